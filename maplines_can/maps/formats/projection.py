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


def _parameters(projection: str) -> Mapping[str, str]:
    """Return the parameters of the last step.

    Raises:
        ValueError: the projection is not one of this module.
    """
    words = (word.lstrip("+") for word in projection.rpartition("+step")[2].split())
    given = {name: value for name, _, value in (word.partition("=") for word in words)}
    known = {"utm", "tmerc", "topocentric"}
    ellipsoid = given.get("ellps", given.get("datum", "WGS84"))
    if given.get("proj") not in known or ellipsoid != "WGS84" or given.get("units", "m") != "m":
        raise ValueError(
            f"projection must be +proj={', '.join(sorted(known))} of WGS84 in metres, "
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
