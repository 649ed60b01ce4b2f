"""Refit in Python: the model of ``c/propagation/refit.c``."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..values.cubics import MIN_ADVANCE, cubic_fit, derivatives, line_of_cubic
from ..values.elementary import hypot, sin_cos, sin_cos_one, tan
from ..values.fixed_order import congruence, product, row_total
from ..values.line import PARAMETERS
from ..values.map_error import MapError
from ..values.seen_lines import NODES, bases
from .cubic_fit import FIT, Fitted, coefficient_variances, longest_ranges
from .rotated_sums import rotated_sums, sums_of_points
from .stretches import Stretches

#: Lines times poses per block: its arrays fit in the processor's cache.
BLOCK = 1024
#: The shape of a line is checked by chords from each CHORD-th of the fitted points to the next.
CHORD = (len(NODES) - 1) // 16
#: Minimum |net| / total absolute advance in x; 1/3 allows a third of it to run backwards. Applies
#: in addition to MIN_ADVANCE.
MIN_PROGRESS = 1 / 3
#: (K, 4) derivatives of the coefficients of a fit with respect to what moves its nodes, times the
#: residuals there.
_BY_PLACE = product(
    np.stack([np.zeros_like(NODES), np.ones_like(NODES), 2 * NODES, 3 * NODES * NODES], axis=1),
    row_total(FIT[:, :, None] * FIT[:, None]),
)
#: (K,) what a cubic leaves of T_4 at the nodes.
_QUARTIC = cubic_fit(NODES, 8 * NODES**4 - 8 * NODES**2 + 1, np.ones_like(NODES)).rest
#: (K,) from the values at the nodes to the coefficient of T_4 in their fit.
_TO_QUARTIC = _QUARTIC / row_total(_QUARTIC * _QUARTIC)
#: Smallest pivot of the normal equations; below it there are fewer than 4 distinct points.
MIN_PIVOT = 1e-13


class RefitModel:
    """Lines as functions of the pose; the arguments are those of ``Refit``.

    Attributes are those of ``Refit``, with the lines on the first axis.
    """

    def __init__(
        self,
        seen: Stretches,
        pose: NDArray[np.float64],
        map_error: MapError | None,
        max_misfit: float,
        room: float,
        step: float,
    ) -> None:
        self._pose, self.count = pose, len(seen.given)
        fitted = longest_ranges(seen, max_misfit, room, step)
        self.x_range, self.misfit = fitted.x_range, fitted.misfit
        x, y = fitted.x, fitted.y
        if max_misfit < np.inf:
            y = y + fitted.shift[:, None]
        self.points = np.stack([x, y], axis=-1)
        self._half = (x[:, -1:] - x[:, :1]) / 2  # (L, 1)
        low, high = y.min(axis=1), y.max(axis=1)
        self._centre = np.array([(x[:, 0] + x[:, -1]) / 2, (low + high) / 2])  # (2, L)
        scaled = (y - self._centre[1][:, None]) / self._half
        self._sums = sums_of_points(scaled)
        chords = self.points[:, CHORD::CHORD] - self.points[:, :-CHORD:CHORD]  # (L, CHORDS, 2)
        self._chords = chords.T[..., None]  # (2, CHORDS, L, 1)
        self._span = row_total(self._chords.swapaxes(0, 1))  # (2, L, 1)
        self._least_advance = MIN_ADVANCE * row_total(hypot(*self._chords))  # (L, 1)
        slopes = self._chords[1] / self._chords[0]
        self._slopes = slopes.min(axis=0), slopes.max(axis=0)
        self.is_across = (2 * self._half < self._least_advance)[:, 0]
        self._turn = sin_cos_one(pose.item(2))
        self.noise_cov = None
        if map_error is not None or max_misfit < np.inf:
            self.noise_cov = self._noise_cov(
                seen, fitted, map_error, is_covered=max_misfit < np.inf
            )

    @property
    def quartic(self) -> NDArray[np.float64]:
        """(L,) coefficients of the polynomial T_4 that the cubics leave of the lines [m]."""
        return row_total(_TO_QUARTIC[:, None] * self.points[..., 1].T)

    def __call__(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (N, L, 4) lines for (N, 3) poses."""
        lines = len(self._half)
        out = np.empty((len(poses), lines, len(PARAMETERS)))
        d = poses - self._pose
        turns = sin_cos(d[:, 2])
        step = max(1, BLOCK // lines)
        for start in range(0, len(poses), step):
            block = slice(start, start + step)
            out[block] = self._block(d[block], *(values[block] for values in turns))
        return out

    def _block(
        self, d: NDArray[np.float64], s: NDArray[np.float64], c: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the (N, L, 4) lines for a block of (N, 3) differences from the mean pose.

        s and c are the (N,) sines and cosines of those of the heading.
        """
        q = self._cubics(c, s)
        q *= self._half
        # Centre of the points as seen from each pose.
        sin_mean, cos_mean = self._turn
        x = self._centre[0, :, None] - (cos_mean * d[:, 0] + sin_mean * d[:, 1])
        y = self._centre[1, :, None] - (cos_mean * d[:, 1] - sin_mean * d[:, 0])
        q[0] += c * y - s * x
        return line_of_cubic(q, c * x + s * y, self._half).swapaxes(0, 1)  # (N, L, 4)

    def _cubics(self, c: NDArray[np.float64], s: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (4, L, N) cubics through the centred and scaled points after rotations.

        They are NaN if the points are ill-posed. c and s are the (N,) cosines and sines.
        """
        q, least_pivot = _solve_normal(rotated_sums(self._sums, c, s))
        net = np.abs(c * self._span[0] + s * self._span[1])
        well_posed = (net >= self._least_advance) & (least_pivot > MIN_PIVOT)
        low, high = self._slopes
        if not ((c + s * low > 0) & (c + s * high > 0)).all():  # some of a line runs backwards
            total = row_total(np.abs(c * self._chords[0] + s * self._chords[1]))
            well_posed &= net >= MIN_PROGRESS * total
        if not well_posed.all():
            q[:, ~well_posed] = np.nan
        return q

    def _noise_cov(
        self, seen: Stretches, fitted: Fitted, map_error: MapError | None, *, is_covered: bool
    ) -> NDArray[np.float64]:
        """Return the (L, 4, 4) covariance of the map error and, if it is covered, of the misfit."""
        cov = np.zeros((self.count, len(PARAMETERS), len(PARAMETERS)))
        mean = self(self._pose[None])[0]
        if map_error is not None:
            cov += self._map_cov(map_error, mean, seen.position(fitted.x))
        if is_covered:
            J = bases(mean, fitted.x_range)
            point_sigma = 0.0 if map_error is None else map_error.point_sigma
            variances = coefficient_variances(seen, fitted, point_sigma)
            cov += product(J * variances[:, None], J.mT)
        return cov

    def _map_cov(
        self, error: MapError, mean: NDArray[np.float64], position: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the (L, 4, 4) covariance of the lines due to the map error, to first order.

        ``mean`` are the (L, 4) lines seen from the mean pose, ``position`` are (L, K) fractional
        indices of the fitted points among those of the map.
        """
        step = 1e-4
        poses = self._pose + step * np.array([np.eye(3), -np.eye(3)])  # (2, 3, 3)
        ahead, behind = self(poses.reshape(6, 3)).reshape(2, 3, -1, len(PARAMETERS))
        J_line_pose = (ahead - behind) / (2 * step)  # (3, L, 4)
        pose_sigma = np.array([error.offset_sigma, error.offset_sigma, error.heading_sigma])
        J = (J_line_pose * pose_sigma[:, None, None]).transpose(1, 2, 0)  # (L, 4, 3)
        cov = product(J, J.mT)
        for i, points in enumerate(self.points):
            unit_cov = _unit_cov(points, position[i], mean[i], self._centre[0, i], self._half[i, 0])
            cov[i] += error.point_sigma * error.point_sigma * unit_cov
        return cov


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def _solve_normal(sums: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (4, ...) solutions of the normal equations, and their least pivots.

    The (10, ...) sums are those of ``rotated_sums``. The elimination needs no pivoting, as the
    matrix is positive definite.
    """
    m, m6, rhs = sums[:9:2], sums[9], sums[1:8:2]
    m1, m2, m3 = m[:3]
    # Row i of the symmetric matrix from its diagonal on, after i steps of the elimination.
    row1 = m[1:4] - m1 * m[:3]
    row2 = m[3:5] - m2 * m[1:3]
    factor = row1[1:] / row1[0]
    row2 -= factor[0] * row1[1:]
    factor3 = row2[1] / row2[0]
    last = m6 - m3 * m3 - factor[1] * row1[2] - factor3 * row2[1]
    q = np.empty((4, *m1.shape))
    q[0] = rhs[0]
    q[1:] = rhs[1:] - rhs[0] * m[:3]
    q[2:] -= factor * q[1]
    q[3] -= factor3 * q[2]
    q[3] /= last
    q[2] = q[2] / row2[0] - factor3 * q[3]
    q[1] = q[1] / row1[0] - factor[0] * q[2] - factor[1] * q[3]
    q[0] -= m1 * q[1] + m2 * q[2] + m3 * q[3]
    return q, np.minimum(np.minimum(row1[0], row2[0]), last)


def _unit_cov(
    points: NDArray[np.float64],
    position: NDArray[np.float64],
    line: NDArray[np.float64],
    centre: float,
    half: float,
) -> NDArray[np.float64]:
    """Return the (4, 4) covariance of a line for unit errors of the points of the map.

    The fitted points are interpolated between those of the map, at ``position``.
    """
    u, v = points.T
    y_off, beta, c0, c1 = line
    tangent = tan(beta)
    slope = tangent + u * (c0 + u * c1 / 2)
    residual = v - (y_off + u * (tangent + u * (c0 / 2 + u * c1 / 6)))
    # An error in u acts twice: via the slope of l, and via the change of the place in the range.
    by_v = FIT
    by_u = _BY_PLACE / half * residual[:, None] - FIT * slope[:, None]
    # The error of a fitted point is the weighted mean of those of its two neighbours.
    below = np.floor(position).astype(int)
    share = (position - below)[:, None]
    below -= below[0]
    effects = np.zeros((below[-1] + 2, 2, 4))
    own = np.stack([by_v, by_u], axis=1)  # (K, 2, 4)
    np.add.at(effects, below + 1, share[..., None] * own)
    np.add.at(effects, below, (1 - share)[..., None] * own)
    effects = effects.reshape(-1, 4)
    S = np.add.reduce(effects[:, :, None] * effects[:, None], axis=0)  # one after the other
    # J: derivative of line_of_cubic at the fit; only beta is nonlinear in q, by its arctangent.
    J = derivatives(np.eye(4), np.full(4, centre), np.full(4, half)).T
    _, cosine = sin_cos(beta)
    J[1] *= cosine * cosine
    cov = congruence(J, S)
    # The fit averages the point errors, but the line itself has them in full.
    square = u * u
    by_slope = (1 + tangent * tangent) * u
    J = np.array([np.ones_like(u), by_slope, square / 2, square * u / 6]).T
    averaged = row_total((product(J, cov) * J).T).min()
    cov[0, 0] += max(0.0, 1 - averaged)
    return cov
