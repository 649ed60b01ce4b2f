"""Accuracy of received lines against the truth of a drive, and the requirements of the survey.

The survey is Liu, Wang and Zhang, High definition map for automated driving: overview and
analysis, Journal of Navigation 73, 2020; its tables 3, 5 and 6 list what map providers, EDMap and
others state or require. It takes the definitions of accuracy from EDMap (2004):

- absolute: largest deviation of a line from the true one;
- relative: the same after the line is aligned with the true one, here by a shift across and a
  rotation (least squares).

An accuracy is met if 95 % of the errors are within it.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.errors import DriveFileError
from ..values.line import MapLine, Slot, Status
from .truth import PLACES, Y_PLACES, Truth

Array = NDArray[np.float64]

#: Share of the errors that an accuracy contains.
QUANTILE = 0.95
#: Lines of less curvature have no relative error of the curvature [1/m].
MIN_CURVATURE = 1e-3
#: Fewest lateral positions of a line that is aligned.
MIN_ALIGNED = 3
#: Smaller times of a log are relative to its start [s].
MIN_ABSOLUTE = 1e8
#: Mean of the time by which the age of a line is rounded up [s].
AGE_ROUNDING = 0.004
#: A line is of a cycle if its pose is at most this many cycles from it.
MAX_CYCLES = 1.0


class AccuracyRequirement(NamedTuple):
    """An accuracy that the survey lists."""

    quantity: str  #: key of ``Accuracy.errors``
    limit: float  #: [m], [deg] or [%]
    source: str


REQUIREMENTS = (
    AccuracyRequirement("lateral", 0.10, "table 6, lane boundary geometry, 10 cm"),
    AccuracyRequirement("lateral", 0.20, "table 6, lane boundary geometry, 20 cm"),
    AccuracyRequirement("heading", 0.05, "table 6, heading, 0.05 deg"),
    AccuracyRequirement("curvature", 1.0, "table 5, EDMap and NextMap, 1 %"),
    AccuracyRequirement("curvature", 2.0, "table 5, Kotei, 2 %"),
    AccuracyRequirement("absolute", 0.10, "table 3, Sanborn, 10 cm"),
    AccuracyRequirement("absolute", 0.15, "table 3, and.com, 15 cm"),
    AccuracyRequirement("absolute", 1.00, "table 3, TomTom lane model, 100 cm"),
    AccuracyRequirement("relative", 0.05, "table 3, and.com, 5 cm"),
    AccuracyRequirement("relative", 0.15, "table 3, TomTom lane model, 15 cm"),
    AccuracyRequirement("relative", 0.20, "table 3, HERE, Baidu and NavInfo, 20 cm"),
)


#: Least sigma of the map's part [m]; it is known no better from what the truth has.
MIN_SIGMA = 0.01


class MapPart(NamedTuple):
    """Part of the lateral errors that the pose does not explain; each (n, 4) at ``PLACES`` [m]."""

    error: Array
    sigma: Array  #: standard deviation that is stated for it
    pose_sigma: Array  #: that of the part of the pose


@dataclass(frozen=True, eq=False)
class Accuracy:
    """Errors of the received lines of a drive.

    Args:
        errors: by quantity; "lateral" [m], "heading" [deg] and "curvature" [% of the true one] are
            (n, 4) at ``PLACES``, "absolute" and "relative" (n, 1) [m]. NaN where there is none.
        slot: (n,) slot of each line.
        time: (n,) time of its pose [s].
        sigmas: (n, 4) lateral error in standard deviations of the line.
        received: lines that were received.
        without_values: of these, lines that are too old or out of range.
        unknown: of these, lines of a time or a slot for which the truth has no line.
        other_lane: of these, lines of cycles in which the car was on another lane than it believed.
        saturated: lines compared that are wider than necessary, because a value reached the end of
            its range in the message.
        of_map: part of the lateral errors that the pose does not explain.
    """

    errors: Mapping[str, Array]
    slot: NDArray[np.int_]
    time: Array
    sigmas: Array
    received: int
    without_values: int
    unknown: int
    other_lane: int
    saturated: int
    of_map: MapPart

    @property
    def lines(self) -> int:
        """Number of lines that were compared."""
        return len(self.slot)

    def figures(self, quantity: str, place: int) -> dict[str, float | int]:
        """Return the number of errors at a place, and their rms, 95 % quantile and maximum.

        ``place`` is an index into ``PLACES``; 0 for "absolute" and "relative".
        """
        error = self.errors[quantity][:, place]
        error = np.abs(error[np.isfinite(error)])
        if not len(error):
            return {"n": 0}
        return {
            "n": len(error),
            "rms": float(np.sqrt(np.mean(error**2))),
            "95 %": float(np.quantile(error, QUANTILE)),
            "max": float(error.max()),
        }

    def as_dict(self) -> dict[str, Any]:
        """Return all figures, for JSON."""
        counts = {name: getattr(self, name) for name in ("received", "without_values", "unknown")}
        counts |= {name: getattr(self, name) for name in ("lines", "other_lane", "saturated")}
        sigmas = [values[np.isfinite(values)] for values in self.sigmas.T]
        return counts | {
            "errors": {
                quantity: {
                    str(x): self.figures(quantity, i)
                    for i, x in enumerate(PLACES if error.shape[1] > 1 else ("line",))
                }
                for quantity, error in self.errors.items()
            },
            "beyond 3 sigma": {
                str(x): float((np.abs(values) > 3).mean()) if len(values) else None
                for x, values in zip(PLACES, sigmas, strict=True)
            },
            "requirements": [
                requirement._asdict() | {"met": self.met(requirement)}
                for requirement in REQUIREMENTS
            ],
        }

    def met(self, requirement: AccuracyRequirement) -> dict[str, bool | None]:
        """Return whether a requirement is met, by place; None without errors there."""
        columns = self.errors[requirement.quantity].shape[1]
        found = [self.figures(requirement.quantity, i) for i in range(columns)]
        names = map(str, PLACES) if columns > 1 else ["line"]
        return {
            name: one["95 %"] <= requirement.limit if one["n"] else None
            for name, one in zip(names, found, strict=True)
        }


def accuracy_of(truth: Truth, lines: Iterable[MapLine]) -> Accuracy:
    """Return the accuracy of received lines.

    A line is compared with the truth of the cycle whose pose it has, which is the time at which it
    was received less its age. Only what is within its range is compared.

    Args:
        truth: of the drive.
        lines: as received, with reception times on the clock of the truth, or from the start of
            the drive on.

    Raises:
        DriveFileError: no line is of the time of the truth.
    """
    received = without_values = 0
    values: list[tuple[float, ...]] = []
    saturated: list[bool] = []
    for line in lines:
        received += 1
        if not line.is_usable or line.t_ns is None:
            without_values += 1
            continue
        t = 1e-9 * line.t_ns - line.age + AGE_ROUNDING
        places = [float(line.y_sigma(x)) for x in PLACES]
        values.append((t, line.slot, line.x_min, line.x_max, *line.gaussian.mean, *places))
        saturated.append(line.status is Status.SATURATED)
    table = np.array(values).reshape(-1, 8 + len(PLACES))
    rows, is_timed = _rows(truth, table[:, 0])
    same = truth.same_lane[rows] & is_timed
    if len(table) and not is_timed.any():
        first, last = truth.time[[0, -1]]
        raise DriveFileError(
            f"the log has no lines of the time of the truth, {first:.3f} to {last:.3f} s, but from "
            f"{table[:, 0].min():.3f} to {table[:, 0].max():.3f} s; give the truth and the log of "
            "the same drive"
        )
    true = np.full((len(table), 9 + 2 * len(PLACES)), np.nan)
    for slot, of_slot in truth.lines.items():
        chosen = (table[:, 1] == slot) & same
        true[chosen] = of_slot[rows[chosen]]
    known = np.isfinite(true[:, : len(Y_PLACES)]).any(axis=1)
    errors, sigmas = _errors(table[known], true[known])
    return Accuracy(
        errors,
        table[known, 1].astype(int),
        truth.time[rows[known]],
        sigmas,
        received,
        without_values,
        int((~known & (same | ~is_timed)).sum()),
        int((is_timed & ~truth.same_lane[rows]).sum()),
        int(np.array(saturated, dtype=bool)[known].sum()),
        _map_part(errors["lateral"], table[known, 8:], true[known], truth, rows[known]),
    )


def _map_part(
    lateral: Array, sigma: Array, true: Array, truth: Truth, rows: NDArray[np.intp]
) -> MapPart:
    """Return the part of (n, 4) lateral errors that the pose errors do not explain.

    From a pose at (dx, dy), turned by dh, the line y(x) is y(x + u) - dy - x dh at x, with
    u = dx - y dh; y(x + u) up to the second order. ``sigma`` is that of the lines, (n, 4).
    """
    x = np.array(PLACES, dtype=float)
    y = true[:, [Y_PLACES.index(place) for place in PLACES]]
    heading, curvature = np.split(true[:, len(Y_PLACES) :], 2, axis=1)
    slope = np.tan(heading)
    dx, dy, dh = (column[:, None] for column in truth.pose_errors[rows].T)
    along = dx - (y - dy) * dh
    bend = curvature * np.hypot(1, slope) ** 3
    of_pose = slope * along + bend * along**2 / 2 - dy - (x - dx) * dh
    J = np.stack([slope, np.full_like(y, -1.0), -(x + slope * y)], axis=-1)  # (n, 4, 3)
    variance = np.einsum("nki,nij,nkj->nk", J, truth.pose_covs[rows], J)
    return MapPart(
        lateral - of_pose,
        np.sqrt(np.maximum(sigma**2 - variance, MIN_SIGMA**2)),
        np.sqrt(np.maximum(variance, 0.0)),
    )


def _rows(truth: Truth, t: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the row of the truth nearest to (n,) times, and whether it is of that time."""
    time = truth.time
    if len(t) and t.min() < MIN_ABSOLUTE <= time[0]:
        t = t + time[0]  # the log has relative times
    after = time.searchsorted(t).clip(1, max(len(time) - 1, 1)).clip(max=len(time) - 1)
    before = (after - 1).clip(0)
    rows = np.where(t - time[before] <= time[after] - t, before, after)
    period = float(np.median(np.diff(time))) if len(time) > 1 else 1.0
    return rows, np.abs(time[rows] - t) <= MAX_CYCLES * period


