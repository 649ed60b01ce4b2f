"""Coordinate systems that map files name: their units, axes and scale, in metres of a plane.

A map is in metres. Positions of a system whose unit of length is one metre on the ground, up to
``MAX_DISTORTION``, remain as they are: those of UTM and of most national grids. Others, in degrees,
in feet or in the metres of a world map, are projected around the middle of the map.

UTM and transverse Mercator projections of WGS84 are known here. All other systems are looked up by
pyproj. A system has x to the east and y to the north, longitude before latitude, as the formats
have it, whatever the order of its own axes.
"""

from __future__ import annotations

import math
import re
import warnings
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...values.errors import missing_extra
from .projection import (
    FLATTENING,
    RADIUS,
    UTM_SCALE,
    around,
    parameters_of,
    project,
    utm_of,
)

Array = NDArray[np.float64]

#: Largest difference of lengths in a plane from those on the ground; that of UTM is 0.0004.
MAX_DISTORTION = 1e-3
#: How far positions may be from the area of use of their system [deg].
MARGIN_DEG = 10.0
#: Largest extent of a map; what is wider is not in degrees [deg].
MAX_SPAN_DEG = 30.0
#: Distance from its central meridian to which UTM is used [m].
UTM_REACH = 450e3
#: Largest coordinate that is looked at [m].
LARGEST = 1e9

#: Names of longitude and latitude of WGS84.
_WGS84 = re.compile(r"(.*\bEPSG\W*(?:[\d.]+\W+)?(4326|4979)|(.*\W)?CRS84h?|WGS ?84)", re.I)
#: Half of the side of the square in which the scale is measured, in units of a plane and [deg].
_STEP, _STEP_DEG = 100.0, 1e-3


class Placed(NamedTuple):
    """Positions in a metric plane.

    Args:
        points: (n, 2) [m]; not finite where there is no position.
        projection: PROJ string, WKT or code of the plane.
        notices: what is assumed or changed, in full sentences without a period.
    """

    points: Array
    projection: str
    notices: list[str]


def is_wgs84(name: str) -> bool:
    """Return whether a name is that of longitude and latitude of WGS84, with or without heights.

    >>> is_wgs84("urn:ogc:def:crs:OGC:1.3:CRS84"), is_wgs84("EPSG:4326"), is_wgs84("EPSG:4258")
    (True, True, False)
    """
    return _WGS84.fullmatch(name.strip()) is not None


def placed(name: str, points: Array, projection: str | None = None) -> Placed:
    """Return positions of a system in a metric plane.

    Args:
        name: of the system: PROJ string, WKT, or a code such as "EPSG:25832".
        points: (n, 2) x and y, in the units of the system.
        projection: of the plane, as of ``project``; by default that of the system, if it is metric,
            or one around the middle of the positions.

    Raises:
        ValueError: there is no such system, it has no plane coordinates, or the positions are not
            in it.
        MissingExtraError: the system is looked up, and pyproj is not installed.
    """
    if projection is None and (known := _known(name, points)) is not None:
        return Placed(points, name, known)
    system = _System(name)
    if not len(sample := _sample(points)):
        return Placed(points, name, [])
    if not system.holds(sample):
        exchanged = system.holds(sample[:, ::-1])
        if system.unit == 1 and projection is None and not exchanged:
            return Placed(points, name, [_outside(name)])
        order = "longitude before latitude" if system.is_geographic else "x (east) before y (north)"
        cure = f"write {order}" if exchanged else "name the system that they are in"
        raise ValueError(f"positions are not in the area of the system {name[:200]!r}; {cure}")
    scale, notices = system.scale(sample), system.shift(sample)
    if projection is None and np.abs(scale - 1).max() <= MAX_DISTORTION:
        return Placed(points, name, notices)
    longitude, latitude = system.to_wgs84(points)
    projection = projection or around(latitude, longitude)
    size = "" if system.is_geographic else f", {np.abs(scale[0]).mean():.5g} m on the ground"
    what = "longitude and latitude" if system.is_geographic else "x and y"
    how = f"positions are {what} of {name[:200]} [{system.unit_name}{size}]; they are projected"
    return Placed(project(projection, latitude, longitude), projection, [how, *notices])


