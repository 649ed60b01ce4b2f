"""Refit: from the pose of the car to the parameters of a line, for many poses at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import floats
from ..errors import IllPosedError
from ..line import LEAST_ADVANCE, STATES, lateral, line_of_cubic
from ..polyline import Polyline, near_stretch, to_ego

__all__ = ["MapError", "Refit"]

#: The sums of the normal equations are polynomials of degree 6 in cosine and sine
#: of the turn of the car.
DEGREE = 6
#: Poses worked on at a time: what one block needs stays in the processor's cache.
BLOCK = 2048
#: Chords that stand for the course of a line where its doubling back is judged.
CHORDS = 16
#: Besides LEAST_ADVANCE of the line's length, the chords must advance along the car's x axis by
#: this share of their whole way along it (at most a third leads back).
LEAST_PROGRESS = 1 / 3
#: A pivot of the normal equations below this is rounding: fewer than 4 points are distinct.
LEAST_PIVOT = 1e-13


@dataclass(frozen=True, slots=True)
class MapError:
    """Error of the map itself, a second source of uncertainty beside the pose.

    Lane geometry of HD maps is given as 5 to 20 cm (Liu, Wang, Zhang 2020,
    tables 3, 5 and 6), part of it common to a stretch, part of it local.

    Args:
        point_sigma: independent error of each map point, in any direction [m].
        offset_sigma: common offset of all points of a line, in any direction [m].
        heading_sigma: common turn of the points about the car [rad].
    """

    point_sigma: float = 0.0
    offset_sigma: float = 0.0
    heading_sigma: float = 0.0

    def __post_init__(self) -> None:
        for name in ("point_sigma", "offset_sigma", "heading_sigma"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(f"{name} must be 0 or more, got {getattr(self, name)!r}")


class Refit:
    """The map from a pose to a line: least-squares cubic through the line's points.

    The points are chosen once, in a window of ``pose``, so that the map is
    smooth; then, for any pose, they are seen from the car and a cubic
    ``v = p0 + p1 u + p2 u^2 + p3 u^3`` is fitted (Map Line Interface, section
    III-A). A turn mixes u and v linearly, so each sum of the normal equations is
    a polynomial in cos and sin of the turn whose coefficients are computed once:
    the cost of a pose does not depend on the number of points.

    Args:
        polyline: the line, or several lines that then share each call.
        pose: (3,) mean pose (e_x [m], e_y [m], e_h [rad]) in the map frame.
        window: (x_min, x_max) ahead of ``pose`` in which points are taken [m].
        map_error: error of the map points, added to what a transform returns.

    Raises:
        IllPosedError: fewer than 4 points in the window, or the points double
            back as seen from ``pose``.

    >>> road = Polyline([[x, 2.0] for x in range(0, 100, 5)])
    >>> refit = Refit(road, [0.0, 0.0, 0.0], window=(-20.0, 80.0))
    >>> refit([10.0, 0.5, 0.0]).round(9) + 0.0
    array([1.5, 0. , 0. , 0. ])
    >>> refit([[0.0, 0.0, 0.1], [0.0, 0.0, 1.57]]).round(3) + 0.0  # the second looks across
    array([[ 2.01, -0.1 ,  0.  ,  0.  ],
           [  nan,   nan,   nan,   nan]])
    """

    def __init__(
        self,
        polyline: Polyline | Sequence[Polyline],
        pose: ArrayLike,
        window: tuple[float, float],
        map_error: MapError | None = None,
    ) -> None:
        self.pose = np.array(floats(pose, "pose"))
        if self.pose.shape != (3,) or not np.isfinite(self.pose).all():
            raise ValueError(f"pose must be finite with shape (3,), got {self.pose!r}")
        x_min, x_max = window
        if not x_min < x_max:
            raise ValueError(f"window must have x_min < x_max [m], got {window}")
        single = isinstance(polyline, Polyline)
        lines = [polyline] if isinstance(polyline, Polyline) else list(polyline)
        if not lines:
            raise ValueError("polyline must be a Polyline or a sequence of at least one")
        points = to_ego(np.concatenate([line.points for line in lines]), self.pose)
        lengths = [len(line.points) for line in lines]
        near = near_stretch(points, lengths, x_min, x_max)
        points = points[near]
        count = np.add.reduceat(near, _starts(np.array(lengths)), dtype=int)
        if (count < len(STATES)).any():
            raise IllPosedError(
                f"a cubic needs 4 points, but the line has {count.min()} in the window "
                f"[{x_min:g}, {x_max:g}] m of the pose; widen the window or resample the line"
            )
        start = _starts(count)
        #: (n, 2) points of each line in the window, in the frame of the mean pose [m].
        self.points = [points[i : i + n] for i, n in zip(start, count, strict=True)]
        self._trailing = () if single else (len(lines),)
        low, high = np.minimum.reduceat(points, start), np.maximum.reduceat(points, start)
        self._centre = (low + high) / 2  # (L, 2)
        self._half = (high[:, 0] - low[:, 0]) / 2  # (L,)
        if not self._half.all():
            self._refuse(self.pose, window)
        self._chords = _chords(points, start, count)  # (L, CHORDS, 2)
        self._span = self._chords.sum(axis=1)  # (L, 2)
        self._least_advance = LEAST_ADVANCE * np.hypot(*self._chords.T).sum(axis=0)[:, None]
        scaled = (points - self._centre.repeat(count, axis=0)) / self._half.repeat(count)[:, None]
        self._coefficients = (_moments(scaled, start, count) @ _MOMENTS_TO_MONOMIALS).reshape(
            -1, 2 * DEGREE + 1
        )  # (11 L, 2 DEGREE + 1)
        if np.isnan(self._cubics(np.array([[1.0], [0.0]]))).any():
            self._refuse(self.pose, window)
        self.noise_cov = None if map_error is None else self._noise_cov(map_error)

    @property
    def x_range(self) -> NDArray[np.float64]:
        """(2,), or (L, 2): extent of the points along the mean car's x axis [m]."""
        extent = self._centre[:, :1] + self._half[:, None] * [-1.0, 1.0]
        return extent.reshape(*self._trailing, 2)

    def __call__(self, poses: ArrayLike) -> NDArray[np.float64]:
        """Lines (y_off, beta, c0, c1) as seen from poses.

        Args:
            poses: (N, 3), or (3,) for a single one [m, m, rad].

        Returns:
            (N, 4), or (N, L, 4) for several lines; a row of NaN where the
            points double back, so that samples can be counted.

        Raises:
            IllPosedError: a single pose from which the points double back.
        """
        poses = floats(poses, "poses")
        if poses.ndim == 1:
            line = self(poses[None])[0]
            if np.isnan(line).any():
                self._refuse(poses, None)
            return line
        out = np.empty((len(poses), len(self._half), len(STATES)))
        for start in range(0, len(poses), BLOCK):
            out[start : start + BLOCK] = self._block(poses[start : start + BLOCK])
        return out.reshape(len(poses), *self._trailing, len(STATES))

    def _block(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        d = poses - self.pose
        turn = np.array([np.cos(d[:, 2]), np.sin(d[:, 2])])  # (2, N)
        # Centre of the points as seen from each pose.
        x, y = self._centre.T[:, :, None] - to_ego(d[:, :2], [0.0, 0.0, self.pose[2]]).T[:, None]
        c, s = turn
        centre_u, centre_v = c * x + s * y, c * y - s * x  # (L, N)
        q = self._half[:, None] * self._cubics(turn)
        q[0] += centre_v
        return line_of_cubic(q, centre_u, self._half[:, None]).swapaxes(0, 1)  # (N, L, 4)

    def _cubics(self, turn: NDArray[np.float64]) -> NDArray[np.float64]:
        """(4, L, N) cubics through the centred and scaled points as seen after a turn.

        NaN where there is none, or where the points double back.

        Args:
            turn: (2, N) its cosine and sine.
        """
        lines, poses = len(self._half), turn.shape[1]
        sums = (self._coefficients @ _monomials(turn)).reshape(lines, -1, poses)  # (L, 11, N)
        q, solved = _solve_normal(sums.swapaxes(0, 1))
        net = np.abs(self._span @ turn)  # (L, N)
        way = np.abs(self._chords @ turn).sum(axis=1)
        posed = (net >= self._least_advance) & (net >= LEAST_PROGRESS * way)
        q[:, ~(posed & solved)] = np.nan
        return q

    def _noise_cov(self, error: MapError) -> NDArray[np.float64]:
        """Map error through the fit, to first order at the mean pose."""
        step = 1e-4
        poses = self.pose + step * np.array([np.eye(3), -np.eye(3)])  # (2, 3, 3)
        ahead, behind = self(poses.reshape(6, 3)).reshape(2, 3, -1, len(STATES))
        J_line_pose = (ahead - behind) / (2 * step)  # (3, L, 4)
        pose_sigma = np.array([error.offset_sigma, error.offset_sigma, error.heading_sigma])
        J = J_line_pose * pose_sigma[:, None, None]
        cov = np.einsum("klm,kln->lmn", J, J)
        mean = self(self.pose[None]).reshape(-1, len(STATES))
        for i, points in enumerate(self.points):
            unit_cov = _fit_cov(points, mean[i], self._centre[i, 0], self._half[i])
            cov[i] += error.point_sigma**2 * unit_cov
        return cov.reshape(*self._trailing, len(STATES), len(STATES))

    def _refuse(self, pose: NDArray[np.float64], window: tuple[float, float] | None) -> None:
        where = "" if window is None else f" in the window [{window[0]:g}, {window[1]:g}] m"
        raise IllPosedError(
            f"the points of the line{where} double back or stand across the car at the pose "
            f"({pose[0]:g} m, {pose[1]:g} m, {np.degrees(pose[2]):g} deg), so no cubic y(x) "
            "follows them; shorten the window or check the heading"
        )


def _starts(count: NDArray[np.intp]) -> NDArray[np.intp]:
    """Index of the first of each line's points where lines are laid end to end."""
    return count.cumsum() - count


def _chords(
    points: NDArray[np.float64], start: NDArray[np.intp], count: NDArray[np.intp]
) -> NDArray[np.float64]:
    """(L, CHORDS, 2) differences between points that divide each line evenly."""
    x, y = (points[1:] - points[:-1]).T
    way = np.zeros(len(points))
    np.hypot(x, y).cumsum(out=way[1:])  # steps from one line to the next are in it too
    stop = start + count - 1
    marks = way[start] + _MARKS * (way[stop] - way[start])  # (CHORDS + 1, L)
    knots = points[way.searchsorted(marks).clip(start, stop)]
    return (knots[1:] - knots[:-1]).swapaxes(0, 1)


def _moments(
    points: NDArray[np.float64], start: NDArray[np.intp], count: NDArray[np.intp]
) -> NDArray[np.float64]:
    """(L, 49) mixed moments mean(a^i b^j), i and j = 0 .. DEGREE, of each line's points (a, b)."""
    points = np.ascontiguousarray(points.T)
    powers = np.ones((DEGREE + 1, *points.shape))
    for k in range(DEGREE):
        np.multiply(powers[k], points, out=powers[k + 1])
    a, b = powers[:, 0], powers[:, 1]
    sums = [a[:, i : i + n] @ b[:, i : i + n].T for i, n in zip(start, count, strict=True)]
    return np.array(sums).reshape(len(count), -1) / count[:, None]


def _monomials(turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2 DEGREE + 1, N): c^(6-j) s^j, j = 0 .. 6, and c^(5-j) s^j, j = 0 .. 5, of (c, s)."""
    powers = np.ones((DEGREE + 1, *turn.shape))
    for k in range(DEGREE):
        np.multiply(powers[k], turn, out=powers[k + 1])
    c, s = powers[:, 0], powers[:, 1]
    return np.concatenate([c[::-1] * s, c[-2::-1] * s[:-1]])


def _moments_to_monomials() -> NDArray[np.float64]:
    """(49, 11 (2 DEGREE + 1)) from the mixed moments of points to their sums as turned points.

    The sums are mean(u^k), k = 0 .. 6, and mean(v u^k), k = 0 .. 3, with u = c a + s b and
    v = c b - s a. Multiplied by c^2 + s^2 = 1 until they are of degree 5 or 6 in (c, s), all
    are combinations of 13 monomials, with whole coefficients. For a small turn nothing cancels.
    """

    def times(p: NDArray[np.float64], s: int, a: int, b: int) -> NDArray[np.float64]:
        return np.roll(p, (s, a, b), axis=(0, 1, 2))  # p[j, m, n] stands at s^j a^m b^n

    one = np.zeros((DEGREE + 1,) * 3)
    one[0, 0, 0] = 1
    u = [one]
    for _ in range(DEGREE):
        u.append(times(u[-1], 0, 1, 0) + times(u[-1], 1, 0, 1))
    v = [times(p, 0, 0, 1) - times(p, 1, 1, 0) for p in u[:4]]
    matrix = np.zeros(((DEGREE + 1) ** 2, 11, 2 * DEGREE + 1))
    for i, (p, degree) in enumerate(zip(u + v, [*range(7), *range(1, 5)], strict=True)):
        for _ in range((DEGREE - degree) // 2):
            p = p + times(p, 2, 0, 0)
        even, odd = slice(0, DEGREE + 1), slice(DEGREE + 1, None)
        columns = p.reshape(DEGREE + 1, -1).T
        if degree % 2:
            matrix[:, i, odd] = columns[:, :-1]
        else:
            matrix[:, i, even] = columns
    return matrix.reshape(len(matrix), -1)


#: Computed once: the moments of a line's points are all that differs between lines.
_MOMENTS_TO_MONOMIALS = _moments_to_monomials()
#: Shares of a line's length at which its chords meet.
_MARKS = np.linspace(0, 1, CHORDS + 1)[:, None]
#: Rows of the normal equations, right-hand side included, in the array of the sums.
_NORMAL = np.column_stack([np.add.outer(np.arange(4), np.arange(4)), np.arange(7, 11)])


def _solve_normal(
    sums: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """(4, ...) cubic of the normal equations, and (...) where they have a solution.

    Elimination without exchange of rows: the matrix is positive definite.

    Args:
        sums: (11, ...): mean(u^k), k = 0 .. 6, then mean(v u^k), k = 0 .. 3.
    """
    M = sums[_NORMAL]  # (4, 5, ...)
    q = M[:, 4]
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for i in range(3):
            M[i, i + 1 :] /= M[i, i]
            M[i + 1 :, i + 1 :] -= M[i + 1 :, i, None] * M[i, i + 1 :]
        q[3] /= M[3, 3]
        for i in (3, 2, 1):
            q[:i] -= M[:i, i] * q[i]
        return q, (M.diagonal() > LEAST_PIVOT).all(axis=-1)


def _fit_cov(
    points: NDArray[np.float64], line: NDArray[np.float64], centre: float, half: float
) -> NDArray[np.float64]:
    """(4, 4) covariance of a fitted line for unit errors of its points in any direction."""
    u, v = points.T
    A = np.vander((u - centre) / half, 4, increasing=True)
    dA = np.column_stack([np.zeros_like(u), A[:, :3] * [1, 2, 3]]) / half
    _, R = np.linalg.qr(A)
    _, beta, c0, c1 = line
    slope = np.tan(beta) + u * (c0 + u * c1 / 2)
    residual = v - lateral(line, u)
    # An error of u acts as one of v, by the slope, and moves the residual to another place.
    V = np.linalg.solve(R.T @ R, np.hstack([A.T, dA.T * residual - A.T * slope]))
    # J: derivative of line_of_cubic at the fit; linear in q but for beta's arctangent.
    J = line_of_cubic(np.eye(4), np.full(4, centre), np.full(4, half)).T
    J[1] = np.tan(J[1]) * np.cos(beta) ** 2
    return J @ (V @ V.T) @ J.T
