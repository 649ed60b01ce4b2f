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


def slot_at(last: int, t_ns: int = 10_000 * MS) -> SequenceCheck:
    """Return a check whose last new record, of this counter, came at ``t_ns``."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    for k in range(last - 59, last + 1):
        assert slot.received(k % 256, k, t_ns + (k - last) * CYCLE) is None
    assert (slot.state, slot.lost) == (VALID, 0)
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
    assert slot.lost == lost


@pytest.mark.parametrize("cycles", [126, 127, 128, 129, 200])
def test_half_a_round_is_never_a_loss(cycles: int) -> None:
    """After a silence this long a counter half a round ahead is that of a restarted sender."""
    slot = slot_at(42)
    assert slot.received(42 + 128, -1, 10_000 * MS + cycles * CYCLE) is None
    assert slot.lost == 0


@pytest.mark.parametrize("behind", [120, 127, 128])
def test_a_restart_after_silence_is_no_loss(behind: int) -> None:
    """A sender that restarts half a round behind its last record has lost none of its records."""
    slot = slot_at(behind + 1)
    assert slot.received(1, -1, 10_000 * MS + 100 * CYCLE) is None
    assert slot.lost == 0


def test_two_records_behind_are_no_restart_yet() -> None:
    """However far apart in time: three consecutive ones are."""
    slot, t_ns = slot_at(42), 10_000 * MS
    assert slot.received(0, -1, t_ns + 1 * CYCLE) is Reason.STALE
    assert slot.received(1, -2, t_ns + 3 * CYCLE) is Reason.STALE
    assert slot.received(2, -3, t_ns + 4 * CYCLE) is None
    assert slot.state is not VALID


@pytest.mark.parametrize("interrupted_by", [43, 7])
def test_a_restart_needs_consecutive_records(interrupted_by: int) -> None:
    """A new record, or one that does not follow, begins the count again."""
    slot, t_ns = slot_at(42), 10_000 * MS
    assert slot.received(0, -1, t_ns + 1 * CYCLE) is Reason.STALE
    assert slot.received(1, -2, t_ns + 2 * CYCLE) is Reason.STALE
    slot.received(interrupted_by, -3, t_ns + 3 * CYCLE)
    assert slot.received(2, -4, t_ns + 4 * CYCLE) is Reason.STALE


def test_a_restart_takes_more_than_a_cycle() -> None:
    """Three records at once are a queue that a gateway held back."""
    slot, t_ns = slot_at(42), 10_000 * MS
    assert slot.received(0, -1, t_ns + CYCLE) is Reason.STALE
    assert slot.received(1, -2, t_ns + CYCLE + CYCLE // 2) is Reason.STALE
    assert slot.received(2, -3, t_ns + 2 * CYCLE + CYCLE // 4) is Reason.STALE
    assert slot.received(3, -4, t_ns + 2 * CYCLE + CYCLE // 2) is None


def test_a_restart_is_seen_although_the_clock_is_set_back() -> None:
    """Neither by a day nor by a few cycles does that keep a restarted sender out."""
    by_a_day, by_some_cycles, t_ns = slot_at(42), slot_at(42), 10_000 * MS
    assert by_a_day.received(0, -1, t_ns - 86_400_000 * MS) is None
    assert by_some_cycles.received(0, -1, t_ns + 1 * CYCLE) is Reason.STALE
    assert by_some_cycles.received(1, -2, t_ns + 2 * CYCLE) is Reason.STALE
    assert by_some_cycles.received(2, -3, t_ns - 2 * CYCLE) is None


def test_a_late_record_is_no_duplicate_of_the_previous_round() -> None:
    """The line stands still, so all rounds of the counter bring the same contents."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    for k in [*range(256 + 40), *range(256 + 41, 256 + 45)]:
        slot.received(k % 256, k % 256, k * CYCLE)
    assert slot.received(40, 40, (256 + 45) * CYCLE) is Reason.STALE
    assert slot.received(39, 39, (256 + 45) * CYCLE) is Reason.DUPLICATE


def test_a_late_record_that_comes_again_is_a_duplicate() -> None:
    """It was not delivered, but it is known; another one of its counter is late as well."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    for k in [*range(40), *range(41, 46)]:
        slot.received(k, k, k * CYCLE)
    assert slot.received(40, 40, 46 * CYCLE) is Reason.STALE
    assert slot.received(40, 40, 47 * CYCLE) is Reason.DUPLICATE
    assert slot.received(40, -1, 48 * CYCLE) is Reason.STALE


def test_the_status_after_silence_says_that_there_is_no_data() -> None:
    """It replaces that of the last record, also in the statistics."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    slot.received(0, 0, 0)
    assert slot.status is ProfileStatus.OK
    slot.elapse(2 * CYCLE)
    assert slot.status is slot.stats().status is NONEWDATA


