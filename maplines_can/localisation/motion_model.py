"""State of the localisation, and its prediction by wheel speed and yaw rate.

    x, y, heading   pose in the map frame [m, m, rad]
    e_v             error of the wheel speed [m/s]
    b               bias of the yaw rate [rad/s]
    k               error of the wheel scale
    g_e, g_n        error of the GNSS position [m]
    c_y, c_b        errors of the camera: lateral [m], direction [rad]
    m_1, m_2, m_3   error that successive pose fixes share, in units of its covariance

The wheel speed v_w and the yaw rate w_m drive the prediction, as those of an inertial sensor do in
an error-state filter:

    v = (1 + k) v_w - e_v,   w = w_m - b
    d/dt (x, y, heading) = (v cos heading, v sin heading, w)

The speed is no state of its own with the wheel speed as its measurement: that would need a process
noise for what the driver does, which is not white, and the innovations would be as wrong as it is.
Its error e_v is a state instead. All errors are Gauss-Markov processes (``SensorErrors``), those of
the pose fixes over the way of the car: that of the map does not change while the car stands.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .sensor_errors import SensorErrors

Array = NDArray[np.float64]

X, Y, HEADING, SPEED, YAW_RATE, SCALE = range(6)
#: Number of states.
N = 13
POSE, GNSS, CAMERA, FIX = slice(0, 3), slice(6, 8), slice(8, 10), slice(10, 13)
#: Gauss-Markov processes.
ERRORS = slice(3, N)


def initial(
    pose: Array, cov: Array, errors: SensorErrors, processes: Array | None = None
) -> tuple[Array, Array]:
    """Return (n, N) means and (n, N, N) covariances for (n, 3) poses with (n, 3, 3) covariances.

    The processes are as in ``predict``.
    """
    mean, full = np.zeros((len(pose), N)), np.zeros((len(pose), N, N))
    mean[:, POSE] = pose
    full[:, POSE, POSE] = cov
    rows = range(3, N)
    full[:, rows, rows] = (errors.sigmas if processes is None else processes[:, 0]) ** 2
    return mean, full


def speed_of(mean: Array, wheel_speed: Array) -> Array:
    """Return the (n,) speeds for (n, N) states and (n,) wheel speeds [m/s]."""
    return np.asarray((1 + mean[:, SCALE]) * wheel_speed - mean[:, SPEED])


# A state, the two inputs of the equations above over a step, and their errors.
def predict(
    mean: Array,
    cov: Array,
    wheel_speed: Array,
    yaw_rate: Array,
    dt: float,
    errors: SensorErrors,
    processes: Array | None = None,
) -> tuple[Array, Array, Array]:
    """Return states, covariances and transition matrices after a time step.

    Args:
        mean: (n, N).
        cov: (n, N, N).
        wheel_speed: (n,) mean over the step [m/s].
        yaw_rate: (n,) mean over the step [rad/s].
        dt: [s], of some 10 ms.
        errors: of the sensors.
        processes: (n, 2, N - 3) standard deviations and correlation times [s] of the errors of each
            filter; None for those of ``errors``.

    Returns:
        (n, N) means, (n, N, N) covariances, (n, N, N) transition matrices F.
    """
    v = speed_of(mean, wheel_speed)
    turn = (yaw_rate - mean[:, YAW_RATE]) * dt
    middle = mean[:, HEADING] + turn / 2
    c, s = np.cos(middle), np.sin(middle)
    if processes is None:
        processes = np.tile([errors.sigmas, errors.times], (len(mean), 1, 1))
    sigmas, times = processes[:, 0], processes[:, 1]
    phi = np.exp(-dt / times)  # (n, N - 3)
    phi[:, -3:] = np.exp(-np.abs(wheel_speed) * dt / errors.fix_distance)[:, None]
    after = mean.copy()
    after[:, X] += v * dt * c
    after[:, Y] += v * dt * s
    after[:, HEADING] += turn
    after[:, ERRORS] *= phi

    F = np.zeros((len(mean), N, N))
    F[:, range(3), range(3)] = 1.0
    F[:, range(3, N), range(3, N)] = phi
    for row, along, across in ((X, c, -s), (Y, s, c)):
        F[:, row, HEADING] = v * dt * across
        F[:, row, SPEED] = -along * dt
        F[:, row, YAW_RATE] = -v * dt**2 / 2 * across
        F[:, row, SCALE] = wheel_speed * dt * along
    F[:, HEADING, YAW_RATE] = -dt
    moved = F @ cov @ F.transpose(0, 2, 1)
    moved[:, HEADING, HEADING] += errors.yaw_rate_noise**2 * dt
    rows = range(3, N)
    moved[:, rows, rows] += sigmas**2 * (1 - phi**2)
    return after, moved, F


def update(
    mean: Array, cov: Array, residual: Array, H: Array, R: Array, used: NDArray[np.bool_]
) -> tuple[Array, Array, Array]:
    """Return states, covariances and reductions I - K H after B measurements of m values each.

    Args:
        mean: (n, N).
        cov: (n, N, N).
        residual: (n, B, m) measurements less their predictions.
        H: (n, B, m, N) Jacobians of the predictions.
        R: (n, B, m, m) covariances of the measurements, which are independent of each other.
        used: (n, B) which of them to use.

    Returns:
        (n, N) means, (n, N, N) covariances, (n, N, N) matrices I - K H.
    """
    n, B, m = residual.shape
    residual = np.where(used[..., None], residual, 0.0).reshape(n, B * m)
    H = np.where(used[..., None, None], H, 0.0).reshape(n, B * m, N)
    PHt = cov @ H.transpose(0, 2, 1)
    S = H @ PHt
    for b in range(B):
        own = slice(m * b, m * b + m)
        S[:, own, own] += np.where(used[:, b, None, None], R[:, b], np.eye(m))
    K = PHt @ np.linalg.inv(S)
    reduction = np.eye(N) - K @ H
    after = cov - K @ PHt.transpose(0, 2, 1)
    after = (after + after.transpose(0, 2, 1)) / 2
    return mean + (K @ residual[..., None])[..., 0], after, reduction
