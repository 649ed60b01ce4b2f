"""The arithmetic of the evidence against closed forms."""

from typing import Any

import numpy as np
import pytest
from evidence import slots, witness
from evidence import sums as sums_
from evidence.exact import covers, is_positive_definite
from hypothesis import given
from hypothesis import strategies as st
from support.lane_maps import lane, network, pose_on
from support.strategies import covariances

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


def two_lines(rng: Any) -> sums_.Given:
    """Return a random joint distribution of two lines."""
    means = np.array([[1.75, 0.1, 1e-3, 1e-5], [-1.75, 0.1, 1e-3, 1e-5]])
    scale = np.tile([0.3, 0.01, 1e-3, 1e-5], 2)
    means += 2 * (rng.standard_normal(8) * scale).reshape(2, 4)
    root = rng.standard_normal((8, 8)) * scale[:, None]
    return sums_.Given(means, root @ root.T, np.array([[-20.0, 80.0]] * 2))


@pytest.mark.parametrize(("sums", "lines"), [(sums_.OF_LINE, [1]), (sums_.OF_WIDTH, [0, 1])])
def test_z_is_normal_if_the_parameters_are_as_stated(sums: sums_.Sums, lines: list[int]) -> None:
    """Of one line and of the difference of two; each mean, rms and tail within five sigmas."""
    rng = np.random.default_rng(1)
    given = two_lines(rng)
    errors = (np.linalg.cholesky(given.cov) @ rng.standard_normal((DRAWS, 8, 1))).reshape(-1, 2, 4)
    drawn = given.means + errors

    z = given.z(sums, lines, lambda i, x: cubic(drawn[:, i], x))

    assert z.shape == (len(sums.names), DRAWS)
    assert np.abs(z.mean(axis=1)).max() < 5 / np.sqrt(DRAWS)
    assert np.abs(z.var(axis=1) - 1).max() < 5 * np.sqrt(2 / DRAWS)
    share = (np.abs(z) > 2).mean(axis=1)
    assert np.abs(share - 0.0455).max() < 5 * np.sqrt(0.0455 / DRAWS)


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
