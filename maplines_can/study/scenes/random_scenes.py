"""Random scenes, and the fewest bits that their joint covariance takes.

A scene has L lines of a road, seen from a pose like that of a production car. Its joint covariance
is determined by n = 8 + L parameters theta, apart from the road: those of the pose error P = L L^T
in the order heading, across, along (ln L_ii, and t_ij = L_ij / L_ii for j < i), the standard
deviations of the points of the map and of their common offset, and the distance of the points of
each line. theta is uniform in a box, so its entropy h(theta) is known exactly.

If the joint covariance C is sent with a mean KL divergence from the true to the decoded one, and it
is small, then (see ``sweep/limit.py``) no code takes less than

    R(KL) = h(theta) + E log2 sqrt(det F(theta)) - n/2 log2(2 pi e 2 KL / n)  bit
    F_ab  = 1/2 tr(C^-1 dC/dtheta_a C^-1 dC/dtheta_b)

on average. The road, that is, the means, the ranges and the misfits of the cubics, counts as known
to the receiver. A parameter to which C is not sensitive takes no bits; so those whose removal
raises the bound count as known, too. (On a straight road, the error along it cannot be seen.)
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import NDArray

from ...propagation import MapError, map_scene
from ...simulation.street_shapes import Street, StreetPiece
from ...values.gaussian import Gaussian
from ...values.linalg import block_diagonal
from ...values.line import Slot
from ...values.polyline import Polyline
from ...values.scene import Scene
from ...values.seen_lines import SeenLines, bases
from ..sweep.limit import Limit

Array = NDArray[np.float64]

#: Least standard deviation of the coefficients of T_0 .. T_3 in a covariance of levels: about that
#: of the rounding errors of the means [m].
RESOLUTION = 2.0**-9
#: Standard deviations of a production pose: along [m], across [m], heading [deg].
PRODUCTION = (0.1, 0.2, 0.2)
#: Rows of P in the order of the parameters. The error along the road comes last.
ROWS = (2, 1, 0)
#: Greatest factor between the pivots of P and the standard deviations of the production pose.
POSE_FACTOR = 2.0
#: Greatest |t_ij| of P.
RATIO = 0.5
#: Standard deviation of the points of the map, and of their common offset [m].
MAP_ERROR = (0.03, 0.10)
#: Distance of the points of the map [m].
SPACING = (2.0, 20.0)
#: Radius of the road [m].
RADIUS = (60.0, 30_000.0)
#: Width of a lane [m], and offsets of the lines in widths of a lane.
LANE, OFFSETS = 3.5, (0.5, -0.5, 1.5, -1.5, 2.5, -2.5, 3.5, -3.5)
#: Length of the road behind and ahead of the car [m].
BEHIND, AHEAD = 60.0, 140.0
#: Step of a parameter for derivatives.
STEP = 0.1
#: Points at which a line is fitted, in the variable that is -1 to 1 in its range.
NODES = np.cos(np.pi * np.arange(64) / 63)[::-1]
#: Positions of the range relative to the points of the map, over which their noise is averaged.
PHASES = (0.0, 0.25, 0.5, 0.75)


class RandomScene(NamedTuple):
    """Scene with its parameters."""

    scene: Scene
    theta: Array  #: (8 + L,)


def box(lines: int) -> Array:
    """Return the (8 + L, 2) ends of the parameters of scenes with L lines."""
    sigma = np.array(PRODUCTION) * [1, 1, np.pi / 180]
    pivots = np.log(sigma[list(ROWS)])[:, None] + math.log(POSE_FACTOR) * np.array([-1, 1])
    ratios = np.tile([-RATIO, RATIO], (3, 1))
    own = np.log([MAP_ERROR, MAP_ERROR, *[SPACING] * lines])
    return np.concatenate([pivots, ratios, own])


def pose_cov(theta: Array) -> Array:
    """Return the (3, 3) covariance of the pose error of parameters."""
    T = np.eye(3)
    T[1, 0], T[2, 0], T[2, 1] = theta[3:6]
    L = np.exp(theta[:3])[:, None] * T
    return np.asarray((L @ L.T)[np.ix_(ROWS, ROWS)])


def random_scene(lines: int, rng: np.random.Generator) -> RandomScene:
    """Draw a scene with a number of lines; a road on which a line is too short is drawn again."""
    while True:
        low, high = box(lines).T
        theta = rng.uniform(low, high)
        seen, pose = random_road(np.exp(theta[8:]), rng)
        c, d = np.cos(pose[2]), np.sin(pose[2])
        R = np.array([[c, -d, 0], [d, c, 0], [0, 0, 1]])
        cov = R @ pose_cov(theta) @ R.T
        error = MapError(*np.exp(theta[6:8]))
        scene = map_scene(seen, Gaussian(pose, (cov + cov.T) / 2), map_error=error)
        if len(scene.lines) == lines:
            return RandomScene(scene, theta)


def random_road(
    spacings: Sequence[float] | Array, rng: np.random.Generator
) -> tuple[dict[Slot, Polyline], Array]:
    """Draw the lines of a road, with the distances of their points [m], and a pose on it."""
    sharpest = rng.choice([-1, 1]) / np.exp(rng.uniform(*np.log(RADIUS)))
    curvature = sharpest * rng.uniform([0, 0], 1)
    street = Street([StreetPiece(BEHIND + AHEAD, *curvature)], BEHIND)
    seen = {}
    for slot, offset, spacing in zip(Slot, OFFSETS, spacings, strict=False):
        s = np.arange(-BEHIND + spacing * rng.uniform(), AHEAD, spacing)
        seen[slot] = Polyline(street.line(s, LANE * offset))
    return seen, rng.normal([0, 0, 0], [0, 0.3, 0.02])


def noise_floor(means: Array, fit_ranges: Array, resolution: float) -> Array:
    """Return the (4 L, 4 L) covariance of errors of a size in each coefficient of ``bases``."""
    J = bases(means, fit_ranges)
    return block_diagonal(resolution**2 * J @ J.swapaxes(1, 2))


def information(drawn: RandomScene, resolution: float) -> Array:
    """Return the (n, n) Fisher information F of the parameters of a scene.

    Args:
        drawn: the scene.
        resolution: standard deviation in each coefficient of ``bases``, added to its covariance
            [m].
    """
    scene, theta = drawn
    seen = SeenLines(scene.means, scene.fit_ranges)
    count = 4 * len(scene.lines)
    floor = noise_floor(scene.means, scene.fit_ranges, resolution)
    W = np.linalg.inv(np.linalg.cholesky(scene.cov + floor))
    dC = np.zeros((len(theta), count, count))
    for k in range(6):
        step = STEP * np.eye(len(theta))[k]
        ends = (seen.spread(pose_cov(theta + sign * step)) for sign in (1, -1))
        dC[k] = np.subtract(*ends) / (2 * STEP)
    point, offset = np.exp(2 * theta[6:8])
    J = seen.jacobian()[..., :2]
    for i, (mean, fit_range) in enumerate(zip(scene.means, scene.fit_ranges, strict=True)):
        block = np.s_[4 * i : 4 * i + 4]
        noise, longer, shorter = (
            unit_point_cov(mean, fit_range, np.exp(theta[8 + i] + step))
            for step in (0, STEP, -STEP)
        )
        dC[6, block, block] = 2 * point * noise
        dC[7, block, block] = 2 * offset * J[i] @ J[i].T
        dC[8 + i, block, block] = point * (longer - shorter) / (2 * STEP)
    M = (W @ dC @ W.T).reshape(len(theta), -1)
    return np.asarray(M @ M.T / 2)


def unit_point_cov(mean: Array, fit_range: Array, spacing: float) -> Array:
    """Return the (4, 4) covariance of a line for unit errors of points with a spacing [m].

    The errors are averaged by the fit.
    """
    half = (fit_range[1] - fit_range[0]) / 2
    V = np.linalg.pinv(np.vander(NODES, 4, increasing=True))
    N = np.zeros((4, 4))
    for phase in PHASES:
        position = (NODES + 1) * half / spacing + phase
        points = np.arange(math.ceil(position[-1]) + 1)
        W = np.maximum(0, 1 - np.abs(position[:, None] - points))
        N += V @ W @ W.T @ V.T / len(PHASES)
    cubics = (Polynomial(q, fit_range).convert().coef for q in np.eye(4))
    J = np.column_stack([np.resize([*q, 0, 0, 0], 4) for q in cubics]) * [[1], [1], [2], [6]]
    J[1] *= np.cos(mean[1]) ** 2
    return np.asarray(J @ N @ J.T)


def joint_limit(informations: Array, kl: float) -> Limit:
    """Return the bound of the joint covariance of scenes near a mean divergence.

    Args:
        informations: (N, n, n) F of scenes with n - 8 lines.
        kl: of a whole scene [nat].
    """
    widths = np.log2(np.diff(box(informations.shape[-1] - 8), axis=1)[:, 0])

    def limit_of(keep: list[int]) -> Limit:
        F = informations[:, keep][:, :, keep]
        log_det = np.linalg.slogdet(F)[1] / math.log(4)
        se = float(log_det.std() / math.sqrt(len(log_det)))
        return Limit(float(widths[keep].sum() + log_det.mean()), len(keep), se)

    keep = list(range(len(widths)))
    best = limit_of(keep)
    while len(keep) > 1:
        trials = [[k for k in keep if k != dropped] for dropped in keep]
        limits = [limit_of(trial) for trial in trials]
        i = int(np.argmax([limit.bits(kl) for limit in limits]))
        if limits[i].bits(kl) <= best.bits(kl):
            break
        keep, best = trials[i], limits[i]
    return best
