"""Authenticated lines: accepted from a sender with the key, once and in order."""

import time
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from answers import one
from support.dbcs import new_codec
from support.secoc_streams import (
    LAYOUT,
    MS,
    NOW,
    OTHER,
    SECRET,
    US,
    Clock,
    S,
    codec_of,
    feed,
    names,
    reference_cmac,
    sent,
)

from maplines_can import Codec, Slot
from maplines_can.generation.dbc.record_spec import SECURED
from maplines_can.values.errors import EncodeError, LayoutError
from maplines_can.wire import Authenticator, E2EState, Key, Layout, Reason, Verifier
from maplines_can.wire.layout.slot_messages import SecuredLayout


def test_every_byte_of_a_frame_is_as_documented(clock: Any, lines: Any) -> None:
    """Record, key ID, time in microseconds and MAC, computed independently from the same line."""
    codec = codec_of(Key(SECRET, key_id=9), clock=clock)
    (frame,) = codec.encoder().encode(lines[0], fd=True)
    (plain,) = new_codec().encoder().encode(lines[0], fd=True)
    assert (frame.can_id, frame.is_fd, len(frame.data)) == (0x350, True, 48)
    freshness = NOW // US
    assert frame.data[:33] == plain.data + b"\x09"
    assert frame.data[33:40] == freshness.to_bytes(7, "big")
    data = b"\x4d\x50" + frame.data[:33] + freshness.to_bytes(8, "big")
    assert frame.data[40:] == reference_cmac(SECRET, data)[:8]


# ---- freshness ------------------------------------------------------------------------------


def test_replay_reordering_and_loss(clock: Any, lines: Any) -> None:
    """A frame is accepted once, not after a later one, and after any number of lost frames."""
    codec = codec_of(clock=clock)
    frames = sent(codec.encoder(), clock, lines[0], 40)
    order = [0, 0, 1, 3, 2, 1, 3, 39, 38]
    decoder = codec_of().decoder()
    answers = names(feed(decoder, [frames[i] for i in order]))
    assert answers == ["line", "REPLAY", "line", "line", *["REPLAY"] * 3, "line", "REPLAY"]
    assert decoder.lines == decoder.line_frames == 4
    assert decoder.counts == {Reason.REPLAY: 5}


def test_freshness_increases_while_the_clock_stands_or_is_set_back(clock: Any, lines: Any) -> None:
    """A sender never uses a freshness value twice."""
    codec = codec_of(clock=clock)
    encoder = codec.encoder()
    frames = sent(encoder, clock, lines[0], 3, step_ns=0) + sent(encoder, clock, lines[0], 3, -S)
    decoder = codec_of().decoder()
    assert names(feed(decoder, frames)) == ["line"] * 6
    assert codec.authenticator.last_sent == NOW // US + 5


def test_a_recording_to_a_receiver_that_has_just_started(clock: Any, lines: Any) -> None:
    """Rejected by its clock or a stored freshness value; without either, accepted once."""
    recorded = sent(codec_of(clock=clock).encoder(), clock, lines[0], 20)
    last = clock.now // US
    clock.now += 10 * S
    assert set(names(feed(codec_of(clock=clock).decoder(), recorded))) == {"AGE"}
    assert set(names(feed(codec_of(not_before=last).decoder(), recorded))) == {"REPLAY"}
    without_clock = codec_of().decoder()
    assert names(feed(without_clock, recorded * 2)) == ["line"] * 20 + ["REPLAY"] * 20


@pytest.mark.parametrize(
    ("ahead_ns", "answer"),
    [(-S - US, "AGE"), (-S, "line"), (0, "line"), (S, "line"), (S + US, "AGE")],
)
def test_the_window_about_the_current_time(
    clock: Any, lines: Any, ahead_ns: Any, answer: str
) -> None:
    """A frame that was delayed too long, or is from the future, is rejected."""
    receiver = codec_of(clock=clock).decoder()
    frames = codec_of(clock=Clock(NOW + ahead_ns)).encoder().encode(lines[0], fd=True)
    assert names(feed(receiver, frames)) == [answer]
    (good,) = codec_of(clock=Clock(NOW + S)).encoder().encode(lines[0], fd=True)
    assert one(receiver.feed(good.can_id, good.data, NOW + S)) is not Reason.AGE


