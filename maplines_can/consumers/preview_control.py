"""Preview control of the curvature demand: the gains by which a car follows a path."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

#: Horizon of the preview [s].
HORIZON = 2.0
#: Errors that weigh the same in the cost: of the offset [m], of the heading [rad], and of the
#: lateral jerk by which they are corrected [m/s^3].
COST = (0.05, 0.05, 3.0)
#: Doublings of the steps of which the cost is added up: to a million steps.
DOUBLINGS = 20
#: Speed below which the rate of the curvature limits the corrections, and no more the jerk [m/s].
SLOW = 4.0


class Gains(NamedTuple):
    """Gains of the change of the curvature demand: ``-feedback x + preview r``."""

    feedback: NDArray[np.float64]  #: (4,) of offset, heading, curvature, and the last demand
    preview: NDArray[np.float64]  #: (n,) of the curvatures of the path at the next n steps


@lru_cache(256)
def preview_gains(speed: float, period: float, lag: float) -> Gains:
    """Return the gains of optimal preview control at a speed.

    The state x is the offset from the path, the heading relative to it, the curvature of the car
    and its demand; u is the change of the demand, r the curvature of the path:

        x' = A x + B u + D r,   minimise  sum  (e / e0)^2 + (psi / psi0)^2 + (u / u0)^2

    With the solution P of the Riccati equation and the closed loop M = A - B K,

        u = -K x - (R + B^T P B)^-1 B^T (P D r_0 + M^T P D r_1 + (M^T)^2 P D r_2 + ...)

    (Tomizuka and Whitney, J. Dyn. Sys. 97, 1975, for known future references). Beyond the horizon,
    r is the last one.

    Args:
        speed: more than 0 [m/s].
        period: [s].
        lag: time constant of the actuator [s].

    >>> K, F = preview_gains(10.0, 0.05, 0.1)
    >>> bool(abs(F.sum() - K[2:].sum()) < 1e-9)  # in a circle the car stays on the path
    True
    """
    A, B, D = model(speed, period, lag)
    jerk = COST[2] * period / max(speed, SLOW) ** 2
    Q, R = np.diag([COST[0] ** -2, COST[1] ** -2, 0.0, 0.0]), np.array([[jerk**-2]])
    P = riccati(A, B @ B.T / R, Q)
    inverse = np.linalg.inv(R + B.T @ P @ B)
    K = inverse @ B.T @ P @ A
    M = A - B @ K
    steps = max(2, round(HORIZON / period))
    v = P @ D
    gains = np.empty(steps)
    for i in range(steps - 1):
        gains[i] = -(inverse @ B.T @ v).item()
        v = M.T @ v
    gains[-1] = -(inverse @ B.T @ np.linalg.solve(np.eye(4) - M.T, v)).item()
    return Gains(K[0], gains)


def riccati(
    A: NDArray[np.float64], G: NDArray[np.float64], Q: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the (n, n) stabilising solution of  P = A^T P (I + G P)^-1 A + Q,  G = B R^-1 B^T.

    P is the cost of all future steps. Doubling adds up 1, 2, 4, 8, ... of them (Chu, Fan, Lin and
    Wang, Int. J. Control 77, 2004). The solver of scipy wakes all threads of BLAS, in the cycle in
    which the car first drives at a speed.

    >>> bool(np.isclose(riccati(*np.ones((3, 1, 1))).item(), (1 + 5**0.5) / 2))
    True
    """
    P, one = Q, np.eye(len(A))
    for _ in range(DOUBLINGS):
        W = np.linalg.inv(one + G @ P)
        A, G, P = A @ W @ A, G + A @ W @ G @ A.T, P + A.T @ P @ W @ A
    return P


def model(
    speed: float, period: float, lag: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return A (4, 4), B (4, 1) and D (4, 1) of ``preview_gains``."""
    step = speed * period
    decay = 0.0 if lag == 0 else math.exp(-period / lag)
    A = np.array(
        [
            [1, step, step**2 / 2, 0],
            [0, 1, step, 0],
            [0, 0, decay, 1 - decay],
            [0, 0, 0, 1],
        ],
        dtype=float,
    )
    B = np.array([[0.0], [0.0], [1 - decay], [1.0]])
    return A, B, np.array([[-(step**2) / 2], [-step], [0.0], [0.0]])
