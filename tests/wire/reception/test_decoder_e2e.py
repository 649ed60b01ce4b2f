"""The E2E state of a slot, as the decoder updates it."""

from typing import Any

import e2e
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.dbcs import default_codec
from support.e2e_streams import CYCLE, MS, SLOT, check_accounts, frames, mixture_frames, record, run

from maplines_can import MapLine
from maplines_can.wire import E2EState, ProfileStatus, Reason

OK, NONEWDATA, ERROR, REPEATED, OKSOMELOST, WRONGSEQUENCE = ProfileStatus
VALID, INVALID = E2EState.VALID, E2EState.INVALID


@settings(max_examples=100)
@given(st.lists(st.integers(0, 32 * 8 - 1), max_size=4), st.integers(0, 254))
def test_errors_agree_with_autosar_e2e(bits: Any, counter: int) -> None:
    """That package writes the counter and the checksum, and checks the damaged record."""
    data_id = default_codec().layout.messages[SLOT].data_id
    before, after = (record(k).tobytes() for k in (counter, counter + 1))
    counted = bytearray(before)
    e2e.p05.e2e_p05_protect(counted, data_id, increment_counter=True)
    assert counted[2] == after[2]
    damaged = bytearray(after)
    for bit in bits:
        damaged[bit // 8] ^= 1 << bit % 8
    decoder = default_codec().decoder()
    decoder.feed(0x348, before, 0)
    decoder.feed(0x348, bytes(damaged), CYCLE)
    good = e2e.p05.e2e_p05_check(bytes(damaged), data_id)
    assert decoder.checks[SLOT].status is (OK if good else ERROR)


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("lines", [20, 32, 64])
def test_a_sender_that_is_stuck(lines: int, fd: bool) -> None:
    """The same record forever is one line, INVALID after a while, and not two senders."""
    decoder = default_codec().decoder()
    _, t_ns = run(decoder, range(lines), fd=fd)
    answers, t_ns = run(decoder, [lines - 1] * 30, t_ns, fd=fd)
    slot = decoder.checks[SLOT]
    assert set(answers) == {Reason.DUPLICATE}
    assert (slot.state, slot.statuses[REPEATED], slot.two_senders) == (INVALID, 30, False)
    run(decoder, range(lines, lines + 40), t_ns, fd=fd)
    assert not slot.two_senders
    check_accounts(decoder)


@settings(max_examples=20)
@given(
    st.integers(0, 2**32), st.booleans(), st.sampled_from([1, 1, 3]), st.sampled_from([0.05, 0.3])
)
def test_one_sender_is_not_taken_for_two(seed: int, fd: bool, k: Any, bad: Any) -> None:
    """It loses frames, restarts, is silent, and many of its frames are late or duplicated."""
    rng = np.random.default_rng(seed)
    decoder, t_ns, counter, restarts, arrivals = default_codec().decoder(), 0, 0, 0, list[Any]()
    for _ in range(300):
        chance = rng.random()
        if chance < 0.005:
            counter, restarts = 0, restarts + 1
        elif chance < 0.01:
            t_ns += int(rng.integers(1, 40)) * CYCLE
        transfer = (
            frames(counter, fd, which=(counter + 50 * restarts) % 256)
            if k == 1
            else mixture_frames(counter, k, fd, seed=restarts)
        )
        for i, frame in enumerate(transfer):
            at = t_ns + i * MS // 4
            late = int(rng.integers(1, 300)) * MS
            chance = rng.random()
            if chance >= 0.1:
                arrivals.append((at + late * (chance < 0.1 + bad / 3), len(arrivals), frame))
            if chance > 1 - bad:
                arrivals.append((at + late // 10, len(arrivals), frame))
        counter, t_ns = (counter + k) % 256, t_ns + CYCLE
    for at, _, frame in sorted(arrivals):
        decoder.feed(frame.can_id, frame.data, at)
    assert not decoder.checks[SLOT].two_senders
    check_accounts(decoder)


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("k", [0, 1, 4, 5, 15, 16, 40])
def test_lost_lines(k: int, fd: bool) -> None:
    """Up to 15 are OKSOMELOST; each missing cycle is NONEWDATA, and five of them end VALID."""
    decoder = default_codec().decoder()
    _, t_ns = run(decoder, range(250, 262), fd=fd)
    (line,), _ = run(decoder, [262 + k], t_ns + k * CYCLE, fd=fd)
    slot = decoder.checks[SLOT]
    assert isinstance(line, MapLine)
    assert slot.statuses[NONEWDATA] == k
    assert slot.lost == decoder.lost == k
    assert slot.status is (OK if k == 0 else OKSOMELOST if k < 16 else WRONGSEQUENCE)
    assert slot.state is (VALID if k < 5 else INVALID)
    check_accounts(decoder)


@pytest.mark.parametrize("silence", [0, 3, 9, 10, 1000])
@pytest.mark.parametrize("at", [10, 120, 130, 250])
def test_a_sender_that_restarts(at: int, silence: int) -> None:
    """Two lines are held back; for ten cycles, if the counters from 0 on were never received."""
    decoder = default_codec().decoder()
    _, t_ns = run(decoder, range(at - 10, at))
    slot = decoder.checks[SLOT]
    assert slot.state is VALID
    kept = max(0, min(2 if at == 10 else 10, 10 - silence)) if at < 240 else 0
    answers, t_ns = run(decoder, range(kept + 1), t_ns + silence * CYCLE, other=100)
    assert answers[:kept] == [Reason.STALE] * kept
    assert isinstance(answers[kept], MapLine)
    if at < 240:  # from there on 0 looks like the next but some
        assert (slot.status, slot.state) == (WRONGSEQUENCE, INVALID)
        answers, t_ns = run(decoder, range(kept + 1, kept + 8), t_ns, other=100)
        assert slot.state is INVALID
        answers += run(decoder, [kept + 8], t_ns, other=100)[0]
        assert all(isinstance(answer, MapLine) for answer in answers)
        assert slot.lost == 0
    assert slot.state is VALID or at >= 240
    assert not slot.two_senders
    check_accounts(decoder)