@cache
def with_freshness(n: int) -> Layout:
    """The layout of a DBC with n bytes of freshness value."""
    return Layout.from_text(replace(SECURED, freshness_bytes=n, slots=(Slot.EGO_LEFT,)).dbc())


@pytest.mark.parametrize("n", [1, 2])
def test_a_freshness_value_that_is_too_short_is_refused(n: int) -> None:
    """Item 8: 2 bytes of microseconds last 65 ms, so no line would be accepted."""
    with pytest.raises(LayoutError, match=r"Freshness is .*needs 24 to 56 bits"):
        with_freshness(n)


@pytest.mark.parametrize(
    ("n", "clock", "window_ns", "words"),
    [
        pytest.param(3, None, S, "3 bytes, but without a clock 7 are needed", id="3-no-clock"),
        pytest.param(4, Clock(), 2148 * S, "window_ns of 2147483647000 at most", id="4-window"),
        pytest.param(4, None, S, "silence of 4294.97 s", id="4-no-clock"),
        pytest.param(6, None, S, "give the authenticator a clock", id="6-no-clock"),
        pytest.param(3, Clock(), 8_388_608_000, "window_ns of 8388607000 at most", id="one-more"),
        pytest.param(3, Clock(), 9 * S, "repeat after 16.7772 s.* 8388607000 at most", id="window"),
    ],
)
def test_a_freshness_value_that_could_not_be_completed_is_refused(
    n: int, clock: Any, window_ns: int, words: str
) -> None:
    """Item 8: without a clock, or with too wide a window, when the codec is made."""
    keys = Authenticator(Key(SECRET), clock=clock, window_ns=window_ns)
    with pytest.raises(LayoutError, match=words):
        Codec(with_freshness(n), keys)
    with pytest.raises(LayoutError, match=words):
        Verifier(keys, SecuredLayout(41 + n, n, 8))


@pytest.mark.parametrize(
    ("n", "window_ns"), [(3, S), (3, 8_388_607_000), (4, S), (4, 2_147_483_647_000), (7, 600 * S)]
)
@pytest.mark.parametrize("offset", [-1, 0, 1])
@pytest.mark.parametrize(
    "gaps_s",
    [
        pytest.param([0.05] * 50, id="50-in-a-row"),
        pytest.param([0.05, 0.15, 0.05, 1.0, 0.05], id="lost-frames"),
        pytest.param([0.05, 16.8, 0.05, 33.554432, 0.05, 86_400, 0.05], id="silences"),
        pytest.param([0.05, 4294.967295, 4294.967296, 0.05, 12884.901888], id="4-bytes-again"),
    ],
)
def test_what_is_accepted_works(
    lines: Any, n: int, window_ns: int, offset: float, gaps_s: Any
) -> None:
    """Item 8: with a clock that is off by up to the window, each frame is accepted, and only once.

    So it is after lost frames and any silence.
    """
    own, other = Clock(), Clock()
    sender = Codec(with_freshness(n), Authenticator(Key(SECRET), clock=own))
    receiver = Authenticator(Key(SECRET), clock=other, window_ns=window_ns)
    decoder = Codec(with_freshness(n), receiver).decoder()
    line = lines[0]
    (record,) = sender.batch.encode(line.gaussian.mean[None], line.gaussian.cov[None])
    for gap_s in gaps_s:
        own.now += round(gap_s * S)
        other.now = own.now + US * round(offset * window_ns / US)
        (frame,) = sender.encoder().frames(record, line.slot, fd=True)
        first, again = (decoder.feed(frame.can_id, frame.data, own.now) for _ in range(2))
        assert first is Reason.DUPLICATE or not isinstance(first, Reason)  # the record is the same
        assert again is Reason.REPLAY


