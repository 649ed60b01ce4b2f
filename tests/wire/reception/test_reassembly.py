"""Frames to lines: all or nothing, every frame accounted for."""

from collections import Counter
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from answers import one
from hypothesis import given, settings
from hypothesis import strategies as st
from support.dbcs import default_codec

from maplines_can.study import road
from maplines_can.values.errors import LayoutError
from maplines_can.values.line import MapLine, Slot
from maplines_can.wire import Codec, Reason

MS = 1_000_000


@cache
def transfers(n: int = 40, slot: Any = Slot.EGO_LEFT, fd: bool = False, seed: int = 2) -> Any:
    """Frames of n lines of one slot, all different."""
    codec = default_codec()
    means, covs = road(n, seed=seed)
    payloads = codec.batch.encode(means, covs, slot=slot)
    return [codec.encoder().frames(payload, slot, fd=fd) for payload in payloads]


def feed(decoder: Any, frames: Any, t_ns: int = 0) -> Any:
    """Answers to frames, a microsecond apart."""
    return [one(decoder.feed(f.can_id, f.data, t_ns + i * 1000)) for i, f in enumerate(frames)]


def check_accounts(decoder: Any, frames: Any) -> None:
    """Every frame is part of a line, dropped with a reason, or pending."""
    assert decoder.frames == frames
    assert decoder.frames == decoder.line_frames + sum(decoder.counts.values()) + decoder.pending
    assert Reason.PENDING not in decoder.counts


@settings(max_examples=60)
@given(st.integers(0, 2**32), st.booleans())
def test_whatever_the_bus_does_each_line_is_a_sent_one_and_comes_once(seed: int, fd: bool) -> None:
    """Loss, duplication, local reordering, corruption and foreign frames at random."""
    rng = np.random.default_rng(seed)
    sent = transfers(fd=fd)
    payloads = {b"".join(frame.data for frame in transfer): i for i, transfer in enumerate(sent)}
    stream = []
    for frame in (frame for transfer in sent for frame in transfer):
        fate = rng.random()
        if fate < 0.1:
            continue
        if fate < 0.15:
            data = bytearray(frame.data)
            data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
            frame = frame._replace(data=bytes(data))
        stream += [frame] * (2 if fate > 0.95 else 1)
    order = np.argsort(np.arange(len(stream)) + rng.uniform(0, 3, len(stream)))
    decoder = default_codec().decoder()
    delivered = []
    for i, place in enumerate(order):
        answer = one(decoder.feed(stream[place].can_id, stream[place].data, i * 100_000))
        if isinstance(answer, MapLine):
            delivered.append(answer)
    check_accounts(decoder, len(stream))
    truth = {
        line.gaussian.mean.tobytes() + line.gaussian.cov.tobytes(): i  # type: ignore[union-attr]
        for payload, i in payloads.items()
        for line in [default_codec().batch.decode_one(payload, Slot.EGO_LEFT)]
    }
    numbers = [
        truth[line.gaussian.mean.tobytes() + line.gaussian.cov.tobytes()] for line in delivered
    ]
    assert numbers == sorted(set(numbers))  # each one sent, none twice, never backwards


@settings(max_examples=100)
@given(st.lists(st.tuples(st.integers(0x33F, 0x351), st.binary(max_size=64), st.integers(-9, 9))))
def test_no_bytes_from_the_bus_can_raise(frames: Any) -> None:
    """Whatever arrives is read or dropped with a reason, at any time."""
    decoder = default_codec().decoder()
    for can_id, data, gap_s in frames:
        assert isinstance(one(decoder.feed(can_id, data, gap_s * 10**9)), MapLine | Reason)
    check_accounts(decoder, len(frames))


def test_memory_does_not_grow(codec: Any) -> None:
    """A slot holds as many transfers as there are numbers, whatever comes."""
    decoder = codec.decoder()
    for i in range(5000):
        page = transfers()[i % 40][i % 4]
        decoder.feed(page.can_id, page.data, i * MS)
    assert decoder.pending <= 4 * 16
    assert isinstance(decoder.counts, Counter)


@cache
def standing(n: int) -> Any:
    """Frames of n transfers of one line that stands still."""
    codec, mean = default_codec(), [[1.75, 0.0, 0.0, 0.0]] * n
    payloads = codec.batch.encode(mean, [np.diag([1e-2, 1e-4, 1e-8, 1e-12])] * n)
    return [codec.encoder().frames(payload, Slot.EGO_LEFT) for payload in payloads]


def test_a_line_that_stands_still_is_no_duplicate_of_itself(codec: Any) -> None:
    """Its pages are those of the transfer one round of IDs before, whatever page comes first."""
    decoder = codec.decoder(timeout_ms=200)
    for i, transfer in enumerate(standing(60)):
        *waiting, line = feed(decoder, transfer[::-1], t_ns=2 * i * MS)
        assert waiting == [Reason.PENDING] * 3
        assert isinstance(line, MapLine)
    assert decoder.counts == {}


def test_a_page_of_a_recent_transfer_is_a_duplicate(codec: Any) -> None:
    """All pages of up to half a round of IDs ago; they do not begin a new transfer."""
    decoder = codec.decoder(timeout_ms=200)
    half = 2 ** codec.layout["TransferId0"].length // 2
    for i, transfer in enumerate(standing(60)):
        feed(decoder, transfer, t_ns=2 * i * MS)
        for back in range(min(i, half) + 1):
            (answer,) = feed(decoder, standing(60)[i - back][2:3], t_ns=(2 * i + 1) * MS)
            assert answer is Reason.DUPLICATE, back
        assert decoder.pending == 0
    assert decoder.lines == 60


def test_a_counter_in_two_pages_is_refused(codec: Any) -> None:
    """No page alone would say to which record it belongs."""
    layout = codec.layout
    signals = dict(layout.signals)
    signals["Counter"] = replace(layout["Counter"], start=58, big_endian=True)
    signals["Status"] = replace(layout["Status"], start=59)
    signals["Kind"] = replace(layout["Kind"], start=16)
    signals["TransferId0"] = replace(layout["TransferId1"], name="TransferId0", start=19)
    signals["C0"] = replace(layout["C0"], start=72, length=11, raw_min=-1024, raw_max=1023)
    with pytest.raises(LayoutError, match=r"signal Counter is .* needs to be within a page"):
        Codec(replace(layout, signals=signals)).decoder()
