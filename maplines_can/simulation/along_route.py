"""Simulated drive along a route of a map, as fast as the lanes permit."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..maps import Map, Route
from ..values.polyline import Polyline
from .trajectory import SimulatedDrive

#: Speed on lanes without a speed limit [m/s].
DEFAULT_SPEED = 50 / 3.6
#: The drive ends where the rest of the route is shorter than this [m].
MIN_LENGTH = 1.0


def drive_along(
    road_map: Map, route: Route, default_speed: float = DEFAULT_SPEED, **limits: Any
) -> SimulatedDrive:
    """Return the drive along a route, from its start to its goal.

    Args:
        road_map: the map of the route.
        route: that the car follows.
        default_speed: limit on lanes of which the map states none [m/s].
        **limits: further arguments of ``SimulatedDrive``.

    Raises:
        ValueError: the route is shorter than 1 m, or a limit is out of range.
    """
    start, goal = route.start, min(route.goal, route.line.length)
    if goal - start < MIN_LENGTH:
        raise ValueError(
            f"the route from lane {route.lanes[0]!r} to lane {route.lanes[-1]!r} has a length of "
            f"{goal - start:.3g} m; choose a goal that is 1 m or more ahead of the start"
        )
    distance = route.line.distance
    inside = (distance > start) & (distance < goal)
    s = np.concatenate([[start], distance[inside], [goal]])
    path = np.column_stack([np.interp(s, distance, values) for values in route.line.points.T])
    lanes = [road_map.lanes[lane] for lane in route.lanes]
    speeds = [lane.speed_limit or default_speed for lane in lanes]
    # Of lanes beside each other, the last one counts; those before the start do not.
    by_start = dict(zip((max(0.0, at - start) for at in route.starts), speeds, strict=True))
    pairs = [(at, speed) for at, speed in by_start.items() if at < goal - start]
    return SimulatedDrive(Polyline(path), pairs, **limits)
