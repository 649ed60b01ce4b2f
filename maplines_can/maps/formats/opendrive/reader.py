"""Reader of OpenDRIVE 1.4 to 1.8: from the elements of a file to the lanes of a map."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import chain
from operator import itemgetter
from typing import BinaryIO, NamedTuple, TypeVar

import numpy as np

from ....values.errors import MapFileError
from ....values.line import Kind
from ....values.polyline import Pieces, Polyline, longest, merged
from ...lane import SkippedList
from ...matching import pieces_beside
from ...road_map import Landmark, Lane, LaneType, Map, Road, Skipped
from ..coordinate_systems import notices_of
from ..projection import shifted, utm_of
from ..xml_tree import Document, Element, number_in
from .boundaries import SAME, Boundaries, SamplingError, sampled
from .landmarks import read_buildings, read_landmarks
from .lane_section import LaneRecord, Speeds
from .links import Connection, LaneKey, LaneTopology, RoadTopology, lane_links, read_connections
from .reference_line import Complex
from .road import RoadRecord, read_road
from .vanishing import without_vanished
from .xml_attributes import UnusableError

#: Elements that say nothing of lanes or landmarks.
_IGNORED = {"elevationProfile", "railroad", "surface"}

#: Travel direction of a lane by whether it is driven along s.
_TRAVEL = {True: "forward", False: "backward"}
#: Kinds at the outside of a road without a marking.
_UNMARKED = {Kind.UNKNOWN: Kind.ROAD_EDGE, Kind.VIRTUAL: Kind.ROAD_EDGE}

T = TypeVar("T")
#: Returns a lane, given its ``successors`` and ``predecessors``.
UnlinkedLane = partial[Lane]


@np.errstate(all="ignore")  # what overflows is not finite, and its road is not used
def read(stream: BinaryIO, name: str) -> Map:
    """Read a map from the bytes of an OpenDRIVE file.

    Lanes have the ids "road:section:lane", with the index of the lane section.

    Args:
        stream: of the XML document.
        name: of the file, for messages.

    Raises:
        MapFileError: it is not XML, is not OpenDRIVE, or has no usable road.
    """
    reader = _Reader()
    document = Document(stream, name, ignored=_IGNORED, text_in={"geoReference"})
    for element in document.elements():
        reader.add(element)
    reader.skipped += document.check_root("OpenDRIVE", "an OpenDRIVE")
    if not reader.lanes:
        why = f"; first reason: {reader.skipped[0]}" if reader.skipped else ""
        raise MapFileError(f"{name} contains no usable road{why}")
    return reader.map(name)


class _Reader:
    """State of the reading: lanes so far, and links to resolve at the end."""

    def __init__(self) -> None:
        self.skipped: list[Skipped] = SkippedList()
        self.lanes: dict[LaneKey, UnlinkedLane] = {}
        self._roads: dict[str, Road] = {}
        self._landmarks: list[Landmark] = []
        self._buildings: list[Polyline] = []
        self._topology: dict[str, RoadTopology] = {}
        self._connections: list[Connection] = []
        self._left_hand = 0
        self._geo_reference: Element | None = None
        self._offset: Element | None = None

    def add(self, element: Element) -> None:
        """Read a child of the root."""
        if element.tag == "header":
            self._add_header(element)
        elif element.tag == "junction":
            self._connections += read_connections(element, self.skipped)
        elif element.tag == "road":
            try:
                self._add_road(element)
            except UnusableError as error:
                why = f"the road {element.get('id')[:40]!r} is not used: {error.skipped.why}"
                self.skipped.append(Skipped(error.skipped.where, why))

    def _add_header(self, header: Element) -> None:
        self._geo_reference, self._offset = header.first("geoReference"), header.first("offset")

    def _frame(self) -> str | None:
        """Return the projection of the map, and list what is to be known of it.

        The offset of the header leads from positions of the file to those of ``geoReference``.
        """
        reference, offset = self._geo_reference, self._offset
        name = "" if reference is None else reference.text.strip()
        x, y, turn = (number_in(offset.get(i, "0")) if offset else 0.0 for i in ("x", "y", "hdg"))
        projection = name or None
        if offset and (x, y, turn) != (0, 0, 0):
            is_moved = turn == 0 and math.isfinite(x + y)
            projection = shifted(utm_of(name) or name, x, y) if is_moved else None
            if projection is None:
                why = "the offset is not applied: latitude and longitude have no place on the map"
                self.skipped.insert(0, Skipped(offset.place, why))
        if reference is not None and projection:
            ends = [end for road in self._topology.values() for end in (road.start, road.end)]
            points = np.array([[end.real + x, end.imag + y] for end in ends])
            found = [Skipped(reference.place, why) for why in notices_of(name, points)]
            self.skipped[:0] = found
        return projection

    def _add_road(self, element: Element) -> None:
        road = read_road(element, self.skipped)
        if road.id in self._topology:
            raise UnusableError(element, "another road has the same id")
        road = without_vanished(road, self.skipped)
        sections = [Boundaries(road, index) for index in range(len(road.sections))]
        try:
            lanes = dict(self._road_lanes(road, [one for one in sections if not one.is_point]))
        except SamplingError as error:
            raise UnusableError(element, str(error)) from None
        is_point = all(section.is_point for section in sections)
        if not lanes and not is_point:
            raise UnusableError(element, "it has no lanes with a length")
        self.lanes |= lanes
        self._landmarks += read_landmarks(element, road, self.skipped)
        self._buildings += read_buildings(element, road, self.skipped)
        self._left_hand += road.is_left_hand
        ends = np.array([road.sections[0].s, road.reference.end])
        (first, last), _ = road.reference(ends, ends)
        self._topology[road.id] = RoadTopology(
            tuple(_topology(road, one.index, one.is_point) for one in sections),
            first,
            last,
            road.predecessor,
            road.successor,
            tuple(section.label for section in road.sections),
        )
        if is_point:
            why = f"the road {road.id!r} has no length; links pass through it"
            self.skipped.append(Skipped(element.place, why))
            return
        ids = tuple(map(str, lanes))
        self._roads[road.id] = Road(road.id, road.name, road.reference.end, ids, road.junction)

    def _road_lanes(
        self, road: RoadRecord, sections: Sequence[Boundaries]
    ) -> Iterator[tuple[LaneKey, UnlinkedLane]]:
        """Yield the lanes of the lane sections of a road without their links."""
        for boundaries, points in zip(sections, sampled(road, sections), strict=True):
            yield from self._section_lanes(road, boundaries, points)

    def _section_lanes(
        self, road: RoadRecord, boundaries: Boundaries, points: Complex
    ) -> Iterator[tuple[LaneKey, UnlinkedLane]]:
        """Yield the lanes of a lane section without their links."""
        index = boundaries.index
        section, extent = road.sections[index], road.extent(index)
        records = sorted(section.lanes.values(), key=lambda record: -record.id)
        kinds = {0: _pieces(section.centre_marks, extent, Kind.UNKNOWN)}  # by row
        for record in records:
            kinds[boundaries.rows[record.id][1]] = _pieces(record.marks, extent, Kind.UNKNOWN)
        if not road.junction:  # roads overlap in a junction
            for row in boundaries.outermost:
                kinds[row] = merged([(s, _UNMARKED.get(kind, kind)) for s, kind in kinds[row]])
        drawn = [_lines_of(record, boundaries, _is_forward(road, record)) for record in records]
        longest_kinds = {row: longest(pieces, extent[1]) for row, pieces in kinds.items()}
        lines = _polylines(points, longest_kinds, dict.fromkeys(chain.from_iterable(drawn)))
        for line, polyline in lines.items():
            if line.one == line.other and len(kinds[line.one]) > 1:
                pieces = _along(polyline, line, kinds[line.one], boundaries)
                lines[line] = Polyline.trusted(polyline.points, pieces, polyline.distance)
        negative = set(boundaries.negative)
        padded = [None, *records, None]
        for record, beside, own in zip(
            records, zip(padded, padded[2:], strict=False), drawn, strict=True
        ):
            key = LaneKey(road.id, index, record.id, section.label)
            limits = _pieces(_speeds(road, record), extent, None)
            is_forward = _is_forward(road, record)
            if record.type.is_drivable and record.travel == _TRAVEL[not is_forward]:
                place, way = f"line {record.line}, lane {key}", _TRAVEL[is_forward]
                why = f"its travelDir {record.travel} is not used; it is driven {way} along s"
                self.skipped.append(Skipped(place, why))
            if record.id in negative:
                place = f"line {record.line}, lane {key}"
                self.skipped.append(Skipped(place, "its width is negative in part; 0 is used"))
            left, right, centre = own
            same, opposite = _neighbours(
                road, index, record, beside[:: 1 if left.is_forward else -1]
            )
            yield (
                key,
                partial(
                    Lane,
                    id=str(key),
                    left=lines[left],
                    right=lines[right],
                    centre=lines[centre],
                    type=record.type,
                    speed_limit=longest(limits, extent[1]),
                    speed_limits=_along(lines[centre], centre, limits, boundaries)
                    if len(limits) > 1
                    else (),
                    left_neighbour=same[0],
                    right_neighbour=same[1],
                    opposite_left=opposite,
                    road=road.id,
                    junction=road.junction,
                ),
            )

    def map(self, name: str) -> Map:
        """Return the map."""
        successors: defaultdict[LaneKey, dict[str, None]] = defaultdict(dict)
        predecessors: defaultdict[LaneKey, dict[str, None]] = defaultdict(dict)
        after: defaultdict[str, dict[str, None]] = defaultdict(dict)
        before: defaultdict[str, dict[str, None]] = defaultdict(dict)
        for one, other in lane_links(self._topology, self._connections, self.skipped):
            successors[one][str(other)] = predecessors[other][str(one)] = None
            if one.road != other.road:
                after[one.road][other.road] = before[other.road][one.road] = None
        projection = self._frame()
        both_ways = [
            key
            for key, lane in self.lanes.items()
            if lane.keywords["type"] == LaneType.BIDIRECTIONAL
        ]
        if both_ways:
            where = f"{len(both_ways)} lanes of both directions, such as {both_ways[0]}"
            why = "they are used only in the direction of their side of the road"
            self.skipped.append(Skipped(where, why))
        return Map(
            lanes={
                str(key): lane(
                    successors=tuple(successors.get(key, ())),
                    predecessors=tuple(predecessors.get(key, ())),
                )
                for key, lane in self.lanes.items()
            },
            roads={
                key: replace(road, successors=tuple(after[key]), predecessors=tuple(before[key]))
                for key, road in self._roads.items()
            },
            skipped=tuple(self.skipped),
            projection=projection,
            name=name,
            left_hand_traffic=2 * self._left_hand > len(self._roads),
            landmarks=tuple(self._landmarks),
            buildings=tuple(self._buildings),
        )


class _Line(NamedTuple):
    """The line halfway between two boundaries of a lane section, or one of them.

    Args:
        one, other: rows of the boundaries.
        is_forward: whether it runs in the direction of s.
    """

    one: int
    other: int
    is_forward: bool


def _lines_of(record: LaneRecord, boundaries: Boundaries, is_forward: bool) -> list[_Line]:
    """Return the left and the right boundary of a lane and its centre line, as driven."""
    inner, outer = boundaries.rows[record.id]
    left, right = (outer, inner) if (record.id > 0) == is_forward else (inner, outer)
    return [
        _Line(one, other, is_forward) for one, other in ((left,) * 2, (right,) * 2, (left, right))
    ]


def _polylines(
    points: Complex, kinds: Mapping[int, Kind], lines: Collection[_Line]
) -> dict[_Line, Polyline]:
    """Return lines of a lane section. Those of one direction are computed together.

    Args:
        points: (rows, k) points of the boundaries.
        kinds: of the boundaries, by row.
        lines: each at most once.
    """

    def kind(line: _Line) -> Kind:
        return kinds[line.one] if line.one == line.other else Kind.VIRTUAL

    found: dict[_Line, Polyline] = {}
    for is_forward in (True, False):
        group = [line for line in lines if line.is_forward == is_forward]
        if not group:
            continue
        rows = (points[[line.one for line in group]] + points[[line.other for line in group]]) / 2
        step = np.abs(rows[:, 1:] - rows[:, :-1])
        has_repeats = (step <= SAME).any(axis=1)
        for i in np.flatnonzero(has_repeats):
            row = distinct(rows[i])[:: 1 if is_forward else -1]
            found[group[i]] = Polyline(np.array([row.real, row.imag]).T, kind(group[i]))
        if has_repeats.any():
            group = [line for line in group if line not in found]
            rows, step = rows[~has_repeats], step[~has_repeats]
        if not is_forward:
            rows, step = np.ascontiguousarray(rows[:, ::-1]), step[:, ::-1]
        distance = np.zeros(rows.shape)
        step.cumsum(axis=1, out=distance[:, 1:])
        xy = rows.view(float).reshape(*rows.shape, 2)
        for line, one, s in zip(group, xy, distance, strict=True):
            found[line] = Polyline.trusted(one, kind(line), s)
    return found


def distinct(points: Complex) -> Complex:
    """Return the points without those that repeat the one before, but with both ends."""
    near = np.abs(points[1:] - points[:-1]) <= SAME
    if len(points) == 2 or not near.any():
        return points
    keep = np.append(True, ~near)
    keep[-1] = True
    if near[-1] and keep.sum() > 2:
        keep[np.flatnonzero(keep)[-2]] = False
    return points[keep]


def _is_forward(road: RoadRecord, record: LaneRecord) -> bool:
    """Return whether a lane is driven in the direction of s."""
    return ((record.id < 0) != road.is_left_hand) != record.is_reversed


def _pieces(
    records: Sequence[tuple[float, T]], extent: tuple[float, float], default: T
) -> Pieces[T]:
    """Return the values that apply in a stretch of s, from the s at which each begins."""
    start, end = extent
    found = {start: default}
    for s, value in sorted(records, key=itemgetter(0)):
        if s <= start + SAME:
            found[start] = value
        elif s < end - SAME:
            found[s] = value
    return merged(list(found.items()))


def _along(polyline: Polyline, line: _Line, pieces: Pieces[T], boundaries: Boundaries) -> Pieces[T]:
    """Return what applies in a stretch of s, along a line of the lane section as driven."""
    s = np.array([s for s, _ in pieces[1:]])
    points = boundaries(s, s)
    at = (points[line.one] + points[line.other]) / 2
    values = [value for _, value in pieces]
    return pieces_beside(polyline, np.column_stack([at.real, at.imag]), values, line.is_forward)


def _speeds(road: RoadRecord, record: LaneRecord) -> Speeds:
    """Return the speed limits of a lane; those of its road apply before its own."""
    first = min((s for s, _ in record.speeds), default=math.inf)
    return (*(one for one in road.speeds if one[0] < first), *record.speeds)


def _neighbours(
    road: RoadRecord, index: int, record: LaneRecord, beside: Sequence[LaneRecord | None]
) -> tuple[list[str | None], str | None]:
    """Return the ids on the left and on the right with the same direction, and an opposite one."""
    same: list[str | None] = [None, None]
    opposite = None
    for side, other in enumerate(beside):
        if other is not None and other.type.is_drivable:
            key = str(LaneKey(road.id, index, other.id, road.sections[index].label))
            if _is_forward(road, other) == _is_forward(road, record):
                same[side] = key
            else:
                opposite = key
    return same, opposite


def _topology(road: RoadRecord, index: int, is_point: bool) -> dict[int, LaneTopology]:
    section, gone = road.sections[index], road.sections[index].gone
    return {
        record.id: LaneTopology(
            record.line,
            _is_forward(road, record),
            record.type.is_drivable,
            is_point,
            record.predecessors,
            record.successors,
            record.id in gone,
        )
        for record in (*section.lanes.values(), *gone.values())
    }
