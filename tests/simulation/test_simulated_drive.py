"""The simulated car keeps its limits, and its pose is the integral of its motion."""

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import cumulative_trapezoid

from maplines_can import Polyline
from maplines_can.simulation import SimulatedDrive

STRAIGHT = Polyline(np.array([[0, 0], [400, 0]], float))


def winding(seed: int) -> Polyline:
    """A road with random bends."""
    random = np.random.default_rng(seed)
    turns = random.normal(0, 0.06, 12).repeat(20)
    heading = turns.cumsum() / 2
    return Polyline(np.column_stack([np.cos(heading), np.sin(heading)]).cumsum(axis=0) * 1.5)


def track(drive: SimulatedDrive, rate: float = 200.0) -> Any:
    """The states of a drive, at a rate [Hz]."""
    return drive.at(drive.times(rate))


@pytest.mark.parametrize(
    ("acceleration", "deceleration", "limit"), [(2.0, 2.0, 10.0), (1.0, 3.0, 13.9), (4.0, 0.7, 8.0)]
)
def test_straight_road_in_closed_form(
    acceleration: float, deceleration: float, limit: float
) -> None:
    """Constant acceleration, constant speed, constant deceleration."""
    drive = SimulatedDrive(STRAIGHT, limit, acceleration=acceleration, deceleration=deceleration)
    rise, fall = limit / acceleration, limit / deceleration
    cruise = 400 / limit - (rise + fall) / 2
    assert drive.duration == pytest.approx(rise + cruise + fall, abs=2e-3)
    t = np.linspace(0, rise * 0.98, 50)
    state = drive.at(t)
    np.testing.assert_allclose(state.pose[:, 0], acceleration * t**2 / 2, atol=1e-6)
    np.testing.assert_allclose(state.speed, acceleration * t, atol=1e-6)
    state = drive.at(drive.duration - np.linspace(0, fall * 0.98, 50))
    left = np.linspace(0, fall * 0.98, 50)
    np.testing.assert_allclose(400 - state.pose[:, 0], deceleration * left**2 / 2, atol=1e-4)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_pose_is_the_integral_of_the_motion(seed: int) -> None:
    """Speed and yaw rate, integrated by scipy, give the pose within 0.1 mm."""
    drive = SimulatedDrive(winding(seed), 15.0, stops=[(120.0, 2.0)])
    state = drive.at(np.linspace(0, drive.duration, 100_001))
    turn = cumulative_trapezoid(state.yaw_rate, state.t, initial=0.0)
    heading = state.pose[0, 2] + turn
    velocity = state.speed * np.array([np.cos(heading), np.sin(heading)])
    integral = np.column_stack([*cumulative_trapezoid(velocity, state.t, initial=0.0), heading])
    np.testing.assert_allclose(integral + np.append(state.pose[0, :2], 0.0), state.pose, atol=1e-4)


@settings(max_examples=25, deadline=None)
@given(
    st.integers(0, 10**6),
    st.floats(0.5, 4.0),
    st.floats(0.5, 4.0),
    st.floats(0.5, 4.0),
    st.lists(st.tuples(st.integers(1, 350), st.floats(0, 5)), max_size=4),
)
@example(709, 1.0, 2.0, 0.5, [(8, 0.0)])  # the curvature peaks between two points of the profile
def test_all_limits_are_kept(
    seed: int, rise: float, fall: float, lateral: float, stops: list[tuple[int, float]]
) -> None:
    """Speed, and acceleration along and across, at all times on random roads with stops."""
    road = winding(seed)
    stops = sorted(dict(stops).items())
    half = road.length / 2
    drive = SimulatedDrive(
        road,
        [(0.0, 14.0), (half, 7.0)],
        stops=stops,
        acceleration=rise,
        deceleration=fall,
        lateral_acceleration=lateral,
    )
    state = track(drive, 100.0)
    s = np.append(0, np.hypot(*np.diff(state.pose[:, :2], axis=0).T).cumsum())
    slack = 1.005
    assert state.speed.max() <= 14.0 * slack
    assert state.speed[s > half + 1].max() <= 7.0 * slack
    along = np.diff(state.speed) * 100
    assert -fall * slack - 1e-6 <= along.min()
    assert along.max() <= rise * slack + 1e-6
    assert np.abs(state.speed * state.yaw_rate).max() <= lateral * slack
    assert (state.speed >= 0).all()
    assert state.speed[0] == 0


def test_stops() -> None:
    """The car stands at each stop for its time, and nowhere else."""
    stops = [(0.0, 1.5), (100.0, 3.0), (100.4, 0.5), (400.0, 2.0)]
    drive = SimulatedDrive(STRAIGHT, 10.0, stops=stops)
    state = track(drive, 1000.0)
    standing = state.speed < 1e-9
    for s, dwell in stops:
        here = standing & (np.abs(state.pose[:, 0] - s) < 1e-6)
        assert here.sum() / 1000 == pytest.approx(dwell, abs=0.01)
    assert standing.sum() / 1000 == pytest.approx(7.0, abs=0.02)
    without = SimulatedDrive(STRAIGHT, 10.0, stops=[(s, 0.0) for s, _ in stops])
    assert drive.duration == pytest.approx(without.duration + 7.0)


@pytest.mark.parametrize("radius", [10.0, 30.0])
def test_a_drive_has_the_limits_of_a_calm_driver(radius: float) -> None:
    """Unless others are given: 50 km/h, 2 m/s^2 along and across, from rest to rest."""
    straight = SimulatedDrive(Polyline([[0.0, 0.0], [600.0, 0.0]]))
    rise = 50 / 3.6 / 2
    assert straight.at(straight.duration / 2).speed == pytest.approx(50 / 3.6)
    assert straight.duration == pytest.approx(600 / (50 / 3.6) + rise, abs=0.01)
    assert straight.at(0.0).speed == 0
    assert straight.at(straight.duration).speed == pytest.approx(0.0, abs=1e-6)
    assert straight.at(rise / 2).speed == pytest.approx(rise, rel=0.01)
    assert straight.at(straight.duration - rise / 2).speed == pytest.approx(rise, rel=0.01)
    a = np.linspace(0, 2.5 * np.pi, 600)
    bend = SimulatedDrive(
        Polyline(np.column_stack([radius * np.sin(a), radius * (1 - np.cos(a))])), 50.0
    )
    assert bend.at(bend.duration / 2).speed == pytest.approx(np.sqrt(2.0 * radius), rel=0.01)


@pytest.mark.parametrize("at", [12.3451, 12.3456, 30.0004, 49.9989, 49.9995])
def test_a_stop_is_at_its_place(at: float) -> None:
    """Within a millimetre of it, also next to the end of the path."""
    drive = SimulatedDrive(Polyline([[0.0, 0.0], [50.0, 0.0]]), 20.0, stops=[(at, 4.0)])
    state = drive.at(drive.times(20.0))
    standing = state.pose[state.speed < 1e-9, 0]
    there = standing[(standing > 1.0) & (np.abs(standing - at) < 0.1)]
    assert len(there) >= 79
    assert np.abs(there - at).max() <= 1.1e-3
