"""Refit: the parameters of map lines as functions of the pose, for many poses at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arrays import floats
from ..errors import IllPosedError
from ..line import LEAST_ADVANCE, PARAMETERS, lateral, line_of_cubic
from ..polyline import Polyline, near_stretch, to_ego

#: The sums of the normal equations are polynomials of degree 6 in the cosine and sine
#: of the rotation of the car.
DEGREE = 6
#: Poses per block: the arrays of one block fit in the processor's cache.
BLOCK = 2048
#: Number of chords by which the shape of a line is checked.
CHORDS = 16
#: Minimum |net| / total absolute advance in x; 1/3 allows a third of it to run backwards. Applies
#: in addition to LEAST_ADVANCE.
LEAST_PROGRESS = 1 / 3
#: Smallest pivot of the normal equations; below it there are fewer than 4 distinct points.
LEAST_PIVOT = 1e-13


@dataclass(frozen=True, slots=True)
class MapError:
    """Standard deviations of the errors of the map points.

    Published errors of the lane geometry of HD maps are 5 to 20 cm (Liu, Wang, Zhang
    2020, tables 3, 5 and 6). Some are common to a section of a road, some are local.

    Args:
        point_sigma: independent error of each map point, in any direction [m].
        offset_sigma: common offset of all points of a line, in any direction [m].
        heading_sigma: common rotation of all points of a line about the car [rad].

    Raises:
        ValueError: a value is negative or not finite.
    """

    point_sigma: float = 0.0
    offset_sigma: float = 0.0
    heading_sigma: float = 0.0

    def __post_init__(self) -> None:
        for name in ("point_sigma", "offset_sigma", "heading_sigma"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(
                    f"{name} must be 0 or more and finite, got {getattr(self, name)!r}"
                )


class Refit:
    """Function from a pose to the least-squares cubics through the points of map lines.

    The points are selected once, in a window relative to ``pose``, so that the
    function is smooth. For each pose the points are transformed to the ego frame (u, v),
    and a cubic ``v = p0 + p1 u + p2 u^2 + p3 u^3`` is fitted (Map Line Interface,
    section III-A). A rotation mixes u and v linearly. Each sum of the normal equations is
    therefore a polynomial in the cosine and sine of the rotation, whose coefficients are
    computed once: the cost per pose does not depend on the number of points.

    Args:
        polyline: the line, or several lines for which each call returns parameters.
        pose: (3,) mean pose (e_x [m], e_y [m], e_h [rad]) in the map frame.
        window: (x_min, x_max) in the ego frame of ``pose``; points in it are used [m].
        map_error: error of the map points; transforms add its effect to the covariance.

    Raises:
        ValueError: ``pose`` or ``window`` is wrong, or there is no line.
        IllPosedError: there are fewer than 4 points in the window, or seen from ``pose``
            they are not a function of x or nearly perpendicular to the x axis.

    >>> road = Polyline([[x, 2.0] for x in range(0, 100, 5)])
    >>> refit = Refit(road, [0.0, 0.0, 0.0], window=(-20.0, 80.0))
    >>> refit([10.0, 0.5, 0.0]).round(9) + 0.0
    array([1.5, 0. , 0. , 0. ])
    >>> refit([[0.0, 0.0, 0.1], [0.0, 0.0, 1.57]]).round(3) + 0.0  # the second is perpendicular
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
            raise ValueError("polyline must be a Polyline or a sequence of at least one, got none")
        points = to_ego(np.concatenate([line.points for line in lines]), self.pose)
        lengths = [len(line.points) for line in lines]
        near = near_stretch(points, lengths, x_min, x_max)
        points = points[near]
        count = np.add.reduceat(near, _starts(np.array(lengths)), dtype=int)
        if (count < len(PARAMETERS)).any():
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
            self._raise_ill_posed(self.pose, window)
        self._chords = _chords(points, start, count)  # (L, CHORDS, 2)
        self._span = self._chords.sum(axis=1)  # (L, 2)
        self._least_advance = LEAST_ADVANCE * np.hypot(*self._chords.T).sum(axis=0)[:, None]
        scaled = (points - self._centre.repeat(count, axis=0)) / self._half.repeat(count)[:, None]
        self._coefficients = (_moments(scaled, start, count) @ _MOMENTS_TO_MONOMIALS).reshape(
            -1, 2 * DEGREE + 1
        )  # (11 L, 2 DEGREE + 1)
        if np.isnan(self._cubics(np.array([[1.0], [0.0]]))).any():
            self._raise_ill_posed(self.pose, window)
        self.noise_cov = None if map_error is None else self._noise_cov(map_error)

    @property
    def x_range(self) -> NDArray[np.float64]:
        """(2,), or (L, 2): range of the points along the x axis of the mean pose [m]."""
        x_range = self._centre[:, :1] + self._half[:, None] * [-1.0, 1.0]
        return x_range.reshape(*self._trailing, 2)

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
        out = np.empty((len(poses), len(self._half), len(PARAMETERS)))
        for start in range(0, len(poses), BLOCK):
            out[start : start + BLOCK] = self._block(poses[start : start + BLOCK])
        return out.reshape(len(poses), *self._trailing, len(PARAMETERS))

    def _block(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (N, L, 4) lines for a block of (N, 3) poses."""
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
        """Return the (4, L, N) cubics through the centred and scaled points after rotations.

        They are NaN if the points are ill-posed. ``turn`` is the (2, N) cosine and sine.
        """
        lines, poses = len(self._half), turn.shape[1]
        sums = (self._coefficients @ _monomials(turn)).reshape(lines, -1, poses)  # (L, 11, N)
        q, solved = _solve_normal(sums.swapaxes(0, 1))
        net = np.abs(self._span @ turn)  # (L, N)
        total = np.abs(self._chords @ turn).sum(axis=1)
        well_posed = (net >= self._least_advance) & (net >= LEAST_PROGRESS * total)
        q[:, ~(well_posed & solved)] = np.nan
        return q

    def _noise_cov(self, error: MapError) -> NDArray[np.float64]:
        """Return the covariance of the lines due to the map error, to first order."""
        step = 1e-4
        poses = self.pose + step * np.array([np.eye(3), -np.eye(3)])  # (2, 3, 3)
        ahead, behind = self(poses.reshape(6, 3)).reshape(2, 3, -1, len(PARAMETERS))
        J_line_pose = (ahead - behind) / (2 * step)  # (3, L, 4)
        pose_sigma = np.array([error.offset_sigma, error.offset_sigma, error.heading_sigma])
        J = J_line_pose * pose_sigma[:, None, None]
        cov = np.einsum("klm,kln->lmn", J, J)
        mean = self(self.pose[None]).reshape(-1, len(PARAMETERS))
        for i, points in enumerate(self.points):
            unit_cov = _fit_cov(points, mean[i], self._centre[i, 0], self._half[i])
            cov[i] += error.point_sigma**2 * unit_cov
        return cov.reshape(*self._trailing, len(PARAMETERS), len(PARAMETERS))

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


def _starts(count: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the index of the first point of each line in the concatenated points."""
    return count.cumsum() - count


def _chords(
    points: NDArray[np.float64], start: NDArray[np.intp], count: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Return the (L, CHORDS, 2) differences between points at equal distances on each line."""
    x, y = (points[1:] - points[:-1]).T
    distance = np.zeros(len(points))
    np.hypot(x, y).cumsum(out=distance[1:])  # includes the steps from one line to the next
    stop = start + count - 1
    marks = distance[start] + _MARKS * (distance[stop] - distance[start])  # (CHORDS + 1, L)
    knots = points[distance.searchsorted(marks).clip(start, stop)]
    return (knots[1:] - knots[:-1]).swapaxes(0, 1)


def _moments(
    points: NDArray[np.float64], start: NDArray[np.intp], count: NDArray[np.intp]
) -> NDArray[np.float64]:
    """Return (L, 49) moments mean(a^i b^j), i and j = 0 .. DEGREE, of the points (a, b)."""
    points = np.ascontiguousarray(points.T)
    powers = np.ones((DEGREE + 1, *points.shape))
    for k in range(DEGREE):
        np.multiply(powers[k], points, out=powers[k + 1])
    a, b = powers[:, 0], powers[:, 1]
    sums = [a[:, i : i + n] @ b[:, i : i + n].T for i, n in zip(start, count, strict=True)]
    return np.array(sums).reshape(len(count), -1) / count[:, None]


def _monomials(turn: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (2 DEGREE + 1, N): c^(6-j) s^j, j = 0 .. 6, and c^(5-j) s^j, j = 0 .. 5, of (c, s)."""
    powers = np.ones((DEGREE + 1, *turn.shape))
    for k in range(DEGREE):
        np.multiply(powers[k], turn, out=powers[k + 1])
    c, s = powers[:, 0], powers[:, 1]
    return np.concatenate([c[::-1] * s, c[-2::-1] * s[:-1]])


def _moments_to_monomials() -> NDArray[np.float64]:
    """Return the (49, 11 (2 DEGREE + 1)) matrix from moments to the sums of rotated points.

    The sums are mean(u^k), k = 0 .. 6, and mean(v u^k), k = 0 .. 3, with u = c a + s b and v = c b
    - s a. Homogenised to degree 5 or 6 in (c, s) with c^2 + s^2 = 1, all are linear combinations of
    13 monomials with integer coefficients. Small rotations cause no cancellation.
    """

    def times(p: NDArray[np.float64], s: int, a: int, b: int) -> NDArray[np.float64]:
        return np.roll(p, (s, a, b), axis=(0, 1, 2))  # p[j, m, n]: coefficient of s^j a^m b^n

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


#: The same for all lines, so computed once.
_MOMENTS_TO_MONOMIALS = _moments_to_monomials()
#: Ends of the chords as shares of the length of a line.
_MARKS = np.linspace(0, 1, CHORDS + 1)[:, None]
#: Rows of the normal equations with their right-hand sides, as indices into the sums.
_NORMAL = np.column_stack([np.add.outer(np.arange(4), np.arange(4)), np.arange(7, 11)])


def _solve_normal(sums: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the (4, ...) solutions of the normal equations, and a mask of the solvable ones.

    The (11, ...) sums are mean(u^k), k = 0 .. 6, and mean(v u^k), k = 0 .. 3. Gaussian elimination
    without pivoting: the matrix is positive definite.
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
    """Return the (4, 4) covariance of a fitted line for unit errors of its points."""
    u, v = points.T
    A = np.vander((u - centre) / half, 4, increasing=True)
    dA = np.column_stack([np.zeros_like(u), A[:, :3] * [1, 2, 3]]) / half
    _, R = np.linalg.qr(A)
    _, beta, c0, c1 = line
    slope = np.tan(beta) + u * (c0 + u * c1 / 2)
    residual = v - lateral(line, u)
    # An error in u acts twice: via the slope of l, and via the change of A's row.
    V = np.linalg.solve(R.T @ R, np.hstack([A.T, dA.T * residual - A.T * slope]))
    # J: derivative of line_of_cubic at the fit; only beta is nonlinear in q, by its arctangent.
    J = line_of_cubic(np.eye(4), np.full(4, centre), np.full(4, half)).T
    J[1] = np.tan(J[1]) * np.cos(beta) ** 2
    return J @ (V @ V.T) @ J.T
