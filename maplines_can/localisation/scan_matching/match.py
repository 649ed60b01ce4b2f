"""Result of a scan matching, and what its methods share."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...values.arrays import floats
from .. import PoseFix

Array = NDArray[np.float64]

#: Fewest points of a scan, and fewest of them and least share that must match the map.
MIN_POINTS, MIN_SHARE = 30, 0.5
#: Standard deviations that are added to those from the points: x, y [m], heading [rad]. They are
#: those of the method, and of what the whole map has in common.
MODEL_SIGMA = (0.02, 0.02, 5e-4)
#: Least curvature of the sum in any direction, as a share of its trace.
MIN_CURVATURE = 1e-9
#: Points of a map are used up to this farther than the points of the scan [m].
MARGIN = 5.0


class ScanMatch(NamedTuple):
    """Pose from a scan; do not use it if ``is_valid`` is false."""

    pose: Array  #: (3,) x [m], y [m], heading [rad]
    cov: Array  #: (3, 3); infinite variances if the scan does not determine the pose
    shared: Array  #: (3, 3) part of ``cov`` that scans of the same surroundings have in common
    used: int  #: number of points that match the map
    is_valid: bool  #: whether the search converged, and enough of the points match the map

    def fix(self, t: float) -> PoseFix:
        """Return the measurement for ``Localisation`` at the time of the scan [s]."""
        return PoseFix(t, self.pose[None], self.cov - self.shared, self.shared)


class Minimum(NamedTuple):
    """Where a sum over the points of a scan is least."""

    pose: Array  #: (3,)
    gradients: Array  #: (m, 3) of the terms
    hessian: Array  #: (3, 3) of the sum
    #: (k, 3, 2) of each object: derivative of the sum of its gradients with respect to a
    #: displacement of its points in the scan
    pulls: Array
    used: int  #: number of points that match the map
    converged: bool  #: whether the search did


def checked(scan: ArrayLike, start: ArrayLike) -> tuple[Array, Array]:
    """Return scan and start as arrays.

    Raises:
        ValueError: a shape is wrong, or a value is not finite.
    """
    points, pose = floats(scan, "scan"), floats(start, "start")
    if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
        raise ValueError(f"scan must be finite with shape (m, 2), got shape {points.shape}")
    if pose.shape != (3,) or not np.isfinite(pose).all():
        raise ValueError(f"start must be finite with shape (3,), got {start!r}")
    return points, pose


def no_match(start: Array, used: int = 0) -> ScanMatch:
    """Return the result of a matching that found no pose."""
    return ScanMatch(start, np.diag([math.inf] * 3), np.zeros((3, 3)), used, is_valid=False)


def placed(scan: Array, pose: Array) -> Array:
    """Return the (m, 2) points of a scan in the map frame."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    return np.asarray(scan @ np.array([[c, s], [-s, c]]) + pose[:2])


def jacobian(scan: Array, heading: float) -> Array:
    """Return the (m, 2, 3) derivatives of the placed points with respect to the pose."""
    c, s = math.cos(heading), math.sin(heading)
    J = np.zeros((len(scan), 2, 3))
    J[:, 0, 0] = J[:, 1, 1] = 1.0
    J[:, 0, 2] = -s * scan[:, 0] - c * scan[:, 1]
    J[:, 1, 2] = c * scan[:, 0] - s * scan[:, 1]
    return J


def result(
    minimum: Minimum, points: int, model_sigma: tuple[float, float, float], map_error: float
) -> ScanMatch:
    """Return the match at the minimum of a sum over the points of a scan.

    The covariance is H^-1 (sum g g') H^-1 with the gradients g of the terms (Huber 1967): their
    scatter replaces a stated noise of the points. Two parts are shared by successive scans: the
    variances of ``model_sigma``, and the error of the map. An object that stands off its place by d
    moves the minimum by H^-1 A d, with the sum A of the pulls of its points; so the errors of many
    objects around the car average out, and those of a few do not.

    Args:
        minimum: found.
        points: number m of the points of the scan.
        model_sigma: standard deviations of x, y [m] and heading [rad].
        map_error: standard deviation of the place of each object, in each direction [m].

    Raises:
        ValueError: ``map_error`` is negative or not finite.
    """
    if not 0 <= map_error < math.inf:
        raise ValueError(f"map_error must be finite and 0 m or more, got {map_error!r}")
    pose, gradients, hessian, pulls, used, converged = minimum
    if np.linalg.eigvalsh(hessian)[0] <= MIN_CURVATURE * np.trace(hessian):
        return no_match(pose, used)
    inverse = np.linalg.inv(hessian)
    moved = map_error * inverse @ pulls  # (k, 3, 2)
    shared = (moved @ moved.transpose(0, 2, 1)).sum(axis=0) + np.diag(np.square(model_sigma))
    cov = inverse @ (gradients.T @ gradients) @ inverse + shared
    is_valid = converged and used >= max(MIN_POINTS, MIN_SHARE * points)
    return ScanMatch(pose, (cov + cov.T) / 2, (shared + shared.T) / 2, used, is_valid)


def by_object(objects: NDArray[np.intp], pulls: Array) -> Array:
    """Return the (k, 3, 2) sums of the (m, 3, 2) pulls of points over their objects."""
    _, row = np.unique(objects, return_inverse=True)
    sums = np.zeros((row.max(initial=-1) + 1, 3, 2))
    np.add.at(sums, row, pulls)
    return sums
