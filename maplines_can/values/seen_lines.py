"""Lines as functions of the pose from which they are seen."""

from __future__ import annotations

import math
from collections.abc import Callable
from copy import copy

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arrays import floats
from .errors import IllPosedError
from .linalg import square_root
from .line import check_window, lateral, lateral_jacobian, line_of_cubic, transformed

#: Standard deviations of the pose error by which the range of a line is shortened at an end, so
#: that the line seen from the true pose ends beyond it.
MARGIN = 3.0
#: Points of a line of the map to which a cubic is fitted, in the normalised variable w. They are
#: denser near the ends of the range, as the extrema of a Chebyshev polynomial, so that the largest
#: deviation of the least-squares fit is near the least possible one.
NODES = np.cos(np.pi * np.arange(64) / 63)[::-1]
#: Points of a line to which a cubic is fitted from another pose, and the weight of both ends. It
#: gives them the share of the whole that they have among ``NODES``.
POINTS, END_WEIGHT = 16, 0.62
#: Chebyshev polynomials T_0 .. T_3, by columns, in terms of w^0 .. w^3.
CHEBYSHEV = np.array([[1.0, 0, -1, 0], [0, 1, 0, -3], [0, 0, 2, 0], [0, 0, 0, 4]])
#: Variances of their coefficients, up to a common factor, for a line of uncertain shape.
SHAPE = np.array([0.0, 0.25, 1.0, 2.0])
#: Halvings of the distance to a pose at which a line is no function of x; then it has a value.
HALVINGS = 60


def bases(means: NDArray[np.float64], fit_ranges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (L, 4, 4) derivatives of lines with respect to their coefficients of T_0 .. T_3.

    These are Chebyshev polynomials in the normalised variable w, -1 to 1 in the range. An error of
    1 m of any coefficient moves the line by up to 1 m.

    Args:
        means: (L, 4) lines.
        fit_ranges: (L, 2) ranges [m].
    """
    centre, half = fit_ranges.mean(axis=1), np.diff(fit_ranges, axis=1)[:, 0] / 2
    shape = (4, 4, len(means))
    q = np.broadcast_to(CHEBYSHEV[:, :, None], shape)
    J = line_of_cubic(q, np.broadcast_to(centre, shape[1:]), np.broadcast_to(half, shape[1:]))
    J = J.transpose(1, 2, 0).copy()  # (L, parameters, coefficients)
    J[:, 1] = np.tan(J[:, 1]) * np.cos(means[:, 1, None]) ** 2
    return J


def extended(
    values: Callable[[NDArray[np.float64]], NDArray[np.float64]],
    poses: NDArray[np.float64],
    mean_pose: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return the (N, L, 4) values of a function at (N, 3) poses, also where it has none (NaN).

    These are extrapolated linearly from the mean pose through the farthest pose with a value that
    halving the distance finds, so that a transform keeps the spread in that direction.

    Raises:
        IllPosedError: the function has no value at the mean pose or next to it.
    """
    found = values(poses)
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
        if np.isnan(self._values(np.zeros((1, 3)))).any():
            raise IllPosedError("a line is nearly perpendicular to the x axis in its range")

    def _values(self, displacements: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._seen(self.means, displacements[:, None])

    def _seen(
        self, means: NDArray[np.float64], displacement: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        window = self.fit_ranges[:, 0], self.fit_ranges[:, 1]
        return transformed(means, displacement, window, POINTS, self.quartics, END_WEIGHT)

    def __call__(self, displacements: ArrayLike) -> NDArray[np.float64]:
        """Return the (N, L, 4) lines seen after (N, 3) displacements [m, m, rad]."""
        return extended(self._values, floats(displacements, "displacements"), np.zeros(3))

    def jacobian(self) -> NDArray[np.float64]:
        """Return the (L, 4, 3) derivatives of the lines with respect to the displacement."""
        step = 1e-4
        ends = self(step * np.vstack([np.eye(3), -np.eye(3)])).reshape(2, 3, -1, 4)
        return ((ends[0] - ends[1]) / (2 * step)).transpose(1, 2, 0)

    def centred(self, P: NDArray[np.float64]) -> SeenLines:
        """Return the lines as seen from the mean pose, if these are their means over pose errors.

        The means over a pose error with the (3, 3) covariance P differ a little from the lines that
        are seen from the mean pose. These are found in two iterations: each takes off the means
        given by how much the mean of what the sigma points see exceeds the lines so far. A line
        that an iteration makes no function of x, since the pose error is so large, stays as it is.
        """
        points = _sigma_points(P)[1:]
        lines = self
        for _ in range(2):
            centred = self.means - (lines(points).mean(axis=0) - lines.means)
            is_function = ~np.isnan(self._seen(centred, np.zeros(3))[:, :1])
            means = np.where(is_function, centred, lines.means)
            lines = copy(self)  # without the check, which these lines have just passed
            lines.means = means
        return lines

    def spread(self, P: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (4 L, 4 L) joint covariance of the lines for a pose error with covariance P.

        It is that of 7 sigma points, which go through all lines at once, so it is positive
        semidefinite. The lines of this object are the means over the pose error, see ``centred``.

        Args:
            P: (3, 3) in the ego frame: along [m], across [m], heading [rad].
        """
        values = self.centred(P)(_sigma_points(P))
        d = values.reshape(len(values), -1)
        d = d[1:] - d[0]
        mean = d.mean(axis=0)
        # The centre has the weights 0 in the mean and 2 in the covariance.
        return np.asarray((d - mean).T @ (d - mean) / len(d) + 2 * np.outer(mean, mean))


def _sigma_points(P: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (7, 3) sigma points of a pose error, the first of which is 0."""
    root = math.sqrt(len(P)) * square_root(P).T
    return np.vstack([np.zeros(3), root, -root])


def margins(P: NDArray[np.float64], ends: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (..., 2) distances by which pose errors shorten the ranges of lines [m].

    Args:
        P: (..., 3, 3) covariance of the pose in the ego frame, and of what of the error of the map
            acts as a pose error.
        ends: (..., 2, 2) x and y of both ends of each line in the ego frame [m].
    """
    x, y = ends[..., 0], ends[..., 1]
    along, both, heading = P[..., 0, 0, None], P[..., 0, 2, None], P[..., 2, 2, None]
    along_sigma = np.sqrt((along - 2 * y * both + y * y * heading).clip(0))
    # A turned car sees the end of a line at x at about x cos(turn), which is nearer.
    shortening = 1 - np.cos(np.minimum(MARGIN * np.sqrt(heading), math.pi / 2))
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
    ends = np.stack([fit_ranges, lateral(means[:, None], fit_ranges)], axis=-1)
    middle = lateral_jacobian(means, fit_ranges.mean(axis=1))
    shift = np.einsum("li,lij,lj->l", middle, specific_covs, middle)
    own = np.zeros((len(means), 3, 3))
    own[:, 0, 0], own[:, 1, 1], own[:, 2, 2] = shift, shift, np.square(heading_sigma)
    return np.asarray(fit_ranges + margins(P + own, ends) * [1, -1])
