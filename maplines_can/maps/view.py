"""Lines of the map around a lane, each continued ahead and behind, by slot."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate, pairwise, takewhile
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..propagation.paths import MAX_TURN
from ..values.line import Kind, Slot
from ..values.polyline import INDEXED, Pieces, Polyline, value_at
from ..values.route_lines import RouteLines
from .joints import MAX_GAP, SNAP, gap, joined_lines
from .lane import Lane, Skipped
from .lane_graph import DirectedLane, DrivenLine, LaneGraph
from .matching import LaneMatch, locate, pieces_beside, wrapped
from .routing import Route

#: Length of the lines ahead of the end of a lane, if the map has it [m].
AHEAD = 150.0
#: Length of the lines behind the start of a lane, if the map has it [m].
BEHIND = 60.0
#: Length of the sections of a lane in which its lines are cut, if they have too many points for
#: a query without a search tree, and what remains of them beyond these distances [m].
SECTION, REACH = 200.0, 100.0
#: Lanes whose lines are kept, so that the next pose on one of them finds them.
KEPT = 1024
#: Largest angle between lines that lead through a junction beside each other [rad].
PARALLEL = math.radians(45.0)

#: A car sees a line as far as it turns ``MAX_TURN`` to either side, so from a part of a line at
#: most twice as much.
MIN_COSINE = math.cos(2 * MAX_TURN)
#: Margin of that cosine for a direction that is taken over a single step.
MARGIN = 0.2
#: Tangent of the angle between such a step and the direction opposite to that of the part.
NEARLY_OPPOSITE = math.tan(math.pi - math.acos(MIN_COSINE + MARGIN))
#: Length over which the direction of a line is taken for that [m].
CHORD = 1.0

#: The slots of the lines of lanes; the same line as seen in the other direction.
_MIRRORED = {
    Slot.EGO_LEFT: Slot.EGO_RIGHT,
    Slot.EGO_RIGHT: Slot.EGO_LEFT,
    Slot.NEXT_LEFT: Slot.NEXT_RIGHT,
    Slot.NEXT_RIGHT: Slot.NEXT_LEFT,
    Slot.CENTRE: Slot.CENTRE,
    Slot.EDGE_LEFT: Slot.EDGE_RIGHT,
    Slot.EDGE_RIGHT: Slot.EDGE_LEFT,
}
_SLOTS = tuple(_MIRRORED)
_OF_EGO_LANE = frozenset({Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.CENTRE})
_EDGES = frozenset({Slot.EDGE_LEFT, Slot.EDGE_RIGHT})


#: The lines of the slots at one lane, in the order of ``_SLOTS``.
CrossSection = tuple[DrivenLine | None, ...]


class _Way(NamedTuple):
    """A lane and those ahead of it."""

    lanes: list[DirectedLane]
    reaches: list[float]  #: length up to which the lines of each lane are used [m]
    lines: dict[Slot, tuple[DrivenLine, ...]]  #: those of the lane, and those that continue them


@dataclass(frozen=True, eq=False, slots=True)
class Surroundings:
    """Lines around a lane.

    Args:
        lines: by slot.
        base: by slot, the line of a lane beside the car that the line is.
        parts: by slot, the lines of the lanes that the line is made of.
        lanes: the lane, and those behind and ahead of it that the lines follow.
        changing: by slot, the kinds of a line that changes its kind beside the lane, from which arc
            length of the centre line of the lane each applies [m].
    """

    lines: Mapping[Slot, Polyline]
    base: Mapping[Slot, DrivenLine]
    parts: Mapping[Slot, tuple[DrivenLine, ...]]
    lanes: frozenset[DirectedLane]
    changing: Mapping[Slot, Pieces[Kind]]


class LaneView:
    """Lines of a map around a pose.

    Args:
        lanes: by their ids.
    """

    def __init__(self, lanes: Mapping[str, Lane]) -> None:
        self.graph = LaneGraph(lanes)
        self.around = lru_cache(KEPT)(self._around)
        self._route_line = lru_cache(KEPT)(_route_line)
        self._of_kind = lru_cache(KEPT)(_of_kind)
        self._at = lru_cache(KEPT * 8)(self._find_at)
        self._following = lru_cache(KEPT * 64)(self._find_following)
        self._leads_beside = lru_cache(KEPT * 64)(self._find_leads_beside)

    def lines(self, match: LaneMatch, route: Route | None) -> dict[Slot, Polyline]:
        """Return the lines around a pose: see ``Map.lines``."""
        key = DirectedLane(match.lane, match.is_against)
        index = None if route is None else self.index(key, route)
        behind, ahead = self.paths(route, index)
        around = self.around(key, ahead, behind)
        return {**self.beside(match.s, around, self.with_route(around, route, index))}

    def index(self, key: DirectedLane, route: Route, first: int = 0) -> int | None:
        """Return which lane of a route a lane is, or else which one is beside it."""
        try:
            return route.lanes.index(key.lane, first)
        except ValueError:
            row = {other.lane for other in self.graph.row(key) if not other.is_against}
            lanes = enumerate(route.lanes[first:], first)
            return next((i for i, lane in lanes if lane in row), None)

    def paths(
        self, route: Route | None, index: int | None
    ) -> tuple[tuple[DirectedLane, ...], tuple[DirectedLane, ...]]:
        """Return the lanes of a route behind a lane, as driven backward, and ahead of it."""
        if route is None or index is None:
            return (), ()
        near = route.around(index, BEHIND, AHEAD)
        behind = tuple(
            DirectedLane(lane, True) for lane in reversed(route.lanes[near.start : index])
        )
        return behind, tuple(map(DirectedLane, route.lanes[index : near.stop]))

    def with_route(
        self, around: Surroundings, route: Route | None, index: int | None
    ) -> dict[Slot, Polyline]:
        """Return the lines, and that of the route."""
        lines = dict(around.lines)
        if route is not None and index is not None:
            lines[Slot.ROUTE] = self._route_line(route, index)
        return lines

    def beside(
        self, s: float, around: Surroundings, lines: Mapping[Slot, Polyline]
    ) -> Mapping[Slot, Polyline]:
        """Return lines around a lane with the kinds that they have beside its centre line at s."""
        found = {
            slot: self._of_kind(lines[slot], value_at(kinds, s))
            for slot, kinds in around.changing.items()
        }
        return {**lines, **found} if found else lines

    def along(self, route: Route) -> RouteLines:
        """Return the lines along a route: see ``Map.along``."""
        path = route.line
        starts, sections = [], []
        for i, (begin, end) in enumerate(pairwise([*route.begins, path.length])):
            behind, ahead = self.paths(route, i)
            around = self.around(DirectedLane(route.lanes[i], False), ahead, behind)
            lines = self.with_route(around, route, i)
            is_long = any(len(line.points) > INDEXED for line in lines.values())
            parts = math.ceil((end - begin) / SECTION) if is_long else 1
            bounds = {*np.linspace(begin, end, parts + 1).tolist()}
            bounds.update(_changes(around, path, (begin, end)))
            for span in pairwise(sorted(bounds)):
                (middle,) = path.at(np.mean(span, keepdims=True))
                (place,) = locate([around.base[Slot.CENTRE].line], middle)
                starts.append(span[0])
                sections.append(
                    {
                        slot: _near_section(line, path, span)
                        for slot, line in self.beside(place.s, around, lines).items()
                    }
                )
        return RouteLines(path, tuple(starts), sections)

    def _around(
        self, key: DirectedLane, ahead: tuple[DirectedLane, ...], behind: tuple[DirectedLane, ...]
    ) -> Surroundings:
        """Return the lines around a lane that follow the paths ahead and behind.

        Args:
            key: the lane.
            ahead: lanes to follow ahead.
            behind: lanes to follow behind, as driven backward, from the nearest one on.
        """
        front, rear = self._way(key, ahead, AHEAD), self._way(key.back, behind, BEHIND)
        # Lines behind, as driven backward, and ahead; slots with the same ones have the same line.
        numbers: dict[tuple[tuple[DrivenLine, ...], tuple[DrivenLine, ...]], int] = {}
        which = {
            slot: numbers.setdefault((rear.lines[_MIRRORED[slot]], own), len(numbers))
            for slot, own in front.lines.items()
        }
        parts, points = [], []
        for back, own in numbers:
            parts.append((*(source.back for source in back[:0:-1]), *own))
            backward = [part[::-1] for part in _points(back, rear.reaches)[:0:-1]]
            points.append(([*backward, *_points(own, front.reaches)], own[0].line.kind))
        lines, spans = [], []
        for (line, starts), (back, _) in zip(joined_lines(points), numbers, strict=True):
            lines.append(line)
            k = len(back) - 1
            spans.append((starts[k], [*starts, line.length][k + 1]))
        for i, turns in enumerate(may_turn_back(lines, spans)):
            if turns:
                lines[i] = visible(lines[i], *spans[i])
        return Surroundings(
            {slot: lines[i] for slot, i in which.items()},
            {slot: own[0] for slot, own in front.lines.items()},
            {slot: parts[i] for slot, i in which.items()},
            frozenset((*front.lanes, *(other.back for other in rear.lanes))),
            _changing(front.lines),
        )

    def _find_at(self, key: DirectedLane) -> CrossSection:
        """Return the line of each slot at a lane."""
        graph = self.graph
        row = graph.row(key)
        i = row.index(key)
        own = graph[key]
        next_left = graph[row[i - 1]].left if i > 0 else None
        next_right = graph[row[i + 1]].right if i + 1 < len(row) else None
        edges = graph[row[0]].left, graph[row[-1]].right
        return own.left, own.right, next_left, next_right, own.centre, *edges

    def _way(self, key: DirectedLane, path: Sequence[DirectedLane], reach: float) -> _Way:
        """Return a lane with those ahead of it, and the lines of each slot that continue it."""
        lanes, reaches, sections = [key], [math.inf], [self._at(key)]
        for following in self.graph.way(key, path, reach):
            section = self._following(sections[-1], following)
            if not any(section):
                break
            lanes.append(following)
            reaches.append(reach)
            sections.append(section)
            reach -= self.graph[following].length
        columns = zip(_SLOTS, zip(*sections, strict=True), strict=True)
        lines = {slot: tuple(takewhile(bool, own)) for slot, own in columns if own[0]}
        return _Way(lanes, reaches, lines)

    def _find_following(self, section: CrossSection, following: DirectedLane) -> CrossSection:
        """Return the lines that continue those of a lane, where the next one begins.

        It is the line of the slot at the next lane, if it begins where this one ends.
        """
        found: list[DrivenLine | None] = []
        for slot, source, designated in zip(_SLOTS, section, self._at(following), strict=True):
            one = designated if source else None
            if source and (one is None or math.dist(source.end, one.start) > MAX_GAP):
                one = None if slot in _OF_EGO_LANE else self._beside(slot, source, following)
            found.append(one)
        return tuple(found)

    def _beside(self, slot: Slot, source: DrivenLine, following: DirectedLane) -> DrivenLine | None:
        """Return the line of a successor of a lane that continues its line beside the next lane.

        Another lane has opened between, or the lanes beside each other have no common road in a
        junction.

        Args:
            slot: of the line.
            source: the line.
            following: lane ahead that the car drives on.
        """
        for key in self.graph[source.key].successors:
            other: DrivenLine = getattr(self.graph[key], source.side)
            if math.dist(source.end, other.start) > MAX_GAP:
                continue
            if key in self.graph.row(following):
                if slot not in _EDGES:  # an edge ends where a lane opens beyond it
                    return other
            elif self._leads_beside(other, following):
                return other
        return None

    def _find_leads_beside(self, source: DrivenLine, key: DirectedLane) -> bool:
        """Return whether a line ends on its side of a lane and in about its direction."""
        lane = self.graph[key]
        boundary = lane.left if source.side == "left" else lane.right
        points = source.points
        (place,) = locate([boundary.polyline], points[-1])
        (x0, y0), (x1, y1) = points[-2:].tolist()
        turn = wrapped(math.atan2(y1 - y0, x1 - x0) - place.direction)
        outward = place.t if source.side == "left" else -place.t
        return outward > -MAX_GAP and abs(turn) < PARALLEL


def _points(sources: Sequence[DrivenLine], reaches: Sequence[float]) -> list[NDArray[np.float64]]:
    """Return the points of lines that follow each other, up to a position each."""
    return [source.points_up_to(s) for source, s in zip(sources, reaches, strict=False)]


def visible(line: Polyline, start: float, end: float) -> Polyline:
    """Return a line without what no car beside a part of it can see, as it turns too far.

    So a line that returns, as that of a loop does, does not come near the car again.

    Args:
        line: the line.
        start: arc length of the start of the part [m].
        end: arc length of its end [m].
    """
    s = np.linspace(0.0, line.length, max(1, math.ceil(line.length / CHORD)) + 1)
    x, y = (np.interp(s, line.distance, values) for values in line.points.T)
    chord = np.diff(x + 1j * y)
    chord /= np.maximum(np.abs(chord), 1e-12)
    first, last = (s[1:-1].searchsorted(at) for at in (start, end))
    ahead = (chord[last:] * chord[last].conj()).real < MIN_COSINE
    behind = (chord[first::-1] * chord[first].conj()).real < MIN_COSINE
    if not (ahead.any() or behind.any()):
        return line
    low = s[first - behind.argmax() + 1] if behind.any() else 0.0
    high = s[last + ahead.argmax()] if ahead.any() else line.length
    rows = line.distance.searchsorted([min(low, start), max(high, end)])
    return Polyline(line.points[rows[0] : rows[1] + 1], line.kind)


def may_turn_back(lines: Sequence[Polyline], spans: Sequence[tuple[float, float]]) -> list[bool]:
    """Return which lines may have a step that turns too far from a part: quickly, and too often.

    Args:
        lines: the lines.
        spans: arc lengths of the start and of the end of the part of each line [m].
    """
    sizes = [len(line.points) for line in lines]
    first = [0, *accumulate(sizes)]
    rows: list[int] = []  # the steps at the ends of the parts; -1 is none
    counts: list[int] = []  # number of steps to compare with each: behind, in and ahead of the part
    is_short = []
    for line, (start, end), row, size in zip(lines, spans, first, sizes, strict=False):
        ends = line.distance[1:-1].searchsorted([start + CHORD / 2, end - CHORD / 2])
        k0, k1 = ends.tolist()
        rows += row + k0, -1, row + k1
        counts += min(k0 + 1, k1), max(0, k1 - k0 - 1), size - k1
        is_short.append(k0 > k1)
    x, y = np.concatenate([line.points for line in lines]).T
    step = np.append(np.diff(x + 1j * y), 0.0)
    step[[row - 1 for row in first[1:]]] = 0.0  # from line to line
    turned = step * step[rows].conj().repeat(counts)
    is_far = np.abs(turned.imag) < -NEARLY_OPPOSITE * turned.real
    far = np.logical_or.reduceat(is_far, first[:-1]).tolist()
    return [a or b for a, b in zip(far, is_short, strict=True)]


def _of_kind(line: Polyline, kind: Kind) -> Polyline:
    return line if line.kind is kind else Polyline.trusted(line.points, kind, line.distance)


def _changing(lines: Mapping[Slot, Sequence[DrivenLine]]) -> dict[Slot, Pieces[Kind]]:
    """Return the kinds of lines that change theirs, by the arc length of the centre line [m]."""
    centre, found = lines[Slot.CENTRE][0], {}
    for slot, (own, *_) in lines.items():
        if own.line.kinds:
            starts, kinds = zip(*own.line.kinds, strict=True)
            points = own.line.at(np.array(starts[1:]))
            is_along = own.key.is_against is centre.key.is_against
            found[slot] = pieces_beside(centre.line, points, kinds, is_along)
    return found


def _changes(around: Surroundings, path: Polyline, span: tuple[float, float]) -> Iterator[float]:
    """Yield where along a part of a path [m] the kinds of lines beside it change."""
    part = Polyline(path.between(*span))
    changes = [s for kinds in around.changing.values() for s, _ in kinds[1:]]
    for point in around.base[Slot.CENTRE].line.at(np.array(changes)):
        (place,) = locate([part], point)
        if 0 < place.s < part.length:
            yield span[0] + place.s


def _near_section(line: Polyline, path: Polyline, span: tuple[float, float]) -> Polyline:
    """Return what a car sees of a long line between two positions along a path beside it [m]."""
    if len(line.points) <= INDEXED:
        return line
    at = np.transpose([np.interp(span, path.distance, values) for values in path.points.T])
    nearest = [np.hypot(*(line.points - place).T).argmin() for place in at]
    low, high = np.sort(line.distance[nearest])
    first, last = line.distance.searchsorted([low - BEHIND - REACH, high + AHEAD + REACH])
    return Polyline(line.points[max(0, first - 1) : last + 1], line.kind)


def _route_line(route: Route, index: int) -> Polyline:
    """Return the line of a route around one of its lanes."""
    near = route.around(index, BEHIND, AHEAD)
    begin = route.starts[near.start]
    end = route.starts[near.stop] if near.stop < len(route.starts) else math.inf
    distance = route.line.distance
    rows = slice(int(distance.searchsorted(begin)), int(distance.searchsorted(end, "right")))
    line = Polyline(route.line.points[rows], route.line.kind)
    start, length = route.extent(index)
    span = start - begin, start - begin + length
    return visible(line, *span) if any(may_turn_back([line], [span])) else line


def link_gaps(lanes: Mapping[str, Lane]) -> Iterator[Skipped]:
    """Yield the links between drivable lanes whose boundaries do not meet.

    Lines are joined across gaps of up to ``MAX_GAP``, and end at larger ones.

    Args:
        lanes: by their ids.
    """
    for lane in lanes.values():
        for following in (lanes[i] for i in lane.successors):
            if not (lane.type.is_drivable and following.type.is_drivable):
                continue
            pairs = ((lane.left, following.left), (lane.right, following.right))
            largest = max(gap(line, other) for line, other in pairs)
            if largest > SNAP:
                what = "end there" if largest > MAX_GAP else "are joined across it"
                yield Skipped(
                    f"link of lane {lane.id} to lane {following.id}",
                    f"the boundaries have a gap of {largest:.2f} m; lines {what}",
                )
