"""Refit: from the pose of the car to the parameters of a line, for many poses at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import IllPosedError
from ..line import STATES, line_of_cubic
from ..polyline import Polyline, to_ego

__all__ = ["MapError", "Refit"]

#: The sums of the normal equations are trigonometric polynomials of degree 6 in
#: the turn of the car, so their values at 13 angles determine them.
DEGREE = 6
#: Poses worked on at a time: what one block needs stays in the processor's cache.
BLOCK = 2048
#: Chords that stand for the course of a line where its doubling back is judged.
CHORDS = 16
#: The chords must advance along the car's x axis by this share of the line's
#: length (the window lies within 80 deg of the axis) ...
LEAST_ADVANCE = 0.17
#: ... and by this share of their whole way along it (at most a third leads back).
LEAST_PROGRESS = 1 / 3


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
        self.pose = np.array(pose, dtype=float)
        if self.pose.shape != (3,) or not np.isfinite(self.pose).all():
            raise ValueError(f"pose must be finite with shape (3,), got {self.pose!r}")
        x_min, x_max = window
        if not x_min < x_max:
            raise ValueError(f"window must have x_min < x_max [m], got {window}")
        single = isinstance(polyline, Polyline)
        lines = [polyline] if isinstance(polyline, Polyline) else list(polyline)
        if not lines:
            raise ValueError("polyline must be a Polyline or a sequence of at least one")
        #: (n, 2) points of each line in the window, in the frame of the mean pose [m].
        self.points = [to_ego(line.window(self.pose, x_min, x_max), self.pose) for line in lines]
        for points in self.points:
            if len(points) < len(STATES):
                raise IllPosedError(
                    f"a cubic needs 4 points, but the line has {len(points)} in the window "
                    f"[{x_min:g}, {x_max:g}] m of the pose; widen the window or resample the line"
                )
        self._trailing = () if single else (len(lines),)
        start = np.append(0, np.cumsum([len(points) for points in self.points[:-1]])).astype(int)
        low, high = (f.reduceat(np.vstack(self.points), start) for f in (np.minimum, np.maximum))
        self._centre = (low + high) / 2  # (L, 2)
        self._half = (high[:, 0] - low[:, 0]) / 2  # (L,)
        if not self._half.all():
            self._refuse(self.pose, window)
        self._chords = np.stack([_chords(points) for points in self.points], axis=1)
        self._coefficients = self._harmonic_sums(start)
        mean = self(self.pose[None])
        if np.isnan(mean).any():
            self._refuse(self.pose, window)
        #: (4, 4), or (L, 4, 4): covariance that the map's own error adds to a line.
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
        poses = np.asarray(poses, dtype=float)
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
        c0, s0 = np.cos(self.pose[2]), np.sin(self.pose[2])
        c, s = np.cos(d[:, 2]), np.sin(d[:, 2])
        # Centre of the points as seen from each pose.
        x = self._centre[:, :1] - (c0 * d[:, 0] + s0 * d[:, 1])  # (L, N)
        y = self._centre[:, 1:] - (c0 * d[:, 1] - s0 * d[:, 0])
        centre_u, centre_v = c * x + s * y, c * y - s * x
        sums = np.tensordot(self._coefficients, _harmonics(c, s), axes=(0, 0))  # (11, L, N)
        q = self._half[:, None] * _solve_normal(sums)  # (4, L, N)
        q[0] += centre_v
        lines = line_of_cubic(q, centre_u, self._half[:, None])  # (L, N, 4)
        advance = np.tensordot(np.array([c, s]), self._chords, axes=(0, 0))  # (N, L, CHORDS)
        net, way = np.abs(advance.sum(axis=-1)), np.abs(advance).sum(axis=-1)
        length = np.hypot(*self._chords).sum(axis=-1)
        posed = (net >= LEAST_ADVANCE * length) & (net >= LEAST_PROGRESS * way)  # (N, L)
        return np.where(posed[..., None], np.moveaxis(lines, 0, 1), np.nan)

    def _harmonic_sums(self, start: NDArray[np.intp]) -> NDArray[np.float64]:
        """Harmonics of the sums of the normal equations, of centred and scaled points.

        Returns:
            (2 DEGREE + 1, 11, L): of mean(u^k), k = 0 .. 6, and mean(v u^k), k = 0 .. 3, with
            (u, v) the points turned by -t, as functions of t.
        """
        count = np.diff(start, append=sum(map(len, self.points)))
        scaled = (np.vstack(self.points) - self._centre.repeat(count, axis=0)) / self._half.repeat(
            count
        )[:, None]
        t = 2 * np.pi * np.arange(2 * DEGREE + 1) / (2 * DEGREE + 1)
        c, s = np.cos(t), np.sin(t)
        u = np.outer(c, scaled[:, 0]) + np.outer(s, scaled[:, 1])  # (2 DEGREE + 1, n)
        v = np.outer(c, scaled[:, 1]) - np.outer(s, scaled[:, 0])
        powers = [np.ones_like(u)]
        for _ in range(DEGREE):
            powers.append(powers[-1] * u)
        terms = powers + [v * power for power in powers[:4]]
        values = np.array([np.add.reduceat(term, start, axis=1) for term in terms]) / count
        weight = np.where(np.arange(len(t)) == 0, 1, 2) / len(t)  # discrete orthogonality
        return np.einsum("h,ht,stl->hsl", weight, _harmonics(c, s), values)

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
            unit_cov = _fit_cov(points[:, 0], mean[i], self._centre[i, 0], self._half[i])
            cov[i] += error.point_sigma**2 * unit_cov
        return cov.reshape(*self._trailing, len(STATES), len(STATES))

    def _refuse(self, pose: NDArray[np.float64], window: tuple[float, float] | None) -> None:
        where = "" if window is None else f" in the window [{window[0]:g}, {window[1]:g}] m"
        raise IllPosedError(
            f"the points of the line{where} double back or stand across the car at the pose "
            f"({pose[0]:g} m, {pose[1]:g} m, {np.degrees(pose[2]):g} deg), so no cubic y(x) "
            "follows them; shorten the window or check the heading"
        )


def _chords(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2, CHORDS) differences between points that divide a line evenly."""
    way = np.append(0.0, np.hypot(*np.diff(points, axis=0).T).cumsum())
    knots = np.searchsorted(way, np.linspace(0, way[-1], CHORDS + 1)).clip(max=len(points) - 1)
    return np.diff(points[knots], axis=0).T


