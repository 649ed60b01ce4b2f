"""Mutilated OpenDRIVE files: an error or a listed reason, never a traceback or a hang."""

import contextlib
import io
import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.xodr_files import (
    WIDTH,
    cubic,
    document,
    geometry,
    lane,
    linked,
    read_map,
    reasons,
    road,
    section,
)

from maplines_can.maps import LaneTracker, MapFileError
from maplines_can.maps.formats.opendrive import read
from maplines_can.maps.road_map import Map
from maplines_can.values.errors import RouteError

GOOD = road(
    section(
        lane(1, successor=1),
        lane(-1, WIDTH + '<roadMark sOffset="0" type="broken"/>', successor=-1),
        lane(-2, cubic("border", -7.0, sOffset=0.0), kind="shoulder"),
        centre='<roadMark sOffset="0" type="solid"/>',
    ),
    section(lane(1), lane(-1, WIDTH + '<speed sOffset="0" max="9" unit="m/s"/>'), s=120.0),
    plan=geometry(length=50.0)
    + geometry('<spiral curvStart="0" curvEnd="0.01"/>', s=50.0, x=50.0, length=50.0)
    + geometry(
        '<paramPoly3 pRange="normalized" '
        'aU="0" bU="50" cU="0" dU="0" aV="0" bV="0" cV="1" dV="0"/>',
        s=100.0,
        x=99.689,
        y=4.148,
        length=50.0,
    )
    + geometry('<poly3 a="0" b="0.1" c="0" d="0"/>', s=150.0, x=149.689, y=5.148, length=10.0)
    + geometry('<arc curvature="0.02"/>', s=160.0, x=159.639, y=6.143, length=10.0),
    length=170.0,
    offsets=cubic("laneOffset", 0.5, s=0.0),
    lateral=cubic("superelevation", 0.05, s=0.0),
    before='<type s="0" type="town"><speed max="50" unit="km/h"/></type>',
    link=linked("successor", "9", "", "junction"),
)
OTHER = road(road_id="2", plan=geometry(x=170.0), link=linked("predecessor", "9", "", "junction"))
JUNCTION = (
    '<junction id="9"><connection id="0" incomingRoad="1" connectingRoad="2" contactPoint="start">'
    '<laneLink from="-1" to="-1"/></connection></junction>'
)
TEXT = document(GOOD, OTHER, JUNCTION, header="<geoReference>+proj=tmerc</geoReference>")


def read_text(text: str | bytes) -> Map:
    data = text.encode() if isinstance(text, str) else text
    return read(io.BytesIO(data), "map.xodr")


def attempt(text: str | bytes) -> Map | None:
    """Return the map, or None if the file is refused."""
    try:
        return read_text(text)
    except MapFileError as error:
        assert str(error).startswith("map.xodr")  # noqa: PT017 - either outcome is right
        return None


def test_the_file_is_good() -> None:
    """Before it is mutilated."""
    found = read_text(TEXT)
    assert not found.skipped
    assert len(found.lanes) == 7
    assert found.lanes["1:1:-1"].successors == ("2:0:-1",)


NUMBERS = ["nan", "inf", "-inf", "1e400", "", "x", "1,5", "0x10", "1e308", "-1e308", "1e-320"]
NUMBERS += ["1" * 5000]
ATTRIBUTES = sorted(set(re.findall(r' (\w+)="[-\d.e]+"', TEXT)) - {"version"})


@pytest.mark.parametrize("name", ATTRIBUTES)
def test_numbers_that_are_none(name: str) -> None:
    """In each attribute in turn, of all elements together and of each third of them alone."""
    places = list(re.finditer(rf' {name}="[-\d.e]+"', TEXT))
    for i, value in enumerate(NUMBERS):
        changed = f' {name}="{value}"'
        found = attempt(re.sub(rf' {name}="[-\d.e]+"', changed, TEXT))
        for place in places[i % 3 :: 3]:
            found = attempt(TEXT[: place.start()] + changed + TEXT[place.end() :])
            assert found is None or len(found.lanes) >= 2  # road 2, at least, or road 1


#: Without them, no road can be used.
NECESSARY = {"OpenDRIVE", "road", "planView", "geometry", "line", "lanes", "laneSection", "lane"}


