"""Reader of bus logs in MF4 (ASAM MDF 4) whose memory is bounded, whatever the file claims."""

from __future__ import annotations

import contextlib
import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from traceback import walk_tb
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..wire.layout.slot_messages import FD_LENGTHS
from .frame_block import BLOCK_FRAMES, MAX_DATA, MAX_OBJECT, FrameBlock, joined_blocks
from .log_summary import LogSummary, Skipped

#: Head of a compressed block of an MF4 file, with the lengths of its data unpacked and packed.
_DZ_MARK, _DZ = b"##DZ\0\0\0\0", struct.Struct("<32xQQ")
#: Channel of the data frames, and prefix of the names of its fields.
_FRAME = "CAN_DataFrame"
#: Records of other groups, by the name of their channel.
_SKIPPED = {"CAN_ErrorFrame": Skipped.ERROR, "CAN_RemoteFrame": Skipped.REMOTE}
#: Fields that may be texts.
_TEXTS = ("BusChannel", "Dir", "DataBytes")
#: Bit of an ID that marks a 29-bit one, where the field IDE is missing.
_EXTENDED = 1 << 31
_MAX_STANDARD = 0x7FF
#: Number in the field Dir of a transmit request, and what its text begins with.
_REQUEST, _REQUEST_TEXT = 2, "txr"
_LENGTHS = np.array(FD_LENGTHS)


