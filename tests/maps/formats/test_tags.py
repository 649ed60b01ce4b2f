"""Kinds of markings, types of lanes and speed limits, as each format names them."""

import io
from collections.abc import Callable
from itertools import product

import pytest
from support.lanelet_files import Osm
from support.xodr_files import WIDTH, read_map, road, section
from support.xodr_files import lane as xodr_lane

from maplines_can.maps import Lane, LaneType, Map
from maplines_can.maps.formats.commonroad import read as read_commonroad
from maplines_can.values.line import Kind


def opendrive(mark: str = "", content: str = "", kind: str = "driving") -> Map:
    """A road of which the left lane has a mark on its right, and whatever else is given."""
    own = f'{WIDTH}<roadMark sOffset="0" type="{mark}"/>{content}'
    return read_map(road(section(xodr_lane(-1, own, kind=kind), xodr_lane(-2))))


def lanelet2(mark: str = "", **tags: str) -> Map:
    """A lanelet whose right way has the tags ``type=subtype``."""
    osm, marking = Osm(), dict(zip(("type", "subtype"), mark.split(), strict=False))
    left, right = osm.way((0.0, 3.0), (9.0, 3.0)), osm.way((0.0, 0.0), (9.0, 0.0), **marking)
    osm.lanelet(left, right, {"type": "lanelet"} | tags)
    return osm.map()


def commonroad(mark: str = "", content: str = "", more: str = "") -> Map:
    marking = f"<lineMarking>{mark}</lineMarking>" if mark else ""
    left, right = (
        f"<{tag}><point><x>0</x><y>{y}</y></point><point><x>9</x><y>{y}</y></point>{end}</{tag}>"
        for tag, y, end in (("leftBound", 3, ""), ("rightBound", 0, marking))
    )
    text = f'<commonRoad><lanelet id="1">{left}{right}{content}</lanelet>{more}</commonRoad>'
    return read_commonroad(io.BytesIO(text.encode()), "map.xml")


def lanelet_types(names: str, one_way: str = "", both_ways: str = "") -> str:
    """Types and users of a lanelet of CommonRoad."""
    users = (("userOneWay", one_way), ("userBidirectional", both_ways))
    types = "".join(f"<laneletType>{name}</laneletType>" for name in names.split())
    return "".join(f"<{tag}>{user}</{tag}>" for tag, user in users if user) + types


def first(found: Map) -> Lane:
    return next(iter(found.lanes.values()))


MARKINGS: list[tuple[Callable[[str], Map], Kind, str]] = [
    (opendrive, Kind.SOLID, "solid"),
    (opendrive, Kind.DASHED, "broken, botts dots"),
    (opendrive, Kind.DOUBLE, "solid solid, solid broken, broken solid, broken broken"),
    (opendrive, Kind.KERB, "curb"),
    (opendrive, Kind.ROAD_EDGE, "grass, edge"),
    (opendrive, Kind.VIRTUAL, "none"),
    (opendrive, Kind.UNKNOWN, "custom, "),
    (lanelet2, Kind.SOLID, "line_thin solid"),
    (lanelet2, Kind.DASHED, "line_thick dashed"),
    (lanelet2, Kind.DOUBLE, "line_thin dashed_solid, line_thin solid_solid"),
    (lanelet2, Kind.VIRTUAL, "virtual"),
    (lanelet2, Kind.KERB, "curbstone low"),
    (lanelet2, Kind.ROAD_EDGE, "road_border"),
    (lanelet2, Kind.BARRIER, "guard_rail"),
    (lanelet2, Kind.UNKNOWN, "line_thin, zebra_marking, "),
    (commonroad, Kind.SOLID, "solid, broad_solid"),
    (commonroad, Kind.DASHED, "dashed, broad_dashed"),
    (commonroad, Kind.DOUBLE, "solid_dashed"),
    (commonroad, Kind.KERB, "curb"),
    (commonroad, Kind.VIRTUAL, "no_marking"),
    (commonroad, Kind.UNKNOWN, "unknown, purple, "),
]


