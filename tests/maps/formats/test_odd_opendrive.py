"""OpenDRIVE that is valid but odd: what is right there, and what is said of it."""

import math
from typing import Any

import numpy as np
import pytest
from support.xodr_files import (
    WIDTH,
    cubic,
    geometry,
    lane,
    linked,
    read_map,
    reasons,
    road,
    section,
)

from maplines_can import Slot
from maplines_can.maps import LaneType, Map

NAN = '<{tag} {start} a="nan" b="nan" c="nan" d="nan"/>'


def row(*lengths: float) -> Map:
    """Return the map of roads 1, 2, 3 and so on, one after the other, of these lengths."""
    roads, x, last = [], 0.0, len(lengths)
    for i, length in enumerate(lengths, 1):
        before = linked("predecessor", str(i - 1), "end") if i > 1 else ""
        after = linked("successor", str(i + 1)) if i < last else ""
        plan = geometry(x=x, length=length)
        ends = -1 if i > 1 else None, -1 if i < last else None
        content = section(lane(-1, predecessor=ends[0], successor=ends[1]))
        roads.append(road(content, road_id=str(i), plan=plan, length=length, link=before + after))
        x += length
    return read_map(*roads)


@pytest.mark.parametrize(
    "lengths",
    [
        pytest.param((100.0, 5e-7, 100.0), id="half-a-micrometre"),
        pytest.param((100.0, 0.0, 100.0), id="none"),
        pytest.param((100.0, 5e-7, 5e-7, 0.0, 100.0), id="several"),
    ],
)
def test_links_pass_through_roads_without_length(lengths: tuple[float, ...]) -> None:
    """Such a road has no lanes, and the map is as if its neighbours met."""
    found = row(*lengths)
    last = f"{len(lengths)}:0:-1"
    assert list(found.lanes) == ["1:0:-1", last]
    assert found.lanes["1:0:-1"].successors == (last,)
    assert found.roads["1"].successors == (str(len(lengths)),)
    assert found.route("1:0:-1", last).length == pytest.approx(200)
    assert all("has no length; links pass through it" in why for why in reasons(found))
    assert len(found.skipped) == len(lengths) - 2


def test_a_connecting_road_without_length() -> None:
    """Links pass through it in a junction, too."""
    junction = (
        '<junction id="9"><connection id="0" incomingRoad="1" connectingRoad="2" '
        'contactPoint="start"><laneLink from="-1" to="-1"/></connection></junction>'
    )
    found = read_map(
        road(section(lane(-1)), link=linked("successor", "9", "", "junction")),
        road(
            section(lane(-1, predecessor=-1, successor=-1)),
            road_id="2",
            plan=geometry(x=100.0, length=5e-7),
            length=5e-7,
            link=linked("predecessor", "1", "end") + linked("successor", "3"),
            attributes='junction="9"',
        ),
        road(section(lane(-1)), road_id="3", plan=geometry(x=100.0)),
        junction,
    )
    assert found.lanes["1:0:-1"].successors == ("3:0:-1",)


def opening(*lanes: str, **more: Any) -> Map:
    return read_map(road(section(*lanes), plan=geometry(length=400.0), length=400.0, **more))


#: No width up to s = 200 m; 3.5 m from 250 m on.
OPENS = (
    cubic("width", 0.0, sOffset=0.0)
    + cubic("width", 0.0, c=0.0042, d=-5.6e-05, sOffset=200.0)
    + cubic("width", 3.5, sOffset=250.0)
)


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(OPENS, id="width"),
        pytest.param(
            cubic("border", -3.5, sOffset=0.0)
            + cubic("border", -3.5, b=-0.07, sOffset=200.0)
            + cubic("border", -7.0, sOffset=250.0),
            id="border",
        ),
    ],
)
def test_a_lane_without_width_is_none(content: str) -> None:
    """Beside a car there is no lane up to s = 200 m, and one after it."""
    found = opening(lane(-1), lane(-2, content))
    assert list(found.lanes) == ["1:0:-1", "1:0.1:-1", "1:0.1:-2"]
    before, after, opened = found.lanes.values()
    assert (before.right_neighbour, after.right_neighbour) == (None, "1:0.1:-2")
    assert (before.successors, after.predecessors) == (("1:0.1:-1",), ("1:0:-1",))
    assert opened.predecessors == ()
    assert before.left.points[-1].tolist() == [200.0, 0.0] == after.left.points[0].tolist()
    assert Slot.NEXT_RIGHT not in found.lines([30.0, -1.75, 0.0])
    lines = found.lines([225.0, -1.75, 0.0])
    assert np.interp(225.0, *lines[Slot.NEXT_RIGHT].points.T) == pytest.approx(-5.25, abs=1e-3)
    assert reasons(found) == ["it has no width from s = 0 to 200 m, and is no lane there"]


@pytest.mark.parametrize(
    ("content", "kind"),
    [
        pytest.param(cubic("width", 0.0, b=0.1, sOffset=0.0), "driving", id="at-a-point"),
        pytest.param(
            cubic("width", 0.0, sOffset=0.0) + cubic("width", 3.5, sOffset=0.9),
            "driving",
            id="less-than-a-metre",
        ),
        pytest.param(OPENS, "shoulder", id="not-drivable"),
    ],
)
def test_lane_sections_that_are_not_divided(content: str, kind: str) -> None:
    found = opening(lane(-1), lane(-2, content, kind))
    assert list(found.lanes) == ["1:0:-1", "1:0:-2"]
    assert not found.skipped


