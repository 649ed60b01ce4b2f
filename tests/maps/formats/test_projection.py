"""Projections of WGS84: PROJ is the witness."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from maplines_can.maps.formats.projection import RADIUS, local_cartesian, project, tangent, utm

#: Of origins [deg]; PROJ takes less than about 1e-8 deg for 0.
LATITUDES = st.integers(-79_000_000, 83_000_000).map(lambda micro: micro / 1e6)
LONGITUDES = st.integers(-180_000_000, 180_000_000).map(lambda micro: micro / 1e6)
AROUND = np.array([(0.0, 0.0), (0.5, 2.0), (-0.7, 1.5), (0.9, -2.9), (-0.2, -3.0)])


def witness(projection: str, positions: np.ndarray) -> np.ndarray:
    """Return positions (latitude, longitude, height) as PROJ projects them."""
    pyproj = pytest.importorskip("pyproj")
    if "pipeline" in projection:
        transformer = pyproj.Transformer.from_pipeline(projection)
    else:
        transformer = pyproj.Transformer.from_crs(4326, projection, always_xy=True)
    latitude, longitude, height = positions.T
    return np.array(transformer.transform(longitude, latitude, height)[:2]).T


@example(0.0, 1e-6, tangent)
@given(LATITUDES, LONGITUDES, st.sampled_from([utm, tangent, local_cartesian]))
def test_projections_are_those_of_proj(
    latitude: float, longitude: float, of: Callable[[float, float], str]
) -> None:
    """Within 1 um, up to 3 deg away."""
    projection = of(latitude, longitude)
    heights = np.linspace(-100, 3000, len(AROUND))
    positions = np.column_stack([np.array([latitude, longitude]) + AROUND, heights])
    expected = witness(projection, positions)
    assert project(projection, *positions.T) == pytest.approx(expected, abs=1e-6)


def test_the_false_origin_and_the_scale() -> None:
    text = "+proj=tmerc +lat_0=38 +lon_0=127 +k_0=0.9998 +x_0=200000 +y_0=600000 +ellps=WGS84"
    positions = np.array([[37.5, 127.3, 0.0], [38.0, 127.0, 0.0]])
    assert project(text, *positions.T) == pytest.approx(witness(text, positions), abs=1e-6)
    assert project(text, [38.0], [127.0])[0] == pytest.approx((200e3, 600e3), abs=1e-6)


def test_closed_forms() -> None:
    """On the central meridian x is 0; on the equator y is 0, and x that of a sphere's Mercator."""
    flat = tangent(0.0, 10.0)
    assert project(flat, [12.0, -7.0], [10.0, 10.0])[:, 0] == pytest.approx([0, 0], abs=1e-9)
    assert project(flat, [0.0], [11.0])[0, 1] == pytest.approx(0, abs=1e-9)
    assert project(flat, [0.0], [10.0001])[0, 0] == pytest.approx(
        RADIUS * math.radians(1e-4), rel=1e-9
    )
    east, north = project(local_cartesian(0.0, 0.0), [0.0], [90.0])[0]
    assert (east, north) == pytest.approx((RADIUS, 0.0))


@pytest.mark.parametrize("latitude", [-80.1, 84.1, math.nan])
def test_utm_ends_at_the_poles(latitude: float) -> None:
    with pytest.raises(ValueError, match=r"from -80 to 84 deg"):
        utm(latitude, 0.0)


@pytest.mark.parametrize(
    ("projection", "message"),
    [
        ("+proj=lcc +lat_0=1", "project the positions with pyproj"),
        ("+proj=tmerc +ellps=bessel", "project the positions with pyproj"),
        ("+proj=tmerc +units=us-ft", "project the positions with pyproj"),
        ("EPSG:25832", "project the positions with pyproj"),
        ("", "project the positions with pyproj"),
        ("+proj=utm", "zone from 1 to 60"),
        ("+proj=utm +zone=61", "zone from 1 to 60"),
        ("+proj=utm +zone=x", "must be a number, got 'x'"),
    ],
)
def test_other_projections_are_an_error(projection: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        project(projection, [49.0], [8.4])


def test_what_is_no_position_is_nan() -> None:
    points = project(utm(49, 8), [math.nan, 91.0, 49.0, 49.0], [8.0, 8.0, math.inf, 8.0])
    assert np.isnan(points).any(axis=1).tolist() == [True, True, True, False]


def test_all_zones() -> None:
    """Every half degree: six degrees wide, but for south-west Norway and Svalbard."""
    svalbard = {31: (0, 9), 33: (9, 21), 35: (21, 33), 37: (33, 42)}
    for latitude in (-80.0, -0.5, 0.0, 55.5, 56.0, 60.0, 63.5, 64.0, 71.5, 72.0, 84.0):
        for longitude in np.arange(-180.0, 180.0, 0.5):
            zone = next(k for k in range(1, 61) if -186 + 6 * k <= longitude < -180 + 6 * k)
            if 56 <= latitude < 64 and 3 <= longitude < 12:
                zone = 32
            if latitude >= 72 and 0 <= longitude < 42:
                zone = next(k for k, (low, high) in svalbard.items() if low <= longitude < high)
            for turns in (-360, 0, 360):
                words = utm(latitude, longitude + turns).split()
                assert words[1] == f"+zone={zone}"
                assert ("+south" in words) is (latitude < 0)
