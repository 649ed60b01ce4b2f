"""Simulation of lane fusion in many cars that take the same drive, each with errors of its own."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from maplines_can.consumers.lane_filter import move_lines
from maplines_can.propagation import Motion
from maplines_can.simulation.camera import PLACES, Errors, UnitGaussMarkov
from maplines_can.values.line import lateral, lateral_jacobian, transform_line_or_nan

from .drive_view import DriveView

Array = NDArray[np.float64]


class MapFilter(Protocol):
    """Filter that the simulation runs; see ``LaneFilter``."""

    @property
    def mean(self) -> Array:
        """(S, n) of both lines, and of what the filter estimates besides."""

    @property
    def cov(self) -> Array:
        """(S, n, n) covariance."""

    def predict(
        self, displacement: Array, cov: Array, dt: float, windows: Array, correlation_time: float
    ) -> None:
        """Predict the lines; see ``LaneFilter``."""

    def update_scene(self, lines: Array, loading: Array, own: Array) -> None:
        """Update with (S, 8) lines, the (S, 8, 3) loading and the (S, 8, 8) own covariance."""

    def update_camera(self, lines: Array, cov: Array, used: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Update with camera lines; see ``LaneFilter``."""


class Track(NamedTuple):
    """Errors of the fused lane centre at ``PLACES`` in (n,) cycles of (S,) cars [m]."""

    error: Array  #: (n, S, 3), NaN where a place is not valid
    sigma: Array  #: (n, S, 3)
    in_outage: NDArray[np.bool_]  #: (n,)
    false_used: float  #: share of the false camera lines that were used
    true_used: float  #: share of the true ones

    @property
    def rms(self) -> Array:
        """(3,) root mean square of the error [m]."""
        return np.asarray(np.sqrt(np.nanmean(self.error**2, axis=(0, 1))))

    @property
    def nees(self) -> Array:
        """(S, 3) normalised error squared of each car, mean over its drive."""
        return np.asarray(np.nanmean((self.error / self.sigma) ** 2, axis=0))


@dataclass
class Simulation:
    """Cars on a drive, with the same random errors for each filter.

    Args:
        view: of the drive.
        correlation_time: of the pose error [s].
        cars: number of them.
        seed: of the errors.
        errors: their sizes.
    """

    view: DriveView
    correlation_time: float
    cars: int
    seed: int = 0
    errors: Errors = field(default_factory=Errors)

    def run(self, lane_filter: MapFilter, stated_time: float | None = None) -> Track:
        """Let a filter fuse the lines; return its errors.

        Args:
            lane_filter: with (S,) cars.
            stated_time: correlation time that the filter is told, if it is not the true one [s].
        """
        rng, e, S = np.random.default_rng(self.seed), self.errors, self.cars
        view, time = self.view, stated_time or self.correlation_time
        state = view.state
        n, dt = len(state.t), float(state.t[1] - state.t[0])
        L = np.diag(e.pose_sigma)
        pose = UnitGaussMarkov(rng, (S, 3))
        local = UnitGaussMarkov(rng, (S, 2, 4))
        bias = UnitGaussMarkov(rng, (S, 3))
        constant = rng.standard_normal((S, 2, 4)) * [e.map_offset, e.map_heading, 0, 0]
        scale = 1 + e.speed_scale * rng.standard_normal(S)
        gyro = e.yaw_rate_bias * rng.standard_normal(S)
        camera_cov = np.diag(np.square(e.camera_sigma))
        outage = np.zeros(n, dtype=bool)
        outage[slice(*(np.array(e.outage) * n).astype(int))] = True
        error, sigma = np.full((2, n, S, len(PLACES)), np.nan)
        counts = np.zeros(4)
        windows = None
        for k in range(n):
            motion = self._motion(k, scale, gyro, rng) if k else None
            delta = pose.step(dt / self.correlation_time) @ L.T
            own = constant + local.step(state.speed[k] * dt / e.map_length) * e.map_local
            seen_bias = bias.step(dt / e.bias_time) * e.camera_bias
            if motion is not None and windows is not None:
                lane_filter.predict(*motion, dt, windows, time)
            if np.isnan(view.lines[k]).any():
                continue
            windows = np.broadcast_to(view.fit_ranges[k], (S, 2, 2))
            lines = np.broadcast_to(view.lines[k], (S, 2, 4))
            ends = windows[..., 0], windows[..., 1]
            sent = transform_line_or_nan(lines + own, delta[:, None], ends)
            loading = move_lines(sent, np.zeros((S, 3)), windows)[2].reshape(S, 8, 3) @ L
            lane_filter.update_scene(
                sent.reshape(S, 8), loading, np.broadcast_to(view.own[k], (S, 8, 8))
            )
            if not (outage[k] or np.isnan(view.seen[k]).any()):
                noise = rng.standard_normal((S, 2, 4)) * e.camera_sigma
                camera = view.seen[k] + noise
                camera[..., :3] += seen_bias[:, None]
                false = rng.random((S, 2)) < e.false_lines
                away = rng.choice([-1, 1], (S, 2)) * rng.uniform(0.5, 2.0, (S, 2))
                camera[..., 0] += false * away
                used = lane_filter.update_camera(
                    camera,
                    np.broadcast_to(camera_cov, (S, 2, 4, 4)),
                    np.ones((S, 2), dtype=bool),
                )
                counts += [(used & false).sum(), false.sum(), (used & ~false).sum(), (~false).sum()]
            error[k], sigma[k] = self._evaluate(lane_filter, k)
        return Track(
            error, sigma, outage, counts[0] / max(counts[1], 1), counts[2] / max(counts[3], 1)
        )

    def _motion(self, k: int, scale: Array, gyro: Array, rng: Any) -> tuple[Array, Array]:
        """Return the (S, 3) measured displacements since the last cycle, and their covariance."""
        state, e = self.view.state, self.errors
        dt = float(state.t[k] - state.t[k - 1])
        speed, rate = state.speed[k - 1 : k + 1].mean(), state.yaw_rate[k - 1 : k + 1].mean()
        noise = e.yaw_rate_noise * rng.standard_normal(self.cars)
        exact = Motion.with_sigma(speed, rate, (e.speed_scale * speed + 0.01, e.yaw_rate_noise))
        moved = exact.over(dt)
        displacement = moved.mean * np.column_stack([scale, scale, np.ones(self.cars)])
        displacement[:, 2] += dt * (gyro + noise)
        displacement[:, 1] += displacement[:, 0] * dt * (gyro + noise) / 2
        return displacement, np.broadcast_to(moved.cov, (self.cars, 3, 3))

    def _evaluate(self, lane_filter: MapFilter, k: int) -> tuple[Array, Array]:
        """Return the errors of the centre and their standard deviations."""
        x = np.array(PLACES)
        left, right = lane_filter.mean[:, None, :4], lane_filter.mean[:, None, 4:8]
        J = np.concatenate([lateral_jacobian(line, x) for line in (left, right)], axis=-1) / 2
        cov = lane_filter.cov[:, :8, :8]
        true = np.where(self.view.valid[k], self.view.true[k].mean(axis=0), np.nan)
        error = (lateral(left, x) + lateral(right, x)) / 2 - true
        return error, np.sqrt(np.einsum("sxi,sij,sxj->sx", J, cov, J))
