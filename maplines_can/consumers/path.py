"""Path of the ego lane ahead, from received lines: offset, direction and curvature by distance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Chebyshev
from numpy.typing import NDArray

from ..values.gaussian import Gaussian
from ..values.line import MapLine, Slot, lateral, lateral_jacobian
from ..values.scene import MapError, Scene
from ..values.seen_lines import SeenLines, bases

#: Spacing of the points of a path along x [m].
SPACING = 0.25
#: Behind a corner, the valid ranges begin a little ahead of the car. If it is not more than this,
#: a line is used from ``BEHIND`` on, since its cubic is nearly exact so close to its range [m].
MAX_GAP = 4.0
BEHIND = -3.0
#: Largest product of curvature and distance to the line; at 1 the parallel line has a cusp.
MAX_BEND = 0.9
#: Rest of a line that is a cubic.
EXACT = Chebyshev([0.0])
#: Least lane width of a received scene, and the largest one [m]. Lanes through city junctions and
#: beside parking are up to 7.5 m wide. Of two lanes taken for one, the middle is 1.75 m beside that
#: of each, which the offset of the car shows.
WIDTHS = (2.0, 8.0)
#: What the covariance of a line has of the misfit in the variance of T_0, as c/propagation/misfit.c
#: makes it: this share of its square, and the square of this deviation [m].
LATERAL_SHARE, MIN_SIGMA = 0.2, 0.01


class Path(NamedTuple):
    """Path to follow, from the point beside the car on."""

    offset: float  #: of the car, positive if it is to the left of the path [m]
    heading: float  #: of the car relative to the path [rad]
    s: NDArray[np.float64]  #: (n,) distances along the path, increasing from 0 [m]
    curvature: NDArray[np.float64]  #: (n,) positive to the left [1/m]
    sigma: NDArray[np.float64]  #: (n,) standard deviations of the lateral position [m]

    @property
    def reach(self) -> float:
        """Distance up to which the path is known [m]."""
        return float(self.s[-1])

    def curvature_at(self, s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the curvature at distances; beyond the reach, that at its end."""
        return np.interp(s, self.s, self.curvature)

    def moved(self, distance: float, offset: float, heading: float) -> Path | None:
        """Return the path after the car has moved along it, with its new offset and heading.

        Returns None if the path ends there.
        """
        s = self.s - distance
        if not s[-1] > SPACING:
            return None
        ahead = s > 0
        keep = [np.interp(0.0, s, values) for values in (self.curvature, self.sigma)]
        return Path(
            offset,
            heading,
            np.append(0.0, s[ahead]),
            np.append(keep[0], self.curvature[ahead]),
            np.append(keep[1], self.sigma[ahead]),
        )


def path_beside(
    line: MapLine,
    distance: float,
    displacement: Gaussian,
    rest: Chebyshev = EXACT,
    specific_cov: NDArray[np.float64] | None = None,
) -> Path | None:
    """Return the path parallel to a line, as seen after a displacement of the car.

    The points of the line, its directions and its curvatures are those of the cubic and of what
    it leaves. They are moved to the new ego frame as they are, without another fit, so corners stay
    what they are.

    Args:
        line: a line that is usable.
        distance: of the path to the left of the line [m].
        displacement: the new pose in the ego frame of the line (x [m], y [m], heading [rad]).
        rest: what the cubic leaves of the line, in the range in which it was fitted [m]. It goes
            on straight beyond.
        specific_cov: (4, 4) part of the line-specific covariance that is due to what its cubic
            misses, and to errors of the points of the map. It makes the shape of the cubic
            uncertain, most of all at the ends of its range; but the variance of the lateral
            position is nowhere more than that of the coefficient of T_0 states, so more does not
            count. It needs ``rest``. None: all of the covariance counts.

    Returns:
        The path from the point that is nearest to the car; None if the car has passed its end,
        or is far before its begin.
        ``sigma`` has the covariances of the line and of the displacement.

    >>> line = MapLine(0, Gaussian([1.75, 0, 0, 0], np.diag([0.01, 0, 0, 0])), x_max=50.0)
    >>> path = path_beside(line, -1.75, Gaussian([2.0, 0.3, 0.01], np.zeros((3, 3))))
    >>> round(path.offset, 3), round(path.heading, 3), path.reach, path.sigma[0].round(3)
    (0.3, 0.01, 48.0, np.float64(0.1))
    """
    if line.x_min - displacement.mean[0] > MAX_GAP:
        return None
    low = min(line.x_min, BEHIND)
    x = np.linspace(low, line.x_max, max(2, round((line.x_max - low) / SPACING) + 1))
    _, beta, c0, c1 = line.gaussian.mean
    inside = x.clip(*rest.domain)
    rest_slope = rest.deriv()(inside)
    slope = np.tan(beta) + x * (c0 + x * c1 / 2) + rest_slope
    norm = np.hypot(1.0, slope)
    rest_bend = np.where(inside == x, rest.deriv(2)(inside), 0.0)
    bend = (c0 + c1 * x + rest_bend) / norm**3
    y = lateral(line.gaussian.mean, x) + rest(inside) + rest_slope * (x - inside)
    tangent = np.column_stack([1 / norm, slope / norm])
    normal = tangent[:, ::-1] * [-1.0, 1.0]
    points = np.column_stack([x, y]) + distance * normal
    bend = bend / (1 - (bend * distance).clip(max=MAX_BEND))
    # Lateral means across the path, and so does the displacement of the car.
    J = lateral_jacobian(line.gaussian.mean, x) / norm[:, None]
    variance = np.einsum("ki,ij,kj->k", J, line.gaussian.cov, J)
    if specific_cov is not None:
        to_t0 = np.linalg.inv(bases(line.gaussian.mean[None], rest.domain[None])[0])[0]
        least = MIN_SIGMA**2
        most = max(0.0, to_t0 @ specific_cov @ to_t0 - least) / LATERAL_SHARE + least
        variance -= (np.einsum("ki,ij,kj->k", J, specific_cov, J) - most / norm**2).clip(0)
    dx, dy, turn = displacement.mean
    arm = points - [dx, dy]
    J = np.column_stack([normal, (tangent * arm).sum(axis=1)])
    variance += np.einsum("ki,ij,kj->k", J, displacement.cov, J)

    chord = np.diff(points, axis=0)
    length = np.hypot(*chord.T)
    share = ((-arm[:-1] * chord).sum(axis=1) / np.maximum(length, 1e-9) ** 2).clip(0, 1)
    foot = arm[:-1] + share[:, None] * chord
    i = int((foot**2).sum(axis=1).argmin())
    if i == len(length) - 1 and share[i] >= 1:
        return None
    s = np.append(0.0, length.cumsum())
    s0 = s[i] + share[i] * length[i]
    heading = np.unwrap(np.arctan2(slope, 1.0))
    direction = np.interp(s0, s, heading)
    nx, ny = -np.sin(direction), np.cos(direction)
    offset = -(foot[i, 0] * nx + foot[i, 1] * ny)
    path = Path(0.0, 0.0, s, bend, np.sqrt(variance.clip(0)))
    turned = (turn - direction + np.pi) % (2 * np.pi) - np.pi
    return path.moved(float(s0), float(offset), float(turned))


