"""Cycles without a record are counted once, however often the time is looked at."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.wire.reception.history import ReceptionDeadline

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


@pytest.mark.parametrize(("t_ns", "missed"), [(149, 0), (150, 1), (249, 1), (250, 2)])
def test_a_record_that_comes_late_returns_what_was_missed(t_ns: int, missed: int) -> None:
    """As if the time had been looked at just before it."""
    deadline = ReceptionDeadline(CYCLE)
    assert deadline.record_arrived(0) == 0
    assert deadline.record_arrived(t_ns) == missed
    assert deadline.elapse(t_ns + 149) == 0
    assert deadline.elapse(t_ns + 150) == 1


def test_a_backlog_out_of_order_is_not_counted_again() -> None:
    """The record that is due with the last missed cycle, then one before it."""
    deadline = ReceptionDeadline(CYCLE)
    deadline.record_arrived(0)
    assert deadline.elapse(1000) == 9
    assert [deadline.record_arrived(t) for t in (900, 800)] == [0, 0]
    assert deadline.elapse(1049) == 0


@pytest.mark.parametrize("looks", [False, True])
def test_a_record_with_an_earlier_time_is_followed_by_the_next_cycle(looks: bool) -> None:
    """Nothing was missed before it, so it has the deadline of any record."""
    deadline = ReceptionDeadline(CYCLE)
    deadline.record_arrived(1000)
    if looks:
        assert deadline.elapse(1100) == 0
    assert deadline.record_arrived(900) == 0
    assert deadline.elapse(1049) == 0
    assert deadline.elapse(1050) == 1


@pytest.mark.parametrize(("t_ns", "due_ns"), [(900, 1150), (899, 1049)])
def test_a_clock_is_set_back_by_more_than_a_cycle(t_ns: int, due_ns: int) -> None:
    """Relative to the last record; less is the jitter of time stamps."""
    deadline = ReceptionDeadline(CYCLE)
    deadline.record_arrived(1000)
    assert deadline.elapse(t_ns) == 0
    assert deadline.elapse(due_ns - 1) == 0
    assert deadline.elapse(due_ns) == 1


def test_after_the_clock_is_set_back_nothing_was_counted() -> None:
    """A record moves the deadline in either direction again."""
    deadline = ReceptionDeadline(CYCLE)
    deadline.record_arrived(0)
    assert deadline.elapse(1000) == 9
    assert deadline.elapse(100) == 0
    assert deadline.record_arrived(50) == 0
    assert deadline.elapse(200) == 1