def notices_of(name: str, points: Array) -> list[str]:
    """Return what is to be known of metric positions in a plane, as those of OpenDRIVE are.

    Args:
        name: of the system.
        points: (n, 2) in the plane [m].
    """
    if (known := _known(name, points)) is not None:
        return known
    try:
        system = _System(name)
    except ImportError:
        return [f"the scale of {name[:200]} is not known without pyproj (the extra maps)"]
    except ValueError as error:
        return [f"{error}; positions are taken as metres"]
    if system.is_geographic:
        return [f"{name[:200]} is in degrees, not a plane; positions are taken as metres"]
    notices = []
    if system.unit != 1:
        unit = f"the unit of {name[:200]} is the {system.unit_name}"
        notices.append(f"{unit}; positions are taken as metres")
    if not len(sample := _sample(points) / system.unit):
        return notices
    if not system.holds(sample):
        return [*notices, _outside(name)]
    scale = system.scale(sample) / system.unit
    if scale.min() < 0:
        notices.append(f"the axes of {name[:200]} are mirrored; x and y are taken as they are")
    elif np.abs(scale - 1).max() > MAX_DISTORTION:
        size = f"a metre of {name[:200]} is {np.abs(scale[0]).mean():.5g} m on the ground"
        notices.append(f"{size}; lengths and widths are taken as they are in the file")
    return [*notices, *system.shift(sample)]


def to_plane(name: str, latitude: ArrayLike, longitude: ArrayLike) -> Array:
    """Return (n, 2) positions of WGS84 [deg] in the plane of a system [m], not finite where none.

    Raises:
        ValueError: there is no such system, or it has no plane.
        MissingExtraError: pyproj is not installed.
    """
    given = parameters_of(name)
    if given is not None and given["proj"] == "topocentric":  # pyproj takes no pipeline for one
        return project(name, latitude, longitude)
    system = _System(name)
    if system.is_geographic:
        raise ValueError(f"projection {name!r} has no coordinates in metres; use a projected one")
    return system.from_wgs84(np.asarray(longitude, float), np.asarray(latitude, float))


class _System:
    """A coordinate system with x to the east and y to the north."""

    def __init__(self, name: str) -> None:
        if name.startswith("+") and "+proj=" not in name and "+init=" not in name:
            # As CARLA writes it. pyproj would look for a similar name, for a quarter of a second.
            raise ValueError(f"projection {name[:200]!r} is not valid: it has no +proj")
        try:
            import pyproj
        except ImportError as error:
            what = f"positions of the system {name[:200]!r} need pyproj"
            raise missing_extra(what, "maps") from error
        try:
            crs = pyproj.CRS.from_user_input(name).to_2d()
            if not (crs.is_geographic or crs.is_projected):
                raise ValueError(
                    f"projection {name[:200]!r} is not valid: it has no coordinates in a plane"
                )
            self._transformer = pyproj.Transformer.from_crs(crs, "EPSG:4326", always_xy=True)
        except pyproj.exceptions.ProjError as error:
            reason = " ".join(str(error).split())
            raise ValueError(f"projection {name[:200]!r} is not valid: {reason[:200]}") from error
        self.name, self._crs = name[:200], crs
        self.is_geographic = bool(crs.is_geographic)
        self.unit_name = str(crs.axis_info[0].unit_name)
        self.unit = 0.0 if self.is_geographic else float(crs.axis_info[0].unit_conversion_factor)

    def to_wgs84(self, points: Array) -> tuple[Array, Array]:
        """Return (n,) longitudes and (n,) latitudes [deg] of (n, 2) positions."""
        longitude, latitude = self._transformer.transform(*points.T)
        return np.asarray(longitude), np.asarray(latitude)

    def from_wgs84(self, longitude: Array, latitude: Array) -> Array:
        """Return (n, 2) positions in the plane [m]."""
        x, y = self._transformer.transform(longitude, latitude, direction="INVERSE")
        return np.column_stack([x, y]) * self.unit

    def holds(self, points: Array) -> bool:
        """Return whether positions are in the area in which the system is used, or near it."""
        longitude, latitude = self.to_wgs84(points)
        is_wide = self.is_geographic and np.ptp(points, axis=0).max() > MAX_SPAN_DEG
        if is_wide or not np.isfinite([longitude, latitude]).all():
            return False
        code = None if self._crs.area_of_use else self._crs.to_epsg()
        area = (type(self._crs).from_epsg(code) if code else self._crs).area_of_use
        if area is None:
            return True
        width = (area.east - area.west) % 360 or 360.0
        is_across = (longitude - area.west + MARGIN_DEG) % 360 <= width + 2 * MARGIN_DEG
        is_along = np.abs(latitude - (area.south + area.north) / 2) <= (
            (area.north - area.south) / 2 + MARGIN_DEG
        )
        return bool((is_across & is_along).all())

    def scale(self, points: Array) -> Array:
        """Return (n, 2) largest and least length on the ground of one unit [m].

        The largest is negative if the axes are mirrored.
        """
        step = _STEP_DEG if self.is_geographic else _STEP
        offsets = step * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
        longitude, latitude = np.radians(
            self.to_wgs84((points[:, None] + offsets).reshape(-1, 2))
        ).reshape(2, -1, 4)
        e2 = FLATTENING * (2 - FLATTENING)
        w2 = 1 - e2 * np.sin(latitude.mean(axis=1)) ** 2
        north = RADIUS * (1 - e2) / w2**1.5 * latitude.T
        turns = (longitude - longitude[:, :1] + math.pi) % (2 * math.pi)
        east = RADIUS / np.sqrt(w2) * np.cos(latitude.mean(axis=1)) * turns.T
        ground = np.stack([east, north])  # (2, 4, n)
        jacobian = np.moveaxis(ground[:, ::2] - ground[:, 1::2], 2, 0) / (2 * step)
        found = np.linalg.svd(jacobian, compute_uv=False)
        found[:, 0] *= np.sign(np.linalg.det(jacobian))
        return found

    def shift(self, points: Array) -> list[str]:
        """Return what is wrong with the shift between the datum of the system and WGS84."""
        from pyproj.transformer import AreaOfInterest, TransformerGroup

        longitude, latitude = (float(v[0]) for v in self.to_wgs84(points[:1]))
        area = AreaOfInterest(longitude - 0.01, latitude - 0.01, longitude + 0.01, latitude + 0.01)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that the best shift is not there, as is said here
            group = TransformerGroup(self._crs, "EPSG:4326", always_xy=True, area_of_interest=area)
        used: Any = group.transformers[0] if group.transformers else self._transformer
        lost = [grid.short_name.lstrip("@") for one in used.operations or () for grid in one.grids
                if not grid.available]  # fmt: skip
        accuracy = used.accuracy if used.accuracy >= 0 else math.inf
        better = [one for one in group.unavailable_operations if 0 <= one.accuracy < accuracy]
        if lost or (used.accuracy < 0 and "Ballpark" in used.description and not self._is_grs80):
            why = f"the grid {', '.join(lost)} is not installed" if lost else "its datum is unknown"
            return [
                f"positions of {self.name} are not shifted to the datum of WGS84, as {why}: "
                "latitude and longitude may be wrong by some 100 m"
            ]
        if better and not group.best_available:
            best = min(better, key=lambda one: one.accuracy)
            grids = ", ".join(grid.short_name for grid in best.grids if not grid.available)
            return [
                f"the shift between {self.name} and WGS84 is right to {accuracy:g} m, instead "
                f"of {best.accuracy:g} m, as the grid {grids} is not installed"
            ]
        return []

    @property
    def _is_grs80(self) -> bool:
        """Whether the ellipsoid is that of WGS84, up to 0.1 mm."""
        ellipsoid = self._crs.ellipsoid
        return ellipsoid is not None and abs(ellipsoid.semi_major_metre - RADIUS) < 1


