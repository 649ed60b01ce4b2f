"""Prediction of lines: Gaussians, and received lines with their time and valid range."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.propagation import (
    Linear,
    Mixture,
    Motion,
    SigmaPoints,
    pose_time_ns,
    predict,
    predict_to,
)
from maplines_can.simulation.scenarios import SCENARIOS
from maplines_can.study.roads import paper_refit
from maplines_can.values.errors import IllPosedError
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import (
    VAGUE_SIGMA,
    Kind,
    MapLine,
    Slot,
    Status,
    lateral,
    lateral_jacobian,
    transform_line,
)
from maplines_can.values.mixture import GaussianMixture
from maplines_can.values.polyline import to_ego

WINDOW = (0.0, 80.0)
X = np.linspace(*WINDOW, 9)
MEAN = np.array([1.75, 0.02, 1e-3, 1e-6])
SIGMA = np.array([0.1, 0.01, 1e-4, 1e-6])
LINE = Gaussian(MEAN, np.diag(SIGMA**2))
NO_DISPLACEMENT = Gaussian(np.zeros(3), np.zeros((3, 3)))
STILL = Motion(0.5, 0.0)
#: 20 m/s on a radius of 1 km for 0.1 s, a street turn for 0.25 s, and the largest motion specified.
DISPLACEMENTS = {
    "cruise": Motion.with_sigma(20.0, 0.02, (0.5, 0.01)).over(0.1),
    "turn": Motion.with_sigma(8.0, 0.4, (0.3, 0.03)).over(0.25),
    "far": Gaussian([4.5, 1.0, np.radians(10)], np.diag([0.3, 0.1, np.radians(1)]) ** 2),
}


def known(*displacement: Any) -> Any:
    return Gaussian(displacement, np.zeros((3, 3)))


def y_sigma(gaussian: Any, x: Any = X) -> Any:
    return MapLine(Slot.EGO_LEFT, gaussian, x_min=-100.0, x_max=200.0).y_sigma(x)


def line_of_scene(name: Any, i: int = 0) -> Any:
    """Window, refit and Gaussian of a line of a scene."""
    scene = SCENARIOS[name]
    refit = paper_refit(scene, Slot(i))
    return tuple(refit.x_range), refit, SigmaPoints()(refit, scene.ego)


def received(age: float = 0.04, **rest: Any) -> Any:
    return MapLine(Slot.EGO_LEFT, LINE, age=age, **{"t_ns": 1_000_000_000} | rest)


@pytest.mark.parametrize("displacement", ["cruise", "far"])
@pytest.mark.parametrize("name", ["production", "highway"])
def test_pose_and_displacement_agree_with_monte_carlo(name: str, displacement: str) -> None:
    """Refits from drawn poses after drawn displacements have the same mean line and sigma.

    Within 5 standard errors of 20 000 draws, 1 mm, and 1 % of sigma.
    """
    n, motion = 20_000, DISPLACEMENTS[displacement]
    window, refit, line = line_of_scene(name)
    now = predict(line, motion, window)
    pose, step = SCENARIOS[name].ego.sample(n, seed=1), motion.sample(n, seed=2)
    z = np.exp(1j * pose[:, 2]) * (step[:, 0] + 1j * step[:, 1])
    drawn = refit(pose + np.column_stack([z.real, z.imag, step[:, 2]]))
    x = np.linspace(*window, 9) - motion.mean[0]  # type: ignore[call-overload]
    y = lateral(drawn[:, None], x)
    sigma = y.std(axis=0)

    mean_error = np.abs(lateral(now.mean, x) - lateral(drawn.mean(axis=0), x))
    assert (mean_error <= (5 / np.sqrt(n) + 0.01) * sigma + 1e-3).all()
    J = lateral_jacobian(drawn.mean(axis=0), x)
    first_order = np.sqrt(np.einsum("ki,ij,kj->k", J, np.cov(drawn.T), J))
    assert (np.abs(y_sigma(now, x) / first_order - 1) <= 5 / np.sqrt(2 * n) + 0.01).all()


@pytest.mark.parametrize("heading_deg", [-30, 0.0, 10])
def test_a_straight_line_is_exact(heading_deg: float) -> None:
    """beta' = beta - heading, and y_off' = y_off + tan(beta) x - y; the variances add up."""
    line = Gaussian([2.0, 0.1, 0, 0], np.diag([0, 0.01, 0, 0]) ** 2)
    turn = Gaussian([0, 0, np.radians(heading_deg)], np.diag([0, 0, 0.02]) ** 2)
    now, beta = predict(line, turn, WINDOW), 0.1 - np.radians(heading_deg)
    assert now.mean[1:] == pytest.approx([beta, 0, 0], abs=1e-12)
    assert now.cov[1, 1] == pytest.approx(0.01**2 + 0.02**2, rel=1e-9)
    assert transform_line(line.mean, turn.mean, WINDOW)[0] == pytest.approx(
        2 * np.cos(0.1) / np.cos(beta)
    )

    line = Gaussian([2.0, 0.1, 0, 0], np.diag([0.1, 0, 0, 0]) ** 2)
    shift = Gaussian([3.0, 0.5, 0.0], np.diag([0.4, 0.2, 0]) ** 2)
    now, slope = predict(line, shift, WINDOW), np.tan(0.1)
    assert now.mean == pytest.approx(np.array([2.0 + 3 * slope - 0.5, 0.1, 0, 0]), abs=1e-12)
    assert now.cov[0, 0] == pytest.approx(0.1**2 + (0.4 * slope) ** 2 + 0.2**2, rel=1e-9)


def test_an_ill_posed_line_raises() -> None:
    """At the mean, or at the sigma points of a wide heading; those of Linear are near the mean."""
    with pytest.raises(IllPosedError, match="no value at"):
        predict(LINE, known(0.0, 0.0, np.radians(85)), WINDOW)
    wide = Gaussian(MEAN, np.diag([0.1, 0.7, 1e-4, 1e-6]) ** 2)
    with pytest.raises(IllPosedError, match="narrow the Gaussian"):
        predict(wide, NO_DISPLACEMENT, WINDOW)

    assert np.allclose(predict(wide, NO_DISPLACEMENT, WINDOW, Linear()).mean, MEAN, atol=1e-9)


def test_predict_to_starts_at_the_time_of_the_pose() -> None:
    """From 0.04 s before the reception to 0.06 s after it are 0.1 s."""
    motion = Motion.with_sigma(20.0, 0.1, (0.5, 0.02))
    line = received(kind=Kind.DASHED, status=Status.REPAIRED, x_min=-8.0, x_max=72.0)
    now = predict_to(line, 1_060_000_000, motion, time_sigma=0.005)
    expected = predict(LINE, motion.over(0.1, 0.005), (-8.0, 72.0))
    unknown = MapLine.mean_only(Slot.EGO_LEFT, MEAN, age=0.04, t_ns=1_000_000_000)
    mean_only = predict_to(unknown, 1_060_000_000, motion)

    assert pose_time_ns(line) == 960_000_000
    assert np.array_equal(now.gaussian.mean, expected.mean)
    assert np.array_equal(now.gaussian.cov, expected.cov)
    assert (now.slot, now.kind, now.status) == (line.slot, Kind.DASHED, Status.REPAIRED)
    assert mean_only.status == Status.UNKNOWN
    assert np.array_equal(mean_only.gaussian.sigma, VAGUE_SIGMA)
    moved = transform_line(MEAN, motion.over(0.1).mean, WINDOW)
    assert np.array_equal(mean_only.gaussian.mean, moved)


@pytest.mark.parametrize("mixture", [None, GaussianMixture([1.0], [LINE])])
def test_predict_to_with_a_displacement_and_a_transform(mixture: Any) -> None:
    """From odometry, which may include a lateral displacement; also of each component."""
    line, displacement = replace(received(), mixture=mixture), DISPLACEMENTS["far"]
    now = predict_to(line, 0, displacement, transform=Linear())

    assert np.array_equal(now.gaussian.mean, predict(LINE, displacement, WINDOW, Linear()).mean)


@given(st.integers(-200, 200), st.integers(-200, 200), st.floats(-30, 30), st.floats(-0.3, 0.3))
def test_two_predictions_are_one(
    first_ms: int, second_ms: int, speed: float, yaw_rate: float
) -> None:
    """A predicted line has the time of the prediction and age 0, and can be predicted further."""
    motion, line = Motion(speed, yaw_rate), received()
    times = pose_time_ns(line) + 10**6 * np.cumsum([first_ms, second_ms])
    one = predict_to(line, int(times[1]), motion)
    two = predict_to(predict_to(line, int(times[0]), motion), int(times[1]), motion)

    x = np.linspace(one.x_min, one.x_max, 9)
    assert np.allclose(two.y(x), one.y(x), atol=1e-3)
    assert np.allclose(two.y_sigma(x), one.y_sigma(x), rtol=2e-3)
    assert np.allclose([two.x_min, two.x_max], [one.x_min, one.x_max], atol=1e-2)
    assert (two.age, two.t_ns) == (0.0, times[1])


def test_the_valid_range_moves_and_gets_shorter() -> None:
    """Its ends are those seen from the new pose, moved inwards by 3 sigma, and never swapped."""
    sigma, R = np.array([0.1, 0.2, 0.01]), np.array([[1, 0.8, 0], [0.8, 1, 0.5], [0, 0.5, 1]])
    displacement = Gaussian([5.0, 0.0, np.radians(40)], R * np.outer(sigma, sigma))
    line = received(x_min=-8.0)
    now = predict_to(line, 960_000_000, displacement)
    ends = np.array([[x, line.y(x)] for x in (-8.0, 80.0)])
    drawn = np.array([to_ego(ends, draw)[:, 0] for draw in displacement.sample(20_000, seed=3)])

    got, mean = np.array([now.x_min, now.x_max]), to_ego(ends, displacement.mean)[:, 0]
    assert np.allclose(got, mean + [3, -3] * drawn.std(axis=0), atol=0.05)
    assert (drawn[:, 0] <= now.x_min).mean() > 0.99
    assert (drawn[:, 1] >= now.x_max).mean() > 0.99
    uncertain = predict_to(line, 960_000_000, Gaussian(np.zeros(3), np.diag([50.0, 1.0, 0.0]) ** 2))
    assert uncertain.x_min == uncertain.x_max == pytest.approx(36.0)


def test_the_valid_range_after_a_u_turn_and_of_length_zero() -> None:
    """x_min is never more than x_max; the message may round both ends to the same value."""
    turned = predict_to(received(), 960_000_000, Gaussian([0.0, 0.0, np.pi], np.diag([0, 0, 1e-4])))
    inwards = 3 * 0.01 * lateral(MEAN, [80.0, 0.0])  # a rotation moves the far end more
    now = predict_to(received(x_min=24.0, x_max=24.0), 960_000_000, known(2.0, 0.0, 0.01))
    u, v = to_ego([24.0, lateral(MEAN, 24.0)], [2.0, 0.0, 0.01])  # type: ignore[arg-type]

    assert np.allclose([turned.x_min, turned.x_max], [-80.0, 0.0] + inwards * [1, -1], atol=1e-9)
    assert turned.gaussian.mean[0] == pytest.approx(-1.75, abs=1e-3)
    assert now.x_min == now.x_max == pytest.approx(u, abs=1e-9)
    assert now.y(u) == pytest.approx(v, abs=1e-5)


def test_each_component_of_a_mixture_is_predicted() -> None:
    """Each keeps its weight; the Gaussian of the line is that of the mixture."""
    scene, motion = SCENARIOS["street-turn"], Motion.with_sigma(8.0, 0.4, (0.3, 0.03))
    window, refit, _ = line_of_scene("street-turn")
    mixture = Mixture(3)(refit, scene.ego)
    valid_range = {"x_min": window[0], "x_max": window[1], "age": 0.05, "t_ns": 0}
    line = MapLine.of_mixture(Slot.ROUTE, mixture, **valid_range)
    now = predict_to(line, 50_000_000, motion)

    assert np.array_equal(now.mixture.weights, mixture.weights)  # type: ignore[union-attr]
    for got, component in zip(now.mixture.components, mixture.components, strict=True):  # type: ignore[union-attr]
        assert np.array_equal(got.mean, predict(component, motion.over(0.1), window).mean)
    assert np.array_equal(now.gaussian.cov, now.mixture.overall.cov)  # type: ignore[union-attr]
    assert isinstance(now.mixture, GaussianMixture)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        pytest.param({"status": Status.OUT_OF_RANGE}, "OUT_OF_RANGE.*check line.is_usable"),
        pytest.param({"age": np.inf}, "age must be finite.*check line.is_usable"),
    ],
)
def test_item_1_a_line_that_is_not_usable_is_not_predicted(change: Any, words: str) -> None:
    """Out of range it has no Gaussian, and without an age no time."""
    line = replace(received(), **change)

    assert received().is_usable
    assert not line.is_usable
    with pytest.raises(ValueError, match=words):
        predict_to(line, 1_060_000_000, Motion(20.0, 0.1))


@pytest.mark.parametrize(
    ("t_ns", "now_ns", "words"),
    [
        (1_700_000_000_000_000_000, 0, "within 10 s"),
        (1_000_000_000, 10_960_000_001, r"within 10 s .* line\.t_ns=1"),
        (1_000_000_000, 10**400, "an integer of about 1e400"),
    ],
)
def test_a_time_far_from_that_of_the_pose_is_refused(t_ns: int, now_ns: int, words: str) -> None:
    """Seconds instead of nanoseconds, or another epoch: more than 10 s from the pose."""
    assert predict_to(received(), 10_960_000_000, STILL).x_max == pytest.approx(75.0)
    with pytest.raises(ValueError, match=words):
        predict_to(received(t_ns=t_ns), now_ns, STILL)
