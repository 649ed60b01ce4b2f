"""Files of tables: Parquet, CSV, JSON Lines, MF4 and MCAP; ROS 2 bags and traces of ASAM OSI.

It may import ``values``, ``wire`` and ``recordings``.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from .file_per_table import CsvWriter, JsonLinesWriter, ParquetWriter
from .mcap import McapWriter
from .mf4 import Mf4Writer
from .osi import OsiWriter
from .rosbag2 import Rosbag2Writer
from .table_writer import About, PathOf, TableWriter, beside

__all__ = [
    "LINES_ONLY",
    "SUFFIXES",
    "About",
    "PathOf",
    "TableWriter",
    "beside",
    "open_tables",
    "suffix_of",
]

_WRITERS: dict[str, Callable[[PathOf, About], TableWriter]] = {
    ".parquet": ParquetWriter,
    ".csv": CsvWriter,
    ".jsonl": JsonLinesWriter,
    ".mf4": Mf4Writer,
    ".osi.mcap": OsiWriter,
    ".mcap": McapWriter,
    ".rosbag2": Rosbag2Writer,
}
#: Suffixes of the formats, a longer one before its end.
SUFFIXES = tuple(_WRITERS)
#: Suffixes of formats that have neither rejects nor scenes.
LINES_ONLY = (".osi.mcap", ".rosbag2")


def suffix_of(path: Path) -> str:
    """Return the suffix of a file of tables.

    Raises:
        ValueError: the format is unknown.

    >>> suffix_of(Path("lines.osi.mcap"))
    '.osi.mcap'
    >>> suffix_of(Path("lines.txt"))
    Traceback (most recent call last):
    ValueError: lines.txt: a table has the suffix .parquet, .csv, .jsonl, .mf4, .osi.mcap, .mcap or
    .rosbag2
    """
    for suffix in SUFFIXES:
        if path.name.endswith(suffix):
            return suffix
    *others, last = SUFFIXES
    raise ValueError(f"{path}: a table has the suffix {', '.join(others)} or {last}")


def open_tables(path_of: PathOf, about: About, suffix: str, *, bands: bool = True) -> TableWriter:
    """Return a writer of tables.

    The files are written under temporary names, and have their own once ``close`` has returned.

    Args:
        path_of: paths of the files.
        about: what the files say of their source.
        suffix: one of `SUFFIXES`.
        bands: whether MCAP has the lines as a scene, too.

    Raises:
        MissingExtraError: a package of the format is not installed.
        OSError: a file cannot be written.
    """
    if suffix == ".mcap":
        return McapWriter(path_of, about, bands=bands)
    return _WRITERS[suffix](path_of, about)