@pytest.mark.parametrize("tag", sorted(set(re.findall(r"<(\w+)[ >/]", TEXT))))
def test_elements_that_are_missing(tag: str) -> None:
    """Renamed, so that they are unknown."""
    found = attempt(re.sub(rf"<(/?){tag}\b", r"<\1unknown", TEXT))
    assert (found is None) == (tag in NECESSARY)
    for place in re.finditer(rf"<{tag}\b([^>]*)/>", TEXT):
        assert attempt(TEXT[: place.start()] + TEXT[place.end() :]) is not None


@given(st.integers(0, TEXT.index("</OpenDRIVE>") + 11))
def test_a_cut_file(end: int) -> None:
    """What is complete is used, and the cut is listed."""
    found = attempt(TEXT[:end])
    assert len(found.roads if found else ()) == TEXT[:end].count("</road>")
    if found:
        assert any("the rest of the file is not used" in why for why in reasons(found))


@given(st.data())
def test_changed_bytes(data: st.DataObject) -> None:
    """Some bytes of the file are others."""
    changed = bytearray(TEXT.encode())
    for _ in range(data.draw(st.integers(1, 5))):
        changed[data.draw(st.integers(0, len(changed) - 1))] = data.draw(st.integers(0, 255))
    attempt(bytes(changed))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        pytest.param("<OpenDRIVE>" + "<a>" * 100_000, "nested more than 64 deep", id="nesting"),
        pytest.param(
            f"<OpenDRIVE><header><geoReference>{'x' * 10**6}</geoReference></header></OpenDRIVE>",
            "<geoReference> has more than 65536 characters of text",
            id="text",
        ),
        pytest.param(
            '<?xml version="1.0" encoding="UTF-9"?><OpenDRIVE/>',
            "unknown encoding: UTF-9; save it as UTF-8",
            id="unknown-encoding",
        ),
        pytest.param(
            '<?xml version="1.0" encoding="gb2312"?><OpenDRIVE/>',
            "multi-byte encodings are not supported; save it as UTF-8",
            id="encoding-of-several-bytes",
        ),
        pytest.param("<a/>", "not an OpenDRIVE file: the root element is <a>", id="root"),
        pytest.param("<OpenDRIVE>&x;</OpenDRIVE>", "contains no usable road", id="entity"),
        pytest.param(
            document(road(plan="")), 'first reason: line 4, <road id="1">: .*planView', id="plan"
        ),
    ],
)
def test_files_that_are_refused(text: str, message: str) -> None:
    with pytest.raises(MapFileError, match=message):
        read_text(text)


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        pytest.param(
            road(plan=geometry(length=1e7), length=1e7), "length must be from 0 to 1e+06", id="long"
        ),
        pytest.param(road(plan=geometry(x=1e300)), "x must be from -1e+08 to 1e+08", id="far"),
        pytest.param(
            road(plan=geometry("<circle/>")), "it has none of line, arc, spiral", id="kind"
        ),
        pytest.param(
            road(plan=geometry(length=-5.0)), "length must be from 0", id="negative-length"
        ),
        pytest.param(
            road(section(lane(-1, cubic("width", 3.0, 0, 0, 1e305, sOffset=0.0)))),
            "lane section 0: its boundaries",
            id="overflow",
        ),
        pytest.param(
            road(section(lane(-1, cubic("width", 3.0, 0, 0, 1e9, sOffset=0.0)))),
            "lane section 0: its boundaries",
            id="huge-width",
        ),
        pytest.param(
            road(
                plan=geometry(
                    '<paramPoly3 aU="1" bU="0" cU="0" dU="0" aV="0" bV="0" cV="0" dV="0"/>'
                )
            ),
            "the curve is a point",
            id="point",
        ),
        pytest.param(road(section(s=500.0)), "no usable <laneSection>", id="section-after-the-end"),
        pytest.param(road(section()), "it has no lanes with a length", id="no-lanes"),
        pytest.param(road(section(lane(0))), "it has no lanes with a length", id="only-lane-0"),
        pytest.param(road(road_id="2"), "another road has the same id", id="same-id"),
        pytest.param(road(road_id=""), "a road needs an id", id="no-id"),
        pytest.param(
            road(offsets=cubic("laneOffset", float("nan"), s=0.0)),
            "a must be a finite number, got 'nan'",
            id="lane-offset",
        ),
    ],
)
def test_a_road_that_cannot_be_used_is_listed(bad: str, reason: str) -> None:
    """The other road is used."""
    found = read_map(OTHER, bad)
    assert list(found.roads) == ["2"]
    assert any(reason in why and "is not used" in why for why in reasons(found)), reasons(found)


