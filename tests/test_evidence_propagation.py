"""The witness of the refit in tools/evidence_propagation.py, and it finds what is wrong."""

from dataclasses import replace

import evidence_propagation as tool
import numpy as np
import pytest
from line_witness import seen_from

from maplines_can import Polyline
from maplines_can.simulation.scenarios import SCENARIOS
from maplines_can.study.paper_refit import paper_refit


@pytest.mark.parametrize("name", SCENARIOS)
def test_the_refit_equals_its_witness(name: str) -> None:
    """Also in the street turn, whose lines turn back beyond the range of the fit."""
    scene = SCENARIOS[name]
    poses = scene.ego.sample(100, 1)
    assert tool.compare_refit(scene, paper_refit(scene), poses).max() <= tool.BOUNDS["refit"]


@pytest.mark.parametrize("name", SCENARIOS)
def test_a_refit_of_lines_a_micrometre_aside_is_found(name: str) -> None:
    scene = SCENARIOS[name]
    aside = {slot: Polyline(np.add(line.points, [0, 1e-6])) for slot, line in scene.lines.items()}
    refit = paper_refit(replace(scene, lines=aside))
    poses = scene.ego.sample(100, 1)
    assert tool.compare_refit(scene, refit, poses).max() > 100 * tool.BOUNDS["refit"]


def test_the_witness_is_a_fit_by_least_squares() -> None:
    """On an arc, against numpy, one pose at a time."""
    angle = np.linspace(-0.5, 1.2, 64)
    points = 20 * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    poses = SCENARIOS["street-turn"].ego.sample(20, 1)
    lines = tool.qr_refit(points, poses)
    for local, line in zip(seen_from(points, poses), lines, strict=True):
        u, v = local.T
        d, c, b, a = np.polyfit(u, v, 3)
        assert line == pytest.approx([a, np.arctan(b), 2 * c, 6 * d], rel=1e-9, abs=1e-12)
