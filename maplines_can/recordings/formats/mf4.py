"""MF4: a channel group a slot, with physical channels such as ``EgoLeft.y40``."""

from __future__ import annotations

import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from ...values.errors import missing_extra
from ...values.line import Slot
from ...wire.layout.record_signals import slot_title
from ..line_tables import LineTable, Table
from .table_writer import About, FilesWriter, PathOf

_TITLES = {slot.name: slot_title(slot) for slot in Slot}
#: Columns that are no channels.
_NOT_CHANNELS = ("t", "t_ns", "channel", "slot")


class Mf4Writer(FilesWriter):
    """Writer of MF4 (ASAM MDF 4.1), for measurement tools.

    The rows of each group are spooled to a temporary file and appended at once at the end, since
    asammdf extends a group by copying it. Categories are numbers with a conversion to text.

    Args:
        path_of: paths of the files.
        about: source of the tables: the comment of the file.

    Raises:
        MissingExtraError: asammdf is not installed.
    """

    def __init__(self, path_of: PathOf, about: About) -> None:
        try:
            import asammdf
        except ImportError as error:
            raise missing_extra("an MF4 file needs asammdf", "mf4") from error
        super().__init__(path_of)
        self._asammdf, self._about = asammdf, about
        self._groups: dict[str, tuple[IO[bytes], np.dtype[np.void], Table]] = {}
        self._path = self._files.temporary("lines")
        self._begin_ns: int | None = None

    def write(self, table: LineTable) -> None:
        """Spool the rows of a block."""
        for name, part in table.parts.items():
            many = len(part.categories.get("channel", ())) > 1
            keys = part.columns["channel"].astype(np.int64) * len(Slot)
            keys = keys + part.columns["slot"] if name == "lines" else keys
            for key in np.unique(keys):
                rows = part.where(keys == key)
                group = _TITLES[str(rows["slot"][0])] if name == "lines" else name
                self._spool(f"{rows['channel'][0]}.{group}" if many else group, rows)

    def _spool(self, group: str, rows: Table) -> None:
        t_ns = rows.columns["t_ns"]
        if self._begin_ns is None:
            self._begin_ns = int(t_ns[0])
        names = [name for name in rows.columns if name not in _NOT_CHANNELS]
        if group not in self._groups:
            kinds: list[Any] = [("t", "f8")]
            for name in names:
                kind = rows.columns[name].dtype
                kinds.append((name, "u1" if kind.kind == "b" else kind))
            spool = tempfile.TemporaryFile()  # noqa: SIM115 - open until close
            self._groups[group] = spool, np.dtype(kinds), rows
        file, dtype, _ = self._groups[group]
        spooled = np.empty(len(rows), dtype)
        spooled["t"] = (t_ns - self._begin_ns) / 1e9
        for name in names:
            spooled[name] = rows.columns[name]
        file.write(spooled.tobytes())

    def close(self) -> list[Path]:
        """Write the file and return its path."""
        with self._asammdf.MDF(version="4.10") as mdf:
            begin = datetime.fromtimestamp((self._begin_ns or 0) / 1e9, UTC)
            mdf.header.start_time = begin
            mdf.header.comment = "; ".join(f"{k}: {v}" for k, v in self._about.texts.items())
            for group, (file, dtype, rows) in self._groups.items():
                file.flush()
                samples = np.memmap(file, dtype, "r")
                signals = [
                    self._signal(f"{group}.{name}", samples, name, rows)
                    for name in dtype.names or ()
                    if name != "t"
                ]
                mdf.append(signals, comment=group, acq_name=group)
            saved = self._path.with_suffix(".mf4")  # asammdf replaces the suffix of another name
            try:
                mdf.save(saved, overwrite=True, compression=1)
                saved.replace(self._path)
            finally:
                saved.unlink(missing_ok=True)
        self._release()
        return self._files.close()

    def _signal(self, channel: str, samples: NDArray[np.void], name: str, rows: Table) -> Any:
        conversion: dict[str, object] | None = None
        if name in rows.categories:
            texts = rows.categories[name]
            conversion = {f"val_{k}": k for k in range(len(texts))}
            conversion |= {f"text_{k}": text for k, text in enumerate(texts)}
            conversion["default"] = b""
        return self._asammdf.Signal(
            np.ascontiguousarray(samples[name]),
            np.ascontiguousarray(samples["t"]),
            name=channel,
            unit=rows.units.get(name, ""),
            conversion=conversion,
        )

    def _release(self) -> None:
        for file, _, _ in self._groups.values():
            file.close()
