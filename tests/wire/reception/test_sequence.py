"""Which records of a slot are new, by their counters, contents and times."""

from typing import Any

from hypothesis import given
from hypothesis import strategies as st
from support.e2e_streams import CYCLE, MS, Received

from maplines_can.wire import E2EState, ProfileStatus

VALID, INVALID = E2EState.VALID, E2EState.INVALID
NONEWDATA = ProfileStatus.NONEWDATA


@given(st.lists(st.integers(0, 400), min_size=1, max_size=20))
def test_cycles_without_data_do_not_depend_on_the_calls(steps_ms: Any) -> None:
    """The first is due 1.5 cycles after the last record, and the next ones every cycle."""
    asked, once = (Received() for _ in range(2))
    now = 0
    for slot in (asked, once):
        for k in range(10):
            slot.received(k, k, k * CYCLE)
    for step in steps_ms:
        now += step * MS
        asked.check.elapse(9 * CYCLE + now)
    once.check.elapse(9 * CYCLE + now)
    assert asked.check.statuses == once.check.statuses
    assert asked.check.state is once.check.state
    assert once.check.statuses[NONEWDATA] == max(0, (now + CYCLE // 2) // CYCLE - 1)


def test_a_clock_that_is_set_back_does_not_keep_a_slot_valid() -> None:
    """Silence is counted from the new time on."""
    slot = Received()
    for k in range(10):
        slot.received(k, k, 10**18 + k * CYCLE)
    assert slot.check.elapse(5) is VALID
    assert slot.check.elapse(5 + 7 * CYCLE) is INVALID
