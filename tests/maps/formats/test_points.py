"""GeoJSON and CSV lines."""

import io
import json
from typing import Any

import numpy as np
import pytest

from maplines_can.maps import Map, MapFileError
from maplines_can.maps.formats.points import read
from maplines_can.maps.formats.projection import project
from maplines_can.values.line import Kind

TWO_LANES = """line,x,y,lane,side,kind
a,0,6,1,left,solid
a,90,6,,,
b,0,3,1,right,dashed
b,90,3,,,
c,0,3,2,left,dashed
c,90,3,,,
d,0,0,2,right,road_edge
d,50,0,,,
d,90,0,,,
e,90,3,3,Left,
e,99,3
f,90,0,3,right,
f,99,0
g,5,5,,,barrier
g,6,6
"""


def read_map(text: str) -> Map:
    return read(io.BytesIO(text.encode()), "map.csv")


def geojson(*features: dict[str, Any], **members: Any) -> str:
    return json.dumps({"type": "FeatureCollection", "features": features} | members)


def feature(*points: tuple[Any, Any], **properties: Any) -> dict[str, Any]:
    return {
        "type": "Feature",
        "properties": properties,
        "geometry": {"type": "LineString", "coordinates": points},
    }


def test_lanes_of_a_csv() -> None:
    """Boundaries with the same points link them."""
    found = read_map(TWO_LANES)
    one, two, three = found.lanes.values()
    assert (one.right_neighbour, two.left_neighbour) == ("2", "1")
    assert (two.successors, three.predecessors) == (("3",), ("2",))
    assert [lane.left.kind for lane in found.lanes.values()] == [
        Kind.SOLID,
        Kind.DASHED,
        Kind.UNKNOWN,
    ]
    assert two.right.kind == Kind.ROAD_EDGE
    assert two.centre.points.tolist() == [[0, 1.5], [50, 1.5], [90, 1.5]]
    assert list(found.polylines) == ["g"]
    assert found.polylines["g"].kind == Kind.BARRIER
    assert (found.skipped, found.projection) == ((), None)


@pytest.mark.parametrize(
    ("text", "where", "why"),
    [
        ("b,1,2\nb,x,3", "line 5", "line 'b' is not used: 'b,x,3' is not a point of a map"),
        ("b,1,2\nb,1", "line 5", "is not a point of a map"),
        ("b,1,2", "line 4", "needs two different points"),
        ("b,nan,2\nb,1,2", "line 4", "is not a point of a map"),
        ("b,1,2,1,left,pink\nb,1,3", "line 4", "one of unknown, solid, dashed"),
        ("b,1,2,1,top,\nb,1,3", "line 4", "the side must be left or right, got 'top'"),
        ("b,1,2,1,left,\nb,1,3", "line 4", "lane '1' is not used: it has only a left side"),
        ("b,1,2\nb,1,3\na,1,2\na,3,4", "line 6", "two places"),
    ],
)
def test_what_cannot_be_used_is_listed(text: str, where: str, why: str) -> None:
    found = read_map(f"line,x,y,lane,side,kind\na,0,0,,,\na,9,0,,,\n{text}\n")
    assert found.polylines["a"].length == 9
    (skipped,) = found.skipped
    assert skipped.where == where
    assert why in skipped.why


def test_a_side_given_twice_is_listed() -> None:
    found = read_map(TWO_LANES + "h,0,9,1,left,\nh,9,9\n")
    assert len(found.lanes) == 3
    assert "another left side" in found.skipped[0].why


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "there is no line, x, y"),
        ("x,y\n1,2", "there is no line"),
        ("line,x,y\n", "contains no usable lane"),
        ("line,x,y\na,1,2", "first reason: line 2: line 'a' is not used"),
        ("line,x,y\na,1," + "2" * 200_000, "line 2 has more than 65536 characters"),
        ("{", "is not JSON"),
        ("[" * 100_000, "is not JSON"),
        ("[]", "is not GeoJSON"),
        ('{"type": "Topology"}', "is not GeoJSON"),
        ('{"type": "FeatureCollection", "features": 3}', "is not GeoJSON"),
        ('{"type": "FeatureCollection", "features": []}', "contains no usable lane"),
    ],
)
def test_files_of_no_use(text: str, message: str) -> None:
    with pytest.raises(MapFileError, match=message):
        read_map(text)


def test_geojson_is_projected_around_its_middle() -> None:
    """The projection keeps the origin, so that others can be projected alike."""
    positions = [(8.40, 49.00), (8.41, 49.00), (8.41, 49.01)]
    found = read_map(geojson(feature(*positions, kind="solid", id="x")))
    line = found.polylines["x"]
    assert found.projection is not None
    assert "+proj=tmerc +lat_0=49.005 +lon_0=8.405" in found.projection
    longitude, latitude = np.array(positions).T
    assert line.points == pytest.approx(project(found.projection, latitude, longitude), abs=1e-9)
    assert line.kind == Kind.SOLID
    assert line.length == pytest.approx(731.7 + 1112.3, abs=0.5)


