"""Direction and amount of the nonlinearity of a function."""

import numpy as np
import pytest

from maplines_can.line import Slot
from maplines_can.propagation import nonlinearity
from maplines_can.scenarios import scenario
from maplines_can.study.paper_refit import paper_refit


def test_a_refit_is_nonlinear_in_the_heading() -> None:
    """On the highway the direction is that of the heading, within a degree."""
    scene = scenario("highway-10deg")
    refit = paper_refit(scene, Slot.EGO_LEFT)
    direction, amount = nonlinearity(refit, scene.ego)
    assert abs(direction[2]) > np.cos(np.radians(1))
    assert amount > 0.9  # c0 depends on the heading mainly in second order
    assert nonlinearity(lambda x: 2 * x, scene.ego).amount == pytest.approx(0, abs=1e-9)
