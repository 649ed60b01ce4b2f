"""The map that the package contains: a small town, and a motorway around it."""

from __future__ import annotations

from pathlib import Path

from .model import Map
from .routing import Route

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
