"""Pose source with stated errors that are correlated in time, as those of a localisation are."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.arrays import floats
from ..values.gaussian import Gaussian, variances


class PoseSource:
    """Source of poses with Gauss-Markov errors and the covariance of these errors.

    Along, across and heading error are independent first-order Gauss-Markov processes (Maybeck,
    Stochastic Models, Estimation and Control, vol. 1, section 4.11), stationary from the first time
    on. The discretisation is exact for any time step dt:

        e(t + dt) = phi e(t) + sigma sqrt(1 - phi^2) w,  phi = exp(-dt / tau),  w from N(0, 1)

    The reported pose is the true pose plus the error, and the stated covariance is that of the
    errors. They are errors in the frame of the true pose.

    Args:
        sigma: (3,) standard deviations along [m], across [m] and of the heading [rad].
        correlation_time: tau, one or (3,) [s]. 0 gives white noise; infinity, a constant error.
        seed: of the random numbers; the same seed and times give the same errors.

    Raises:
        ValueError: a value is negative or NaN, or a shape is wrong.

    >>> source = PoseSource(sigma=(0.3, 0.1, 0.01), correlation_time=10.0, seed=1)
    >>> stated = source.pose(0.0, [100.0, 50.0, np.pi / 2])
    >>> stated.sigma.round(6)  # the car heads along y
    array([0.1 , 0.3 , 0.01])
    """

    def __init__(self, sigma: ArrayLike, correlation_time: ArrayLike = 10.0, seed: int = 0) -> None:
        self._variance = variances(sigma)
        if self._variance.shape != (3,):
            raise ValueError(f"sigma must be (along, across, heading), got {sigma!r}")
        tau = floats(correlation_time, "correlation_time")
        if tau.shape not in {(), (3,)} or not (tau >= 0).all():
            raise ValueError(
                "correlation_time must be one number or three, 0 s or more, "
                f"got {correlation_time!r}"
            )
        self._tau = tau
        self._random = np.random.default_rng(seed)
        self._t = -np.inf
        self._error = np.zeros(3)  # in units of sigma

    def pose(self, t: float, true_pose: ArrayLike) -> Gaussian:
        """Return the reported pose at a time later than that of the previous call.

        Args:
            t: [s].
            true_pose: (3,) x [m], y [m], heading [rad] in the map frame.

        Returns:
            Gaussian over x [m], y [m] and heading [rad] in the map frame.

        Raises:
            ValueError: the time is not later than the previous one, or a value is not finite.
        """
        pose = floats(true_pose, "true_pose")
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise ValueError(f"true_pose must be finite with shape (3,), got {true_pose!r}")
        if not self._t < floats(t, "t") < np.inf:
            raise ValueError(f"t must be finite and later than {self._t:g} s, got {t!r}")
        c, s = np.cos(pose[2]), np.sin(pose[2])
        T_map_ego = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        error = np.sqrt(self._variance) * self._next(t - self._t)
        self._t = float(t)
        cov = T_map_ego * self._variance @ T_map_ego.T
        return Gaussian.trusted(pose + T_map_ego @ error, (cov + cov.T) / 2)

    def _next(self, dt: float) -> NDArray[np.float64]:
        """Advance the (3,) errors by a time [s], infinite before the first call; return them."""
        steps = np.full(3, np.inf)  # in units of the correlation time
        if np.isfinite(self._t):
            np.divide(dt, self._tau, out=steps, where=self._tau > 0)
        noise = self._random.standard_normal(3)
        self._error = np.exp(-steps) * self._error + np.sqrt(-np.expm1(-2 * steps)) * noise
        return self._error
