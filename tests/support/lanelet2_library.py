"""Maps by the library ``lanelet2``: the witness of the reader of this package.

The library ignores ``local_x`` and ``local_y``, and takes positions that are missing for 0.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import lanelet2
import numpy as np

from maplines_can.maps import Map, Skipped
from maplines_can.maps.formats.lanelet_tags import RawLanelet, Side, lanelets
from maplines_can.maps.formats.lanelets import lanelet_map, linked


def read(path: Path, projection: str) -> Map:
    """Read a map, in the projection of a UTM zone or of a tangent plane as a PROJ string."""
    found, errors = lanelet2.io.loadRobust(str(path), _projector(projection))
    skipped = [Skipped(path.name, line.strip(" \t-")) for line in errors[1:]]
    return lanelet_map(linked(lanelets(_raw(found), skipped)), path.name, skipped, projection)


def _projector(projection: str) -> Any:
    given = dict(re.findall(r"\+(\w+)=([^\s+]+)", projection.rpartition("+step")[2]))
    if given["proj"] == "utm":
        is_south = "+south" in projection
        latitude, longitude = -1.0 if is_south else 1.0, 6.0 * float(given["zone"]) - 183.0
        origin = lanelet2.io.Origin(latitude, longitude)
        return lanelet2.projection.UtmProjector(origin, False, False)
    origin = lanelet2.io.Origin(*(float(given[name]) for name in ("lat_0", "lon_0", "h_0")))
    return lanelet2.projection.LocalCartesianProjector(origin)


def _raw(found: Any) -> Iterator[RawLanelet]:
    for lanelet in sorted(found.laneletLayer, key=lambda one: one.id):
        tags = dict(lanelet.attributes.items())
        sides = [_side(line) for line in (lanelet.leftBound, lanelet.rightBound)]
        yield RawLanelet(str(lanelet.id), f"lanelet {lanelet.id}", tags, *sides)


def _side(line: Any) -> Side:
    nodes = tuple(str(point.id) for point in line)
    points = np.array([(point.x, point.y) for point in line]).reshape(-1, 2)
    return Side(nodes, points, dict(line.attributes.items()))
