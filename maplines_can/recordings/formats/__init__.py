"""Files of tables: Parquet, CSV, JSON Lines, MF4 and MCAP."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from .mcap import McapWriter
from .mf4 import Mf4Writer
from .parquet import ParquetWriter
from .text import CsvWriter, JsonLinesWriter
from .writer import About, TableWriter

__all__ = ["SUFFIXES", "About", "TableWriter", "open_tables"]

_WRITERS: dict[str, Callable[[Path, About], TableWriter]] = {
    ".parquet": ParquetWriter,
    ".csv": CsvWriter,
    ".jsonl": JsonLinesWriter,
    ".mf4": Mf4Writer,
    ".mcap": McapWriter,
}
#: Suffixes of the formats.
SUFFIXES = tuple(_WRITERS)


def open_tables(path: Path, about: About) -> TableWriter:
    """Return a writer of tables, in the format of the suffix of a path.

    The files are written under temporary names, and have their own once ``close`` has returned.

    Args:
        path: of the file of lines.
        about: what the file says of its source.

    Raises:
        ValueError: the format is unknown.
        MissingExtraError: a package of the format is not installed.
        OSError: the file cannot be written.

    >>> open_tables(Path("lines.txt"), About("drive.log", "maplines.dbc", ""))
    Traceback (most recent call last):
    ValueError: lines.txt: a table has the suffix .parquet, .csv, .jsonl, .mf4, .mcap
    """
    if path.suffix not in _WRITERS:
        raise ValueError(f"{path}: a table has the suffix {', '.join(SUFFIXES)}")
    return _WRITERS[path.suffix](path, about)


