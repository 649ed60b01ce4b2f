"""Mutilated Lanelet2, CommonRoad, GeoJSON and CSV files: an error or a listed reason, no more."""

import gzip
import io
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.lanelet_files import ROAD, Osm
from support.xodr_files import document, geometry, road

import maplines_can as ml
from maplines_can.maps import Map, MapFileError
from maplines_can.maps.formats import commonroad, osm, points
from maplines_can.maps.formats.opendrive import read as read_opendrive
from maplines_can.maps.formats.projection import tangent, utm

ENTITIES = {
    "billion-laughs": "<!DOCTYPE lolz [<!ENTITY a 'ha'><!ENTITY b '&a;&a;&a;&a;&a;&a;&a;'>]>",
    "quadratic": f"<!DOCTYPE lolz [<!ENTITY b '{'1' * 10**5}'>]>",
    "external": '<!DOCTYPE lolz [<!ENTITY b SYSTEM "file:///etc/passwd">]>',
    "parameter": '<!DOCTYPE lolz [<!ENTITY % b SYSTEM "http://localhost/b"> %b;]>',
    "external-subset": '<!DOCTYPE lolz PUBLIC "-//X//Y" "http://localhost/b.dtd">',
}


def lanelet2_text() -> str:
    town = Osm()
    ways = [town.way((0.0, y), (20.0, y + 1), (40.0, y), type="line_thin") for y in (3.0, 0, -3.0)]
    town.lanelet(ways[0], ways[1], ROAD | {"speed_limit": "50"})
    town.lanelet(ways[1], ways[2])
    town.strip(100.0, 120.0)
    return town.text()


def commonroad_text() -> str:
    lanelets = "".join(
        f'<lanelet id="{key}">'
        + "".join(
            f"<{tag}><point><x>{x}</x><y>{y}</y></point><point><x>{x + 9}</x><y>{y}</y></point>"
            f"<lineMarking>solid</lineMarking></{tag}>"
            for tag, y in (("leftBound", 3), ("rightBound", 0))
        )
        + f'<predecessor ref="{key - 1}"/><successor ref="{key + 1}"/>'
        + '<laneletType>urban</laneletType><trafficSignRef ref="9"/></lanelet>\n'
        for key, x in ((1, 0), (2, 9), (3, 18))
    )
    sign = (
        '<trafficSign id="9"><trafficSignElement><trafficSignID>274</trafficSignID>'
        "<additionalValue>8</additionalValue></trafficSignElement></trafficSign>"
    )
    other = '<dynamicObstacle id="4"><lanelet id="9"/></dynamicObstacle>'  # is not read
    return f'<?xml version="1.0"?>\n<commonRoad>{lanelets}{sign}{other}</commonRoad>'


def geojson_text() -> str:
    features = [
        {
            "type": "Feature",
            "properties": {"lane": "1", "side": side, "kind": "solid"},
            "geometry": {"type": "LineString", "coordinates": [[8.0, lat], [8.1, lat]]},
        }
        for side, lat in (("left", 49.00003), ("right", 49.0))
    ]
    return json.dumps({"type": "FeatureCollection", "features": features})


CSV = "line,x,y,lane,side,kind\na,0,3,1,left,solid\na,9,3,,,\nb,0,0,1,right,\nb,9,0,,,\n"
Read = Callable[[BinaryIO, str], Map]
FILES: dict[str, tuple[Read, str]] = {
    "Lanelet2": (osm.read, lanelet2_text()),
    "CommonRoad": (commonroad.read, commonroad_text()),
    "GeoJSON": (points.read, geojson_text()),
    "CSV": (points.read, CSV),
}
#: Its cut and changed files are in test_bad_opendrive.py.
OPENDRIVE: dict[str, tuple[Read, str]] = {
    "OpenDRIVE": (read_opendrive, document(road(plan=geometry(x=1.0))))
}


def attempt(read: Read, data: bytes) -> Map | None:
    """Return the map, or None if there is none; all that is in it must be usable."""
    try:
        found = read(io.BytesIO(data), "map")
    except MapFileError:
        return None
    for lane in found.lanes.values():
        assert np.isfinite(lane.centre.points).all()
        assert lane.width >= 0
    return found


