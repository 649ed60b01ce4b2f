"""Lines as functions of the pose from which they are seen."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import floats
from .cubics import Poses, derivatives, fit_points, is_function, points_of, refitted
from .elementary import sin_cos, tan
from .errors import IllPosedError
from .fixed_order import product, row_total
from .linalg import square_root
from .line import check_window

#: Standard deviations of the pose error by which the range of a line is shortened at an end, so
#: that the line seen from the true pose ends beyond it.
MARGIN = 3.0
#: Points of a line of the map to which a cubic is fitted, in the normalised variable w. They are
#: denser near the ends of the range, as the extrema of a Chebyshev polynomial, so that the largest
#: deviation of the least-squares fit is near the least possible one.
NODES = sin_cos(np.pi * np.arange(64) / 63)[1][::-1]
#: Points of a line to which a cubic is fitted from another pose, and the weight of both ends. It
#: gives them the share of the whole that they have among ``NODES``.
POINTS, END_WEIGHT = 16, 0.62
#: Chebyshev polynomials T_0 .. T_3, by columns, in terms of w^0 .. w^3.
CHEBYSHEV = np.array([[1.0, 0, -1, 0], [0, 1, 0, -3], [0, 0, 2, 0], [0, 0, 0, 4]])
#: Variances of their coefficients, up to a common factor, for a line of uncertain shape.
SHAPE = np.array([0.0, 0.25, 1.0, 2.0])
#: Halvings of the distance to a pose at which a line is no function of x; then it has a value.
HALVINGS = 60
#: Displacement for derivatives [m, rad].
STEP = 1e-4


class Displacements(NamedTuple):
    """Displacements of the car, with what each line needs of them."""

    poses: NDArray[np.float64]  #: (N, 3) along [m], across [m], heading [rad]
    directed: Poses  #: (N, 1) the same

    @classmethod
    def of(cls, poses: NDArray[np.float64]) -> Displacements:
        """Return (N, 3) displacements."""
        return cls(poses, Poses.of(poses[:, None]))

    def then(self, others: Displacements) -> Displacements:
        """Return these displacements, and others after them."""
        pairs = zip(self.directed, others.directed, strict=True)
        poses = np.concatenate([self.poses, others.poses])
        return Displacements(poses, Poses(*map(np.concatenate, pairs)))


_MEAN = Displacements.of(np.zeros((1, 3)))
_STEPS = Displacements.of(STEP * np.vstack([np.eye(3), -np.eye(3)]))


class PoseSpread(NamedTuple):
    """Sigma points of a pose error: three pairs about the mean."""

    pairs: Displacements  #: 6
    with_mean: Displacements  #: 7: the mean, and the pairs
    with_steps: Displacements  #: 12: the pairs, and the steps of ``SeenLines.jacobian``

    @classmethod
    def of(cls, P: NDArray[np.float64]) -> PoseSpread:
        """Return those of a pose error with the (3, 3) covariance P."""
        root = math.sqrt(len(P)) * square_root(P).T
        pairs = Displacements.of(np.concatenate([root, -root]))
        return cls(pairs, _MEAN.then(pairs), pairs.then(_STEPS))


def bases(means: NDArray[np.float64], fit_ranges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (L, 4, 4) derivatives of lines with respect to their coefficients of T_0 .. T_3.

    These are Chebyshev polynomials in the normalised variable w, -1 to 1 in the range. An error of
    1 m of any coefficient moves the line by up to 1 m.

    Args:
        means: (L, 4) lines.
        fit_ranges: (L, 2) ranges [m].
    """
    x_min, x_max = fit_ranges.T
    shape = (4, 4, len(means))
    q = np.broadcast_to(CHEBYSHEV[:, :, None], shape)
    J = derivatives(q, np.broadcast_to((x_min + x_max) / 2, shape[1:]), (x_max - x_min) / 2)
    J = J.transpose(1, 2, 0).copy()  # (L, parameters, coefficients)
    _, cosine = sin_cos(means[:, 1])
    J[:, 1] *= (cosine * cosine)[:, None]
    return J


def extended(
    values: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    poses: NDArray[np.float64],
    mean_pose: NDArray[np.float64],
    found: NDArray[np.float64] | None = None,
) -> NDArray[np.float64]:
    """Return the (N, L, 4) values of a function at (N, 3) poses, also where it has none (NaN).

    These are extrapolated linearly from the mean pose through the farthest pose with a value that
    halving the distance finds, so that a transform keeps the spread in that direction.

    Args:
        values: the function.
        poses: where its values are wanted.
        mean_pose: where it has a value.
        found: ``values(poses)``, if that is known.

    Raises:
        IllPosedError: the function has no value at the mean pose or next to it.
    """
    found = values(poses) if found is None else found
    missing = np.isnan(found[..., 0])
    if not missing.any():
        return found
    mean = values(mean_pose[None])
    share = 1.0
    for _ in range(HALVINGS):
        share /= 2
        rows = np.flatnonzero(missing.any(axis=1))
        inner = values(mean_pose + share * (poses[rows] - mean_pose))
        filled = mean + (inner - mean) / share
        found[rows] = np.where(missing[rows][..., None], filled, found[rows])
        missing = np.isnan(found[..., 0])
        if not missing.any():
            return found
    raise IllPosedError("a line is not a function of x, seen from the mean pose")


