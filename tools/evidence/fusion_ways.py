"""Right and wrong ways to fuse received lines, for comparison."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from maplines_can.consumers.lane_filter import (
    BIAS_SIGMA,
    CHANGE,
    GATE,
    NOISE_SHARE,
    UNKNOWN,
    LaneFilter,
    Mask,
    N,
    move_lines,
    road_noise,
    roots,
)
from maplines_can.simulation.camera import PLACES
from maplines_can.values.linalg import squared_distance

from .fleet import MapFilter

Array = NDArray[np.float64]

#: Standard deviations of a receiver that knows a quality of 2 bits only, of its second class.
FIXED_SIGMA = np.tile([0.15, 0.01, 1e-3, 5e-5], 2)


class Fused(LaneFilter):
    """Lane filter that takes what lines share as it is told.

    Args:
        cars: number of them.
        lines: what is known of the errors of the lines of a cycle: ``joint``, ``independent``
            lines, their ``variances`` only, or the ``mean`` only.
        is_white: take cycles as independent.
        is_considered: consider the pose error (Schmidt) instead of estimating it.
    """

    def __init__(
        self,
        cars: int,
        lines: str = "joint",
        *,
        is_white: bool = False,
        is_considered: bool = False,
    ) -> None:
        errors = {"joint": 3, "independent": 6}.get(lines, 8)
        super().__init__(errors, "consider" if is_considered else "state", shape=(cars,))
        self._lines, self._is_white = lines, is_white

    def update_scene(self, lines: Array, loading: Array, own: Array) -> None:
        """Update with a scene; see ``MapFilter``."""
        loading, own = self._known(loading, own)
        used, none = np.ones(lines.shape, dtype=bool), np.zeros_like(own)
        if self._is_white:
            noise = loading @ loading.mT + own
            self.update_map(lines, np.zeros_like(loading), none, noise, used)
        else:
            self.update_map(lines, loading, own, None, used)

    def update_camera(self, lines: Array, cov: Array, used: Mask, gate: float = GATE) -> Mask:
        """Update with camera lines; see ``LaneFilter``."""
        return super().update_camera(lines, cov, used, gate)

    def _known(self, loading: Array, own: Array) -> tuple[Array, Array]:
        """Return the loading and own covariance as far as this variant knows them."""
        if self._lines == "joint":
            return loading, own
        blocks = np.kron(np.eye(2), np.ones((4, 4)))
        if self._lines == "independent":
            apart = np.zeros((*loading.shape[:-1], 6))
            apart[..., :4, :3], apart[..., 4:, 3:] = loading[..., :4, :], loading[..., 4:, :]
            return apart, own * blocks
        total = np.einsum("...im,...im->...i", loading, loading) + np.einsum("...ii->...i", own)
        sigma = np.sqrt(total) if self._lines == "variances" else np.full(total.shape, FIXED_SIGMA)
        tiny = np.broadcast_to(np.diag((1e-3 * FIXED_SIGMA) ** 2), own.shape)
        return sigma[..., None] * np.eye(8), tiny


class SplitFused:
    """Filter by split covariance intersection (Julier, Uhlmann 2001; Li, Nashashibi 2013).

    The error of the lane has a part that is independent of those of the measurements, and one whose
    correlation with them is unknown. That of a scene is all unknown but its rounding; that of a
    camera line is its bias. So no correlation time is needed, and none is used.
    """

    #: Weights of the unknown part of the prediction that are tried.
    WEIGHTS = (0.02, 0.1, 0.25, 0.5, 0.75, 0.9, 0.98)

    def __init__(self, cars: int) -> None:
        self.mean = np.zeros((cars, N))
        self._independent = np.zeros((cars, N, N))
        self._correlated = np.broadcast_to(np.diag(UNKNOWN**2), (cars, N, N))

    @property
    def cov(self) -> Array:
        """(S, 8, 8) covariance."""
        return self._independent + self._correlated

    def predict(
        self, displacement: Array, cov: Array, dt: float, windows: Array, correlation_time: float
    ) -> None:
        """Predict the lines; see ``LaneFilter``."""
        del correlation_time
        S = len(self.mean)
        moved, J_lines, J_move = move_lines(self.mean.reshape(S, 2, 4), displacement, windows)
        F, G = np.zeros((S, N, N)), J_move.reshape(S, N, 3)
        for i in range(2):
            F[:, 4 * i : 4 * i + 4, 4 * i : 4 * i + 4] = J_lines[:, i]
        turn = G[:, :, 2:] * dt * BIAS_SIGMA[-1]
        self.mean = moved.reshape(S, N)
        self._independent = F @ self._independent @ F.mT + G @ cov @ G.mT
        self._independent += road_noise(displacement[:, 0], dt)
        # The bias of the yaw rate adds up: sigma grows by that of each step.
        P = F @ self._correlated @ F.mT
        sigma = np.sqrt(np.einsum("sii->si", P))
        share = np.abs(turn[..., 0]).max(axis=1) / np.maximum(sigma[:, 1], 1e-9)
        self._correlated = P * (1 + share[:, None, None]) + (1 + 1 / np.maximum(share, 1e-9))[
            :, None, None
        ] * (turn @ turn.mT)

    def update_scene(self, lines: Array, loading: Array, own: Array) -> None:
        """Update with a scene; see ``MapFilter``."""
        own_root = roots(own)
        correlated, noise = loading @ loading.mT + own_root @ own_root.mT, NOISE_SHARE * own
        r = lines - self.mean
        misfits = squared_distance(r, self.cov + correlated + noise) > CHANGE
        r = r * misfits[:, None]
        self._correlated = self._correlated + r[:, :, None] * r[:, None, :]
        self._update(lines, correlated, noise, np.ones(len(lines), dtype=bool))

    def update_camera(self, lines: Array, cov: Array, used: Mask) -> Mask:
        """Update with camera lines; see ``LaneFilter``."""
        used = np.array(used)
        bias = np.diag(np.append(np.square(BIAS_SIGMA[:3]), 0.0))
        for i in range(2):
            one = slice(4 * i, 4 * i + 4)
            r = lines[:, i] - self.mean[:, one]
            used[:, i] &= squared_distance(r, self.cov[:, one, one] + bias + cov[:, i]) <= GATE
            z = self.mean.copy()
            z[:, one] = lines[:, i]
            correlated, noise = np.zeros((2, len(lines), N, N))
            correlated[:, one, one], noise[:, one, one] = bias, cov[:, i]
            other = slice(4 - 4 * i, 8 - 4 * i)  # is not measured
            noise[:, other, other] = 1e4 * np.diag(UNKNOWN[:4] ** 2)
            self._update(z, correlated, noise, used[:, i])
        return used

    def _update(self, z: Array, correlated: Array, noise: Array, used: Mask) -> None:
        best = np.full(len(z), np.inf)
        found = self.mean, self._independent, self._correlated
        for weight in self.WEIGHTS:
            P = self._correlated / weight + self._independent
            R = correlated / (1 - weight) + noise
            K = np.linalg.solve(P + R, P).mT
            I_K = np.eye(N) - K
            total = I_K @ P @ I_K.mT + K @ R @ K.mT
            independent = I_K @ self._independent @ I_K.mT + K @ noise @ K.mT
            cost = lateral_variance(total)
            is_best = (cost < best) & used
            best = np.where(is_best, cost, best)
            fused = self.mean + (K @ (z - self.mean)[..., None])[..., 0]
            one = is_best[:, None]
            found = (
                np.where(one, fused, found[0]),
                np.where(one[..., None], independent, found[1]),
                np.where(one[..., None], total - independent, found[2]),
            )
        self.mean, self._independent, self._correlated = found


def lateral_variance(cov: Array) -> Array:
    """Return the (S,) sum of the variances of both lines at ``PLACES`` ahead of the car."""
    x = np.array(PLACES)
    J = np.column_stack([np.ones(3), x, x**2 / 2, x**3 / 6])
    return sum(np.einsum("xi,sij,xj->s", J, cov[:, one, one], J) for one in (slice(4), slice(4, 8)))


#: Filters for a number of cars, by name: those that are right, then those that are not.
RIGHT: dict[str, Callable[[int], MapFilter]] = {
    "pose error as state": lambda cars: Fused(cars),
    "Schmidt filter": lambda cars: Fused(cars, is_considered=True),
    "split covariance intersection": lambda cars: SplitFused(cars),
}
WRONG: dict[str, Callable[[int], MapFilter]] = {
    "joint, cycles independent": lambda cars: Fused(cars, is_white=True),
    "lines independent": lambda cars: Fused(cars, "independent"),
    "lines and cycles independent": lambda cars: Fused(cars, "independent", is_white=True),
    "variances only": lambda cars: Fused(cars, "variances"),
    "variances only, cycles independent": lambda cars: Fused(cars, "variances", is_white=True),
    "mean only": lambda cars: Fused(cars, "mean"),
    "mean only, cycles independent": lambda cars: Fused(cars, "mean", is_white=True),
}
