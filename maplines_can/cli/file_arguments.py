"""Files that a command is given: one that exists is replaced only with ``--force``, and what to do
about one that does not exist.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from difflib import get_close_matches
from itertools import islice
from pathlib import Path

from .command_line import option_group


def add_force(parser: argparse.ArgumentParser) -> None:
    """Add ``--force``, for ``check_new``."""
    option_group(parser, "output").add_argument(
        "--force",
        action="store_true",
        help="replace files that exist (default: end with an error before anything is written)",
    )


def check_new(arguments: argparse.Namespace, *paths: str | Path | None) -> None:
    """Check that no file to be written exists, unless ``--force`` is given.

    Commands call this before their work, which may take long.

    Args:
        arguments: with those of ``add_force``.
        paths: of the files; None for one that is not wanted. With those that the command does not
            write but that would be taken for its own, as they are beside what it writes: with
            ``--force`` it removes them.

    Raises:
        ValueError: a file exists.
    """
    if arguments.force:
        return
    for path in paths:
        if path is not None and Path(path).exists():
            raise ValueError(
                f"{path} exists already; use another name, or --force to replace the file"
            )


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
    from ..maps.formats.load import SHIPPED as MAPS  # what --help does not need
    from ..wire import SHIPPED as DBCS

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
