"""Files that come from anywhere: their paths, and the lines of a text."""

from __future__ import annotations

from collections.abc import Iterator
from os import PathLike, fspath
from pathlib import Path
from typing import TextIO

#: Most characters of a line of a table.
MAX_LINE = 1 << 16
#: What may separate the cells of a table.
DELIMITERS = ",;\t"


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
    """Yield the lines of a text, with their line breaks.

    Args:
        file: the text.
        source: its name, for messages.
        error: type of the error.

    Raises:
        error: a line has more than ``MAX_LINE`` characters.
    """
    number = 0
    while line := file.readline(MAX_LINE + 1):
        number += 1
        if len(line) > MAX_LINE:
            raise error(f"{source}: line {number} has more than {MAX_LINE} characters")
        yield line
