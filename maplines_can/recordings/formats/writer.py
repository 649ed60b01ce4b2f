"""What the writers of tables share: names of files, and what a file says of its source."""

from __future__ import annotations

import os
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol

from ... import __version__
from ..table import LineTable


@dataclass(frozen=True)
class About:
    """What a file of tables says of its source, as texts.

    Args:
        log: name of the log.
        dbc: name of the DBC.
        dbc_sha256: of its text.
        at: distances ahead of the car [m].
    """

    log: str
    dbc: str
    dbc_sha256: str
    at: tuple[float, ...] = ()
    maplines_can: str = field(default=__version__)

    @property
    def texts(self) -> dict[str, str]:
        """The values by name, as texts."""
        texts = {name: str(value) for name, value in asdict(self).items()}
        return texts | {"at": " ".join(f"{x:g}" for x in self.at)}


class TableWriter(Protocol):
    """Writer of the tables of a log, block by block."""

    def write(self, table: LineTable) -> None:
        """Write the rows of a block."""

    def close(self) -> list[Path]:
        """Complete the files and return their paths."""

    def abort(self) -> None:
        """Leave no file."""


class PartFiles:
    """The files of a writer by the names of their tables, under temporary names until `close`.

    The lines are in the file of the path, and other tables beside it: ``drive.rejects.csv``.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._paths: dict[str, Path] = {}

    def temporary(self, name: str) -> Path:
        """Return the temporary path of the file of a table, which is new."""
        final = self._path
        if name != "lines":
            final = final.with_name(f"{final.stem}.{name}{final.suffix}")
        self._paths[name] = final
        return _temporary(final)

    def close(self) -> list[Path]:
        """Give the files their names; return their paths."""
        for final in self._paths.values():
            _temporary(final).replace(final)
        return [*self._paths.values()]

    def abort(self) -> None:
        """Remove the files."""
        for final in self._paths.values():
            _temporary(final).unlink(missing_ok=True)


def _temporary(final: Path) -> Path:
    return final.with_name(f".{final.name}.{os.getpid()}.part")
