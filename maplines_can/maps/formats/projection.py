"""Projection of WGS84 positions to the plane of a map, for the projections that maps use most.

A projection is a PROJ string, as pyproj takes it. These are evaluated here, without pyproj:

- ``+proj=utm +zone=32``, with ``+south`` in the southern hemisphere;
- ``+proj=tmerc`` with ``+lat_0``, ``+lon_0``, ``+k``, ``+x_0`` and ``+y_0``;
- ``+proj=topocentric`` with ``+lat_0``, ``+lon_0`` and ``+h_0``, alone or as the last step of the
  pipeline that ``local_cartesian`` returns: x east and y north in the plane tangent to the
  ellipsoid.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Semi-major axis of WGS84 [m].
RADIUS = 6378137.0
#: Flattening of WGS84.
FLATTENING = 1 / 298.257223563
#: Scale of UTM on its central meridian.
UTM_SCALE = 0.9996
#: Latitudes of UTM [deg].
UTM_LATITUDES = (-80.0, 84.0)

#: Projections of this module, and parameters that it knows. GRS80 is WGS84 up to 0.1 mm.
_PROJECTIONS = ("tmerc", "topocentric", "utm")
_PLANE = ("proj", "zone", "south", "lat_0", "lon_0", "h_0", "k", "k_0", "x_0", "y_0")
_OTHERS = ("datum", "ellps", "units", "geoidgrids", "no_defs", "type", "vunits", "wktext")
_PARAMETERS = frozenset(_PLANE + _OTHERS)
_UTM = re.compile(r".*\bEPSG\W*(?:[\d.]+\W+)?(326|327|258)(0[1-9]|[1-5]\d|60)", re.I)

_E2 = FLATTENING * (2 - FLATTENING)
_N = FLATTENING / (2 - FLATTENING)
#: Radius of a circle with the circumference of a meridian [m].
_RECTIFYING = RADIUS / (1 + _N) * (1 + _N**2 / 4 + _N**4 / 64 + _N**6 / 256)
#: Krueger's series in the third flattening to order 6: Karney, Transverse Mercator with an accuracy
#: of a few nanometers, J. Geodesy 85 (2011), eq. (35). Row j has the coefficients of n^j, n^(j+1)..
_ALPHA = tuple(
    sum(c * _N ** (j + i) for i, c in enumerate(row))
    for j, row in enumerate(
        (
            (1 / 2, -2 / 3, 5 / 16, 41 / 180, -127 / 288, 7891 / 37800),
            (13 / 48, -3 / 5, 557 / 1440, 281 / 630, -1983433 / 1935360),
            (61 / 240, -103 / 140, 15061 / 26880, 167603 / 181440),
            (49561 / 161280, -179 / 168, 6601661 / 7257600),
            (34729 / 80640, -3418889 / 1995840),
            (212378941 / 319334400,),
        ),
        start=1,
    )
)


def utm(latitude: float, longitude: float) -> str:
    """Return the PROJ string of the UTM zone of a position [deg].

    The zones of Norway and of Svalbard are those of the standard.

    Raises:
        ValueError: UTM does not cover the latitude.

    >>> utm(49.0, 8.4)
    '+proj=utm +zone=32 +datum=WGS84 +units=m +no_defs'
    """
    low, high = UTM_LATITUDES
    if not low <= latitude <= high:
        raise ValueError(f"UTM covers latitudes from {low:g} to {high:g} deg, got {latitude:g}")
    longitude = (longitude + 180) % 360 - 180
    zone = math.floor(longitude / 6) + 31
    if 56 <= latitude < 64 and 3 <= longitude < 12:
        zone = 32
    if latitude >= 72 and 0 <= longitude < 42:
        zone = 31 + 2 * math.floor((longitude + 3) / 12)
    south = " +south" if latitude < 0 else ""
    return f"+proj=utm +zone={zone}{south} +datum=WGS84 +units=m +no_defs"


def tangent(latitude: float, longitude: float) -> str:
    """Return the PROJ string of the transverse Mercator projection around a position [deg].

    The position is at x = y = 0. Up to 10 km from it, distances are true to 1.3e-6.

    >>> tangent(49.0, 8.4)
    '+proj=tmerc +lat_0=49.0 +lon_0=8.4 +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs'
    """
    origin = f"+lat_0={_fixed(latitude)} +lon_0={_fixed(longitude)}"
    return f"+proj=tmerc {origin} +k=1 +x_0=0 +y_0=0 +datum=WGS84 +units=m +no_defs"


def middle(latitude: ArrayLike, longitude: ArrayLike) -> tuple[float, float]:
    """Return the middle of positions, also across the 180th meridian [deg].

    >>> middle([10.0, 11.0], [179.0, -179.0])
    (10.5, 180.0)
    """
    positions = np.column_stack([latitude, longitude])
    positions = positions[np.isfinite(positions).all(axis=1)]
    first = positions[0, 1]
    positions[:, 1] = first + (positions[:, 1] - first + 180) % 360 - 180
    mid_latitude, mid_longitude = ((positions.min(axis=0) + positions.max(axis=0)) / 2).tolist()
    return mid_latitude, math.remainder(mid_longitude, 360)


def around(latitude: ArrayLike, longitude: ArrayLike) -> str:
    """Return the PROJ string of ``tangent`` at the middle of positions, rounded to 1 cm [deg].

    >>> around([49.0], [8.4]) == tangent(49.0, 8.4)
    True
    """
    mid_latitude, mid_longitude = middle(latitude, longitude)
    return tangent(round(mid_latitude, 7), round(mid_longitude, 7))


def shifted(projection: str, x: float, y: float) -> str | None:
    """Return the PROJ string whose positions are those of a projection less (x, y) [m].

    It is None if the projection is no PROJ string with an origin that can be moved.

    >>> shifted("+proj=utm +zone=32 +datum=WGS84", 490e3, 5.46e6)
    '+proj=tmerc +lat_0=0 +lon_0=9 +k=0.9996 +datum=WGS84 +x_0=10000.0 +y_0=-5460000.0'
    """
    words = projection.split()
    given = {name: value for name, _, value in (w.lstrip("+").partition("=") for w in words)}
    if given.get("proj", "longlat") in {"geocent", "latlong", "longlat", "pipeline"}:
        return None
    try:
        if given["proj"] == "utm":
            origin = 500e3, 10e6 if "south" in given else 0.0
            moved = {"proj", "zone", "south", "lat_0", "lon_0", "k", "k_0"}
            meridian = 6 * int(given["zone"]) - 183
            kept = [f"+proj=tmerc +lat_0=0 +lon_0={meridian} +k={UTM_SCALE}"]
        else:
            origin = float(given.get("x_0", "0")), float(given.get("y_0", "0"))
            moved, kept = set(), []
    except (KeyError, ValueError):
        return None
    moved |= {"x_0", "y_0"}
    kept += [word for word in words if word.lstrip("+").partition("=")[0] not in moved]
    return f"{' '.join(kept)} +x_0={_fixed(origin[0] - x)} +y_0={_fixed(origin[1] - y)}"


def utm_of(name: str) -> str | None:
    """Return the PROJ string of a code of UTM of WGS84 or ETRS89, or None if it is another name.

    >>> utm_of("urn:ogc:def:crs:EPSG::25832"), utm_of("EPSG:32733"), utm_of("EPSG:2154")
    ('+proj=utm +zone=32 +datum=WGS84', '+proj=utm +zone=33 +south +datum=WGS84', None)
    """
    code = _UTM.fullmatch(name.strip())
    if code is None:
        return None
    south = " +south" if code[1] == "327" else ""
    return f"+proj=utm +zone={int(code[2])}{south} +datum=WGS84"


def local_cartesian(latitude: float, longitude: float, height: float = 0.0) -> str:
    """Return the PROJ pipeline of the plane tangent to the ellipsoid at a position [deg, m].

    >>> local_cartesian(49.0, 8.4).partition("+step +proj=topocentric")[2]
    ' +ellps=WGS84 +lat_0=49.0 +lon_0=8.4 +h_0=0.0'
    """
    return (
        "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart "
        f"+ellps=WGS84 +step +proj=topocentric +ellps=WGS84 +lat_0={_fixed(latitude)} "
        f"+lon_0={_fixed(longitude)} +h_0={_fixed(height)}"
    )


@np.errstate(all="ignore")
def project(
    projection: str, latitude: ArrayLike, longitude: ArrayLike, height: ArrayLike = 0.0
) -> Array:
    """Return positions in the plane of a map.

    Args:
        projection: PROJ string of one of the projections of this module.
        latitude: (n,) of WGS84 [deg].
        longitude: (n,) of WGS84 [deg].
        height: (n,) above the ellipsoid [m]; only the tangent plane depends on it.

    Returns:
        (n, 2) east and north [m]; NaN where there is no position.

    Raises:
        ValueError: the projection is not one of this module.

    >>> project("+proj=utm +zone=32 +datum=WGS84", [49.0], [9.0]).round(3)
    array([[ 500000.   , 5427455.781]])
    """
    given = _parameters(projection)
    phi, lam = np.radians(np.asarray(latitude, float)), np.radians(np.asarray(longitude, float))
    phi = np.where(np.abs(phi) <= math.pi / 2, phi, math.nan)
    phi_0, lam_0 = (math.radians(_number(given, name, 0.0)) for name in ("lat_0", "lon_0"))
    if given["proj"] == "topocentric":
        up = np.asarray(height, float)
        return _local_cartesian(phi, lam, up, phi_0, lam_0, _number(given, "h_0", 0.0))
    if given["proj"] == "utm":
        zone = _number(given, "zone", math.nan)
        if zone not in range(1, 61):
            raise ValueError(f"a projection to UTM needs a zone from 1 to 60, got {projection!r}")
        phi_0, lam_0 = 0.0, math.radians(6 * zone - 183)
        scale, x_0, y_0 = UTM_SCALE, 500e3, 10e6 if "south" in given else 0.0
    else:
        scale = _number(given, "k", _number(given, "k_0", 1.0))
        x_0, y_0 = _number(given, "x_0", 0.0), _number(given, "y_0", 0.0)
    origin = _krueger(np.array(phi_0), np.array(0.0)).imag
    plane = scale * (_krueger(phi, lam - lam_0) - 1j * origin)
    return np.stack([plane.real + x_0, plane.imag + y_0], axis=-1)


def _krueger(phi: Array, lam: Array) -> NDArray[np.complex128]:
    """Return east + i north of the transverse Mercator projection with scale 1 [m]."""
    eccentricity = math.sqrt(_E2)
    tau = np.tan(phi)
    sigma = np.sinh(eccentricity * np.arctanh(eccentricity * np.sin(phi)))
    tau = tau * np.hypot(1, sigma) - sigma * np.hypot(1, tau)
    east = np.arcsinh(np.sin(lam) / np.hypot(tau, np.cos(lam)))
    zeta = np.arctan2(tau, np.cos(lam)) + 1j * east
    series = sum(alpha * np.sin(2 * j * zeta) for j, alpha in enumerate(_ALPHA, start=1))
    return 1j * np.conj(_RECTIFYING * (zeta + series))


def _local_cartesian(
    phi: Array, lam: Array, height: Array, phi_0: float, lam_0: float, height_0: float
) -> Array:
    away = _geocentric(phi, lam, height) - _geocentric(
        np.array(phi_0), np.array(lam_0), np.array(height_0)
    )
    east = np.array([-math.sin(lam_0), math.cos(lam_0), 0.0])
    north = np.array(
        [
            -math.sin(phi_0) * math.cos(lam_0),
            -math.sin(phi_0) * math.sin(lam_0),
            math.cos(phi_0),
        ]
    )
    return np.stack([away @ east, away @ north], axis=-1)


def _geocentric(phi: Array, lam: Array, height: Array) -> Array:
    normal = RADIUS / np.sqrt(1 - _E2 * np.sin(phi) ** 2)
    across = (normal + height) * np.cos(phi)
    up = (normal * (1 - _E2) + height) * np.sin(phi)
    return np.stack([across * np.cos(lam), across * np.sin(lam), up], axis=-1)


def _fixed(number: float) -> str:
    """Return all digits without an exponent."""
    return np.format_float_positional(float(number), trim="0")


def parameters_of(projection: str) -> Mapping[str, str] | None:
    """Return the parameters of the last step, or None if it is no projection of this module."""
    words = (word.lstrip("+") for word in projection.rpartition("+step")[2].split())
    given = {name: value for name, _, value in (word.partition("=") for word in words)}
    is_known = (
        given.get("proj") in _PROJECTIONS
        and given.keys() <= _PARAMETERS
        and {given.get("ellps", "WGS84"), given.get("datum", "WGS84")} <= {"WGS84", "GRS80"}
        and given.get("units", "m") == "m"
    )
    return given if is_known else None


def _parameters(projection: str) -> Mapping[str, str]:
    """Return the parameters of the last step.

    Raises:
        ValueError: the projection is not one of this module.
    """
    given = parameters_of(projection)
    if given is None:
        raise ValueError(
            f"projection must be +proj={', '.join(_PROJECTIONS)} of WGS84 in metres, "
            f"got {projection[:80]!r}; project the positions with pyproj"
        )
    return given


def _number(given: Mapping[str, str], name: str, default: float) -> float:
    text = given.get(name)
    if text is None:
        return default
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"+{name} of a projection must be a number, got {text!r}") from None
