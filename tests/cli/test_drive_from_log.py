"""The command ``maplines drive --drive`` with a bus log of a car."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest
from support.drive_files import run, table, town
from support.fixtures import Capture, Patch

from maplines_can import maps
from maplines_can.cli import main

DBC = """\
VERSION ""
BU_: car
BO_ 256 Position: 8 car
 SG_ X : 0|32@1- (0.001,0) [0|0] "m" car
 SG_ Y : 32|32@1- (0.001,0) [0|0] "m" car
BO_ 257 Motion: 4 car
 SG_ Course : 0|16@1- (0.01,0) [0|0] "deg" car
 SG_ Speed : 16|16@1- (0.01,0) [0|0] "km/h" car
"""
TABLES = {
    "signals.toml": 'x = "Position.X"\ny = "Y"\nheading_deg = "Course"\n'
    'speed_kmh = "Motion.Speed"\n',
    "signals.csv": "column,signal\nx,Position.X\ny,Y\nheading_deg,Course\nspeed_kmh,Motion.Speed\n",
}


def car_log(folder: Path, name: str, north: float = 0.0) -> list[str]:
    """Write the log of a car that drives east at 10 m/s, and return the options to use it.

    python-can and cantools write it.
    """
    database: Any = cantools.database.load_string(DBC)
    (folder / "car.dbc").write_text(DBC)
    with can.Logger(folder / name) as logger:
        for i in range(101):
            values = {"X": i, "Y": north - 1.75}, {"Course": 0.0, "Speed": 36.0}
            for message, signals in zip(database.messages, values, strict=True):
                data = message.encode(signals)
                logger(can.Message(1e9 + i / 10, message.frame_id, False, data=data))
    return ["--drive", str(folder / name), "--signals-dbc", str(folder / "car.dbc")]


@pytest.mark.parametrize(
    ("log", "table_name"), [("car.blf", "signals.toml"), ("car.csv", "signals.csv")]
)
def test_a_recorded_drive_from_a_bus_log(
    tmp_path: Path, capsys: Capture, log: str, table_name: str
) -> None:
    """With the DBC of the car and a table of its signals; the suffix .csv may be a log, too."""
    options = car_log(tmp_path, log)
    (tmp_path / table_name).write_text(TABLES[table_name])
    truth = tmp_path / "truth.csv"
    options += ["--signals", str(tmp_path / table_name), "--as-fast-as-possible"]
    result = run(capsys, town(tmp_path), *options, "--truth", str(truth))
    assert result["cycles"] == 201
    assert result["km"] == pytest.approx(0.1)
    row = table(truth)[100]
    assert [float(row[name]) for name in ("x", "y", "heading", "speed")] == pytest.approx(
        [50.0, -1.75, 0.0, 10.0]
    )
    assert float(row["ego_left_y_0"]) == pytest.approx(1.75)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        pytest.param({"x": ""}, "car.log: signals: .*x", id="no position"),
        pytest.param({"Motion.Speed": "Motion.Sped"}, "Motion.Sped.* is not in", id="no signal"),
        pytest.param({"=": ":"}, "not valid TOML", id="no TOML"),
        pytest.param({"heading_deg": "bearing_deg"}, "bearing .* needs lat_deg", id="bearing"),
    ],
)
def test_a_wrong_table_of_signals_is_one_line(
    tmp_path: Path, capsys: Capture, change: dict[str, str], words: str
) -> None:
    options = car_log(tmp_path, "car.log")
    text = TABLES["signals.toml"]
    for old, new in change.items():
        text = text.replace(old, new, 1) if new else text.split("\n", 1)[1]
    (tmp_path / "signals.toml").write_text(text)
    options += ["--signals", str(tmp_path / "signals.toml"), "--as-fast-as-possible"]
    err = run(capsys, town(tmp_path), *options, status=1)
    assert re.search(f"error: .*{words}", err), err


PAGE = Path(__file__).parents[2] / "docs" / "drives.md"
#: The DBC of the table in the page.
PAGE_DBC = """\
VERSION ""
BU_: car
BO_ 512 GNSS: 12 car
 SG_ Latitude : 0|32@1- (0.0000001,0) [0|0] "deg" car
 SG_ Longitude : 32|32@1- (0.0000001,0) [0|0] "deg" car
 SG_ Course : 64|16@1+ (0.01,0) [0|0] "deg" car
BO_ 514 ESP: 2 car
 SG_ VehicleSpeed : 0|16@1+ (0.01,0) [0|0] "km/h" car
"""


def test_the_command_of_the_page_runs(tmp_path: Path, capsys: Capture, monkeypatch: Patch) -> None:
    """With its table of signals, and a log of a car on the motorway, in latitude and longitude."""
    pyproj = pytest.importorskip("pyproj")
    monkeypatch.chdir(tmp_path)
    page = PAGE.read_text(encoding="utf-8")
    (signals,) = re.findall(r"```toml\n(.*?)```", page, re.DOTALL)
    (command,) = re.findall(r"^maplines (drive --drive car.blf .*)$", page, re.MULTILINE)
    Path("signals.toml").write_text(signals)
    Path("car.dbc").write_text(PAGE_DBC)
    road_map = maps.load(maps.town_path())
    centre = road_map.lanes["3:0:-3"].centre
    inverse = pyproj.Transformer.from_crs(road_map.projection, "EPSG:4326", always_xy=True)
    s = 30 + 2.0 * np.arange(60)
    lon, lat = inverse.transform(*(np.interp(s, centre.distance, xy) for xy in centre.points.T))
    ahead = inverse.transform(*(np.interp(s + 1, centre.distance, xy) for xy in centre.points.T))
    course, *_ = pyproj.Geod(ellps="WGS84").inv(lon, lat, *ahead)
    gnss, esp = cantools.database.load_string(PAGE_DBC).messages  # type: ignore[union-attr]
    with can.Logger("car.blf") as logger:
        for i in range(len(s)):
            values = {"Latitude": lat[i], "Longitude": lon[i], "Course": course[i] % 360}
            for message, signals_now in ((gnss, values), (esp, {"VehicleSpeed": 72.0})):
                data = message.encode(signals_now)
                fd = len(data) > 8
                logger(can.Message(1e9 + i / 10, message.frame_id, False, data=data, is_fd=fd))
    assert main([*shlex.split(command), "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["cycles"] == 119
    assert result["km"] == pytest.approx(0.118, rel=0.01)
    assert result["off_map"] == result["lane_changes"] == 0
    assert result["lines"] >= 3 * 119
    assert Path("lines.blf").exists()