class Mf4Reader:
    """MF4 reader that yields the data frames of all groups as blocks, in the order of their times.

    A group of data frames has the channel ``CAN_DataFrame``. Some fields of it may be missing: IDE
    (bit 31 of the ID is it), DataLength (the DLC tells it), BusChannel and Dir. asammdf unpacks a
    block as a whole, so blocks of more than ``MAX_OBJECT`` bytes are refused.

    Args:
        path: of the file.
        summary: of the log.

    Raises:
        ValueError: a block is larger, the file is damaged, or it is no log of a CAN bus.
    """

    def __init__(self, path: Path, summary: LogSummary) -> None:
        with path.open("rb") as file:
            if not file.read(8).startswith((b"MDF ", b"UnFinMF ")):
                raise ValueError("it does not begin with MDF")
        check_mf4_blocks(path)
        self._summary = summary
        self._channels: dict[str, int] = {}
        self._mdf = _opened(path)
        self._start_ns = _start_ns(self._mdf.header)
        summary.times = "absolute" if self._start_ns else "zero"

    def __enter__(self) -> Mf4Reader:
        return self

    def __exit__(self, *exception: object) -> None:
        self._mdf.close()

    def __iter__(self) -> Iterator[FrameBlock]:
        runs: list[Iterator[FrameBlock]] = []
        others = Counter[Skipped]()
        for number, group in enumerate(self._mdf.groups):
            names = {channel.name for channel in group.channels}
            if _FRAME in names and _may_be_can(group):
                runs.append(self._run(number))
            elif names & set(_SKIPPED) or _is_bus_event(group):
                kind = next((_SKIPPED[name] for name in _SKIPPED if name in names), Skipped.OTHER)
                others[kind] += group.channel_group.cycles_nr
        self._summary.skipped += others  # without those that are 0
        if not runs and not others:
            raise ValueError(f"it is no log of a CAN bus: no group has the channel {_FRAME}")
        return self._merged(runs)

    def _run(self, group: int) -> Iterator[FrameBlock]:
        """Yield the data frames of a group."""
        for offset in range(0, self._mdf.groups[group].channel_group.cycles_nr, BLOCK_FRAMES):
            try:
                fields, seconds = self._fields(group, offset)
            except Exception as error:
                raise ValueError(f"asammdf cannot read it: {error}") from error
            block = self._block(fields, seconds)
            if len(block):
                yield block

    def _fields(
        self, group: int, offset: int
    ) -> tuple[dict[str, NDArray[Any]], NDArray[np.float64]]:
        """Return the fields of frames, by their names in the standard, and their times [s]."""

        def read(name: str, *, raw: bool = False) -> Any:
            return self._mdf.get(
                name, group, raw=raw, record_offset=offset, record_count=BLOCK_FRAMES
            )

        found, fields = read(_FRAME), {}
        names = found.samples.dtype.names
        for channel in self._mdf.groups[group].channels:
            name = channel.name.removeprefix(f"{_FRAME}.")
            if name == channel.name:
                continue
            # asammdf may leave out the conversions of the fields of a structure.
            is_read = channel.conversion is None and channel.name in (names or ())
            values = found[channel.name] if is_read else read(channel.name).samples
            if values.dtype.kind in "SUO" and name not in _TEXTS:
                values = read(channel.name, raw=True).samples
                if values.dtype.kind in "SUO":
                    raise ValueError(f"the field {channel.name} of a group is no number")
            fields[name] = values
        return fields, found.timestamps

    def _block(
        self, fields: Mapping[str, NDArray[Any]], seconds: NDArray[np.float64]
    ) -> FrameBlock:
        for name in ("ID", "DataBytes"):
            if name not in fields:
                raise ValueError(f"a group of frames has no field {_FRAME}.{name}")
        n = len(seconds)
        t_ns = np.rint(seconds * 1e9)
        if n and not np.abs(t_ns).max() < 2**62:
            raise ValueError("the time stamp is beyond 64 bits of nanoseconds")
        given = _data(fields["DataBytes"])
        stated = _length(fields, given.shape[1])
        if n and stated.max() > MAX_DATA:
            raise ValueError(f"a frame has at most {MAX_DATA} bytes of data")
        length = np.minimum(stated, given.shape[1]).astype(np.uint8)
        width = 8 if n == 0 or length.max() <= 8 else MAX_DATA
        data = np.zeros((n, width), np.uint8)
        known = min(width, given.shape[1])
        data[:, :known] = np.where(np.arange(known) < length[:, None], given[:, :known], 0)
        id_field = fields["ID"].astype(np.uint32)
        can_id = id_field & np.uint32(0x1FFFFFFF)
        is_extended = (id_field >= _EXTENDED) | (can_id > _MAX_STANDARD)
        block = FrameBlock(
            can_id=can_id,
            is_extended=is_extended | (fields["IDE"] != 0) if "IDE" in fields else is_extended,
            t_ns=t_ns.astype(np.int64) + self._start_ns,
            has_time=np.ones(n, bool),
            channel=self._numbers(fields.get("BusChannel"), n),
            length=length,
            data=data,
            channels=tuple(self._channels),
        )
        return self._on_bus(block, fields)

    def _numbers(self, of_frame: NDArray[Any] | None, n: int) -> NDArray[np.uint16]:
        """Return the numbers of the channels of frames; new ones are added."""
        if of_frame is None:
            return np.full(n, self._channels.setdefault("", len(self._channels)), np.uint16)
        values, first, place = np.unique(of_frame, return_index=True, return_inverse=True)
        names = [_text(value) for value in values]
        for k in np.argsort(first):
            self._channels.setdefault(names[k], len(self._channels))
        return np.array([self._channels[name] for name in names], np.uint16)[place]

    def _on_bus(self, block: FrameBlock, fields: Mapping[str, NDArray[Any]]) -> FrameBlock:
        """Return the frames that were on the bus as data frames; count the others."""
        is_request, is_remote = np.zeros((2, len(block)), bool)
        if (direction := fields.get("Dir")) is not None:
            values, place = np.unique(direction, return_inverse=True)
            is_request = np.array(
                [_text(v).lower().startswith((str(_REQUEST), _REQUEST_TEXT)) for v in values], bool
            )[place]
        if "RTR" in fields:
            is_remote = (fields["RTR"] != 0) & ~is_request
        for kind, those in ((Skipped.REQUEST, is_request), (Skipped.REMOTE, is_remote)):
            if those.any():
                self._summary.skipped[kind] += int(those.sum())
        is_frame = ~(is_request | is_remote)
        return block if is_frame.all() else block.where(is_frame)

    def _merged(self, runs: Sequence[Iterator[FrameBlock]]) -> Iterator[FrameBlock]:
        """Yield the frames of groups, each in its order, in the order of their times."""
        if len(runs) == 1:
            yield from runs[0]
            return
        waiting = [(block, run) for run in runs if (block := next(run, None)) is not None]
        while waiting:
            # No group has more frames up to the time at which the first of the blocks ends.
            end = min(block.t_ns[-1] for block, _ in waiting)
            counts = [
                len(block) if block.t_ns[-1] == end else int(np.searchsorted(block.t_ns, end))
                for block, _ in waiting
            ]
            ready = [
                block.part(0, count)
                for (block, _), count in zip(waiting, counts, strict=True)
                if count
            ]
            found = replace(joined_blocks(ready), channels=tuple(self._channels))
            yield found.where(np.argsort(found.t_ns, kind="stable"))
            rest = [
                (block.part(count, len(block)) if count < len(block) else next(run, None), run)
                for (block, run), count in zip(waiting, counts, strict=True)
            ]
            waiting = [(block, run) for block, run in rest if block is not None]


