"""Links between lanes: within a road, from road to road, and through junctions.

A link joins an end of a lane with an end of another one. Which of the two succeeds the other
follows from their driving directions.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from ...road_map import Skipped
from ..xml_tree import Element
from .road import RoadLink, contact_of
from .xml_attributes import UnusableError, attempt, integer

#: Largest distance of a road from a junction that it does not name [m].
CONTACT_DISTANCE = 1.0


class LaneKey(NamedTuple):
    """A lane of a file; the label is that of the lane section in ids, if not its index."""

    road: str
    section: int
    lane: int
    label: str = ""

    def __str__(self) -> str:
        return f"{self.road}:{self.label or self.section}:{self.lane}"


class LaneEnd(NamedTuple):
    """The start of a lane in the direction of s, or its end."""

    lane: LaneKey
    is_end: bool


class LaneTopology(NamedTuple):
    """A lane, as links need it.

    Args:
        line: of the file.
        is_forward: whether it is driven in the direction of s.
        is_drivable: whether cars drive on it.
        is_point: whether its lane section has no length, so that links pass through it.
        is_gone: whether it has no width, so that links end at it.
        predecessors: ids of lanes at its start.
        successors: ids of lanes at its end.
    """

    line: int
    is_forward: bool
    is_drivable: bool
    is_point: bool
    predecessors: tuple[int, ...]
    successors: tuple[int, ...]
    is_gone: bool = False


@dataclass(frozen=True)
class RoadTopology:
    """A road, as links need it: its lanes by section and id, and the points where it ends.

    ``labels`` are those of its lane sections.
    """

    sections: tuple[Mapping[int, LaneTopology], ...]
    start: complex
    end: complex
    predecessor: RoadLink | None
    successor: RoadLink | None
    labels: tuple[str, ...] = ()

    def key(self, road_id: str, section: int, lane_id: int) -> LaneKey:
        """Return a lane of the road."""
        return LaneKey(road_id, section, lane_id, self.labels[section] if self.labels else "")

    def link(self, is_end: bool) -> RoadLink | None:
        """Return the neighbour at the end, or at the start."""
        return self.successor if is_end else self.predecessor

    def point(self, is_end: bool) -> complex:
        """Return the end point of the reference line, or its start."""
        return self.end if is_end else self.start

    def lane_end(self, road_id: str, lane_id: int, is_end: bool) -> LaneEnd:
        """Return an end of a lane at an end of the road."""
        section = len(self.sections) - 1 if is_end else 0
        return LaneEnd(self.key(road_id, section, lane_id), is_end)


@dataclass(frozen=True)
class Connection:
    """A connection of a junction.

    Args:
        where: place in the file.
        junction: id of the junction.
        incoming: id of the road that leads to the junction.
        outgoing: id of the connecting road, or of the linked road of a direct junction.
        contact: end of ``outgoing`` that it joins, "start" or "end"; empty if the file has none.
        lanes: ids of a lane of ``incoming`` and of the one of ``outgoing`` that continues it.
    """

    where: str
    junction: str
    incoming: str
    outgoing: str
    contact: str
    lanes: tuple[tuple[int, int], ...]


def read_connections(junction: Element, skipped: list[Skipped]) -> list[Connection]:
    """Return the connections of a junction, and list those that cannot be used."""

    def read(element: Element) -> Connection:
        incoming = element.get("incomingRoad")
        outgoing = element.get("connectingRoad") or element.get("linkedRoad")
        if not incoming or not outgoing:
            raise UnusableError(element, "it needs the ids of an incoming and a connecting road")
        lanes = attempt(
            lambda e: (integer(e, "from"), integer(e, "to")), element.all("laneLink"), skipped
        )
        place = f"{element.place} of junction {junction.get('id')[:40]!r}"
        contact = contact_of(element)
        if not element.first("laneLink"):
            skipped.append(Skipped(place, "it has no laneLink, so it links no lanes"))
        return Connection(place, junction.get("id"), incoming, outgoing, contact, tuple(lanes))

    return attempt(read, junction.all("connection"), skipped)


def lane_links(
    roads: Mapping[str, RoadTopology], connections: Iterable[Connection], skipped: list[Skipped]
) -> Iterator[tuple[LaneKey, LaneKey]]:
    """Yield pairs of lanes, of which the second one continues the first one.

    Args:
        roads: by their ids.
        connections: of all junctions.
        skipped: list that gets the links that lead nowhere.
    """
    joined: defaultdict[LaneEnd, dict[LaneEnd, None]] = defaultdict(dict)

    def lane(end: LaneEnd) -> LaneTopology | None:
        road = roads.get(end.lane.road)
        return road.sections[end.lane.section].get(end.lane.lane) if road else None

    for place, one, other in (
        *_of_lanes(roads, skipped),
        *_of_junctions(roads, connections, skipped),
    ):
        if lost := next((end for end in (one, other) if lane(end) is None), None):
            skipped.append(Skipped(place, f"it names lane {lost.lane}, which is not in the map"))
        elif not any(found.is_gone for end in (one, other) if (found := lane(end))):
            joined[one][other] = joined[other][one] = None
    _pass_through_points(joined, lane)
    for one, others in joined.items():
        for other in others:
            first, second = lane(one), lane(other)
            if first is None or second is None:
                continue
            leaves = first.is_forward == one.is_end, second.is_forward == other.is_end
            if leaves == (True, False):
                yield one.lane, other.lane
            elif leaves[0] == leaves[1] and one < other and _drivable(first, second):
                why = f"it meets lane {other.lane}, which has the opposite driving direction"
                skipped.append(Skipped(f"line {first.line}, lane {one.lane}", why))


def _drivable(first: LaneTopology, second: LaneTopology) -> bool:
    return first.is_drivable and second.is_drivable


def _of_lanes(
    roads: Mapping[str, RoadTopology], skipped: list[Skipped]
) -> Iterator[tuple[str, LaneEnd, LaneEnd]]:
    """Yield the place in the file and both ends of the links that lanes name."""
    for one, lane in _lane_ends(roads):
        place = f"line {lane.line}, lane {one.lane}"
        for other in lane.successors if one.is_end else lane.predecessors:
            try:
                found = _linked_end(roads, one, other)
            except KeyError:
                why = f"its link to lane {other} leads to no road"
                skipped.append(Skipped(place, why))
            else:
                if found:
                    yield place, one, found


def _lane_ends(roads: Mapping[str, RoadTopology]) -> Iterator[tuple[LaneEnd, LaneTopology]]:
    """Yield both ends of all lanes."""
    for road_id, road in roads.items():
        for section, lanes in enumerate(road.sections):
            for lane_id, lane in lanes.items():
                for is_end in (False, True):
                    yield LaneEnd(road.key(road_id, section, lane_id), is_end), lane


def _linked_end(roads: Mapping[str, RoadTopology], one: LaneEnd, other: int) -> LaneEnd | None:
    """Return the end of the lane ``other`` that a lane's end is linked to; None at a junction.

    Raises:
        KeyError: there is no road beyond.
    """
    road = roads[one.lane.road]
    beyond = one.lane.section + (1 if one.is_end else -1)
    if 0 <= beyond < len(road.sections):
        return LaneEnd(road.key(one.lane.road, beyond, other), not one.is_end)
    link = road.link(one.is_end)
    if link is not None and link.is_junction:
        return None
    if link is None:
        raise KeyError(other)
    contact = _contact(link.contact, roads[link.id], one.lane.road)
    return roads[link.id].lane_end(link.id, other, contact)


def _contact(contact: str, road: RoadTopology, neighbour: str) -> bool:
    """Return whether a link joins the end of a road; where the file does not say, by its links."""
    if contact:
        return contact == "end"
    link = road.link(is_end=True)
    return link is not None and not link.is_junction and link.id == neighbour


def _of_junctions(
    roads: Mapping[str, RoadTopology], connections: Iterable[Connection], skipped: list[Skipped]
) -> Iterator[tuple[str, LaneEnd, LaneEnd]]:
    """Yield the place in the file and both ends of the links that junctions name."""
    for connection in connections:
        lost = next((i for i in (connection.incoming, connection.outgoing) if i not in roads), None)
        if lost is not None:
            why = f"it names road {lost[:40]!r}, which is not in the map"
            skipped.append(Skipped(connection.where, why))
            continue
        incoming, outgoing = roads[connection.incoming], roads[connection.outgoing]
        contact = _contact(connection.contact, outgoing, connection.incoming)
        end = _incoming_end(connection, incoming, outgoing, contact)
        if end is None:
            why = f"no end of road {connection.incoming!r} is at the junction"
            skipped.append(Skipped(connection.where, why))
            continue
        for one, other in connection.lanes:
            yield (
                connection.where,
                incoming.lane_end(connection.incoming, one, end),
                outgoing.lane_end(connection.outgoing, other, contact),
            )


def _incoming_end(
    connection: Connection, incoming: RoadTopology, outgoing: RoadTopology, contact: bool
) -> bool | None:
    """Return whether the end of the incoming road is at the junction, or its start.

    The connecting road names it, or the incoming road names the junction. If it does so at both
    ends or at none, the end nearer to the connecting road is taken.
    """
    back = outgoing.link(contact)
    if back and not back.is_junction and back.id == connection.incoming and back.contact:
        return back.contact == "end"
    ends = [False, True]
    links = [incoming.link(end) for end in ends]
    naming = [
        end
        for end, link in zip(ends, links, strict=True)
        if link and link.is_junction and link.id == connection.junction
    ]
    distance = {end: abs(incoming.point(end) - outgoing.point(contact)) for end in ends}
    nearest = min(naming or ends, key=distance.__getitem__)
    return nearest if naming or distance[nearest] < CONTACT_DISTANCE else None


def _pass_through_points(
    joined: dict[LaneEnd, dict[LaneEnd, None]], lane: Callable[[LaneEnd], LaneTopology | None]
) -> None:
    """Join the lanes on both sides of lane sections without length."""
    points = {end.lane for end in joined if (found := lane(end)) and found.is_point}
    for key in points:
        sides = [joined.pop(LaneEnd(key, is_end), {}) for is_end in (False, True)]
        for is_end, side in zip((False, True), sides, strict=True):
            for end in side:
                joined.get(end, {}).pop(LaneEnd(key, is_end), None)
        before, after = ([e for e in side if e.lane != key] for side in sides)
        for one in before:
            for other in after:
                joined[one][other] = joined[other][one] = None
