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


def with_a_flipped_bit(frames: Any, bit: Any) -> Any:
    """The frames of a record with one of its bits flipped."""
    size = len(frames[0].data)
    place, within = divmod(bit, 8 * size)
    data = bytearray(frames[place].data)
    data[within // 8] ^= 1 << within % 8
    return [*frames[:place], frames[place]._replace(data=bytes(data)), *frames[place + 1 :]]


def check_accounts(decoder: Any, frames: Any) -> None:
    """Every frame is part of a line, dropped with a reason, or pending."""
    assert decoder.frames == frames
    assert decoder.frames == decoder.line_frames + sum(decoder.counts.values()) + decoder.pending
    assert Reason.PENDING not in decoder.counts


@pytest.mark.parametrize("order", [(3, 2, 1, 0), (1, 0, 3, 2), (2, 3, 0, 1)])
def test_pages_in_any_order(codec: Any, order: Any) -> None:
    """Reordering within a transfer does not matter."""
    decoder = codec.decoder()
    answers = feed(decoder, [transfers()[0][page] for page in order])
    assert isinstance(answers[-1], MapLine)
    direct = codec.batch.decode_one(b"".join(f.data for f in transfers()[0]), Slot.EGO_LEFT)
    assert np.array_equal(answers[-1].gaussian.cov, direct.gaussian.cov)


@pytest.mark.parametrize("lost", range(4))
def test_a_lost_page_loses_its_line_only(codec: Any, lost: Any) -> None:
    """The next transfer is delivered; the pages of the broken one wait, and then are counted."""
    decoder = codec.decoder()
    broken = [f for i, f in enumerate(transfers()[1]) if i != lost]
    answers = feed(decoder, [*transfers()[0], *broken, *transfers()[2]])
    assert sum(isinstance(a, MapLine) for a in answers) == 2
    assert decoder.pending == 3
    decoder.expire(76 * MS)
    assert decoder.counts == {Reason.TIMEOUT: 3}
    assert decoder.lost == 1
    check_accounts(decoder, 11)


def test_duplicates_are_dropped(codec: Any) -> None:
    """A page twice, and a whole transfer twice, deliver one line."""
    decoder = codec.decoder()
    twice = [frame for frame in transfers()[0] for _ in range(2)]
    answers = feed(decoder, [*twice, *transfers()[0]])
    assert sum(isinstance(a, MapLine) for a in answers) == 1
    assert decoder.counts == {Reason.DUPLICATE: 8}
    check_accounts(decoder, 12)


def test_an_fd_frame_twice_is_delivered_once(codec: Any) -> None:
    """The counter tells a repeated record where there are no pages."""
    decoder = codec.decoder()
    (frame,) = transfers(fd=True)[0]
    answers = feed(decoder, [frame, frame])
    assert isinstance(answers[0], MapLine)
    assert answers[1] is Reason.DUPLICATE
    check_accounts(decoder, 2)


def test_a_slow_transfer_times_out(codec: Any) -> None:
    """Pages further apart than the time-out are not one transfer."""
    decoder = codec.decoder(timeout_ms=10)
    a, b, c, d = transfers()[0]
    assert decoder.feed(a.can_id, a.data, 0) is Reason.PENDING
    assert decoder.feed(b.can_id, b.data, 11 * MS) is Reason.PENDING
    assert decoder.counts == {Reason.TIMEOUT: 1}
    assert decoder.feed(c.can_id, c.data, 12 * MS) is Reason.PENDING
    decoder.expire(40 * MS)
    assert decoder.counts == {Reason.TIMEOUT: 3}
    assert decoder.feed(d.can_id, d.data, 41 * MS) is Reason.PENDING
    check_accounts(decoder, 4)


def test_a_clock_that_is_set_back_does_not_stop_the_lines(codec: Any) -> None:
    """What was held is given up, and the next transfer is delivered."""
    decoder = codec.decoder()
    feed(decoder, transfers()[0][:2], t_ns=10**12)
    assert isinstance(feed(decoder, transfers()[1], t_ns=5)[-1], MapLine)
    assert decoder.counts == {Reason.TIMEOUT: 2}


def test_slots_interleave(codec: Any) -> None:
    """Eight lines page by page in turn: eight lines."""
    decoder = codec.decoder()
    frames = [transfers(slot=slot)[0] for slot in Slot]
    answers = feed(decoder, [frames[slot][page] for page in range(4) for slot in Slot])
    lines = [a for a in answers if isinstance(a, MapLine)]
    assert [line.slot for line in lines] == list(Slot)
    check_accounts(decoder, 32)


@pytest.mark.parametrize(
    ("can_id", "data", "is_extended", "reason"),
    [
        pytest.param(0x123, bytes(8), False, Reason.FOREIGN, id="foreign-id"),
        pytest.param(0x340, bytes(8), True, Reason.FOREIGN, id="extended-id"),
        pytest.param(0x340, bytes(7), False, Reason.LENGTH, id="short-page"),
        pytest.param(0x340, b"", False, Reason.LENGTH, id="no-bytes"),
        pytest.param(0x340, bytes(64), False, Reason.LENGTH, id="long-page"),
        pytest.param(0x348, bytes(24), False, Reason.LENGTH, id="short-fd"),
        pytest.param(0x348, bytes(32), False, Reason.MIXED, id="zero-fd"),
        pytest.param(0x348, bytes(64), False, Reason.MIXED, id="longest-fd"),
        pytest.param(0x348, bytes(65), False, Reason.LENGTH, id="longer-than-any-frame"),
        pytest.param(0x348, bytes(256), False, Reason.LENGTH, id="length-of-a-byte-more"),
    ],
)
def test_frames_that_are_no_pages(
    codec: Any, can_id: int, data: Any, is_extended: bool, reason: Any
) -> None:
    """Each has its reason."""
    decoder = codec.decoder()
    assert decoder.feed(can_id, data, 0, is_extended=is_extended) is reason
    assert decoder.counts == {reason: 1}
    check_accounts(decoder, 1)


def test_an_fd_frame_may_be_padded(codec: Any) -> None:
    """A gateway may send 48 or 64 bytes; the record is the first 32."""
    (frame,) = transfers(fd=True)[0]
    assert isinstance(one(codec.decoder().feed(frame.can_id, frame.data + bytes(16), 0)), MapLine)


@pytest.mark.parametrize("fd", [False, True])
def test_a_flipped_bit_never_becomes_a_line(codec: Any, fd: bool) -> None:
    """Wherever it is, the record is dropped; the same one, whole, and the next are delivered."""
    first, second = transfers(fd=fd)[3:5]
    for bit in range(0, 256, 3):
        decoder = codec.decoder()
        broken = with_a_flipped_bit(first, bit)
        assert not any(isinstance(answer, MapLine) for answer in feed(decoder, broken))
        answers = feed(decoder, [*first, *second], t_ns=10_000)
        assert sum(isinstance(answer, MapLine) for answer in answers) == 2, bit
        check_accounts(decoder, 3 * len(first))


def test_pages_of_two_transfers_with_one_id_fail_the_checksum(codec: Any) -> None:
    """Sixteen lines apart the transfer number is the same; the checksum tells them apart."""
    decoder = codec.decoder()
    mixed = [*transfers()[0][:2], *transfers()[16][2:]]
    assert feed(decoder, mixed)[-1] is Reason.CRC
    check_accounts(decoder, 4)


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


@pytest.mark.parametrize("timeout_ms", [0, -1, float("nan")])
def test_a_timeout_must_be_positive(codec: Any, timeout_ms: Any) -> None:
    """The message names value and unit."""
    with pytest.raises(ValueError, match="timeout_ms must be more than 0 ms"):
        codec.decoder(timeout_ms=timeout_ms)


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
