"""Lanelets: centre lines, links that lead nowhere, and roads."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.maps import Lane
from maplines_can.maps.formats.lanelets import boundary, centre_line, lanelet_map
from maplines_can.values.polyline import Polyline


def lane(key: str, y: float = 0.0, **links: object) -> Lane:
    lines = [boundary(np.array([[0, y + side], [9, y + side]])) for side in (3.0, 0.0, 1.5)]
    return Lane(key, lines[0], lines[1], centre=lines[2], **links)  # type: ignore[arg-type]


@given(st.floats(0.0, 1.2), st.integers(2, 9), st.integers(2, 9))
def test_the_centre_of_a_straight_lane(skew: float, first: int, second: int) -> None:
    """Also if its ends are not square."""
    left = Polyline(
        np.column_stack([np.linspace(3 * math.tan(skew), 50, first), np.full(first, 3)])
    )
    right = Polyline(np.column_stack([np.linspace(0, 50, second), np.zeros(second)]))
    points = centre_line(left, right).points
    assert points[:, 1] == pytest.approx(1.5)
    assert points[[0, -1], 0] == pytest.approx([1.5 * math.tan(skew), 50])


def test_a_corner_sharper_than_the_lane_is_wide() -> None:
    """The inner boundary makes a loop; points across from each other are known."""
    at = np.linspace(0, math.pi, 181)
    inner, outer = (
        boundary(np.column_stack([r * np.cos(at), r * np.sin(at)])) for r in (-0.5, 3.0)
    )
    assert np.hypot(*centre_line(inner, outer).points.T) == pytest.approx(1.25)


def test_links_that_lead_nowhere_are_removed() -> None:
    one = lane("1", successors=("2", "9"), left_neighbour="8", opposite_left="2")
    found = lanelet_map([one, lane("2", 3.0, predecessors=("1", "7"))], "m")
    assert found.lanes["1"].linked == ("2", "2")
    assert found.lanes["2"].linked == ("1",)
    assert [str(skipped) for skipped in found.skipped] == [
        "lane 1: its links to 8, 9 lead nowhere",
        "lane 2: its links to 7 lead nowhere",
    ]


def test_lanes_in_a_ring_are_one_road() -> None:
    """Loops of neighbours end."""
    ring = [lane(str(i), left_neighbour=str((i + 1) % 5)) for i in range(5)]
    found = lanelet_map(ring, "m")
    assert [road.lanes for road in found.roads.values()] == [("0", "1", "2", "3", "4")]
