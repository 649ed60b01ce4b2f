"""Gaussians of the lines of random roads.

The roads have the distributions of ``random_scenarios``, but other draws, and are drawn many at a
time.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..propagation import MapError, Refit, SigmaPoints
from ..propagation.paths import MAX_TURN
from ..propagation.refit import MAX_MISFIT
from ..values.errors import IllPosedError
from ..values.gaussian import Gaussian
from ..values.polyline import Polyline

Array = NDArray[np.float64]

#: Largest number of points of a road.
POINTS = 60
#: Window that contains each road as a whole [m].
WINDOW = (-1e3, 1e3)


class Roads(NamedTuple):
    """N roads of one line each, and the uncertainty of the car's pose at the origin."""

    points: Array  #: (N, POINTS, 2), in the frame of the mean pose [m]
    number: NDArray[np.int64]  #: (N,) number of valid points of each road
    sigma: Array  #: (N, 3) standard deviations of the pose [m, m, rad]
    correlation: Array  #: (N,) of e_x and e_y
    #: (N, 3) sigmas of the map: of each point [m], of the offset [m], of the heading [rad]; or None
    map_error: Array | None


def random_roads(n: int, rng: np.random.Generator, *, with_map_error: bool) -> Roads:
    """Draw n roads from motorway to street turn, as described at ``random_scenarios``.

    With map error, its sigmas are 2 to 20 cm for each point and for the common offset, and
    0.05 deg for the heading.
    """
    radius = 10 ** rng.uniform(np.log10(15.0), 4.5, n)
    sharpest = rng.choice([-1.0, 1.0], n) / radius
    ahead = np.minimum(rng.uniform(30.0, 100.0, n), np.radians(70.0) * radius)
    behind = np.minimum(rng.uniform(0.0, 20.0, n), ahead / 3)
    count = rng.integers(12, POINTS + 1, n)
    growth = rng.uniform(-1.0, 1.0, n)
    y_off, heading = rng.uniform(-6.0, 6.0, n), np.radians(rng.uniform(-6.0, 6.0, n))
    sigma = np.column_stack(
        [
            10 ** rng.uniform(np.log10(0.03), 0.0, (n, 2)),
            np.radians(10 ** rng.uniform(np.log10(0.05), 1.0, n)),
        ]
    )
    correlation = rng.uniform(-0.9, 0.9, n)
    map_error = None
    if with_map_error:
        both = 10 ** rng.uniform(np.log10(0.02), np.log10(0.2), (n, 2))
        map_error = np.column_stack([both, np.full(n, np.radians(0.05))])

    spacing = (ahead + behind) / (count - 1)
    s = spacing[:, None] * np.arange(POINTS) - behind[:, None]
    here, there = np.minimum(1, 1 - growth), np.minimum(1, 1 + growth)
    share = (s / ahead[:, None]).clip(0, 1)
    curvature = sharpest[:, None] * (here[:, None] + (there - here)[:, None] * share)
    points = _curves(y_off, heading, curvature, spacing, behind / spacing)
    return Roads(points, count, sigma, correlation, map_error)


def _curves(y_off: Array, heading: Array, curvature: Array, spacing: Array, place: Array) -> Array:
    """Return (N, P, 2) points as ``scenarios.curve`` does; ``place`` is the index of s = 0."""
    rows = np.arange(len(place))
    middle = (curvature[:, 1:] + curvature[:, :-1]) / 2 * spacing[:, None]  # turn of each step
    turn = np.zeros_like(curvature)
    middle.cumsum(axis=1, out=turn[:, 1:])
    chord = turn[:, :-1] + middle / 2
    points = np.zeros((*curvature.shape, 2))
    steps = spacing[:, None, None] * np.stack([np.cos(chord), np.sin(chord)], axis=-1)
    steps.cumsum(axis=1, out=points[:, 1:])
    first = place.astype(int)
    rest = place - first

    def at_zero(values: Array) -> Array:
        weight = rest.reshape(-1, *[1] * (values.ndim - 2))
        return values[rows, first] * (1 - weight) + values[rows, first + 1] * weight

    points -= at_zero(points)[:, None]
    back = heading - at_zero(turn)
    c, d = np.cos(back)[:, None], np.sin(back)[:, None]
    x, y = points[..., 0], points[..., 1]
    return np.stack([c * x - d * y, d * x + c * y + y_off[:, None]], axis=-1)


def lines_of_roads(
    roads: Roads, *, max_misfit: float = MAX_MISFIT, max_turn: float = MAX_TURN
) -> tuple[Array, Array]:
    """Propagate the pose through the refit of each road, with sigma points.

    Args:
        roads: the roads.
        max_misfit: see ``Refit``.
        max_turn: see ``Refit``.

    Returns:
        (N, 4) means and (N, 4, 4) covariances; NaN where a road is across the car at the mean pose
        or at a sigma point.
    """
    n = len(roads.number)
    mean, cov = np.full((n, 4), np.nan), np.full((n, 4, 4), np.nan)
    transform, at_origin = SigmaPoints(), np.zeros(3)
    poses = np.einsum("ni,nj->nij", roads.sigma, roads.sigma) * np.eye(3)
    poses[:, 0, 1] = poses[:, 1, 0] = roads.correlation * roads.sigma[:, 0] * roads.sigma[:, 1]
    for i in range(n):
        error = None if roads.map_error is None else MapError(*roads.map_error[i])
        line = Polyline(roads.points[i, : roads.number[i]])
        try:
            refit = Refit(line, at_origin, WINDOW, error, max_misfit=max_misfit, max_turn=max_turn)
            mean[i], cov[i] = transform.moments(refit, Gaussian.trusted(at_origin, poses[i]))
        except IllPosedError:
            continue
    return mean, cov
