"""Kalman filter over both lines of the ego lane, with the errors that its inputs share."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..values.linalg import squared_distance
from ..values.line import transform_line_or_nan

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

#: Lines of the lane: left and right.
LINES = 2
#: Parameters of both lines.
N = 4 * LINES
#: Slowly varying errors of sensors: offset [m], heading [rad] and curvature [1/m] of the camera
#: lines, and yaw rate [rad/s].
BIASES = 4
#: Standard deviations of a lane of which nothing is known [m, rad, 1/m, 1/m^2].
UNKNOWN = np.tile([30.0, 1.0, 0.3, 0.1], LINES)
#: The curvature of a road changes with its arc length so that a car at its speed has at most some
#: lateral jerk [m/s^3]. It is a random walk with this standard deviation in each ``JERK_LENGTH``.
JERK, JERK_LENGTH = 2.0, 10.0
#: Roads are not more winding for lower speeds than this [m/s].
MIN_SPEED = 5.0
#: Both lines bend together: share of the process noise that is of one line alone (in sigma).
OWN_SHARE = 0.1
#: Squared Mahalanobis distance of a scene beyond which the road has changed (95 % of 8 variables).
CHANGE = 15.51
#: The same of a camera line beyond which it is not used (99.9 % of 4 variables).
GATE = 18.47
#: Share of the variances of what map lines have of their own that is new in each cycle, such as
#: rounding; it is added to them.
NOISE_SHARE = 1.0
#: The cubic of a scene and that of a camera may both miss the road ahead: standard deviation of
#: the curvature of a map line, in addition to its own covariance [1/m].
MISFIT = 7e-5
#: Standard deviations of the biases, and their correlation time [s].
BIAS_SIGMA, BIAS_TIME = (0.05, 0.003, 5e-5, 0.002), 100.0
#: In a corner no cubic follows the road, so the one of the next cycle is another one: standard
#: deviations of its offset [m] and heading [rad] in ``CORNER_LENGTH`` [m], reached at this rate of
#: the curvature [1/m^2].
CORNER, CORNER_LENGTH, CORNER_RATE = (0.1, 0.05), 5.0, 0.001

Handling = Literal["state", "consider"]


class LaneFilter:
    """Filter over (y_off, beta, c0, c1) of the left and the right line of the ego lane.

    The errors of successive measurements are not independent, so they are variables of the filter,
    in units of their standard deviations:

        x = (left, right; u: pose error; v: what the map lines have of their own; b: sensor biases)

    A map line is the line plus ``loading u + own_root v``. u and b are first-order Gauss-Markov
    processes, v is constant. v is a *consider* variable (Schmidt 1966): the covariances with it are
    kept, but it is not estimated, since it differs from place to place. For the same reason, no
    number of scenes makes the lines more certain than v.

    u is estimated from camera lines (``handling="state"``), or only considered. A scene never
    updates it: what successive scenes say of it depends on how it changes from cycle to cycle. The
    error of a localisation does not change as a Gauss-Markov process does, since it moves with its
    dead reckoning: the error across grows by that of the heading. The difference of a camera line
    and a map line shows it without such a model.

    All arrays may have leading axes, for many cars at once.

    Args:
        errors: variables of u.
        handling: of u at camera lines.
        bias_sigma: (4,) standard deviations of the biases b [m, rad, 1/m, rad/s].
        bias_time: correlation time of the biases [s].
        shape: leading axes.
    """

    def __init__(
        self,
        errors: int = 3,
        handling: Handling = "state",
        bias_sigma: tuple[float, float, float, float] = BIAS_SIGMA,
        bias_time: float = BIAS_TIME,
        shape: tuple[int, ...] = (),
    ) -> None:
        sizes = np.cumsum([0, N, errors, N, BIASES])
        self.lane, self.u, self.v, self.b = (slice(*ends) for ends in pairwise(sizes))
        n = int(sizes[-1])
        # Shares of the gain: 0 for what is considered.
        self._map_gain, self._camera_gain = np.ones((2, n))
        self._map_gain[self.u] = self._map_gain[self.v] = self._camera_gain[self.v] = 0
        self.handle(handling)
        self._bias, self._bias_time = np.array(bias_sigma), bias_time
        self.mean = np.zeros((*shape, n))
        self.cov = np.zeros((*shape, n, n))
        self.cov[..., range(n), range(n)] = np.append(UNKNOWN**2, np.ones(n - N))

    def handle(self, handling: Handling) -> None:
        """Estimate the pose error from camera lines from now on, or consider it."""
        self._camera_gain[self.u] = float(handling == "state")

    def predict(
        self, displacement: Array, cov: Array, dt: float, windows: Array, correlation_time: float
    ) -> None:
        """Predict the lines after a displacement of the car.

        Args:
            displacement: (..., 3), the new pose in the old ego frame [m, m, rad].
            cov: (..., 3, 3) of the displacement.
            dt: time of the displacement [s].
            windows: (..., 2, 2) in which the lines are described [m].
            correlation_time: of u [s].
        """
        n = self.mean.shape[-1]
        keep = np.ones(n)
        keep[self.u] = np.exp(-dt / correlation_time)
        keep[self.b] = np.exp(-dt / self._bias_time)
        displacement = np.array(np.broadcast_to(displacement, (*self.mean.shape[:-1], 3)))
        turn = dt * self._bias[-1]
        displacement[..., 2] -= turn * self.mean[..., -1]
        lines = self.mean[..., :N].reshape(*self.mean.shape[:-1], LINES, 4)
        moved, J_lines, J_move = move_lines(lines, displacement, windows)
        G = J_move.reshape(*J_move.shape[:-3], N, 3)
        F = np.zeros((*self.mean.shape, n))
        F[..., range(n), range(n)] = keep
        for i in range(LINES):
            F[..., 4 * i : 4 * i + 4, 4 * i : 4 * i + 4] = J_lines[..., i, :, :]
        F[..., :N, -1] = -turn * G[..., 2]
        self.mean = self.mean * keep
        self.mean[..., :N] = moved.reshape(*moved.shape[:-2], N)
        P = F @ self.cov @ F.mT
        P[..., :N, :N] += G @ cov @ G.mT + road_noise(displacement[..., 0], dt)
        P[..., range(N, n), range(N, n)] += 1 - keep[N:] ** 2
        rate = np.abs(moved[..., 3]).max(axis=-1)
        corner = (
            (rate / CORNER_RATE).clip(max=1) ** 2 * np.abs(displacement[..., 0]) / CORNER_LENGTH
        )
        for i, sigma in enumerate(CORNER):
            both = np.isin(np.arange(n), (i, 4 + i))
            P += (corner * sigma**2)[..., None, None] * (both[:, None] & both)
        self.cov = P

    def turn_errors(self, Q: Array) -> None:
        """Turn u by (..., m, m) orthogonal matrices: its axes have turned relative to the car."""
        n = self.mean.shape[-1]
        M = np.zeros((*Q.shape[:-2], n, n))
        M[..., range(n), range(n)] = 1.0
        M[..., self.u, self.u] = Q
        self.mean = (M @ self.mean[..., None])[..., 0]
        self.cov = M @ self.cov @ M.mT

    def update_map(
        self, lines: Array, loading: Array, own: Array, noise: Array | None, used: Mask
    ) -> None:
        """Update with the lines of a scene. The pose error is considered.

        Args:
            lines: (..., 8) left and right.
            loading: (..., 8, m) of u.
            own: (..., 8, 8) covariance of what the lines have of their own.
            noise: (..., 8, 8) covariance of what is independent from cycle to cycle; None for
                ``NOISE_SHARE`` of ``own``, in addition to that.
            used: (..., 8) which rows there are.
        """
        noise = NOISE_SHARE * own if noise is None else noise
        H = self._rows(used)
        H[..., :, self.u] = loading * used[..., None]
        root = roots(own)
        H[..., :, self.v] = root * used[..., None]
        self._admit_change(lines, H, noise, used)
        self._update(lines, H, noise, used, self._map_gain)
        self._keep_own(root, used)

    def update_camera(self, lines: Array, cov: Array, used: Mask, gate: float = GATE) -> Mask:
        """Update with the lines of a camera; those beyond the gate are not used.

        Args:
            lines: (..., 2, 4) left and right.
            cov: (..., 2, 4, 4) of their noise.
            used: (..., 2) which lines there are.
            gate: limit on the squared Mahalanobis distance of a line.

        Returns:
            (..., 2) which lines were used.
        """
        used = np.array(used)
        for i in range(LINES):
            rows = np.zeros((*used.shape[:-1], N), dtype=bool)
            rows[..., 4 * i : 4 * i + 4] = used[..., i, None]
            H = self._rows(rows)
            for j in range(BIASES - 1):
                H[..., 4 * i + j, self.b.start + j] = self._bias[j] * used[..., i]
            R = np.zeros((*used.shape[:-1], N, N))
            R[..., 4 * i : 4 * i + 4, 4 * i : 4 * i + 4] = cov[..., i, :, :]
            z = np.zeros((*used.shape[:-1], N))
            z[..., 4 * i : 4 * i + 4] = lines[..., i, :]
            used[..., i] &= self._update(z, H, R, rows, self._camera_gain, gate)
        return used

    def _admit_change(self, z: Array, H: Array, R: Array, used: Mask) -> None:
        """Add process noise along the innovation where a scene does not fit the prediction.

        This is so where the road changes its shape, since a cubic then fits another range, and at
        a change of the lane.
        """
        r, S, _ = self._innovation(z, H, R, used)
        misfits = squared_distance(r, S) > CHANGE
        r = r * misfits[..., None]
        self.cov[..., :N, :N] += r[..., :, None] * r[..., None, :]

    def _keep_own(self, root: Array, used: Mask) -> None:
        """Raise the covariance of the lines to that of what the map lines have of their own.

        The cubic of the next cycle misses the road by nearly as much as this one, but by another
        shape once the car has moved. If this were a constant, it could be told from the road, and
        the lines would seem to be known better with each scene. What is due to the pose error and
        to the biases is in addition to it.
        """
        others = np.r_[self.u, self.b]
        P, X = self.cov[..., :N, :N], self.cov[..., :N, others]
        rest = P - X @ np.linalg.solve(self.cov[..., others[:, None], others], X.mT)
        inverse = np.linalg.inv(root)
        both = used[..., None] & used[..., None, :]
        values, vectors = np.linalg.eigh(np.where(both, inverse @ rest @ inverse.mT, np.eye(N)))
        lacking = root @ vectors
        self.cov[..., :N, :N] += lacking * (1 - values).clip(0)[..., None, :] @ lacking.mT

    def _innovation(self, z: Array, H: Array, R: Array, used: Mask) -> tuple[Array, Array, Array]:
        """Return the innovation, its covariance, and that of the variables with it."""
        both = used[..., None] & used[..., None, :]
        r = np.where(used, z - (H @ self.mean[..., None])[..., 0], 0.0)
        PH = self.cov @ H.mT
        return r, H @ PH + np.where(both, R, np.eye(N)), PH

    def _rows(self, used: Mask) -> Array:
        H = np.zeros((*used.shape[:-1], N, self.mean.shape[-1]))
        H[..., range(N), range(N)] = used
        return H

    def _update(
        self, z: Array, H: Array, R: Array, used: Mask, gain: Array, gate: float = np.inf
    ) -> Mask:
        r, S, PH = self._innovation(z, H, R, used)
        passed = squared_distance(r, S) <= gate
        K = np.linalg.solve(S, PH.mT).mT
        K = K * gain[:, None] * passed[..., None, None]
        self.mean = self.mean + (K @ r[..., None])[..., 0]
        I_KH = np.eye(self.mean.shape[-1]) - K @ H
        P = I_KH @ self.cov @ I_KH.mT + K @ R @ K.mT
        self.cov = (P + P.mT) / 2
        return passed


def roots(covs: Array) -> Array:
    """Return (..., 8, 8) roots R of covariances of two lines, so that R R' covers them.

    They differ little for covariances that do, as those of successive scenes.
    """
    more = covs.copy()
    more[..., [2, 6], [2, 6]] += MISFIT**2
    variance = np.einsum("...ii->...i", more)
    more[..., range(N), range(N)] += 1e-9 * variance + 1e-24  # they may be singular
    return np.asarray(np.linalg.cholesky(more), dtype=float)


def road_noise(distance: Array, dt: float) -> Array:
    """Return the (..., 8, 8) covariance of what (...,) metres of road change of both lines."""
    speed = np.maximum(np.abs(distance) / dt, MIN_SPEED)
    sigma = JERK / speed**3 * np.sqrt(np.abs(distance) / JERK_LENGTH)
    s = np.asarray(distance)[..., None]
    g = sigma[..., None] * np.concatenate([s**3 / 6, s**2 / 2, s, np.ones_like(s)], axis=-1)
    one = g[..., :, None] * g[..., None, :]
    both = np.ones((LINES, LINES)) + OWN_SHARE**2 * np.eye(LINES)
    return np.einsum("ij,...ab->...iajb", both, one).reshape(*one.shape[:-2], N, N)


def move_lines(lines: Array, displacement: Array, windows: Array) -> tuple[Array, Array, Array]:
    """Return lines after a displacement of the car, and the derivatives.

    Args:
        lines: (..., L, 4).
        displacement: (..., 3), the new pose in the old ego frame.
        windows: (..., L, 2) in which the lines are described [m].

    Returns:
        (..., L, 4) lines, their (..., L, 4, 4) derivatives with respect to the lines, and
        (..., L, 4, 3) with respect to the displacement. A line that is no function of x in the
        new frame is NaN.
    """
    window = (windows[..., 0], windows[..., 1])
    moved = transform_line_or_nan(lines, displacement[..., None, :], window)
    x = displacement[..., None, 0]
    cos2 = np.cos(moved[..., 1]) ** 2
    J = np.zeros((*lines.shape, 4))
    J[..., range(4), range(4)] = 1.0
    J[..., 0, 1] = x / np.cos(lines[..., 1]) ** 2
    J[..., 0, 2], J[..., 0, 3] = x**2 / 2, x**3 / 6
    J[..., 1, 2], J[..., 1, 3], J[..., 2, 3] = cos2 * x, cos2 * x**2 / 2, x
    G = np.zeros((*lines.shape, 3))
    G[..., 0, 0], G[..., 0, 1] = np.tan(moved[..., 1] + displacement[..., None, 2]), -1.0
    G[..., 1, 0], G[..., 1, 2] = cos2 * moved[..., 2], -1.0
    G[..., 2, 0] = moved[..., 3]
    return moved, J, G
