"""What to do about a file that does not exist: take one with a similar name, or make one."""

from __future__ import annotations

from collections.abc import Sequence
from difflib import get_close_matches
from itertools import islice
from pathlib import Path

from ..maps.formats.load import SHIPPED as MAPS
from ..wire import SHIPPED as DBCS

#: Files of a folder whose names are compared.
MAX_FILES = 10_000
#: Logs that ``maplines drive`` writes, and suffixes of maps.
LOGS, MAP_SUFFIXES = (".log", ".asc", ".blf", ".mf4"), (".xodr", ".osm", ".xml", ".geojson")


def missing_file_hint(message: str, words: Sequence[str]) -> str:
    """Return what to do about the missing file of an error message, as the end of a sentence.

    It is empty if the message is about something else.

    Args:
        message: of the error.
        words: of the command.
    """
    if "o such file" not in message and "no set or file" not in message:
        return ""
    paths = [Path(word.partition("=")[2] if word.startswith("--") else word) for word in words]
    named = [path for path in paths if path.name and path.name in message and not path.exists()]
    return _hint(max(named, key=lambda path: len(path.name))) if named else ""


def _hint(path: Path) -> str:
    is_here = path.parent == Path()
    shipped = [*DBCS, *MAPS] if is_here else []
    try:
        there = [one.name for one in islice(path.parent.iterdir(), MAX_FILES)]
    except OSError:
        there = []
    if like := get_close_matches(path.name, [*there, *shipped], 1):
        return f"; did you mean {path.with_name(like[0])}?"
    suffix = path.suffix.lower()
    if suffix in LOGS:
        return f"; 'maplines drive --as-fast-as-possible --record {path}' makes one"
    if suffix == ".dbc":
        return f"; this package has {', '.join(DBCS)}"
    if suffix in MAP_SUFFIXES:
        return f"; this package has {', '.join(MAPS)}"
    return f"; it was looked for in {path.parent.absolute()}"
