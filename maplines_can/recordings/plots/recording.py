"""What is drawn of a log: columns of its lines, scenes and rejects, by slot."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...logs.log_part import ALL, Time, Window, of_channel
from ...logs.log_summary import LogSummary, Times
from ...values.errors import LogError
from ...values.line import Slot
from ...wire import LineCodec
from ..block_reception import LogReceiver
from ..blocks import read_blocks
from ..fitting import misfit
from ..line_tables import LineTable, Table, left_out_column
from ..read_lines import name_of, tables_of

Array = NDArray[Any]

#: A line is in the view from above if it is not older than this [s].
OLDEST = 1.0


@dataclass(frozen=True, eq=False)
class Recording:
    """Columns of a log, thinned out for nothing yet.

    Args:
        name: of the log.
        begin: time of its first line [s]; the times of the columns are from there on.
        lines: columns of the lines by the name of their slot, after that of their channel if there
            are several.
        scenes: columns of the scenes; none if the DBC has none.
        rejects: times of the dropped frames, by reason.
        log: summary of the log.
        truth: times and lateral positions (n, 9) at 0, 10 .. 80 m, by slot.
    """

    name: str
    begin: float
    lines: Mapping[str, Mapping[str, Array]]
    scenes: Mapping[str, Array]
    rejects: Mapping[str, Array]
    log: LogSummary
    truth: Mapping[Slot, tuple[Array, Array]] = field(default_factory=dict)


def recorded(
    log: Any,
    codec: LineCodec,
    at: Sequence[float],
    *,
    slots: Sequence[Slot] | None = None,
    time: Time = ALL,
    times: Times = "auto",
    channel: str | None = None,
) -> tuple[Recording, str]:
    """Return the columns of a log, and why it is damaged, or nothing.

    Args:
        log: path or stream.
        codec: of the lines.
        at: distances ahead of the car [m].
        slots: these only.
        time: first and last time [s], from the first line on, or of the clock if they are more than
            1e8.
        times: kind of the time stamps, see `read_log`.
        channel: frames of this one only; None for all.

    Raises:
        LogError: the log cannot be opened, has no time stamps, or has no line in this time.
    """
    has_scenes = codec.layout.pose is not None
    kept: dict[str, list[Table]] = {"lines": [], "rejects": [], "scenes": []}
    damage, window, name = "", Window(time), name_of(log)
    receiver = LogReceiver(codec, scenes=has_scenes)
    blocks = of_channel(read_blocks(log, times=times), channel, name)
    columns = ["t", "channel", "slot", "status", "usable", "state", "age", "x_min", "x_max"]
    columns += ["y_off", "beta", "c0", "c1"]
    try:
        for table in tables_of(
            receiver, blocks, at, slots, scenes=has_scenes, window=window, name=name
        ):
            if window.begin is not None:
                for kind, part in table.parts.items():
                    kept[kind].append(_drawn(part, columns))
    except LogError as error:
        damage = str(error)
        if window.begin is None:
            raise
    begin = window.begin
    if receiver.is_empty:
        raise LogError(f"{name}: {misfit(receiver.first, [codec], blocks.summary).text}")
    if begin is None:
        received = sum(one.lines for one in receiver.decoders.values())
        raise LogError(f"{name}: has {received} lines, but none of the slots that are drawn")
    if math.isnan(begin):
        raise LogError(f"{name}: has no time stamps, so there is nothing to draw; use candump -L")
    lines = _joined(kept["lines"])
    if not len(lines):
        raise LogError(f"{name}: has no line in this time")
    many = len(lines.categories["channel"]) > 1
    keys = lines.columns["channel"].astype(int) * len(Slot) + lines.columns["slot"]
    by_slot = {}
    for key in np.unique(keys):
        rows = lines.where(keys == key)
        label = str(rows["slot"][0]).replace("_", " ").lower()
        label = f"{rows['channel'][0]} {label}" if many else label
        by_slot[label] = {name: rows.columns[name] for name in rows.columns} | {
            "state": rows["state"]
        }
    rejects = _joined(kept["rejects"])
    reasons = rejects["reason"] if len(rejects) else np.empty(0, str)
    of_reason = {str(one): rejects["t"][reasons == one] - begin for one in np.unique(reasons)}
    for columns_of in by_slot.values():
        columns_of["t"] = columns_of["t"] - begin
    scenes = dict(_joined(kept["scenes"]).columns) if kept["scenes"] else {}
    for slot in {*Slot} - {*(Slot if slots is None else slots)}:
        scenes.pop(left_out_column(slot), None)
    if "t" in scenes:
        scenes["t"] = scenes["t"] - begin
    drawn = Recording(Path(name).name, begin, by_slot, scenes, of_reason, blocks.summary)
    return drawn, damage


def _drawn(part: Table, columns: list[str]) -> Table:
    """Return the columns that are drawn."""
    if not isinstance(part, LineTable):
        return part
    names = [*columns, *(name for name in part.columns if name.startswith(("y", "sigma", "cov_")))]
    return Table({name: part.columns[name] for name in dict.fromkeys(names)}, part.categories)


def _joined(parts: Sequence[Table]) -> Table:
    if not parts:
        return Table({})
    columns = {
        name: np.concatenate([part.columns[name] for part in parts]) for name in parts[0].columns
    }
    return Table(columns, parts[-1].categories)
