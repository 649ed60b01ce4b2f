"""Transformation of lines against a refit of the map points from the new pose."""

from typing import Any

import numpy as np
import pytest

from maplines_can.propagation import Refit
from maplines_can.simulation.scenarios import SCENARIOS
from maplines_can.study.roads import PAPER, curve, paper_refit, random_scenarios
from maplines_can.values.errors import IllPosedError
from maplines_can.values.line import Slot, lateral, transform_line, transform_line_or_nan
from maplines_can.values.polyline import Polyline, to_ego

WINDOW = (0.0, 80.0)
MEAN = np.array([1.75, 0.02, 1e-3, 1e-6])


def far_motions() -> Any:
    """(260, 3) motions in any direction up to 5 m and 10 deg, many of them at the limits."""
    rng = np.random.default_rng(6)
    way, angle, turn = rng.uniform([0, 0, -1], [1, 2 * np.pi, 1], (200, 3)).T
    way[:50], turn[:50] = 1.0, np.sign(turn[:50])
    box = rng.uniform(-1, 1, (60, 3))
    box[:8] = np.sign(box[:8])
    around = np.column_stack([way * np.cos(angle), way * np.sin(angle), turn])
    return np.vstack([around, box]) * [5, 5, np.radians(10)]


def of_scene(name: Any, scatter: float = 0.0) -> Any:
    """The eight lines of a scene, with random errors of the map points [m]."""
    scene, roads = SCENARIOS[name], []
    window = scene.window[0] - 1, scene.window[1] + 1
    for i, line in enumerate(scene.lines.values()):
        noise = scatter * np.random.default_rng(i).normal(size=line.points.shape)
        roads.append(
            Refit(Polyline(line.points + noise), scene.ego.mean, window, **PAPER).points[0]
        )
    return roads


def arc(radius: Any, view: int = 100) -> Any:
    """A road of one radius, from 20 m behind the car [m]."""
    return [curve(-1.75, 0.0, np.full(51, 1 / radius), view / 50, -20.0)]


def random_roads() -> Any:
    """Those of 100 random roads with a radius of 500 m or more."""
    roads = []
    for scene in random_scenarios(100, seed=1):
        p = scene.lines[Slot.EGO_LEFT].points
        turn = np.diff(np.unwrap(np.arctan2(*np.diff(p, axis=0).T[::-1])))
        if np.abs(turn).max() / np.hypot(*(p[1] - p[0])) < 1 / 500:
            roads.append(paper_refit(scene, Slot.EGO_LEFT).points[0])
    assert len(roads) > 30
    return roads


@pytest.mark.parametrize(
    ("roads", "window", "bound"),
    [
        pytest.param(lambda: of_scene("highway"), None, 3e-5, id="highway"),
        pytest.param(lambda: of_scene("highway", 0.05), None, 1e-3, id="5-cm-of-noise"),
        pytest.param(lambda: arc(1000), None, 1e-5, id="1000-m"),
        pytest.param(lambda: arc(500), None, 1e-4, id="500-m"),
        pytest.param(lambda: arc(200), None, 1e-3, id="200-m"),
        pytest.param(lambda: arc(100, 60), None, 1e-3, id="100-m-for-60-m"),
        pytest.param(random_roads, None, 1e-3, id="random-roads"),
        # The message rounds the valid range inwards, so other points are fitted.
        pytest.param(lambda: arc(500), (-16.0, 72.0), 5e-4, id="500-m-shortened"),
    ],
)
def test_a_transformed_line_agrees_with_a_refit(roads: Any, window: Any, bound: float) -> None:
    """Up to 5 m and 10 deg, within 1 mm over the window if a cubic describes the road.

    Map points with and without noise.
    """
    for road in roads():
        around = road[:, 0].min() - 1, road[:, 0].max() + 1
        refit = Refit(Polyline(road), np.zeros(3), around, **PAPER)
        line, far = refit(np.zeros(3)), far_motions()
        valid = tuple(refit.x_range) if window is None else window
        ends = np.column_stack([valid, lateral(line, valid)])
        u = np.array([to_ego(ends, motion)[:, 0] for motion in far])
        x = u[:, :1] + (u[:, 1:] - u[:, :1]) * np.linspace(0, 1, 33)
        moved, refitted = transform_line(line, far, valid), refit(far)
        assert np.abs(lateral(moved[:, None], x) - lateral(refitted[:, None], x)).max() <= bound


def test_ill_posed_lines_are_rows_of_nan() -> None:
    """The other rows are those of single calls; transform_line raises."""
    lines = np.array([MEAN, [np.nan, 0, 0, 0], MEAN, MEAN, [0, 1.6, 0, 0], [0, 0, 0, 10.0]])
    displacements = np.array(
        [[1, 0, 0.1], [0, 0, 0], [0, 0, 1.5], [np.nan, 0, 0], [0, 0, 1.6], [1e99, 0, 0]]
    )
    got = transform_line_or_nan(lines, displacements, WINDOW)

    assert np.array_equal(np.isnan(got).all(axis=1), [False, True, True, True, True, True])
    assert np.array_equal(got[0], transform_line(lines[0], displacements[0], WINDOW))
    with pytest.raises(IllPosedError, match=r"after the displacement \[0\.\s+0\.\s+1\.5\]"):
        transform_line(lines[[0, 2]], displacements[[0, 2]], WINDOW)
