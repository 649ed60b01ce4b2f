"""A line that is late is not delivered after a newer one, as far as counters and time can tell."""

import math
import pickle
from functools import cache
from typing import Any

import pytest
from answers import one
from support.dbcs import default_codec
from support.e2e_streams import CYCLE, MS, SLOT, Received, frames, mixture_frames

from maplines_can import MapLine
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


def slot_of(records: int) -> Received:
    """Return what has received so many records, one in each cycle."""
    slot = Received()
    for i in range(records):
        assert slot.received(i, i, i * CYCLE) is None
    return slot


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


@cache
def line_frames(line: int, components: int) -> Any:
    """Return the CAN FD frames of a line, one for each component."""
    counter = line * components % 256
    if components == 1:
        return frames(counter, True, which=line * 7 % 256)
    return mixture_frames(counter, components, True, seed=line)


class Stream:
    """A receiver of lines at 20 Hz, of which some are held back."""

    def __init__(self, components: int = 1) -> None:
        self.components = components
        self.decoder = default_codec().decoder()
        self.t_ns = 0

    def receive(self, line: int, t_ns: int | None = None) -> Any:
        """Return the answer to a line at a time, by default that of the next cycle."""
        t_ns = self.t_ns if t_ns is None else t_ns
        for i, frame in enumerate(line_frames(line, self.components)):
            answer = one(self.decoder.feed(frame.can_id, frame.data, t_ns + i * MS // 4))
        return answer

    def run(self, lines: Any) -> list[Any]:
        """Return the answers to a line, or None for none, in each cycle."""
        answers = []
        for line in lines:
            if line is not None:
                answers.append(self.receive(line))
            self.t_ns += CYCLE
        return answers


SPILLS: dict[str, Any] = {
    "at once": lambda n: [0.1 + 0.01 * i / n for i in range(n)],
    "within a cycle": lambda n: [0.1 + 0.8 * i / n for i in range(n)],
    "at the rate of the sender": lambda n: [0.5 + i for i in range(min(n, 9))],
    "at twice the rate": lambda n: [0.5 + i / 2 for i in range(min(n, 18))],
}


@pytest.mark.parametrize("sender", ["goes on", "silent"])
@pytest.mark.parametrize("spill", SPILLS)
@pytest.mark.parametrize(("components", "held"), [(1, 1), (1, 16), (1, 32), (8, 3), (8, 10)])
@pytest.mark.parametrize("first_counter", [0, 104])
def test_a_gateway_that_spills_held_back_lines_gets_none_delivered(
    first_counter: int, components: int, held: int, spill: str, sender: str
) -> None:
    """Between newer lines, or within the window after the last one; 8 lines: 5 before."""
    first = (256 + first_counter) // components
    stream = Stream(components)
    newer = range(first + held, first + held + 10)
    stream.run(range(first - 20, first))
    stream.t_ns += held * CYCLE
    stream.run(newer)
    newest = stream.t_ns - CYCLE
    assert stream.decoder.latest(SLOT, newest).usable
    times = SPILLS[spill](held)
    arrivals = [(newest + round(at * CYCLE), first + i) for i, at in enumerate(times)]
    if sender == "goes on":
        arrivals += [(newest + k * CYCLE, newer.stop + k - 1) for k in range(1, 20)]
    late, delivered = list[int](), list[int]()
    for t_ns, line in sorted(arrivals):
        answer = stream.receive(line, t_ns)
        if isinstance(answer, MapLine):
            (late if line < newer.stop else delivered).append(line)
    assert not stream.decoder.latest(SLOT, stream.t_ns).two_senders
    assert late == []
    assert delivered == sorted(delivered)
    assert len(delivered) == (19 if sender == "goes on" else 0)


@pytest.mark.parametrize("counter", [40, 100, 150, 230])
def test_another_sender_takes_over_after_the_window(counter: int) -> None:
    """With any counter: ten cycles after the last line, and VALID eight lines later."""
    last = 200
    slot = slot_of(last + 1)
    taken_over = valid = None
    for k in range(1, 40):
        t_ns = (last + k) * CYCLE
        answer = slot.received((counter + k) % 256, -k, t_ns, 1)
        if answer is None and taken_over is None:
            taken_over = k
        if taken_over and valid is None and slot.check.state is VALID:
            valid = k
    assert (taken_over, valid) == (11, 19)
