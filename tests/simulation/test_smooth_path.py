"""The smooth path follows the polyline, with continuous heading and curvature."""

import numpy as np
import pytest
from numpy.typing import NDArray

from maplines_can.simulation.smooth_path import SmoothPath, _graded
from maplines_can.values.polyline import Polyline


def arc(radius: float, angle: float, sagitta: float = 5e-4) -> NDArray[np.float64]:
    """Points of an arc that begins at the origin along x, with a chord error."""
    count = int(np.ceil(angle * radius / np.sqrt(8 * sagitta * radius)))
    a = np.linspace(0, angle, count + 1)
    return np.column_stack([radius * np.sin(a), radius * (1 - np.cos(a))])


@pytest.mark.parametrize("radius", [10.0, 30.0, 300.0, 5000.0])
def test_circle(radius: float) -> None:
    """On a sampled circle, position, heading and curvature are those of the circle."""
    path = SmoothPath(Polyline(arc(radius, 1.5)))
    s = np.linspace(0, path.length, 5001)
    pose, curvature = path.pose(s), path.curvature(s)
    assert np.abs(np.hypot(pose[:, 0], pose[:, 1] - radius) - radius).max() < 2e-3
    # The heading is perpendicular to the radius.
    around = np.arctan2(pose[:, 1] - radius, pose[:, 0]) + np.pi / 2
    inside = (s > 5) & (s < path.length - 5)
    assert np.abs(pose[:, 2] - around)[inside].max() < 1e-3
    np.testing.assert_allclose(curvature[inside], 1 / radius, rtol=0.01)


@pytest.mark.parametrize("radius", [8.0, 25.0, 200.0])
def test_long_straights_beside_an_arc_stay_straight(radius: float) -> None:
    """The spline does not swing out where the spacing changes from 50 m to less than 1 m."""
    bend = arc(radius, np.pi / 2) + np.array([50.0, 0.0])
    end = bend[-1] + np.array([0.0, 50.0])
    path = SmoothPath(Polyline(np.concatenate([[[0.0, 0.0]], bend, [end]])))
    s = np.linspace(0, path.length, 5001)
    x, y, heading = path.pose(s).T
    off = np.where(x < 50, np.abs(y), np.abs(np.hypot(x - 50, y - radius) - radius))
    off = np.where(y > radius, np.abs(x - 50 - radius), off)
    assert off.max() < 0.02
    assert np.abs(heading[x < 45]).max() < 3e-3
    assert np.abs(np.diff(heading)).max() < 1.1 * path.length / 5000 / radius


@pytest.mark.parametrize(
    "points",
    [
        pytest.param([[0, 0], [100, 0], [100, 100]], id="corner"),
        pytest.param([[0, 0], [50, 0], [50.001, 0.05], [100, 0.05]], id="step-to-the-side"),
        pytest.param([[0, 0], [10, 0], [10, 10], [0, 10], [0, 0]], id="square"),
        pytest.param([[0, 0], [50, 0], [50, 0], [50.002, 0], [99, 1]], id="same-point-twice"),
        pytest.param([[0, 0], [50, 0], [49.9, 0.01], [99, 0]], id="overlap"),
        pytest.param([[0, 0], [0.5, 0]], id="half-a-metre"),
    ],
)
def test_heading_has_no_step(points: list[list[float]]) -> None:
    """Corners are rounded within 2 m, and the path stays within 0.35 m of the polyline."""
    line = Polyline(np.array(points))
    path = SmoothPath(line)
    s = np.linspace(0, path.length, 20001)
    pose, curvature = path.pose(s), path.curvature(s)
    dense = line.resampled(min(0.01, line.length / 100)).points
    near = [np.hypot(*(dense - point).T).min() for point in pose[::100, :2]]
    assert max(near) < 0.35
    turn = np.diff(s) * (curvature[1:] + curvature[:-1]) / 2
    np.testing.assert_allclose(np.diff(pose[:, 2]), turn, atol=2e-5)
    assert np.abs(curvature).max() < 1.0


def test_arc_length_is_the_integral_of_the_speed() -> None:
    """Positions at even arc lengths are evenly spaced, also in a corner."""
    path = SmoothPath(Polyline(np.array([[0, 0], [30, 0], [30, 30]], float)))
    s = np.linspace(0, path.length, 60001)
    step = np.hypot(*np.diff(path.pose(s)[:, :2], axis=0).T)
    np.testing.assert_allclose(step, s[1], rtol=2e-3)
    assert step.sum() == pytest.approx(path.length, abs=1e-4)


@pytest.mark.parametrize(
    ("points", "text"),
    [
        pytest.param([[0, 0], [0, 0]], "more than 0", id="no-length"),
        pytest.param([[0, 0], [2e6, 0]], "up to 1e\\+06 m", id="too-long"),
        pytest.param([[0, 0], [50, 0], [0, 0]], "turns back on itself at s = 50", id="reversal"),
    ],
)
def test_unusable_paths(points: list[list[float]], text: str) -> None:
    """The message says why."""
    with pytest.raises(ValueError, match=text):
        SmoothPath(Polyline(np.array(points)))


@pytest.mark.parametrize(("first", "last"), [(0.1, 0.1), (0.1, 3.0), (0.5, 0.1)])
@pytest.mark.parametrize("length", [1.0, 40.0, 1e4])
def test_inserted_points_are_twice_as_far_apart_each_time(
    first: float, last: float, length: float
) -> None:
    """Away from both ends, up to the middle."""
    s = np.sort(_graded(7.0, 7.0 + length, first, last))
    up, down = s[s < 7 + length / 2] - 7, 7 + length - s[s > 7 + length / 2][::-1]
    for part, step in ((up, first), (down, last)):
        gaps = np.diff(part, prepend=0.0)
        np.testing.assert_allclose(gaps, step * 2.0 ** np.arange(len(part)), rtol=1e-6)
        following = (part[-1] if len(part) else 0.0) + step * 2.0 ** len(part)
        assert following >= length / 2 - 1e-9
