"""A long route through a map, chosen at random."""

from __future__ import annotations

import numpy as np

from ..values.errors import RouteError
from .model import Map
from .routing import Route

#: Starts that are compared, and goals in a row without a route after which a tour ends.
STARTS, FAILURES = 8, 12


def random_tour(road_map: Map, length: float = 10_000.0, seed: int = 0) -> Route:
    """Return a route from lane to lane, each drawn at random, until it has a length.

    It is shorter if no further lane can be reached. Of several starts drawn at random, the one
    with the longest tour is taken.

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
        tour = tour_from(road_map, lanes[rng.integers(len(lanes))], lanes, length, rng)
        if best is None or tour.length > best.length:
            best = tour
        if best.length >= length:
            break
    assert best is not None  # noqa: S101 - there is a start at least
    return best


def tour_from(
    road_map: Map, start: str, lanes: list[str], length: float, rng: np.random.Generator
) -> Route:
    """Return a tour from a lane on."""
    stops, failures = [start], 0
    driven = 0.0
    while driven < length and failures < FAILURES:
        goal = lanes[rng.integers(len(lanes))]
        try:
            leg = road_map.route(stops[-1], goal)
        except RouteError:
            failures += 1
            continue
        if goal == stops[-1]:
            failures += 1
            continue
        failures = 0
        stops.append(goal)
        driven += leg.length
    return road_map.route(stops[0], stops[-1], via=stops[1:-1])