def _opened(path: Path) -> Any:
    from asammdf import MDF
    from asammdf.blocks.mdf_v4 import MDF4

    try:
        return MDF(path)
    except Exception as error:
        for frame, _ in walk_tb(error.__traceback__):
            half_open = frame.f_locals.get("self")
            if isinstance(half_open, MDF4):  # else its end prints the traceback of a second error
                with contextlib.suppress(AttributeError):
                    half_open.close()
        raise ValueError(f"asammdf cannot open it: {error}") from error


def _start_ns(header: Any) -> int:
    """Return the time at which a file begins [ns]; one without a zone is local time."""
    start = header.start_time
    if start.tzinfo is not None:
        return int(header.abs_time)
    return int(header.abs_time) - start.astimezone().utcoffset() // timedelta(microseconds=1) * 1000


def _is_bus_event(group: Any) -> bool:
    from asammdf.blocks.v4_constants import FLAG_CG_BUS_EVENT

    return bool(group.channel_group.flags & FLAG_CG_BUS_EVENT)


def _may_be_can(group: Any) -> bool:
    """Return whether a group says of CAN frames, or says nothing of its bus."""
    from asammdf.blocks.v4_constants import BUS_TYPE_CAN, BUS_TYPE_NONE, BUS_TYPE_OTHER

    source = group.channel_group.acq_source
    return source is None or source.bus_type in {BUS_TYPE_NONE, BUS_TYPE_OTHER, BUS_TYPE_CAN}


def _text(value: Any) -> str:
    return value.decode("latin-1") if isinstance(value, bytes) else str(value)


def _data(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Return the bytes of frames as one row for each, of at most 64 bytes."""
    if values.ndim == 1:  # texts
        values = (
            np.ascontiguousarray(values).view(np.uint8).reshape(len(values), values.dtype.itemsize)
        )
    return values[:, :MAX_DATA]


def _length(fields: Mapping[str, NDArray[Any]], width: int) -> NDArray[np.int64]:
    """Return the numbers of bytes of frames; without the field, the DLC tells it."""
    if "DataLength" in fields:
        return fields["DataLength"].astype(np.int64)
    n = len(fields["DataBytes"])
    if "DLC" not in fields:
        return np.full(n, width)
    dlc = np.minimum(fields["DLC"].astype(np.int64), 15)
    is_fd = fields["EDL"] != 0 if "EDL" in fields else np.full(n, width > 8)
    return np.where(is_fd, _LENGTHS[dlc], np.minimum(dlc, 8))


def check_mf4_blocks(path: Path) -> None:
    """Raise ValueError if a block ##DZ is too large, by the lengths that it states."""
    with path.open("rb") as file:
        data = b""
        while chunk := file.read(MAX_OBJECT):
            data = data[-_DZ.size :] + chunk  # a block may begin in the chunk before
            place = -1
            while 0 <= (place := data.find(_DZ_MARK, place + 1)) <= len(data) - _DZ.size:
                largest = max(_DZ.unpack_from(data, place))
                if largest > MAX_OBJECT:
                    raise ValueError(
                        f"a compressed block has {largest} bytes, more than {MAX_OBJECT}"
                    )
