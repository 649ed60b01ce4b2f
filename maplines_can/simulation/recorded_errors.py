"""Records of a drive: their covariances, checks, and the times that they cover."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.arrays import floats
from ..values.errors import DriveFileError
from ..values.linalg import MAX_COV, asymmetric, indefinite
from .drive_columns import COVARIANCE, chosen

#: Largest value of a record, such as a coordinate [m] or a time [s]; beyond it a double cannot
#: state a millimetre or a microsecond.
LARGEST = 1e10


def covered(
    times: NDArray[np.float64], t: NDArray[np.float64], max_gap: float
) -> NDArray[np.bool_]:
    """Return (...,) whether (...,) times are at or between records without a gap."""
    if not len(times):
        return np.zeros(t.shape, dtype=bool)
    after = times.searchsorted(t).clip(0, len(times) - 1)
    before = (times.searchsorted(t, side="right") - 1).clip(0)
    return (times[0] <= t) & (t <= times[-1]) & (times[after] - times[before] <= max_gap)


def linear(
    times: NDArray[np.float64], values: NDArray[np.float64], t: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return values at (...,) times between the first and the last of (n,) times.

    ``numpy.interp`` copies read-only arrays in each call, which takes 1 ms for an hour of records.

    >>> linear(np.array([0.0, 2.0]), np.array([1.0, 5.0]), np.array(0.5))
    np.float64(2.0)
    """
    before = (times.searchsorted(t, side="right") - 1).clip(0, max(len(times) - 2, 0))
    after = np.minimum(before + 1, len(times) - 1)
    share = (t - times[before]) / np.where(after > before, times[after] - times[before], 1.0)
    share = share.reshape(share.shape + (1,) * (values.ndim - 1))
    return values[before] + share * (values[after] - values[before])


def valid_series(
    series: tuple[ArrayLike, ArrayLike], name: str, factor: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return times and values in SI units, without values that are not finite or not later."""
    t, values = (floats(array, name) for array in series)
    if t.ndim != 1 or t.shape != values.shape:
        raise ValueError(f"{name} must have (n,) times and values, got {t.shape}, {values.shape}")
    finite = np.isfinite(t) & np.isfinite(values)
    t, values = t[finite], values[finite]
    later = np.append(True, t[1:] > np.maximum.accumulate(t)[:-1])[: len(t)]
    if not later.any():
        raise DriveFileError(f"signals: {name} has no value; check the log and the signal's name")
    return t[later], values[later] * factor


def covariances(
    table: Mapping[str, NDArray[np.float64]], heading: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Return the (n, 3, 3) covariances in the map frame; None if the table has none."""
    names = chosen(table, COVARIANCE)
    if not names:
        return None
    values = [table[name] for name in names]
    cov = np.zeros((len(heading), 3, 3))
    places = [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)]
    if len(names) == len(places):
        for (i, j), value in zip(places, values, strict=True):
            cov[:, i, j] = cov[:, j, i] = value
        return cov
    sigma = np.column_stack(values)
    cov[:, [0, 1, 2], [0, 1, 2]] = sigma * np.abs(sigma)  # a negative sigma is found as a variance
    if "sigma_along" in names:
        c, s, zero, one = np.cos(heading), np.sin(heading), 0 * heading, 1 + 0 * heading
        T_map_ego = np.moveaxis(np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]), -1, 0)
        cov = T_map_ego @ cov @ np.swapaxes(T_map_ego, 1, 2)
    return cov


def first_problem(
    t: NDArray[np.float64],
    pose: NDArray[np.float64],
    speed: NDArray[np.float64] | None,
    yaw_rate: NDArray[np.float64] | None,
    cov: NDArray[np.float64] | None,
) -> tuple[int, str] | None:
    """Return the first record with a wrong value and what is wrong; None if all are right."""
    n = len(t)
    motion = [values for values in (speed, yaw_rate) if values is not None]
    numbers = np.column_stack([t, pose, *motion])
    checks: list[tuple[Any, str]] = [
        (~(np.abs(numbers) <= LARGEST).all(axis=1), f"a value is beyond {LARGEST:g} or not finite"),
        (
            np.append(False, ~(np.diff(t) > 0)),
            "the time must be later than that of the record before; sort the records, and remove "
            "duplicates",
        ),
    ]
    if cov is not None:
        finite = np.asarray((np.abs(cov) <= MAX_COV).all(axis=(1, 2)))
        safe = np.where(finite[:, None, None], cov, np.eye(3))
        variance = np.diagonal(safe, axis1=1, axis2=2)
        zero = ((variance == 0)[:, :, None] & (safe != 0)).any(axis=(1, 2))
        bad = np.array(~finite | (variance < 0).any(axis=1) | zero | asymmetric(safe))
        bad |= indefinite(np.where(bad[:, None, None], np.eye(3), safe))
        checks.append(
            (
                bad,
                "the sigmas must be 0 or more and the covariance positive semidefinite; "
                "use nearest_covariance",
            )
        )
    wrong = [(int(bad.argmax()), text) for bad, text in checks if n and bad.any()]
    return min(wrong, default=None)
