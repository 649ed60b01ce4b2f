"""Evaluation of lines from their points, which shares no code with the package.

z is the lateral position of a line at x, seen from a pose drawn from the Gaussian, less the mean
y(x), in units of the standard deviation of y(x).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

#: Standard deviations of the pose: along [m], across [m], heading [deg].
POSES = {"production": (0.1, 0.2, 0.2), "poor": (0.5, 1.0, 2.0)}
WINDOW = (-20.0, 80.0)
#: Where z is evaluated: x [m] for the range of the line.
PLACES: dict[str, Callable[[float, float], float]] = {
    "x_min": lambda x_min, _: x_min,
    "0": lambda *_: 0.0,
    "20": lambda *_: 20.0,
    "40": lambda *_: 40.0,
    "x_max": lambda _, x_max: x_max,
}
#: Fewer values at a place are too few to compare their share of |z| > 3 with its bound.
LEAST_VALUES = 4000
#: Lines of which the map has more within the window ahead of the car must not be refused [m].
AHEAD = 15.0
#: Points of the map farther away along the line are not used [m].
NEAR = 160.0


def seen_from(points: Array, poses: Array) -> Array:
    """Return (D, n, 2) points in the frames of (D, 3) poses; points are (n, 2) or (D, n, 2)."""
    c, d = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    R = np.array([[c, -d], [d, c]]).transpose(2, 0, 1)
    return np.asarray((points - poses[:, None, :2]) @ R)


def place_of(points: Array) -> tuple[int, Array]:
    """Return the step of (n, 2) points that is nearest to the origin, and arc lengths from there.

    The arc lengths are (n,), 0 at the place nearest to the origin [m].
    """
    begin, step = points[:-1], np.diff(points, axis=0)
    share = (-(begin * step).sum(1) / np.maximum((step * step).sum(1), 1e-18)).clip(0, 1)
    nearest = int(np.hypot(*(begin + share[:, None] * step).T).argmin())
    s = np.append(0.0, np.hypot(*step.T).cumsum())
    return nearest, s - s[nearest] - share[nearest] * (s[nearest + 1] - s[nearest])


def is_oncoming(local: Array) -> bool:
    """Return whether the direction of a line is against the x axis where the car is."""
    _, s = place_of(local)
    behind, ahead = np.interp([-1.0, 1.0], s, local[:, 0])
    return bool(ahead < behind)


def crossings(local: Array, s: Array, x: float) -> Array:
    """Return the (D,) lateral positions at x of (D, n, 2) lines, nearest along them to s = 0.

    They are NaN if a line does not cross x in its direction, or only farther along than a line
    that is followed can be: there it comes back, as in a hairpin, or another road begins.
    """
    u, v = np.moveaxis(local, -1, 0)
    crossed = (u[:, :-1] <= x) & (u[:, 1:] > x)
    du = np.diff(u, axis=1)
    share = (x - u[:, :-1]) / np.where(crossed, du, 1.0)
    along = np.where(crossed, np.abs(s[:-1] + share * np.diff(s)), np.inf)
    rows, i = np.arange(len(u)), along.argmin(axis=1)
    y = v[rows, i] + share[rows, i] * (v[rows, i + 1] - v[rows, i])
    return np.where(along[rows, i] <= 4 * abs(x) + 20, y, np.nan)


def turned(heading: float) -> Array:
    """Return the (3, 3) rotation of errors of a pose from the car's frame to that of the map."""
    c, d = np.cos(heading), np.sin(heading)
    return np.array([[c, -d, 0], [d, c, 0], [0, 0, 1]])


def beyond(values: list[Array]) -> float:
    """Return the share of |z| > 3; a line that does not cross x counts as such."""
    z = np.concatenate(values) if values else np.empty(0)
    return float((~(np.abs(z) <= 3)).mean()) if len(z) else 0.0


def rms(values: list[Array]) -> float | None:
    """Return the root mean square of z."""
    z = np.concatenate(values) if values else np.empty(0)
    return float(np.sqrt(np.nanmean(z**2))) if np.isfinite(z).any() else None


def quantiles(values: list[float]) -> list[float]:
    """Return the median and the 5 % quantile; empty without values."""
    return np.quantile(values, [0.5, 0.05]).tolist() if values else []
