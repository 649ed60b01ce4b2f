"""Direction and amount of the nonlinearity of a function."""

import numpy as np
import pytest

from maplines_can import Gaussian, Polyline
from maplines_can.propagation import Refit, nonlinearity
from maplines_can.simulation.scenarios import scenario
from maplines_can.study.roads import paper_refit
from maplines_can.values.line import Slot


def test_a_refit_is_nonlinear_in_the_heading() -> None:
    """On the highway the direction is that of the heading, within a degree."""
    scene = scenario("highway-10deg")
    refit = paper_refit(scene, Slot.EGO_LEFT)
    direction, amount = nonlinearity(refit, scene.ego)
    assert abs(direction[2]) > np.cos(np.radians(1))
    assert amount > 0.9  # c0 depends on the heading mainly in second order
    assert nonlinearity(lambda x: 2 * x, scene.ego).amount == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("heading", [0.0, 0.3, 1.0])
def test_a_straight_line_is_linear_in_the_pose(heading: float) -> None:
    """Its curvature is zero but for rounding errors, which have no nonlinearity."""
    along = np.array([np.cos(heading), np.sin(heading)])
    line = Polyline(np.linspace(-100, 200, 151)[:, None] * along + [0.5, 1.5])
    ego = Gaussian([0.0, 0.0, heading], np.diag([0.3, 0.1, 0.0035]) ** 2)
    assert nonlinearity(Refit(line, ego.mean, (-20.0, 80.0)), ego).amount < 0.001