def lane_path(
    scene: Scene,
    displacement: Gaussian,
    width: float | None = None,
    route: Slot | None = None,
) -> tuple[Path | None, float | None]:
    """Return the path in the middle of the ego lane, and the width of the lane.

    Each boundary gives the path at half the width beside it; of two, it is their mean. Where one
    of them ends, as the inner one does in a corner, the other one continues. A cubic may be 10 cm
    off its line; most of this is in the quartics of the scene, which are added to it.

    Args:
        scene: lines.
        displacement: of the car since the scene, see ``path_beside``.
        width: of the lane, if it is known from an earlier scene with both boundaries [m]. It counts
            where this one has not both at one place.
        route: slot of a line to follow itself, instead of the lane.

    Returns:
        The path, None if there is none; and the width, None if it is unknown.
    """
    given = scene.index

    def beside(slot: Slot, distance: float) -> Path | None:
        i = given[slot]
        rest = Chebyshev([0, 0, 0, 0, scene.quartics[i]], domain=scene.fit_ranges[i])
        specific_cov = None if scene.specific_covs is None else scene.specific_covs[i]
        if specific_cov is not None and scene.map_error is not None:
            specific_cov = specific_cov - _offset_and_heading(scene, i)
        return path_beside(scene.lines[i], distance, displacement, rest, specific_cov)

    if route is not None:
        return (beside(route, 0.0) if route in given else None), width
    ego = [slot for slot in (Slot.EGO_LEFT, Slot.EGO_RIGHT) if slot in given]
    if len(ego) == 2:
        here = width_of(scene)
        width = width if here is None else here
    if width is None or not WIDTHS[0] <= width <= WIDTHS[1]:
        return None, None
    sides = {Slot.EGO_LEFT: -width / 2, Slot.EGO_RIGHT: width / 2}
    paths = [beside(slot, sides[slot]) for slot in ego]
    return mean_path([path for path in paths if path is not None]), width


def _offset_and_heading(scene: Scene, i: int) -> NDArray[np.float64]:
    """Return the (4, 4) covariance of a line due to the offset and the heading of it on the map."""
    error = scene.map_error or MapError()
    line = slice(i, i + 1)
    seen = SeenLines(scene.means[line], scene.fit_ranges[line], scene.quartics[line])
    J = seen.jacobian()[0] * [error.offset_sigma, error.offset_sigma, error.heading_sigma]
    return np.asarray(J @ J.T)


def width_of(scene: Scene) -> float | None:
    """Return the width of the ego lane where both boundaries are seen, nearest to the car [m].

    It is None if their ranges have nothing in common.
    """
    low, high = scene.x_range((Slot.EGO_LEFT, Slot.EGO_RIGHT))
    if low > high:
        return None
    x = min(max(low, 0.0), high)
    across = float(scene.width(x).value)
    means = [scene.line(slot).gaussian.mean for slot in (Slot.EGO_LEFT, Slot.EGO_RIGHT)]
    slope = np.mean([np.tan(beta) + x * (c0 + x * c1 / 2) for _, beta, c0, c1 in means])
    return float(across / np.hypot(1.0, slope))


def mean_path(paths: Sequence[Path]) -> Path | None:
    """Return the mean of paths as functions of the distance; where one ends, of the others.

    The largest standard deviation is taken, as the errors of the lines are due to one pose.
    """
    if not paths:
        return None
    longest = max(paths, key=lambda path: path.reach)
    s = longest.s
    known = np.array([s <= path.reach + 1e-9 for path in paths])
    bends = np.array([path.curvature_at(s) for path in paths])
    sigmas = np.array([np.interp(s, path.s, path.sigma) for path in paths])
    return Path(
        float(np.mean([path.offset for path in paths])),
        float(np.mean([path.heading for path in paths])),
        s,
        (bends * known).sum(axis=0) / known.sum(axis=0),
        (sigmas * known).max(axis=0),
    )
