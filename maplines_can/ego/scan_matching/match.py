"""Result of a scan matching, and what its methods share."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...arrays import floats
from ..localisation import PoseFix

Array = NDArray[np.float64]

#: Fewest points of a scan, and fewest of them and least share that must match the map.
LEAST_POINTS, LEAST_SHARE = 30, 0.5
#: Standard deviations that are added to those from the noise of the points: x, y [m], heading
#: [rad]. They are those of the map, whose errors all points of a wall share, and of the method.
MODEL_SIGMA = (0.02, 0.02, 5e-4)
#: Least curvature of the sum in any direction, as a share of its trace.
LEAST_CURVATURE = 1e-9
#: Points of a map are used up to this farther than the points of the scan [m].
MARGIN = 5.0


class ScanMatch(NamedTuple):
    """Pose from a scan; do not use it if ``is_valid`` is false."""

    pose: Array  #: (3,) x [m], y [m], heading [rad]
    cov: Array  #: (3, 3); infinite variances if the scan does not determine the pose
    used: int  #: number of points that match the map
    is_valid: bool  #: whether the search converged, and enough of the points match the map

    def fix(self, t: float) -> PoseFix:
        """Return the measurement for ``Localisation`` at the time of the scan [s]."""
        return PoseFix(t, self.pose[None], self.cov)


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
    return ScanMatch(start, np.diag([math.inf] * 3), used, is_valid=False)


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
    pose: Array,
    gradients: Array,
    hessian: Array,
    scan: Array,
    model_sigma: tuple[float, float, float],
    *,
    used: int,
    converged: bool = True,
) -> ScanMatch:
    """Return the match at the minimum of a sum over points.

    The covariance is H^-1 (sum g g') H^-1 with the gradients g of the terms (Huber 1967): their
    scatter replaces a stated noise of the points. The variances of ``model_sigma`` are added.

    Args:
        pose: (3,) at the minimum.
        gradients: (m, 3) of the terms.
        hessian: (3, 3) of the sum.
        scan: (m, 2).
        model_sigma: standard deviations of x, y [m] and heading [rad].
        used: number of points that match the map.
        converged: whether the search did.
    """
    if np.linalg.eigvalsh(hessian)[0] <= LEAST_CURVATURE * np.trace(hessian):
        return no_match(pose, used)
    inverse = np.linalg.inv(hessian)
    cov = inverse @ (gradients.T @ gradients) @ inverse + np.diag(np.square(model_sigma))
    is_valid = converged and used >= max(LEAST_POINTS, LEAST_SHARE * len(scan))
    return ScanMatch(pose, (cov + cov.T) / 2, used, is_valid)
