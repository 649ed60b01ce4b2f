"""Received lines as tables: a column an array, with the positions at chosen x and their sigmas."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..logs.log_summary import LogSummary
from ..values.errors import MissingExtraError, missing_extra
from ..values.line import (
    LEFT_OUT,
    PARAMETERS,
    Kind,
    Slot,
    Status,
    are_within,
    lateral,
    lateral_jacobian,
)
from ..wire import E2EState
from ..wire.reception.check import Reason
from .block_reception import COMPLETE, REASONS, LineBlock
from .blocks import FrameBlock

#: Rows and columns of the upper triangle of a covariance.
UPPER_TRIANGLE = [(i, j) for i in range(4) for j in range(i, 4)]
#: Units of the parameters of a line.
PARAMETER_UNITS = ("m", "rad", "1/m", "1/m^2")
#: Lines of the ego lane.
LANE = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
#: Reasons for which whole scenes have no line of a slot, by their numbers.
LEFT_OUT_NAMES = tuple("" if reason is None else reason.name for reason in LEFT_OUT)
#: Reasons of frames that are not rejected.
_NOT_REJECTED = (COMPLETE, REASONS.index(Reason.PENDING), REASONS.index(Reason.FOREIGN))

Array = NDArray[Any]


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of equal length, with their units.

    Args:
        columns: (n,) arrays by name; those of a category have its places.
        categories: the texts of a category, by the name of its column.
        units: of columns, by name; a column without one has no unit.

    >>> table = Table({"slot": np.array([1, 0])}, {"slot": ("EGO_LEFT", "EGO_RIGHT")})
    >>> table["slot"].tolist(), len(table)
    (['EGO_RIGHT', 'EGO_LEFT'], 2)
    """

    columns: Mapping[str, Array]
    categories: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()), ()))

    def __getitem__(self, name: str) -> Array:
        """Return a column; of a category, its texts."""
        column = self.columns[name]
        if name not in self.categories:
            return column
        return np.array([*self.categories[name], ""])[column]

    def where(self, keep: Array) -> Table:
        """Return the rows at these places, or where a mask is true."""
        columns = {name: column[keep] for name, column in self.columns.items()}
        return Table(columns, self.categories, self.units)

    def to_arrow(self) -> Any:
        """Return a ``pyarrow.Table``; each field has its unit in its metadata.

        Raises:
            MissingExtraError: pyarrow is not installed.
        """
        try:
            import pyarrow as pa
        except ImportError as error:
            raise missing_extra("an Arrow table needs pyarrow", "tables") from error
        fields, arrays = [], []
        for name, column in self.columns.items():
            array = pa.array(column)
            if name in self.categories:
                indices = pa.array(column.astype(np.int32))
                array = pa.DictionaryArray.from_arrays(indices, pa.array(self.categories[name]))
            elif column.dtype.kind == "f":
                array = pa.array(column, from_pandas=True)  # no number is null
            unit = self.units.get(name)
            fields.append(pa.field(name, array.type, metadata={"unit": unit} if unit else None))
            arrays.append(array)
        return pa.Table.from_arrays(arrays, schema=pa.schema(fields))

    def to_pandas(self) -> Any:
        """Return a ``pandas.DataFrame``; a category becomes a ``Categorical``.

        Raises:
            MissingExtraError: pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError as error:
            raise MissingExtraError("there is no pandas: pip install pandas") from error
        columns: dict[str, Any] = dict(self.columns)
        for name, texts in self.categories.items():
            columns[name] = pd.Categorical.from_codes(self.columns[name].astype(int), list(texts))
        return pd.DataFrame(columns)

    def to_polars(self) -> Any:
        """Return a ``polars.DataFrame``.

        Raises:
            MissingExtraError: polars or pyarrow is not installed.
        """
        try:
            import polars as pl
        except ImportError as error:
            raise MissingExtraError("there is no polars: pip install polars") from error
        return pl.from_arrow(self.to_arrow())


@dataclass(frozen=True, eq=False)
class LineTable(Table):
    """A row a line; `read_lines` gives the columns.

    Args:
        at: distances ahead of the car at which there are a position and its sigma [m].
        rejects: a row a frame that was dropped at once, but those of other messages.
        scenes: a row a scene, with the width and the centre of the ego lane at each x.
        log: summary of the log, as far as it has been read: what is no data frame, by kind.
    """

    at: tuple[float, ...] = ()
    rejects: Table = field(default_factory=lambda: Table({}))
    scenes: Table = field(default_factory=lambda: Table({}))
    log: LogSummary = field(default_factory=LogSummary)

    @property
    def parts(self) -> dict[str, Table]:
        """The tables by name: lines, rejects, and scenes if they were asked for."""
        parts: dict[str, Table] = {"lines": self, "rejects": self.rejects}
        return parts | ({"scenes": self.scenes} if self.scenes.columns else {})


def line_table(
    block: LineBlock,
    frames: FrameBlock | None,
    at: Sequence[float] = (),
    slots: Sequence[Slot] | None = None,
    *,
    scenes: bool = False,
) -> LineTable:
    """Return the tables of a block of lines.

    Args:
        block: the lines.
        frames: of which they were received; None after the last one.
        at: distances ahead of the car [m], in [-1000, 1000].
        slots: lines of these only; by default all.
        scenes: whether there is a table of the scenes.

    Raises:
        ValueError: a distance is not in its range.
    """
    xs = checked_at(at)
    keep = np.arange(len(block))
    if slots is not None:
        keep = np.flatnonzero(np.isin(block.lines["slot"], np.array([*slots], np.uint8)))
    rows, named = block.lines[keep], {"channel": block.channels}
    seconds = np.where(block.has_time[keep], rows["t_ns"] / 1e9, np.nan)
    columns: dict[str, Array] = {"t": seconds, "t_ns": rows["t_ns"]}
    columns["channel"] = block.channel[keep]
    columns |= {name: rows[name] for name in ("slot", "kind", "status", "usable")}
    columns["state"] = _STATE_PLACES[rows["state"]]
    columns |= {name: rows[name] for name in ("two_senders", "counter", "ahead", "components")}
    # What must not be used has no values, whatever the state of its slot.
    known = (rows["status"] != Status.OUT_OF_RANGE) & np.isfinite(rows["age"])
    mean = np.where(known[:, None], rows["mean"], np.nan)
    cov = np.where(known[:, None, None], rows["cov"], np.nan)
    for name in ("age", "x_min", "x_max"):
        columns[name] = np.where(known, rows[name], np.nan)
    columns |= {name: mean[:, i] for i, name in enumerate(PARAMETERS)}
    for i, j in UPPER_TRIANGLE:
        columns[f"cov_{PARAMETERS[i]}_{PARAMETERS[j]}"] = cov[:, i, j]
    for x in xs:
        y, sigma = position(mean, cov, x)
        is_in = are_within(columns["x_min"], columns["x_max"], x)
        columns[f"y{x:g}"] = np.where(is_in, y, np.nan)
        columns[f"sigma{x:g}"] = np.where(is_in, sigma, np.nan)
    of_scenes = _scene_table(block, xs, named) if scenes else Table({})
    rejects = _reject_table(block, frames, named)
    return LineTable(columns, named | _CATEGORIES, _units(columns), xs, rejects, of_scenes)


def joined(tables: Sequence[LineTable]) -> LineTable:
    """Return tables with the same columns as one; there must be one or more."""

    def parts_of(name: str) -> Table:
        parts = [table.parts[name] for table in tables]
        columns = {
            column: np.concatenate([part.columns[column] for part in parts])
            for column in parts[0].columns
        }
        return Table(columns, parts[-1].categories, parts[-1].units)

    found = {name: parts_of(name) for name in tables[-1].parts}
    lines, last = found["lines"], tables[-1]
    scenes = found.get("scenes", Table({}))
    return LineTable(
        lines.columns, lines.categories, lines.units, last.at, found["rejects"], scenes, last.log
    )


def checked_at(at: Sequence[float]) -> tuple[float, ...]:
    """Return distances without repetition, checked.

    >>> checked_at([0, 40, 40.0])
    (0.0, 40.0)
    >>> checked_at([2000])
    Traceback (most recent call last):
    ValueError: at must be distances in [-1000, 1000] m, got 2000.0
    """
    for x in at:
        if not (math.isfinite(x) and -1000 <= x <= 1000):
            raise ValueError(f"at must be distances in [-1000, 1000] m, got {float(x)}")
    return tuple(dict.fromkeys(map(float, at)))


_CATEGORIES = {
    kind.__name__.lower().removeprefix("e2e"): tuple(one.name for one in sorted(kind))
    for kind in (Slot, Kind, Status, E2EState)
}

#: Places of the E2E states, whose numbers have gaps.
_STATE_PLACES = np.zeros(max(E2EState) + 1, np.uint8)
_STATE_PLACES[sorted(E2EState)] = np.arange(len(E2EState))


def _units(columns: Mapping[str, Array]) -> dict[str, str]:
    """Return the unit of each column that has one."""
    units = {"t": "s", "t_ns": "ns", "age": "s", "x_min": "m", "x_max": "m"}
    units |= dict(zip(PARAMETERS, PARAMETER_UNITS, strict=True))
    for i, j in UPPER_TRIANGLE:
        name = f"cov_{PARAMETERS[i]}_{PARAMETERS[j]}"
        units[name] = f"{PARAMETER_UNITS[i]}*{PARAMETER_UNITS[j]}"
    return {name: units.get(name, "m") for name in columns if name in units or _is_at(name)}


def _is_at(name: str) -> bool:
    """Return whether a column has values at a distance, such as ``sigma40``."""
    head = name.rstrip("0123456789.-+e")
    return head in ("y", "sigma", "width", "sigma_width", "centre", "sigma_centre") and head != name


def position(mean: Array, cov: Array, x: float) -> tuple[Array, Array]:
    """Return the positions of cubics at x [m] and their standard deviations, to first order.

    Those of lines are valid in the range of each.
    """
    J = lateral_jacobian(mean, x)
    return lateral(mean, x), np.sqrt(np.einsum("ni,nij,nj->n", J, cov, J).clip(0))


def _reject_table(
    block: LineBlock, frames: FrameBlock | None, named: dict[str, tuple[str, ...]]
) -> Table:
    if frames is None:
        places = np.empty(0, int)
        columns: dict[str, Array] = {"t": np.empty(0), "t_ns": np.empty(0, np.int64)}
        columns |= {"channel": np.empty(0, np.uint16), "can_id": np.empty(0, np.uint32)}
    else:
        places = np.flatnonzero(~np.isin(block.reasons, _NOT_REJECTED))
        t_ns = frames.t_ns[places]
        columns = {"t": np.where(frames.has_time[places], t_ns / 1e9, np.nan), "t_ns": t_ns}
        columns |= {"channel": frames.channel[places], "can_id": frames.can_id[places]}
    columns["frame"] = places + block.first_frame
    columns["reason"] = block.reasons[places]
    reasons = {"reason": tuple(reason.name for reason in REASONS)}
    return Table(columns, named | reasons, {"t": "s", "t_ns": "ns"})


def _scene_table(block: LineBlock, xs: Sequence[float], named: dict[str, tuple[str, ...]]) -> Table:
    rows = block.scenes
    columns: dict[str, Array] = {"t": rows["t_ns"] / 1e9, "t_ns": rows["t_ns"]}
    columns["channel"] = block.scene_channel
    columns["state"] = _STATE_PLACES[rows["state"]]
    columns |= {name: rows[name] for name in ("usable", "two_senders", "counter")}
    columns |= {"lines": rows["count"], "age": rows["age"]}
    columns["correlation_time"] = rows["correlation_time"]
    left_out = {left_out_column(slot): slot for slot in Slot if block.has_left_out}
    columns |= {name: rows["left_out"][:, slot] for name, slot in left_out.items()}
    lane = _lane(rows)
    for x in xs:
        estimates = [_combined(lane, weights, x) for weights in ((1.0, -1.0), (0.5, 0.5))]
        for name, (value, sigma) in zip(("width", "centre"), estimates, strict=True):
            columns[f"{name}{x:g}"], columns[f"sigma_{name}{x:g}"] = value, sigma
    units = _units(columns) | {"correlation_time": "s"}
    categories = {"state": _CATEGORIES["state"]} | dict.fromkeys(left_out, LEFT_OUT_NAMES)
    return Table(columns, named | categories, units)


def left_out_column(slot: Slot) -> str:
    """Return the name of the column of scenes that says why they have no line of a slot.

    >>> left_out_column(Slot.EGO_LEFT)
    'left_out_ego_left'
    """
    return f"left_out_{slot.name.lower()}"


def _lane(rows: Array) -> tuple[Array, Array, Array, Array]:
    """Return the means (n, 2, 4), joint covariances (n, 8, 8) and range of both lines of the lane.

    A scene without one of them has nan.
    """
    n = len(rows)
    mean, cov = np.full((n, 2, 4), np.nan), np.full((n, 8, 8), np.nan)
    x_min, x_max = np.full(n, np.nan), np.full(n, np.nan)
    is_there = np.arange(len(Slot)) < rows["count"][:, None]
    found = [is_there & (rows["slots"] == slot) for slot in LANE]
    has = found[0].any(1) & found[1].any(1)
    k = np.flatnonzero(has)
    place = np.stack([one.argmax(1) for one in found], axis=1)[k]  # (m, 2)
    entry = (4 * place[:, :, None] + np.arange(4)).reshape(-1, 8)
    mean[k] = rows["mean"][k[:, None], place]
    cov[k] = rows["cov"][k[:, None, None], entry[:, :, None], entry[:, None, :]]
    x_min[k] = rows["x_min"][k[:, None], place].max(1)
    x_max[k] = rows["x_max"][k[:, None], place].min(1)
    return mean, cov, x_min, x_max


def _combined(
    lane: tuple[Array, Array, Array, Array], weights: tuple[float, float], x: float
) -> tuple[Array, Array]:
    """Return the weighted sum of the positions of both lines at x, and its standard deviation."""
    mean, cov, x_min, x_max = lane
    value = sum(weight * lateral(mean[:, i], x) for i, weight in enumerate(weights))
    J = np.concatenate(
        [weight * lateral_jacobian(mean[:, i], x) for i, weight in enumerate(weights)], axis=1
    )
    sigma = np.sqrt(np.einsum("ni,nij,nj->n", J, cov, J).clip(0))
    is_in = are_within(x_min, x_max, x)
    return np.where(is_in, value, np.nan), np.where(is_in, sigma, np.nan)
