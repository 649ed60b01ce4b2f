"""Cycles without a record are counted once, however often the time is looked at."""

from typing import Any

from hypothesis import given
from hypothesis import strategies as st

from maplines_can.wire.reception.deadline import ReceptionDeadline

CYCLE = 100


@given(st.lists(st.integers(0, 400), max_size=30), st.integers(1, 2000))
def test_the_count_does_not_depend_on_who_asks(steps: Any, end: int) -> None:
    """Missed are the whole cycles from 1.5 cycles after the record on."""
    once, often = ReceptionDeadline(CYCLE), ReceptionDeadline(CYCLE)
    once.record_arrived(0)
    often.record_arrived(0)
    times = sorted({min(sum(steps[: i + 1]), end) for i in range(len(steps))})

    assert sum(often.elapse(t) for t in [*times, end]) == once.elapse(end)
    assert once.elapse(end) == 0
    fresh = ReceptionDeadline(CYCLE)
    fresh.record_arrived(0)
    assert fresh.elapse(end) == max(0, (end - 150) // CYCLE + 1)


def test_nothing_is_missed_before_the_first_record() -> None:
    """A slot that was never heard has no deadline."""
    assert ReceptionDeadline(CYCLE).elapse(10**9) == 0


def test_a_backlog_is_not_counted_again() -> None:
    """Records that waited in a queue come after the cycles in which they were missed."""
    deadline = ReceptionDeadline(CYCLE)
    deadline.record_arrived(0)
    assert deadline.elapse(1000) == 9
    assert [deadline.record_arrived(t) for t in range(100, 1001, 100)] == [0] * 10
    assert deadline.elapse(1149) == 0
    assert deadline.elapse(1150) == 1


def test_a_clock_that_is_set_back_starts_a_new_deadline() -> None:
    """Else nothing would be missed until the clock is where it was."""
    deadline = ReceptionDeadline(CYCLE)
    deadline.record_arrived(10**9)
    assert deadline.elapse(0) == 0
    assert deadline.elapse(150) == 1
