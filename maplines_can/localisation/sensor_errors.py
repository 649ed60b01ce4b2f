"""Errors of the sensors of a localisation: each a first-order Gauss-Markov process."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray


class GaussMarkov(NamedTuple):
    """First-order Gauss-Markov process.

    Its autocorrelation falls to 1/e within the correlation time (Maybeck, Stochastic Models,
    Estimation and Control, vol. 1, section 4.11).
    """

    sigma: float  #: standard deviation, in the unit of the error; 0 for no such error
    time: float = math.inf  #: correlation time [s]; infinite for a constant error


@dataclass(frozen=True)
class SensorErrors:
    """Errors of the sensors: what is correlated in time, and the white noise of the yaw rate.

    The white noise of the other sensors comes with each measurement, as its covariance. The
    defaults are those of a production car; the error of its GNSS receiver is not known.

    Args:
        speed: of the wheel speed, such as by slip [m/s].
        yaw_rate: bias of the yaw rate [rad/s].
        wheel_scale: relative error of the wheel radius: true speed over wheel speed, less 1.
        gnss: of the GNSS position, to the east and to the north alike [m]; None if it is not
            known, so that the filter finds it out: see ``gnss_hypotheses``. A fix may state its
            own, see ``GnssFix``.
        camera_offset: common to the lateral positions of all lines that the camera sees [m].
        camera_heading: common to their directions [rad].
        fix_distance: way of the car over which the autocorrelation of the error that successive
            pose fixes share falls to 1/e [m]; see ``PoseFix``.
        yaw_rate_noise: density of the white noise of the yaw rate (angle random walk)
            [rad/s / sqrt(Hz)].
        gnss_drift: standard deviation of a rate at which the error of GNSS may drift for up to
            150 s, to the east and to the north alike [m/s]; 0 for none. What such a drift may have
            changed of the pose unnoticed is in the stated covariance, see ``drift.possible``.

    Raises:
        ValueError: a standard deviation is negative, or a correlation time is not positive.
    """

    speed: GaussMarkov = GaussMarkov(0.05, 1.0)
    yaw_rate: GaussMarkov = GaussMarkov(math.radians(0.2), 1000.0)
    wheel_scale: GaussMarkov = GaussMarkov(0.01, 3600.0)
    gnss: GaussMarkov | None = None
    camera_offset: GaussMarkov = GaussMarkov(0.05, 20.0)
    camera_heading: GaussMarkov = GaussMarkov(math.radians(0.1), 100.0)
    fix_distance: float = 20.0
    yaw_rate_noise: float = math.radians(0.02)
    gnss_drift: float = 0.0

    #: Error of a single-frequency GNSS receiver on an open road [m].
    UNKNOWN_GNSS: ClassVar[GaussMarkov] = GaussMarkov(1.5, 60.0)

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if value is None:
                continue
            sigma, time = value if isinstance(value, tuple) else (value, math.inf)
            if not (0 <= sigma < math.inf and time > 0):
                raise ValueError(
                    f"{field.name} must have a finite standard deviation of 0 or more and a "
                    f"correlation time of more than 0 s, got {value!r}"
                )
        if not self.fix_distance > 0:
            raise ValueError(f"fix_distance must be more than 0 m, got {self.fix_distance!r}")

    @property
    def processes(self) -> tuple[GaussMarkov, ...]:
        """Processes in time, in the order of the states of the filter."""
        gnss = self.gnss or self.UNKNOWN_GNSS
        return (
            self.speed,
            self.yaw_rate,
            self.wheel_scale,
            gnss,
            gnss,
            self.camera_offset,
            self.camera_heading,
        )

    @property
    def sigmas(self) -> NDArray[np.float64]:
        """(10,) standard deviations of the processes, and 1 for the errors of the pose fixes."""
        return np.array([*(process.sigma for process in self.processes), *[1.0] * 3])

    @property
    def times(self) -> NDArray[np.float64]:
        """(10,) correlation times [s]; infinite for the pose fixes, which change with the way."""
        return np.array([*(process.time for process in self.processes), *[math.inf] * 3])
