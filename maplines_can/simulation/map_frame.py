"""Positions in the frame of a map: projection from WGS84, and a check that they are on the map."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..maps.formats.coordinate_systems import to_plane
from ..values.arrays import floats
from ..values.errors import DriveFileError
from ..values.polyline import Polyline

#: Step to the north at which the direction of north in the map frame is taken [deg]; about 1 m.
_NORTH_STEP_DEG = 1e-5
#: Farthest from the extent of a map that a position counts as on the map [m].
MARGIN = 100.0


def project(lat_deg: ArrayLike, lon_deg: ArrayLike, projection: str | None) -> NDArray[np.float64]:
    """Return (n, 2) positions in the map frame [m] for (n,) latitudes and longitudes of WGS84.

    Args:
        lat_deg: (n,) positive to the north [deg].
        lon_deg: (n,) positive to the east [deg].
        projection: of the map: PROJ string, WKT, or a code such as "EPSG:25832".

    Raises:
        DriveFileError: there is no projection, it is not valid, it is none to a plane, or a
            position is outside its domain.
        MissingExtraError: pyproj is not installed.
    """
    lat, lon = floats(lat_deg, "lat_deg"), floats(lon_deg, "lon_deg")
    wrong = ~((np.abs(lat) <= 90) & (np.abs(lon) <= 360))
    if wrong.any():
        i = int(wrong.argmax())
        raise DriveFileError(
            "lat_deg must be from -90 to 90 deg and lon_deg from -360 to 360 deg, "
            f"got {lat[i]:g} and {lon[i]:g}"
        )
    if not projection:
        raise DriveFileError(
            "the map has no projection, so latitude and longitude have no position on it; "
            "give the positions as x and y in the frame of the map"
        )
    try:
        points = to_plane(projection, lat, lon)
    except ValueError as error:
        raise DriveFileError(str(error)) from error
    if not np.isfinite(points).all():
        i = int((~np.isfinite(points).all(axis=1)).argmax())
        raise DriveFileError(
            f"latitude {lat[i]:g} deg, longitude {lon[i]:g} deg has no position in the projection "
            f"{projection!r} of the map; use a map of the region of the drive"
        )
    return points


def north(
    lat_deg: NDArray[np.float64], lon_deg: NDArray[np.float64], projection: str | None
) -> NDArray[np.float64]:
    """Return the (n,) directions of true north in the map frame [rad]; raises as ``project``.

    It differs from the direction of the y axis by the meridian convergence.
    """
    step = np.where(lat_deg < 0, _NORTH_STEP_DEG, -_NORTH_STEP_DEG)
    there = project(lat_deg + step, lon_deg, projection)
    dx, dy = ((there - project(lat_deg, lon_deg, projection)) * np.sign(step)[:, None]).T
    return np.arctan2(dy, dx)


def check_on_map(
    positions: ArrayLike,
    lines: Iterable[Polyline],
    projection: str | None = None,
    source: str = "the drive",
) -> float:
    """Return the share of positions within the extent of a map, with 100 m of margin.

    Args:
        positions: (n, 2) [m].
        lines: of the map, such as the centre lines of its lanes.
        projection: of the map, for the message.
        source: of the positions, for the message.

    Raises:
        DriveFileError: no position is within the extent. They are probably in another
            projection, in degrees, or have x and y exchanged; the message tells which.
        ValueError: a shape is wrong, or there are no positions or no lines.

    >>> road = Polyline([[0, 0], [900, 0]])
    >>> check_on_map([[10, 2], [20, 2]], [road])
    1.0
    >>> check_on_map([[8.6, 49.9], [8.7, 49.9]], [Polyline([[477000, 5529000], [478000, 5529000]])])
    Traceback (most recent call last):
    ...
    maplines_can.values.errors.DriveFileError: the drive: no position is on the map: x is 8.6 to
    8.7 m and y is 49.9 to 49.9 m, but the map has x from 477000 to 478000 m and y from 5529000 to
    5529000 m; they look like degrees: name the columns lat_deg and lon_deg
    """
    points = floats(positions, "positions")
    extents = np.array([(p.min(axis=0), p.max(axis=0)) for p in (line.points for line in lines)])
    if points.ndim != 2 or points.shape[1] != 2 or not len(points) or not len(extents):
        raise ValueError(
            f"positions must have shape (n, 2) with n >= 1, got {points.shape}, "
            f"and lines must be one or more, got {len(extents)}"
        )
    low, high = extents[:, 0].min(axis=0) - MARGIN, extents[:, 1].max(axis=0) + MARGIN

    def share(points: NDArray[np.float64]) -> float:
        return float(((points >= low) & (points <= high)).all(axis=1).mean())

    if inside := share(points):
        return inside
    (x0, y0), (x1, y1) = points.min(axis=0), points.max(axis=0)
    if np.abs(points).max() <= 360:
        cure = "they look like degrees: name the columns lat_deg and lon_deg"
    elif share(points[:, ::-1]):
        cure = "x and y are exchanged: x is to the east and y to the north"
    else:
        cure = (
            "they are in another projection, or of another region: give lat_deg and lon_deg, or x "
            f"and y in the projection of the map ({projection or 'which it does not state'})"
        )
    low, high = low + MARGIN, high - MARGIN
    raise DriveFileError(
        f"{source}: no position is on the map: x is {x0:.7g} to {x1:.7g} m and y is {y0:.7g} to "
        f"{y1:.7g} m, but the map has x from {low[0]:.7g} to {high[0]:.7g} m and y from "
        f"{low[1]:.7g} to {high[1]:.7g} m; {cure}"
    )