class SeenLines:
    """Function from a displacement of the car to the cubics that lines are, seen from there.

    The lines are given as cubics, and most of what these leave of the lines of the map: a multiple
    of the Chebyshev polynomial T_4. It matters to a line in a bend that is seen from a turned car.
    For each displacement, points of the lines are transformed to the new frame, and cubics are
    fitted (see ``transform_line``). Where a line is not a function of x, its value is extrapolated.

    Args:
        means: (L, 4) lines [m, rad, 1/m, 1/m^2].
        fit_ranges: (L, 2) ranges in which cubics are fitted to them [m].
        quartics: (L,) coefficients of T_4 in these ranges [m]; None for 0.

    Raises:
        ValueError: a shape is wrong, or a range is empty.
        IllPosedError: a line is nearly perpendicular to the x axis within its range.

    >>> seen = SeenLines([[1.75, 0, 0, 0], [-1.75, 0, 0, 0]], [[-20, 80], [-20, 60]])
    >>> seen([[0, 0.5, 0]]).round(9)[0, :, 0]
    array([ 1.25, -2.25])
    """

    def __init__(
        self, means: ArrayLike, fit_ranges: ArrayLike, quartics: ArrayLike | None = None
    ) -> None:
        self.means, self.fit_ranges = floats(means, "means"), floats(fit_ranges, "fit_ranges")
        lines = len(self.means)
        if self.means.shape != (lines, 4) or self.fit_ranges.shape != (lines, 2):
            raise ValueError(
                "means must be (L, 4) and fit_ranges (L, 2), got "
                f"{self.means.shape} and {self.fit_ranges.shape}"
            )
        self.quartics = floats(np.zeros(lines) if quartics is None else quartics, "quartics")
        if self.quartics.shape != (lines,):
            raise ValueError(f"quartics must be (L,), got {self.quartics.shape}")
        check_window(self.fit_ranges[:, 0], self.fit_ranges[:, 1], POINTS)
        #: x and y of (K, L) points of the lines.
        self.points = self._points_of(self.means)
        if not is_function(*self.points).all():
            raise IllPosedError("a line is nearly perpendicular to the x axis in its range")

    @np.errstate(over="ignore", invalid="ignore")
    def _points_of(
        self, means: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return x and y of (K, L) points of lines."""
        window = self.fit_ranges[:, 0], self.fit_ranges[:, 1]
        return points_of(means, window, self.quartics, fit_points(POINTS, END_WEIGHT), 1)

    @np.errstate(over="ignore", invalid="ignore")
    def _refitted(self, poses: Poses) -> NDArray[np.float64]:
        x, y = (values[:, None] for values in self.points)
        return refitted(x, y, poses, fit_points(POINTS, END_WEIGHT).weights)

    def _values(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._refitted(Poses.of(poses[:, None]))

    def _seen(self, after: Displacements) -> NDArray[np.float64]:
        found = self._refitted(after.directed)
        return extended(self._values, after.poses, np.zeros(3), found)

    def __call__(self, displacements: ArrayLike) -> NDArray[np.float64]:
        """Return the (N, L, 4) lines seen after (N, 3) displacements [m, m, rad]."""
        return self._seen(Displacements.of(floats(displacements, "displacements")))

    def jacobian(self) -> NDArray[np.float64]:
        """Return the (L, 4, 3) derivatives of the lines with respect to the displacement."""
        return _slopes(self._seen(_STEPS))

    def centred(self, P: NDArray[np.float64]) -> SeenLines:
        """Return the lines as seen from the mean pose, if these are their means over pose errors.

        The means over a pose error with the (3, 3) covariance P differ a little from the lines that
        are seen from the mean pose. These are found in two iterations: each takes off the means
        given by how much the mean of what the sigma points see exceeds the lines so far. A line
        that an iteration makes no function of x, since the pose error is so large, stays as it is.
        """
        pairs = PoseSpread.of(P).pairs
        return self._centred(pairs, self._seen(pairs))

    def _centred(self, pairs: Displacements, seen: NDArray[np.float64]) -> SeenLines:
        """Return ``centred`` of what is seen after the displacements of the sigma points."""
        lines = self
        for _ in range(2):
            if lines is not self:
                seen = lines._seen(pairs)
            centred = self.means - (_mean(seen) - lines.means)
            points = self._points_of(centred)
            found = is_function(*points)
            if not found.all():
                centred = np.where(found[:, None], centred, lines.means)
                points = (points[0], np.where(found, points[1], lines.points[1]))
            lines = copy(self)  # without the check, which these have just passed
            lines.means, lines.points = centred, points
        return lines

    def spread(self, P: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (4 L, 4 L) joint covariance of the lines for a pose error with covariance P.

        It is positive semidefinite: A A^T with the factor A of ``spread_factor``.
        """
        A = self.spread_factor(PoseSpread.of(P))
        return product(A, A.T)

    def spread_factor(self, points: PoseSpread) -> NDArray[np.float64]:
        """Return the (4 L, 7) factor of the joint covariance for a pose error.

        Its columns are deviations of 7 sigma points, which go through all lines at once. The lines
        of this object are the means over the pose error, see ``centred``.
        """
        return self._spread_factor(points, self._seen(points.pairs))

    def spread_and_jacobian(
        self, points: PoseSpread
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return ``spread_factor`` and ``jacobian``: faster, as both begin with the same lines."""
        seen = self._seen(points.with_steps)
        n = len(points.pairs.poses)
        return self._spread_factor(points, seen[:n]), _slopes(seen[n:])

    def _spread_factor(self, points: PoseSpread, seen: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return ``spread_factor`` of what is seen after the displacements of the sigma points."""
        centred = self._centred(points.pairs, seen)
        values = centred._seen(points.with_mean)  # noqa: SLF001 - of this class, too
        d = values.reshape(len(values), -1)
        d = d[1:] - d[0]
        mean = _mean(d)
        # The centre has the weights 0 in the mean and 2 in the covariance.
        deviations = (d - mean) / math.sqrt(len(d))
        return np.concatenate([deviations, math.sqrt(2) * mean[None]]).T


def _slopes(seen: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (L, 4, 3) derivatives of the lines that are seen after steps ahead and back."""
    ahead, back = seen.reshape(2, 3, -1, 4)
    return ((ahead - back) / (2 * STEP)).transpose(1, 2, 0)


def _mean(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (...,) means over the first axis."""
    return row_total(values) / len(values)


def margins(P: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (..., 2) distances by which pose errors shorten the ranges of lines [m].

    Args:
        P: (..., 3, 3) covariance of the pose in the ego frame, and of what of the error of the map
            acts as a pose error.
        ends: (..., 2, 2) x and y of both ends of each line in the ego frame [m].
    """
    x, y = ends[..., 0], ends[..., 1]
    along, both, heading = P[..., 0, 0, None], P[..., 0, 2, None], P[..., 2, 2, None]
    along_sigma = np.sqrt(np.maximum(along - 2 * y * both + y * y * heading, 0.0))
    # A turned car sees the end of a line at x at about x cos(turn), which is nearer.
    _, cosine = sin_cos(np.minimum(MARGIN * np.sqrt(heading), math.pi / 2))
    shortening = 1 - cosine
    return np.asarray(MARGIN * along_sigma + shortening * np.abs(x))


def valid_ranges(
    means: NDArray[np.float64],
    fit_ranges: NDArray[np.float64],
    P: NDArray[np.float64],
    specific_covs: NDArray[np.float64],
    heading_sigma: ArrayLike,
) -> NDArray[np.float64]:
    """Return the (L, 2) ranges in which lines are valid, within those in which they were fitted.

    A range leaves room for the errors of the pose and of the map: the line seen from the true pose
    does not end before it.

    Args:
        means: (L, 4) lines.
        fit_ranges: (L, 2) [m].
        P: (3, 3) covariance of the pose in the ego frame.
        specific_covs: (L, 4, 4) line-specific covariances; the variance of the lateral position in
            the middle of the range is taken to act along the line, too.
        heading_sigma: of the map, (L,) or one for all [rad].
    """
    y_off, beta, c0, c1 = means.T[..., None]
    slope = tan(beta)

    def lateral(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return y_off + x * (slope + x * (c0 / 2 + x * c1 / 6))

    middle = (fit_ranges[:, :1] + fit_ranges[:, 1:]) / 2
    square = middle * middle
    by_slope = (1 + slope * slope) * middle
    columns = np.ones_like(middle), by_slope, square / 2, square * middle / 6
    J = np.concatenate(columns, axis=1)[:, None]
    shift = product(product(J, specific_covs), J.mT)[:, 0, 0]
    own = np.zeros((len(means), 3, 3))
    own[:, 0, 0], own[:, 1, 1], own[:, 2, 2] = shift, shift, np.square(heading_sigma)
    ends = np.concatenate([fit_ranges[..., None], lateral(fit_ranges)[..., None]], axis=-1)
    return np.asarray(fit_ranges + margins(P + own, ends) * [1, -1])
