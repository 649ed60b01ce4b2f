"""Lanelet2 maps by the reader of this package."""

import pytest
from support.lanelet_files import Osm

from maplines_can.maps import MapFileError
from maplines_can.maps.formats.projection import local_cartesian, tangent


def test_links_follow_from_shared_ways_and_points() -> None:
    """As on a road of two lanes and an oncoming one, that splits at its end.

    ::

        6 ---- 40 ---- 90        oncoming (third), one lanelet
        3 ---- 40 --             middle: the left boundary of all
        0 ---- 40 --             first, then ahead
       -3 ---- 40 ----           second
    """
    osm = Osm()
    ways = [osm.way((0.0, y), (20.0, y), (40.0, y)) for y in (6.0, 3.0, 0.0, -3.0)]
    first = osm.lanelet(ways[1], ways[2])
    second = osm.lanelet(ways[2], ways[3])
    oncoming = osm.lanelet(ways[1], ways[0])
    ahead = osm.lanelet(osm.way((40.0, 3.0), (80.0, 3.0)), osm.way((40.0, 0.0), (80.0, 0.0)))
    exit_ = osm.lanelet(osm.way((40.0, 3.0), (80.0, 33.0)), osm.way((40.0, 0.0), (83.0, 30.0)))
    found = osm.map()
    lanes = found.lanes
    assert (lanes[first].right_neighbour, lanes[first].left_neighbour) == (second, None)
    assert (lanes[second].right_neighbour, lanes[second].left_neighbour) == (None, first)
    assert lanes[first].opposite_left == oncoming
    assert lanes[oncoming].opposite_left == first
    assert lanes[oncoming].centre.points[0, 0] > lanes[oncoming].centre.points[-1, 0]
    assert lanes[first].successors == (ahead, exit_)
    assert lanes[ahead].predecessors == lanes[exit_].predecessors == (first,)
    assert lanes[second].successors == lanes[oncoming].successors == ()
    assert not found.left_hand_traffic
    roads = {road.lanes for road in found.roads.values()}
    assert {frozenset(one) for one in roads} == {
        frozenset({first, second, oncoming}),
        frozenset({ahead}),
        frozenset({exit_}),
    }
    road = found.roads[lanes[first].road]
    assert road.length == pytest.approx(40, rel=0.01)
    assert road.successors == (lanes[ahead].road, lanes[exit_].road)
    assert lanes[first].left is not lanes[second].left
    assert lanes[first].right is lanes[second].left


def test_the_frame_is_utm() -> None:
    """Or another one, when it is named."""
    osm = Osm()
    osm.strip(0.0, 100.0)
    found = osm.map()
    assert found.projection == "+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs"
    (lane,) = found.lanes.values()
    assert lane.right.points[0] == pytest.approx((456114.2, 5427628.2), abs=5)
    for projection in (tangent(49.0, 8.4), local_cartesian(49.0, 8.4)):
        (lane,) = osm.map(projection).lanes.values()
        assert lane.right.points[0] == pytest.approx((0.0, 0.0), abs=1e-6)
        assert lane.left.points[-1] == pytest.approx((100.0, 3.5), rel=0.01)
    with pytest.raises(ValueError, match="project the positions with pyproj"):
        osm.map("+proj=merc")


def test_local_coordinates_are_used_where_most_lanelets_have_them() -> None:
    """They are exact, and those without are listed."""
    osm = Osm("both")
    osm.strip(0.0, 100.0)
    osm.strip(100.0, 200.0)
    found = osm.map()
    assert found.projection is None
    assert [lane.right.points.tolist() for lane in found.lanes.values()] == [
        [[0.0, 0.0], [100.0, 0.0]],
        [[100.0, 0.0], [200.0, 0.0]],
    ]
    osm.frame = "globe"
    osm.strip(200.0, 300.0)
    found = osm.map()
    assert found.projection is not None, "all have a position on the globe"
    assert len(found.lanes) == 3
    osm = Osm("local")
    local = [osm.strip(x, x + 90.0) for x in (0.0, 100.0)]
    osm.frame = "globe"
    osm.strip(200.0, 290.0)
    found = osm.map()
    assert list(found.lanes) == local
    (skipped,) = found.skipped
    assert "has no usable local_x and local_y" in skipped.why


def test_other_relations_are_counted() -> None:
    osm = Osm()
    osm.strip(0.0, 9.0)
    for key, subtype in enumerate(("right_of_way", "traffic_light", "traffic_light")):
        osm.elements.append(
            f'<relation id="9{key}"><tag k="type" v="regulatory_element"/>'
            f'<tag k="subtype" v="{subtype}"/></relation>'
        )
    (skipped,) = osm.map().skipped
    assert skipped.where == "3 relations of type regulatory_element"
    assert skipped.why == "only lanelets are used, not: 1 right_of_way, 2 traffic_light"


def test_a_street_map_is_an_error() -> None:
    osm = Osm()
    osm.way((0.0, 0.0), (1.0, 1.0), highway="residential")
    with pytest.raises(MapFileError, match="contains no lanelet"):
        osm.map()


def test_deleted_elements_do_not_count() -> None:
    osm = Osm()
    osm.strip(0.0, 9.0)
    last = osm.strip(20.0, 29.0)
    osm.elements[-1] = osm.elements[-1].replace("<relation", '<relation action="delete"')
    osm.elements.append('<bounds minlat="49.0"/>')  # nor do others
    assert last not in osm.map().lanes