# ---- rejected frames ----------------------------------------------------------------------


def test_every_flipped_bit_is_rejected(clock: Any, lines: Any) -> None:
    """Each of the 384 bits of a frame; the frame itself is still accepted."""
    codec = codec_of(Key(SECRET, 1), Key(OTHER, 2), clock=clock)
    (frame,) = codec.encoder().encode(lines[0], fd=True)
    decoder = codec.decoder()
    for bit in range(384):
        data = bytearray(frame.data)
        data[bit // 8] ^= 1 << bit % 8
        assert one(decoder.feed(frame.can_id, bytes(data), NOW)) in {Reason.MAC, Reason.KEY}
    assert names(feed(decoder, [frame])) == ["line"]


@pytest.mark.parametrize(("mac_bytes", "n"), [(1, 6000), (2, 20_000)])
def test_as_many_guessed_macs_are_accepted_as_the_bound_says(
    lines: Any, mac_bytes: int, n: int
) -> None:
    """n / 2^bits of n, within four sampling errors.

    The receiver has received genuine traffic. It has no clock, so only the MAC and the last
    freshness value protect it: the guesses have the next one.
    """
    layout, clock = Layout.from_text(replace(SECURED, mac_bytes=mac_bytes).dbc()), Clock()
    keys, random = (Key(SECRET, 1), Key(OTHER, 2)), np.random.default_rng(0)
    frames = sent(Codec(layout, Authenticator(*keys, clock=clock)).encoder(), clock, lines[0], 20)
    decoder = Codec(layout, Authenticator(*keys)).decoder()
    assert names(feed(decoder, frames)) == ["line"] * 20
    last, secured = decoder.verifiers[Slot.EGO_LEFT].last_accepted, layout.secured
    assert secured is not None
    before, accepted, now = sum(last.values()), 0, clock.now
    for _ in range(n):
        now += US
        fresh = (now // US).to_bytes(8, "big")[-secured.freshness_bytes :]
        record = random.bytes(secured.authentic_bytes - 1) + bytes([random.integers(1, 3)])
        decoder.feed(frames[0].can_id, record + fresh + random.bytes(mac_bytes), now)
        accepted += sum(last.values()) != before
        before = sum(last.values())
    p = 2.0 ** (-8 * mac_bytes)
    assert abs(accepted - n * p) <= 4 * (n * p * (1 - p)) ** 0.5 + 1


@pytest.mark.parametrize("fd", [False, True])
def test_a_frame_without_a_mac_is_rejected(clock: Any, lines: Any, fd: bool) -> None:
    """Even a correct frame of the slot's other messages, and the E2E state does not change."""
    codec = codec_of(clock=clock)
    decoder = codec.decoder()
    good = sent(codec.encoder(), clock, lines[0], 20)
    assert names(feed(decoder, good)) == ["line"] * 20
    assert decoder.checks[Slot.EGO_LEFT].state is E2EState.VALID
    before = decoder.checks[Slot.EGO_LEFT].stats()
    plain = new_codec()
    plain_encoder = plain.encoder()
    without_mac = [frame for _ in range(20) for frame in plain_encoder.encode(lines[0], fd=fd)]
    damaged = [frame._replace(data=b"?") for frame in [*without_mac, *good]]
    answers = feed(decoder, without_mac + damaged, clock.now, step_ns=1)
    assert set(names(answers[: len(without_mac) * 2])) == {"UNAUTHENTICATED"}
    assert set(names(answers[len(without_mac) * 2 :])) == {"LENGTH"}
    assert decoder.checks[Slot.EGO_LEFT].stats() == before
    assert decoder.frames == decoder.line_frames + sum(decoder.counts.values()) + decoder.pending


# ---- keys -------------------------------------------------------------------------------------


def test_a_key_change_loses_no_line(clock: Any, lines: Any) -> None:
    """New key to the receiver, new key to the sender, old key retired: every line is accepted."""
    old, new = Key(SECRET, 1), Key(OTHER, 2)
    sender, receiver = codec_of(old, clock=clock), codec_of(old, clock=clock)
    encoder, decoder = sender.encoder(), receiver.decoder()

    def send() -> Any:
        (frame,) = encoder.encode(lines[0], fd=True)
        clock.now += 50 * MS
        return frame

    def take(frame: Any) -> Any:
        return names(feed(decoder, [frame], clock.now))

    assert take(send()) == ["line"]
    sender.authenticator.add(new)
    receiver.authenticator.add(new)
    waiting = send()  # encoded with the old key, still in a queue while the key changes
    sender.authenticator.use(2)
    assert take(waiting) + take(send()) == ["line", "line"]
    late = sender.authenticator
    late.use(1)
    with_the_old_key = send()
    late.use(2)
    receiver.authenticator.use(2)
    receiver.authenticator.retire(1)
    assert take(with_the_old_key) + take(send()) == ["KEY", "line"]
    assert sender.authenticator.active == new
    assert receiver.authenticator.keys == (new,)


def test_the_key_in_use_cannot_be_retired(clock: Any, lines: Any) -> None:
    """Before the first frame, any key but the last one can be retired."""
    first, second, third = (Key(SECRET, number) for number in (7, 2, 3))
    authenticator = codec_of(first, second, third, clock=clock).authenticator
    authenticator.retire(7)
    assert authenticator.active == second
    Codec.from_dbc(None, authenticator).encoder().encode(lines[0], fd=True)
    with pytest.raises(ValueError, match=r"one of \[3\], got 2; the key that is in use, 2, cannot"):
        authenticator.retire(2)
    authenticator.retire(3)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda _: Authenticator(Key(SECRET), window_ns=999), "at least 1000 ns .* got 999;"),
        (lambda _: Authenticator(Key(SECRET), window_ns=1), "a second is 1_000_000_000"),
        (lambda _: Authenticator(Key(SECRET), window_ns=float("inf")), "window_ns must .* got inf"),  # type: ignore[arg-type]
        (lambda _: Authenticator(Key(SECRET), window_ns=float("nan")), "window_ns must .* got nan"),  # type: ignore[arg-type]
        (lambda _: Authenticator(Key(SECRET), window_ns="1"), "window_ns must .* got a str"),  # type: ignore[arg-type]
        (lambda _: Authenticator(Key(SECRET), not_before=2**63), "not_before must be a whole"),
        (lambda _: Authenticator(Key(SECRET), not_before=1.5), "a whole number .* us, got 1.5"),  # type: ignore[arg-type]
        (lambda _: Authenticator(Key(SECRET), clock=time.time), r"time_ns, .* \d+\.\d+$"),  # type: ignore[arg-type]
        (lambda _: Authenticator(Key(SECRET), clock=lambda: 1e18), r"int, .* 1e\+18$"),  # type: ignore[arg-type, return-value]
        (lambda _: Authenticator(Key(SECRET), clock=5), "clock must be a function .* got 5$"),  # type: ignore[arg-type]
        (lambda a: a.retire(2), r"one of \[\], got 2"),
    ],
)
def test_an_invalid_argument_of_authentication_raises(act: Any, message: str) -> None:
    """The message has the cure."""
    with pytest.raises(ValueError, match=message):
        act(Authenticator(Key(SECRET)))


def test_a_record_that_does_not_fit_raises_and_no_freshness_value_is_lost() -> None:
    sender = Authenticator(Key(SECRET), clock=lambda: 1_000_000)
    for length in (LAYOUT.authentic_bytes, 100):
        with pytest.raises(EncodeError, match=f"32 bytes at most, got {length}"):
            sender.secure(bytes(length), 1, LAYOUT)
    assert sender.last_sent == 0
    assert len(sender.secure(bytes(32), 1, LAYOUT)) == LAYOUT.length
