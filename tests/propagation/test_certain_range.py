"""The valid range ends where the lateral position of a line is less certain than a limit."""

from typing import Any

import numpy as np
import pytest
from evidence.roads import SHAPES, random_scene
from evidence.witness import POSES, Poses
from hypothesis import example, given
from hypothesis import strategies as st
from support.strategies import covariances

from maplines_can import Gaussian, LeftOut, MapError, MapLine, Polyline, map_lines, map_scene
from maplines_can.core import lib
from maplines_can.core.memory import pointer

MAP_ERROR = MapError(0.05, 0.05, 0.001)


def sigma_of(mean: Any, cov: Any, x: Any) -> Any:
    """The standard deviation of y(x) from its definition, to first order."""
    slope = 1 + np.tan(mean[1]) ** 2
    g = np.stack([np.ones_like(x), slope * x, x**2 / 2, x**3 / 6], axis=-1)
    return np.sqrt(np.einsum("ki,ij,kj->k", g, cov, g).clip(0))


@given(
    covariances(jitters=(0.0, 1e-12, 1e-6)),
    st.floats(-1.2, 1.2),
    st.tuples(st.floats(-60, 100), st.floats(1.0, 120.0)),
    st.floats(-2.0, 0.2),
)
@example(np.diag([0.1, 0.01, 0, 0]) ** 2, 0.0, (-20.0, 100.0), -0.3)
@example(np.full((4, 4), 0.25), 0.0, (0.05, 2.0), -1.0)
@example(np.zeros((4, 4)), 0.0, (-20.0, 100.0), 0.0)
def test_the_range_is_the_longest_one_about_the_car(
    cov: Any, beta: float, place: Any, decades: float
) -> None:
    """Within it the line is certain, at its ends it is at the limit; a scan is the witness."""
    mean = np.array([1.0, beta, 0.001, 0.0])
    low, high = place[0], place[0] + place[1]
    car = np.clip(0.0, low, high)
    largest = sigma_of(mean, cov, np.linspace(low, high, 100)).max()
    limit = 10.0**decades * max(largest, 1e-9)
    found = np.array([low, high])
    lib.maplines_shorten_line(pointer(mean), pointer(np.array(cov)), limit, pointer(found))
    if np.isnan(found).any():
        assert sigma_of(mean, cov, np.array([car]))[0] >= limit * (1 - 1e-6)
        return
    slack = 1e-6 * (high - low)
    assert low <= found[0] <= car + slack
    assert car - slack <= found[1] <= high
    assert (sigma_of(mean, cov, np.linspace(found[0], found[1], 300)) <= limit * (1 + 1e-5)).all()
    for end, last in zip(found, (low, high), strict=True):
        if end != last:
            assert sigma_of(mean, cov, np.array([end]))[0] == pytest.approx(limit, rel=1e-4)


def lines_of(shape: str, number: int) -> Any:
    """Lines of a random road, and a poor pose."""
    rng = np.random.default_rng([7, number])
    case = random_scene(shape, rng, 4)
    poses = Poses.about(case.pose, POSES["poor"], 1, rng)
    lines = {slot: Polyline(points) for slot, points in case.lines.items()}
    return lines, Gaussian(case.pose, poses.cov)


def is_certain(line: MapLine, max_sigma: float) -> bool:
    x = np.linspace(line.x_min, line.x_max, 200)
    return bool((line.y_sigma(x) <= max_sigma * (1 + 1e-6)).all())


@pytest.mark.parametrize("max_sigma", [1.05])
@pytest.mark.parametrize("shape", ["rural", "hairpin"])
def test_lines_and_scenes_are_certain_in_their_ranges(shape: str, max_sigma: float) -> None:
    """All that are given; without a limit, the same lines are given, or longer ones."""
    assert shape in SHAPES
    for number in range(4):
        lines, ego = lines_of(shape, number)
        for of in (map_lines, map_scene):
            found: Any = of(lines, ego, map_error=MAP_ERROR, max_sigma=max_sigma)
            free: Any = of(lines, ego, map_error=MAP_ERROR, max_sigma=np.inf)
            given = {line.slot: line for line in getattr(found, "lines", found)}
            longest = {line.slot: line for line in getattr(free, "lines", free)}
            assert given.keys() <= longest.keys()
            assert given.keys() | found.left_out.keys() == lines.keys()
            for slot in longest.keys() - given.keys():
                assert found.left_out[slot] is LeftOut.UNCERTAIN
            for slot, line in given.items():
                assert is_certain(line, max_sigma)
                if is_certain(longest[slot], max_sigma):
                    assert (line.x_min, line.x_max) == (longest[slot].x_min, longest[slot].x_max)
                else:
                    assert line.x_max - line.x_min < longest[slot].x_max - longest[slot].x_min
