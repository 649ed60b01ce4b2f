"""Gaussians of the lines of random roads, for many roads at once.

The roads have the distributions of ``random_scenarios``, but other draws. The Gaussians
are those of ``SigmaPoints`` over ``Refit``, up to rounding. This is several times faster for two
reasons: the arrays run over roads, and a fitted cubic can be shifted without another fit, so that
only the sigma points of the heading need a fit of their own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..line import LEAST_ADVANCE, lateral, lateral_jacobian, line_of_cubic
from ..polyline import MAX_TURN, Polyline, stretches
from ..propagation import SigmaPoints
from ..propagation.refit import CHORD_ENDS, LEAST_PROGRESS, MAX_MISFIT
from ..propagation.transform import weighted_moments
from ..propagation.valid_range import at_nodes, longest_ranges

Array = NDArray[np.float64]

#: Largest number of points of a road.
POINTS = 60
#: Roads computed at a time, so that their arrays stay in the processor's cache.
BLOCK = 256
#: Step of the derivative with respect to the pose, as in ``Refit`` [m, rad].
STEP = 1e-4
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
    for start in range(0, n, BLOCK):
        rows = np.arange(start, min(n, start + BLOCK))
        lines = [Polyline(roads.points[i, : roads.number[i]]) for i in rows]
        seen = stretches(lines, np.zeros(3), WINDOW, max_turn)
        x_range, shift, misfit = longest_ranges(seen, max_misfit)
        x = at_nodes(x_range)
        if max_misfit == np.inf:
            shift, misfit = np.zeros_like(shift), np.zeros_like(misfit)
        points = np.stack([x, seen.lateral(x) + shift[:, None]], axis=-1)
        rows = rows[seen.given]
        block = Roads(*(None if field is None else field[rows] for field in roads))  # type: ignore[arg-type]
        mean[rows], cov[rows] = _lines_of_block(block, points, seen.position(x))
        cov[rows, 0, 0] += misfit**2
    return mean, cov


def _lines_of_block(roads: Roads, points: Array, position: Array) -> tuple[Array, Array]:
    """Return the moments of the cubics through (N, K, 2) points of the roads.

    ``position`` are (N, K) fractional indices of these points among those of the map.
    """
    zero = np.zeros(len(points))
    s_x, s_y, s_h = np.sqrt(3) * roads.sigma.T
    rho = roads.correlation
    e_x = np.stack([zero, s_x, zero, -s_x, zero])  # sigma points with no change of heading
    e_y = np.stack([zero, rho * s_y, np.sqrt(1 - rho**2) * s_y])
    e_y = np.concatenate([e_y, -e_y[1:]])
    straight = _Fit(points, zero)
    left, right = _Fit(points, s_h), _Fit(points, -s_h)
    shifted = [straight.seen_from(x, y) for x, y in zip(e_x, e_y, strict=True)]
    values = np.stack([*shifted[:3], left.line, *shifted[3:], right.line])  # (7, N, 4)
    mean, cov = weighted_moments(values, *SigmaPoints().weights(3))
    if roads.map_error is not None:
        cov = cov + _noise_cov(straight, points, position, roads.map_error)
    for fit in (straight, left, right):
        mean[~fit.posed], cov[~fit.posed] = np.nan, np.nan
    return mean, (cov + cov.transpose(0, 2, 1)) / 2


class _Fit:
    """Cubics through (N, K, 2) points, after a turn of each car by (N,) ``turn`` [rad]."""

    def __init__(self, points: Array, turn: Array) -> None:
        x, y = np.moveaxis(points, -1, 0)
        c, s = np.cos(turn)[:, None], np.sin(turn)[:, None]
        self.u, self.v = c * x + s * y, c * y - s * x
        low, high = self.u.min(axis=1), self.u.max(axis=1)
        self.centre, self.half = (low + high) / 2, (high - low) / 2
        self.posed = self._posed()
        w = (self.u - self.centre[:, None]) / self.half[:, None]
        powers = np.ones((4, *w.shape))
        for k in range(3):
            np.multiply(powers[k], w, out=powers[k + 1])
        self.A = powers.transpose(1, 2, 0)  # (N, K, 4)
        self.normal = self.A.transpose(0, 2, 1) @ self.A
        middle = self.v.mean(axis=1)
        right = self.A.transpose(0, 2, 1) @ (self.v - middle[:, None])[..., None]
        self.q = np.linalg.solve(self.normal, right)[..., 0].T  # (4, N)
        self.q[0] += middle
        self.line = line_of_cubic(self.q, self.centre, self.half)  # (N, 4)

    def seen_from(self, e_x: Array, e_y: Array) -> Array:
        """Return (N, 4) lines as seen from cars that are also shifted [m]."""
        return line_of_cubic(self.q - [[1], [0], [0], [0]] * e_y, self.centre - e_x, self.half)

    def _posed(self) -> NDArray[np.bool_]:
        """Return (N,) whether a cubic follows the points, by the criteria of ``Refit``."""
        along, across = (np.diff(a[:, CHORD_ENDS], axis=1) for a in (self.u, self.v))
        net, way = np.abs(along.sum(axis=1)), np.abs(along).sum(axis=1)
        length = np.hypot(along, across).sum(axis=1)
        return (net >= LEAST_ADVANCE * length) & (net >= LEAST_PROGRESS * way)


def _noise_cov(fit: _Fit, points: Array, position: Array, map_error: Array) -> Array:
    """Propagate the map error through the fit, to first order at the mean pose: (N, 4, 4)."""
    point_sigma, offset_sigma, heading_sigma = map_error.T
    zero = np.zeros(len(points))
    J = np.stack(
        [
            fit.seen_from(zero + STEP, zero) - fit.seen_from(zero - STEP, zero),
            fit.seen_from(zero, zero + STEP) - fit.seen_from(zero, zero - STEP),
            _Fit(points, zero + STEP).line - _Fit(points, zero - STEP).line,
        ]
    ) / (2 * STEP)  # (3, N, 4), of the line with respect to the pose
    J *= np.stack([offset_sigma, offset_sigma, heading_sigma])[..., None]
    return np.einsum("knm,knl->nml", J, J) + _fit_cov(fit, position) * (
        point_sigma[:, None, None] ** 2
    )


def _fit_cov(fit: _Fit, position: Array) -> Array:
    """Return the (N, 4, 4) covariance of fitted lines for unit errors of the points of the map."""
    _, beta, c0, c1 = fit.line.T[..., None]
    slope = np.tan(beta) + fit.u * (c0 + fit.u * c1 / 2)
    residual = fit.v - lateral(fit.line[:, None, :], fit.u)
    # An error of u acts as an error of v times the slope, and moves the residual along the line.
    moved = -fit.A * slope[..., None]
    moved[..., 1:] += fit.A[..., :3] * [1, 2, 3] * (residual / fit.half[:, None])[..., None]
    # The error of a fitted point is the weighted mean of those of its neighbours on the map.
    place = position - np.floor(position[:, :1])
    knots = np.arange(np.floor(place.max()) + 2)
    W = (1 - np.abs(place[..., None] - knots)).clip(0)  # (N, K, points of the map)
    V, V_moved = fit.A.transpose(0, 2, 1) @ W, moved.transpose(0, 2, 1) @ W
    error = V @ V.transpose(0, 2, 1) + V_moved @ V_moved.transpose(0, 2, 1)
    # The derivative of line_of_cubic; linear in q but for the arctangent of beta.
    unit = np.eye(4)[:, :, None] + np.zeros_like(fit.half)  # (4, 4, N)
    J = line_of_cubic(unit, fit.centre, fit.half).transpose(1, 2, 0).copy()  # (N, 4 of line, 4)
    J[:, 1] = np.tan(J[:, 1]) * np.cos(beta) ** 2
    B = np.linalg.solve(fit.normal, J.transpose(0, 2, 1))  # (N, 4, 4 of line)
    cov = B.transpose(0, 2, 1) @ error @ B
    # The fit averages the point errors, but the line itself has them in full.
    J = lateral_jacobian(fit.line[:, None], fit.u)  # (N, K, 4)
    averaged = ((J @ cov) * J).sum(axis=-1).min(axis=1)
    cov[:, 0, 0] += (1 - averaged).clip(0)
    return cov
