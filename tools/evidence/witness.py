"""Lines as they are seen from poses, computed from their points without code of the package."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from maplines_can import MapError, Polyline

Array = NDArray[np.float64]

#: Standard deviations of the pose: along [m], across [m], heading [deg].
POSES = {"production": (0.1, 0.2, 0.2), "poor": (0.5, 1.0, 2.0)}
WINDOW = (-20.0, 80.0)
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


class Poses(NamedTuple):
    """Poses that are drawn about the mean pose of a car."""

    mean: Array  #: (3,)
    root: Array  #: (3, 3) square root of the covariance
    number: int  #: of poses in a draw
    rng: np.random.Generator

    @classmethod
    def about(cls, mean: Array, sigma: Any, number: int, rng: np.random.Generator) -> Poses:
        """Return poses with sigmas along [m], across [m] and of the heading [deg]."""
        c, d = np.cos(mean[2]), np.sin(mean[2])
        turned = np.array([[c, -d, 0], [d, c, 0], [0, 0, 1]])
        return cls(mean, turned * [sigma[0], sigma[1], np.radians(sigma[2])], number, rng)

    @property
    def cov(self) -> Array:
        """(3, 3) covariance of the poses."""
        return np.asarray(self.root @ self.root.T)

    def draw(self) -> Array:
        """Return a draw of (D, 3) poses."""
        return np.asarray(self.mean + self.rng.standard_normal((self.number, 3)) @ self.root.T)

    def see(self, points: Array) -> Array:
        """Return the (D, n, 2) points seen from a draw; points are (n, 2) or (D, n, 2)."""
        return seen_from(points, self.draw())


def near_points(points: Array, pose: Array) -> tuple[Array, Array]:
    """Return the (n, 2) points near a (3,) pose, and their (n,) arc lengths from there [m]."""
    _, s = place_of(seen_from(points, pose[None])[0])
    near = np.abs(s) <= NEAR + np.diff(s).max()
    return points[near], s[near]


def beside(points: Array, pose: Array) -> float:
    """Return the lateral position at the car of (n, 2) points; NaN if they do not pass it."""
    local = seen_from(points, pose[None])
    _, s = place_of(local[0])
    return float(crossings(local, s, 0.0)[0])


def erred(points: Array, pose: Array, error: MapError | None, draws: int, rng: Any) -> Array:
    """Return (draws, n, 2) points with errors of the map; (1, n, 2) without an error."""
    if error is None:
        return points[None]
    turn = error.heading_sigma * rng.standard_normal(draws)
    about_car = seen_from(points, np.column_stack([np.tile(pose[:2], (draws, 1)), turn]))
    common = error.offset_sigma * rng.standard_normal((draws, 1, 2))
    local = error.point_sigma * rng.standard_normal(about_car.shape)
    return np.asarray(about_car + pose[:2] + common + local)


class MapOfCar:
    """The lines as the map of a car has them: off the true ones by errors of their own.

    A point keeps its error, also in a line that begins or ends elsewhere.
    """

    def __init__(self, error: MapError | None, rng: np.random.Generator) -> None:
        self._error, self._rng = error, rng
        self._of_point: dict[tuple[float, float], tuple[Array, Array]] = {}
        self._moved: dict[Any, tuple[Polyline, Polyline]] = {}

    def __call__(self, slot: Any, line: Polyline) -> Polyline:
        """Return the line of the map for a true line."""
        if self._error is None:
            return line
        if slot not in self._moved or self._moved[slot][0] is not line:
            self._moved[slot] = line, self._with_errors(self._error, line)
        return self._moved[slot][1]

    def _with_errors(self, error: MapError, line: Polyline) -> Polyline:
        keys = [(round(x, 3), round(y, 3)) for x, y in line.points.tolist()]
        known = (self._of_point[key][0] for key in keys if key in self._of_point)
        offset = next(known, error.offset_sigma * self._rng.standard_normal(2))
        local = error.point_sigma * self._rng.standard_normal(line.points.shape)
        for key, own in zip(keys, local, strict=True):
            self._of_point.setdefault(key, (offset, own))
        errors = offset + np.array([self._of_point[key][1] for key in keys])
        return Polyline(line.points + errors, line.kind)


def turned(cov: Array, heading: float) -> Array:
    """Return a (3, 3) covariance in the ego frame, in the frame of the map."""
    c, s = np.cos(heading), np.sin(heading)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(R @ cov @ R.T)
