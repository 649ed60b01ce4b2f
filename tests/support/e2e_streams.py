"""Streams of records of one slot, for tests of the E2E state."""

from functools import cache
from typing import Any

import numpy as np
from answers import one
from support.dbcs import default_codec
from support.lines import random_lines

from maplines_can import Slot
from maplines_can.wire import Reason

MS = 1_000_000
CYCLE = 50 * MS
SLOT = Slot.EGO_LEFT


MEANS, COVS = random_lines(256, seed=11)


@cache
def record(counter: Any, which: Any = None) -> Any:
    """Return the record of a counter; its line depends on the counter, or on ``which``."""
    i = counter % 256 if which is None else which
    one = MEANS[i : i + 1], COVS[i : i + 1]
    return default_codec().batch.encode(*one, slot=SLOT, counter=[counter % 256])[0]


@cache
def frames(counter: Any, fd: bool = False, which: Any = None) -> Any:
    """Return the frames of that record."""
    return default_codec().encoder().frames(record(counter, which=which), SLOT, fd=fd)


def feed(decoder: Any, transfer: Any, t_ns: Any) -> Any:
    """Return the answer to the last frame of a transfer, whose frames are 0.25 ms apart."""
    answers = [
        one(decoder.feed(f.can_id, f.data, t_ns + i * MS // 4)) for i, f in enumerate(transfer)
    ]
    return answers[-1]


def run(decoder: Any, counters: Any, t_ns: int = 0, fd: bool = False, other: int = 0) -> Any:
    """Feed lines at 20 Hz, other ones with ``other``; return the answers and the next time."""
    answers = []
    for counter in counters:
        which = (counter + other) % 256
        answers.append(feed(decoder, frames(counter, fd, which=which), t_ns))
        t_ns += CYCLE
    return answers, t_ns


def check_accounts(decoder: Any) -> None:
    dropped = sum(decoder.counts.values())
    assert decoder.frames == decoder.line_frames + dropped + decoder.pending


@cache
def mixture_frames(counter: Any, k: Any, fd: Any, seed: int = 0) -> Any:
    """Return the frames of the k components of a line, with counters from ``counter``."""
    rng = np.random.default_rng([seed, counter])
    means = MEANS[rng.integers(0, 256, k)]
    weights = np.full((1, k), 1 / k)
    payloads = default_codec().batch.encode_mixtures(
        weights, means[None], np.tile(np.diag([1e-2, 1e-4, 1e-8, 1e-12]), (1, k, 1, 1)),
        slot=SLOT, counter=[counter],
    )[0]  # fmt: skip
    return [frame for p in payloads for frame in default_codec().encoder().frames(p, SLOT, fd=fd)]


class Received:
    """Records of a slot by counter and content, as a decoder receives them."""

    def __init__(self) -> None:
        self.decoder = default_codec().decoder()
        self.check = self.decoder.checks[SLOT]

    def received(self, counter: int, content: int, t_ns: int, records: int = 1) -> Reason | None:
        """Return why a record is not new; None if it is.

        Args:
            counter: of the record.
            content: what tells it from others with its counter, -20 000 to 20 000.
            t_ns: time of reception [ns].
            records: of its line, whose first one has a content that is a multiple of this.
        """
        (frame,) = content_frames(counter % 256, content, records)
        answer = self.decoder.feed(frame.can_id, frame.data, t_ns)
        return None if answer is Reason.PENDING or not isinstance(answer, Reason) else answer

    def has_one_sender(self, t_ns: int) -> bool:
        return self.check.has_one_sender(t_ns)


@cache
def content_frames(counter: int, content: int, records: int) -> Any:
    """Return the CAN FD frame of a record with a content."""
    record = default_codec().batch.encode(
        [[content / 1024, 0, 0, 0]],
        slot=SLOT,
        counter=[counter],
        component_index=[content % records],
        component_count=[records],
        component_weight=[1 / records],
    )[0]
    return default_codec().encoder().frames(record, SLOT, fd=True)
