"""tools/evidence_scan_matching.py on a few scans."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from maplines_can.maps import Map, load, town_path, town_tour
from maplines_can.simulation.trajectory import drive_along

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


def test_each_localisation_has_its_figures(
    tool: Any, town: Map, monkeypatch: pytest.MonkeyPatch
) -> None:
    """That which takes the error of the map as white noise states less than the other one."""
    monkeypatch.setattr(tool, "FED_SPAN", (54.0, 56.0))
    way = drive_along(town, town_tour(town))
    found = tool.localised(town, way, "NDT", SimpleNamespace(seeds=2, seed=3))
    assert [*found] == [
        f"localisation, NDT{rest}" for rest in ("", " and GNSS", " and GNSS, taken as white")
    ]
    alone, both, white = found.values()
    assert white["stated sigma of x, y [m]"] < 0.9 * both["stated sigma of x, y [m]"]
    assert both["stated sigma of x, y [m]"] <= alone["stated sigma of x, y [m]"]
    assert sum(alone["poses"].values()) == 2 * 2  # the history of 0.5 s is not counted


@pytest.mark.parametrize(("scale", "is_met"), [(1.0, True), (1.3, False)])
def test_a_localisation_that_is_overconfident_is_found(
    tool: Any, scale: float, is_met: bool
) -> None:
    """That which is taken as white is met if it is overconfident."""
    k, n = 120, 50
    root = np.diag([0.1, 0.05, 0.002])
    errors = scale * np.random.default_rng(5).standard_normal((k, n, 3)) @ root
    covs = np.broadcast_to(root @ root, (k, n, 3, 3))
    run = tool.Run(np.arange(k) / 2, errors, covs, np.zeros(k), np.ones((k, n, 3)), [], {})
    found = tool.fed_figures(run, is_white=False)
    assert found["met"] is is_met
    assert tool.fed_figures(run, is_white=True)["met"] is not is_met
    assert found["NEES"] == pytest.approx(3 * scale**2, rel=0.03)
    rms = [float(one) for one in found["RMS along, across [m]"].split(", ")]
    assert rms == pytest.approx([scale * 0.1, scale * 0.05], rel=0.05)


def test_a_match_that_is_not_valid_is_missing(tool: Any) -> None:
    bad = tool.match_ndt(None, np.zeros((3, 2)), np.zeros(3))  # too few points
    good = bad._replace(cov=0.05 * np.eye(3), shared=0.04 * np.eye(3), is_valid=True)
    fix = tool.pose_fix(1.0, [good, bad])
    assert np.isnan(fix.pose).tolist() == [[False] * 3, [True] * 3]
    assert fix.cov == pytest.approx(np.array([0.01 * np.eye(3), np.eye(3)]))
    assert fix.shared[0] == pytest.approx(0.04 * np.eye(3))
