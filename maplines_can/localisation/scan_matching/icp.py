"""Scan matching by the iterative closest point algorithm, point to plane, of small_gicp."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...values.errors import missing_extra
from .match import (
    MARGIN,
    MIN_POINTS,
    MODEL_SIGMA,
    Minimum,
    ScanMatch,
    by_object,
    checked,
    jacobian,
    no_match,
    placed,
    result,
)
from .reference import ScanReference

Array = NDArray[np.float64]

#: Heights to which the points are copied, so that small_gicp finds normals of walls [m].
HEIGHTS = np.arange(-2, 3) * 0.1
#: Largest distance of matching points [m], from coarse to fine.
DISTANCES = (2.0, 0.3)
#: Neighbours from which the normals are computed: a wall is a grid of points every 10 cm.
NEIGHBOURS = 15


def match_icp(
    reference: ScanReference,
    scan: ArrayLike,
    start: ArrayLike,
    model_sigma: tuple[float, float, float] = MODEL_SIGMA,
    map_error: float = 0.0,
) -> ScanMatch:
    """Return the pose at which a scan fits the map best, by point-to-plane ICP.

    Args:
        reference: surfaces of the map.
        scan: (m, 2) points in the ego frame [m].
        start: (3,) pose from which the search begins; within about 1 m and some degrees.
        model_sigma: standard deviations of what all scans have in common: x, y [m], heading [rad].
        map_error: standard deviation of the place of each house and pole, in each direction [m].

    Raises:
        ValueError: a shape is wrong, or a value is not finite or negative.
        MissingExtraError: small_gicp is not installed.
    """
    from scipy.spatial import cKDTree

    small_gicp = _small_gicp()
    scan, start = checked(scan, start)
    if len(scan) < MIN_POINTS:
        return no_match(start)
    reach = float(np.hypot(*scan.T).max()) + MARGIN
    points, normals = reference.near(start[:2], reach)
    if len(points) < NEIGHBOURS:
        return no_match(start)
    points = points - start[:2]
    pose, converged = _aligned(small_gicp, points, scan, start[2])
    at = placed(scan, pose)
    gap, row = cKDTree(points).query(at)
    used = gap <= DISTANCES[-1]
    n = normals[row[used]]
    g = (n[:, None] @ jacobian(scan[used], pose[2]))[:, 0]  # of the distance to the plane
    residual = ((at[used] - points[row[used]]) * n).sum(axis=1)
    objects = reference.objects_at(at[used] + start[:2])
    pulls = by_object(objects, g[:, :, None] * n[:, None])
    pose[2] = start[2] + math.remainder(pose[2] - start[2], 2 * math.pi)
    pose += [*start[:2], 0.0]
    minimum = Minimum(pose, residual[:, None] * g, g.T @ g, pulls, len(g), converged)
    return result(minimum, len(scan), model_sigma, map_error)


def _small_gicp() -> Any:
    try:
        import small_gicp
    except ImportError as error:
        raise missing_extra("matching scans by ICP needs small_gicp", "scan") from error
    return small_gicp


def _aligned(small_gicp: Any, points: Array, scan: Array, heading: float) -> tuple[Array, bool]:
    """Return the (3,) pose at which a scan fits (m, 2) points, and whether the search converged."""
    target, source = (small_gicp.PointCloud(_raised(one)) for one in (points, scan))
    tree = small_gicp.KdTree(target)
    small_gicp.estimate_normals_covariances(target, tree, num_neighbors=NEIGHBOURS)
    small_gicp.estimate_normals_covariances(source, num_neighbors=NEIGHBOURS)
    T, converged = _transform(heading), True
    for distance in DISTANCES:
        found = small_gicp.align(
            target, source, tree, init_T_target_source=T, registration_type="PLANE_ICP",
            max_correspondence_distance=distance, max_iterations=50,
            rotation_epsilon=1e-5, translation_epsilon=1e-4,
        )  # fmt: skip
        T, converged = found.T_target_source, bool(found.converged)
    return np.array([T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0])]), converged


def _raised(points: Array) -> Array:
    """Return (5 m, 3) copies of (m, 2) points at several heights."""
    copies = np.tile(points, (len(HEIGHTS), 1))
    return np.column_stack([copies, np.repeat(HEIGHTS, len(points))])


def _transform(heading: float) -> Array:
    c, s = math.cos(heading), math.sin(heading)
    T = np.eye(4)
    T[:2, :2] = [[c, -s], [s, c]]
    return T
