"""The truth of a drive as a table: poses, and the true lines as seen from the true pose.

A row for each cycle, as CSV or Parquet, with SI units:

- ``time``: on the clock of the bus log; ``drive_time``: from the start of the drive;
- ``x``, ``y``, ``heading``, ``speed``, ``yaw_rate``: true pose in the map frame, and true motion;
- ``stated_x``, ``stated_y``, ``stated_heading``, ``stated_cov_xx`` to ``stated_cov_hh``: the pose
  that the car knows, and its covariance; empty if it does not know its pose;
- ``lane``, ``stated_lane``: where the car is, and where it believes to be; empty off the map;
- ``lane_changed``: 1 in the cycle in which all slots become those of another lane;
- for each slot, such as ``ego_left``: ``ego_left_y_0`` to ``ego_left_y_80``, the lateral position
  of the line 0, 10 to 80 m ahead of the true pose, and its ``heading`` and ``curvature`` at 0, 20,
  40 and 80 m; empty where the line is not.

Heading and curvature are those of a cubic fitted to 8 m of the line on either side.
"""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..propagation.paths import stretches
from ..values.errors import DriveFileError
from ..values.input_files import checked_path, lines_of
from ..values.line import Slot
from ..values.output_files import writing
from ..values.polyline import Polyline
from .parquet_files import arrow, parquet_batches

Array = NDArray[np.float64]

#: Where the lateral position of the lines is stated, and where also heading and curvature [m].
Y_PLACES = tuple(range(0, 81, 10))
PLACES = (0, 20, 40, 80)
#: A cubic is fitted to this length on either side of a place [m].
HALF = 8
_GRID = np.arange(Y_PLACES[0] - HALF, Y_PLACES[-1] + HALF + 1.0)
#: (2, n) first and second derivative of the cubic by the n lateral positions.
_DERIVATIVES = np.linalg.pinv(np.vander(np.arange(-HALF, HALF + 1.0), 4))[[2, 1]] * [[1], [2]]

SUFFIXES = (".csv", ".parquet")
_TEXT = frozenset({"lane", "stated_lane"})
_CYCLE = (
    *("time", "drive_time", "x", "y", "heading", "speed", "yaw_rate"),
    *("stated_x", "stated_y", "stated_heading"),
    *(f"stated_cov_{pair}" for pair in ("xx", "xy", "yy", "xh", "yh", "hh")),
    *("lane", "stated_lane", "lane_changed"),
)
_OF_LINE = (
    *(f"y_{x}" for x in Y_PLACES),
    *(f"heading_{x}" for x in PLACES),
    *(f"curvature_{x}" for x in PLACES),
)
#: Most values of a table: two hours at 20 Hz with eight slots have 21 million.
MAX_VALUES = 24_000_000
#: Rows of a Parquet file that are read at a time.
BATCH = 10_000
#: Larger numbers, such as times and northings, have more digits in a CSV file.
LARGE = 1e6
#: Rows that are written at a time.
ROWS = 1000


def columns(slots: Sequence[Slot]) -> list[str]:
    """Return the names of the columns for these slots."""
    return [*_CYCLE, *(f"{slot.name.lower()}_{name}" for slot in slots for name in _OF_LINE)]


def true_lines(lines: Mapping[Slot, Polyline], slots: Sequence[Slot], pose: Array) -> Array:
    """Return the (S, 17) true values of the lines of these slots, NaN where a line is not.

    These are the lateral positions at ``Y_PLACES`` [m], and headings [rad] and curvatures [1/m] at
    ``PLACES``, as seen from the true pose.

    >>> road = {Slot.EGO_LEFT: Polyline([[-50, 2], [150, 2]])}
    >>> true_lines(road, [Slot.EGO_LEFT], np.zeros(3))[0, :3]
    array([2., 2., 2.])
    """
    values = np.full((len(slots), len(_OF_LINE)), np.nan)
    rows = [i for i, slot in enumerate(slots) if slot in lines]
    if not rows:
        return values
    seen = stretches([lines[slots[i]] for i in rows], pose, (_GRID[0], _GRID[-1]))
    if not seen:
        return values
    low, high = np.array([stretch.x_range for stretch in seen]).T[:, :, None]
    y = np.array([stretch.lateral(_GRID) for stretch in seen])
    y[(low > _GRID + 1e-9) | (high < _GRID - 1e-9)] = np.nan
    around = np.stack([y[:, x : x + 2 * HALF + 1] for x in PLACES], axis=1)  # (L, 4, n)
    slope, bend = np.moveaxis(around @ _DERIVATIVES.T, -1, 0)
    shape = [y[:, HALF::10][:, : len(Y_PLACES)], np.arctan(slope), bend / np.hypot(1, slope) ** 3]
    values[[rows[stretch.line] for stretch in seen]] = np.concatenate(shape, axis=1)
    return values