def test_geojson_of_another_system_is_kept() -> None:
    crs = {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}
    found = read_map(geojson(feature((456000.0, 5427000.0), (456010.0, 5427000.0)), crs=crs))
    assert found.projection == "urn:ogc:def:crs:EPSG::25832"
    assert found.polylines["0"].points.tolist() == [[456000, 5427000], [456010, 5427000]]
    crs["properties"] = {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}
    found = read_map(geojson(feature((8.0, 49.0), (8.1, 49.0)), crs=crs))
    assert "+proj=tmerc" in str(found.projection)


@pytest.mark.parametrize(
    ("bad", "why"),
    [
        (None, "its geometry is None"),
        (feature((8.0, 49.0)), "two different points"),
        (feature((1000.0, 49.0), (8.0, 49.0)), "no longitude and latitude"),
        (feature((0.0, 1.75), (10.0, 1.75)), "no longitude and latitude"),  # metres of a short road
        (feature((float("nan"), 49.0), (8.0, 49.0)), "no longitude and latitude"),
        ({"geometry": {"type": "Point", "coordinates": [8, 49]}}, "its geometry is Point"),
        ({"geometry": {"type": "LineString", "coordinates": 3}}, "not lists of two numbers"),
        ({"geometry": {"type": "LineString", "coordinates": [[1], [2]]}}, "not lists of two"),
        ({"geometry": {"type": "LineString", "coordinates": [["a", 1]]}}, "not lists of two"),
        ({"geometry": {"type": "LineString", "coordinates": [{"x": 1}]}}, "not lists of two"),
        ({"geometry": {"type": "LineString", "coordinates": [[10**400, 1]]}}, "not lists of two"),
        (feature((True, False), ("1", "2")), "not lists of two"),
        (feature((8.0, 49.0), (8.1, True)), "not lists of two"),
        ({"geometry": {"type": "MultiLineString", "coordinates": 3}}, "not lists of two"),
        (feature((8.0, 49.0), (8.1, 49.0), kind=3), "the kind must be one of"),
        (feature((8.0, 49.0), (8.1, 49.0), lane="1"), "the side must be left or right"),
    ],
)
def test_features_of_no_use_are_listed(bad: Any, why: str) -> None:
    found = read_map(geojson(feature((8.0, 49.0), (8.1, 49.0), id="good"), bad))
    assert list(found.polylines) == ["good"]
    (skipped,) = found.skipped
    assert skipped.where == "feature 1"
    assert why in skipped.why


def test_the_kind_of_a_csv_holds_from_its_point_on() -> None:
    """Up to the next one that is given; the same for lines without a lane."""
    text = """line,x,y,lane,side,kind
a,0,3,1,left,dashed
a,30,3,,,
a,50,3,,,solid
a,90,3,,,kerb
b,0,0,1,right,
b,90,0,,,
c,0,0,,,
c,60,0,,,barrier
c,60,0,,,barrier
c,80,0,,,
"""
    found = read_map(text)
    lane, other = found.lanes["1"], found.polylines["c"]
    assert lane.left.kinds == ((0.0, Kind.DASHED), (50.0, Kind.SOLID))
    assert (lane.left.kind, lane.right.kinds) == (Kind.DASHED, ())
    assert other.kinds == ((0.0, Kind.UNKNOWN), (60.0, Kind.BARRIER))
    assert found.skipped == ()


def test_a_side_of_several_lines_has_the_kind_of_each() -> None:
    """Each begins where the one before it ends; the lanes beside it share all of them."""
    text = """line,x,y,lane,side,kind
a,0,3,1,left,
a,90,3,,,
b,0,0,1,right,dashed
b,30,0,,,
c,30,0,1,right,solid
c,60,0,,,
c,90,0,,,
d,0,0,2,left,
d,30,0,,,
d,60,0,,,
d,90,0,,,
e,0,-3,2,right,
e,90,-3,,,
"""
    found = read_map(text)
    one = found.lanes["1"]
    assert one.right.points[:, 0].tolist() == [0, 30, 60, 90]
    assert one.right.kinds == ((0.0, Kind.DASHED), (30.0, Kind.SOLID))
    assert (one.right_neighbour, found.skipped) == ("2", ())

    sides = [(9.0, 50.0), (9.001, 50.0), (9.003, 50.0)], [(9.0, 49.999), (9.003, 49.999)]
    parts = [
        feature(*sides[0][:2], lane="1", side="left", kind="dashed"),
        feature(*sides[0][1:], lane="1", side="left", kind="solid"),
        feature(*sides[1], lane="1", side="right"),
    ]
    left = read_map(geojson(*parts)).lanes["1"].left
    assert [kind for _, kind in left.kinds] == [Kind.DASHED, Kind.SOLID]
    assert left.kinds[1][0] == pytest.approx(left.length / 3, rel=1e-3)


def test_text_in_another_encoding() -> None:
    with pytest.raises(MapFileError, match="cannot be read as text in UTF-8"):
        read(io.BytesIO(b"line,x,y\n\xff,1,2"), "map.csv")
