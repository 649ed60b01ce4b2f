#!/usr/bin/env python3
r"""Write the map that the package contains: a small town, and a motorway around it.

python tools/make_town.py            write it
python tools/make_town.py --check    report whether it is up to date

                  exit ramp  .--J--.  entry ramp
    motorway ===============/===|===\===============
                                | access road, with an S-bend
                  corner.-------C-------.corner       C  roundabout
                        |       |       |
                        A-------B-------'corner       A  junction of three roads
                        |       |                     B  junction of four roads
                        '--~~~--'                     S-bends
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path

from reporting import parser_of
from road_alignment import Alignment, Piece, Pose, Vertex, between, through
from xodr_writer import (
    Arm,
    ConnectionSpec,
    HouseRow,
    JunctionSpec,
    LaneSpec,
    Neighbour,
    PoleRow,
    RoadSpec,
    SectionSpec,
    Sign,
    Width,
    blend,
    constant,
    document,
)

PATH = Path(__file__).resolve().parents[1] / "maplines_can" / "maps" / "town.xodr"
PROJECTION = "+proj=tmerc +lat_0=48.7 +lon_0=9.1 +k=1 +x_0=0 +y_0=0 +ellps=WGS84 +units=m +no_defs"

# Widths of lanes [m].
STREET, SIDEWALK, WIDENED = 3.25, 2.0, 4.75
FAST, RAMP, MEDIAN, SHOULDER = 3.75, 3.5, 1.5, 2.5
RING = 5.0

#: Distance of poles and signs from the edge of the road, of poles from each other along a street
#: and along the motorway, and of signs from the ends of a road [m].
VERGE, POLES, MOTORWAY_POLES, SIGN = 0.5, 32.0, 90.0, 6.0

#: Houses: distance from the sidewalk, from each other and from the ends of a street, and their
#: lengths on the left and on the right of it, and their width [m].
YARD, HOUSES, HOUSE_END, LEFT_HOUSE, RIGHT_HOUSE, HOUSE_WIDTH = 2.0, 24.0, 20.0, 15.0, 11.0, 8.0
#: Offset of the poles of the motorway, beyond an additional lane at the right [m].
OUTER = MEDIAN + 3 * FAST + SHOULDER + VERGE

#: Distance from the middle of a junction to its arms [m].
JUNCTION, RAMP_JUNCTION, ROUNDABOUT = 15.0, 20.0, 40.0
#: Radius of the middle of a lane that turns right, and of a street that turns [m].
CORNER = 8.0
RIGHT, LEFT, RIGHT_TO_RAMP = CORNER + STREET / 2, 10.0, 15.0
#: Roundabout: radius of the island, and of entries and exits [m]; half its arms' angle.
ISLAND, ENTRY, HALF_ARM = 18.0, 16.0, math.radians(30)

# Middles of the junctions.
J, C, B, A = (0.0, 541.0), (40.0, 240.0), (40.0, 60.0), (-260.0, 60.0)
TOP = J[1] + 159.0  # y of the motorway at the interchange
EAST = 180.0  # x of the street with two corners
#: x of the ends of the exit and the entry lane.
GORE, NOSE = -280.0, 280.0

#: Ids of roads. The first direction of a road is that of its lane -1.
BEFORE_EXIT, INTERCHANGE, BEHIND_ENTRY, THREE_LANES, EXIT_RAMP, ENTRY_RAMP = 1, 2, 3, 4, 5, 6
ACCESS, STATION_STREET, WEST_STREET, EAST_STREET, MAIN_STREET, VALLEY_ROAD = range(11, 17)
#: Ids of junctions; connecting roads have ids from ten times that on.
EXIT, ENTRY_END, AT_J, AT_A, AT_B = 41, 42, 43, 44, 45
ARMS_OF_C = {
    ACCESS: (50, 90),
    WEST_STREET: (51, 180),
    STATION_STREET: (52, 270),
    EAST_STREET: (53, 0),
}


class Town:
    """Roads and junctions so far."""

    def __init__(self) -> None:
        self.roads: list[RoadSpec] = []
        self.junctions: list[JunctionSpec] = []

    def add(self, *roads: RoadSpec) -> None:
        """Add roads."""
        self.roads += roads

    def connecting(
        self,
        junction: int,
        ends: tuple[Arm, Arm],
        line: Alignment,
        widths: tuple[float, float],
        marks: tuple[str, str] = ("none", "none"),
        limit: int = 50,
    ) -> ConnectionSpec:
        """Add a connecting road of one lane, and return its connection."""
        road_id = 10 * junction + sum(road.junction == junction for road in self.roads)
        one, other = ends
        lane = LaneSpec([blend(*widths, line.length)], mark=marks[1])
        road = RoadSpec(
            road_id,
            f"{one.road.name} to {other.road.name}",
            line,
            [SectionSpec(0.0, {-1: lane}, centre=marks[0])],
            limit,
            junction=junction,
            before=one.link(one.lane_in),
            after=other.link(other.lane_out),
        )
        self.add(road)
        return ConnectionSpec(one.road.id, road_id, "start", {one.lane_in: -1})


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--check", action="store_true", help="write nothing")
    check = parser.parse_args().check
    text = town()
    is_stale = not PATH.exists() or PATH.read_text() != text
    if is_stale and not check:
        PATH.write_text(text)
    print(
        f"{PATH.name}: {'up to date' if not is_stale else 'not up to date' if check else 'written'}"
    )
    return int(check and is_stale)


def town() -> str:
    """Return the text of the file."""
    made = Town()
    add_motorway(made)
    add_streets(made)
    return document("town", PROJECTION, made.roads, made.junctions)


def add_motorway(made: Town) -> None:
    """Add the motorway: a ring of four roads whose reference lines run clockwise."""
    ring = through(
        [
            Vertex(-620, TOP),
            Vertex(1200, TOP, 480, 150),
            Vertex(1200, -600, 450, 150),
            Vertex(350, -600, 1200, 150),
            Vertex(-250, -740, 1200, 150),
            Vertex(-1200, -600, 450, 150),
            Vertex(-1200, TOP, 480, 150),
            Vertex(-620, TOP),
        ]
    )
    third = 3600.0  # where the third lane begins
    cuts = (0.0, GORE + 620, NOSE + 620, third, ring.length)
    lines = [ring.cut(one, other) for one, other in pairwise(cuts)]

    opening = {-4: LaneSpec([blend(0, RAMP, 80), constant(RAMP, 80)], "exit", "solid")}
    closing = {-4: LaneSpec([constant(RAMP), blend(RAMP, 0, 100, 200)], "entry", "solid")}
    length = lines[3].length
    third_lane = {-4: LaneSpec([blend(0, FAST, 120), constant(FAST, 120)], mark="solid")}
    ending = {-4: LaneSpec([constant(FAST), blend(FAST, 0, 180, 120)], mark="solid")}
    plain, wide = cross_section(), {**SAME, -4: -5}
    sections = [
        [SectionSpec(0.0, plain, wide), SectionSpec(40.0, cross_section(opening))],
        [SectionSpec(0.0, plain)],
        [SectionSpec(0.0, cross_section(closing), {**SAME, -5: -4}), SectionSpec(300.0, plain)],
        [
            SectionSpec(0.0, plain, wide),
            SectionSpec(60.0, cross_section(third_lane), {**SAME, -4: -4, -5: -5}),
            SectionSpec(length - 900, cross_section(ending), {**SAME, -5: -4}),
            SectionSpec(length - 600, plain),
        ],
    ]
    whole = {**SAME, -4: -4}
    links = [
        (Neighbour(THREE_LANES, "end", whole), Neighbour(EXIT)),
        (Neighbour(EXIT), Neighbour(ENTRY_END)),
        (Neighbour(ENTRY_END), Neighbour(THREE_LANES, "start", whole)),
        (Neighbour(BEHIND_ENTRY, "end", whole), Neighbour(BEFORE_EXIT, "start", whole)),
    ]
    for i, line in enumerate(lines):
        road = RoadSpec(
            i + 1, "Motorway", line, sections[i], 120, "motorway", before=links[i][0],
            after=links[i][1], poles=[PoleRow(30.0, MOTORWAY_POLES, t) for t in (-OUTER, OUTER)],
        )  # fmt: skip
        made.add(road)

    edge, low = TOP - 2 * FAST - MEDIAN, J[1]
    down = [(GORE, edge), (GORE + 80, edge), (GORE + 170, low), (-RAMP_JUNCTION, low)]
    up = [(RAMP_JUNCTION, low), (NOSE - 170, low), (NOSE - 80, edge), (NOSE, edge)]
    made.add(
        ramp(EXIT_RAMP, "Exit ramp", "offRamp", down, (Neighbour(EXIT), Neighbour(AT_J))),
        ramp(ENTRY_RAMP, "Entry ramp", "onRamp", up, (Neighbour(AT_J), Neighbour(ENTRY_END))),
    )

    against = {i: i for i in (1, 2, 3, 4)}
    along = {i: i for i in (-1, -2, -3)}
    made.junctions += [
        JunctionSpec(EXIT, "Exit", [
            ConnectionSpec(BEFORE_EXIT, INTERCHANGE, "start", along),
            ConnectionSpec(BEFORE_EXIT, EXIT_RAMP, "start", {-4: -1}),
            ConnectionSpec(INTERCHANGE, BEFORE_EXIT, "end", against),
        ], is_direct=True),
        JunctionSpec(ENTRY_END, "Entry", [
            ConnectionSpec(INTERCHANGE, BEHIND_ENTRY, "start", along),
            ConnectionSpec(ENTRY_RAMP, BEHIND_ENTRY, "start", {-1: -4}),
            ConnectionSpec(BEHIND_ENTRY, INTERCHANGE, "end", against),
        ], is_direct=True),
    ]  # fmt: skip


#: Lanes of the motorway that continue from section to section, without the shoulder at the right.
SAME = {i: i for i in (4, 3, 2, 1, -1, -2, -3)}


def cross_section(extra: dict[int, LaneSpec] | None = None) -> dict[int, LaneSpec]:
    """Return the lanes of the motorway; an extra lane is left of the shoulder at the right."""
    shoulder = LaneSpec([constant(SHOULDER)], "stop")
    lanes = {4: shoulder}
    for side in (1, -1):
        lanes |= {
            side: LaneSpec([constant(MEDIAN)], "median", "solid"),
            2 * side: LaneSpec([constant(FAST)], mark="broken"),
            3 * side: LaneSpec([constant(FAST)], mark="solid"),
        }
    if not extra:
        return lanes | {-4: shoulder}
    return lanes | {-3: LaneSpec([constant(FAST)], mark="broken")} | extra | {-5: shoulder}


def ramp(
    road_id: int,
    name: str,
    kind: str,
    corners: Sequence[tuple[float, float]],
    ends: tuple[Neighbour, Neighbour],
) -> RoadSpec:
    """Return a ramp of one lane."""
    lanes = {
        -1: LaneSpec([constant(RAMP)], kind, "solid"),
        -2: LaneSpec([constant(SHOULDER / 2)], "shoulder"),
    }
    line = through([Vertex(*corner, 80, 40) for corner in corners])
    section = SectionSpec(0.0, lanes, centre="solid")
    return RoadSpec(road_id, name, line, [section], 60, "rural", -1, *ends)


def add_streets(made: Town) -> None:
    """Add the streets of the town, and the junctions that they lead to."""
    access = street(
        ACCESS, "Access Road", AT_J, 50, 70,
        [(0, J[1] - RAMP_JUNCTION), (0, 440, 60, 20), (C[0], 380, 60, 20),
         (C[0], C[1] + ROUNDABOUT)],
    )  # fmt: skip
    station = street(
        STATION_STREET, "Station Street", 52, AT_B, 30,
        [(C[0], C[1] - ROUNDABOUT), (B[0], B[1] + JUNCTION)],
    )  # fmt: skip
    west = street(
        WEST_STREET, "West Street", 51, AT_A, 50,
        [(C[0] - ROUNDABOUT, C[1]), (A[0], C[1], CORNER), (A[0], A[1] + JUNCTION)],
    )  # fmt: skip
    east = street(
        EAST_STREET, "East Street", 53, AT_B, 50,
        [(C[0] + ROUNDABOUT, C[1]), (EAST, C[1], CORNER), (EAST, B[1], CORNER),
         (B[0] + JUNCTION, B[1])],
    )  # fmt: skip
    wide = [constant(STREET), blend(STREET, WIDENED, 40, 60), constant(WIDENED, 100)]
    wide += [blend(WIDENED, STREET, 30, 180), constant(STREET, 210)]
    main_street = street(
        MAIN_STREET, "Main Street", AT_A, AT_B, 50,
        [(A[0] + JUNCTION, A[1]), (B[0] - JUNCTION, B[1])], wide,
    )  # fmt: skip
    valley = street(
        VALLEY_ROAD, "Valley Road", AT_B, AT_A, 70,
        [(B[0], B[1] - JUNCTION), (40, -40, 60, 25), (110, -110, 60, 25), (40, -230, 150, 40),
         (-110, -330, 100, 40), (-260, -230, 80, 30), (A[0], A[1] - JUNCTION)],
    )  # fmt: skip
    made.add(access, station, west, east, main_street, valley)

    crossing(made, AT_A, "A", [Arm(main_street, "start"), Arm(west, "end"), Arm(valley, "end")])
    crossing(
        made, AT_B, "B",
        [Arm(east, "end"), Arm(station, "end"), Arm(main_street, "end"), Arm(valley, "start")],
    )  # fmt: skip
    off, on = (next(r for r in made.roads if r.id == i) for i in (EXIT_RAMP, ENTRY_RAMP))
    arms = [Arm(on, "start"), Arm(off, "end"), Arm(access, "start")]
    crossing(made, AT_J, "J", arms, RIGHT_TO_RAMP)
    roundabout(made, {road.id: Arm(road, c) for road, c in (
        (access, "end"), (west, "start"), (station, "start"), (east, "start"))})  # fmt: skip


def street(
    road_id: int,
    name: str,
    junctions_before: int,
    junction_after: int,
    limit: int,
    vertices: Sequence[tuple[float, ...]],
    right: Sequence[Width] = (constant(STREET),),
) -> RoadSpec:
    """Return a street with a lane for each direction and sidewalks, or shoulders."""
    verge, mark = ("sidewalk", "curb") if limit <= 50 else ("shoulder", "solid")
    lanes = {
        2: LaneSpec([constant(SIDEWALK)], verge),
        1: LaneSpec([constant(STREET)], mark=mark),
        -1: LaneSpec(right, mark=mark),
        -2: LaneSpec([constant(SIDEWALK)], verge),
    }
    line = through([Vertex(*vertex) for vertex in vertices])
    section = SectionSpec(0.0, lanes, centre="broken")
    ends = Neighbour(junctions_before), Neighbour(junction_after)
    left = STREET + SIDEWALK + VERGE
    right_side = -max(width[1] for width in right) - SIDEWALK - VERGE
    # The lamps on one side stand between those on the other.
    poles = PoleRow(10.0, POLES, left), PoleRow(10.0 + POLES / 2, POLES, right_side)
    signs = Sign(SIGN, right_side), Sign(line.length - SIGN, left)
    rows = houses(line, left, right_side) if verge == "sidewalk" else []
    return RoadSpec(road_id, name, line, [section], limit, "town", -1, *ends, poles, signs, rows)


def houses(line: Alignment, left: float, right: float) -> list[HouseRow]:
    """Return the rows of houses beside the straight pieces of a street.

    Args:
        line: of the street.
        left: offset of the poles on its left [m].
        right: that on its right, negative.
    """
    rows = []
    s = 0.0
    for piece in line.pieces:
        begin, end = s + HOUSE_END, s + piece.length - HOUSE_END
        s += piece.length
        if piece.first == piece.last == 0 and begin < end:
            across = YARD + HOUSE_WIDTH / 2
            # Those on one side stand between those on the other.
            rows.append(HouseRow(begin, end, HOUSES, left + across, LEFT_HOUSE, HOUSE_WIDTH))
            if begin + HOUSES / 2 < end:
                first = begin + HOUSES / 2
                row = HouseRow(first, end, HOUSES, right - across, RIGHT_HOUSE, HOUSE_WIDTH)
                rows.append(row)
    return rows


def crossing(
    made: Town, junction: int, name: str, arms: Sequence[Arm], right: float = RIGHT
) -> None:
    """Add a junction with a connecting road from each arm to each other one."""
    connections = []
    for one in arms:
        for other in arms:
            if one is other or not (one.has(one.lane_in) and other.has(other.lane_out)):
                continue
            goal = other.pose.reversed
            turn = math.remainder(goal.heading - one.pose.heading, 2 * math.pi)
            line = between(one.pose, goal, LEFT if turn > 0 else right)
            widths = one.width, other.width
            marks = ("none", "curb" if turn < -1 else "none")
            connections.append(made.connecting(junction, (one, other), line, widths, marks))
    made.junctions.append(JunctionSpec(junction, name, connections))


def roundabout(made: Town, arms: dict[int, Arm]) -> None:
    """Add the roundabout: a ring of roads counter-clockwise, and a junction for each arm."""
    order = sorted(ARMS_OF_C.items(), key=lambda item: item[1][1])
    ring = {}
    for i, (road_id, (junction, degrees)) in enumerate(order):
        next_junction = order[(i + 1) % len(order)][1][0]
        line = arc(math.radians(degrees) + HALF_ARM, math.radians(degrees + 90) - HALF_ARM)
        lane = LaneSpec([constant(RING)], mark="curb")
        ring[road_id] = RoadSpec(
            30 + i, "Roundabout", line, [SectionSpec(0.0, {-1: lane}, centre="curb")], 30,
            before=Neighbour(junction), after=Neighbour(next_junction),
        )  # fmt: skip
    made.add(*ring.values())
    for i, (road_id, (junction, degrees)) in enumerate(order):
        angle = math.radians(degrees)
        arm = arms[road_id]
        before, after = Arm(ring[order[i - 1][0]], "end"), Arm(ring[road_id], "start")
        round_it = arc(angle - HALF_ARM, angle + HALF_ARM)
        entry = between(arm.pose, round_it.end, ENTRY)
        leave = between(round_it.start, arm.pose.reversed, ENTRY)
        connections = [
            made.connecting(
                junction, (before, after), round_it, (RING, RING), ("curb", "none"), 30
            ),
            made.connecting(junction, (arm, after), entry, (STREET, RING), ("none", "curb"), 30),
            made.connecting(junction, (before, arm), leave, (RING, STREET), ("none", "curb"), 30),
        ]
        name = f"Roundabout, {arm.road.name}"
        made.junctions.append(JunctionSpec(junction, name, connections))


def arc(begin: float, end: float) -> Alignment:
    """Return the edge of the island from angle to angle [rad]."""
    x, y = C[0] + ISLAND * math.cos(begin), C[1] + ISLAND * math.sin(begin)
    piece = Piece(ISLAND * (end - begin), 1 / ISLAND, 1 / ISLAND)
    return Alignment(Pose(x, y, begin + math.pi / 2), (piece,))


if __name__ == "__main__":
    sys.exit(main())
