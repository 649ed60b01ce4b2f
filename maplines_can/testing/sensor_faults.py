"""Faults of the sensors of a localisation, injected into simulated measurements.

A fault changes each measurement of its sensor from its begin to its end.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from ..localisation import CameraLines, GnssFix, Odometry, PoseFix, SeenLandmarks
from ..localisation.measurements import Measurement
from ..simulation.sensors import Arrival


class FaultedMeasurement(NamedTuple):
    """A measurement that a fault changes."""

    one: Any  #: the measurement
    t: float  #: since the begin of the fault [s]
    last: Any  #: measurement of this sensor before the fault


#: Returns the measurement that arrives instead; None for none.
Change = Callable[[FaultedMeasurement], Any]


class SensorFault(NamedTuple):
    """A fault of a sensor."""

    sensor: str  #: "odometry", "gnss", "lines", "landmarks" or "pose"
    name: str
    change: Change


SENSORS: dict[str, type] = {
    "odometry": Odometry,
    "gnss": GnssFix,
    "lines": CameraLines,
    "landmarks": SeenLandmarks,
    "pose": PoseFix,
}


def _frozen(at: FaultedMeasurement) -> Any:
    return at.last._replace(t=at.one.t)


def _dropped(_: FaultedMeasurement) -> None:
    return None


def _with(**values: Any) -> Change:
    return lambda at: at.one._replace(**values)


def _stamped(by: float) -> Change:
    return lambda at: at.one._replace(t=at.one.t + by)


def _scaled(field: str, factor: ArrayLike) -> Change:
    return lambda at: at.one._replace(**{field: getattr(at.one, field) * np.asarray(factor)})


def _moved(field: str, *by: float) -> Change:
    return lambda at: at.one._replace(**{field: getattr(at.one, field) + np.array(by)})


def _ramp(field: str, *rate: float) -> Change:
    return lambda at: at.one._replace(**{field: getattr(at.one, field) + at.t * np.array(rate)})


def _set(field: str, value: float) -> Change:
    return lambda at: at.one._replace(**{field: np.full_like(getattr(at.one, field), value)})


def _noisy(field: str, sigma: float) -> Change:
    rng = np.random.default_rng(3)

    def change(at: FaultedMeasurement) -> Any:
        value = getattr(at.one, field)
        return at.one._replace(**{field: value + sigma * rng.standard_normal(value.shape)})

    return change


def _still(at: FaultedMeasurement) -> Any:
    return at.one._replace(wheel_speed=0 * at.one.wheel_speed, yaw_rate=0 * at.one.yaw_rate)


#: The faults by the sensors that they need.
FAULTS = (
    SensorFault("odometry", "yaw rate 57 rad/s", _set("yaw_rate", 57.0)),
    SensorFault("odometry", "yaw rate + 0.3 rad/s", _moved("yaw_rate", 0.3)),
    SensorFault("odometry", "yaw rate + 0.05 rad/s", _moved("yaw_rate", 0.05)),
    SensorFault("odometry", "yaw rate with the other sign", _scaled("yaw_rate", -1.0)),
    SensorFault("odometry", "yaw rate in deg/s", _scaled("yaw_rate", math.degrees(1.0))),
    SensorFault("odometry", "km/h as m/s", _scaled("wheel_speed", 3.6)),
    SensorFault("odometry", "wheel speed + 3 m/s", _moved("wheel_speed", 3.0)),
    SensorFault("odometry", "wheel speed 0", _scaled("wheel_speed", 0.0)),
    SensorFault("odometry", "wheel speed and yaw rate 0", _still),
    SensorFault("odometry", "frozen", _frozen),
    SensorFault("odometry", "dropped", _dropped),
    SensorFault("odometry", "NaN", _set("yaw_rate", math.nan)),
    SensorFault("odometry", "infinite", _set("wheel_speed", math.inf)),
    SensorFault("odometry", "of shape (7,)", _with(wheel_speed=np.zeros(7))),
    SensorFault("odometry", "60 s ahead", _stamped(60.0)),
    SensorFault("odometry", "60 s late", _stamped(-60.0)),
    SensorFault("odometry", "time NaN", _with(t=math.nan)),
    SensorFault("gnss", "off by 30 m", _moved("position", 30.0, 0.0)),
    SensorFault("gnss", "off by 8 m", _moved("position", 0.0, 8.0)),
    SensorFault("gnss", "ramp of 1 m/s to the east", _ramp("position", 1.0, 0.0)),
    SensorFault("gnss", "ramp of 1 m/s to the north", _ramp("position", 0.0, 1.0)),
    SensorFault("gnss", "frozen", _frozen),
    SensorFault("gnss", "noise of 5 m", _noisy("position", 5.0)),
    SensorFault("gnss", "dropped", _dropped),
    SensorFault("gnss", "60 s ahead", _stamped(60.0)),
    SensorFault("gnss", "0.4 s late", _stamped(0.4)),
    SensorFault("gnss", "time NaN", _with(t=math.nan)),
    SensorFault("gnss", "infinite", _set("position", math.inf)),
    SensorFault("gnss", "at (0, 0)", _set("position", 0.0)),
    SensorFault("gnss", "covariance (3, 3)", _with(cov=np.eye(3))),
    SensorFault("gnss", "covariance negative", _with(cov=-np.eye(2))),
    SensorFault("gnss", "covariance not symmetric", _with(cov=np.array([[1.0, 0.9], [0.0, 1.0]]))),
    SensorFault("gnss", "covariance 0", _with(cov=np.zeros((2, 2)))),
    SensorFault("lines", "off by 1 m", _moved("offset", 1.0)),
    SensorFault("lines", "ramp of 0.2 m/s", _ramp("offset", 0.2)),
    SensorFault("lines", "turned by 3 deg", _moved("heading", math.radians(3.0))),
    SensorFault("lines", "left and right swapped", _scaled("offset", -1.0)),
    SensorFault("lines", "frozen", _frozen),
    SensorFault("lines", "dropped", _dropped),
    SensorFault("lines", "covariance negative", _with(cov=-np.eye(2))),
    SensorFault("lines", "infinite", _set("offset", math.inf)),
    SensorFault("landmarks", "off by 5 m", _moved("position", 5.0, 0.0)),
    SensorFault("landmarks", "mirrored", _scaled("position", -1.0)),
    SensorFault("landmarks", "frozen", _frozen),
    SensorFault("landmarks", "covariance NaN", _with(cov=np.full((2, 2), math.nan))),
    SensorFault("pose", "off by 5 m", _moved("pose", 3.0, 4.0, 0.0)),
    SensorFault("pose", "ramp of 0.5 m/s", _ramp("pose", 0.5, 0.0, 0.0)),
    SensorFault("pose", "turned by 10 deg", _moved("pose", 0.0, 0.0, math.radians(10.0))),
    SensorFault("pose", "heading in degrees",
                _scaled("pose", [1, 1, math.degrees(1.0)])),
    SensorFault("pose", "frozen", _frozen),
    SensorFault("pose", "infinite", _set("pose", math.inf)),
    SensorFault("pose", "covariance (2, 2)", _with(cov=np.eye(2))),
)  # fmt: skip


def injected(
    arrivals: Iterable[Arrival], fault: SensorFault, begin: float, end: float
) -> Iterator[Arrival]:
    """Yield measurements as they arrive, with a fault of those of a time.

    Args:
        arrivals: in order.
        fault: the fault.
        begin: of the fault, by the stamps of the measurements [s].
        end: of it [s]; the first measurement has it in any case.
    """
    last: Measurement | None = None
    count = 0
    for t, one in arrivals:
        if not isinstance(one, SENSORS[fault.sensor]):
            yield Arrival(t, one)
        elif begin <= one.t < end or (one.t >= end and not count):
            count += 1
            changed = fault.change(FaultedMeasurement(one, one.t - begin, last or one))
            if changed is not None:
                yield Arrival(t, changed)
        else:
            last = one
            yield Arrival(t, one)