class TruthWriter:
    """Table of the truth, written row by row; the suffix is the format.

    Args:
        path: of the file, ``.csv`` or ``.parquet``.
        slots: of the lines.

    Raises:
        DriveFileError: the suffix is another one, or the file cannot be written.
        MissingExtraError: Parquet without pyarrow.
    """

    def __init__(self, path: str | PathLike[str], slots: Sequence[Slot]) -> None:
        self._path = path = checked_path(path, DriveFileError)
        self._names = columns(slots)
        self._rows: list[list[Any]] = []
        self._parquet: Any = None
        self._file: Any = None
        if _suffix(path) == ".parquet":
            pa = arrow()
            kinds = [pa.string() if name in _TEXT else pa.float64() for name in self._names]
            self._schema = pa.schema(list(zip(self._names, kinds, strict=True)))
        try:
            self._file = path.open("wb" if _suffix(path) == ".parquet" else "w", newline=None)
        except OSError as error:
            raise DriveFileError(f"{path}: cannot be written: {error.strerror or error}") from error
        if _suffix(path) == ".parquet":
            self._parquet = arrow().parquet.ParquetWriter(self._file, self._schema)
        else:
            csv.writer(self._file, lineterminator="\n").writerow(self._names)

    def write(self, cycle: Sequence[Any], lines: Array) -> None:
        """Write a row: the values of the cycle in the order of the columns, and ``true_lines``."""
        self._rows.append([*cycle, *lines.ravel().tolist()])
        if len(self._rows) == ROWS:
            with self._writing():
                self._flush()

    def close(self) -> None:
        """Write the rest and close the file; any number of times."""
        if self._file.closed:
            return
        with self._writing():
            self._flush()
            if self._parquet is not None:
                self._parquet.close()
            self._file.close()

    def _writing(self) -> AbstractContextManager[None]:
        return writing(self._path, DriveFileError, self._file.close)

    def __enter__(self) -> TruthWriter:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _flush(self) -> None:
        rows, self._rows = self._rows, []
        if self._parquet is None:
            cells = ([_cell(value) for value in row] for row in rows)
            csv.writer(self._file, lineterminator="\n").writerows(cells)
        elif rows:
            table = dict(zip(self._names, zip(*rows, strict=True), strict=True))
            self._parquet.write_table(arrow().Table.from_pydict(table, schema=self._schema))


def _cell(value: Any) -> Any:
    """Return a value as a CSV cell: micrometres also of large coordinates, NaN as empty."""
    if not isinstance(value, float):
        return value
    if math.isnan(value):
        return ""
    return f"{value:.16g}" if abs(value) > LARGE else f"{value:.12g}"


def _suffix(path: Path) -> str:
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise DriveFileError(
            f"{path}: the truth of a drive is a file of {' or '.join(SUFFIXES)}, not {suffix!r}"
        )
    return suffix


def truth_paths(log: str) -> tuple[Path, Path]:
    """Return where the truth beside a log is as Parquet, or else, without pyarrow, as CSV.

    >>> [path.name for path in truth_paths("drive.log.gz")]
    ['drive.truth.parquet', 'drive.truth.csv']
    """
    path = Path(log)
    if path.suffix.lower() == ".gz":
        path = path.with_suffix("")
    return path.with_suffix(".truth.parquet"), path.with_suffix(".truth.csv")


class Truth(NamedTuple):
    """The truth of a drive, read from a file."""

    time: Array  #: (n,) on the clock of the log [s]
    same_lane: NDArray[np.bool_]  #: (n,) whether the car is on the lane on which it believes to be
    lane_changes: int
    speed: Array  #: (n,) [m/s]
    lines: Mapping[Slot, Array]  #: (n, 17) by slot, as of ``true_lines``
    #: (n, 3) reported pose as seen from the true one [m, m, rad]; NaN without a reported pose.
    pose_errors: Array
    pose_covs: Array  #: (n, 3, 3) covariance of the reported pose, in the same frame


