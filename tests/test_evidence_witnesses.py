"""The arithmetic of the evidence against closed forms."""

from typing import Any

import numpy as np
import pytest
from evidence import (
    canyon,
    lines,
    scenes,
    slots,
    witness,
)
from evidence import plausibility as drawn
from evidence import sums as sums_
from evidence.exact import covers, is_positive_definite
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import ndtri
from support.lane_maps import lane, network, pose_on
from support.strategies import covariances

from maplines_can import MapError, Motion, Polyline, Slot
from maplines_can.study.scenes.map_scenes import SLOTS

LEFT, RIGHT, NEXT_LEFT, NEXT_RIGHT = SLOTS
DRAWS = 20_000

# ---- lines as they are seen -----------------------------------------------------------------


@given(st.floats(-0.5, 0.5), st.floats(-3, 3), st.floats(-60, 60))
def test_a_straight_line_is_crossed_where_it_lies(angle: float, y: float, x: float) -> None:
    """Seen from a pose that is turned by an angle, and from the origin."""
    points = np.column_stack([np.linspace(-100, 100, 7), np.full(7, y)])
    poses = np.array([[0, 0, 0], [0, 0, angle]])

    local = witness.seen_from(points, poses)
    _, s = witness.place_of(local[0])

    expected = [y, y / np.cos(angle) - x * np.tan(angle)]
    assert np.allclose(witness.crossings(local, s, x), expected)


def test_a_line_that_ends_is_not_crossed() -> None:
    points = np.array([[0.0, 1], [10, 1], [20, 1]])
    assert np.isnan(witness.crossings(points[None], np.array([0.0, 10, 20]), 25.0)).all()


def test_a_line_that_comes_back_is_crossed_where_it_is_followed() -> None:
    """Of a circle, the side on which the car is; its other side is not a line ahead."""
    angle = np.linspace(-0.7 * np.pi, 1.2 * np.pi, 400)
    circle = 12 * np.column_stack([np.cos(angle), 1 + np.sin(angle)])
    local = circle - [0, 0.3]
    _, s = witness.place_of(local)
    near, far = witness.crossings(np.array([local, local + np.array([0, 40])]), s, 4.0)
    assert near == pytest.approx(12 - np.sqrt(12**2 - 4**2) - 0.3, abs=1e-3)
    assert far == pytest.approx(near + 40)
    assert np.isnan(witness.crossings(local[None], s, 12.5)).all()


def test_an_oncoming_line_is_known_by_its_direction_at_the_car() -> None:
    """Whatever its direction is farther along."""
    hairpin = np.array([[-50.0, 2], [50, 2], [50, 30], [-50, 30]])
    assert not witness.is_oncoming(hairpin)
    assert witness.is_oncoming(hairpin[::-1])
    assert witness.is_oncoming(hairpin - [0, 31])


def test_the_nearest_place_is_between_points() -> None:
    nearest, s = witness.place_of(np.array([[-30.0, 4], [-10, 4], [30, 4]]))
    assert nearest == 1
    assert s.tolist() == [-30, -10, 30]


def test_points_keep_their_errors_in_other_lines() -> None:
    points = np.column_stack([np.arange(0.0, 40.0, 2.0), np.zeros(20)])
    of_map = witness.MapOfCar(MapError(0.05, 0.05), np.random.default_rng(0))
    first = of_map(Slot.EGO_LEFT, Polyline(points))
    later = of_map(Slot.EGO_LEFT, Polyline(points[5:]))
    np.testing.assert_array_equal(first.points[5:], later.points)
    assert 0.02 < np.abs(first.points - points).mean() < 0.15


def test_the_true_line_deviates_as_the_map_error_says() -> None:
    """Standard deviations of the common offset, of the rotation and of each point."""
    points = np.column_stack([5e5 + np.linspace(0, 50, 26), np.full(26, 5e6 + 2.0)])
    pose, error = np.array([5e5, 5e6, 0.4]), MapError(0.05, 0.1, np.radians(0.1))
    true = witness.erred(points, pose, error, DRAWS, np.random.default_rng(1)) - points
    x = points[:, 0] - pose[0]
    variance = error.point_sigma**2 + error.offset_sigma**2 + (x * error.heading_sigma) ** 2
    assert true[..., 1].var(axis=0) == pytest.approx(variance, rel=0.06)
    assert witness.erred(points, pose, None, 5, np.random.default_rng(1)).shape == (1, 26, 2)


