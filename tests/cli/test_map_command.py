"""The command ``maplines map``: what it prints, draws and refuses."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from support.fixtures import Capture
from support.xodr_files import WIDTH, cubic, document, lane, linked, road, section

from maplines_can.cli import main
from maplines_can.maps import load, town_path

BROKEN = cubic("width", float("nan"), sOffset=0.0)


@pytest.fixture
def partly(tmp_path: Path) -> Path:
    """A map of a road of 100 m, with three lanes that cannot be used and a link to nowhere."""
    bad = [lane(i, BROKEN) for i in (-2, -3)]
    lanes = section(lane(1), lane(-1, successor=-7), *bad, lane(2, BROKEN, successor=1))
    path = tmp_path / "partly.xodr"
    path.write_text(document(road(lanes, link=linked("successor", "9"))))
    return path


def test_the_map_of_the_package_is_the_default(capsys: Capture) -> None:
    assert main(["map"]) == 0
    out = capsys.readouterr().out

    assert out.startswith("town.xodr\n  roads         49, 10.63 km\n")
    assert "x -1211.5 to 1211.5 m" in out
    assert "right-hand" in out
    assert "+proj=tmerc" in out
    assert "not used, or assumed: none" in out
    assert "links with gaps: none" in out


def test_json_agrees_with_the_map(capsys: Capture) -> None:
    """Counts and lengths are sums over the lanes."""
    assert main(["map", "--json"]) == 0
    summary = json.loads(capsys.readouterr().out)
    town = load(town_path())

    assert summary["roads"]["count"] == len(town.roads)
    assert sum(kind["count"] for kind in summary["lanes"].values()) == len(town.lanes)
    length = sum(lane.length for lane in town.lanes.values() if lane.type == "driving")
    assert summary["lanes"]["driving"]["km"] == pytest.approx(length / 1000, abs=1e-3)
    assert summary["drivable"]["without_successor"] == 2
    assert summary["speed_limits_kmh"] == [30.0, 120.0]
    assert summary["projection"] == town.projection
    assert summary["skipped"] == []
    assert summary["plot"] is None


def test_how_good_the_points_are(tmp_path: Path, capsys: Capture) -> None:
    """Points of 5 cm every 2 m, in text and in JSON."""
    rng = np.random.default_rng(2)
    rows = ["line,lane,side,x,y"]
    for side, y in (("left", 3.5), ("right", 0.0)):
        for x in np.arange(0.0, 401.0, 2.0):
            dx, dy = rng.normal(0, 0.05, 2)
            rows.append(f"{side},1,{side},{x + dx:.3f},{y + dy:.3f}")
    path = tmp_path / "noisy.csv"
    path.write_text("\n".join(rows) + "\n")
    assert main(["map", str(path)]) == 0
    text = capsys.readouterr().out
    assert main(["map", str(path), "--json"]) == 0
    points = json.loads(capsys.readouterr().out)["points"]

    assert points["spacing"]["median"] == pytest.approx(2.0, abs=0.1)
    assert points["noise"]["median"] == pytest.approx(0.05, rel=0.25)
    assert [one["x"] for one in points["sigmas"]] == [0, 20, 40, 60]
    assert all(0 < one["median"] <= one["high"] < 0.2 for one in points["sigmas"])
    assert "points of the lines: 402\n    one every 2 m; " in text
    assert re.search(r"noise as they show it: [3-6]\.?\d* cm; ", text)
    assert f"given: {points['lines']}, {points['reach']:.0f} m ahead (median)" in text


def test_what_is_not_used_is_counted_by_reason_with_an_example(
    partly: Path, capsys: Capture
) -> None:
    assert main(["map", str(partly)]) == 0
    text = capsys.readouterr().out
    assert main(["map", str(partly), "--json"]) == 0
    skipped = json.loads(capsys.readouterr().out)["skipped"]
    listed = load(partly).skipped

    assert sum(group["count"] for group in skipped) == len(listed)
    assert len(skipped) < len(listed)
    assert skipped[0]["count"] == 2
    assert {group["where"] for group in skipped} <= {one.where for one in listed}
    assert f"not used, or assumed: {len(listed)}" in text
    assert f"2 x {skipped[0]['why']}" in text
    assert f"first: {skipped[0]['where']}" in text


def test_the_picture(tmp_path: Path, capsys: Capture) -> None:
    path = tmp_path / "town.svg"
    assert main(["map", "--plot", str(path)]) == 0

    assert path.read_bytes().startswith(b"<?xml")
    assert str(path) in capsys.readouterr().out


def test_the_speed_limits_are_all_that_apply(tmp_path: Path, capsys: Capture) -> None:
    """Also those of a short part of a lane."""
    limits = "".join(
        f'<speed sOffset="{s}" max="{v}" unit="km/h"/>' for s, v in ((0, 50), (10, 30), (20, 70))
    )
    path = tmp_path / "limits.xodr"
    path.write_text(document(road(section(lane(-1, WIDTH + limits)))))
    assert main(["map", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["speed_limits_kmh"] == [30.0, 70.0]