@pytest.mark.parametrize(
    ("lanes", "used", "reason"),
    [
        (
            [lane(1), lane(-1, cubic("width", float("inf"), sOffset=0.0)), lane(-2)],
            "1:0:1",
            "lane -1, from which its position follows, cannot be used",
        ),
        ([lane(1), lane(-1, "")], "1:0:1", "its width is 0"),
        ([lane(1), lane(1)], "1:0:1", "the id is that of the lane in line"),
        ([lane(1), lane(-1).replace('id="-1"', 'id="-x"')], "1:0:1", "id must be a finite number"),
        ([lane(1), lane(-1).replace('id="-1"', 'id="-1.5"')], "1:0:1", "id must be an integer"),
        (
            [lane(-1, WIDTH + '<speed sOffset="0" max="50" unit="knots"/>')],
            "1:0:-1",
            "unit must be one of m/s, km/h, mph, got 'knots'",
        ),
        (
            [lane(-1, WIDTH + '<speed sOffset="0" max="fast"/>')],
            "1:0:-1",
            "max must be a finite number",
        ),
        (
            [lane(-1, WIDTH + '<roadMark sOffset="nan" type="solid"/>')],
            "1:0:-1",
            "sOffset must be a finite number",
        ),
    ],
)
def test_a_lane_that_cannot_be_used_is_listed(lanes: list[str], used: str, reason: str) -> None:
    found = read_map(road(section(*lanes)))
    assert " ".join(sorted(found.lanes)) == used
    assert any(reason in why for why in reasons(found)), reasons(found)
    assert all(re.match(r"line \d+, ", skipped.where) for skipped in found.skipped)


def test_many_geometries() -> None:
    """They are used, or their road is listed as too large."""
    count = 20_000
    plan = "".join(geometry(s=i * 0.01, x=i * 0.01, length=0.01) for i in range(count))
    found = read_map(road(plan=plan, length=count * 0.01), OTHER)
    assert "2" in found.roads


@pytest.mark.parametrize(
    "links",
    [
        pytest.param([("1", "end"), ("1", "start")], id="onto-itself"),
        pytest.param([("1", "start"), ("1", "start")], id="starts-at-its-start"),
        pytest.param([("2", "end"), ("2", "start")], id="two-roads"),
        pytest.param([("2", "start"), ("2", "start")], id="both-ends-at-one"),
    ],
)
def test_loops_of_links(links: list[tuple[str, str]]) -> None:
    """Lines, routes and the tracker end, whatever the links say."""
    ends = [
        linked(tag, other, contact)
        for tag, (other, contact) in zip(("predecessor", "successor"), links, strict=True)
    ]
    lanes = section(lane(1, predecessor=1, successor=1), lane(-1, predecessor=-1, successor=-1))
    other = road(lanes, road_id="2", link="".join(ends).replace('"2"', '"1"'))
    found = read_map(road(lanes, link="".join(ends)), other)
    assert len(found.lanes) == 4
    for pose in ([50.0, -1.7, 0.0], [50.0, 1.7, 0.0], [50.0, 1.7, math.pi]):
        assert {"EGO_LEFT", "EGO_RIGHT"} <= {slot.name for slot in found.lines(pose)}
        assert LaneTracker(found).lines(pose).lines
    for goal in found.lanes:
        with contextlib.suppress(RouteError):
            assert found.route("1:0:-1", goal).lanes[-1] == goal


@pytest.mark.parametrize("name", ATTRIBUTES)
def test_attributes_that_are_missing(name: str) -> None:
    for place in re.finditer(rf' {name}="[-\d.e]+"', TEXT):
        found = attempt(TEXT[: place.start()] + TEXT[place.end() :])
        assert found is not None
        assert found.lanes