@pytest.mark.parametrize(("read", "kind", "marks"), MARKINGS)
def test_kinds_of_markings(read: Callable[[str], Map], kind: Kind, marks: str) -> None:
    """Of the line that is marked, and of no other one."""
    for mark in marks.split(", "):
        found = read(mark)
        assert first(found).right.kind is kind, mark
        assert first(found).centre.kind is Kind.VIRTUAL
        if read is opendrive:
            assert found.lanes["1:0:-2"].left.kind is kind
        else:
            assert first(found).left.kind is Kind.UNKNOWN


D = LaneType
TYPES: list[tuple[Callable[..., Map], dict[str, str], LaneType]] = [
    *((opendrive, {"kind": name}, LaneType(name)) for name in (
        "driving", "entry", "onRamp", "offRamp", "connectingRamp", "bidirectional", "bus", "HOV",
        "stop", "shoulder", "biking", "none",
    )),
    (opendrive, {"kind": "mwyExit"}, D.EXIT),
    (opendrive, {"kind": "walking"}, D.SIDEWALK),
    (opendrive, {"kind": "special1"}, D.OTHER),
    (lanelet2, {"subtype": "highway"}, D.DRIVING),
    (lanelet2, {"subtype": "road", "one_way": "no"}, D.BIDIRECTIONAL),
    (lanelet2, {"subtype": "road", "one_way": "no", "one_way:vehicle": "yes"}, D.DRIVING),
    (lanelet2, {"subtype": "bicycle_lane"}, D.BIKING),
    (lanelet2, {"subtype": "bicycle_lane", "participant:vehicle": "yes"}, D.DRIVING),
    (lanelet2, {"subtype": "road", "participant:vehicle:car": "yes"}, D.DRIVING),
    (lanelet2, {"subtype": "road", "participant:bicycle": "yes"}, D.BIKING),
    (lanelet2, {"subtype": "road", "participant:vehicle": "no"}, D.OTHER),
    (lanelet2, {"subtype": "walkway"}, D.SIDEWALK),
    (lanelet2, {"subtype": "crosswalk"}, D.CROSSWALK),
    (lanelet2, {"subtype": "emergency_lane"}, D.STOP),
    (lanelet2, {"subtype": "road_shoulder"}, D.SHOULDER),
    (lanelet2, {"subtype": "rail"}, D.RAIL),
    (lanelet2, {"subtype": "exit"}, D.OTHER),
    (lanelet2, {}, D.DRIVING),
    (commonroad, {"content": lanelet_types("highway mainCarriageWay")}, D.DRIVING),
    (commonroad, {"content": lanelet_types("highway accessRamp")}, D.ENTRY),
    (commonroad, {"content": lanelet_types("urban busLane", "bus")}, D.BUS),
    (commonroad, {"content": lanelet_types("crosswalk")}, D.CROSSWALK),
    (commonroad, {"content": lanelet_types("shoulder")}, D.SHOULDER),
    (commonroad, {"content": lanelet_types("unknown")}, D.DRIVING),
]  # fmt: skip


@pytest.mark.parametrize(("read", "tags", "expected"), TYPES)
def test_types_of_lanes(read: Callable[..., Map], tags: dict[str, str], expected: LaneType) -> None:
    assert first(read(**tags)).type is expected


def test_drivable_lanes() -> None:
    drivable = {one for one in LaneType if one.is_drivable}
    ramps = {D.ENTRY, D.EXIT, D.ON_RAMP, D.OFF_RAMP, D.CONNECTING_RAMP}
    assert drivable - {D.SLIP_LANE} == {D.DRIVING, D.BIDIRECTIONAL} | ramps


