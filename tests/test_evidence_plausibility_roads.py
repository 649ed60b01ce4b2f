"""tools/evidence_plausibility_roads.py: no false alarms in bends; and it finds false ones."""

import argparse
import json
from typing import Any

import evidence_plausibility_roads as tool
import numpy as np
import pytest
import road_sources
from random_roads import random_map, spiral_map

from maplines_can import Polyline

ONE = ("exact", "2 cm")


def alarms_of(road_map: Any, monkeypatch: pytest.MonkeyPatch, cars: int, seconds: float) -> Any:
    """Alarms of cars on a road, by row: a map without errors, and a camera with little noise."""
    monkeypatch.setattr(tool, "MAP_ERRORS", {"exact": None})
    monkeypatch.setattr(tool, "CAMERAS", {"2 cm": tool.CAMERAS["2 cm"]})
    monkeypatch.setattr(tool, "RATES", (1.0,))
    options = argparse.Namespace(cars=cars, seconds=seconds)
    return tool.of_route(road_map, road_map.route("1", "1"), options, 0, lambda _: None)


def test_there_are_hardly_any_false_alarms_in_a_corner(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 100 cars, in 12 s each; designed are 0.3. The fits change from image to image there."""
    alarms, _ = alarms_of(random_map("corner", 0), monkeypatch, 100, 12.0)
    assert {hours > 0.25 for _, hours in alarms.values()} == {True}
    assert max(number for number, _ in alarms.values()) <= 3


def test_what_cubics_miss_is_found_if_it_is_not_covered(monkeypatch: pytest.MonkeyPatch) -> None:
    """Here a cubic is off by 0.5 m in every other image, which nothing states."""
    seen, sign = tool.seen, iter(np.resize([0.5, 0.0], 10_000))

    def wrong(*arguments: Any) -> Any:
        parts = seen(*arguments)
        return None if parts is None else (parts[0], parts[1] + next(sign), *parts[2:])

    monkeypatch.setattr(tool, "seen", wrong)
    alarms, times = alarms_of(spiral_map(), monkeypatch, 40, 5.0)
    assert max(number for number, _ in alarms.values()) >= 30
    figures = tool.figures([(alarms, times)])
    assert not all(row.get("as designed", True) for row in figures.values())


def test_a_shift_of_the_map_is_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    _, times = alarms_of(spiral_map(), monkeypatch, 40, 8.0)
    for found in times.values():
        assert len(found) >= 39
        assert np.median(found) <= 0.3


def test_a_point_of_the_map_keeps_its_error() -> None:
    """Also if the line is made anew, of some more points; another line has errors of its own."""
    cars = tool.Cars(3, np.ones(3), tool.MAP_ERRORS["5 cm"], np.random.default_rng(0))
    x = np.arange(0.0, 60.0, 5.0)
    line, longer, other = (
        Polyline(np.column_stack([x[part], np.full(len(x[part]), y)]))
        for part, y in ((slice(0, 8), 1.75), (slice(2, 12), 1.75), (slice(0, 8), -1.75))
    )
    points, offset = cars.line_errors(line)
    again, same = cars.line_errors(longer)
    assert np.array_equal(again[:, :6], points[:, 2:])
    assert np.array_equal(same, offset)
    points_of_other, offset_of_other = cars.line_errors(other)
    assert not np.isin(points_of_other, again).any()
    assert not np.isin(offset_of_other, offset).any()


def test_the_command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(road_sources, "ROADS", ("roundabout-12m",))
    quick = ["-n", "1", "--seconds", "1", "--cars", "3", "--json"]
    assert tool.main(quick) == 0
    result = json.loads(capsys.readouterr().out)
    assert set(result) == {
        "straight", "straight, spiral, bend of 150 m", "random: roundabout-12m", "all", "met",
    }  # fmt: skip
