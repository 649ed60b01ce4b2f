"""CommonRoad XML, 2018b and 2020a."""

import io
from pathlib import Path

import pytest

import maplines_can as ml
from maplines_can.maps import LaneType, Map, MapFileError
from maplines_can.maps.formats.commonroad import read
from maplines_can.values.line import Kind


def bound(tag: str, *points: tuple[float, float], marking: str = "") -> str:
    body = "".join(f"<point><x>{x}</x><y> {y} </y></point>\n" for x, y in points)
    marking = f"<lineMarking>{marking}</lineMarking>" if marking else ""
    return f"<{tag}>{body}{marking}</{tag}>"


def lanelet(
    key: int | str,
    x: float = 0.0,
    y: float = 0.0,
    content: str = "",
    *,
    marking: str = "",
    kind: str = "urban",
) -> str:
    """Return a lanelet of 10 m by 3 m with its lower left corner at (x, y)."""
    return (
        f'<lanelet id="{key}">'
        + bound("leftBound", (x, y + 3), (x + 5, y + 3), (x + 10, y + 3), marking=marking)
        + bound("rightBound", (x, y), (x + 5, y), (x + 10, y))
        + content
        + "".join(f"<laneletType>{one}</laneletType>" for one in kind.split())
        + "</lanelet>\n"
    )


def document(*elements: str, version: str = "2020a") -> str:
    body = "".join(elements)
    return (
        f'<?xml version="1.0"?>\n<commonRoad commonRoadVersion="{version}" timeStepSize="0.1">\n'
        f"{body}</commonRoad>"
    )


def read_map(*elements: str) -> Map:
    return read(io.BytesIO(document(*elements).encode()), "map.xml")


def test_lines_and_links() -> None:
    found = read_map(
        lanelet(1, 0, 0, '<successor ref="2"/><adjacentLeft ref="3" drivingDir="same"/>'),
        lanelet(2, 10, 0, '<predecessor ref="1"/>'),
        lanelet(3, 0, 3, '<adjacentRight ref="1" drivingDir="same"/>'),
    )
    one, two, three = found.lanes.values()
    assert one.left.points.tolist() == [[0, 3], [5, 3], [10, 3]]
    assert one.right.points.tolist() == [[0, 0], [5, 0], [10, 0]]
    assert one.centre.points.tolist() == [[0, 1.5], [5, 1.5], [10, 1.5]]
    assert (one.successors, two.predecessors) == (("2",), ("1",))
    assert (one.left_neighbour, three.right_neighbour) == ("3", "1")
    assert [road.lanes for road in found.roads.values()] == [("1", "3"), ("2",)]
    assert not found.skipped


def test_opposite_lanelets() -> None:
    """On the right in left-hand traffic."""
    back = (
        '<lanelet id="2">'
        + bound("leftBound", (10, 3), (0, 3))
        + bound("rightBound", (10, 6), (0, 6))
        + '<adjacentLeft ref="1" drivingDir="opposite"/></lanelet>'
    )
    found = read_map(lanelet(1, 0, 0, '<adjacentLeft ref="2" drivingDir="opposite"/>'), back)
    assert [lane.opposite_left for lane in found.lanes.values()] == ["2", "1"]
    assert [lane.left_neighbour for lane in found.lanes.values()] == [None, None]
    assert not found.left_hand_traffic
    back = (
        '<lanelet id="2">'
        + bound("leftBound", (10, -3), (0, -3))
        + bound("rightBound", (10, 0), (0, 0))
        + '<adjacentRight ref="1" drivingDir="opposite"/></lanelet>'
    )
    assert read_map(
        lanelet(1, 0, 0, '<adjacentRight ref="2" drivingDir="opposite"/>'), back
    ).left_hand_traffic


@pytest.mark.parametrize(
    ("marking", "kind"),
    [
        ("solid", Kind.SOLID),
        ("broad_solid", Kind.SOLID),
        ("dashed", Kind.DASHED),
        ("broad_dashed", Kind.DASHED),
        ("solid_dashed", Kind.DOUBLE),
        ("curb", Kind.KERB),
        ("no_marking", Kind.VIRTUAL),
        ("unknown", Kind.UNKNOWN),
        ("", Kind.UNKNOWN),
        ("purple", Kind.UNKNOWN),
    ],
)
def test_markings(marking: str, kind: Kind) -> None:
    (lane,) = read_map(lanelet(1, marking=marking)).lanes.values()
    assert (lane.left.kind, lane.right.kind) == (kind, Kind.UNKNOWN)


@pytest.mark.parametrize(
    ("kind", "users", "expected"),
    [
        ("urban", "", LaneType.DRIVING),
        ("highway mainCarriageWay", "", LaneType.DRIVING),
        ("highway accessRamp", "", LaneType.ENTRY),
        ("highway exitRamp", "", LaneType.EXIT),
        ("urban busLane", "<userOneWay>bus</userOneWay>", LaneType.BUS),
        ("crosswalk", "", LaneType.CROSSWALK),
        ("urban", "<userOneWay>bicycle</userOneWay>", LaneType.BIKING),
        ("urban", "<userBidirectional>pedestrian</userBidirectional>", LaneType.SIDEWALK),
        ("urban", "<userBidirectional>vehicle</userBidirectional>", LaneType.BIDIRECTIONAL),
        ("shoulder", "", LaneType.SHOULDER),
        ("unknown", "", LaneType.DRIVING),
    ],
)
def test_types(kind: str, users: str, expected: LaneType) -> None:
    (lane,) = read_map(lanelet(1, content=users, kind=kind)).lanes.values()
    assert lane.type == expected