def test_the_witness_knows_the_lane_and_those_beside_it() -> None:
    """Also for a car that drives against the direction, and only where the boundaries pass it."""
    found = network(
        lane("l", t=3.5), lane("m"), lane("o", t=-3.5, backward=True), rows=["l m"],
        opposite=["m o"], left_hand_traffic=True,
    )  # fmt: skip
    witness = slots.Witness(found)
    pose = pose_on(found.lanes["m"], 50.0, t=0.25)
    expected = {LEFT: 1.5, RIGHT: -2.0, NEXT_LEFT: 5.0, NEXT_RIGHT: -5.5}
    assert witness.expected(found.lanes["m"], pose) == pytest.approx(expected)
    turned = pose + np.array([0, 0, np.pi])
    assert witness.expected(found.lanes["m"], turned) == pytest.approx(
        {RIGHT: -1.5, LEFT: 2.0, NEXT_RIGHT: -5.0, NEXT_LEFT: 5.5}
    )
    assert witness.expected(found.lanes["l"], pose) is None
    assert witness.is_right(expected, pose)
    assert not witness.is_right({LEFT: 1.5, RIGHT: -2.0}, pose)
    assert not witness.is_right(expected | {NEXT_LEFT: 4.5}, pose)
    assert not witness.is_right({slot: -y for slot, y in expected.items()}, pose)


# ---- sums of lateral positions -----------------------------------------------------------------


def cubic(parameters: Any, x: float) -> Any:
    """Return the (...,) lateral positions of (..., 4) lines (Map Line Interface, eq. 1)."""
    y_off, beta, c0, c1 = np.moveaxis(parameters, -1, 0)
    return y_off + np.tan(beta) * x + c0 * x**2 / 2 + c1 * x**3 / 6


def two_lines(rng: Any, components: int = 1) -> sums_.Given:
    """Return a random joint distribution of two lines."""
    means = np.zeros((components, 2, 4))
    means[:, 0] = [1.75, 0.1, 1e-3, 1e-5]
    means[:, 1] = [-1.75, 0.1, 1e-3, 1e-5]
    scale = np.tile([0.3, 0.01, 1e-3, 1e-5], 2)
    means += 2 * (rng.standard_normal((components, 8)) * scale).reshape(-1, 2, 4)
    roots = rng.standard_normal((components, 8, 8)) * scale[:, None]
    covs = roots @ roots.swapaxes(1, 2)
    shares = rng.dirichlet(np.ones(components))
    return sums_.Given(shares, means, covs, np.array([[-20.0, 80.0]] * 2))


@pytest.mark.parametrize("components", [1, 3])
@pytest.mark.parametrize(("sums", "lines"), [(sums_.OF_LINE, [1]), (sums_.OF_WIDTH, [0, 1])])
def test_z_is_normal_if_the_parameters_are_as_stated(
    components: int, sums: sums_.Sums, lines: list[int]
) -> None:
    """Of one line and of the difference of two; each mean, rms and tail within five sigmas."""
    rng = np.random.default_rng(1)
    given = two_lines(rng, components)
    which = rng.choice(components, DRAWS, p=given.shares)
    roots = np.linalg.cholesky(given.covs)[which]
    errors = (roots @ rng.standard_normal((DRAWS, 8, 1))).reshape(DRAWS, 2, 4)
    drawn = given.means[which] + errors

    z = given.z(sums, lines, lambda i, x: cubic(drawn[:, i], x))

    assert z.shape == (len(sums.names), DRAWS)
    assert np.abs(z.mean(axis=1)).max() < 5 / np.sqrt(DRAWS)
    assert np.abs(z.var(axis=1) - 1).max() < 5 * np.sqrt(2 / DRAWS)
    share = (np.abs(z) > 2).mean(axis=1)
    assert np.abs(share - 0.0455).max() < 5 * np.sqrt(0.0455 / DRAWS)


