"""Refit: the parameters of map lines as functions of the pose, for many poses at once."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.arrays import floats
from ..values.cubics import MIN_ADVANCE, line_of_cubic
from ..values.errors import IllPosedError
from ..values.line import PARAMETERS, lateral, lateral_jacobian
from ..values.map_error import MapError
from ..values.polyline import Polyline
from ..values.seen_lines import NODES, bases
from .cubic_fit import Fitted, coefficient_variances, longest_ranges
from .stretches import MAX_TURN, Stretches, stretches

#: The sums of the normal equations are polynomials of degree 6 in the cosine and sine
#: of the rotation of the car.
DEGREE = 6
#: Lines times poses per block: its arrays fit in the processor's cache, and its products are so
#: small that BLAS computes them in the calling thread.
BLOCK = 1024
#: The shape of a line is checked by chords from each CHORD-th of the fitted points to the next.
CHORD = (len(NODES) - 1) // 16
#: Default of the largest deviation of a cubic from its line [m].
MAX_MISFIT = 0.1
#: Minimum |net| / total absolute advance in x; 1/3 allows a third of it to run backwards. Applies
#: in addition to MIN_ADVANCE.
MIN_PROGRESS = 1 / 3
#: (K,) from the values at the nodes to the coefficient of T_4 in their fit.
_TO_QUARTIC = np.linalg.pinv(np.polynomial.chebyshev.chebvander(NODES, 4))[4]
#: Smallest pivot of the normal equations; below it there are fewer than 4 distinct points.
MIN_PIVOT = 1e-13


class Refit:
    """Function from a pose to the cubics that map lines are, seen from there.

    The stretch of each line is selected once, in a window relative to ``pose``, so that the
    function is smooth (see ``stretches``), and shortened to the range that a cubic follows
    within ``max_misfit``. For each pose the stretch is transformed to the ego frame (u, v), and a
    cubic ``v = p0 + p1 u + p2 u^2 + p3 u^3`` is fitted by least squares (Map Line Interface,
    section III-A) at 64 Chebyshev nodes of the range, interpolated on the line. The result
    therefore depends on the line and not on the spacing of its points, and deviates little more
    than the best cubic. A rotation mixes u and v linearly. Each sum of the normal equations is
    therefore a polynomial in the cosine and sine of the rotation, whose coefficients are computed
    once: the cost per pose does not depend on the number of points.

    Args:
        polyline: the line; several lines, for which each call returns parameters; or stretches
            of lines that were selected before, for which ``window`` and ``max_turn`` are ignored.
        pose: (3,) mean pose (e_x [m], e_y [m], e_h [rad]) in the map frame.
        window: (x_min, x_max) in the ego frame of ``pose``; the line in it is used [m].
        map_error: error of the map points; transforms add its effect to the covariance.
        max_misfit: largest deviation of the cubic from the line within ``x_range`` [m]. What
            remains of it is covered by ``noise_cov``. Infinite for a fit to all of the window
            without that cover, as in the paper.
        max_turn: largest angle between a line and the x axis of ``pose`` [rad]; the line is not
            used farther along.
        room: distance behind the car at which a range begins at least, if the line does [m].
        step: of which the ends of the ranges are multiples, for lines that are long enough; 0 for
            any [m].

    Raises:
        ValueError: ``pose``, ``window`` or ``max_misfit`` is wrong, or there is no line.
        IllPosedError: a line is not in the window, or is nearly perpendicular to the x axis.

    >>> road = Polyline([[x, 2.0] for x in range(0, 100, 5)])
    >>> refit = Refit(road, [0.0, 0.0, 0.0], window=(-20.0, 80.0))
    >>> refit.x_range
    array([ 0., 80.])
    >>> refit([10.0, 0.5, 0.0]).round(9) + 0.0
    array([1.5, 0. , 0. , 0. ])
    >>> refit([[0.0, 0.0, 0.1], [0.0, 0.0, 1.57]]).round(3) + 0.0  # the second is perpendicular
    array([[ 2.01, -0.1 ,  0.  ,  0.  ],
           [  nan,   nan,   nan,   nan]])
    """

    # More parameters than six: all choices of a fit, and most callers need two.
    def __init__(
        self,
        polyline: Polyline | Sequence[Polyline] | Stretches,
        pose: ArrayLike,
        window: tuple[float, float] = (-20.0, 80.0),
        map_error: MapError | None = None,
        *,
        max_misfit: float = MAX_MISFIT,
        max_turn: float = MAX_TURN,
        room: float = 0.0,
        step: float = 0.0,
    ) -> None:
        if not max_misfit > 0:
            raise ValueError(f"max_misfit must be more than 0 m, got {max_misfit!r}")
        pose = floats(pose, "pose")
        if isinstance(polyline, Stretches):
            seen = polyline
        else:
            seen = _seen(polyline, pose, window, max_turn)
        self._trailing = () if isinstance(polyline, Polyline) else (len(seen.given),)
        self.pose = np.array(pose)
        fitted = longest_ranges(seen, max_misfit, room, step)
        #: (2,), or (L, 2): range that the cubics describe, in the frame of the mean pose [m].
        self.x_range = fitted.x_range.reshape(*self._trailing, 2)
        #: (), or (L,): largest deviation of the cubic from the line in its range [m].
        self.misfit = fitted.misfit.reshape(self._trailing)
        x, y = fitted.x, fitted.y
        if max_misfit < np.inf:
            y = y + fitted.shift[:, None]
        #: (L, K, 2) points of each line to which the cubics are fitted, in the frame of ``pose``.
        self.points = np.stack([x, y], axis=-1)
        self._half = (x[:, -1:] - x[:, :1]) / 2  # (L, 1)
        low, high = y.min(axis=1), y.max(axis=1)
        self._centre = np.array([(x[:, 0] + x[:, -1]) / 2, (low + high) / 2])  # (2, L)
        scaled = (y - self._centre[1][:, None]) / self._half
        self._harmonics = _harmonics_of_sums(scaled)  # (11 L, 2 DEGREE + 1)
        chords = self.points[:, CHORD::CHORD] - self.points[:, :-CHORD:CHORD]  # (L, CHORDS, 2)
        self._chords = chords.reshape(-1, 2)
        self._least_advance = MIN_ADVANCE * np.hypot(*chords.T).sum(axis=0)[:, None]
        #: (), or (L,): whether the line is nearly perpendicular to the x axis of the mean pose.
        self.is_across = (2 * self._half < self._least_advance).reshape(self._trailing)
        c, s = math.cos(pose[2]), math.sin(pose[2])
        self._to_ego = np.array([[c, -s], [s, c]])
        #: (4, 4), or (L, 4, 4): covariance of the map error and of the misfit; None without both.
        self.noise_cov = None
        if map_error is not None or max_misfit < np.inf:
            noise_cov = self._noise_cov(seen, fitted, map_error, is_covered=max_misfit < np.inf)
            self.noise_cov = noise_cov.reshape(*self._trailing, 4, 4)

    @property
    def quartic(self) -> NDArray[np.float64]:
        """(), or (L,): coefficient of the polynomial T_4 that the cubic leaves of the line [m]."""
        return np.asarray((self.points[..., 1] @ _TO_QUARTIC).reshape(self._trailing))

    def __call__(self, poses: ArrayLike) -> NDArray[np.float64]:
        """Return the lines (y_off, beta, c0, c1) for poses.

        Args:
            poses: (N, 3), or (3,) for a single pose [m, m, rad].

        Returns:
            (N, 4), or (N, L, 4) for several lines. A row is NaN if, seen from the pose, the
            points are not a function of x or nearly perpendicular to the x axis.

        Raises:
            IllPosedError: the same, for a single pose.
        """
        poses = floats(poses, "poses")
        if poses.ndim == 1:
            line = self(poses[None])[0]
            if np.isnan(line).any():
                self._raise_ill_posed(poses, None)
            return line
        lines = len(self._half)
        out = np.empty((len(poses), lines, len(PARAMETERS)))
        step = max(1, BLOCK // lines)
        for start in range(0, len(poses), step):
            out[start : start + step] = self._block(poses[start : start + step])
        return out.reshape(len(poses), *self._trailing, len(PARAMETERS))

    def _block(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (N, L, 4) lines for a block of (N, 3) poses."""
        d = poses - self.pose
        turn = np.array([np.cos(d[:, 2]), np.sin(d[:, 2])])  # (2, N)
        q = self._cubics(turn)
        q *= self._half
        # Centre of the points as seen from each pose.
        x, y = self._centre[:, :, None] - (d[:, :2] @ self._to_ego).T[:, None]
        c, s = turn
        q[0] += c * y - s * x
        return line_of_cubic(q, c * x + s * y, self._half).swapaxes(0, 1)  # (N, L, 4)

    def _cubics(self, turn: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (4, L, N) cubics through the centred and scaled points after rotations.

        They are NaN if the points are ill-posed. ``turn`` is the (2, N) cosine and sine.
        """
        lines, poses = len(self._half), turn.shape[1]
        sums = (self._harmonics @ _harmonics(turn)).reshape(lines, -1, poses)  # (L, 11, N)
        q, least_pivot = _solve_normal(sums.swapaxes(0, 1))
        advance = (self._chords @ turn).reshape(lines, -1, poses)  # (L, CHORDS, N)
        net, total = np.abs(advance.sum(axis=1)), np.abs(advance).sum(axis=1)
        well_posed = (net >= self._least_advance) & (net >= MIN_PROGRESS * total)
        well_posed &= least_pivot > MIN_PIVOT
        if not well_posed.all():
            q[:, ~well_posed] = np.nan
        return q

    def _noise_cov(
        self, seen: Stretches, fitted: Fitted, map_error: MapError | None, *, is_covered: bool
    ) -> NDArray[np.float64]:
        """Return the (L, 4, 4) covariance of the map error and, if it is covered, of the misfit."""
        cov = np.zeros((len(fitted.x), len(PARAMETERS), len(PARAMETERS)))
        mean = self._block(self.pose[None])[0]
        if map_error is not None:
            cov += self._map_cov(map_error, mean, seen.position(fitted.x))
        if is_covered:
            J = bases(mean, fitted.x_range)
            point_sigma = 0.0 if map_error is None else map_error.point_sigma
            variances = coefficient_variances(seen, fitted, point_sigma)
            cov += np.einsum("lik,lk,ljk->lij", J, variances, J)
        return cov

    def _map_cov(
        self, error: MapError, mean: NDArray[np.float64], position: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Return the (L, 4, 4) covariance of the lines due to the map error, to first order.

        ``mean`` are the (L, 4) lines seen from the mean pose, ``position`` are (L, K) fractional
        indices of the fitted points among those of the map.
        """
        step = 1e-4
        poses = self.pose + step * np.array([np.eye(3), -np.eye(3)])  # (2, 3, 3)
        ahead, behind = self._block(poses.reshape(6, 3)).reshape(2, 3, -1, len(PARAMETERS))
        J_line_pose = (ahead - behind) / (2 * step)  # (3, L, 4)
        pose_sigma = np.array([error.offset_sigma, error.offset_sigma, error.heading_sigma])
        J = J_line_pose * pose_sigma[:, None, None]
        cov = np.einsum("klm,kln->lmn", J, J)
        for i, points in enumerate(self.points):
            unit_cov = _fit_cov(points, position[i], mean[i], self._centre[0, i], self._half[i, 0])
            # The fit averages the point errors, but the line itself has them in full.
            J = lateral_jacobian(mean[i], points[:, 0])
            averaged = np.einsum("ki,ij,kj->k", J, unit_cov, J).min()
            unit_cov[0, 0] += max(0.0, 1 - averaged)
            cov[i] += error.point_sigma**2 * unit_cov
        return cov

    def _raise_ill_posed(
        self, pose: NDArray[np.float64], window: tuple[float, float] | None
    ) -> NoReturn:
        where = "" if window is None else f" in the window [{window[0]:g}, {window[1]:g}] m"
        raise IllPosedError(
            f"the points of the line{where} are not a function of x, or are nearly perpendicular "
            f"to the x axis, at the pose ({pose[0]:g} m, {pose[1]:g} m, "
            f"{np.degrees(pose[2]):g} deg), so no cubic y(x) describes them; shorten the window "
            "or check the heading"
        )


def _harmonics(turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (2 DEGREE + 1, N): 1, cos(k h) and sin(k h), k = 1 .. 6, of (2, N) cos h and sin h."""
    z = turn[0] + 1j * turn[1]
    powers = np.multiply.accumulate(z[None].repeat(DEGREE, axis=0))
    return np.concatenate([np.ones_like(turn[:1]), powers.real, powers.imag])


def _moments_to_harmonics() -> NDArray[np.float64]:
    """Return the (49, 11 (2 DEGREE + 1)) matrix from moments to the sums of rotated points.

    The moments are mean(b^j a^i), i and j = 0 .. 6. The sums are mean(u^k), k = 0 .. 6, and
    mean(v u^k), k = 0 .. 3, with u = c a + s b and v = c b - s a. They are trigonometric
    polynomials, which their values at 13 angles determine.
    """
    angles = 2 * np.pi * np.arange(2 * DEGREE + 1) / (2 * DEGREE + 1)
    c, s = np.cos(angles), np.sin(angles)
    u = np.zeros((DEGREE + 1, len(angles), DEGREE + 1, DEGREE + 1))  # powers, coefficients [j, i]
    u[0, :, 0, 0] = 1
    for k in range(DEGREE):
        u[k + 1, :, :, 1:] = c[:, None, None] * u[k, :, :, :-1]
        u[k + 1, :, 1:] += s[:, None, None] * u[k, :, :-1]
    v_u = np.zeros_like(u[:4])
    v_u[:, :, 1:] = c[:, None, None] * u[:4, :, :-1]
    v_u[:, :, :, 1:] -= s[:, None, None] * u[:4, :, :, :-1]
    values = np.concatenate([u, v_u]).swapaxes(0, 1).reshape(len(angles), -1)
    coefficients = np.linalg.solve(_harmonics(np.array([c, s])).T, values)
    shape = (len(angles), 11, (DEGREE + 1) ** 2)
    return coefficients.reshape(shape).T.reshape((DEGREE + 1) ** 2, -1)


#: The same for all lines, so computed once.
_MOMENTS_TO_HARMONICS = _moments_to_harmonics()
#: (K, DEGREE + 1) powers of the nodes, with the factor of a mean.
_POWERS = np.vander(NODES, DEGREE + 1, increasing=True) / len(NODES)


def _seen(
    polyline: Polyline | Sequence[Polyline],
    pose: NDArray[np.float64],
    window: tuple[float, float],
    max_turn: float,
) -> Stretches:
    """Return the stretches of the lines, all of which must have one."""
    lines = [polyline] if isinstance(polyline, Polyline) else list(polyline)
    if not lines:
        raise ValueError("polyline must be a Polyline or a sequence of at least one, got none")
    seen = stretches(lines, pose, window, max_turn)
    for i, reason in sorted(seen.left_out.items()):
        which = "the line" if len(lines) == 1 else f"line {i} of {len(lines)}"
        raise IllPosedError(f"{which} cannot be given: {reason}; the window is {window} m")
    return seen


def _harmonics_of_sums(b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (11 L, 2 DEGREE + 1) coefficients of the sums of points (a, b) after rotations.

    Of each line, a are the nodes and b is (L, K).
    """
    powers = np.ones((DEGREE + 1, *b.shape))
    for k in range(DEGREE):
        np.multiply(powers[k], b, out=powers[k + 1])
    moments = (powers @ _POWERS).swapaxes(0, 1).reshape(len(b), -1)  # (L, 49)
    return (moments @ _MOMENTS_TO_HARMONICS).reshape(-1, 2 * DEGREE + 1)


@np.errstate(invalid="ignore", divide="ignore", over="ignore")
def _solve_normal(sums: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the (4, ...) solutions of the normal equations, and their least pivots.

    The (11, ...) sums are mean(u^k), k = 0 .. 6, the first of which is 1, and mean(v u^k), k = 0
    .. 3. The elimination needs no pivoting, as the matrix is positive definite.
    """
    m1, m2, m3, m6 = sums[1], sums[2], sums[3], sums[6]
    rhs = sums[7:]
    # Row i of the symmetric matrix from its diagonal on, after i steps of the elimination.
    row1 = sums[2:5] - m1 * sums[1:4]
    row2 = sums[4:6] - m2 * sums[2:4]
    factor = row1[1:] / row1[0]
    row2 -= factor[0] * row1[1:]
    factor3 = row2[1] / row2[0]
    last = m6 - m3 * m3 - factor[1] * row1[2] - factor3 * row2[1]
    q = np.empty((4, *m1.shape))
    q[0] = rhs[0]
    q[1:] = rhs[1:] - rhs[0] * sums[1:4]
    q[2:] -= factor * q[1]
    q[3] -= factor3 * q[2]
    q[3] /= last
    q[2] = q[2] / row2[0] - factor3 * q[3]
    q[1] = q[1] / row1[0] - factor[0] * q[2] - factor[1] * q[3]
    q[0] -= m1 * q[1] + m2 * q[2] + m3 * q[3]
    return q, np.minimum(np.minimum(row1[0], row2[0]), last)


def _fit_cov(
    points: NDArray[np.float64],
    position: NDArray[np.float64],
    line: NDArray[np.float64],
    centre: float,
    half: float,
) -> NDArray[np.float64]:
    """Return the (4, 4) covariance of a fitted line for unit errors of the points of the map.

    The fitted points are interpolated between those of the map, at ``position``.
    """
    u, v = points.T
    A = np.vander((u - centre) / half, 4, increasing=True)
    dA = np.column_stack([np.zeros_like(u), A[:, :3] * [1, 2, 3]]) / half
    _, R = np.linalg.qr(A)
    _, beta, c0, c1 = line
    slope = np.tan(beta) + u * (c0 + u * c1 / 2)
    residual = v - lateral(line, u)
    # An error in u acts twice: via the slope of l, and via the change of A's row.
    V = np.linalg.solve(R.T @ R, np.hstack([A.T, dA.T * residual - A.T * slope]))
    # The error of a fitted point is the weighted mean of those of its two neighbours.
    below = np.floor(position).astype(int)
    share = position - below
    below -= below[0]
    W = np.zeros((len(u), below[-1] + 2))
    W[np.arange(len(u)), below] = 1 - share
    W[np.arange(len(u)), below + 1] = share
    V = np.hstack([V[:, : len(u)] @ W, V[:, len(u) :] @ W])
    # J: derivative of line_of_cubic at the fit; only beta is nonlinear in q, by its arctangent.
    J = line_of_cubic(np.eye(4), np.full(4, centre), np.full(4, half)).T
    J[1] = np.tan(J[1]) * np.cos(beta) ** 2
    return np.asarray(J @ (V @ V.T) @ J.T)
