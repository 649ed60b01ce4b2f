"""Files of a drive for tests: a map, the log of its lines, and the truth."""

import csv
import json
from pathlib import Path
from typing import Any

from support.xodr_files import document, geometry, lane, road, section

from maplines_can.cli import main

#: A straight road of 200 m, a left bend of 200 m with a radius of 400 m; two lanes to the east.
PLAN = geometry(length=200.0) + geometry(
    '<arc curvature="0.0025"/>', s=200.0, x=200.0, length=200.0
)
ROAD = road(section(lane(1), lane(-1), lane(-2)), plan=PLAN, length=400.0)

#: DBC of a car with the signals of its motion, and a table of their names.
CAR_DBC = """\
VERSION ""
BU_: car
BO_ 1 ESP: 4 car
 SG_ VehicleSpeed : 0|16@1- (0.01,0) [0|0] "km/h" car
 SG_ YawRate : 16|16@1- (0.01,0) [0|0] "deg/s" car
"""
CAR_SIGNALS = 'speed_kmh = "ESP.VehicleSpeed"\nyaw_rate_deg_s = "YawRate"\n'


def car_signals(folder: Path) -> list[object]:
    """Write the DBC and the table, and return the options of ``maplines consume``."""
    (folder / "car.dbc").write_text(CAR_DBC)
    (folder / "signals.toml").write_text(CAR_SIGNALS)
    return ["--signals", folder / "signals.toml", "--signals-dbc", folder / "car.dbc"]


def town(folder: Path, header: str = "") -> str:
    """Write the map and return its path."""
    path = folder / "map.xodr"
    path.write_text(document(ROAD, header=header))
    return str(path)


def run(capsys: Any, *options: str, status: int = 0) -> Any:
    """Run ``maplines drive --json --force`` and return its result, or its standard error."""
    assert main(["drive", *options, "--json", "--force"]) == status
    captured = capsys.readouterr()
    return json.loads(captured.out) if not status else captured.err


def table(path: Path) -> list[dict[str, str]]:
    """Return the rows of a truth in CSV."""
    with path.open() as file:
        return list(csv.DictReader(file))
