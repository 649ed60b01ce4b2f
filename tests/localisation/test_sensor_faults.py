"""Faults of each sensor: a reported pose is never wrong for long, and is found again.

All durations and kinds of cars: tools/evidence sensor_faults.faults.
"""

from functools import cache
from typing import Any

import numpy as np
import pytest
from evidence import sensor_faults as tool
from evidence.harness import bounds_of, missed

from maplines_can.testing.sensor_faults import FAULTS

SEEDS = 2


@cache
def drive(cars: str) -> Any:
    return tool.drive_of(cars, SEEDS)


#: Every second one; what is no measurement is dropped: see test_admission.py.
CASES = [
    fault
    for fault in FAULTS
    if not any(word in fault.name for word in ("NaN", "infinite", "shape", "covariance"))
][::2]


@pytest.mark.parametrize("fault", CASES, ids=lambda fault: f"{fault.sensor}-{fault.name}")
def test_a_fault_is_noticed(fault: Any) -> None:
    """The error of a reported pose exceeds 5 of its sigmas for no longer than stated."""
    cars = {"odometry": "no map", "gnss": "no map", "pose": "lidar"}.get(fault.sensor, "map")
    course = drive(cars).run(fault, 5.0)
    figures = {f"{fault.sensor}, {fault.name}; {cars}; 5 s": tool.figures(course)}
    assert not [*missed(figures, bounds_of("sensor_faults.faults", quick=False))]


def test_the_figures_of_a_course_are_those_of_its_errors() -> None:
    """Of two cars: one is wrong for 3 s, the other one says so after 1 s, for 2 s."""
    k = 100
    errors, sigmas = np.zeros((k, 2, 3)), np.ones((k, 2, 3))
    known = np.full((k, 2), True)
    errors[20:50, 0, 2] = 6.0
    errors[10:30, 1, 0] = 50.0
    known[10:30, 1] = False
    course = tool.Course(tool.STEP * np.arange(k, dtype=float), known, errors, sigmas)
    found = tool.figures(course)
    assert found["beyond [s]"] == pytest.approx(3.0)
    assert found["position beyond [s]"] == 0
    assert found["said after [s]"] == pytest.approx(1.0)
    assert found["cars without a pose"] == 1
