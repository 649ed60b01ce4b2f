"""Evaluation of lines from their points, which shares no code with the package.

z is the lateral position of a line at x, seen from a pose drawn from the Gaussian, less the mean
y(x), in units of the standard deviation of y(x).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

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
#: Bounds: largest share of |z| > 3, and largest share of refused lines.
BEYOND, REFUSED = 0.005, 0.02
#: Fewer values at a place are too few to compare their figures with the bounds.
MIN_VALUES = 4000
#: Headings of the columns that ``Tally.figures`` and ``cells`` give.
HEADINGS = (
    "".join(f"{'x = ' + name:>14}" for name in PLACES) + "  range  x_max",
    "  |z| > 3  rms" * len(PLACES) + f"{'m':>7}{'m':>7}",
)
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


class Tally:
    """Figures of the lines of a shape of road or of a map."""

    def __init__(self) -> None:
        self._z: dict[str, list[Array]] = {name: [] for name in PLACES}
        self._ranges: list[tuple[float, float]] = []
        self._outcomes = Counter[str]()
        self._ahead = self._refused = 0

    def count(self, local: Array, s: Array, outcome: str) -> None:
        """Count a line of (n, 2) points: "given", or the reason for which it is left out."""
        self._outcomes[outcome] += 1
        is_ahead = s[(s >= 0) & (np.hypot(*local.T) <= WINDOW[1])].max(initial=0.0) >= AHEAD
        self._ahead += is_ahead
        self._refused += is_ahead and outcome != "given"

    def evaluate(self, line: Any, points: Array, s: Array, see: Callable[[Array], Array]) -> None:
        """Evaluate a line at all places in its range; ``see`` is that of the poses."""
        self._ranges.append((line.x_min, line.x_max))
        near = np.abs(s) <= NEAR + np.diff(s).max()
        for name, place in PLACES.items():
            x = place(line.x_min, line.x_max)
            if line.x_min <= x <= line.x_max:
                y = crossings(see(points[near]), s[near], x)
                self._z[name].append((y - line.y(x)) / line.y_sigma(x))

    def figures(self) -> dict[str, Any]:
        """Return all figures by name."""
        return {
            "left out": dict(sorted(self._outcomes.items())),
            "refused": self._refused / max(self._ahead, 1),
            "beyond 3 sigma": {name: _beyond(values) for name, values in self._z.items()},
            "rms": {name: _rms(values) for name, values in self._z.items()},
            "values": {name: sum(map(len, values)) for name, values in self._z.items()},
            "range": quantiles([x_max - x_min for x_min, x_max in self._ranges]),
            "x_max": quantiles([x_max for _, x_max in self._ranges]),
        }


def missed(name: str, row: Any, rms: tuple[float, float] = (0.0, np.inf)) -> Iterator[str]:
    """Yield the bounds that figures miss; ``rms`` are those of the rms of z."""
    for place, n in row["values"].items():
        if n < MIN_VALUES:
            continue
        if row["beyond 3 sigma"][place] > BEYOND:
            yield f"{name}: {row['beyond 3 sigma'][place]:.2%} beyond 3 sigma at x = {place}"
        if not rms[0] <= row["rms"][place] <= rms[1]:
            yield f"{name}: rms of z is {row['rms'][place]:.2f} at x = {place}"
    if row["refused"] > REFUSED:
        yield f"{name}: {row['refused']:.1%} of the lines with 15 m ahead are refused"


def cells(row: Any) -> str:
    """Return figures as the columns of ``HEADINGS``."""
    at_places = "".join(
        f"{row['beyond 3 sigma'][place]:9.2%}{row['rms'][place] or np.nan:5.2f}"
        if row["values"][place]
        else f"{'-':>14}"
        for place in PLACES
    )
    return at_places + "".join(f"{(row[key] or [0])[0]:7.1f}" for key in ("range", "x_max"))


def quantiles(values: list[float]) -> list[float]:
    """Return the median and the 5 % quantile; empty without values."""
    return np.quantile(values, [0.5, 0.05]).tolist() if values else []


def _beyond(values: list[Array]) -> float:
    """Return the share of |z| > 3; a line that does not cross x counts as such."""
    z = np.concatenate(values) if values else np.empty(0)
    return float((~(np.abs(z) <= 3)).mean()) if len(z) else 0.0


def _rms(values: list[Array]) -> float | None:
    """Return the root mean square of z."""
    z = np.concatenate(values) if values else np.empty(0)
    return float(np.sqrt(np.nanmean(z**2))) if np.isfinite(z).any() else None
