"""Tracking of a car from lane to lane, so that each line of the map keeps its slot."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.arrays import floats
from ..values.line import Slot
from ..values.polyline import Polyline
from .lane_graph import DirectedLane
from .matching import LaneMatch
from .road_map import Map
from .routing import Route
from .view import Surroundings

#: Distance beyond the boundary of its lane at which a car has changed lanes [m].
MARGIN = 0.3
#: Distance that a car drives beyond the boundary, by whatever little, before it has changed
#: lanes [m].
PATIENCE = 10.0
#: Distance in which the car finds the lanes ahead that it may be on next [m].
LOOKAHEAD = 60.0
#: Distance behind the lane in which it may have taken another branch [m].
BRANCH = 30.0
#: Lanes behind the car that it remembers.
MAX_BEHIND = 16


@dataclass(frozen=True, eq=False, slots=True)
class TrackedLines:
    """Lines around a car in one cycle.

    Args:
        lines: by slot.
        match: the car in the coordinates of its lane; None off the map.
        lane_changed: whether the car has another lane than in the cycle before, and this lane is
            no continuation of that one. Then all slots are those of the new lane.
        changed: slots that have another physical line than in the cycle before. Without a lane
            change, they are new, or the map has opened or closed a lane there.
    """

    lines: Mapping[Slot, Polyline]
    match: LaneMatch | None
    lane_changed: bool = False
    changed: frozenset[Slot] = frozenset()

    @property
    def lane(self) -> str | None:
        """Id of the lane that the car is on; None off the map."""
        return None if self.match is None else self.match.lane


@dataclass(frozen=True, eq=False, slots=True)
class _Track:
    """The lane of a car, and the lanes that continue it.

    Args:
        key: the lane.
        around: its lines.
        lines: these, and that of the route.
        followed: lanes that the car may be on next without a lane change.
        behind: lanes that it has driven on, as driven backward, from the last one on.
    """

    key: DirectedLane
    around: Surroundings
    lines: Mapping[Slot, Polyline]
    followed: frozenset[DirectedLane]
    behind: tuple[DirectedLane, ...]


class LaneTracker:
    """State of a car on a map, which keeps its lane until it changes lanes.

    The car changes lanes when it is more than 0.3 m beyond the boundary of its lane, or has been
    beyond it for 10 m. Until then, and where lanes overlap, it remains on its lane and on those
    that continue it. ::

        lane 2                          .------------
               - - - - - - - - - - - - / - - - - - -   boundary
               . . . . . . . . . . . / . . . . . . .   0.3 m to either side of it
        lane 1 ---------------------'

    Where a lane has several successors, the car is expected on that of the route, or else on the
    straightest. It takes another one as soon as its direction or position shows it; then the lines
    around it are other ones, which counts as a lane change, too.

    Args:
        road_map: the map.
        route: that the car follows.
    """

    def __init__(self, road_map: Map, route: Route | None = None) -> None:
        self._map, self._route = road_map, route
        self._track: _Track | None = None
        self._crossing: tuple[float, float] | None = None  # where it left its lane
        self._progress = 0  # index of the last lane of the route

    def lines(self, pose: ArrayLike) -> TrackedLines:
        """Return the lines around the car at its next pose: see ``Map.lines``.

        Args:
            pose: (3,) e_x [m], e_y [m], e_h [rad] of the car in the map frame.

        Raises:
            ValueError: ``pose`` is not finite or not of shape (3,).
        """
        last = self._track
        match = self._choose(floats(pose, "pose"))
        if match is None:
            return self.lose()
        key = DirectedLane(match.lane, match.is_against)
        track = last if last and key == last.key else self._entered(key, last)
        lines = self._map.view.beside(match.s, track.around, track.lines)
        if track is last:
            return TrackedLines(lines, match)
        self._track = track
        if last is None:
            return TrackedLines(lines, match, changed=frozenset(lines))
        changed = frozenset(
            slot
            for slot in last.lines.keys() | track.lines.keys()
            if not _is_continued(slot, last, track)
        )
        lane_changed = {Slot.EGO_LEFT, Slot.EGO_RIGHT} <= changed
        return TrackedLines(lines, match, lane_changed, changed)

    def lose(self) -> TrackedLines:
        """Return the lines of a car that is off the map, or does not know its pose: no lines."""
        last, self._track = self._track, None
        gone = frozenset(last.lines if last else ())
        return TrackedLines({}, None, lane_changed=last is not None, changed=gone)

    def _choose(self, pose: NDArray[np.float64]) -> LaneMatch | None:
        """Return the match that the car has now."""
        index, track = self._map.index, self._track
        if track is None:
            return index.match(pose, self._route.lane_set if self._route else frozenset())
        near = {DirectedLane(match.lane, match.is_against): match for match in index.near(pose)}
        followed = [key for key in near if key in track.followed]
        best = min(near.values(), key=index.cost, default=None)
        if best is None or not followed:
            return best

        def cost(key: DirectedLane) -> float:
            return index.cost(near[key]) - (MARGIN if key in track.around.lanes else 0.0)

        stay = near[min(followed, key=cost)]
        if stay.outside <= best.outside:
            self._crossing = None
            return stay
        x, y, _ = pose.tolist()
        self._crossing = self._crossing or (x, y)
        is_patient = math.dist(self._crossing, (x, y)) < PATIENCE
        return stay if stay.outside <= MARGIN and is_patient else best

    def _entered(self, key: DirectedLane, last: _Track | None) -> _Track:
        """Return the track from a lane on."""
        view, route = self._map.view, self._route
        index = None
        if route is not None:
            index = view.index(key, route, self._progress)
            index = view.index(key, route) if index is None else index  # it has turned back
            self._progress = self._progress if index is None else index
        behind, ahead = view.paths(route, index)
        if last is not None:
            driven = (last.key.back, *last.behind) if key in last.followed else last.behind
            behind = driven[:MAX_BEHIND]
        around = view.around(key, ahead, behind)
        self._crossing = None
        return _Track(
            key, around, view.with_route(around, route, index), self._followed(key, behind), behind
        )

    def _followed(
        self, key: DirectedLane, behind: tuple[DirectedLane, ...]
    ) -> frozenset[DirectedLane]:
        """Return the lane, and all that a car on it, or shortly behind it, may reach."""
        graph = self._map.view.graph
        origins = [key, *(other.back for other in graph.way(key.back, behind, BRANCH))]
        return frozenset(origins).union(*(graph.reachable(one, LOOKAHEAD) for one in origins))


def _is_continued(slot: Slot, last: _Track, track: _Track) -> bool:
    """Return whether the line of a slot is physically the same one."""
    if slot not in last.lines or slot not in track.lines:
        return False
    if slot is Slot.ROUTE:
        return True
    old, new = last.around, track.around
    return old.base[slot] in new.parts[slot] or new.base[slot] in old.parts[slot]