def read_truth(path: str | PathLike[str]) -> Truth:
    """Read a file of ``TruthWriter``.

    Raises:
        DriveFileError: the file cannot be read, or is no truth of a drive.
        MissingExtraError: Parquet without pyarrow.
    """
    path = checked_path(path, DriveFileError)
    table = _parquet_table(path) if _suffix(path) == ".parquet" else _csv_table(path)
    slots = [slot for slot in Slot if f"{slot.name.lower()}_{_OF_LINE[0]}" in table]
    missing = [name for name in columns(slots or [Slot.EGO_LEFT]) if name not in table]
    if missing:
        raise DriveFileError(
            f"{path}: has no column {missing[0]}; give the truth that 'maplines drive --record' "
            "writes"
        )
    numbers = {
        slot: np.column_stack([table[f"{slot.name.lower()}_{name}"] for name in _OF_LINE])
        for slot in slots
    }
    time = np.asarray(table["time"], dtype=float)
    if not len(time) or not (np.diff(time) > 0).all() or not np.isfinite(time).all():
        raise DriveFileError(f"{path}: the times must increase from row to row, of one row or more")
    same = np.array([a == b for a, b in zip(table["lane"], table["stated_lane"], strict=True)])
    changes = int(np.nansum(np.asarray(table["lane_changed"], dtype=float)))
    speed = np.asarray(table["speed"], dtype=float)
    return Truth(time, same, changes, speed, numbers, *_pose_errors(table))


def _pose_errors(table: Mapping[str, Any]) -> tuple[Array, Array]:
    """Return the errors of the reported poses and their covariances, as of ``Truth``."""
    names = ("x", "y", "heading")
    true = np.column_stack([np.asarray(table[name], dtype=float) for name in names])
    stated = np.column_stack([np.asarray(table[f"stated_{name}"], dtype=float) for name in names])
    xx, xy, yy, xh, yh, hh = (
        np.asarray(table[f"stated_cov_{pair}"], dtype=float)
        for pair in ("xx", "xy", "yy", "xh", "yh", "hh")
    )
    cov = np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]]).transpose(2, 0, 1)
    to_car = np.zeros_like(cov)
    c, s = np.cos(true[:, 2]), np.sin(true[:, 2])
    to_car[:, 0, 0], to_car[:, 0, 1], to_car[:, 1, 0], to_car[:, 1, 1] = c, s, -s, c
    to_car[:, 2, 2] = 1.0
    error = stated - true
    error[:, 2] = (error[:, 2] + math.pi) % (2 * math.pi) - math.pi
    return np.einsum("nij,nj->ni", to_car, error), to_car @ cov @ to_car.transpose(0, 2, 1)


def _parquet_table(path: Path) -> dict[str, Any]:
    def choose(names: list[str]) -> list[str]:
        return [name for name in names if name in known]

    known = {*columns([*Slot])}
    parts: dict[str, list[Any]] = {}
    values = 0
    for batch in parquet_batches(path, choose, BATCH, DriveFileError):
        for name, part in batch.items():
            is_text = name in _TEXT
            parts.setdefault(name, []).extend(part if is_text else [_numbers(path, name, part)])
            values += len(part)
        _check_values(path, values)
    return {n: part if n in _TEXT else np.concatenate(part) for n, part in parts.items()}


def _csv_table(path: Path) -> dict[str, Any]:
    numbers, texts = array("d"), {name: list[str]() for name in _TEXT}
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(lines_of(file, str(path), DriveFileError))
            names = next(reader, [])
            places = [i for i, name in enumerate(names) if name not in _TEXT]
            for row in reader:
                if len(row) != len(names):
                    raise DriveFileError(
                        f"{path}: line {reader.line_num} has not {len(names)} values, as the "
                        "header has"
                    )
                for name in _TEXT.intersection(names):
                    texts[name].append(row[names.index(name)])
                for i in places:
                    numbers.append(_number(path, names[i], row[i]))
                _check_values(path, len(numbers))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DriveFileError(f"{path}: cannot be read: {error}") from error
    found = np.array(numbers).reshape(-1, max(len(places), 1)).T
    return dict(zip((names[i] for i in places), found, strict=False)) | {
        name: texts[name] for name in names if name in _TEXT
    }


def _check_values(path: Path, values: int) -> None:
    """Raise ``DriveFileError`` if a table has too many values."""
    if values > MAX_VALUES:
        raise DriveFileError(f"{path}: has more than {MAX_VALUES} values; divide it into several")


def _numbers(path: Path, name: str, values: Sequence[Any]) -> Array:
    """Return a column as numbers, an empty cell as NaN."""
    return np.array([_number(path, name, value) for value in values])


def _number(path: Path, name: str, value: Any) -> float:
    """Return a cell as a number, an empty one as NaN."""
    try:
        return math.nan if value in ("", None) else float(value)
    except (TypeError, ValueError) as error:
        raise DriveFileError(f"{path}: column {name}: {error}") from error