@pytest.mark.parametrize("at", [pytest.param(50.0, id="same-s"), pytest.param(100.0, id="at-end")])
@pytest.mark.parametrize("tag", ["width", "laneOffset", "superelevation"])
def test_a_record_that_never_applies_may_be_unusable(tag: str, at: float) -> None:
    """Another one begins at the same s, or the road has ended; it is listed."""
    start = "sOffset" if tag == "width" else "s"
    value = 3.5 if tag == "width" else 0.0
    records = (
        cubic(tag, value, **{start: 0.0})
        + NAN.format(tag=tag, start=f'{start}="{at}"')
        + (cubic(tag, value, **{start: at}) if at < 100 else "")
    )
    found = read_map(
        road(
            section(lane(-1, records if tag == "width" else WIDTH)),
            offsets=records if tag == "laneOffset" else "",
            lateral=records if tag == "superelevation" else "",
        )
    )
    assert found.lanes["1:0:-1"].width == pytest.approx(3.5)
    assert reasons(found) == ["a must be a finite number, got 'nan'; it never applies"]


@pytest.mark.parametrize(
    ("tag", "before", "after"),
    [
        pytest.param("laneOffset", -3.5, -1.5, id="offset"),
        pytest.param("superelevation", -3.5, -3.5 * math.cos(0.6), id="roll"),
    ],
)
def test_what_is_not_defined_is_0(tag: str, before: float, after: float) -> None:
    """Before the first record there is neither an offset nor a roll, and it is said."""
    record = cubic(tag, 2.0 if tag == "laneOffset" else 0.6, s=60.0)
    found = read_map(road(offsets=record) if tag == "laneOffset" else road(lateral=record))
    right = found.lanes["1:0:-1"].right
    assert np.interp([10, 59, 61, 90], *right.points.T) == pytest.approx(
        [before, before, after, after]
    )
    assert reasons(found) == ["it is not defined before s = 60 m; 0 is used there"]
    slow = cubic(tag, 0.0, b=0.01, s=60.0)
    assert not read_map(road(offsets=slow) if tag == "laneOffset" else road(lateral=slow)).skipped


def test_level_lanes_are_not_rolled() -> None:
    """Their width is that of the plan, beyond the rolled lanes; 15 mm at 0.1 rad."""
    found = read_map(
        road(
            section(lane(-1), lane(-2, kind="sidewalk", attributes='level="true"')),
            lateral=cubic("superelevation", 0.1, s=0.0),
        )
    )
    rolled, level = (found.lanes[f"1:0:{i}"].right.points[0, 1] for i in (-1, -2))
    assert rolled == pytest.approx(-3.5 * math.cos(0.1), abs=1e-9)
    assert level == pytest.approx(-3.5 * math.cos(0.1) - 3.5, abs=1e-9)


@pytest.mark.parametrize(
    ("lateral", "text"),
    [
        pytest.param(cubic("crossfall", 0.2, s=0.0), "3.5 m is 69.8 mm too large", id="fall"),
        pytest.param(cubic("crossfall", 0.01, s=0.0), None, id="small"),
        pytest.param('<shape s="0" t="-4" a="0" b="0.1" c="0" d="0"/>', "shapes", id="shape"),
        pytest.param('<shape s="0" t="-4" a="0" b="0.0" c="0" d="0"/>', None, id="flat"),
    ],
)
def test_cross_sections_that_are_not_used(lateral: str, text: str | None) -> None:
    """3.5 m (1 - cos 0.2) are 69.8 mm."""
    found = read_map(road(lateral=lateral))
    assert len(found.skipped) == (text is not None)
    assert text is None or text in reasons(found)[0]


def test_a_jump_between_geometries_is_said() -> None:
    found = read_map(
        road(plan=geometry(length=50.0) + geometry(s=50.0, x=50.0, y=2.0, length=50.0))
    )
    (why,) = reasons(found)
    assert why == (
        "1 geometries begin up to 2 m from the end of the one before; the lines jump, first at "
        "s = 50 m"
    )


@pytest.mark.parametrize(
    ("content", "attributes", "type_", "text"),
    [
        pytest.param("", 'direction="both"', LaneType.BIDIRECTIONAL, "only in the", id="both"),
        pytest.param("bidirectional", "", LaneType.BIDIRECTIONAL, "only in the", id="travel-both"),
        pytest.param("backward", "", LaneType.DRIVING, "is driven forward along s", id="against"),
        pytest.param("forward", "", LaneType.DRIVING, None, id="as-its-side"),
        pytest.param("forward", 'direction="reversed"', LaneType.DRIVING, "backward", id="turned"),
        pytest.param("undirected", "", LaneType.DRIVING, None, id="undirected"),
    ],
)
def test_directions_of_a_lane(
    content: str, attributes: str, type_: LaneType, text: str | None
) -> None:
    """The direction is that of the side, or of the attribute; another one is said."""
    data = f'<userData><vectorLane travelDir="{content}"/></userData>' if content else ""
    found = read_map(road(section(lane(-1, WIDTH + data, attributes=attributes))))
    assert found.lanes["1:0:-1"].type is type_
    assert len(found.skipped) == (text is not None)
    assert text is None or text in reasons(found)[0]


def test_a_connection_without_lane_links_is_said() -> None:
    junction = (
        '<junction id="9"><connection id="0" incomingRoad="1" connectingRoad="2" '
        'contactPoint="start"/></junction>'
    )
    one = road(link=linked("successor", "9", "", "junction"))
    (why,) = reasons(read_map(one, road(road_id="2", plan=geometry(x=100.0)), junction))
    assert why == "it has no laneLink, so it links no lanes"


def test_access_is_said() -> None:
    denied = '<access sOffset="0" rule="deny" restriction="truck"/>'
    walk = lane(-2, WIDTH + denied, kind="sidewalk")
    (why,) = reasons(read_map(road(section(lane(-1, WIDTH + denied), walk))))
    assert why.startswith("who has access to it is not read")
