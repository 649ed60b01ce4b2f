"""Faults of each sensor: a reported pose is never wrong for long, and is found again.

All durations and both kinds of cars: tools/evidence_sensor_faults.py.
"""

import math
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplines_can.testing.sensor_faults import FAULTS

TOOLS = Path(__file__).parents[2] / "tools"
SEEDS = 2


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The tool as a module."""
    monkeypatch.syspath_prepend(str(TOOLS))
    import evidence_sensor_faults

    return evidence_sensor_faults


@cache
def drive(cars: str) -> Any:
    import evidence_sensor_faults as tool

    return tool.drive_of(cars, SEEDS)


#: Faults that are also injected for 1 s and 30 s.
LONG = {"km/h as m/s", "off by 30 m", "ramp of 1 m/s to the north", "60 s ahead"}
CASES = [
    (fault, duration)
    for fault in FAULTS
    for duration in (1.0, 5.0, 30.0)
    # What is no measurement is dropped: see test_admission.py.
    if not any(word in fault.name for word in ("NaN", "infinite", "shape", "covariance"))
    if duration == 5.0 or fault.name in LONG
]


@pytest.mark.parametrize(
    ("fault", "duration"),
    CASES,
    ids=[f"{fault.sensor}-{fault.name}-{duration:g}s" for fault, duration in CASES],
)
def test_a_fault_is_noticed(tool: Any, fault: Any, duration: float) -> None:
    """The error of a reported pose exceeds 5 of its sigmas for no longer than stated."""
    cars = {"odometry": "no map", "gnss": "no map", "pose": "lidar"}.get(fault.sensor, "map")
    course = drive(cars).run(fault, duration)
    found = tool.figures(course, tool.LONGEST[cars])
    assert found["beyond [s]"] <= tool.LONGEST[cars], found
    assert found["known at the end"] == SEEDS, found


def test_a_ramp_across_a_straight_road_is_noticed_by_most(tool: Any) -> None:
    """The heading follows it, as nothing else measures it: 16 of 20 cars say so, in 3 s or so."""
    (fault,) = (one for one in FAULTS if one.name == "ramp of 1 m/s to the north")
    found = tool.figures(tool.drive_of("straight road", 20).run(fault, 30.0), math.inf)
    assert found["cars beyond for 10 s"] <= 6, found
    assert found["right at the end"] == 20, found


def test_the_figures_of_a_course_are_those_of_its_errors(tool: Any) -> None:
    """Of two cars: one is wrong for 3 s, the other one says so after 1 s, for 2 s."""
    k = 100
    errors, sigmas = np.zeros((k, 2, 3)), np.ones((k, 2, 3))
    known = np.full((k, 2), True)
    errors[20:50, 0, 2] = 6.0
    errors[10:30, 1, 0] = 50.0
    known[10:30, 1] = False
    course = tool.Course(tool.STEP * np.arange(k), known, errors, sigmas)
    found = tool.figures(course, 2.0)
    assert found["beyond [s]"] == pytest.approx(3.0)
    assert found["position beyond [s]"] == 0
    assert not found["met"]
    assert found["said after [s]"] == pytest.approx(1.0)
    assert found["cars without a pose"] == 1
    assert found["largest sigmas"] == 6.0
    assert tool.figures(course, 3.0)["met"]
    name = "gnss, frozen; map; 5 s"
    row = tool.table({name: found})[-1]
    assert row.startswith("| gnss, frozen | map | 5 s | 3 s | 0 s |")
    never = found | {"said after [s]": math.nan}
    assert "| - |" in tool.table({name: never})[-1]