@pytest.mark.parametrize(
    ("kind", "one_way", "both_ways"),
    [
        *product(
            ["urban", "highway exitRamp", "sidewalk"],
            ["", "car", "bicycle", "pedestrian", "bus"],
            ["", "car", "vehicle", "bicycle", "pedestrian", "bus"],
        )
    ],
)
def test_users_of_a_lane_of_commonroad(kind: str, one_way: str, both_ways: str) -> None:
    """A lane of which only cyclists or walkers are users is theirs; cars may use it both ways."""
    found = first(commonroad(content=lanelet_types(kind, one_way, both_ways)))
    alone = {"urban": D.DRIVING, "highway exitRamp": D.EXIT}
    expected, users = alone.get(kind, D.SIDEWALK), {one_way, both_ways} - {""}
    if kind in alone and users and not users - {"bicycle", "pedestrian"}:
        expected = D.BIKING if "bicycle" in users else D.SIDEWALK
    elif kind == "urban" and both_ways in ("car", "vehicle"):
        expected = D.BIDIRECTIONAL
    assert found.type is expected


def sign(key: int, number: str, value: str = "") -> str:
    more = f"<additionalValue>{value}</additionalValue>" if value else ""
    return (
        f'<trafficSign id="{key}"><trafficSignElement><trafficSignID>{number}</trafficSignID>'
        f"{more}</trafficSignElement></trafficSign>"
    )


SIGNS = sign(7, "274", "8.3") + sign(8, "R2-1", "5") + sign(9, "206", "3") + sign(10, "274")
REF = '<trafficSignRef ref="{}"/>'.format


def of_road(speed: str) -> Map:
    """OpenDRIVE: of the road, or of a lane that has its own."""
    before = f'<type s="0" type="town"><speed {speed}/></type>'
    slow = '<type s="0" type="town"><speed max="1"/></type>'
    own = section(xodr_lane(-1, WIDTH + f'<speed sOffset="0" {speed}/>'))
    assert (
        first(read_map(road(before=before))).speed_limit
        == first(read_map(road(own, before=slow))).speed_limit
    )
    return read_map(road(before=before))


LIMITS: list[tuple[Callable[..., Map], dict[str, str], float | None]] = [
    (of_road, {"speed": 'max="50" unit="km/h"'}, 50 / 3.6),
    (of_road, {"speed": 'max="55" unit="mph"'}, 55 * 0.44704),
    (of_road, {"speed": 'max="13.9" unit="m/s"'}, 13.9),
    (of_road, {"speed": 'max="13.9"'}, 13.9),
    (of_road, {"speed": 'max="no limit"'}, None),
    (of_road, {"speed": 'max="undefined"'}, None),
    (lanelet2, {"speed_limit": "50"}, 50 / 3.6),
    (lanelet2, {"speed_limit": "50 km/h"}, 50 / 3.6),
    (lanelet2, {"speed_limit": "50kmh"}, 50 / 3.6),
    (lanelet2, {"speed_limit": "13.5 m/s"}, 13.5),
    (lanelet2, {"speed_limit": "30 mph"}, 13.4112),
    *((lanelet2, {"speed_limit": x}, None) for x in ("walk", "-3", "nan", "0", "1" * 400)),
    (commonroad, {}, None),
    (commonroad, {"content": "<speedLimit>13.9</speedLimit>"}, 13.9),
    *((commonroad, {"content": f"<speedLimit>{x}</speedLimit>"}, None) for x in ("-1", "x", "inf")),
    (commonroad, {"content": REF(7), "more": SIGNS}, 8.3),
    (commonroad, {"content": REF(7) + REF(8), "more": SIGNS}, 5.0),
    (commonroad, {"content": REF(9) + REF(10) + REF(99), "more": SIGNS}, None),
]


@pytest.mark.parametrize(("read", "tags", "limit"), LIMITS)
def test_speed_limits(read: Callable[..., Map], tags: dict[str, str], limit: float | None) -> None:
    """In metres a second; what is none is listed by Lanelet2."""
    found = read(**tags)
    assert first(found).speed_limit == (limit and pytest.approx(limit))
    if read is lanelet2:
        assert any("speed" in one.why for one in found.skipped) == (limit is None)
