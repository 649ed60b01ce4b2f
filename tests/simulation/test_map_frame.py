"""Positions of WGS84 in the frame of a map, and positions that are not on the map."""

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.fixtures import Patch

from maplines_can import Polyline
from maplines_can.simulation import DriveFileError, RecordedDrive
from maplines_can.simulation.map_frame import check_on_map, north, project
from maplines_can.values.errors import MissingExtraError

UTM = "EPSG:32632"
GNSS = "time,lat_deg,lon_deg,bearing_deg\n0,49.9,8.6,90\n1,49.9,8.6001,90\n2,49.9,8.6002,90\n"


@pytest.fixture
def gnss(tmp_path: Path) -> Path:
    path = tmp_path / "gnss.csv"
    path.write_text(GNSS)
    return path


def mercator(lat_deg: Any, lon_deg: Any, origin_deg: float) -> Any:
    """Positions in the transverse Mercator projection of the sphere, in closed form."""
    lat, lon = np.radians(lat_deg), np.radians(np.subtract(lon_deg, origin_deg))
    radius = 6371000.0
    x = radius * np.arctanh(np.cos(lat) * np.sin(lon))
    return np.column_stack([x, radius * np.arctan2(np.tan(lat), np.cos(lon))])


def test_projection_against_a_closed_form() -> None:
    """The transverse Mercator projection of a sphere has one."""
    pytest.importorskip("pyproj")
    lat, lon = np.array([49.9, 50.3, -12.0]), np.array([8.6, 11.0, 7.0])
    on_sphere = "+proj=tmerc +lon_0=9 +R=6371000 +units=m +nadgrids=@null +type=crs"
    found = project(lat, lon, on_sphere)
    np.testing.assert_allclose(found, mercator(lat, lon, 9.0), atol=1e-4)
    convergence = np.arctan(np.tan(np.radians(lon - 9)) * np.sin(np.radians(lat)))
    np.testing.assert_allclose(north(lat, lon, on_sphere), np.pi / 2 + convergence, atol=1e-6)


def test_a_geoid_grid_that_is_not_installed_does_no_harm() -> None:
    """It concerns heights only; map files of simulators name one."""
    pytest.importorskip("pyproj")
    lat, lon = np.array([49.9, 50.3]), np.array([8.6, 9.0])
    utm = "+proj=utm +zone=32 +datum=WGS84 +units=m"
    found = project(lat, lon, f"{utm} +geoidgrids=no_such_grid.gtx +vunits=m +no_defs")
    np.testing.assert_allclose(found, project(lat, lon, UTM), atol=1e-6)


def test_bearings_are_from_true_north(gnss: Path) -> None:
    """The heading in the map frame differs by the meridian convergence."""
    pytest.importorskip("pyproj")
    drive = RecordedDrive.from_csv(gnss, UTM)
    lat = np.radians(49.9)
    normal_radius = 6_378_137 / np.sqrt(1 - 0.00669438 * np.sin(lat) ** 2)
    west = 0.9996 * normal_radius * np.cos(lat) * np.radians(0.4)  # of the central meridian
    assert drive.pose[0, 0] == pytest.approx(500_000 - west, abs=1)
    convergence = np.arctan(np.tan(np.radians(8.6 - 9)) * np.sin(np.radians(49.9)))
    assert drive.pose[0, 2] == pytest.approx(convergence, abs=1e-4)
    assert drive.at(1.0).speed == pytest.approx(7.18, abs=0.01)


@pytest.mark.parametrize(
    ("projection", "text"),
    [
        (None, "the map has no projection"),
        ("", "the map has no projection"),
        ("nonsense", "projection 'nonsense' is not valid"),
        ("+proj=nonsense", "is not valid"),
        ("EPSG:4326", "has no coordinates in metres"),
    ],
)
def test_bad_projections(gnss: Path, projection: str | None, text: str) -> None:
    pytest.importorskip("pyproj")
    with pytest.raises(DriveFileError, match=text) as caught:
        RecordedDrive.from_csv(gnss, projection)
    assert str(caught.value).startswith(str(gnss))


@pytest.mark.parametrize(("lat", "lon"), [(91.0, 8.0), (477_000.0, 5_529_000.0), (50.0, 400.0)])
def test_positions_that_are_not_in_degrees(lat: float, lon: float) -> None:
    with pytest.raises(DriveFileError, match="lat_deg must be from -90 to 90 deg"):
        project([lat], [lon], UTM)


def test_pyproj_is_an_extra(gnss: Path, monkeypatch: Patch) -> None:
    """The message names the extra."""
    monkeypatch.setitem(sys.modules, "pyproj", None)
    with pytest.raises(MissingExtraError, match='install the extra "maps"'):
        RecordedDrive.from_csv(gnss, UTM)


MAP = [Polyline(np.array([[477_000, 5_529_000], [479_000, 5_529_500]], float))]
ON_MAP = np.array([[477_100.0, 5_529_050.0], [478_000.0, 5_529_300.0]])


@pytest.mark.parametrize(
    ("positions", "share"),
    [
        pytest.param(ON_MAP, 1.0, id="inside"),
        pytest.param(ON_MAP - [2000, 0], 0.0, id="outside"),
        pytest.param(ON_MAP - [500, 0], 0.5, id="half"),
        pytest.param([[476_901.0, 5_528_901.0]], 1.0, id="within-the-margin"),
        pytest.param([[476_899.0, 5_529_001.0]], 0.0, id="beyond-the-margin"),
    ],
)
def test_share_on_the_map(positions: Any, share: float) -> None:
    if share:
        assert check_on_map(positions, MAP) == share
    else:
        with pytest.raises(DriveFileError, match=r"no position is on the map"):
            check_on_map(positions, MAP)


@pytest.mark.parametrize(
    ("positions", "text"),
    [
        pytest.param([[8.6, 49.9]], "look like degrees: name the columns lat_deg", id="degrees"),
        pytest.param(ON_MAP[:, ::-1], "x and y are exchanged", id="exchanged"),
        pytest.param(ON_MAP - [4e5, 0], "another projection.*EPSG:25832", id="other-zone"),
    ],
)
def test_positions_off_the_map(positions: Any, text: str) -> None:
    """The message has both extents and the probable cause."""
    with pytest.raises(DriveFileError, match=text) as caught:
        check_on_map(positions, MAP, "EPSG:25832", source="drive.csv")
    assert "drive.csv: no position is on the map" in str(caught.value)
    assert "477000 to 479000 m and y from 5529000 to 5529500 m" in str(caught.value)


@pytest.mark.parametrize("positions", [np.empty((0, 2)), [[1, 2, 3]]])
def test_wrong_shapes(positions: Any) -> None:
    with pytest.raises(ValueError, match="positions must have shape"):
        check_on_map(positions, MAP)
    with pytest.raises(ValueError, match="lines must be one or more"):
        check_on_map(ON_MAP, [])
