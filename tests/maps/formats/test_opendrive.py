"""Lanes and roads that the reader of OpenDRIVE returns."""

from itertools import pairwise

import numpy as np
import pytest
from support.xodr_files import WIDTH, geometry, lane, read_map, reasons, road, section

from maplines_can import Kind, Polyline
from maplines_can.maps import Lane

#: A road with all that a reader tends to mix up: two lanes each way, and shoulders.
WIDE = section(
    lane(3, kind="shoulder"), lane(2), lane(1), lane(-1), lane(-2), lane(-3, kind="shoulder")
)


def lane_of(*elements: str, lane_id: str = "1:0:-1") -> Lane:
    return read_map(*elements).lanes[lane_id]


def left_to_right(found: Lane) -> list[list[float]]:
    """Return the first point of the left and of the right boundary."""
    return [line.points[0].tolist() for line in (found.left, found.centre, found.right)]


@pytest.mark.parametrize(
    ("rule", "lane_id", "expected"),
    [
        ("RHT", -1, [[0, 0], [0, -1.75], [0, -3.5]]),
        ("RHT", 1, [[100, 0], [100, 1.75], [100, 3.5]]),
        ("LHT", 1, [[0, 3.5], [0, 1.75], [0, 0]]),
        ("LHT", -1, [[100, -3.5], [100, -1.75], [100, 0]]),
    ],
)
def test_lines_run_in_the_driving_direction(
    rule: str, lane_id: int, expected: list[list[float]]
) -> None:
    """Left and right are as seen by the driver."""
    found = read_map(road(attributes=f'rule="{rule}"'))
    assert left_to_right(found.lanes[f"1:0:{lane_id}"]) == expected
    assert found.left_hand_traffic == (rule == "LHT")


def test_a_lane_can_be_reversed() -> None:
    """By its attribute direction (OpenDRIVE 1.8)."""
    found = lane_of(road(section(lane(-1, attributes='direction="reversed"'))))
    assert left_to_right(found) == [[100, -3.5], [100, -1.75], [100, 0]]


def test_lanes_that_share_a_boundary_share_its_polyline() -> None:
    found = read_map(road(WIDE)).lanes
    assert found["1:0:-1"].right is found["1:0:-2"].left
    assert found["1:0:1"].left is not found["1:0:-1"].left  # the other way round


@pytest.mark.parametrize(
    ("lane_id", "left", "right", "opposite"),
    [
        (-1, None, "1:0:-2", "1:0:1"),
        (-2, "1:0:-1", None, None),
        (-3, "1:0:-2", None, None),
        (1, None, "1:0:2", "1:0:-1"),
        (2, "1:0:1", None, None),
    ],
)
def test_neighbours(
    lane_id: int, left: str | None, right: str | None, opposite: str | None
) -> None:
    """A shoulder is no neighbour; the lane beside it is one of the shoulder."""
    found = lane_of(road(WIDE), lane_id=f"1:0:{lane_id}")
    assert (found.left_neighbour, found.right_neighbour) == (left, right)
    assert found.opposite_left == opposite


def test_an_outermost_boundary_without_marking_is_a_road_edge() -> None:
    found = read_map(road()).lanes
    assert found["1:0:-1"].right.kind == found["1:0:1"].right.kind == Kind.ROAD_EDGE
    kerb = WIDTH + '<roadMark sOffset="0" type="curb"/>'
    assert lane_of(road(section(lane(-1, kerb)))).right.kind == Kind.KERB


def test_the_edges_of_a_one_way_road() -> None:
    """The boundary between its lanes is none."""
    found = read_map(road(section(lane(-1), lane(-2)))).lanes
    assert found["1:0:-1"].left.kind == found["1:0:-2"].right.kind == Kind.ROAD_EDGE
    assert found["1:0:-1"].right.kind == found["1:0:-2"].left.kind == Kind.UNKNOWN


def test_roads_in_a_junction_have_no_edges() -> None:
    """They overlap."""
    found = lane_of(road(section(lane(-1)), attributes='junction="9"'))
    assert found.left.kind == found.right.kind == Kind.UNKNOWN


@pytest.mark.parametrize(
    ("header", "projection"),
    [
        ("<geoReference><![CDATA[ +proj=utm +zone=32 ]]></geoReference>", "+proj=utm +zone=32"),
        ("<geoReference>+proj=utm\n+zone=32</geoReference>", "+proj=utm\n+zone=32"),
        ("<geoReference/>", None),
        ("", None),
    ],
)
def test_the_projection_is_kept(header: str, projection: str | None) -> None:
    assert read_map(road(), header=header).projection == projection


def test_the_length_of_the_geometry_counts() -> None:
    found = read_map(road(length=120.0))
    assert reasons(found) == ["length is '120.0'; that of the geometry is used, 100.000 m"]
    assert repr(found) == "<Map 'map.xodr': 1 road, 2 lanes>"
    assert found.lanes["1:0:-1"].length == pytest.approx(100)


def marks(*pairs: tuple[float, str]) -> str:
    return "".join(f'<roadMark sOffset="{s}" type="{kind}"/>' for s, kind in pairs)


#: A bend to the left of radius 100 m, so that each boundary has another length.
BEND = geometry('<arc curvature="0.01"/>')


