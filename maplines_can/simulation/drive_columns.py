"""Columns of a recorded drive: their names and units, and the reader of CSV files."""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Iterable, Mapping, Sequence
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from ..values.errors import DriveFileError
from ..values.input_files import DELIMITERS, checked_path, lines_of

_METRES, _RADIANS = {"": 1.0}, {"": 1.0, "_deg": math.radians(1.0)}
#: Units of each quantity by the suffix of its column, as factors to the SI unit; latitude and
#: longitude stay in degrees.
_UNITS = {
    "time": {"": 1.0, "_ms": 1e-3, "_us": 1e-6, "_ns": 1e-9},
    "x": _METRES,
    "y": _METRES,
    "lat": {"_deg": 1.0},
    "lon": {"_deg": 1.0},
    "heading": _RADIANS,
    "bearing": _RADIANS,
    "speed": {"": 1.0, "_kmh": 1 / 3.6, "_mph": 0.44704},
    "yaw_rate": {"": 1.0, "_deg_s": math.radians(1.0)},
    "sigma_x": _METRES,
    "sigma_y": _METRES,
    "sigma_along": _METRES,
    "sigma_across": _METRES,
    "sigma_heading": _RADIANS,
    **{f"cov_{pair}": {"": 1.0} for pair in ("xx", "xy", "yy", "xh", "yh", "hh")},
}
#: Quantity and factor of each column name.
COLUMNS = {
    quantity + suffix: (quantity, factor)
    for quantity, units in _UNITS.items()
    for suffix, factor in units.items()
}
POSITION = (("x", "y"), ("lat", "lon"))
HEADING = (("heading",), ("bearing",))
COVARIANCE = (
    ("sigma_x", "sigma_y", "sigma_heading"),
    ("sigma_along", "sigma_across", "sigma_heading"),
    ("cov_xx", "cov_xy", "cov_yy", "cov_xh", "cov_yh", "cov_hh"),
)
#: Most values of a drive: an hour at 100 Hz with all columns has 5 million.
MAX_VALUES = 10_000_000


def quantities(names: Sequence[str], source: str) -> dict[str, tuple[str, float]]:
    """Return column and factor by quantity, for the column names of a recorded drive.

    Unknown columns are left out.

    Raises:
        DriveFileError: a quantity has two columns, or a necessary one has none.

    >>> quantities(["time", "x", "y", "heading_deg", "note"], "drive.csv")["heading"]
    ('heading_deg', 0.017453292519943295)
    """
    found: dict[str, tuple[str, float]] = {}
    for name in names:
        if name not in COLUMNS:
            continue
        quantity, factor = COLUMNS[name]
        if quantity in found:
            raise DriveFileError(
                f"{source}: has two columns for {quantity}, {found[quantity][0]} and {name}; "
                "remove one of them"
            )
        found[quantity] = name, factor
    unknown = ", ".join(name for name in names if name not in COLUMNS) or "none"
    if "time" not in found:
        raise DriveFileError(
            f"{source}: the header has no column {_text(('time',))} (unknown columns: {unknown})"
        )
    for group, needed in ((POSITION, True), (HEADING, True), (COVARIANCE, False)):
        present = [choice for choice in group if found.keys() >= set(choice)]
        part = sorted({q for choice in group for q in choice} & found.keys())
        if len(present) > 1 or (len(present) == 1 and len(part) > len(present[0])):
            raise DriveFileError(
                f"{source}: has too many of the columns {', '.join(part)}; keep one of the sets: "
                + "; or ".join(_text(choice) for choice in group)
            )
        if not present and (needed or part):
            raise DriveFileError(
                f"{source}: the header must have the columns "
                + "; or ".join(_text(choice) for choice in group)
                + f" (unknown columns: {unknown})"
            )
    return found


def chosen(found: Mapping[str, object], group: Sequence[tuple[str, ...]]) -> tuple[str, ...]:
    """Return the set of a group that is present; empty if none is."""
    return next((choice for choice in group if found.keys() >= set(choice)), ())


def _text(choice: Sequence[str]) -> str:
    """Return the column names of a set, with all units."""
    return ", ".join(
        " or ".join(quantity + suffix for suffix in _UNITS[quantity]) for quantity in choice
    )


def read_csv(
    path: str | PathLike[str],
) -> tuple[dict[str, NDArray[np.float64]], Sequence[int], int]:
    """Return the quantities of a CSV file by name, the line of each row, and the skipped rows.

    A row with an empty or non-finite value in a known column is skipped. Empty lines, and lines
    that begin with #, are ignored.

    Raises:
        DriveFileError: the file cannot be read, lacks a column, or has a value that is no number.
    """
    source = checked_path(path, DriveFileError)
    try:
        with source.open(encoding="utf-8-sig", newline="") as file:
            return _read_rows(lines_of(file, str(source), DriveFileError), str(source))
    except OSError as error:
        raise DriveFileError(f"{source}: cannot be read: {error.strerror or error}") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise DriveFileError(f"{source}: is not a CSV file: {error}") from error


def _read_rows(
    file: Iterable[str], source: str
) -> tuple[dict[str, NDArray[np.float64]], Sequence[int], int]:
    numbered = (
        (number, line)
        for number, line in enumerate(file, start=1)
        if line.strip() and not line.startswith("#")
    )
    _, header = next(numbered, (0, ""))
    delimiter = max(DELIMITERS, key=header.count)
    names = [name.strip() for name in next(csv.reader([header], delimiter=delimiter), [])]
    found = quantities(names, source)
    places = [names.index(column) for column, _ in found.values()]
    rows, lines, skipped = array("d"), array("q"), 0
    for number, line in numbered:
        cells = next(csv.reader([line], delimiter=delimiter))
        if len(cells) != len(names):
            raise DriveFileError(
                f"{source}: line {number}: has {len(cells)} values, but the header has "
                f"{len(names)} columns; correct the line"
            )
        try:
            row = [float(cells[i]) for i in places]
        except ValueError:
            where = f"{source}: line {number}: column"
            row = [_number(cells[i], f"{where} {names[i]}") for i in places]
        if all(map(math.isfinite, row)):
            rows.extend(row)
            lines.append(number)
            if len(rows) > MAX_VALUES:
                raise DriveFileError(
                    f"{source}: has more than {MAX_VALUES} values in its columns of a drive; "
                    "divide it into several"
                )
        else:
            skipped += 1
    table = np.array(rows).reshape(-1, len(found)) * [factor for _, factor in found.values()]
    return dict(zip(found, table.T, strict=True)), lines, skipped


def _number(cell: str, where: str) -> float:
    """Return the number in a cell; NaN if it is empty."""
    try:
        return float(cell) if cell.strip() else math.nan
    except ValueError:
        raise DriveFileError(
            f"{where}: {cell[:40]!r} is not a number; correct it, or leave it empty to skip the row"
        ) from None
