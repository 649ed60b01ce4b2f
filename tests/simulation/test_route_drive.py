"""Drives along routes."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.lane_maps import lane, network

from maplines_can.maps import Map, Route
from maplines_can.maps.line_source import LineSource
from maplines_can.simulation import PoseSource
from maplines_can.simulation.trajectory import drive_along

LANES = [lane("a", length=100.0), lane("b", (100.0, 0.0, 0.0), 100.0)]


def road(*limits: float | None) -> Map:
    lanes = [replace(one, speed_limit=v) for one, v in zip(LANES, limits, strict=True)]
    return network(*lanes, links={"a": "b"})


@pytest.mark.parametrize("start", ["a", (40.0, 0.0, 0.0)])
def test_the_car_keeps_the_limits_of_the_lanes(start: str | tuple[float, float, float]) -> None:
    """Also from within a lane; a lane without a limit has the default one."""
    found = road(10.0, None)
    route = found.route(start, "b")
    drive = drive_along(found, route, default_speed=5.0)
    state = drive.at(drive.times(50.0))
    assert drive.path.length == pytest.approx(route.length)
    assert state.pose[0, 0] == pytest.approx(0.0 if start == "a" else 40.0)
    assert state.pose[-1, 0] == pytest.approx(200.0, abs=1e-3)
    before = state.pose[:, 0] < 100.0
    assert state.speed[before].max() == pytest.approx(10.0, abs=0.1)
    assert state.speed[~before].max() <= 5.0 + 1e-6


def test_a_route_without_length_is_refused() -> None:
    found = road(None, None)
    route = found.route((40.0, 0.0, 0.0), (40.2, 0.0, 0.0))
    assert isinstance(route, Route)
    with pytest.raises(ValueError, match=r"0\.2 m, but a drive needs 1 m or more"):
        drive_along(found, route)


def test_the_lines_of_a_drive_are_those_from_4_m_behind_to_80_m_ahead() -> None:
    """Unless another range is given."""
    found = road(None, None)
    for window, ends in ((None, (-4.0, 80.0)), ((-5.0, 30.0), (-5.0, 30.0))):
        settings: dict[str, Any] = {} if window is None else {"window": window}
        source = LineSource(found, PoseSource((1e-4, 1e-4, 1e-6)).pose, **settings)
        cycle = source.cycle(0.0, np.array([100.0, 0.0, 0.0]))
        for line in cycle.lines:
            assert (line.x_min, line.x_max) == pytest.approx(ends, abs=0.05)


def test_a_limit_that_changes_in_a_lane_holds_from_there() -> None:
    """From s to s of each lane, also if the route begins behind it."""
    limits = ((0.0, 20.0), (50.0, 8.0), (70.0, None))
    first, second = (replace(one, speed_limits=limits) for one in LANES)
    found = network(first, replace(second, speed_limits=(), speed_limit=12.0), links={"a": "b"})
    for start in ("a", (40.0, 0.0, 0.0), (60.0, 0.0, 0.0)):
        drive = drive_along(found, found.route(start, "b"), acceleration=9.0, start_speed=0.0)
        state = drive.at(drive.times(100.0))
        x = state.pose[:, 0]
        for low, high, most in ((0, 50, 20.0), (50, 70, 8.0), (70, 100, 50 / 3.6), (100, 200, 12)):
            inside = (x > low + 0.01) & (x < high - 0.01)
            assert not inside.any() or state.speed[inside].max() <= most + 1e-6
        assert state.speed[(x > 90) & (x < 99)].max() > 12.0


@pytest.mark.parametrize(("own", "other"), [(20.0, 10.0), (10.0, 20.0)])
def test_in_a_lane_change_the_limit_changes_half_way(own: float, other: float) -> None:
    lanes = [replace(lane("l", t=3.5), speed_limit=own), replace(lane("r"), speed_limit=other)]
    found = network(*lanes, rows=["l r"])
    route = found.route("l", "r")
    drive = drive_along(found, route, acceleration=9.0, lateral_acceleration=9.0)
    state = drive.at(drive.times(100.0))
    (change,) = route.changes
    half = (change.start + change.end) / 2
    x = state.pose[:, 0]
    assert state.speed[x < half - 0.1].max() <= own + 1e-6
    assert state.speed[x > half + 0.1].max() <= other + 1e-6
    assert state.speed.max() > 12.0


def test_limits_within_the_lanes_of_a_route_hold_where_the_car_is_on_them() -> None:
    """Neither that of a lane that it has left, nor one counted from the start of the route."""
    second = replace(LANES[1], speed_limits=((0.0, 20.0), (30.0, 6.0)))
    found = network(replace(LANES[0], speed_limit=20.0), second, links={"a": "b"})
    state = (drive := drive_along(found, found.route("a", "b"), acceleration=9.0)).at(
        drive.times(100.0)
    )
    x = state.pose[:, 0]
    assert state.speed[x > 130.1].max() <= 6.0 + 1e-6
    assert state.speed[(x > 50) & (x < 110)].min() > 6.5
    left = replace(lane("l", t=3.5), speed_limits=((0.0, 10.0), (100.0, 5.0)))
    beside = network(left, replace(lane("r"), speed_limit=12.0), rows=["l r"])
    state = (drive := drive_along(beside, beside.route("l", "r"))).at(drive.times(10.0))
    assert state.speed[state.pose[:, 0] > 100].max() == pytest.approx(12.0, abs=0.05)
