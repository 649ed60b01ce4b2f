"""Maps: lanes with their boundary lines, from files of several formats.

It may import ``values`` and ``propagation``.
"""

from ..values.errors import MapFileError
from .formats.load import load
from .matching import LaneMatch
from .road_map import Landmark, LandmarkKind, Lane, LaneType, Map, Road, Skipped
from .routing import LaneChange, Route
from .tour import random_tour, town_path, town_tour
from .tracking import LaneTracker, TrackedLines
from .view import link_gaps

__all__ = [
    "Landmark",
    "LandmarkKind",
    "Lane",
    "LaneChange",
    "LaneMatch",
    "LaneTracker",
    "LaneType",
    "Map",
    "MapFileError",
    "Road",
    "Route",
    "Skipped",
    "TrackedLines",
    "link_gaps",
    "load",
    "random_tour",
    "town_path",
    "town_tour",
]
