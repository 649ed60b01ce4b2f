"""Commands on maps whose coordinates are no metres of UTM, with a drive in degrees."""

import json
from pathlib import Path

import numpy as np
import pytest

from maplines_can.cli import main

LAT, LON = 48.1, 11.6
#: Degrees of latitude and longitude of a metre there: radii of curvature of WGS84.
SIN = np.sin(np.radians(LAT))
NORTH = np.degrees(1 / (6378137 * (1 - 0.00669438) / (1 - 0.00669438 * SIN**2) ** 1.5))
EAST = np.degrees(1 / (6378137 / np.sqrt(1 - 0.00669438 * SIN**2) * np.cos(np.radians(LAT))))


def web_mercator(lat: float, lon: float) -> list[float]:
    """Return the closed form of EPSG:3857."""
    y = np.log(np.tan(np.pi / 4 + np.radians(lat) / 2))
    return [6378137 * float(np.radians(lon)), 6378137 * float(y)]


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """Return a map of a lane of 3.5 m by 300 m, and a drive 0.5 m to the left of its middle."""
    features = []
    for side, north in (("left", 1.75), ("right", -1.75)):
        points = [web_mercator(LAT + north * NORTH, LON + x * EAST) for x in range(0, 301, 10)]
        geometry = {"type": "LineString", "coordinates": points}
        properties = {"lane": "1", "side": side, "kind": "solid"}
        features.append({"type": "Feature", "properties": properties, "geometry": geometry})
    crs = {"type": "name", "properties": {"name": "EPSG:3857"}}
    road, drive = tmp_path / "road.geojson", tmp_path / "drive.csv"
    road.write_text(json.dumps({"type": "FeatureCollection", "crs": crs, "features": features}))
    rows = [f"{t},{LAT + 0.5 * NORTH:.10f},{LON + (20 + 10 * t) * EAST:.10f},90" for t in range(10)]
    drive.write_text("\n".join(["time,lat_deg,lon_deg,bearing_deg", *rows]))
    return road, drive


def test_a_drive_in_degrees_on_a_world_map(
    files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The lines are 1.25 m to the left and 2.25 m to the right of the car, as on the ground."""
    pytest.importorskip("pyproj")
    truth = tmp_path / "truth.csv"
    options = ["--as-fast-as-possible", "--truth", str(truth)]
    assert main(["drive", str(files[0]), "--drive", str(files[1]), *options]) == 0
    assert "positions are x and y of EPSG:3857 [metre, 0.66" in capsys.readouterr().err
    table = np.genfromtxt(truth, delimiter=",", names=True)
    assert table["ego_left_y_0"] == pytest.approx(1.25, abs=2e-3)
    assert table["ego_right_y_0"] == pytest.approx(-2.25, abs=2e-3)


@pytest.mark.parametrize("name", ["EPSG:9999999", "local"])
def test_a_system_that_is_none_ends_in_one_line(
    files: tuple[Path, Path], name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("pyproj")
    files[0].write_text(files[0].read_text().replace("EPSG:3857", name))
    assert main(["map", str(files[0])]) == 1
    err = capsys.readouterr().err
    assert f"'{name}' is not valid" in err
    assert len(err.splitlines()) == 1