@pytest.mark.parametrize("name", FILES)
def test_the_files_are_good(name: str) -> None:
    read, text = FILES[name]
    found = attempt(read, text.encode())
    assert found is not None
    assert found.lanes
    assert len(found.skipped) == (2 if name == "CommonRoad" else 0)  # the links out of the map


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("Lanelet2", "map.osm"), ("Lanelet2", "map.osm.gz"), ("Lanelet2", "map.xml"),
        ("CommonRoad", "scenario.xml"), ("GeoJSON", "map.geojson"), ("GeoJSON", "map.json"),
        ("GeoJSON", "MAP.GEOJSON"), ("CSV", "map.csv"),
    ],
)  # fmt: skip
def test_load(tmp_path: Path, name: str, file: str) -> None:
    """By content or suffix, compressed and with a byte order mark; in another frame if it can."""
    read, text = FILES[name]
    data, path = b"\xef\xbb\xbf" * (name == "GeoJSON") + text.encode(), tmp_path / file
    path.write_bytes(gzip.compress(data) if file.endswith("gz") else data)
    road_map = ml.maps.load(path)
    assert (road_map.lanes.keys(), road_map.name) == (read(io.BytesIO(data), "").lanes.keys(), file)
    if name == "CSV":
        with pytest.raises(ValueError, match="is CSV, whose positions are in metres"):
            ml.maps.load(path, projection=utm(49.0, 8.0))
    elif name != "CommonRoad":
        frame = tangent(49.0, 8.4)
        assert ml.maps.load(path, projection=frame).projection == frame


@pytest.mark.parametrize("name", FILES)
@given(data=st.data())
def test_cut_files(name: str, data: st.DataObject) -> None:
    read, text = FILES[name]
    attempt(read, text.encode()[: data.draw(st.integers(0, len(text)))])


@pytest.mark.parametrize("name", FILES)
@given(data=st.data())
def test_changed_values(name: str, data: st.DataObject) -> None:
    """Each quoted value, text or field becomes something else."""
    read, text = FILES[name]
    places = [m.span(1) for m in re.finditer(r'[">,\n ]([^"<>,\n{}\[\] ]+)(?=["<,\n\] ])', text)]
    for start, stop in sorted(
        data.draw(st.lists(st.sampled_from(places), max_size=4, unique=True)), reverse=True
    ):
        bad = data.draw(st.sampled_from(["", "nan", "inf", "1e400", "-1", "9" * 30, "x", "left"]))
        text = text[:start] + bad + text[stop:]
    attempt(read, text.encode())


@pytest.mark.parametrize("kind", ENTITIES)
@pytest.mark.parametrize("name", ["Lanelet2", "CommonRoad", "OpenDRIVE"])
def test_entities_are_refused(name: str, kind: str) -> None:
    read, text = (FILES | OPENDRIVE)[name]
    bad = text.replace("?>", f"?>{ENTITIES[kind]}", 1).replace('id="1"', 'id="&b;"', 1)
    with pytest.raises(MapFileError, match="document type"):
        read(io.BytesIO(bad.encode()), "map")


LANELET2 = [
    ('<nd ref="2"/>', '<nd ref="77"/>', "node '77' of way 1 is not in the file"),
    ('<member type="way" ref="1" role="left"/>', "", "0 boundaries with the role left"),
    ('ref="1" role="left"', 'ref="78" role="left"', "way '78', is not in the file"),
    ('role="right"', 'role="left"', "2 boundaries with the role left"),
    ('<nd ref="2"/><nd ref="3"/><nd ref="4"/>', '<nd ref="2"/>', "way 1 has 1 points"),
    ('<nd ref="2"/><nd ref="3"/><nd ref="4"/>', '<nd ref="2"/><nd ref="2"/>', "two different"),
    ('lat="49.00002697599137"', 'lat="nan"', "node '2' has no usable latitude"),
    ('lat="49.00002697599137"', "", "node '2' has no usable latitude"),
    ('lat="49.00002697599137"', 'lat="91"', "node '2' has no usable latitude"),
    ('<way id="1">', '<way id="5">', "another one has the same id"),
]


