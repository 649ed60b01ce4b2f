"""The values of a map."""

from dataclasses import replace

import numpy as np
import pytest

from maplines_can import Polyline
from maplines_can.maps import Lane, Map, Road


def line(*points: list[float]) -> Polyline:
    return Polyline(np.array(points))


def lane(lane_id: str = "a", width: float = 3.0) -> Lane:
    left, right, centre = (line([0, y], [50, y], [100, y + 1]) for y in (width, 0.0, width / 2))
    return Lane(lane_id, left, right, centre, road="1")


def road(*lanes: str) -> Road:
    return Road("1", "", 100.0, lanes)


def test_width_is_the_mean_distance_of_the_boundaries() -> None:
    assert lane(width=3.25).width == pytest.approx(3.25)
    left = line([0, 2], [100, 4])
    right = line(*([x, 0] for x in np.linspace(0, 100, 7)))
    assert replace(lane(), left=left, right=right).width == pytest.approx(3, abs=0.01)


def test_width_of_a_lane_whose_boundary_is_a_point() -> None:
    """As inside a turn on the spot."""
    point = line([0, 0], [0, 0])
    arc = line(*([3 * np.cos(a), 3 * np.sin(a)] for a in np.linspace(0, 1, 50)))
    assert replace(lane(), left=point, right=arc).width == pytest.approx(3, abs=1e-3)


def test_a_map_cannot_be_changed() -> None:
    """Neither can a dict that it was made from."""
    lanes = {"a": lane()}
    found = Map(lanes, {"1": road("a")})
    lanes.clear()
    assert list(found.lanes) == ["a"]
    with pytest.raises(TypeError):
        found.lanes["b"] = lane("b")  # type: ignore[index]


@pytest.mark.parametrize(
    ("lanes", "roads", "message"),
    [
        ({"b": lane()}, {"1": road()}, r"lanes\['b'\] has the id 'a'"),
        ({"a": lane()}, {"2": road()}, r"roads\['2'\] has the id '1'"),
        ({"a": lane()}, {}, "lane 'a' is on the road '1', not in roads"),
        ({"a": replace(lane(), successors=("b",))}, {"1": road("a")}, "lane 'a' names 'b'"),
        ({"a": replace(lane(), predecessors=("b",))}, {"1": road("a")}, "lane 'a' names 'b'"),
        ({"a": replace(lane(), left_neighbour="b")}, {"1": road("a")}, "lane 'a' names 'b'"),
        ({"a": replace(lane(), opposite_left="b")}, {"1": road("a")}, "lane 'a' names 'b'"),
        ({"a": lane()}, {"1": road("b")}, "road '1' names 'b'"),
        ({"a": lane()}, {"1": replace(road("a"), successors=("2",))}, "road '1' names '2'"),
    ],
)
def test_ids_that_lead_nowhere_are_an_error(
    lanes: dict[str, Lane], roads: dict[str, Road], message: str
) -> None:
    """A mistake of a reader; what is wrong in a file is listed as skipped."""
    with pytest.raises(ValueError, match=message):
        Map(lanes, roads)
