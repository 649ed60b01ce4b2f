"""Lines around a car that knows its pose with an error."""

from typing import Any

import numpy as np
import pytest
from support.lane_maps import lane, network, pose_on

from maplines_can import Gaussian, LeftOut, Slot
from maplines_can.maps.line_source import LineSource

ROWS = network(lane("l", t=3.5), lane("r"), rows=["l r"])
EXACT = np.diag([1e-8, 1e-8, 1e-10])


def exact(_: float, pose: Any) -> Gaussian:
    return Gaussian(pose, EXACT)


def test_the_slots_are_those_that_were_chosen() -> None:
    """And the changes are of these only."""
    pose = pose_on(ROWS.lanes["r"], 50.0)
    source = LineSource(ROWS, exact, slots=[Slot.EGO_LEFT, Slot.NEXT_LEFT])
    cycle = source.cycle(0.0, pose)
    assert [line.slot for line in cycle.lines] == [Slot.EGO_LEFT, Slot.NEXT_LEFT]
    assert cycle.changed == {Slot.EGO_LEFT, Slot.NEXT_LEFT}
    assert [line.gaussian.mean[0] for line in cycle.lines] == pytest.approx([1.75, 5.25])
    assert source.cycle(0.05, pose).changed == frozenset()


def test_the_lane_is_that_of_the_reported_pose() -> None:
    """The car does not know the true one."""

    def displaced(_: float, pose: Any) -> Gaussian:
        return Gaussian(pose + np.array([0.0, 3.5, 0.0]), EXACT)

    cycle = LineSource(ROWS, displaced).cycle(0.0, pose_on(ROWS.lanes["r"], 50.0))
    assert cycle.tracked.lane == "l"
    assert cycle.lines[0].gaussian.mean[0] == pytest.approx(1.75)


def test_lines_that_cannot_be_given_have_a_reason() -> None:
    """A car across the road."""
    cycle = LineSource(ROWS, exact).cycle(0.0, pose_on(ROWS.lanes["r"], 50.0, turn=np.pi / 2))
    assert not cycle.lines
    assert set(cycle.lines.left_out.values()) == {LeftOut.ACROSS}


@pytest.mark.parametrize("time", [None, 3.0])
def test_without_a_pose_there_are_no_lines(time: float | None) -> None:
    """Nor a pose error; with a pose they are there again."""
    poses = iter([True, False, True])

    def stated(t: float, pose: Any) -> Gaussian | None:
        return exact(t, pose) if next(poses) else None

    source, pose = LineSource(ROWS, stated, correlation_time=time), pose_on(ROWS.lanes["r"], 50.0)
    before, without, again = (source.cycle(t, pose) for t in (0.0, 0.1, 0.2))
    assert without.reported is None
    assert without.scene is None
    assert (without.lines, without.lines.left_out) == ([], {})
    assert without.tracked.match is None
    assert without.changed == {line.slot for line in before.lines}
    assert [line.slot for line in again.lines] == [line.slot for line in before.lines]


def test_with_a_correlation_time_a_cycle_has_the_joint_covariance() -> None:
    """Of the same lines; off the map there are none, and mixtures are refused."""
    pose = pose_on(ROWS.lanes["r"], 50.0)
    source = LineSource(ROWS, exact, correlation_time=3.0)
    cycle = source.cycle(0.0, pose)
    assert cycle.scene is not None
    assert list(cycle.scene.lines) == cycle.lines
    assert cycle.scene.pose_error.correlation_time == 3.0
    assert len(cycle.lines) == len(LineSource(ROWS, exact).cycle(0.0, pose).lines) > 0
    off = source.cycle(0.05, pose + np.array([0.0, 500.0, 0.0]))
    assert off.scene is not None
    assert (off.scene.lines, off.lines) == ((), [])
    assert LineSource(ROWS, exact).cycle(0.0, pose).scene is None
    with pytest.raises(ValueError, match="components must be 1 with a correlation_time"):
        LineSource(ROWS, exact, components=2, correlation_time=3.0)
