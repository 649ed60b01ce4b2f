"""What no sensor can give is refused with a reason, and stops nothing that comes after it."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from maplines_can import Gaussian
from maplines_can.localisation import (
    CameraLines,
    GnssFix,
    Localisation,
    Odometry,
    PoseFix,
    SeenLandmarks,
)

DT = 0.02
START = Gaussian(np.zeros(3), np.diag([1.0, 1.0, 0.02]) ** 2)
POSITION, COV = np.array([[5.0, 0.0]]), 0.25 * np.eye(2)
LINES = CameraLines(
    0.5, np.array([[1.7, -1.8]]), np.zeros((1, 2)), np.ones((1, 2), dtype=int), 0.01 * np.eye(2)
)
LANDMARKS = SeenLandmarks(0.5, np.array([[[10.0, 3.0]]]), 0.1 * np.eye(2))
POSE = PoseFix(0.5, np.array([[5.0, 0.0, 0.0]]), 0.01 * np.eye(3))
FIX: Any = GnssFix(0.5, POSITION, COV)


def driven(*measurements: Any) -> Localisation:
    """Return a localisation after a second of odometry, these, another second, and a fix."""
    localisation = Localisation(START)
    for i in range(51):
        localisation.add(Odometry(i * DT, np.array([10.0]), np.zeros(1)))
    for one in measurements:
        localisation.add(one)
    for i in range(51, 101):
        localisation.add(Odometry(i * DT, np.array([10.0]), np.zeros(1)))
    localisation.add(GnssFix(1.9, np.array([[19.5, 0.3]]), COV))
    return localisation


def assert_unchanged(found: Localisation) -> None:
    """Assert that the pose is as without the measurement, and known."""
    one, other = found.ego(), driven().ego()
    assert one is not None
    assert other is not None
    np.testing.assert_array_equal(one.mean, other.mean)
    np.testing.assert_array_equal(one.cov, other.cov)


@pytest.mark.parametrize(
    ("one", "reason"),
    [
        (FIX._replace(t=math.nan), "INVALID"),
        (FIX._replace(t=-math.inf), "INVALID"),
        (FIX._replace(t="now"), "INVALID"),
        (FIX._replace(t=None), "INVALID"),
        (FIX._replace(position=np.array([[np.inf, 0.0]])), "INVALID"),
        (FIX._replace(position=np.array([[1e11, 0.0]])), "INVALID"),
        (FIX._replace(position=np.zeros((1, 3))), "INVALID"),
        (FIX._replace(position="here"), "INVALID"),
        (FIX._replace(position=np.zeros((1, 2), dtype=complex)), "INVALID"),
        (FIX._replace(cov=np.eye(3)), "INVALID"),
        (FIX._replace(cov=np.zeros((2, 2, 2))), "INVALID"),
        (FIX._replace(cov=-COV), "COVARIANCE"),
        (FIX._replace(cov=np.diag([1.0, -1e-6])), "COVARIANCE"),
        (FIX._replace(cov=np.full((2, 2), np.nan)), "COVARIANCE"),
        (FIX._replace(cov=np.diag([np.inf, 1.0])), "COVARIANCE"),
        (FIX._replace(cov=np.array([[1.0, 0.5], [0.4, 1.0]])), "COVARIANCE"),
        (FIX._replace(cov=np.array([[1.0, 1.5], [1.5, 1.0]])), "COVARIANCE"),
        (FIX._replace(cov=np.array([[0.0, 0.1], [0.1, 1.0]])), "COVARIANCE"),
        (POSE._replace(cov=np.eye(2)), "INVALID"),
        (POSE._replace(shared=np.eye(2)), "INVALID"),
        (POSE._replace(shared=-np.eye(3)), "COVARIANCE"),
        (POSE._replace(pose=np.array([[0.0, 0.0, np.inf]])), "INVALID"),
        (LINES._replace(cov=np.zeros((2, 2))), "COVARIANCE"),
        (LINES._replace(cov=np.eye(3)), "INVALID"),
        (LINES._replace(heading=np.zeros((1, 3))), "INVALID"),
        (LINES._replace(offset=np.zeros(2), heading=np.zeros(2)), "INVALID"),
        (LINES._replace(kind=np.array([["solid", "solid"]])), "INVALID"),
        (LINES._replace(offset=np.full((1, 2), -np.inf)), "INVALID"),
        (LANDMARKS._replace(cov=np.array([[1.0, 1.0], [1.0, 1.0]])), "COVARIANCE"),
        (LANDMARKS._replace(position=np.zeros((1, 1, 3))), "INVALID"),
        (LANDMARKS._replace(position=np.zeros(2)), "INVALID"),
    ],
)
def test_what_is_no_measurement_is_refused(one: Any, reason: str) -> None:
    """Counted with a reason, without effect, and what comes after it is used."""
    found = driven(one)
    assert found.counts()[type(one).__name__] == {reason: 1}
    assert_unchanged(found)


NUMBERS = st.floats(width=64) | st.sampled_from([0.0, 1.0, -1.0, 1e300, -1e-300, np.nan, np.inf])
SHAPES = st.sampled_from(
    [(), (1,), (2,), (3,), (1, 1), (1, 2), (1, 3), (2, 2), (3, 3), (1, 2, 2), (1, 3, 3), (1, 1, 2),
     (1, 2, 2, 2), (0, 2), (1, 0), (1, 0, 2)]
)  # fmt: skip
ARRAYS = SHAPES.flatmap(lambda shape: hnp.arrays(float, shape, elements=NUMBERS)) | NUMBERS
TIMES = st.floats() | st.floats(0.4, 1.2)


@given(st.data())
def test_nothing_that_a_sensor_sends_raises(data: st.DataObject) -> None:
    """Whatever the shapes and numbers are; the filter then still takes a good position."""
    draw, t = data.draw, data.draw(TIMES)
    hostile = draw(
        st.one_of(
            st.builds(Odometry, st.just(t), ARRAYS, ARRAYS),
            st.builds(GnssFix, st.just(t), ARRAYS, ARRAYS),
            st.builds(PoseFix, st.just(t), ARRAYS, ARRAYS, st.none() | ARRAYS),
            st.builds(SeenLandmarks, st.just(t), ARRAYS, ARRAYS),
            st.builds(
                CameraLines, st.just(t), ARRAYS, ARRAYS, st.just(np.ones((1, 1), int)), ARRAYS
            ),
        )
    )
    with np.errstate(over="ignore", invalid="ignore"):
        found = driven(hostile)
    assert found.t == pytest.approx(2.0)
    pose = found.poses()
    assert np.isfinite(pose.mean).all()
    assert np.isfinite(pose.cov).all()


def test_a_caller_who_adds_no_measurement_is_told() -> None:
    with pytest.raises(TypeError, match="must be Odometry, GnssFix"):
        driven(3.0)


@pytest.mark.parametrize("kind", [GnssFix, PoseFix])
def test_the_second_of_two_exact_fixes_at_one_time_is_refused(kind: Any) -> None:
    """The first one leaves nothing to compare it with; fixes at other times are used."""
    m = 2 if kind is GnssFix else 3
    exact = [kind(t, np.array([[10 * t, 0.0, 0.0]])[:, :m], np.zeros((m, m))) for t in (0.6, 0.8)]
    found = driven(exact[0], exact[0], exact[1])
    for i in range(101, 140):
        found.add(Odometry(i * DT, np.array([10.0]), np.zeros(1)))
    counts = found.counts()["gnss" if kind is GnssFix else "pose"]
    assert counts["SINGULAR"] == 1
    assert counts["USED"] >= 2
    assert found.ego() is not None


def test_a_wrong_car_does_not_harm_the_others() -> None:
    """In a study of several cars, the values of one are refused, and those of the others used."""
    cov = np.diag([1.0, 1.0, 0.02]) ** 2
    both, alone = Localisation(np.zeros((2, 3)), cov=cov), Localisation(np.zeros((1, 3)), cov=cov)
    for one, n in ((both, 2), (alone, 1)):
        for i in range(51):
            one.add(Odometry(i * DT, np.full(n, 10.0), np.zeros(n)))
    covs = np.stack([COV, -COV])
    both.add(GnssFix(0.5, np.array([[5.5, 0.2], [5.5, 0.2]]), covs))
    alone.add(GnssFix(0.5, np.array([[5.5, 0.2]]), COV))
    assert both.counts()["GnssFix"] == {"COVARIANCE": 1}
    np.testing.assert_array_equal(both.poses().mean[0], alone.poses().mean[0])
    assert both.poses().mean[1, 0] == pytest.approx(10.0)