def test_the_curvature_about_the_car_is_c0() -> None:
    """A cubic has no third difference about its middle."""
    given = two_lines(np.random.default_rng(2))
    sums = sums_.Sums.of([("", (-5.0, 0.0, 5.0), (0.04, -0.08, 0.04))])
    mean, variance = given.moments(sums, [0])
    assert mean == pytest.approx(given.means[0, 0, 2])
    assert variance == pytest.approx(given.covs[0, 2, 2])


def test_quantiles_of_a_mixture_do_not_saturate() -> None:
    """Far from all components they are those of the widest; near zero, of the average."""
    shares = np.array([0.5, 0.5])
    u = np.array([[-40.0, 60.0], [-80.0, 20.0]])
    z = sums_.normal_quantiles(u[..., None], shares)[:, 0]
    assert z == pytest.approx([-40.0, 20.0], abs=0.05)
    middle = sums_.normal_quantiles(np.array([[1.0], [-0.5]]), shares)
    cdf = (0.841345 + 0.308538) / 2
    assert middle == pytest.approx(ndtri(cdf), abs=1e-5)


def test_the_motion_ends_where_the_closed_form_says() -> None:
    """The mean pose of the witness is that of ``Motion``, from any pose, on arcs and straight."""
    for yaw_rate in (0.0, 1e-4, 0.5, -0.3):
        local = Motion(lines.SPEED, yaw_rate).over(lines.SECONDS).mean
        c, s = np.cos(0.7), np.sin(0.7)
        expected = [10 + c * local[0] - s * local[1], 5 + s * local[0] + c * local[1]]
        found = lines.arc(10.0, 5.0, 0.7, lines.SPEED, yaw_rate)
        assert found == pytest.approx([*expected, 0.7 + local[2]], abs=1e-6)


def test_a_line_that_does_not_cross_counts_as_beyond() -> None:
    """As in the other evidence, and only in sums that need that place."""
    given, tally = two_lines(np.random.default_rng(1)), sums_.Tally()
    mean = given.means[0, 0]
    tally.evaluate(
        given._replace(ranges=given.ranges[:1]),
        lambda _, x: np.full(7, np.nan) if x == 40.0 else np.full(7, cubic(mean, x)),
    )
    beyond = tally.figures()["beyond 3 sigma"]
    assert beyond["y"] == pytest.approx(1 / 3)
    assert beyond["slope 10 m"] == pytest.approx(1 / 3)
    assert beyond["curvature"] == 0.0


# ---- covariances --------------------------------------------------------------------------------


@given(covariances(4, (0.0, 1e-15, 1e-9, 1.0)))
def test_exact_definiteness_agrees_with_the_eigenvalues(cov: np.ndarray[Any, Any]) -> None:
    """Where they are not near 0; and a matrix covers itself plus anything definite only."""
    scale = np.sqrt(np.where(cov.diagonal() > 0, cov.diagonal(), 1.0))
    least = np.linalg.eigvalsh(cov / scale / scale[:, None])[0]
    if abs(least) > 1e-12:
        assert is_positive_definite(cov.tolist()) == (least > 0)
    zero = np.zeros(4)
    assert not covers(cov, zero, cov, zero)
    more = cov + np.diag(scale**2)
    assert covers(more, zero, cov, zero)
    assert not covers(more, zero, cov, 2 * scale * [1, 0, 0, 0])


@pytest.mark.parametrize(
    ("matrix", "definite"),
    [
        ([[1.0, 1.0], [1.0, 1.0 + 2**-52]], True),
        ([[1.0, 1.0], [1.0, 1.0]], False),
        ([[1e-300, 0.0], [0.0, 1e300]], True),
        ([[0.0]], False),
        ([[2, -1, 0], [-1, 2, -1], [0, -1, 2]], True),
        ([[2, -1, -1], [-1, 2, -1], [-1, -1, 2]], False),
        ([[1, 2], [2, 1]], False),
    ],
)
def test_exact_definiteness(matrix: Any, definite: bool) -> None:
    assert is_positive_definite(matrix) is definite


