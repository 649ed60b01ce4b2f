"""Roads and junctions as values, and as the text of an OpenDRIVE 1.7 file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

from road_alignment import Alignment, Piece, Pose

#: Cubic from a start along the lane section: (start, a, b, c, d).
Width = tuple[float, float, float, float, float]


def blend(one: float, other: float, length: float, start: float = 0.0) -> Width:
    """Return the smooth transition from one width to another [m]."""
    change = other - one
    return start, one, 0.0, 3 * change / length**2, -2 * change / length**3


def constant(width: float, start: float = 0.0) -> Width:
    """Return a constant width [m]."""
    return start, width, 0.0, 0.0, 0.0


@dataclass(frozen=True)
class LaneSpec:
    """A lane: its widths, its type, and the marking of its outer boundary."""

    widths: Sequence[Width]
    kind: str = "driving"
    mark: str = "none"


@dataclass(frozen=True)
class SectionSpec:
    """A lane section.

    Args:
        s: start [m].
        lanes: by id, without lane 0.
        following: for the id of a lane, the one that continues it in the next section.
        centre: marking of lane 0.
    """

    s: float
    lanes: Mapping[int, LaneSpec]
    following: Mapping[int, int] = field(default_factory=dict)
    centre: str = "none"


class PoleRow(NamedTuple):
    """Poles at even distances along a road."""

    start: float  #: s of the first one [m]
    distance: float  #: between two of them [m]
    t: float  #: offset from the reference line, positive to the left [m]


class HouseRow(NamedTuple):
    """Houses at even distances along a road."""

    start: float  #: s of the middle of the first one [m]
    end: float  #: s that no middle exceeds [m]
    distance: float  #: between the middles of two of them [m]
    t: float  #: offset of their middles from the reference line, positive to the left [m]
    length: float  #: along the road [m]
    width: float  #: across the road [m]


class Sign(NamedTuple):
    """Traffic sign beside a road."""

    s: float  #: [m]
    t: float  #: offset from the reference line, positive to the left [m]


class Neighbour(NamedTuple):
    """Road or junction at an end of a road, and the lane that continues each lane there."""

    id: int
    contact: str = ""  #: "start" or "end"; of a road only
    lanes: Mapping[int, int] = {}


@dataclass(frozen=True)
class RoadSpec:
    """A road; the speed limit is in km/h."""

    id: int
    name: str
    line: Alignment
    sections: Sequence[SectionSpec]
    limit: int
    kind: str = "town"
    junction: int = -1
    before: Neighbour | None = None
    after: Neighbour | None = None
    poles: Sequence[PoleRow] = ()
    signs: Sequence[Sign] = ()
    houses: Sequence[HouseRow] = ()


class Arm(NamedTuple):
    """End of a road at a junction."""

    road: RoadSpec
    contact: str

    @property
    def pose(self) -> Pose:
        """Pose that looks into the junction."""
        line = self.road.line
        return line.end if self.contact == "end" else line.start.reversed

    @property
    def lane_in(self) -> int:
        """Lane that leads into the junction."""
        return -1 if self.contact == "end" else 1

    @property
    def lane_out(self) -> int:
        """Lane that leads out of it."""
        return -self.lane_in

    @property
    def width(self) -> float:
        """Width of its lane [m], the same at both ends of the road."""
        return self.road.sections[0].lanes[-1].widths[0][1]

    def has(self, lane: int) -> bool:
        """Return whether the road has a lane."""
        return lane in self.road.sections[0].lanes

    def link(self, lane: int, own: int = -1) -> Neighbour:
        """Return the link of a connecting road to it."""
        return Neighbour(self.road.id, self.contact, {own: lane})


class ConnectionSpec(NamedTuple):
    """A connection of a junction: from a road, to the contact point of another one, by lanes."""

    incoming: int
    outgoing: int
    contact: str
    lanes: Mapping[int, int]


@dataclass(frozen=True)
class JunctionSpec:
    """A junction; a direct one has no connecting roads."""

    id: int
    name: str
    connections: Sequence[ConnectionSpec]
    is_direct: bool = False


def document(
    name: str, projection: str, roads: Iterable[RoadSpec], junctions: Iterable[JunctionSpec]
) -> str:
    """Return the file. Numbers are rounded, so that it is the same on every machine."""
    lines = [
        '<?xml version="1.0" encoding="UTF-8"?>',
        "<OpenDRIVE>",
        f'<header revMajor="1" revMinor="7" name="{name}">',
        f"<geoReference><![CDATA[{projection}]]></geoReference>",
        "</header>",
    ]
    for road in roads:
        lines += _road(road)
    for junction in junctions:
        lines += _junction(junction)
    return "\n".join([*lines, "</OpenDRIVE>", ""])


def _road(road: RoadSpec) -> list[str]:
    lines = [
        f'<road name="{road.name}" length="{_text(road.line.length)}" id="{road.id}" '
        f'junction="{road.junction}" rule="RHT">',
        "<link>",
        *_neighbour("predecessor", road.before),
        *_neighbour("successor", road.after),
        "</link>",
        f'<type s="0" type="{road.kind}"><speed max="{road.limit}" unit="km/h"/></type>',
        "<planView>",
    ]
    s = 0.0
    for piece, pose in road.line.placed():
        lines.append(_geometry(s, piece, pose))
        s += piece.length
    lines += ["</planView>", "<lanes>"]
    ends = [road.before.lanes if road.before else {}, road.after.lanes if road.after else {}]
    for i, section in enumerate(road.sections):
        before = {b: a for a, b in road.sections[i - 1].following.items()} if i else ends[0]
        after = section.following if i + 1 < len(road.sections) else ends[1]
        lines += _section(section, before, after)
    return [*lines, "</lanes>", *_objects(road), *_signs(road), "</road>"]


def _objects(road: RoadSpec) -> list[str]:
    if not road.poles and not road.houses:
        return []
    lines = ["<objects>"]
    for i, house in enumerate(road.houses, len(road.poles)):
        lines.append(
            f'<object type="building" id="{i}" s="{_text(house.start)}" t="{_text(house.t)}" '
            f'zOffset="0" hdg="0" length="{_text(house.length)}" width="{_text(house.width)}" '
            f'height="9"><repeat s="{_text(house.start)}" '
            f'length="{_text(house.end - house.start)}" distance="{_text(house.distance)}" '
            f'tStart="{_text(house.t)}" tEnd="{_text(house.t)}" zOffsetStart="0" zOffsetEnd="0"/>'
            "</object>"
        )
    for i, (start, distance, t) in enumerate(road.poles):
        length = road.line.length - 2 * start
        lines.append(
            f'<object type="pole" id="{i}" s="{_text(start)}" t="{_text(t)}" zOffset="0" '
            f'radius="0.08" height="6">'
            f'<repeat s="{_text(start)}" length="{_text(length)}" distance="{_text(distance)}" '
            f'tStart="{_text(t)}" tEnd="{_text(t)}" zOffsetStart="0" zOffsetEnd="0"/></object>'
        )
    return [*lines, "</objects>"]


def _signs(road: RoadSpec) -> list[str]:
    if not road.signs:
        return []
    lines = ["<signals>"]
    for i, (s, t) in enumerate(road.signs):
        direction = "+" if t < 0 else "-"
        lines.append(
            f'<signal s="{_text(s)}" t="{_text(t)}" id="{i}" dynamic="no" '
            f'orientation="{direction}" zOffset="2" type="274" subtype="{road.limit}"/>'
        )
    return [*lines, "</signals>"]


def _neighbour(tag: str, other: Neighbour | None) -> list[str]:
    if other is None:
        return []
    if not other.contact:
        return [f'<{tag} elementType="junction" elementId="{other.id}"/>']
    contact = f'contactPoint="{other.contact}"'
    return [f'<{tag} elementType="road" elementId="{other.id}" {contact}/>']


def _geometry(s: float, piece: Piece, pose: Pose) -> str:
    first, last = (_text(k, 12) for k in (piece.first, piece.last))
    shape = f'<spiral curvStart="{first}" curvEnd="{last}"/>'
    if first == last:
        shape = "<line/>" if first == "0" else f'<arc curvature="{first}"/>'
    place = f'x="{_text(pose.x)}" y="{_text(pose.y)}" hdg="{_text(pose.heading, 12)}"'
    return f'<geometry s="{_text(s)}" {place} length="{_text(piece.length)}">{shape}</geometry>'


def _section(
    section: SectionSpec, before: Mapping[int, int], after: Mapping[int, int]
) -> list[str]:
    lines = [f'<laneSection s="{_text(section.s)}">']
    sides = {
        "left": sorted((i for i in section.lanes if i > 0), reverse=True),
        "center": [0],
        "right": sorted((i for i in section.lanes if i < 0), reverse=True),
    }
    for side, lane_ids in sides.items():
        if lane_ids:
            lines.append(f"<{side}>")
            for i in lane_ids:
                lane = section.lanes.get(i, LaneSpec((), "none", section.centre))
                lines += _lane(i, lane, before.get(i), after.get(i))
            lines.append(f"</{side}>")
    return [*lines, "</laneSection>"]


def _lane(lane_id: int, lane: LaneSpec, before: int | None, after: int | None) -> list[str]:
    links = (("predecessor", before), ("successor", after))
    link = "".join(f'<{tag} id="{other}"/>' for tag, other in links if other is not None)
    return [
        f'<lane id="{lane_id}" type="{lane.kind}" level="false">',
        *([f"<link>{link}</link>"] if link else []),
        *(
            f'<width sOffset="{_text(s)}" a="{_text(a)}" b="{_text(b)}" c="{_text(c, 12)}" '
            f'd="{_text(d, 12)}"/>'
            for s, a, b, c, d in lane.widths
        ),
        f'<roadMark sOffset="0" type="{lane.mark}" weight="standard" color="white"/>',
        "</lane>",
    ]


def _junction(junction: JunctionSpec) -> list[str]:
    kind = "direct" if junction.is_direct else "default"
    role = "linkedRoad" if junction.is_direct else "connectingRoad"
    lines = [f'<junction id="{junction.id}" name="{junction.name}" type="{kind}">']
    for i, connection in enumerate(junction.connections):
        lines.append(
            f'<connection id="{i}" incomingRoad="{connection.incoming}" '
            f'{role}="{connection.outgoing}" contactPoint="{connection.contact}">'
        )
        lines += [f'<laneLink from="{a}" to="{b}"/>' for a, b in connection.lanes.items()]
        lines.append("</connection>")
    return [*lines, "</junction>"]


def _text(value: float, digits: int = 6) -> str:
    """Return a rounded number without trailing zeros.

    >>> _text(1.5), _text(-1e-9), _text(100.0)
    ('1.5', '0', '100')
    """
    text = f"{value:.{digits}f}".rstrip("0").rstrip(".")
    return "0" if text == "-0" else text
