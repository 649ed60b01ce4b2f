"""tools/evidence_chain.py: the first seconds of the chain without waiting, and its figures."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from maplines_can import Monitor

TOOLS = Path(__file__).parents[1] / "tools"
SECONDS = 2.0


@pytest.fixture
def tool(monkeypatch: pytest.MonkeyPatch) -> Any:
    """The tool as a module."""
    monkeypatch.syspath_prepend(str(TOOLS))
    import evidence_chain

    return evidence_chain


def test_the_car_starts_by_received_lines(tool: Any) -> None:
    """It drives off in its lane, and nothing is lost; the figures are those of the seed."""
    found = tool.simulated(SECONDS, seed=1)
    assert found["met"]
    assert found["cycles"] == 20 * SECONDS
    assert found["sender"]["lines"] == found["receiver"]["lines"] == 3 * 20 * SECONDS
    assert found["km"] > 0.001
    assert found["error of the car [m]"]["max"] < 0.3
    assert found["share of the time driven by the lines"] > 0.5
    # 0.04 s of its own, up to 4 ms of the message, and a cycle, of which all lines have come
    assert found["age of the lines, median and 95 % [s]"] == [0.094, 0.094]


def moment(tool: Any, error: float, state: str) -> Any:
    from chain_parts import Moment

    centre = np.full((3, 2), np.nan)
    return Moment(0.0, 0.0, error, tool.SteeringState[state], "BAND", 0.05, centre)


@pytest.mark.parametrize(
    ("moments", "arrived", "met", "handovers"),
    [
        pytest.param([(0.1, "DRIVING")] * 3, 30, True, 0, id="in-the-lane"),
        pytest.param([(0.1, "DRIVING"), (0.9, "SLOWING")], 30, False, 0, id="off-the-lane"),
        pytest.param([(0.1, "DRIVING"), (0.9, "HANDOVER")], 30, True, 1, id="handed-over"),
        pytest.param([(0.1, "DRIVING")] * 3, 29, False, 0, id="a-line-lost"),
        pytest.param([(0.1, "HANDOVER")] * 3, 30, False, 0, id="never-driven"),
    ],
)
def test_what_is_met(
    tool: Any, moments: Any, arrived: int, met: bool, handovers: int, monkeypatch: Any
) -> None:
    monkeypatch.setattr(tool, "fused_nees", lambda _: np.ones((2, 3)))
    consumer = SimpleNamespace(
        moments=[moment(tool, *one) for one in moments], world=SimpleNamespace(t=1.0)
    )
    sent, received = {"lines": 30, "frames": 90}, {"lines": arrived, "frames": 90}
    found = tool.figures_of(consumer, sent, received)
    assert found["met"] is met
    assert found["handovers"] == handovers


def test_the_shares_of_a_core_add_up(tool: Any) -> None:
    sender = {"all": 5.0, "simulation": 1.0, "localisation": 1.5, "lines": 2.0}
    receiver = {"all": 3.0, "simulation": 0.5, "fusion": 1.0, "steering": 0.5}
    found = tool.shares_of(sender, receiver, 10.0)
    assert found["sender"] == pytest.approx(0.4)
    assert sum(found["sender: its parts"].values()) == pytest.approx(0.4)
    assert found["receiver: its parts"]["reception"] == pytest.approx(0.1)
    assert found["receiver: simulation"] == pytest.approx(0.05)


def test_the_mean_over_seeds_and_its_standard_error(tool: Any) -> None:
    """Places that a drive does not show are left out."""
    drives = [
        {"met": True, "sender": {tool.POSE_NEES: x}, tool.FUSED: [x, 2.0, 1.0]}
        | {tool.OUTAGE: [x, np.nan, np.nan]}
        for x in (1.0, 3.0)
    ]
    found = tool.over_seeds(drives)
    assert found["met"]
    assert found[tool.POSE_NEES]["mean"] == [2.0]
    assert found[tool.FUSED]["mean"] == [2.0, 2.0, 1.0]
    assert found[tool.FUSED]["standard error"] == [1.0, 0.0, 0.0]  # sqrt(2) / sqrt(2)
    assert found[tool.OUTAGE]["mean"] == pytest.approx([2.0, np.nan, np.nan], nan_ok=True)
    assert not tool.over_seeds([drives[0], drives[1] | {"met": False}])["met"]


def test_a_driver_brings_the_car_back_to_its_lane(tool: Any) -> None:
    """Without lines, the car stands 2.6 m off the lane; the driver comes after a while."""
    from chain_parts import PAUSE, Consumer, World

    world = World(1)
    x, y, heading = world.car.pose
    world.car.pose = np.array([x - 2.6 * np.sin(heading), y + 2.6 * np.cos(heading), heading])
    consumer = Consumer(world, Monitor(tool.codec_of(tool.DBC).decoder()))
    for _ in range(400):
        consumer.step(0, round(1e9 * world.t))
        consumer.drive(consumer.demands, 0.0)
    error = np.array([m.error for m in consumer.moments])
    t = tool.PERIOD * np.arange(len(error))
    assert error[t < PAUSE] == pytest.approx(2.6, abs=0.01)
    assert (np.abs(error[t > 15.0]) < 0.3).all()