def _known(name: str, points: Array) -> list[str] | None:
    """Return what is to be known of positions in a plane of ``projection``, without pyproj.

    It is None if the system is not one of these, or has another scale at the positions.
    """
    given = parameters_of(utm_of(name) or name)
    sample = _sample(points)
    try:
        if given is None:
            return None
        if given["proj"] == "topocentric":
            return []
        if given["proj"] == "utm" and float(given.get("zone", "0")) not in range(1, 61):
            return None
        k, x_0 = float(given.get("k", given.get("k_0", "1"))), float(given.get("x_0", "0"))
        if given["proj"] == "utm":
            k, x_0 = UTM_SCALE, 500e3
            if (np.abs(sample[:, 0] - x_0) > UTM_REACH).any():
                return [_outside(name)]
        scale = k * np.cosh((sample[:, 0] - x_0) / (k * RADIUS))
    except (ValueError, ZeroDivisionError):
        return None
    return [] if np.abs(scale - 1).max(initial=0.0) <= MAX_DISTORTION else None


def _sample(points: Array) -> Array:
    """Return (5, 2) the middle of the extent of positions, and its corners; (0, 2) of none."""
    usable = points[(np.abs(points) <= LARGEST).all(axis=1)]  # false for NaN
    if not len(usable):
        return np.empty((0, 2))
    (x0, y0), (x1, y1) = usable.min(axis=0), usable.max(axis=0)
    return np.array([[(x0 + x1) / 2, (y0 + y1) / 2], [x0, y0], [x1, y0], [x0, y1], [x1, y1]])


def _outside(name: str) -> str:
    return (
        f"positions are not in the area of {name[:200]}; they are taken as metres, and latitude "
        "and longitude have no place among them"
    )
