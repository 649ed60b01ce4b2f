"""Which records of a slot are new, by their counters, contents and times."""

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.e2e_streams import CYCLE, MS, Received

from maplines_can.wire import E2EState, ProfileStatus, Reason

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


def slot_at(last: int, t_ns: int = 10_000 * MS) -> Received:
    """Return a check whose last new record, of this counter, came at ``t_ns``."""
    slot = Received()
    for k in range(last - 59, last + 1):
        assert slot.received(k % 256, k, t_ns + (k - last) * CYCLE) is None
    assert (slot.check.state, slot.check.lost) == (VALID, 0)
    return slot


@pytest.mark.parametrize(
    ("ahead", "cycles", "reason", "lost"),
    [
        pytest.param(1, 1, None, 0, id="next"),
        pytest.param(2, 1, None, 1, id="one-lost"),
        pytest.param(126, 126, None, 125, id="almost-half-a-round"),
        pytest.param(127, 127, None, 126, id="just-below-half-a-round"),
        pytest.param(126, 9, Reason.STALE, 0, id="sooner-than-it-can-be-sent"),
        pytest.param(128, 9, Reason.STALE, 0, id="half-a-round"),
        pytest.param(129, 9, Reason.STALE, 0, id="just-above-half-a-round"),
        pytest.param(255, 1, Reason.STALE, 0, id="one-behind"),
    ],
)
def test_half_a_round_of_the_counter_divides_new_from_late(
    ahead: int, cycles: int, reason: Reason | None, lost: int
) -> None:
    """Less than half a round ahead is new if there was time to send it, all else late."""
    slot = slot_at(42)
    assert slot.received((42 + ahead) % 256, -1, 10_000 * MS + cycles * CYCLE) is reason
    assert slot.check.lost == lost


def fast_slot(lines: int, pace: int) -> tuple[Received, int]:
    """Return a check of a sender of so many lines, ``pace`` in a cycle, and the last time."""
    slot = Received()
    for k in range(lines):
        assert slot.received(k % 256, k, k * CYCLE // pace) is None
    return slot, (lines - 1) * CYCLE // pace


@pytest.mark.parametrize(
    ("lines", "pace", "cycles", "most"),
    [
        pytest.param(400, 10, 4, 41, id="ten-times-faster"),
        pytest.param(400, 20, 4, 41, id="no-more-than-that"),
        pytest.param(400, 1, 9, 16, id="as-the-dbc-says"),
        pytest.param(9, 5, 9, 20, id="after-eight-intervals"),
    ],
)
def test_how_many_lines_a_fast_sender_may_lose(
    lines: int, pace: int, cycles: int, most: int
) -> None:
    """As many as it can send in the time, by the mean interval of about eight lines.

    The mean begins with the cycle. After eight intervals of 1/5 of it, 0.34 = (7/8)^8 of that is
    left: 0.47 cycles, so 9 cycles are ceil(9 / 0.47 + 0.5) = 20 lines.
    """
    for ahead in (most, most + 1):
        slot, t_ns = fast_slot(lines, pace)
        reason = slot.received((lines - 1 + ahead) % 256, -1, t_ns + cycles * CYCLE)
        assert reason is (None if ahead == most else Reason.STALE)
