"""The table of scenes on maps, and its command."""

import json
from typing import Any

import pytest

from maplines_can.cli import main
from maplines_can.study.scenes.carriers import WITH_POSE
from maplines_can.study.scenes.map_scenes import ROADS
from maplines_can.study.scenes.sigma_ratios import ALL, Ratios, ratios_text


def test_each_kind_of_records_is_measured_on_each_map(capsys: pytest.CaptureFixture[str]) -> None:
    """On the town without a map; all entries are closer than levels in one frame."""
    assert main(["study", "maps", "--n", "6", "--json"]) == 0
    figures = json.loads(capsys.readouterr().out)
    assert list(figures) == list(WITH_POSE)
    for of_maps in figures.values():
        assert list(of_maps) == ["town.xodr", ROADS, ALL]
        lines = [of_maps[name]["lines"] for name in of_maps]
        assert lines[0] + lines[1] == lines[2] > 20
    whole, apart = (figures[f"{name}, FD"][ALL] for name in ("Scene", "PoseConditional"))
    assert 1 < apart["width at 20 m"][0] < whole["width at 20 m"][0]
    assert 1 < whole["y at 0 m"][0] < apart["y at 0 m"][0]


def test_the_table_has_the_reasons_of_lines_that_are_left_out() -> None:
    ratios = Ratios(lines=200, wider=3)
    ratios.left_out.update({"RANGE": 3, "MEAN": 1})
    ratios.ratios["y", 0.0] = [1.01, 1.02, 1.03]
    shown = ratios_text({"Scene, FD": {"a.xodr": ratios}})
    assert "2 % (3 RANGE, 1 MEAN)" in shown
    assert "1.5 %" in shown
    assert "1.02 1.03" in shown


def test_the_command_shows_the_table(capsys: pytest.CaptureFixture[str]) -> None:
    def shown(*options: str) -> Any:
        assert main(["study", "maps", "--n", "2", *options]) == 0
        return capsys.readouterr().out

    first = shown()
    assert "town.xodr" in first
    assert "Scene, FD" in first
    assert first == shown("--seed", "0") != shown("--seed", "1")
