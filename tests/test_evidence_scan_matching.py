"""tools/evidence_scan_matching.py on a few scans."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from maplines_can.ego import drive_along
from maplines_can.maps import Map, load, town_path, town_tour

TOOLS = Path(__file__).parents[1] / "tools"


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The tool as a module."""
    monkeypatch.syspath_prepend(str(TOOLS))
    import evidence_scan_matching

    return evidence_scan_matching


@pytest.fixture(scope="module")
def town() -> Map:
    return load(town_path())


def test_a_worse_map_gives_worse_poses(
    tool: Any, town: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By NDT on Main Street; with an error of 0.5 m, the bound of 0.1 m is missed."""
    monkeypatch.setattr(tool, "SPAN", (10.0, 22.0))
    monkeypatch.setattr(tool, "METHODS", {"NDT": tool.match_ndt, "ICP": tool.match_ndt})
    way = drive_along(town, town_tour(town))
    arguments = SimpleNamespace(step=2.0, seed=1)
    good = tool.compared(town, way, 0.0, arguments)
    assert good["met"]
    assert good["scans"] == good["NDT valid"] == 6
    assert good["NDT vs ICP, RMS x, y [m]"] == "0.000, 0.000"
    bad = tool.compared(town, way, 0.5, arguments)
    assert not bad["met"]


def test_the_displacement_is_as_stated(tool: Any, town: Map) -> None:
    """Of each house as a whole, and of each pole."""
    moved = tool.displaced(town, 0.05, np.random.default_rng(2))
    pairs = zip(moved.buildings, town.buildings, strict=True)
    shifts = np.array([one.points - other.points for one, other in pairs])
    assert np.ptp(shifts, axis=1).max() < 1e-9
    assert shifts.std() == pytest.approx(0.05, rel=0.25)
    both = zip(moved.landmarks, town.landmarks, strict=True)
    poles = np.array([(one.x - other.x, one.y - other.y) for one, other in both])
    assert poles.std() == pytest.approx(0.05, rel=0.15)
