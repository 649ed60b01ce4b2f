"""What the writers of tables share: names of files, and what a file says of its source."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Protocol

from ... import __version__
from ...values.output_files import temporary_path
from ...wire import LineCodec
from ..line_tables import LineTable

#: Path of the file of a table, by its name: lines, rejects or scenes.
PathOf = Callable[[str], Path]


def beside(path: Path) -> PathOf:
    """Return the paths of tables of which the lines are in a file: others are beside it.

    >>> beside(Path("drive.csv"))("rejects").name
    'drive.rejects.csv'
    """
    return lambda name: (
        path if name == "lines" else path.with_name(f"{path.stem}.{name}{path.suffix}")
    )


@dataclass(frozen=True)
class About:
    """What a file of tables says of its source, as texts.

    Args:
        log: name of the log.
        dbc: name of the DBC.
        dbc_sha256: of its text.
        at: distances ahead of the car [m].
        cycle_ms: longest cycle time of a line [ms].
    """

    log: str
    dbc: str
    dbc_sha256: str
    at: tuple[float, ...] = ()
    cycle_ms: int = 100
    maplines_can: str = field(default=__version__)

    @classmethod
    def of(
        cls, codec: LineCodec, log: str, at: tuple[float, ...], cycle_ms: float | None = None
    ) -> About:
        """Return what a log, its codec and the stated cycle time, if it is, say."""
        layout = codec.layout
        cycles = [own.cycle_ms or cls.cycle_ms for own in layout.messages_of.values()]
        cycle = max(cycles) if cycle_ms is None else math.ceil(cycle_ms)
        return cls(Path(log).name, Path(layout.source).name, layout.sha256, at, cycle)

    @property
    def texts(self) -> dict[str, str]:
        """The values by name, as texts."""
        texts = {name: str(value) for name, value in asdict(self).items()}
        return texts | {"at": " ".join(f"{x:g}" for x in self.at)}


class TableWriter(Protocol):
    """Writer of the tables of a log, block by block."""

    @property
    def path(self) -> Path:
        """Path of the file of the lines, for messages."""

    def write(self, table: LineTable) -> None:
        """Write the rows of a block."""

    def close(self) -> list[Path]:
        """Complete the files and return their paths."""

    def abort(self) -> None:
        """Leave no file."""


class FilesWriter:
    """Base of the writers.

    Args:
        path_of: paths of the files.
    """

    def __init__(self, path_of: PathOf) -> None:
        self._files, self.path = PartFiles(path_of), path_of("lines")

    def abort(self) -> None:
        """Leave no file."""
        with suppress(OSError):  # what is left cannot be written, either
            self._release()
        self._files.abort()

    def _release(self) -> None:
        """Close the temporary files."""


class PartFiles:
    """The files of a writer by the names of their tables, under temporary names until `close`.

    Args:
        path_of: returns the path of the file of a table by its name, such as "lines".
    """

    def __init__(self, path_of: PathOf) -> None:
        self._path_of = path_of
        self._paths: dict[Path, Path] = {}  # temporary ones, by the final ones

    def temporary(self, name: str) -> Path:
        """Return the temporary path of the file of a table, which is new."""
        final = self._path_of(name)
        self._paths[final] = temporary_path(final)
        return self._paths[final]

    def close(self) -> list[Path]:
        """Give the files their names; return their paths."""
        for final, part in self._paths.items():
            if part != final:
                part.replace(final)
        return [*self._paths]

    def abort(self) -> None:
        """Remove the files."""
        for final, part in self._paths.items():
            if part != final:
                part.unlink(missing_ok=True)
