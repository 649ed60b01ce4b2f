"""What a car sees of a line of the map: its stretch in a window."""

from typing import Any

import numpy as np
import pytest

from maplines_can.model.stretches import Path, shown_error
from maplines_can.propagation.paths import point_errors, points_in_window
from maplines_can.values.polyline import INDEXED, Polyline, to_ego

STRAIGHT = Polyline([[x, 0.0] for x in range(101)])


def hairpin(gap: float = 10.0) -> Any:
    """A line of 100 m ahead, a turn, and a branch back at ``gap`` [m] to the left."""
    x, arc = np.arange(0.0, 101.0, 2.0), np.linspace(-np.pi / 2, np.pi / 2, 9)[1:-1]
    turn = np.column_stack([100 + gap / 2 * np.cos(arc), gap / 2 + gap / 2 * np.sin(arc)])
    out, back = np.column_stack([x, 0 * x]), np.column_stack([x[::-1], 0 * x + gap])
    return Polyline(np.vstack([out, turn, back]))


@pytest.mark.parametrize(
    ("x_min", "x_max", "first", "last"),
    [
        pytest.param(-20, 50, 10, 80, id="inside"),
        pytest.param(-20.5, 50.5, 9.5, 80.5, id="between-points"),
        pytest.param(-50, 20, 0, 50, id="before-the-start"),
        pytest.param(0, 500, 30, 100, id="beyond-the-end"),
        pytest.param(20, 30, 50, 60, id="ahead-only"),
        pytest.param(-20, -10, 10, 20, id="behind-only"),
    ],
)
def test_a_window_ends_where_it_says(x_min: float, x_max: float, first: float, last: float) -> None:
    """Its ends are interpolated between points, here of a car at x = 30 m."""
    seen = points_in_window(STRAIGHT, [30.0, 2.0, 0.0], (x_min, x_max))

    assert seen[[0, -1], 0] == pytest.approx([first, last])
    assert len(points_in_window(STRAIGHT, [900.0, 2.0, 0.0], (x_min, x_max))) == 0
    assert len(seen) == 1 + np.floor(last) - np.ceil(first) + (first % 1 > 0) + (last % 1 > 0)
    assert np.allclose(seen[:, 1], 0.0)


@pytest.mark.parametrize(
    ("pose", "y"), [((20.0, 1.0, 0.0), 0.0), ((20.0, 9.0, np.pi), 10.0)], ids=["out", "back"]
)
def test_a_window_contains_the_near_branch_of_a_hairpin(pose: Any, y: float) -> None:
    """The branch that returns beside the car is excluded, also if the turn is in the window."""
    for x_max in (60.0, 200.0):
        seen = points_in_window(hairpin(), pose, (-10.0, x_max))

        assert np.allclose(seen[to_ego(seen, pose)[:, 0] <= 60.0, 1], y)
        assert np.all(np.diff(to_ego(seen, pose)[:, 0]) > 0)
        assert to_ego(seen, pose)[-1, 0] >= (20.0 if y else 60.0) - 1e-9


@pytest.mark.parametrize("spacing", [0.5, 45.0])
def test_item_6_an_index_finds_the_same_stretch(spacing: float) -> None:
    """A line of many points, also far apart, against its part near the car.

    Of dense points a sample is used, at most 0.6 m apart, which costs less than 0.1 mm here.
    """
    x = np.append(np.arange(0.0, 3000.0, 0.5), np.arange(3000.0, 9000.0, spacing))
    points = np.column_stack([x, 20 * np.sin(x / 300)])
    line = Polyline(points)
    assert len(points) > INDEXED
    for at in (10.0, 2990.0, 3010.0, 5000.0):
        pose = [at, 20 * np.sin(at / 300), np.arctan(np.cos(at / 300) / 15)]
        near = np.abs(x - at) < 500
        part, seen = Polyline(points[near][: INDEXED - 1]), points_in_window(line, pose, (-20, 80))
        expected = points_in_window(part, pose, (-20, 80))
        assert seen[[0, -1]] == pytest.approx(expected[[0, -1]], abs=1e-4)
        assert np.interp(seen[:, 0], *expected.T) == pytest.approx(seen[:, 1], abs=1e-4)


@pytest.mark.parametrize("sigma", [0.02, 0.1])
def test_independent_errors_of_points_are_found(sigma: float) -> None:
    """4000 squared fourth differences are as uncertain as 1500 independent squares."""
    angle = np.arange(4000) / 100
    points = 500 * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    line = Polyline(points + np.random.default_rng(5).normal(0, sigma, points.shape))
    shown = point_errors(line)[2:-2]

    assert np.sqrt(np.mean(shown**2)) == pytest.approx(sigma, rel=4 / np.sqrt(2 * 1500))
    x, y = line.points.T.tolist()
    path = Path(x, y, line.distance.tolist())
    expected = [shown_error(path, i) for i in range(2, 40)]
    assert shown[:38] ** 2 == pytest.approx(expected, rel=1e-12)
