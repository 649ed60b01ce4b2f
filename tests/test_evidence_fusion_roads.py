"""tools/evidence_fusion_roads.py on a few roads, and it finds a fused lane that is too certain."""

import argparse
import json
from typing import Any

import evidence_fusion_roads as tool
import numpy as np
import pytest
import road_sources
from random_roads import random_map

from maplines_can import MapError, Polyline, Slot
from maplines_can.consumers import lane_filter


def figures_of(names: list[str], error: MapError | None, seconds: float) -> Any:
    """Figures of one car on each of these random roads."""
    options = argparse.Namespace(seconds=seconds)
    cars = []
    for seed, name in enumerate(names):
        found = random_map(name, 0)
        route = found.route("1", "1")
        cars.append(tool.of_car(found, route, error, options, seed, lambda _: None))
    return tool.figures(cars, tool.BOUND)


def nees_of(figures: Any, quantity: str) -> float:
    return float(figures["scenes"][quantity].split(",")[0])


def test_the_shape_of_the_fused_lane_is_as_uncertain_as_that_of_its_scenes() -> None:
    """Scenes alone say no more of a shape than one of them, however many there are."""
    figures = figures_of(["s-bend"], None, 5.0)
    assert nees_of(figures, "shape") <= tool.BOUND
    assert nees_of(figures, "width, 0 m") <= tool.BOUND


def test_a_lane_that_is_too_certain_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Here the mean of many scenes seems to have no errors of its own."""
    monkeypatch.setattr(lane_filter.LaneFilter, "_keep_own", lambda *_: None)
    figures = figures_of(["s-bend"], None, 5.0)
    assert nees_of(figures, "shape") > 5
    assert not figures["scenes"]["met"]


def test_points_keep_their_errors_in_other_lines() -> None:
    points = np.column_stack([np.arange(0.0, 40.0, 2.0), np.zeros(20)])
    of_map = tool.MapOfCar(MapError(0.05, 0.05), np.random.default_rng(0))
    first = of_map(Slot.EGO_LEFT, Polyline(points))
    later = of_map(Slot.EGO_LEFT, Polyline(points[5:]))
    np.testing.assert_array_equal(first.points[5:], later.points)
    assert 0.02 < np.abs(first.points - points).mean() < 0.15


def test_the_command(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(road_sources, "ROADS", ("roundabout-12m",))
    assert tool.main(["--cars", "1", "--seconds", "1", "--json"]) in (0, 1)
    result = json.loads(capsys.readouterr().out)
    assert {"all, exact", "all, 5 cm", "met"} <= set(result)
