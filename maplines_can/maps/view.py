"""Lines of the map around a lane, each continued ahead and behind, by the slots of a scene."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ..line import Slot
from ..polyline import MAX_TURN, Polyline
from .driven import DrivenLane, Key, LaneGraph
from .joints import MAX_GAP, SNAP, gap, joined
from .lane import Lane, Skipped
from .matching import LaneMatch, locate, wrapped
from .routing import Route

#: Length of the lines ahead of the end of a lane, if the map has it [m].
AHEAD = 150.0
#: Length of the lines behind the start of a lane, if the map has it [m].
BEHIND = 60.0
#: Lanes whose lines are kept, so that the next pose on one of them finds them.
KEPT = 1024
#: Largest angle between lines that lead through a junction beside each other [rad].
PARALLEL = math.radians(45.0)

#: A car sees a line as far as it turns ``MAX_TURN`` to either side, so from a part of a line at
#: most twice as much.
LEAST_COSINE = math.cos(2 * MAX_TURN)
#: Margin of that cosine for a direction that is taken over a single step.
MARGIN = 0.2
#: Length over which the direction of a line is taken for that [m].
CHORD = 1.0

#: The same line as seen in the other direction.
_MIRRORED = {
    Slot.EGO_LEFT: Slot.EGO_RIGHT,
    Slot.EGO_RIGHT: Slot.EGO_LEFT,
    Slot.NEXT_LEFT: Slot.NEXT_RIGHT,
    Slot.NEXT_RIGHT: Slot.NEXT_LEFT,
    Slot.CENTRE: Slot.CENTRE,
    Slot.EDGE_LEFT: Slot.EDGE_RIGHT,
    Slot.EDGE_RIGHT: Slot.EDGE_LEFT,
}
_OTHER_SIDE = {"left": "right", "right": "left", "centre": "centre"}
_OF_EGO_LANE = frozenset({Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.CENTRE})
_EDGES = frozenset({Slot.EDGE_LEFT, Slot.EDGE_RIGHT})


@dataclass(eq=False, slots=True)
class Source:
    """A line of a lane; always the same object, so that it is found by its identity.

    Args:
        key: the lane.
        side: "left", "right" or "centre", as driven.
        line: the line, as driven.

    Attributes:
        start: first point of the line [m].
        end: last point of the line [m].
        length: of the line [m].
        back: the same line in the other direction.
    """

    key: Key
    side: str
    line: Polyline
    start: tuple[float, float] = field(init=False)
    end: tuple[float, float] = field(init=False)
    length: float = field(init=False)
    back: Source = field(init=False)

    def __post_init__(self) -> None:
        points = self.line.points
        self.start, self.end = tuple(points[0].tolist()), tuple(points[-1].tolist())
        self.length = self.line.length


#: A line of a lane, and those of its points that are used.
Part = tuple[Source, NDArray[np.float64]]


@dataclass(frozen=True, eq=False, slots=True)
class CrossSection:
    """The lines of the slots at one lane.

    Args:
        sources: slots, and the line that each has.
    """

    sources: tuple[tuple[Slot, Source], ...]


@dataclass(frozen=True, eq=False, slots=True)
class Surroundings:
    """Lines around a lane.

    Args:
        lines: by slot.
        base: by slot, the line of a lane beside the car that the line is.
        parts: by slot, the lines of the lanes that the line is made of.
        lanes: the lane, and those behind and ahead of it that the lines follow.
    """

    lines: Mapping[Slot, Polyline]
    base: Mapping[Slot, Source]
    parts: Mapping[Slot, tuple[Source, ...]]
    lanes: frozenset[Key]


class View:
    """Lines of a map around a pose.

    Args:
        lanes: by their ids.
    """

    def __init__(self, lanes: Mapping[str, Lane]) -> None:
        self.graph = LaneGraph(lanes)
        self.around = lru_cache(KEPT)(self._around)
        self._route_line = lru_cache(KEPT)(_route_line)
        self._sources: dict[tuple[Key, str], Source] = {}
        self._at = lru_cache(KEPT * 8)(self._find_at)
        # The same lines are the same object, so that the lanes after them are found once.
        self._cross_section = lru_cache(KEPT * 64)(CrossSection)
        self._following = lru_cache(KEPT * 64)(self._find_following)

    def lines(self, match: LaneMatch, route: Route | None) -> dict[Slot, Polyline]:
        """Return the lines around a pose: see ``Map.lines``."""
        key = Key(match.lane, match.is_against)
        index = None if route is None else self.index(key, route)
        behind, ahead = self.paths(route, index)
        return self.with_route(self.around(key, ahead, behind), route, index)

    def index(self, key: Key, route: Route, first: int = 0) -> int | None:
        """Return which lane of a route a lane is, or else which one is beside it."""
        try:
            return route.lanes.index(key.lane, first)
        except ValueError:
            row = {other.lane for other in self.graph.row(key) if not other.is_against}
            lanes = enumerate(route.lanes[first:], first)
            return next((i for i, lane in lanes if lane in row), None)

    def paths(
        self, route: Route | None, index: int | None
    ) -> tuple[tuple[Key, ...], tuple[Key, ...]]:
        """Return the lanes of a route behind a lane, as driven backward, and ahead of it."""
        if route is None or index is None:
            return (), ()
        near = route.around(index, BEHIND, AHEAD)
        behind = tuple(Key(lane, True) for lane in reversed(route.lanes[near.start : index]))
        return behind, tuple(map(Key, route.lanes[index : near.stop]))

    def with_route(
        self, around: Surroundings, route: Route | None, index: int | None
    ) -> dict[Slot, Polyline]:
        """Return the lines, and that of the route."""
        lines = dict(around.lines)
        if route is not None and index is not None:
            lines[Slot.ROUTE] = self._route_line(route, index)
        return lines

    def _around(self, key: Key, ahead: tuple[Key, ...], behind: tuple[Key, ...]) -> Surroundings:
        """Return the lines around a lane that follow the paths ahead and behind.

        Args:
            key: the lane.
            ahead: lanes to follow ahead.
            behind: lanes to follow behind, as driven backward, from the nearest one on.
        """
        after, lanes_ahead = self._continued(key, ahead, AHEAD)
        before, lanes_behind = self._continued(key.back, behind, BEHIND)
        known: dict[tuple[Source, ...], Polyline] = {}
        lines: dict[Slot, Polyline] = {}
        parts: dict[Slot, tuple[Source, ...]] = {}
        bases = self._at(key)
        for slot, source in bases.items():
            back, front = before[_MIRRORED[slot]], after[slot]
            sources = [part.back for part, _ in reversed(back)]
            sources += [source, *(part for part, _ in front)]
            whole = tuple(sources)
            if whole not in known:
                points = [part[::-1] for _, part in reversed(back)]
                points += [source.line.points, *(part for _, part in front)]
                line, starts = joined(points, source.line.kind)
                end = [*starts, line.length][len(back) + 1]
                known[whole] = _visible(line, starts[len(back)], end)
            lines[slot], parts[slot] = known[whole], whole
        return Surroundings(lines, bases, parts, frozenset((key, *lanes_ahead, *lanes_behind)))

    def _source(self, key: Key, side: str) -> Source:
        """Return a line of a lane."""
        found = self._sources.get((key, side))
        if found is None:
            pair = ((key, side), (key.back, _OTHER_SIDE[side]))
            one, other = (Source(*at, getattr(self.graph[at[0]], at[1])) for at in pair)
            one.back, other.back = other, one
            self._sources |= zip(pair, (one, other), strict=True)
            found = one
        return found

    def _find_at(self, key: Key) -> dict[Slot, Source]:
        """Return where the line of each slot is from, at a lane."""
        row = self.graph.row(key)
        i = row.index(key)
        places = {Slot.EGO_LEFT: (key, "left"), Slot.EGO_RIGHT: (key, "right")}
        if i > 0:
            places[Slot.NEXT_LEFT] = (row[i - 1], "left")
        if i + 1 < len(row):
            places[Slot.NEXT_RIGHT] = (row[i + 1], "right")
        places[Slot.CENTRE] = (key, "centre")
        places[Slot.EDGE_LEFT] = (row[0], "left")
        places[Slot.EDGE_RIGHT] = (row[-1], "right")
        return {slot: self._source(*place) for slot, place in places.items()}

    def _continued(
        self, key: Key, path: Sequence[Key], reach: float
    ) -> tuple[dict[Slot, list[Part]], list[Key]]:
        """Return the parts that continue the line of each slot ahead of a lane, and the lanes."""
        at = self._at(key)
        section = self._cross_section(tuple(at.items()))
        parts: dict[Slot, list[Part]] = {slot: [] for slot in at}
        lanes = []
        for following in self.graph.way(key, path, reach):
            section = self._following(section, following)
            if not section.sources:
                break
            for slot, source in section.sources:
                points = source.line.points
                if source.length > reach:
                    rows = int(source.line.distance.searchsorted(reach)) + 1
                    points = points[: max(2, rows)]
                parts[slot].append((source, points))
            lanes.append(following)
            reach -= self.graph[following].centre.length
        return parts, lanes

    def _find_following(self, section: CrossSection, following: Key) -> CrossSection:
        """Return the lines that continue those of a lane, where the next one begins.

        It is the line of the slot at the next lane, if it begins where this one ends.
        """
        at = self._at(following)
        found = []
        for slot, source in section.sources:
            designated = at.get(slot)
            if designated is None or math.dist(source.end, designated.start) > MAX_GAP:
                designated = None if slot in _OF_EGO_LANE else self._beside(slot, source, following)
            if designated is not None:
                found.append((slot, designated))
        return self._cross_section(tuple(found))

    def _beside(self, slot: Slot, source: Source, following: Key) -> Source | None:
        """Return the line of a successor of a lane that continues its line beside the next lane.

        Another lane has opened between, or the lanes beside each other have no common road in a
        junction.

        Args:
            slot: of the line.
            source: the line.
            following: lane ahead that the car drives on.
        """
        for key in self.graph[source.key].successors:
            other = self._source(key, source.side)
            if math.dist(source.end, other.start) > MAX_GAP:
                continue
            if key in self.graph.row(following):
                if slot not in _EDGES:  # an edge ends where a lane opens beyond it
                    return other
            elif _leads_beside(other.line, self.graph[following], source.side):
                return other
        return None


def _leads_beside(line: Polyline, lane: DrivenLane, side: str) -> bool:
    """Return whether a line ends on one side of a lane and in about its direction."""
    boundary = lane.left if side == "left" else lane.right
    (place,) = locate([boundary], line.points[-1])
    (x0, y0), (x1, y1) = line.points[-2:].tolist()
    turn = wrapped(math.atan2(y1 - y0, x1 - x0) - place.direction)
    outward = place.t if side == "left" else -place.t
    return outward > -MAX_GAP and abs(turn) < PARALLEL


def _visible(line: Polyline, start: float, end: float) -> Polyline:
    """Return a line without what no car beside a part of it can see, as it turns too far.

    So a line that returns, as that of a loop does, does not come near the car again.

    Args:
        line: the line.
        start: arc length of the start of the part [m].
        end: arc length of its end [m].
    """
    if not _turns(line, start, end):
        return line
    s = np.linspace(0.0, line.length, max(1, math.ceil(line.length / CHORD)) + 1)
    x, y = (np.interp(s, line.distance, values) for values in line.points.T)
    chord = np.diff(x + 1j * y)
    chord /= np.maximum(np.abs(chord), 1e-12)
    first, last = (s[1:-1].searchsorted(at) for at in (start, end))
    ahead = (chord[last:] * chord[last].conj()).real < LEAST_COSINE
    behind = (chord[first::-1] * chord[first].conj()).real < LEAST_COSINE
    if not (ahead.any() or behind.any()):
        return line
    low = s[first - behind.argmax() + 1] if behind.any() else 0.0
    high = s[last + ahead.argmax()] if ahead.any() else line.length
    rows = line.distance.searchsorted([min(low, start), max(high, end)])
    return Polyline(line.points[rows[0] : rows[1] + 1], line.kind)


def _turns(line: Polyline, start: float, end: float) -> bool:
    """Return whether a step of a line may turn too far from the part: quickly, and too often."""
    step = line.points[1:] - line.points[:-1]
    length = line.distance[1:] - line.distance[:-1]
    k0, k1 = line.distance[1:-1].searchsorted([start + CHORD / 2, end - CHORD / 2])
    for k, part in ((k1, slice(k1, None)), (k0, slice(None, k0 + 1))):
        advance = step[part] @ step[k]
        if (advance < (LEAST_COSINE + MARGIN) * length[k] * length[part]).any():
            return True
    return False


def _route_line(route: Route, index: int) -> Polyline:
    """Return the line of a route around one of its lanes."""
    near = route.around(index, BEHIND, AHEAD)
    begin = route.starts[near.start]
    end = route.starts[near.stop] if near.stop < len(route.starts) else math.inf
    distance = route.line.distance
    rows = slice(int(distance.searchsorted(begin)), int(distance.searchsorted(end, "right")))
    line = Polyline(route.line.points[rows], route.line.kind)
    start, length = route.extent(index)
    return _visible(line, start - begin, start - begin + length)


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
