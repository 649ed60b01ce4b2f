"""Long routes: through a map, chosen at random, and through the town that the package contains."""

from __future__ import annotations

from itertools import pairwise
from operator import itemgetter
from pathlib import Path

import numpy as np

from ..values.errors import RouteError
from .lane_graph import DirectedLane
from .road_map import Map
from .routing import Route, route_through, ways_from

#: Starts that are compared.
STARTS = 32
#: Most places of a tour, and most of them that are given up.
MAX_PLACES, MAX_DEAD_ENDS = 1000, 12
#: Shortest lane change of a tour [m].
LEAST_CHANGE = 30.0
#: Largest gap between two lanes of a tour [m]; a link over a greater one is an error of the map.
MAX_GAP = 1.0


def random_tour(road_map: Map, length: float = 10_000.0, seed: int = 0) -> Route:
    """Return a route through places drawn at random, until it has a length.

    Each place is one that can be reached from the one before, and a lane change is made only on
    the way to it: where the lane does not lead there. A place is reached when the car enters any
    of the lanes beside each other there. The tour is shorter if the road ends. Of several starts
    drawn at random, the one with the longest tour is taken.

    Args:
        road_map: the map.
        length: that the route shall have at least [m].
        seed: of the random numbers.

    Raises:
        RouteError: the map has no lane to drive on.
    """
    lanes = [
        lane.id for lane in road_map.lanes.values() if lane.type.is_drivable and lane.length > 0
    ]
    if not lanes:
        raise RouteError(f"the map {road_map.name!r} has no lane to drive on")
    rng = np.random.default_rng(seed)
    best: Route | None = None
    for _ in range(STARTS):
        tour = tour_from(road_map, lanes[rng.integers(len(lanes))], length, rng)
        if best is None or tour.length > best.length:
            best = tour
        if best.length >= length:
            break
    assert best is not None  # noqa: S101 - there is a start at least
    return best


def tour_from(road_map: Map, start: str, length: float, rng: np.random.Generator) -> Route:
    """Return a tour from a lane on. Where it cannot go on, another place is drawn."""
    lanes = road_map.lanes
    places = [(lanes[start].length, [start])]  # length and lanes up to each
    longest, dead_ends = places[0], 0
    for _ in range(MAX_PLACES):
        driven, path = places[-1]
        ahead = [
            (state, way)
            for state, way in ways_from(lanes, path[-1], 0.0, LEAST_CHANGE, MAX_GAP)
            if not state.is_beside_start
        ]
        if ahead:
            goal, _ = ahead[rng.integers(len(ahead))]
            row = road_map.view.graph.row(DirectedLane(goal.lane))
            leg = next(way for state, way in ahead if DirectedLane(state.lane) in row)()
            driven += sum(lanes[b].length for a, b in pairwise(leg) if b in lanes[a].successors)
            places.append((driven, path + leg[1:]))
            longest = max(longest, places[-1], key=itemgetter(0))
        else:
            places.pop()
            dead_ends += 1
        if longest[0] >= length or not places or dead_ends > MAX_DEAD_ENDS:
            break
    _, path = longest
    return route_through(lanes, path, 0.0, lanes[path[-1]].length)


#: Lanes that a tour passes. It returns to the first one.
#: Main Street, East Street, roundabout, West Street, Valley Road, Station Street, Access Road,
#: motorway with the lane that ends, and back by the other direction of the streets.
STOPS = (
    *("15:0:-1", "14:0:1", "13:0:-1", "16:0:1", "12:0:1", "11:0:1"),
    *("6:0:-1", "4:2:-4", "5:0:-1"),
    *("12:0:-1", "15:0:1", "13:0:1", "14:0:-1", "13:0:-1", "442:0:-1"),
)


def town_path() -> Path:
    """Return the path of the map: OpenDRIVE, written by ``tools/make_town.py``."""
    return Path(__file__).with_name("town.xodr")


def town_tour(town: Map, rounds: int = 1) -> Route:
    """Return a route through all of the town and around the motorway.

    Args:
        town: the map at ``town_path()``.
        rounds: number of times that the route goes round.

    Raises:
        ValueError: ``rounds`` is less than 1.
        RouteError: it is another map.
    """
    if rounds < 1:
        raise ValueError(f"rounds must be 1 or more, got {rounds!r}")
    first, *others, last = STOPS
    return town.route(first, last, via=[*others, *(last, *STOPS[:-1]) * (rounds - 1)])
