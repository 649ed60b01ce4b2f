"""The latest epoch: the newest one with lines that waits for none, whatever comes and when."""

from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from maplines_can.values.line import Slot
from maplines_can.wire.reception.scenes import EpochAssembler

SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.ROUTE)
CYCLE = 100


@st.composite
def drives(draw: Any) -> list[tuple[int, Slot | None, int]]:
    """Times, slots (None for a pose error) and cycles of records, each perhaps late or lost."""
    cycles = draw(st.integers(1, 12))
    events = []
    for cycle in range(cycles):
        for slot in (None, *SLOTS):
            if draw(st.integers(0, 3)):
                late = draw(st.sampled_from([0, 0, 0, 20, 60, 130, 250]))
                t = CYCLE * cycle + (0 if slot is None else 10 + late)
                events.append((t, slot, cycle))
    return sorted(events, key=lambda event: event[0])


def assembler() -> EpochAssembler[int, int]:
    return EpochAssembler(dict.fromkeys(SLOTS, 3), CYCLE, has_mixtures=False)


def feed(epochs: EpochAssembler[int, int], event: tuple[int, Slot | None, int]) -> None:
    t_ns, slot, cycle = event
    if slot is None:
        epochs.add_pose(cycle, dict.fromkeys(SLOTS, cycle % 8), t_ns)
    else:
        epochs.add_line(cycle, slot, cycle, t_ns)


@settings(max_examples=100)
@given(drives())
def test_the_latest_epoch_has_lines_and_does_not_go_back(events: Any) -> None:
    """Records of one path come in the order of their cycles, or late by less than three."""
    epochs, with_lines, last = assembler(), set(), -1
    for event in events:
        feed(epochs, event)
        with_lines |= {epoch.pose for epoch in epochs.epochs if epoch.lines}
        latest = epochs.latest
        if latest is None:
            continue
        assert latest.lines
        assert all(line == latest.pose for line in latest.lines.values())
        assert latest.pose >= last
        last = latest.pose
    if with_lines:
        assert epochs.latest is not None


@settings(max_examples=100)
@given(drives(), st.integers(1, 10))
def test_after_a_silence_it_is_the_newest_with_a_line(events: Any, steps: int) -> None:
    """However many lines it waited for: each epoch is given up after five cycles.

    While time passes, it does not go back, and an epoch that may still get lines is not taken.
    """
    epochs, with_lines = assembler(), set()
    for event in events:
        feed(epochs, event)
        with_lines |= {epoch.pose for epoch in epochs.epochs if epoch.lines}
    end = max((t for t, _, _ in events), default=0)
    last = -1 if epochs.latest is None else epochs.latest.pose
    at_end = last
    for k in range(1, steps + 1):
        t_ns = end + k * 600 // steps
        epochs.expire(t_ns)
        waiting = {epoch.pose for epoch in epochs.epochs}
        if epochs.latest is not None:
            assert epochs.latest.lines
            assert epochs.latest.pose >= last
            last = epochs.latest.pose
            assert last == at_end or last not in waiting
    newest = max(with_lines, default=None)
    assert (None if epochs.latest is None else epochs.latest.pose) == newest
    assert not epochs.epochs
    assert epochs.pending == 0
