"""Pose of a car from positions along its odometry, without a pose before.

The way by odometry, turned and shifted as a whole, passes through the positions. The rotation and
the shift of least squares have a closed form (Kabsch 1976); a generalised least-squares step from
there takes the errors into account, with what successive positions have in common: the bias of
GNSS, and the scale and the turn of the odometry. The sum of squares says whether positions and
odometry fit each other at all.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .sensor_errors import SensorErrors

Array = NDArray[np.float64]

#: Fewest positions, shortest time [s] and shortest way [m] from which a pose is taken.
MIN_COUNT, MIN_TIME, MIN_WAY = 8, 4.0, 20.0
#: Variance that each position has at least [m^2], so that exact ones can be compared.
MIN_VARIANCE = 1e-6
#: Longest time over which odometry is taken for one way [s].
MAX_TIME = 15.0
#: Probability that positions and odometry that fit each other are rejected.
FALSE_ALARM = 1e-5


class Position(NamedTuple):
    """A position, and where the car was by its odometry."""

    t: float  #: [s]
    is_gnss: bool  #: whether it has the bias of GNSS
    position: Array  #: (n, 2) x, y [m]; NaN for none
    noise: Array  #: (n, 2, 2) covariance of its white noise [m^2]
    common: Array  #: (n, 2, 2) covariance of what it has in common with the others [m^2]
    odometry: Array  #: (n, 2) x, y of the car by odometry, in some frame that it keeps [m]


class Alignment(NamedTuple):
    """Pose of a car, at the last position."""

    pose: Array  #: (3,) x [m], y [m], heading [rad]
    cov: Array  #: (3, 3)
    bias_cov: Array  #: (3, 2) of the error of the pose and the GNSS bias, which is 0 in the mean
    fits: bool  #: whether positions and odometry fit each other; otherwise, it is no pose


def aligned(
    positions: Sequence[Position], car: int, since: float, pose: Array, errors: SensorErrors
) -> Alignment | None:
    """Return the pose of a car by its last positions; None if they are too few.

    Args:
        positions: in order of time.
        car: index of the car.
        since: time before which they are not used [s].
        pose: (3,) of the car at the last position, in the frame of the odometry.
        errors: of the sensors.
    """
    from scipy.special import chdtri

    chosen = _last(positions, car, since)
    if chosen is None:
        return None
    t = np.array([one.t for one in chosen])
    fixes = np.array([one.position[car] for one in chosen])
    arm = np.array([one.odometry[car] for one in chosen]) - pose[:2]  # (K, 2)
    # The rotation of least squares.
    a, b = arm - arm.mean(axis=0), fixes - fixes.mean(axis=0)
    turn = math.atan2((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum(), (a * b).sum())
    c, s = math.cos(turn), math.sin(turn)
    R = np.array([[c, -s], [s, c]])
    way = arm @ R.T
    across = np.column_stack([-way[:, 1], way[:, 0]])  # derivative by the turn
    K = len(chosen)
    by_pose = np.zeros((K, 2, 3))
    by_pose[:, :, :2], by_pose[:, :, 2] = np.eye(2), across
    J = by_pose.reshape(2 * K, 3)
    place = (fixes - way).mean(axis=0)
    residual = (fixes - way - place).ravel()
    cov, bias = _covariance(chosen, car, t, way, across, errors)
    solved = np.linalg.solve(cov, np.column_stack([J, residual[:, None]]))
    information = J.T @ solved[:, :3]
    step = np.linalg.solve(information, J.T @ solved[:, 3])
    rest = residual - J @ step
    squared = float(rest @ np.linalg.solve(cov, rest))
    P = np.linalg.inv(information)
    # The pose is off by G times the errors of the positions, of which the bias is a part.
    bias_cov = -P @ solved[:, :3].T @ bias
    found = np.array([*place, pose[2] + turn]) + step
    fits = squared <= chdtri(2 * K - 3, FALSE_ALARM)
    return Alignment(found, (P + P.T) / 2, bias_cov, bool(fits))


def _last(positions: Sequence[Position], car: int, since: float) -> list[Position] | None:
    """Return the last positions of a car that are enough, or None."""
    chosen: list[Position] = []
    for one in reversed(positions):
        if np.isnan(one.position[car, 0]):
            continue
        if one.t < since or (chosen and chosen[0].t - one.t > MAX_TIME):
            return None
        chosen.append(one)
        way = math.dist(one.odometry[car], chosen[0].odometry[car])
        if len(chosen) >= MIN_COUNT and chosen[0].t - one.t >= MIN_TIME and way >= MIN_WAY:
            return chosen[::-1]
    return None


def _covariance(
    chosen: list[Position], car: int, t: Array, way: Array, across: Array, errors: SensorErrors
) -> tuple[Array, Array]:
    """Return the (2 K, 2 K) covariance of K positions, and the (2 K, 2) one with the GNSS bias."""
    K, gnss = len(chosen), errors.gnss or errors.UNKNOWN_GNSS
    cov = np.zeros((K, 2, K, 2))
    has_bias = np.array([one.is_gnss for one in chosen])
    share = np.exp(-np.abs(t[:, None] - t) / gnss.time) * np.outer(has_bias, has_bias)
    cov += gnss.sigma**2 * share[:, None, :, None] * np.eye(2)[None, :, None, :]
    both = np.outer(~has_bias, ~has_bias)
    cov += both[:, None, :, None] * chosen[-1].common[car][None, :, None, :]
    for i, one in enumerate(chosen):
        cov[i, :, i] += one.noise[car] + MIN_VARIANCE * np.eye(2)
    # Errors of the odometry: of the scale along, of the yaw rate across, growing to the past.
    for sigma, shape in (
        (errors.wheel_scale.sigma, way),
        (errors.yaw_rate.sigma, across * (t - t[-1])[:, None] / 2),
    ):
        cov += sigma**2 * shape[:, :, None, None] * shape[None, None]
    decay = np.exp(-(t[-1] - t) / gnss.time) * has_bias
    bias = gnss.sigma**2 * decay[:, None, None] * np.eye(2)
    return cov.reshape(2 * K, 2 * K), bias.reshape(2 * K, 2)
