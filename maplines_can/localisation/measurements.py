"""Measurements that a localisation takes.

Each is of one time and of n cars, whose filters run side by side in a study; one car has n = 1.
What is missing is NaN.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Odometry(NamedTuple):
    """Wheel speed and yaw rate, such as those of one message of the ESC."""

    t: float  #: [s]
    wheel_speed: Array  #: (n,) [m/s]
    yaw_rate: Array  #: (n,) positive to the left [rad/s]


class GnssFix(NamedTuple):
    """GNSS position in the map frame, of the origin of the ego frame.

    A receiver that knows how large the error is that a position shares with those before and after
    it, states it as ``error``, such as ``GaussMarkov(15.0, 20.0)``, with each fix. It holds until
    the next fix, and overrides ``SensorErrors.gnss``.
    """

    t: float  #: [s]
    position: Array  #: (n, 2) x, y [m]
    cov: Array  #: (n, 2, 2) or (2, 2), of its white noise; the bias is a state [m^2]
    #: (2,) or (n, 2) standard deviation [m] and correlation time [s] of its correlated error; None,
    #: or NaN for a car, if it is not known
    error: Array | tuple[float, float] | None = None


class CameraLines(NamedTuple):
    """Lines that a camera sees, where they cross the y axis of the ego frame.

    Lines that are not horizontal neighbours in the image may be in any order.
    """

    t: float  #: [s]
    offset: Array  #: (n, L) y_off [m]
    heading: Array  #: (n, L) beta [rad]
    kind: NDArray[np.intp]  #: (n, L) values of ``Kind``; UNKNOWN matches each
    cov: Array  #: (2, 2) of the white noise of y_off and beta of a line


class SeenLandmarks(NamedTuple):
    """Landmarks that a camera or a lidar sees, in the ego frame."""

    t: float  #: [s]
    position: Array  #: (n, K, 2) x ahead, y to the left [m]
    cov: Array  #: (n, K, 2, 2) or (2, 2) [m^2]


class PoseFix(NamedTuple):
    """Pose in the map frame with its covariance, such as that of a scan matching.

    An error that it shares with the poses before and after it, such as that of the map, does not
    average out: give its covariance as ``shared``, and not in ``cov``.
    """

    t: float  #: [s]
    pose: Array  #: (n, 3) x [m], y [m], heading [rad]
    cov: Array  #: (n, 3, 3) or (3, 3), of its white noise
    shared: Array | None = None  #: (n, 3, 3) or (3, 3), positive semidefinite; None for none


Observation = GnssFix | CameraLines | SeenLandmarks | PoseFix
Measurement = Odometry | Observation
