"""Maps on which evidence is taken: maps of others, and random roads as maps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from evidence_maps import files_of
from random_roads import ROADS, random_map

from maplines_can import MapFileError, maps

#: Name of a map, and a function that returns it for a seed.
Source = tuple[str, Callable[[int], maps.Map]]


def sources_of(paths: list[str], *roads: tuple[str, maps.Map]) -> list[Source]:
    """Return the maps with drivable lanes in folders and files, given roads, and random ones.

    Raises:
        FileNotFoundError: there is no such file or folder.
    """
    found: list[tuple[str, maps.Map]] = []
    for path in files_of(paths):
        try:
            road_map = maps.load(path)
        except (MapFileError, OSError):
            continue
        if any(lane.type.is_drivable for lane in road_map.lanes.values()):
            found.append((path.name, road_map))
    fixed: list[Source] = [(name, partial(_same, one)) for name, one in [*found, *roads]]
    return fixed + [(f"random: {x}", partial(random_map, x)) for x in ROADS]


def route_of(road_map: maps.Map, length: float, seed: int) -> maps.Route:
    """Return the route along the only lane of a map, or a random one of a length [m]."""
    if len(road_map.lanes) == 1:
        return road_map.route("1", "1")
    return maps.random_tour(road_map, length, seed)


def _same(road_map: maps.Map, _: int) -> maps.Map:
    return road_map