def _errors(table: Array, true: Array) -> tuple[dict[str, Array], Array]:
    """Return the errors by quantity, and the lateral errors in standard deviations.

    Args:
        table: (n, 12) time, slot, range, parameters, and standard deviations at ``PLACES``.
        true: (n, 17) as of ``true_lines``.
    """
    low, high, y_off, beta, c0, c1 = (column[:, None] for column in table[:, 2:8].T)

    def within(x: Array) -> NDArray[np.bool_]:
        return (low <= x) & (x <= high)

    all_x = np.array(Y_PLACES, dtype=float)
    y = y_off + all_x * (np.tan(beta) + all_x * (c0 / 2 + all_x * c1 / 6))
    deviation = np.where(within(all_x), y - true[:, : len(all_x)], np.nan)
    x = np.array(PLACES, dtype=float)
    at = [Y_PLACES.index(place) for place in PLACES]
    heading, curvature = np.split(true[:, len(all_x) :], 2, axis=1)
    slope = np.tan(beta) + x * (c0 + x * c1 / 2)
    bend = (c0 + x * c1) / np.hypot(1, slope) ** 3
    curved = within(x) & (np.abs(curvature) >= MIN_CURVATURE)
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = {
            "lateral": deviation[:, at],
            "heading": np.where(within(x), np.degrees(np.arctan(slope) - heading), np.nan),
            "curvature": np.where(curved, 100 * (bend - curvature) / np.abs(curvature), np.nan),
            "absolute": _largest(deviation),
            "relative": _largest(_aligned(all_x, deviation)),
        }
        return errors, deviation[:, at] / table[:, 8:]