def test_duplicated_frames_are_repeated_records_once_they_fill_one() -> None:
    """Each new record starts the count again."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    for counter in range(5):
        slot.received(counter, counter, counter * CYCLE)
        for _ in range(3):
            slot.frame_dropped(Reason.DUPLICATE, counter * CYCLE)
    assert slot.stats().repeated == 0
    slot.frame_dropped(Reason.DUPLICATE, 4 * CYCLE)
    assert slot.stats().repeated == 1


def test_a_duplicated_transfer_is_not_silence() -> None:
    """A stuck sender is present: its checks are REPEATED, not NONEWDATA."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    slot.received(0, 0, 0)
    for cycle in range(1, 6):
        for _ in range(4):
            slot.frame_dropped(Reason.DUPLICATE, cycle * CYCLE)
    slot.elapse(6 * CYCLE)
    assert (slot.stats().repeated, slot.stats().no_new_data) == (5, 0)


@pytest.mark.parametrize("reason", Reason)
@pytest.mark.parametrize("is_authentic", [False, True])
def test_dropped_frames_that_are_errors(reason: Reason, is_authentic: bool) -> None:
    """What is not authentic does not reach the E2E check, and a damaged frame is not authentic."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE, is_authentic=is_authentic)
    for _ in range(3):
        slot.frame_dropped(reason, 0)
    is_error = reason is Reason.PAGE or (reason is Reason.LENGTH and not is_authentic)
    assert slot.statuses == ({ProfileStatus.ERROR: 3} if is_error else {})


def test_two_senders_are_forgotten_on_a_silent_bus() -> None:
    """The time alone is enough: 256 cycles after the last evidence, without another record."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    for k in range(96):  # duplicates count in blocks of 32
        for late_ms in (0, 10):
            slot.received(k, k, k * CYCLE + late_ms * MS)
    assert slot.two_senders
    last = 95 * CYCLE + 10 * MS
    slot.elapse(last + 256 * CYCLE)
    assert slot.two_senders
    slot.elapse(last + 256 * CYCLE + 1)
    assert not slot.two_senders


@pytest.mark.parametrize(("lost_in_pause", "two_senders"), [(0, True), (1, False)])
def test_senders_that_take_turns_are_two(lost_in_pause: int, two_senders: bool) -> None:
    """Each continues its own sequence after the other; a sender that restarts continues none."""
    slot, counters = SequenceCheck(E2EConfig(), 256, 4, CYCLE), [0, 120]
    for turn in range(20):
        for k in range(3):
            counter = counters[turn % 2] % 256
            assert slot.received(counter, turn, (15 * turn + k) * CYCLE) is None
            counters[turn % 2] += 1
        counters[turn % 2] += lost_in_pause
    assert slot.two_senders is two_senders


def fast_slot(lines: int, pace: int) -> tuple[SequenceCheck, int]:
    """Return a check of a sender of so many lines, ``pace`` in a cycle, and the last time."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    for k in range(lines):
        assert slot.received(k % 256, k, k * CYCLE // pace) is None
        slot.delivered(1)
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


def test_a_repeated_record_is_one_of_the_last_line() -> None:
    """Of two records, if they were a line; of a line that is not complete, only the last one."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    wrong, repeated = ProfileStatus.WRONGSEQUENCE, ProfileStatus.REPEATED
    for k in range(10):
        slot.received(k, k, k * CYCLE)
    for is_line, counter, status in (
        (False, 8, wrong),
        (False, 9, repeated),
        (True, 7, wrong),
        (True, 8, repeated),
        (True, 9, repeated),
    ):
        if is_line:
            slot.delivered(2)
        assert slot.received(counter, counter, 10 * CYCLE) is Reason.DUPLICATE
        assert slot.status is status


@pytest.mark.parametrize(("behind", "two_senders"), [(1, True), (16, True), (17, False)])
def test_duplicates_of_recent_records_are_those_of_a_second_sender(
    behind: int, two_senders: bool
) -> None:
    """Farther back they may be those of a sender that restarted in a car that stands."""
    slot = SequenceCheck(E2EConfig(), 256, 4, CYCLE)
    for k in range(120):
        slot.received(k, k, k * CYCLE)
        if k >= behind:
            reason = slot.received(k - behind, k - behind, k * CYCLE + 10 * MS)
            assert reason is Reason.DUPLICATE
    assert slot.two_senders is two_senders


@pytest.mark.parametrize(("first", "is_restart"), [(0, True), (15, True), (16, False)])
def test_a_restart_begins_with_a_low_counter(first: int, is_restart: bool) -> None:
    """Up to 15 of its first records may be lost; others are those of a late queue."""
    slot, t_ns = slot_at(60), 10_000 * MS
    reasons = [slot.received(first + i, -1 - i, t_ns + (1 + i) * CYCLE) for i in range(3)]
    assert reasons == [Reason.STALE, Reason.STALE, None if is_restart else Reason.STALE]
