"""Checks of records by their counters in C, as in Python, with counters of any length."""

import random
import struct
from collections import Counter
from typing import Any

import c_core
import pytest

from maplines_can.wire import E2EConfig, Reason
from maplines_can.wire.reception.sequence import SequenceCheck

CYCLE = 50_000_000
REASONS = {reason: i + 1 for i, reason in enumerate(Reason)}
#: Size of the answer to a step [byte].
ANSWER = struct.calcsize("<5BIQ")


def answer_of(check: SequenceCheck, reason: Reason | None, t_ns: int) -> bytes:
    status = 0xFF if check.status is None else check.status
    return struct.pack(
        "<5BIQ",
        0 if reason is None else REASONS[reason],
        check.state,
        status,
        check.two_senders,
        check.has_one_sender(t_ns),
        check.ahead or 0,
        check.lost,
    )


def steps(rng: random.Random, bits: int, n: int) -> Any:
    """Yield kinds and times of steps, with a counter that goes on, is late, or is of another."""
    modulus, counter, other, t_ns = 2**bits, 0, rng.randrange(2**bits), 0
    sent: dict[int, int] = {}
    for _ in range(n):
        t_ns += rng.choice([0, CYCLE // 8, CYCLE, CYCLE, 2 * CYCLE])
        if rng.random() < 0.003:
            t_ns += rng.choice([-1, 1]) * rng.choice([CYCLE, 20 * CYCLE, 10**15])
        kind = rng.choices(range(5), [20, 8, 1, 2, 1])[0]
        if kind != 0:
            yield kind, t_ns, rng.randrange(1, 9)
            continue
        match rng.choices(range(6), [20, 3, 3, 3, 2, 1])[0]:
            case 0:
                counter = (counter + 1) % modulus
            case 1:
                counter = (counter + rng.choice([2, 5, 17, 100, 300])) % modulus
            case 2:  # late, or twice
                behind = rng.choice([0, 1, 2, 5, 17, 100, 254, 255, 256, 257, 300])
                late = (counter - behind) % modulus
                yield 0, t_ns, (late, sent.get(late, 7), 1)
                continue
            case 3:
                other = (other + 1) % modulus
                yield 0, t_ns, (other, rng.randrange(3), rng.randrange(1, 3))
                continue
            case 4:
                counter = rng.randrange(modulus)
            case _:
                counter, other = other, counter
        sent[counter] = rng.choice([sent.get(counter, 0), rng.randrange(2**63)])
        yield 0, t_ns, (counter, sent[counter], rng.choice([1, 1, 1, 2, 8]))


@pytest.mark.parametrize("is_authentic", [False, True])
@pytest.mark.parametrize(("bits", "max_delta"), [(4, 3), (8, 16), (8, 127), (16, 16), (32, 40)])
def test_a_stream_of_records_is_checked_as_in_python(
    bits: int, max_delta: int, is_authentic: bool
) -> None:
    """Duplicates, late records, gaps, restarts, two senders, and jumps of the clock."""
    rng, met = random.Random(f"{bits} {max_delta} {is_authentic}"), Counter[str]()  # noqa: S311
    pages = rng.randrange(1, 5)
    config = E2EConfig(max_delta_counter=max_delta)
    check = SequenceCheck(config, 2**bits, pages, CYCLE, is_authentic=is_authentic)
    asked = struct.pack("<3BqB", bits, pages, is_authentic, CYCLE, max_delta)
    expected = b""
    for kind, t_ns, more in steps(rng, bits, 6000):
        asked += struct.pack("<Bq", kind, t_ns)
        reason = None
        match kind:
            case 0:
                asked += struct.pack("<IQI", *more)
                reason = check.received(more[0], more[1], t_ns, more[2])
                met["new" if reason is None else reason.name] += 1
                met["break"] += reason is None and check.ahead is None
            case 1:
                asked += struct.pack("<I", more)
                check.delivered(more)
            case 2:
                check.failed(t_ns)
            case 3:
                check.frame_dropped(Reason.DUPLICATE, t_ns)
            case _:
                check.elapse(t_ns)
        expected += answer_of(check, reason, t_ns)
    given = c_core.run(c_core.harness("sequence"), asked)
    for i in range(0, len(expected), ANSWER):
        assert given[i : i + ANSWER] == expected[i : i + ANSWER], i // ANSWER
    assert len(given) == len(expected)
    assert min(met[name] for name in ("new", "break", "STALE", "DUPLICATE")) > 5