def _aligned(x: Array, deviation: Array) -> Array:
    """Return (n, k) deviations less a shift and a rotation; NaN with fewer than 3 of them."""
    known = np.isfinite(deviation)
    weight = known / np.maximum(known.sum(axis=1, keepdims=True), 1)
    d = np.where(known, deviation, 0.0)
    from_middle = x - (weight * x).sum(axis=1, keepdims=True)
    shift = (weight * d).sum(axis=1, keepdims=True)
    spread = np.maximum((weight * from_middle**2).sum(axis=1, keepdims=True), 1e-12)
    turn = (weight * from_middle * d).sum(axis=1, keepdims=True) / spread
    enough = known.sum(axis=1, keepdims=True) >= MIN_ALIGNED
    return np.where(known & enough, deviation - shift - turn * from_middle, np.nan)


def _largest(deviation: Array) -> Array:
    """Return the (n, 1) largest absolute deviations of each line; NaN without any."""
    largest = np.abs(np.nan_to_num(deviation)).max(axis=1, initial=0.0)
    return np.where(np.isfinite(deviation).any(axis=1), largest, np.nan)[:, None]


def slots_of(accuracy: Accuracy) -> list[Slot]:
    """Return the slots of the lines that were compared."""
    return [Slot(value) for value in np.unique(accuracy.slot).tolist()]
