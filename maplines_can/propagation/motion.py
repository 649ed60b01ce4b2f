"""Motion of the car: displacement within a time, with its uncertainty."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.arrays import floats
from ..values.elementary import sin_cos
from ..values.gaussian import Gaussian, independent, variances
from .sigma_points import SIGMA_POINTS
from .transform import Transform


@dataclass(frozen=True, eq=False)
class Motion:
    """Motion of the car with constant turn rate and velocity (CTRV).

    The origin of the ego frame moves on a circular arc that is tangent to the car's
    x axis at each point (Schubert, Richter, Wanielik, FUSION 2008). This is true for
    the centre of the rear axle. If the origin is elsewhere, or the car brakes hard,
    pass the displacement itself to ``predict`` and ``predict_to``.

    Args:
        speed: forward, negative in reverse [m/s].
        yaw_rate: positive to the left [rad/s].
        cov: (2, 2) covariance of speed and yaw rate; it may be singular. It should
            include the effect of an unknown acceleration.

    Raises:
        ValueError: a value is not finite, or ``cov`` is not a covariance.

    >>> Motion(20.0, 0.0).over(0.1).mean
    array([2., 0., 0.])
    """

    speed: float
    yaw_rate: float
    cov: NDArray[np.float64] = field(default_factory=lambda: np.zeros((2, 2)))

    def __post_init__(self) -> None:
        for name in ("speed", "yaw_rate"):
            if not np.isfinite(floats(getattr(self, name), name)):
                raise ValueError(f"{name} must be finite, got {getattr(self, name)!r}")
        object.__setattr__(self, "cov", Gaussian(np.zeros(2), self.cov).cov)

    @classmethod
    def with_sigma(cls, speed: float, yaw_rate: float, sigma: ArrayLike) -> Motion:
        """Return a motion with (2,) standard deviations [m/s, rad/s] and no correlation.

        >>> Motion.with_sigma(20.0, 0.1, sigma=(0.2, 0.01)).over(0.1).sigma.round(4)
        array([0.02 , 0.001, 0.001])
        """
        return cls(speed, yaw_rate, np.diag(variances(sigma)))

    def over(
        self, dt: float, time_sigma: float = 0.0, transform: Transform = SIGMA_POINTS
    ) -> Gaussian:
        """Return the displacement of the car within a time: the new pose in the old ego frame.

        Args:
            dt: time, negative for a displacement into the past [s].
            time_sigma: standard deviation of ``dt`` [s].
            transform: moment transform over speed, yaw rate and time.

        Returns:
            Gaussian over (x [m], y [m], heading [rad]).

        Raises:
            ValueError: a value is not finite, or ``time_sigma`` is negative.

        >>> Motion(10.0, np.pi / 2).over(1.0).mean.round(3)  # a quarter of a circle
        array([6.366, 6.366, 1.571])
        """
        if not np.isfinite(floats(dt, "dt")):
            raise ValueError(f"dt must be finite [s], got {dt!r}")
        if not 0 <= floats(time_sigma, "time_sigma") < np.inf:
            raise ValueError(f"time_sigma must be 0 s or more and finite, got {time_sigma!r}")
        rates = Gaussian(np.array([self.speed, self.yaw_rate]), self.cov)
        time = Gaussian(np.array([dt]), np.array([[variances(time_sigma)]]))
        with np.errstate(over="ignore", invalid="ignore"):  # Gaussian raises for such a result
            return transform(_arc, independent(rates, time))


def _arc(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (N, 3) displacements [m, m, rad] for (N, 3) speeds, yaw rates and times."""
    speed, yaw_rate, dt = points.T
    half = yaw_rate * dt / 2  # angle of the chord to the x axis
    sine, cosine = sin_cos(half)
    chord = speed * dt * np.divide(sine, half, where=np.abs(half) > 1e-9, out=np.ones_like(half))
    return np.column_stack([chord * cosine, chord * sine, 2 * half])
