"""Files that come from anywhere: their paths, the lines of a text, and values in TOML and JSON."""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Callable, Iterator
from os import PathLike, fspath
from pathlib import Path
from typing import Any, TextIO

#: Most characters of a line of a table.
MAX_LINE = 1 << 16
#: What may separate the cells of a table.
DELIMITERS = ",;\t"
#: Deepest nesting of values in TOML and JSON; parsers and messages recurse into deeper ones.
MAX_NESTING = 32
_KEY = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')[ \t]*\.[ \t]*"""
#: A key or header of TOML that nests deeper; it is refused before the text is parsed.
_LONG_KEY = re.compile(
    rf"(?:^[ \t]*\[{{0,2}}|[{{,])[ \t]*(?:{_KEY}){{{MAX_NESTING}}}", re.MULTILINE
)


def checked_path(path: str | PathLike[str], error: type[Exception]) -> Path:
    r"""Return a path that a file can have.

    Raises:
        error: it has a NUL character, which ends a path for the operating system.

    >>> checked_path("drive\0.csv", ValueError)
    Traceback (most recent call last):
    ...
    ValueError: 'drive\x00.csv': a path cannot have a NUL character
    """
    if "\0" in fspath(path):
        raise error(f"{fspath(path)[:200]!r}: a path cannot have a NUL character")
    return Path(path)


def lines_of(file: TextIO, source: str, error: type[Exception]) -> Iterator[str]:
    """Yield the lines of a text, with their line breaks; the source is its name, for messages.

    Raises:
        error: a line has more than ``MAX_LINE`` characters.
    """
    number = 0
    while line := file.readline(MAX_LINE + 1):
        number += 1
        if len(line) > MAX_LINE:
            raise error(f"{source}: line {number} has more than {MAX_LINE} characters")
        yield line


def toml_of(text: str, source: str, error: type[Exception]) -> dict[str, Any]:
    """Return the values of a text in TOML; the source is its name, for messages.

    Raises:
        error: it is not TOML, or is nested deeper than ``MAX_NESTING``.

    >>> toml_of("a = [", "car.toml", ValueError)
    Traceback (most recent call last):
    ...
    ValueError: car.toml: is not valid TOML: Invalid value (at end of document)
    """
    values: dict[str, Any] = _parsed("TOML", tomllib.loads, text, source, error)
    return values


def json_of(text: str, source: str, error: type[Exception]) -> Any:
    """Return the value of a text in JSON; arguments and errors are those of ``toml_of``.

    >>> json_of("[" * 100_000, "log.json", ValueError)
    Traceback (most recent call last):
    ...
    ValueError: log.json: values must be nested at most 32 deep
    """
    return _parsed("JSON", json.loads, text, source, error)


def _parsed(
    kind: str, parse: Callable[[str], Any], text: str, source: str, error: type[Exception]
) -> Any:
    too_deep = error(f"{source}: values must be nested at most {MAX_NESTING} deep")
    if kind == "TOML" and _LONG_KEY.search(text):
        raise too_deep
    try:
        value = parse(text)
    except ValueError as wrong:
        raise error(f"{source}: is not valid {kind}: {wrong}") from wrong
    except RecursionError:
        raise too_deep from None
    level = [value]
    for _ in range(MAX_NESTING + 1):
        level = [
            item
            for each in level
            if isinstance(each, dict | list)
            for item in (each.values() if isinstance(each, dict) else each)
        ]
    if level:
        raise too_deep
    return value
