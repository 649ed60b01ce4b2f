"""The commands ``claims``, ``figures`` and ``scenarios``."""

import csv
import json
from pathlib import Path

import pytest
from support.fixtures import Capture, Patch

from maplines_can.cli import main
from maplines_can.pictures.figure import new_figure
from maplines_can.simulation.scenarios import SCENARIOS, STREETS
from maplines_can.study.figures import paper as figures


def test_figures_are_written_to_the_folder(
    capsys: Capture, tmp_path: Path, monkeypatch: Patch
) -> None:
    """An empty picture of one figure; tests of the figures check what they show."""
    pytest.importorskip("matplotlib")
    plans = [plan for plan in figures.FIGURES if plan.number == 8]
    monkeypatch.setattr(figures, "FIGURES", plans)
    monkeypatch.setattr(figures, "draw_case", lambda *_: new_figure(1, 1))
    assert main(["figures", "--out", str(tmp_path), "--samples", "1000", "--json"]) == 0
    paths = json.loads(capsys.readouterr().out)
    names = [plans[0].name(wire=wire) for wire in (False, True)]
    assert [Path(path).name for path in paths] == [
        f"{name}.{suffix}" for name in names for suffix in ("png", "svg")
    ]
    assert all(Path(path).stat().st_size for path in paths)


def test_claims_as_csv(capsys: Capture, monkeypatch: Patch) -> None:
    """There is a row for each representation, before and after the bus."""
    monkeypatch.setattr("maplines_can.study.representations.DRAWS", 2000)
    arguments = ["claims", "--scenario", "production", "--samples", "1000", "--format", "csv"]
    assert main(arguments) == 0
    rows = list(csv.DictReader(capsys.readouterr().out.splitlines()))
    assert {row["wire"] for row in rows} == {"before", "after"}
    assert len(rows) >= 2 * 6


def test_scenarios_are_listed(capsys: Capture) -> None:
    """By name, as text and as JSON."""
    assert main(["scenarios"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in SCENARIOS | STREETS)
    assert main(["scenarios", "--json"]) == 0
    assert [row["name"] for row in json.loads(capsys.readouterr().out)] == list(SCENARIOS | STREETS)