def _harmonics(c: NDArray[np.float64], s: NDArray[np.float64]) -> NDArray[np.float64]:
    """(2 DEGREE + 1, N): 1, cos kt, sin kt for k = 1 .. DEGREE, of cos t and sin t."""
    rows = [np.ones_like(c), c, s]
    for _ in range(DEGREE - 1):
        ck, sk = rows[-2:]
        rows += [ck * c - sk * s, sk * c + ck * s]
    return np.array(rows)


def _solve_normal(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, ...) cubic of the normal equations, by Cholesky on their Hankel matrix.

    Args:
        sums: (11, ...): mean(u^k), k = 0 .. 6, then mean(v u^k), k = 0 .. 3.
    """
    m, r = sums[:7], sums[7:]
    L: list[list[NDArray[np.float64]]] = []
    z: list[NDArray[np.float64]] = []
    with np.errstate(invalid="ignore", divide="ignore"):  # ill-posed poses are weeded out later
        for i in range(4):
            row: list[NDArray[np.float64]] = []
            for j in range(i):
                rest = m[i + j] - sum(row[k] * L[j][k] for k in range(j))
                row.append(rest / L[j][j])
            row.append(np.sqrt(m[2 * i] - sum(x * x for x in row)))
            L.append(row)
            z.append((r[i] - sum(row[k] * z[k] for k in range(i))) / row[i])
        q = [np.empty(0)] * 4
        for i in reversed(range(4)):
            q[i] = (z[i] - sum(L[k][i] * q[k] for k in range(i + 1, 4))) / L[i][i]
    return np.array(q)


def _fit_cov(
    u: NDArray[np.float64], line: NDArray[np.float64], centre: float, half: float
) -> NDArray[np.float64]:
    """(4, 4) covariance of a fitted line for unit errors of its points in any direction."""
    w = (u - centre) / half
    _, R = np.linalg.qr(np.vander(w, 4, increasing=True))
    _, beta, c0, c1 = line
    # An error along u acts as the slope times as much along v.
    slope = np.tan(beta) + u * (c0 + u * c1 / 2)
    V = np.linalg.solve(R.T @ R, np.vander(w, 4, increasing=True).T * np.sqrt(1 + slope**2))
    # J: derivative of line_of_cubic at the fit; linear in q but for beta's arctangent.
    J = line_of_cubic(np.eye(4), np.full(4, centre), np.full(4, half)).T
    J[1] = np.tan(J[1]) * np.cos(beta) ** 2
    return J @ (V @ V.T) @ J.T