@pytest.mark.parametrize(("good", "bad", "why"), LANELET2)
def test_lanelets_of_no_use_are_listed(good: str, bad: str, why: str) -> None:
    """With the line of the file; the others are used."""
    text = lanelet2_text()
    assert good in text
    found = osm.read(io.BytesIO(text.replace(good, bad, 1).encode()), "map")
    assert 0 < len(found.lanes) < 3
    assert any(why in skipped.why for skipped in found.skipped), found.skipped
    assert re.match(r'line \d+, <(relation|way) id="\d+">', found.skipped[0].where)


COMMONROAD = [
    ("<x>0</x>", "<x>nan</x>", "the point in line 2 has no finite x and y"),
    ("<x>0</x>", "", "has no finite x and y"),
    ("leftBound>", "middleBound>", "it has no <leftBound>"),
    ('id="1"', 'id=""', "it has no id"),
    ('id="2"', 'id="1"', "another one has the same id"),
    ("<x>9</x>", "<x>0</x>", "two different points"),
    ("<x>9</x>", "<x>1e300</x>", "at most 1e+08 m"),
    ("<y>3</y>", "<y>0</y>", "it has no width"),
]


@pytest.mark.parametrize(("good", "bad", "why"), COMMONROAD)
def test_lanelets_of_commonroad_of_no_use_are_listed(good: str, bad: str, why: str) -> None:
    text = commonroad_text()
    assert good in text
    found = commonroad.read(io.BytesIO(text.replace(good, bad, 2).encode()), "map")
    assert 0 < len(found.lanes) < 3
    assert any(why in skipped.why for skipped in found.skipped), found.skipped


def test_many_points() -> None:
    """Of one boundary; the other has two."""
    count = 10**5
    x = np.linspace(0, 5e4, count)
    rows = "\n".join(f"a,{one:.3f},3,1,left" for one in x)
    found = points.read(
        io.BytesIO(f"line,x,y,lane,side\n{rows}\nb,0,0,1,right\nb,5e4,0,1,right\n".encode()), "map"
    )
    (lane,) = found.lanes.values()
    assert len(lane.left.points) == count
    assert lane.centre.points[:, 1] == pytest.approx(1.5)


#: Where the coordinates of each format are, as a group.
COORDINATES = {
    "Lanelet2": r'l(?:at|on)="([^"]*)"',
    "CommonRoad": r"<[xy]>([^<]*)<",
    "GeoJSON": r"[\[ ](\d[\d.]*)[\],]",
    "CSV": r"(?<=[a-z],)(\d)|(?<=\d,)(\d)(?=,)",
    "OpenDRIVE": r' (?:s|x|y|hdg|length)="([^"]*)"',
}
#: What is no finite number in any format, and what is one in Python or in another format only.
NO_NUMBERS = ["true", "false", "NaN", "Infinity", "-inf", "1e400", "1_0", "x", "\uff11", "9" * 400]
NO_NUMBERS += [""]
NO_JSON_NUMBERS = ["true", "false", "null", "NaN", "Infinity", "1e400", "9" * 400, '"8.0"', "[8.0]"]
NO_JSON_NUMBERS += ["{}", '""', '{"0": 8.0}']


@pytest.mark.parametrize("name", COORDINATES)
def test_a_coordinate_that_is_no_number_is_listed(name: str) -> None:
    """Any one of them; the rest of the map is used, or there is none."""
    read, text = (FILES | OPENDRIVE)[name]
    places = [
        next(span for span in match.regs[1:] if span[0] >= 0)
        for match in re.finditer(COORDINATES[name], text)
    ]
    assert len(places) >= 5
    before = attempt(read, text.encode())
    assert before is not None
    for start, stop in places:
        for bad in NO_JSON_NUMBERS if name == "GeoJSON" else NO_NUMBERS:
            found = attempt(read, (text[:start] + bad + text[stop:]).encode())
            assert found is None or len(found.skipped) > len(before.skipped), (start, bad)


@pytest.mark.parametrize("name", FILES)
@given(data=st.data())
def test_missing_lines_and_tags(name: str, data: st.DataObject) -> None:
    read, text = FILES[name]
    parts = re.split(r"(?<=>)|(?<=\n)|(?<=,)", text)
    gone = data.draw(st.sets(st.integers(0, len(parts) - 1), max_size=3))
    attempt(read, "".join(part for i, part in enumerate(parts) if i not in gone).encode())