def sign(key: int, number: str, *values: str) -> str:
    more = "".join(f"<additionalValue>{value}</additionalValue>" for value in values)
    return (
        f'<trafficSign id="{key}"><trafficSignElement><trafficSignID>{number}</trafficSignID>'
        f"{more}</trafficSignElement></trafficSign>"
    )


@pytest.mark.parametrize(
    ("content", "limit"),
    [
        ("", None),
        ("<speedLimit>13.9</speedLimit>", 13.9),
        ("<speedLimit>-1</speedLimit>", None),
        ("<speedLimit>fast</speedLimit>", None),
        ("<speedLimit>inf</speedLimit>", None),
        ('<trafficSignRef ref="7"/>', 8.3),
        ('<trafficSignRef ref="7"/><trafficSignRef ref="8"/>', 5.0),
        ('<trafficSignRef ref="9"/><trafficSignRef ref="10"/><trafficSignRef ref="99"/>', None),
    ],
)
def test_speed_limits(content: str, limit: float | None) -> None:
    """Of 2018b in the lanelet, of 2020a by a sign [m/s]."""
    signs = (
        sign(7, "274", "8.3"),
        sign(8, "R2-1", "5"),
        sign(9, "206", "3"),
        sign(10, "274"),
    )
    (lane,) = read_map(lanelet(1, content=content), *signs).lanes.values()
    assert lane.speed_limit == limit


def test_lanes_of_an_intersection() -> None:
    found = read_map(
        lanelet(1, 0, 0, '<successor ref="2"/>'),
        lanelet(2, 10, 0),
        '<intersection id="5"><incoming id="6"><incomingLanelet ref="1"/>'
        '<successorsStraight ref="2"/></incoming></intersection>',
    )
    assert [lane.junction for lane in found.lanes.values()] == [None, "5"]


def test_the_projection() -> None:
    text = (
        "<location><geoNameId>1</geoNameId><geoTransformation>"
        "<geoReference>+proj=utm +zone=32</geoReference><additionalTransformation>"
        "<xTranslation>{}</xTranslation><yTranslation>0.0</yTranslation>"
        "<scaling>{}</scaling></additionalTransformation></geoTransformation></location>"
    )
    found = read_map(text.format("0.0", "1.0"), lanelet(1, 5e5))
    assert (found.projection, found.skipped) == ("+proj=utm +zone=32", ())
    for wrong in ("0.0", "1.1"), ("far", "1.0"):
        found = read_map(text.format(*wrong), lanelet(1, 5e5))
        assert found.skipped[0].why.startswith("zRotation and scaling are not applied")
        assert found.projection is None
    assert read_map(lanelet(1)).projection is None


def test_load(tmp_path: Path) -> None:
    """Other elements of a scenario are not read."""
    path = tmp_path / "scenario.xml"
    obstacle = "<dynamicObstacle id='3'><lanelet id='9'/></dynamicObstacle>"
    path.write_text(document(lanelet(1), obstacle, version="2018b"))
    assert list(ml.maps.load(path).lanes) == ["1"]
    path.write_text(document(obstacle))
    with pytest.raises(MapFileError, match="contains no usable lane"):
        ml.maps.load(path)


@pytest.mark.parametrize("both_ways", ["", "car", "vehicle", "bicycle", "pedestrian", "bus"])
@pytest.mark.parametrize("one_way", ["", "car", "bicycle", "pedestrian", "bus"])
@pytest.mark.parametrize("kind", ["urban", "highway exitRamp", "sidewalk"])
def test_types_of_all_users(kind: str, one_way: str, both_ways: str) -> None:
    """A lane of which only cyclists or walkers are users is theirs; cars may use it both ways."""
    tags = (("userOneWay", one_way), ("userBidirectional", both_ways))
    content = "".join(f"<{tag}>{user}</{tag}>" for tag, user in tags if user)
    (found,) = read_map(lanelet(1, content=content, kind=kind)).lanes.values()
    alone = {"urban": LaneType.DRIVING, "highway exitRamp": LaneType.EXIT}
    expected = alone.get(kind, LaneType.SIDEWALK)
    users = {one_way, both_ways} - {""}
    if kind in alone and users and not users - {"bicycle", "pedestrian"}:
        expected = LaneType.BIKING if "bicycle" in users else LaneType.SIDEWALK
    elif kind == "urban" and both_ways in ("car", "vehicle"):
        expected = LaneType.BIDIRECTIONAL
    assert found.type == expected


def test_a_lanelet_without_width_is_not_used() -> None:
    flat = bound("leftBound", (0, 9), (9, 9)) + bound("rightBound", (0, 9), (9, 9))
    found = read_map(lanelet(1), f'<lanelet id="2">{flat}</lanelet>')
    assert list(found.lanes) == ["1"]
    assert "it has no width" in found.skipped[0].why
