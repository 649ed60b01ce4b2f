"""The sequence check of one slot, without a decoder."""

from typing import Any

import numpy as np
import pytest
from e2e_streams import CYCLE, MS
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.wire import E2EConfig, E2EState, ProfileStatus, Reason, SequenceCheck

VALID, INVALID = E2EState.VALID, E2EState.INVALID
NONEWDATA = ProfileStatus.NONEWDATA


@pytest.mark.parametrize(("good", "confirmed"), [(10, True), (30, True), (40, False)])
def test_rare_conflicts_do_not_add_up(good: int, confirmed: bool) -> None:
    """An occasional other record with a counter that was received before is an accident."""
    slot, t_ns = SequenceCheck(E2EConfig(), 256, 4, CYCLE), 0
    for k in range(12 * good):
        slot.received(k % 256, k, t_ns)
        if k % good == 0:
            assert slot.received(k % 256, -1, t_ns + 30 * MS) is Reason.STALE
        t_ns += CYCLE
    assert slot.two_senders is confirmed


@pytest.mark.parametrize(("share", "confirmed"), [(0.5, False), (0.7, False), (1.0, True)])
def test_lines_that_are_received_twice(share: float, confirmed: bool) -> None:
    """Two senders of the same lines look like this; one line in a hundred is lost."""
    rng = np.random.default_rng(5)
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    for k in range(400):
        for again in (False, True):
            if rng.random() < (share if again else 1) * 0.99:
                slot.received(k % 256, k, k * CYCLE + again * 10 * MS)
    assert slot.two_senders is confirmed


def test_a_line_lost_256_lines_after_another_is_counted() -> None:
    """The counter of the last loss is not remembered for that long."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    for k in [*range(11), *range(12, 256 + 10), *range(256 + 11, 256 + 20)]:
        slot.received(k % 256, k % 256, k * CYCLE)
    assert slot.lost == 2


@given(st.lists(st.integers(0, 400), min_size=1, max_size=20))
def test_cycles_without_data_do_not_depend_on_the_calls(steps_ms: Any) -> None:
    """The first is due 1.5 cycles after the last record, and the next ones every cycle."""
    asked, once = (SequenceCheck(E2EConfig(), 256, 4, CYCLE) for _ in range(2))
    now = 0
    for slot in (asked, once):
        for k in range(10):
            slot.received(k, k, k * CYCLE)
    for step in steps_ms:
        now += step * MS
        asked.elapse(9 * CYCLE + now)
    once.elapse(9 * CYCLE + now)
    assert asked.statuses == once.statuses
    assert asked.state is once.state
    assert once.statuses[NONEWDATA] == max(0, (now + CYCLE // 2) // CYCLE - 1)


def test_a_clock_that_is_set_back_does_not_keep_a_slot_valid() -> None:
    """Silence is counted from the new time on."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    for k in range(10):
        slot.received(k, k, 10**18 + k * CYCLE)
    assert slot.elapse(5) is VALID
    assert slot.elapse(5 + 7 * CYCLE) is INVALID


@pytest.mark.parametrize("asks_every_ms", [None, 10, 50, 200])
def test_a_backlog_is_not_missed_twice(asks_every_ms: int | None) -> None:
    """Old frames after a pause of the receiver were counted as missing once already."""
    slot, now, asked = SequenceCheck(E2EConfig(), 256, 4, CYCLE), 0, 0
    for k in range(10):
        slot.received(k, k, k * CYCLE)
    stopped, now = 9 * CYCLE, 9 * CYCLE + 2000 * MS
    slot.elapse(now)
    missed = slot.statuses[NONEWDATA]
    assert missed == 39
    for k in range(10, 40):  # at once, with the times at which they came
        slot.received(k, k, stopped + (k - 9) * CYCLE)
        now += MS
        if asks_every_ms and now - asked > asks_every_ms * MS:
            slot.elapse(now)
            asked = now
    assert slot.statuses[NONEWDATA] == missed
    slot.received(50, 50, now)
    assert slot.elapse(now + 74 * MS) is slot.state
    assert slot.statuses[NONEWDATA] <= missed + 1
