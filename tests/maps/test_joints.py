"""Joints of lines: several lines at once are those that they are alone."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.lane_maps import lane, network

from maplines_can.maps.joints import SNAP, joined_lines
from maplines_can.maps.lane_graph import DirectedLane, LaneGraph
from maplines_can.values.line import Kind
from maplines_can.values.polyline import Polyline

POINT = st.tuples(*[st.integers(-3, 3).map(lambda i: i * SNAP * 0.8)] * 2)  # often near
PARTS = st.lists(st.lists(POINT, min_size=2, max_size=4), min_size=1, max_size=4)


@given(lines=st.lists(st.tuples(PARTS, st.sampled_from(Kind)), min_size=1, max_size=4))
def test_lines_joined_point_by_point(
    lines: list[tuple[list[list[tuple[float, float]]], Kind]],
) -> None:
    """Each line has the points of its parts without those near the end of the part before."""
    found = joined_lines([([np.array(part) for part in parts], kind) for parts, kind in lines])

    for (parts, kind), (line, starts) in zip(lines, found, strict=True):
        points = list(parts[0])
        rows = [0]
        for before, part in pairwise(parts):
            is_near = int(np.hypot(*np.subtract(part[0], before[-1])) <= SNAP)
            rows.append(len(points) - is_near)
            points += part[is_near:]
        expected = Polyline(points, kind)
        assert line.kind is kind
        assert line.points.tolist() == expected.points.tolist()
        assert line.distance == pytest.approx(expected.distance, abs=1e-12)
        assert starts == pytest.approx(expected.distance[rows], abs=1e-12)


@given(s=st.floats(0.0, 120.0), is_against=st.booleans())
def test_points_of_a_lane_up_to_a_position(s: float, is_against: bool) -> None:
    """They reach the position in either direction, and end with the next point."""
    graph = LaneGraph(network(lane("1")).lanes)
    line = graph[DirectedLane("1", is_against)].left

    points = line.points_up_to(s)
    whole = line.polyline

    assert line.back.back is line
    assert (line.start, line.end) == tuple(map(tuple, whole.points[[0, -1]].tolist()))
    assert points.tolist() == whole.points[: len(points)].tolist()
    last = len(points) - 1
    assert last == len(whole.points) - 1 or whole.distance[last] >= s
    assert last == 1 or whole.distance[last - 1] < s
