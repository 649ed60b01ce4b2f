"""Odometry: what no car can do, stamps that jump, and what is not known in a gap."""

import math
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can import Gaussian
from maplines_can.localisation import CarLimits, Localisation, Odometry
from maplines_can.localisation.odometry_stream import CONFIRM, OdometryStream

DT = 0.02
LIMITS = CarLimits()
START = Gaussian(np.zeros(3), np.diag([0.1, 0.1, 0.001]) ** 2)


def odometry(t: float, speed: float = 15.0, rate: float = 0.0) -> Odometry:
    return Odometry(t, np.array([speed]), np.array([rate]))


def driven(seconds: float = 2.0, speed: float = 15.0) -> Localisation:
    found = Localisation(START)
    for i in range(round(seconds / DT) + 1):
        found.add(odometry(i * DT, speed))
    return found


@pytest.mark.parametrize(
    ("speed", "rate", "reason"),
    [
        (15.0, 0.19, "USED"),
        (15.0, 0.2 + 15 * DT + 0.01, "ACCELERATION"),
        (15.0, 1.01, "YAW_RATE"),  # 15.15 m/s^2 across
        (15.0, 57.0, "YAW_RATE"),
        (15.0, -57.0, "YAW_RATE"),
        (16.7, 0.0, "USED"),
        (15 + 1.5 + 15 * DT + 0.01, 0.0, "ACCELERATION"),
        (0.0, 0.0, "ACCELERATION"),
        (54.0, 0.0, "ACCELERATION"),  # km/h
        (101.0, 0.0, "SPEED"),
        (math.nan, 0.0, "INVALID"),
        (math.inf, 0.0, "INVALID"),
        (15.0, math.nan, "INVALID"),
    ],
)
def test_a_sample_that_no_car_gives_is_refused(speed: float, rate: float, reason: str) -> None:
    """It turns the pose by nothing; the next good sample goes on."""
    found = driven()
    before = found.counts()["odometry"]["USED"]
    found.add(odometry(2.0 + DT, speed, rate))
    counts = found.counts()["odometry"]
    assert counts[reason] == (before + 1 if reason == "USED" else 1)
    found.add(odometry(2.0 + 2 * DT))
    ego = found.ego()
    assert ego is not None
    if reason != "USED":
        assert ego.mean == pytest.approx([15 * (2 + 2 * DT), 0, 0], abs=1e-9)


@given(st.floats(allow_nan=True), st.floats(allow_nan=True), st.integers(1, 40))
def test_a_burst_of_anything_turns_the_car_by_no_more_than_its_limits(
    speed: float, rate: float, count: int
) -> None:
    """Or the pose is not known."""
    found = driven(1.0)
    for i in range(count):
        found.add(odometry(1.0 + (i + 1) * DT, speed, rate))
    for i in range(count, 60):
        found.add(odometry(1.0 + (i + 1) * DT))
    ego, most = found.ego(), 61 * DT * LIMITS.yaw_rate
    assert ego is None or abs(ego.mean[2]) <= most
    assert abs(found.poses().mean[0, 2]) <= most


def test_a_stamp_ahead_is_refused_until_others_continue_from_it() -> None:
    """One of 60 s ahead does not stop what comes after it; a stream that moves on is followed."""
    found = driven()
    found.add(odometry(62.0))
    assert found.t == 2.0
    for i in range(1, 11):
        found.add(odometry(2.0 + i * DT))
    assert found.t == pytest.approx(2.2)
    assert found.counts()["odometry"] == {"USED": 111, "AHEAD": 1}
    assert found.ego() is not None
    for i in range(CONFIRM):
        assert found.t == pytest.approx(2.2)
        found.add(odometry(62.0 + i * DT))
    assert found.t == pytest.approx(62.0 + (CONFIRM - 1) * DT)
    assert found.ego() is None  # a minute of odometry is missing


def test_a_clock_that_is_set_back_is_followed() -> None:
    """After as many stamps; the pose is then not known."""
    found = driven(70.0, 0.0)
    for i in range(CONFIRM):
        assert found.t == 70.0
        found.add(odometry(10.0 + i * DT, 0.0))
    assert found.t == pytest.approx(10.0 + (CONFIRM - 1) * DT)
    assert found.ego() is None
    assert found.ego(5.0) is None  # nothing is asked of a pose that is not known


@pytest.mark.parametrize("gap", [0.05, 0.3, 0.9, 1.9, 2.1, 5.0])
def test_a_gap_widens_the_pose_by_what_a_car_may_do_in_it(gap: float) -> None:
    """At once when it is asked for, and after it; beyond the longest gap, it is not known."""
    found, free = driven(), max(gap - LIMITS.unnoticed, 0.0)
    before, ahead = found.ego(), found.ego(2.0 + gap)
    for i in range(CONFIRM + 1):
        found.add(odometry(2.0 + gap + i * DT))
    if gap > LIMITS.gap:
        assert ahead is None
        assert found.ego() is None
        return
    assert before is not None
    assert ahead is not None
    along = LIMITS.sigma_acceleration * free**2 / 2
    turn = LIMITS.sigma_yaw_acceleration * free**2 / 2
    after = found.ego()
    assert after is not None
    for one in (ahead, after):
        assert one.sigma[0] >= math.hypot(before.sigma[0], along) * (1 - 1e-9)
        assert one.sigma[2] >= math.hypot(before.sigma[2], turn) * (1 - 1e-9)


def test_the_noise_of_a_gap_does_not_depend_on_its_steps() -> None:
    stream, since, speed = OdometryStream(2, 0.0, LIMITS), np.array([0.0, 0.5]), np.full(2, 10.0)
    times = np.sort(np.random.default_rng(1).uniform(0, 2, 9))
    once = stream.gap_noise(times[0], times[-1], since, speed)
    steps = [stream.gap_noise(a, b, since, speed) for a, b in pairwise(times)]
    np.testing.assert_allclose(np.sum(steps, axis=0), once)


def test_odometry_that_stays_refused_is_none() -> None:
    """Then neither what was before nor what comes after it is known to be right."""
    found = driven()
    for i in range(1, 41):
        found.add(odometry(2.0 + i * DT, 54.0))
        assert (found.ego() is None) == (i * DT > LIMITS.refused)
