"""A line that is late is not delivered after a newer one, as far as counters and time can tell."""

import math
import pickle
from typing import Any

import pytest
from support.e2e_streams import CYCLE

from maplines_can.model.e2e import Windows
from maplines_can.model.sequence import SequenceCheck
from maplines_can.wire import E2EConfig, E2EState

VALID, INVALID = E2EState.VALID, E2EState.INVALID
MAX_DELTA = E2EConfig().max_delta_counter
PHASES = [0.5, 0.51, 4.0]


def most_ahead(phase: float, components: int) -> int:
    """How far ahead a newer record can be: the formula of the documentation."""
    lines = math.ceil(phase + 0.5)
    return min(127, max(MAX_DELTA, lines * components))


def check_of(received: list[bool], components: int) -> SequenceCheck:
    """Return a check of the model that has received a line in each cycle, or not."""
    check = SequenceCheck(Windows(), 256, 4, CYCLE, is_authentic=False)
    for i, is_received in enumerate(received):
        if is_received:
            t_ns = i // components * CYCLE
            assert check.received(i % 256, str(i).encode(), t_ns, components) is None
            if (i + 1) % components == 0:
                check.delivered(components)
    return check


@pytest.mark.parametrize("history", [8, 40])
@pytest.mark.parametrize("components", [1, 8])
def test_a_late_line_is_delivered_only_if_it_cannot_be_told_from_a_newer_one(
    components: int, history: int
) -> None:
    """Every lateness from 1 to 255 records, at several times; the exceptions are exact.

    By the model, for its speed. Its counters were not received before: a duplicate would be
    recognised. With a short history,
    the receiver has joined after the line was sent.
    """
    wrong = list[Any]()
    records = -(-max(8 * components, history * 256 // 40) // components) * components
    for late in range(components, 256):  # of its first record
        first = records - 1 - late
        gap = range(first, first + components)
        received = [i not in gap or first < 0 for i in range(records)]
        check = check_of(received, components)
        saved = pickle.dumps(check)  # copied faster than by deepcopy
        check_state, newest = check.state, (records // components - 1) * CYCLE
        for phase in PHASES:
            probe, t_ns = pickle.loads(saved), newest + round(phase * CYCLE)  # noqa: S301
            probe.elapse(t_ns)
            answers = [
                probe.received((first + i) % 256, b"%d" % (-1 - i), t_ns, components)
                for i in range(components)
            ]
            expected = 256 - late <= most_ahead(phase, components)
            is_valid = probe.state == "VALID" and not probe.senders.are_two
            if (answers == [None] * components) is not expected:
                wrong.append((late, phase, answers))
            if expected and check_state == "VALID" and is_valid is not (256 - late <= MAX_DELTA):
                wrong.append((late, phase, probe.state))
    assert wrong == []
