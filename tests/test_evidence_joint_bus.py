"""tools/evidence_joint_bus.py: no wrong joint with few cycles, and a wrong one would be found."""

from collections import Counter
from types import SimpleNamespace
from typing import Any

import evidence_joint_bus as tool
import pytest

from maplines_can.wire.reception import epochs


@pytest.mark.parametrize("dbc", tool.CARRIERS.values())
def test_no_joint_is_wrong(dbc: str) -> None:
    """With all kinds of faults and both carriers; scenes are received under each of them."""
    result = tool.measure({"": tool.NumberedRecords(dbc)}, tool.DISTURBANCES, 900, seed=1)
    assert result["met"]
    for one in tool.DISTURBANCES:
        assert result[f": {one.name}"]["scenes"] > 20


@pytest.mark.parametrize(("dbc", "fd"), [(tool.CONDITIONAL, False), (tool.COMPLETE, True)])
def test_the_whole_chain(dbc: str, fd: bool) -> None:
    result = tool.measure({"": tool.WholeChain(dbc, fd=fd)}, tool.DISTURBANCES[-1:], 60, seed=1)
    assert result["met"]
    assert result["sum"]["scenes"] > 20


@pytest.mark.parametrize("dbc", tool.CARRIERS.values())
def test_a_wrong_joint_is_found(dbc: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the counters of lines were ignored, the tool would notice."""

    def first(self: Any, slot: Any, counter: int, t_ns: int) -> Any:
        fitting = [one for one in self._epochs if slot not in one.lines]
        return fitting[0] if fitting else None

    monkeypatch.setattr(epochs.EpochAssembler, "_epoch_of", first)
    chain = tool.NumberedRecords(dbc)
    result = tool.measure({"": chain}, tool.DISTURBANCES[5:6], 200, seed=1)
    assert result["sum"]["wrong_joints"] > 10
    assert not result["met"]


def test_a_scene_of_another_cycle_is_found_by_its_values() -> None:
    chain = tool.WholeChain(tool.CONDITIONAL, fd=False)
    slots, counters = tool.SLOTS, Counter[Any]()
    chain.write(3, slots, counters)
    scene = tool.road_scene(3)
    assert not +chain.check(scene)
    other = tool.road_scene(4)
    mixed: Any = SimpleNamespace(pose_error=scene.pose_error, lines=other.lines)
    assert chain.check(mixed) == {"wrong_joints": 1}
    for number in range(tool.SCENES):
        sigma = tool.LEAST * tool.RATIO**number
        assert tool.scene_number(sigma) == tool.scene_number(1.03 * sigma) == number
