"""CommonRoad XML, 2018b and 2020a."""

import io

from maplines_can.maps import Map
from maplines_can.maps.formats.commonroad import read


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
