"""The points of a map line, and which of them a car takes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from maplines_can.polyline import Polyline, near_stretch, to_ego

STRAIGHT = Polyline([[x, 0.0] for x in range(101)])


def hairpin(gap=10.0):
    """A road that runs 100 m ahead, turns, and comes back ``gap`` to the left."""
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
def test_wrong_points_are_refused_in_words(points, words):
    """A shape or a value that is wrong is named."""
    with pytest.raises(ValueError, match=words):
        Polyline(points)


def test_a_polyline_owns_its_points():
    """What was checked cannot be changed any more."""
    points = np.zeros((2, 2))
    line = Polyline(points)
    points[0, 0] = np.nan

    assert np.isfinite(line.points).all()
    with pytest.raises(ValueError, match="read-only"):
        line.points[0, 0] = 1


@given(arrays(float, (5, 2), elements=st.floats(-100, 100, width=16)), st.floats(0.5, 300))
def test_resampled_points_are_evenly_spaced_on_the_line(points, spacing):
    """Ends stay; the way between points is at most the spacing, and all points are on the line."""
    line = Polyline(points)
    fine = line.resampled(spacing)
    count = max(1, np.ceil(line.length / spacing))
    s = np.linspace(0, line.length, int(count) + 1)

    assert np.allclose(fine.points[[0, -1]], points[[0, -1]], atol=1e-9)
    assert len(fine.points) == len(s)
    assert (np.hypot(*np.diff(fine.points, axis=0).T) <= spacing * (1 + 1e-9)).all()
    for p, way in zip(fine.points, s, strict=True):
        i = min(np.searchsorted(line.distance, way, side="right") - 1, len(points) - 2)
        step = line.distance[i + 1] - line.distance[i]
        share = (way - line.distance[i]) / step if step else 0.0
        assert np.allclose(p, points[i] + share * (points[i + 1] - points[i]), atol=1e-9)


@pytest.mark.parametrize("spacing", [0.0, -1.0, np.nan])
def test_a_spacing_is_more_than_nothing(spacing):
    """Points cannot stand 0 m apart."""
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
def test_a_window_holds_the_points_between_its_ends(x_min, x_max, first, last):
    """Both ends belong to the window, seen from a car at x = 30 m."""
    seen = STRAIGHT.window([30.0, 2.0, 0.0], x_min, x_max)

    assert (seen[0, 0], seen[-1, 0]) == (first, last)
    assert len(seen) == last - first + 1


def test_a_window_where_the_line_is_not_is_empty():
    """No point, no error: the caller knows what it needs."""
    assert STRAIGHT.window([0.0, 0.0, np.pi], 1, 80).shape == (0, 2)


@pytest.mark.parametrize(
    ("pose", "y"), [((20.0, 1.0, 0.0), 0.0), ((20.0, 9.0, np.pi), 10.0)], ids=["out", "back"]
)
def test_of_a_hairpin_the_near_branch_is_seen(pose, y):
    """Where the road comes back beside the car, the other branch is left out."""
    seen = hairpin().window(pose, -10.0, 60.0)

    assert (seen[:, 1] == y).all()
    assert len(seen) >= 15


def test_near_is_what_is_near_the_car_and_not_the_start_of_the_window():
    """A road that comes back to cross behind the car is seen where it passes the car."""
    road = Polyline([[-20, 2], [0, 2], [50, 2], [100, 16], [50, 9.5], [0, 3], [-20, 0.4]])
    seen = road.resampled(1.0).window([0.0, 0.0, 0.0], -15.0, 40.0)

    assert np.allclose(seen[:, 1], 2.0)


def test_a_hairpin_within_the_window_is_one_stretch():
    """Points that follow one another are not taken apart: whether they fit is for the refit."""
    road = hairpin()

    assert len(road.window([20.0, 1.0, 0.0], -50.0, 200.0)) == len(road.points)


def test_of_several_lines_each_has_its_own_stretch():
    """Laid end to end, lines do not disturb each other's windows."""
    lines, pose = [STRAIGHT, hairpin(), Polyline(STRAIGHT.points[::-1])], [20.0, 1.0, 0.1]
    ego = [to_ego(line.points, pose) for line in lines]
    alone = [line.window(pose, -10.0, 60.0) for line in lines]
    together = near_stretch(np.vstack(ego), [len(points) for points in ego], -10.0, 60.0)

    assert np.array_equal(np.vstack([line.points for line in lines])[together], np.vstack(alone))


@given(arrays(float, (6, 2), elements=st.floats(-100, 100)), st.floats(-np.pi, np.pi))
def test_the_ego_frame_is_a_turn_by_the_heading(points, heading):
    """In complex numbers: (z - pose) e^(-i heading)."""
    z = (points @ [1, 1j] - (3 - 4j)) * np.exp(-1j * heading)

    assert np.allclose(to_ego(points, [3, -4, heading]) @ [1, 1j], z, atol=1e-12)
