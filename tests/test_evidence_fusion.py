"""tools/evidence_fusion.py and tools/evidence_integrity.py in small."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

TOOLS = Path(__file__).parents[1] / "tools"


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The tool as a module."""
    monkeypatch.syspath_prepend(str(TOOLS))
    import evidence_fusion

    return evidence_fusion


def test_a_short_fusion(
    tool: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Of one correlation time; wrong ways are far from the right ones."""
    monkeypatch.setattr(tool, "TIMES", (30.0,))
    monkeypatch.setattr(tool, "STRETCHES", {"motorway": (320.0, 380.0)})
    plot = tmp_path / "fusion.png"
    options = ["--seeds", "20", "--seconds", "12", "--rate", "5", "--only", "fusion"]
    tool.main([*options, "--plot", str(plot), "--json"])
    ways = json.loads(capsys.readouterr().out)["fusion"]["motorway"]["30 s"]
    assert set(ways) == {*tool.RIGHT, *tool.WRONG}
    right, wrong = ways["pose error as state"], ways["joint, cycles independent"]
    assert max(right["nees"]) < 1.8 < 3 < max(wrong["nees"])
    assert right["rms"][1] < wrong["rms"][1]
    assert plot.stat().st_size > 10_000


def test_received_lines_against_the_truth(
    tool: Any, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tool, "DRIVE", 2.0)
    tool.main(["--seeds", "3", "--rate", "5", "--only", "received", "--json"])
    found = json.loads(capsys.readouterr().out)["received"]
    assert 15 <= found["scenes"] <= 30
    assert 0.05 < found["single lines"][0] < 6
    assert 0.05 < found["joint"][0] < 6


def test_misses_are_found(tool: Any) -> None:
    def result(right: float, wrong: float, received: float) -> Any:
        ways = {"pose error as state": right, "joint, cycles independent": wrong}
        figures = {way: {"nees": [0.9, nees, 0.8]} for way, nees in ways.items()}
        return {
            "fusion": {"streets": {"1 s": figures}},
            "received": {"single lines": [received, np.nan, 0.5], "joint": [1.0, 1.0, 1.0]},
        }

    assert tool.misses_of(result(1.0, 5.0, 1.0), 1.4) == []
    assert len(tool.misses_of(result(1.5, 1.2, 1.5), 1.4)) == 3
    assert tool.upper_bound(50) == pytest.approx(1.428, abs=1e-3)


def test_the_integrity_of_a_short_drive(
    tool: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import evidence_integrity

    del tool
    monkeypatch.setattr(evidence_integrity, "TIMES", (5.0,))
    monkeypatch.setattr(evidence_integrity, "STRETCHES", {"motorway": (320.0, 380.0)})
    plot = tmp_path / "stanford.png"
    options = ["--draws", "1000", "--scenes", "3", "--seeds", "10", "--seconds", "3"]
    status = evidence_integrity.main([*options, "--plot", str(plot), "--json"])
    result = json.loads(capsys.readouterr().out)
    assert status == 0
    assert result["met"]
    for figures in result["in time"].values():
        assert figures["sampled"] < figures["bound"] < 1.2e-5
    assert result["diagram"]["motorway, 0 m"]["misleading"] == 0
    assert plot.stat().st_size > 10_000


def test_too_low_a_level_is_found(tool: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nine tenths of the multiplier of sigma."""
    import evidence_integrity

    del tool
    from maplines_can.consumers.integrity import multiplier as true

    monkeypatch.setattr(evidence_integrity, "multiplier", lambda *a: 0.9 * true(*a))
    monkeypatch.setattr(evidence_integrity, "TIMES", (1.0,))
    found = evidence_integrity.in_time(type("Arguments", (), {"seed": 1, "draws": 300})())
    assert not any(figures["met"] for figures in found.values())