def test_eigenvalues_are_those_of_the_whitened_covariance() -> None:
    rng = np.random.default_rng(1)
    A, B = (X @ X.T + np.eye(5) for X in rng.normal(size=(2, 5, 5)))
    expected = np.sort(np.linalg.eigvals(np.linalg.solve(A, B)).real)
    assert scenes.whitened(np.linalg.cholesky(A), B) == pytest.approx(expected)


# ---- drawn errors -------------------------------------------------------------------------------


def test_the_errors_have_the_covariance_of_the_model() -> None:
    model = drawn.model_of_lane()
    errors = drawn.Errors(model, 5.0, 40_000, np.random.default_rng(0))
    z = errors.next()
    scale = np.sqrt(model.marginal.diagonal())
    found = np.cov(z.T) / scale / scale[:, None]
    assert found == pytest.approx(model.marginal / scale / scale[:, None], abs=0.03)


def test_reflections_jump_and_the_stated_covariance_is_that_of_the_noise() -> None:
    """Between changes of the satellites, two errors differ by two noises; else, by metres."""
    off, cov = canyon.least_squares(600, 4, 5.0, np.random.default_rng(8))
    step = np.diff(off, axis=0)
    same = (cov[1:] == cov[:-1]).all(axis=(2, 3))
    squared = np.einsum("kni,knij,knj->kn", step, np.linalg.inv(2 * cov[1:]), step)
    n = same.sum()  # the median has a standard error of 2 / sqrt(n)
    # A reflection may change in length while the same satellites are seen.
    assert np.median(squared[same]) == pytest.approx(2 * np.log(2), abs=8 / np.sqrt(n))
    assert squared[~same].mean() > 20.0
    assert 10.0 < np.sqrt((off**2).mean()) < 30.0


def test_the_errors_are_those_that_are_told() -> None:
    """In a canyon, (fix - pose) / sigma has a variance of 1 and the correlation time."""
    n = 200
    course = canyon.made(canyon.Kind("canyon"), n, np.random.default_rng(3))
    row = np.searchsorted(course.t, course.fix_t)
    white = course.cov[0, 0, 0, 0]
    off = (course.fixes - course.pose[row, :, :2]) / course.error[..., :1]
    share = white / course.error[0, :, 0] ** 2
    assert (off**2).mean(axis=(0, 2)).mean() == pytest.approx(1 + share.mean(), rel=0.1)
    lag = 10  # 2 s
    rho = (off[lag:] * off[:-lag]).mean(axis=(0, 2)).mean()
    assert rho == pytest.approx(np.exp(-2.0 / course.error[0, :, 1]).mean(), rel=0.1)


def test_events_are_where_they_belong() -> None:
    """A gap has no fixes, a jump is 100 m, outliers are a tenth."""
    rng = np.random.default_rng(4)
    gap = canyon.made(canyon.Kind("canyon", "gap"), 2, rng)
    missing = np.isnan(gap.fixes).all(axis=(1, 2))
    assert missing.sum() == 150
    assert (gap.fix_t[missing] >= canyon.GAP[0]).all()
    jump = canyon.made(canyon.Kind("open", "jump"), 2, rng)
    row = np.searchsorted(jump.t, jump.fix_t)
    size = np.linalg.norm(jump.fixes - jump.pose[row, :, :2], axis=-1)
    assert np.median(size[(jump.fix_t >= 100) & (jump.fix_t < 110)]) == pytest.approx(100, abs=5)
    outliers = canyon.made(canyon.Kind("open", "outliers"), 20, rng)
    row = np.searchsorted(outliers.t, outliers.fix_t)
    size = np.linalg.norm(outliers.fixes - outliers.pose[row, :, :2], axis=-1)
    assert (size > 150).mean() == pytest.approx(0.1, abs=0.01)
