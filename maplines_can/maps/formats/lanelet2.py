"""Reader of Lanelet2 maps by the library ``lanelet2``, of which this is the only use.

``load`` uses ``maps.osm`` instead, whose map is the same to 1 um: this library ignores ``local_x``
and ``local_y`` and takes positions that are missing for 0.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ...values.errors import MapFileError, missing_extra
from ..model import Map, Skipped
from .lanelet_tags import RawLanelet, Side, lanelets
from .lanelets import lanelet_map, linked


def read(path: str | os.PathLike[str], projection: str) -> Map:
    """Read a map by the library.

    Args:
        path: of an OSM file that is not compressed.
        projection: PROJ string of a UTM zone or of a tangent plane, as ``maps.projection.utm`` and
            ``maps.projection.local_cartesian`` return it.

    Raises:
        MissingExtraError: the library is not installed.
        MapFileError: the library cannot read the file, or there is no usable lanelet in it.
        ValueError: the projection is another one.
    """
    try:
        import lanelet2
    except ImportError as error:
        raise missing_extra("the library of Lanelet2 is the package lanelet2", "maps") from error
    path = Path(path)
    projector = _projector(lanelet2, projection)
    try:
        found, errors = lanelet2.io.loadRobust(os.fspath(path), projector)
    except RuntimeError as error:
        raise MapFileError(f"{path.name} cannot be read: {error}") from None
    skipped = [Skipped(path.name, line.strip(" \t-")) for line in errors[1:]]
    lanes = linked(lanelets(_raw(found), skipped))
    return lanelet_map(lanes, path.name, skipped, projection)


def _projector(lanelet2: Any, projection: str) -> Any:
    """Return the projector of the library."""
    given = dict(re.findall(r"\+(\w+)=([^\s+]+)", projection.rpartition("+step")[2]))
    if given.get("proj") == "utm":
        is_south = "+south" in projection
        latitude, longitude = -1.0 if is_south else 1.0, 6.0 * float(given["zone"]) - 183.0
        origin = lanelet2.io.Origin(latitude, longitude)
        return lanelet2.projection.UtmProjector(origin, False, False)
    if given.get("proj") == "topocentric":
        origin = lanelet2.io.Origin(*(float(given[name]) for name in ("lat_0", "lon_0", "h_0")))
        return lanelet2.projection.LocalCartesianProjector(origin)
    raise ValueError(
        "projection must be +proj=utm or +proj=topocentric for the library, "
        f"got {projection[:80]!r}"
    )


def _raw(found: Any) -> Iterator[RawLanelet]:
    for lanelet in sorted(found.laneletLayer, key=lambda one: one.id):
        tags = dict(lanelet.attributes.items())
        sides = [_side(line) for line in (lanelet.leftBound, lanelet.rightBound)]
        yield RawLanelet(str(lanelet.id), f"lanelet {lanelet.id}", tags, *sides)


def _side(line: Any) -> Side:
    nodes = tuple(str(point.id) for point in line)
    points = np.array([(point.x, point.y) for point in line]).reshape(-1, 2)
    return Side(nodes, points, dict(line.attributes.items()))
