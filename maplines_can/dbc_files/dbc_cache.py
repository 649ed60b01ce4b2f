"""A DBC file and its tables, which are kept, so that a known DBC is not parsed again.

Those of the DBCs of this package are in the folder ``packaged``, which ``tools/make_dbc.py``
writes; those of others in the user's cache. What is kept is known by the bytes of the file, the
encoding that the user states, our version, and the cantools that is installed.
"""

from __future__ import annotations

import hashlib
from contextlib import suppress
from functools import cached_property
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from ..values.output_files import read_cached, write_cached
from .dbc_tables import DbcTables, from_json, tables_of, to_json
from .encoding import decoded, say
from .parser import parse_database, read_bytes

#: Folder with the tables of the DBCs of this package.
PACKAGED = Path(__file__).with_name("packaged")


class DbcFile:
    """A DBC file that is read.

    Args:
        path: of the file.
        encoding: as the user states it; None to find it.

    Raises:
        LayoutError: the file cannot be read, or is too large.
    """

    def __init__(self, path: Path, encoding: str | None = None) -> None:
        self.source = str(path)
        self._path, self._encoding, self._data = path, encoding, read_bytes(path)

    def kept(self) -> DbcTables | None:
        """Return the tables that are kept of such a file; None if there are none."""
        packaged = PACKAGED / f"{self._path.stem}.json"
        if packaged.is_file():
            text = packaged.read_text(encoding="utf-8")
            if tables := from_json(key_of(self._data, self._encoding), text):
                return tables
        return from_json(self._key, read_cached(f"{self._key}.json"))

    def keep(self, tables: DbcTables) -> None:
        """Keep the tables of this file, unless cantools logs a warning when it parses it."""
        if tables.is_unique:
            write_cached(f"{self._key}.json", to_json(self._key, tables))

    @cached_property
    def _key(self) -> str:
        return key_of(self._data, self._encoding, _readers())

    def parsed(self) -> DbcTables:
        """Return the tables of the file, parsed by cantools.

        Warns:
            UserWarning: a unit or a name is uncertain.

        Raises:
            LayoutError: it is not in the encoding, or not a DBC.
        """
        text, doubt = decoded(self._data, self.source, self._encoding)
        say(doubt, self.source)
        return parsed_tables(text, self.source)._replace(doubt=doubt)


def key_of(data: bytes, encoding: str | None = None, readers: str = "") -> str:
    """Return what the tables of a file are known by.

    Args:
        data: content of the file.
        encoding: as the user states it.
        readers: versions that may read it otherwise; those of the package belong to any.
    """
    return hashlib.sha256(f"{readers}\n{encoding}\n".encode() + data).hexdigest()


def parsed_tables(text: str, source: str) -> DbcTables:
    """Return the tables of the text of a DBC; raises as `parse_database`."""
    sha256 = hashlib.sha256(text.encode()).hexdigest()
    return tables_of(parse_database(text, source))._replace(sha256=sha256)


def _readers() -> str:
    """Return what tells this version, and the cantools that is installed, from others.

    ``importlib.metadata`` would need longer for the version of cantools than all the rest.
    """
    readers, spec = import_module(__name__.partition(".")[0]).__version__, find_spec("cantools")
    with suppress(OSError):
        found = Path(spec.origin if spec and spec.origin else "").stat()
        readers += f" {found.st_mtime_ns} {found.st_size}"
    return str(readers)
