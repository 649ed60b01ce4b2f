"""The evidence on canyons: its courses are what they say, and its bounds can be missed."""

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
    import evidence_canyon

    return evidence_canyon


def test_the_errors_are_those_that_are_told(tool: Any) -> None:
    """In a canyon, (fix - pose) / sigma has a variance of 1 and the correlation time."""
    n = 200
    course = tool.made(tool.Kind("canyon"), n, np.random.default_rng(3))
    row = np.searchsorted(course.t, course.fix_t)
    white = course.cov[0, 0]
    off = (course.fixes - course.pose[row, :, :2]) / course.error[..., :1]
    share = white / course.canyon[:, 0] ** 2
    assert (off**2).mean(axis=(0, 2)).mean() == pytest.approx(1 + share.mean(), rel=0.1)
    lag = 10  # 2 s
    rho = (off[lag:] * off[:-lag]).mean(axis=(0, 2)).mean()
    assert rho == pytest.approx(np.exp(-2.0 / course.canyon[:, 1]).mean(), rel=0.1)


def test_events_are_where_they_belong(tool: Any) -> None:
    """A gap has no fixes, a jump is 100 m, outliers are a tenth."""
    rng = np.random.default_rng(4)
    gap = tool.made(tool.Kind("canyon", "gap"), 2, rng)
    missing = np.isnan(gap.fixes).all(axis=(1, 2))
    assert missing.sum() == 150
    assert (gap.fix_t[missing] >= tool.GAP[0]).all()
    jump = tool.made(tool.Kind("open", "jump"), 2, rng)
    row = np.searchsorted(jump.t, jump.fix_t)
    size = np.linalg.norm(jump.fixes - jump.pose[row, :, :2], axis=-1)
    assert np.median(size[(jump.fix_t >= 100) & (jump.fix_t < 110)]) == pytest.approx(100, abs=5)
    outliers = tool.made(tool.Kind("open", "outliers"), 20, rng)
    row = np.searchsorted(outliers.t, outliers.fix_t)
    size = np.linalg.norm(outliers.fixes - outliers.pose[row, :, :2], axis=-1)
    assert (size > 150).mean() == pytest.approx(0.1, abs=0.01)


def test_the_command_prints_the_figures(
    tool: Any, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of three cars for 60 s; the same seed gives the same ones."""
    monkeypatch.setattr(tool, "SECONDS", 60.0)
    found = []
    for seed in ("1", "1", "2"):
        arguments = ["evidence_canyon.py", "--course", "canyon, 1 Hz", "-n", "3", "--seed", seed]
        monkeypatch.setattr("sys.argv", [*arguments, "--json"])
        tool.main()
        found.append(json.loads(capsys.readouterr().out)["canyon, 1 Hz"])
    assert found[0] == found[1]
    assert found[0] != found[2]
    assert found[0]["known [%]"] == 100
    assert "| canyon |" in tool.table({"canyon": found[0]})[-1]


@pytest.mark.parametrize(
    ("changed", "kept"),
    [
        ({}, True),
        ({"inside [%]": 89.9}, False),
        ({"inside [%]": 99.1}, False),
        ({"cars": 2}, False),
        ({"RMS, ratio": 1.21}, False),
    ],
)
def test_each_bound_can_be_missed(tool: Any, changed: dict[str, float], kept: bool) -> None:
    right = {"inside [%]": 95.0, "cars": 1, "RMS, ratio": 1.2}
    assert tool.is_within(right | changed, 50) is kept
