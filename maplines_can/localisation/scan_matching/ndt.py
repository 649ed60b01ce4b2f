"""Scan matching by the normal distributions transform in two dimensions (Biber, Strasser 2003)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

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

#: Sizes of the cells, and the standard deviation that is added to each [m], from coarse to fine. A
#: wall is thin however large the cell, so a start beside it needs the first one; the last one is
#: that of the noise of the points.
LEVELS = ((3.0, 0.5), (2.0, 0.15), (1.0, 0.05))
#: Fewest points of a cell, and the ratio of its variances below which it is a wall: it then says
#: nothing of the place along it.
MIN_IN_CELL, WALL_RATIO = 3, 0.02
#: Most steps of each level, and the greatest one of a search that has converged [m, rad].
STEPS, LAST_STEP = 30, 1e-3
#: Likelihood of a point in its cell above which it counts as one of the map.
MIN_LIKELIHOOD = 0.1


class Cells(NamedTuple):
    """Gaussians of the cells of one grid."""

    low: Array  #: (2,) corner [m]
    size: float
    shape: tuple[int, int]
    row: NDArray[np.intp]  #: (cells,) row of the Gaussian of each cell, -1 without one
    mean: Array  #: (g, 2)
    information: Array  #: (g, 2, 2)

    def of(self, points: Array) -> NDArray[np.intp]:
        """Return the (m,) rows of the Gaussians of points, -1 without one."""
        i, j = np.floor((points - self.low) / self.size).astype(int).T
        inside = (i >= 0) & (i < self.shape[0]) & (j >= 0) & (j < self.shape[1])
        return np.where(inside, self.row[np.where(inside, i * self.shape[1] + j, 0)], -1)


def match_ndt(
    reference: ScanReference,
    scan: ArrayLike,
    start: ArrayLike,
    model_sigma: tuple[float, float, float] = MODEL_SIGMA,
    map_error: float = 0.0,
) -> ScanMatch:
    """Return the pose at which a scan fits the map best, by NDT.

    Four overlapping grids divide the points of the map into cells with a Gaussian each. The score
    is the sum of the likelihoods of the points of the scan in the Gaussians of their cells; a
    point that the map does not have contributes nothing. The result of coarse cells is the start
    for fine ones. The search is that of Gauss and Newton with the likelihoods as weights: the
    score jumps where points change cells, and a line search ends there.

    Args:
        reference: surfaces of the map.
        scan: (m, 2) points in the ego frame [m].
        start: (3,) pose from which the search begins; within about 1.5 m and some degrees.
        model_sigma: standard deviations of what all scans have in common: x, y [m], heading [rad].
        map_error: standard deviation of the place of each house and pole, in each direction [m].

    Raises:
        ValueError: a shape is wrong, or a value is not finite or negative.
    """
    scan, start = checked(scan, start)
    if len(scan) < MIN_POINTS:
        return no_match(start)
    reach = float(np.hypot(*scan.T).max()) + MARGIN
    points, _ = reference.near(start[:2], reach)
    origin = np.array([*start[:2], 0.0])
    pose = start - origin
    if len(points) < MIN_IN_CELL:
        return no_match(start)
    for size, sigma in LEVELS:
        grids = [
            cells_of(points - origin[:2], size, np.array(shift) * size, sigma)
            for shift in ((0, 0), (0.5, 0), (0, 0.5), (0.5, 0.5))
        ]
        score = LikelihoodScore(scan, grids)
        for _ in range(STEPS):
            step = np.linalg.lstsq(score.normal_matrix(pose), -score.gradient(pose), rcond=None)[0]
            pose = pose + step
            if is_last := bool(np.abs(step).max() < LAST_STEP):
                break
    gradients, used = score.terms(pose)
    pulls = by_object(reference.objects_at(placed(scan, pose) + origin[:2]), score.pulls(pose))
    minimum = Minimum(pose + origin, gradients, score.hessian(pose), pulls, used, is_last)
    return result(minimum, len(scan), model_sigma, map_error)


class LikelihoodScore:
    """Negative NDT score of a scan as a function of the pose, with its derivatives."""

    def __init__(self, scan: Array, grids: list[Cells]) -> None:
        self._scan, self._grids = scan, grids

    def value(self, pose: Array) -> float:
        """Return the negative score."""
        placed_ = placed(self._scan, pose)
        return -sum(float(self.likelihood(placed_, one)[0].sum()) for one in self._grids)

    def gradient(self, pose: Array) -> Array:
        """Return the (3,) gradient."""
        return np.asarray(self.terms(pose)[0].sum(axis=0))

    def terms(self, pose: Array) -> tuple[Array, int]:
        """Return the (m, 3) gradients of the points, and how many of them match the map."""
        J, at = jacobian(self._scan, pose[2]), placed(self._scan, pose)
        found, best = np.zeros((len(at), 3)), np.zeros(len(at))
        for one in self._grids:
            e, weighted, _ = self.likelihood(at, one)
            found += (e[:, None, None] * weighted[:, None] @ J)[:, 0]
            best = np.maximum(best, e)
        return found, int((best > MIN_LIKELIHOOD).sum())

    def pulls(self, pose: Array) -> Array:
        """Return the (m, 3, 2) derivatives of the gradients with respect to the placed points."""
        J, at = jacobian(self._scan, pose[2]), placed(self._scan, pose)
        found = np.zeros((len(at), 3, 2))
        for one in self._grids:
            e, weighted, information = self.likelihood(at, one)
            curvature = information - weighted[:, :, None] * weighted[:, None]
            found += e[:, None, None] * (J.transpose(0, 2, 1) @ curvature)
        return found

    def normal_matrix(self, pose: Array) -> Array:
        """Return the (3, 3) part of the Hessian that is positive semidefinite."""
        J, at = jacobian(self._scan, pose[2]), placed(self._scan, pose)
        found = np.zeros((3, 3))
        for one in self._grids:
            e, _, information = self.likelihood(at, one)
            found += np.einsum("m,mik,mij,mjl->kl", e, J, information, J)
        return found

    def hessian(self, pose: Array) -> Array:
        """Return the (3, 3) second derivatives (Biber and Strasser, eq. 12)."""
        J, at = jacobian(self._scan, pose[2]), placed(self._scan, pose)
        turned = pose[:2] - at  # second derivative of the points with respect to the heading
        H = self.normal_matrix(pose)
        for one in self._grids:
            e, weighted, _ = self.likelihood(at, one)
            g = (weighted[:, None] @ J)[:, 0]
            H -= (e[:, None] * g).T @ g
            H[2, 2] += (e * (weighted * turned).sum(axis=1)).sum()
        return H

    @staticmethod
    def likelihood(at: Array, cells: Cells) -> tuple[Array, Array, Array]:
        """Return (m,) likelihoods, (m, 2) S^-1 q, and (m, 2, 2) S^-1; 0 without a cell."""
        row = cells.of(at)
        q = at - cells.mean[row]
        information = cells.information[row]
        weighted = (information @ q[..., None])[..., 0]
        e = np.where(row >= 0, np.exp(-(q * weighted).sum(axis=1) / 2), 0.0)
        return e, weighted, information


def cells_of(points: Array, size: float, shift: Array, sigma: float) -> Cells:
    """Return the Gaussians of the cells of a grid, with a standard deviation added [m]."""
    low = points.min(axis=0) - shift
    i, j = np.floor((points - low) / size).astype(int).T
    shape = int(i.max()) + 1, int(j.max()) + 1
    cell, inverse, count = np.unique(i * shape[1] + j, return_inverse=True, return_counts=True)
    mean = np.column_stack([np.bincount(inverse, values) for values in points.T]) / count[:, None]
    d = points - mean[inverse]
    pairs = ((0, 0), (0, 1), (1, 1))
    xx, xy, yy = (np.bincount(inverse, d[:, a] * d[:, b]) / count for a, b in pairs)
    cov = np.stack([np.stack([xx, xy], -1), np.stack([xy, yy], -1)], -2)
    values, vectors = np.linalg.eigh(cov)
    # Along a wall, the points of a scan are denser where the car is nearer; that would pull.
    weight = np.ones(values.shape)
    weight[values[:, 0] < WALL_RATIO * values[:, 1], 1] = 0.0
    weight /= values + sigma**2
    information = (vectors * weight[:, None]) @ vectors.transpose(0, 2, 1)
    keep = count >= MIN_IN_CELL
    row = np.full(shape[0] * shape[1], -1)
    row[cell[keep]] = np.arange(keep.sum())
    # A last Gaussian for the points without a cell, so that the row -1 exists.
    return Cells(
        low,
        size,
        shape,
        row,
        np.vstack([mean[keep], np.zeros(2)]),
        np.concatenate([information[keep], np.zeros((1, 2, 2))]),
    )