@pytest.mark.parametrize("lane_id", [1, -1])
def test_markings_hold_from_s_to_s(lane_id: int) -> None:
    """Along the boundary as driven, against s on the left; the s of a section counts from 0."""
    first = section(lane(1), lane(-1), centre=marks((0, "solid")))
    own = WIDTH + marks((5, "broken"), (20, "solid"), (50, "solid"))
    centre = marks((0, "solid"), (30, "solid solid"))
    second = section(lane(1, own), lane(-1, own), s=40.0, centre=centre)
    found = lane_of(road(first, second, plan=BEND), lane_id=f"1:1:{lane_id}")

    def along(line: Polyline, t: float, *changes: tuple[float, Kind]) -> list[tuple[float, Kind]]:
        """Return the kinds as driven of those by s from the start of the section."""
        scale, length = 1 - t / 100, 60.0
        spans = [(s, end, kind) for (s, kind), (end, _) in pairwise([*changes, (length, kind_0)])]
        if lane_id < 0:
            return [(s * scale, kind) for s, _, kind in spans]
        return [((length - end) * scale, kind) for _, end, kind in reversed(spans)]

    kind_0, t = Kind.UNKNOWN, 3.5 * lane_id
    for line, at, changes in (
        (found.left, 0.0, [(0.0, Kind.SOLID), (30.0, Kind.DOUBLE)]),
        (found.right, t, [(0.0, Kind.ROAD_EDGE), (5.0, Kind.DASHED), (20.0, Kind.SOLID)]),
    ):
        expected = along(line, at, *changes)
        assert [kind for _, kind in line.kinds] == [kind for _, kind in expected]
        assert [s for s, _ in line.kinds] == pytest.approx([s for s, _ in expected], abs=2e-3)
        for s in np.linspace(0.5, line.length - 0.5, 60):
            kind = next(kind for start, kind in reversed(expected) if start <= s + 2e-3)
            assert line.kind_at(s) is kind


def test_a_marking_that_does_not_change_is_one() -> None:
    """Neither one of another colour, nor one that begins where the section ends, nor lines."""
    same = marks((0, "broken"), (30, "broken"), (100, "solid"), (120, "curb"))
    found = lane_of(road(section(lane(-1, WIDTH + same))))
    assert found.right.kinds == found.centre.kinds == found.speed_limits == ()
    assert found.right.kind is Kind.DASHED


@pytest.mark.parametrize(
    ("of_road", "of_lane", "expected"),
    [
        pytest.param("0:50 60:30", "", [(0, 50), (60, 30)], id="road"),
        pytest.param("0:50 60", "", [(0, 50), (60, None)], id="road-type-without-a-limit"),
        pytest.param("0:50 60:x", "", [(0, 50), (60, None)], id="road-type-with-a-bad-one"),
        pytest.param("", "0:50 60:30", [(0, 50), (60, 30)], id="lane"),
        pytest.param("0:50", "60:30", [(0, 50), (60, 30)], id="lane-later"),
        pytest.param("0:50 20:70 80:60", "60:30", [(0, 50), (20, 70), (60, 30)], id="both"),
        pytest.param("", "60:30", [(0, None), (60, 30)], id="none-before"),
        pytest.param("", "0:50 60:no limit", [(0, 50), (60, None)], id="no-limit"),
        pytest.param("", "0:50 60:undefined", [(0, 50), (60, None)], id="undefined"),
    ],
)
def test_speed_limits_hold_from_s_to_s(
    of_road: str, of_lane: str, expected: list[tuple[float, float | None]]
) -> None:
    """In both directions; before the first limit of a lane, that of its road applies."""

    def elements(text: str, element: str) -> str:
        pairs = [pair.partition(":") for pair in text.replace(" limit", "_").split()]
        return "".join(
            element.format(
                s,
                f'<speed sOffset="{s}" max="{v.replace("_", " limit")}" unit="km/h"/>' if v else "",
            )
            for s, _, v in pairs
        )

    own = WIDTH + elements(of_lane, "{1}")
    before = elements(of_road, '<type s="{0}" type="town">{1}</type>')
    lanes = read_map(road(section(lane(1, own), lane(-1, own)), before=before)).lanes
    stops = [s for s, _ in expected[1:]]
    starts = [0, *(100 - s for s in reversed(stops))]
    backward = zip(starts, [v for _, v in reversed(expected)], strict=True)
    for found, pairs in (("1:0:-1", expected), ("1:0:1", list(backward))):
        given = lanes[found].speed_limits
        assert [s for s, _ in given] == pytest.approx([s for s, _ in pairs])
        limits = [None if v is None else pytest.approx(v / 3.6) for _, v in pairs]
        assert [v for _, v in given] == limits
        assert lanes[found].speed_limit == lanes["1:0:-1"].speed_limit


def test_a_marking_from_a_rounding_error_on_is_that_from_the_start() -> None:
    """A part of less than 0.1 mm is none; in a longer one before it, nothing is said."""
    near, later = (WIDTH + marks((s, "solid")) for s in (9e-5, 2e-4))
    lanes = read_map(road(section(lane(-1, near), lane(-2, later), lane(-3)))).lanes
    assert (lanes["1:0:-1"].right.kind, lanes["1:0:-1"].right.kinds) == (Kind.SOLID, ())
    assert [kind for _, kind in lanes["1:0:-2"].right.kinds] == [Kind.UNKNOWN, Kind.SOLID]


def test_a_namespace_changes_nothing() -> None:
    text = road().replace("<road ", '<road xmlns="http://asam.net" xmlns:o="http://o" ')
    prefixed = text.replace("<planView>", "<o:planView>").replace("</planView>", "</o:planView>")
    assert len(read_map(prefixed).lanes) == 2
