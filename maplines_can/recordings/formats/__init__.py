"""Files of tables: Parquet, CSV, JSON Lines, MF4 and MCAP.

It may import ``values``, ``wire`` and ``recordings``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from .file_per_table import CsvWriter, JsonLinesWriter, ParquetWriter
from .mcap import McapWriter
from .mf4 import Mf4Writer
from .table_writer import About, PathOf, TableWriter, beside

__all__ = ["SUFFIXES", "About", "PathOf", "TableWriter", "beside", "open_tables", "suffix_of"]

_WRITERS: dict[str, Callable[[PathOf, About], TableWriter]] = {
    ".parquet": ParquetWriter,
    ".csv": CsvWriter,
    ".jsonl": JsonLinesWriter,
    ".mf4": Mf4Writer,
    ".mcap": McapWriter,
}
#: Suffixes of the formats.
SUFFIXES = tuple(_WRITERS)


def suffix_of(path: Path) -> str:
    """Return the suffix of a file of tables.

    Raises:
        ValueError: the format is unknown.

    >>> suffix_of(Path("lines.txt"))
    Traceback (most recent call last):
    ValueError: lines.txt: a table has the suffix .parquet, .csv, .jsonl, .mf4 or .mcap
    """
    if path.suffix not in SUFFIXES:
        *others, last = SUFFIXES
        raise ValueError(f"{path}: a table has the suffix {', '.join(others)} or {last}")
    return path.suffix


def open_tables(path_of: PathOf, about: About, suffix: str) -> TableWriter:
    """Return a writer of tables.

    The files are written under temporary names, and have their own once ``close`` has returned.

    Args:
        path_of: paths of the files.
        about: what the files say of their source.
        suffix: one of `SUFFIXES`.

    Raises:
        MissingExtraError: a package of the format is not installed.
        OSError: a file cannot be written.
    """
    return _WRITERS[suffix](path_of, about)
