"""The example of a simulated car: it keeps its lane, and slows down as it should."""

import runpy
from pathlib import Path

import numpy as np
import pytest
from support import fmus

pytest.importorskip("fmpy")
pytestmark = fmus.needs_compiler
EXAMPLE = Path(__file__).parents[2] / "examples" / "simulated_car" / "run.py"


def test_the_car_keeps_its_lane_through_a_tunnel_and_an_outage(tmp_path: Path) -> None:
    """The tunnel is from 3 s to 12 s, the outage at 16 s."""
    example = runpy.run_path(str(EXAMPLE))
    simulate = example["simulate"]
    simulate.__globals__["TUNNEL"] = (3.0, 12.0)
    moments, simulation = simulate(18.0, "loss=1@16-17")
    assert len(moments) == 18 / example["PERIOD"] + 1
    room = example["HALF_LANE"] - example["HALF_CAR"]
    assert max(abs(moment.offset) for moment in moments) < room
    t = np.array([moment.t for moment in moments])
    speed = np.array([moment.speed for moment in moments])
    sigma = np.array([moment.sigma for moment in moments])
    usable = np.array([moment.is_usable for moment in moments])
    assert speed[(t > 1) & (t < 3)].min() > 10
    assert sigma[t > 1][-1] < 0.12 < 0.17 < sigma[(t > 11) & (t < 12)].min()
    assert speed[(t > 11) & (t < 12)].max() < 0.7 * speed[(t > 1) & (t < 3)].min()
    assert usable[(t > 0.5) & (t < 16)].all()
    assert not usable[(t > 16.5) & (t < 17)].any()
    assert speed[(t > 16.9) & (t < 17.1)].max() < speed[(t > 15.9) & (t < 16.0)].min() - 2
    assert simulation.link.frames > 1500
    example["draw"](moments, tmp_path / "car.png")
    assert (tmp_path / "car.png").stat().st_size > 10_000
