"""The points of a map line, and their selection by a window."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from maplines_can.polyline import Polyline, near_stretch, to_ego

STRAIGHT = Polyline([[x, 0.0] for x in range(101)])  # type: ignore[arg-type]


def hairpin(gap: float = 10.0) -> Any:
    """A road of 100 m ahead, a turn, and a branch back at ``gap`` [m] to the left."""
    x, arc = np.arange(0.0, 101.0, 2.0), np.linspace(-np.pi / 2, np.pi / 2, 9)[1:-1]
    turn = np.column_stack([100 + gap / 2 * np.cos(arc), gap / 2 + gap / 2 * np.sin(arc)])
    out, back = np.column_stack([x, 0 * x]), np.column_stack([x[::-1], 0 * x + gap])
    return Polyline(np.vstack([out, turn, back]))


@pytest.mark.parametrize(
    ("points", "words"),
    [
        pytest.param([[0, 0]], r"\(n, 2\) with n >= 2, got \(1, 2\)", id="one-point"),
        pytest.param([0, 1], r"got \(2,\)", id="flat"),
        pytest.param(np.zeros((4, 3)), r"got \(4, 3\)", id="with-heights"),
        pytest.param([[0, 0], [1, np.nan]], r"finite \[m\], but point 1 is \[ 1. nan\]", id="nan"),
        pytest.param([[np.inf, 0], [1, 0]], "but point 0 is", id="inf"),
    ],
)
def test_invalid_points_raise(points: Any, words: str) -> None:
    """The message has the shape or the value."""
    with pytest.raises(ValueError, match=words):
        Polyline(points)


def test_a_polyline_copies_its_points_and_makes_them_read_only() -> None:
    """Validated points cannot be changed."""
    points = np.zeros((2, 2))
    line = Polyline(points)
    points[0, 0] = np.nan

    assert np.isfinite(line.points).all()
    with pytest.raises(ValueError, match="read-only"):
        line.points[0, 0] = 1


@given(arrays(float, (5, 2), elements=st.floats(-100, 100, width=16)), st.floats(0.5, 300))
def test_resampled_points_are_evenly_spaced_on_the_line(points: Any, spacing: float) -> None:
    """The ends stay, the points are at most the spacing apart, and all of them are on the line."""
    line = Polyline(points)
    fine = line.resampled(spacing)
    count = max(1, np.ceil(line.length / spacing))
    s = np.linspace(0, line.length, int(count) + 1)

    assert np.allclose(fine.points[[0, -1]], points[[0, -1]], atol=1e-9)
    assert len(fine.points) == len(s)
    assert (np.hypot(*np.diff(fine.points, axis=0).T) <= spacing * (1 + 1e-9)).all()
    for p, distance in zip(fine.points, s, strict=True):
        i = min(np.searchsorted(line.distance, distance, side="right") - 1, len(points) - 2)
        step = line.distance[i + 1] - line.distance[i]
        share = (distance - line.distance[i]) / step if step else 0.0
        assert np.allclose(p, points[i] + share * (points[i + 1] - points[i]), atol=1e-9)


@pytest.mark.parametrize("spacing", [0.0, -1.0, np.nan])
def test_a_spacing_of_zero_raises(spacing: Any) -> None:
    """A spacing must be positive."""
    with pytest.raises(ValueError, match="spacing must be more than 0 m"):
        STRAIGHT.resampled(spacing)


@pytest.mark.parametrize(
    ("x_min", "x_max", "first", "last"),
    [
        pytest.param(-20, 50, 10, 80, id="inside"),
        pytest.param(-20.5, 50.5, 10, 80, id="between-points"),
        pytest.param(-50, 20, 0, 50, id="before-the-start"),
        pytest.param(0, 500, 30, 100, id="beyond-the-end"),
        pytest.param(20, 30, 50, 60, id="ahead-only"),
        pytest.param(-20, -10, 10, 20, id="behind-only"),
    ],
)
def test_a_window_contains_the_points_between_its_ends(
    x_min: float, x_max: float, first: int, last: int
) -> None:
    """Both ends belong to the window, here of a car at x = 30 m."""
    seen = STRAIGHT.window([30.0, 2.0, 0.0], x_min, x_max)

    assert (seen[0, 0], seen[-1, 0]) == (first, last)
    assert len(seen) == last - first + 1


def test_a_window_without_points_is_empty() -> None:
    """No error is raised: the caller decides how many points are enough."""
    assert STRAIGHT.window([0.0, 0.0, np.pi], 1, 80).shape == (0, 2)


@pytest.mark.parametrize(
    ("pose", "y"), [((20.0, 1.0, 0.0), 0.0), ((20.0, 9.0, np.pi), 10.0)], ids=["out", "back"]
)
def test_a_window_contains_the_near_branch_of_a_hairpin(pose: Any, y: float) -> None:
    """The branch that returns beside the car is excluded."""
    seen = hairpin().window(pose, -10.0, 60.0)

    assert (seen[:, 1] == y).all()
    assert len(seen) >= 15


def test_near_refers_to_the_car_and_not_to_the_start_of_the_window() -> None:
    """Of a road that crosses behind the car, the branch that passes the car is selected."""
    road = Polyline([[-20, 2], [0, 2], [50, 2], [100, 16], [50, 9.5], [0, 3], [-20, 0.4]])  # type: ignore[arg-type]
    seen = road.resampled(1.0).window([0.0, 0.0, 0.0], -15.0, 40.0)

    assert np.allclose(seen[:, 1], 2.0)


def test_a_hairpin_within_the_window_is_not_divided() -> None:
    """Consecutive points stay together; the refit decides whether a cubic fits them."""
    road = hairpin()

    assert len(road.window([20.0, 1.0, 0.0], -50.0, 200.0)) == len(road.points)


def test_points_of_several_lines_are_selected_independently() -> None:
    """For concatenated lines the result is that of each line alone."""
    lines, pose = [STRAIGHT, hairpin(), Polyline(STRAIGHT.points[::-1])], [20.0, 1.0, 0.1]
    ego = [to_ego(line.points, pose) for line in lines]
    alone = [line.window(pose, -10.0, 60.0) for line in lines]
    together = near_stretch(np.vstack(ego), [len(points) for points in ego], -10.0, 60.0)

    assert np.array_equal(np.vstack([line.points for line in lines])[together], np.vstack(alone))


@given(arrays(float, (6, 2), elements=st.floats(-100, 100)), st.floats(-np.pi, np.pi))
def test_the_ego_frame_is_rotated_by_the_heading(points: Any, heading: float) -> None:
    """In complex numbers: (z - pose) e^(-i heading)."""
    z = (points @ [1, 1j] - (3 - 4j)) * np.exp(-1j * heading)

    assert np.allclose(to_ego(points, [3, -4, heading]) @ [1, 1j], z, atol=1e-12)
