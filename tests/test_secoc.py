"""Authenticated lines: what comes from who has the key, once and in order, and nothing else."""

import argparse
import json
import logging
import pickle
import re
import subprocess
import sys
import time
import traceback
import uuid
from dataclasses import replace
from pathlib import Path

import can
import cantools
import numpy as np
import pytest
from cryptography.hazmat.primitives.ciphers import Cipher, algorithms, modes
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import scene_lines

from maplines_can import Codec, Link, MapLine, Receiver, Slot, Transmitter, scenario
from maplines_can.bus import key_from_env, key_from_file
from maplines_can.bus.tx_queue import AHEAD, TxQueue
from maplines_can.cli import _parser, main
from maplines_can.errors import EncodeError, KeyMaterialError, LayoutError, MissingExtraError
from maplines_can.study.dbc.record_spec import SECURED, dbc_writer_for
from maplines_can.wire import Authenticator, E2EState, Key, Layout, Reason, Verifier
from maplines_can.wire.message.channel import SecuredForm
from maplines_can.wire.protection.secoc import complete

ROOT = Path(__file__).parents[1]
SECRET = bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c")  # of RFC 4493
OTHER = bytes.fromhex("603deb1015ca71be2b73aef0857d7781")
FORM = SecuredForm(length=48, freshness_bytes=7, mac_bytes=8)
DATA_ID = 0x4D50
US, MS, S = 1_000, 1_000_000, 1_000_000_000
NOW = 1_750_000_000 * S


class Clock:
    """A clock [ns] that a test sets."""

    def __init__(self, now=NOW):
        self.now = now

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def lines():
    return scene_lines(scenario("highway"), 2)


def codec_of(*keys, clock=None, **rest):
    return Codec.from_dbc(None, Authenticator(*(keys or (Key(SECRET),)), clock=clock, **rest))


def feed(decoder, frames, t_ns=NOW, step_ns=50 * MS):
    """Answers to frames, a period apart."""
    return [decoder.feed(f.can_id, f.data, t_ns + i * step_ns) for i, f in enumerate(frames)]


def names(answers):
    return ["line" if isinstance(answer, MapLine) else answer.name for answer in answers]


def sent(codec, clock, line, n, step_ns=50 * MS):
    """n frames of a line, a period apart."""
    frames = []
    for _ in range(n):
        frames += codec.encode(line, fd=True)
        clock.now += step_ns
    return frames


# ---- the MAC ------------------------------------------------------------------------------

#: RFC 4493 section 4 has AES-128, NIST SP 800-38B appendix D.3 AES-256; the messages are the same.
MESSAGE = bytes.fromhex(
    "6bc1bee22e409f96e93d7e117393172aae2d8a571e03ac9c9eb76fac45af8e51"
    "30c81c46a35ce411e5fbc1191a0a52eff69f2445df4f9b17ad2b417be66c3710"
)
AES_256 = OTHER + bytes.fromhex("1f352c073b6108d72d9810a30914dff4")


@pytest.mark.parametrize(
    ("secret", "length", "mac"),
    [
        (SECRET, 0, "bb1d6929e95937287fa37d129b756746"),
        (SECRET, 16, "070a16b46b4d4144f79bdd9dd04a287c"),
        (SECRET, 40, "dfa66747de9ae63030ca32611497c827"),
        (SECRET, 64, "51f0bebf7e3b9d92fc49741779363cfe"),
        (AES_256, 0, "028962f61b7bf89efc6b551f4667d983"),
        (AES_256, 16, "28a7023f452e8f82bd4bf28d8c37c35c"),
        (AES_256, 40, "aaf3d8f1de5640c232f5b169b9c911e6"),
        (AES_256, 64, "e1992190549f6ed5696a2c056c315410"),
    ],
)
def test_the_published_vectors(secret, length, mac):
    """RFC 4493 and NIST SP 800-38B, twice each: a key is used again and again."""
    key = Key.from_hex(secret.hex())
    assert [key.mac(MESSAGE[:length]).hex() for _ in range(2)] == [mac, mac]
    assert cmac_by_the_book(secret, MESSAGE[:length]).hex() == mac


def cmac_by_the_book(secret, data):
    """RFC 4493 figures 2.2 and 2.3, with nothing but AES of single blocks."""

    def aes(block):
        encryptor = Cipher(algorithms.AES(secret), modes.ECB()).encryptor()  # noqa: S305 - single blocks
        return encryptor.update(block) + encryptor.finalize()

    def doubled(number):
        return (number << 1) % 2**128 ^ (0x87 if number >> 127 else 0)

    k1 = doubled(int.from_bytes(aes(bytes(16)), "big"))
    blocks = [data[i : i + 16] for i in range(0, len(data), 16)] or [b""]
    last, k = (blocks[-1], k1) if len(blocks[-1]) == 16 else (blocks[-1] + b"\x80", doubled(k1))
    last = int.from_bytes(last.ljust(16, b"\0"), "big") ^ k
    x = bytes(16)
    for block in [*blocks[:-1], last.to_bytes(16, "big")]:
        x = aes((int.from_bytes(x, "big") ^ int.from_bytes(block, "big")).to_bytes(16, "big"))
    return x


def test_every_byte_of_a_frame_is_where_the_page_says(clock, lines):
    """Record, key number, time in microseconds, MAC: made again by hand from the same line."""
    codec = codec_of(Key(SECRET, key_id=9), clock=clock)
    (frame,) = codec.encode(lines[0], fd=True)
    (plain,) = Codec.from_dbc().encode(lines[0], fd=True)
    assert (frame.can_id, frame.is_fd, len(frame.data)) == (0x350, True, 48)
    freshness = NOW // US
    assert frame.data[:33] == plain.data + b"\x09"
    assert frame.data[33:40] == freshness.to_bytes(7, "big")
    data = b"\x4d\x50" + frame.data[:33] + freshness.to_bytes(8, "big")
    assert frame.data[40:] == cmac_by_the_book(SECRET, data)[:8]


def test_cantools_reads_what_is_sent(clock, lines):
    """The DBC names the key, the time and the MAC, and the record as the FD message has it."""
    database = cantools.database.load_file(ROOT / "dbc" / "maplines-secoc.dbc")
    (frame,) = codec_of(Key(SECRET, key_id=9), clock=clock).encode(lines[0], fd=True)
    signals = database.get_message_by_name("EgoLeftSecOc").decode(frame.data)
    assert [signals.pop(name) for name in ("KeyId", "Freshness", "Mac")] == [
        9,
        NOW // US,
        int.from_bytes(frame.data[40:], "big"),
    ]
    assert signals == database.get_message_by_name("EgoLeftFd").decode(frame.data[:32])
    for message in database.messages:
        assert sum(s.length for s in message.signals if not s.multiplexer_ids) <= 8 * message.length


# ---- freshness ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("sent", "bits", "floor", "value"),
    [
        pytest.param(0x01, 8, 0x00, 0x01, id="first"),
        pytest.param(0x00, 8, 0x00, 0x100, id="zero-again-is-a-round-later"),
        pytest.param(0xFE, 8, 0x1FE, 0x2FE, id="the-last-again-is-a-round-later"),
        pytest.param(0xFF, 8, 0x1FE, 0x1FF, id="the-next"),
        pytest.param(0x00, 8, 0x1FF, 0x200, id="the-next-wraps"),
        pytest.param(0xFF, 8, 0x1FF, 0x2FF, id="the-farthest"),
        pytest.param(0xFD, 8, 0x1FE, 0x2FD, id="one-back-is-nearly-a-round-on"),
        pytest.param(0x0000, 16, 0xFFFF, 0x10000, id="carry"),
        pytest.param(0xFFFFFFFF, 32, 0x5_00000000, 0x5_FFFFFFFF, id="32-bits"),
        pytest.param(0, 32, 0x5_FFFFFFFF, 0x6_00000000, id="32-bits-wrap"),
        pytest.param(2**56 - 1, 56, 2**56 - 2, 2**56 - 1, id="the-end-of-56-bits"),
        pytest.param(0, 56, 2**56 - 1, 2**56, id="beyond-56-bits"),
    ],
)
def test_freshness_is_completed(sent, bits, floor, value):
    """The next value that ends so: the same high part if the low one has grown, else one more."""
    assert complete(sent, bits, floor) == value


@given(st.integers(0, 2**60), st.sampled_from([8, 16, 32, 56]), st.data())
def test_whatever_is_near_enough_is_completed_right(floor, bits, data):
    """Every value of the next 2^bits is found again from its low bits."""
    value = floor + data.draw(st.integers(1, 2**bits))
    assert complete(value % 2**bits, bits, floor) == value


def test_replay_reordering_and_loss(clock, lines):
    """A frame is good once, not after a later one, and however many are lost before it."""
    codec = codec_of(clock=clock)
    frames = sent(codec, clock, lines[0], 40)
    order = [0, 0, 1, 3, 2, 1, 3, 39, 38]
    decoder = codec_of().decoder()
    answers = names(feed(decoder, [frames[i] for i in order]))
    assert answers == ["line", "REPLAY", "line", "line", *["REPLAY"] * 3, "line", "REPLAY"]
    assert decoder.lines == decoder.line_frames == 4
    assert decoder.counts == {Reason.REPLAY: 5}


def test_each_slot_has_its_own_freshness(clock, lines):
    """Frames of two slots may overtake each other, and none passes for the other's."""
    codec = codec_of(clock=clock)
    left, right = (codec.encode(line, fd=True)[0] for line in lines)
    decoder = codec.decoder()
    swapped = left._replace(can_id=right.can_id)
    assert names(feed(decoder, [right, left, swapped])) == ["line", "line", "MAC"]


def test_a_mixture_is_authentic_in_all_its_parts(clock):
    """A part that was forged or held back leaves no line."""
    (line,) = scene_lines(scenario("street-turn"), 1, components=3)
    codec = codec_of(clock=clock)
    first, second, third = codec.encode(line, fd=True)
    forged = second._replace(data=bytes([second.data[0] ^ 1]) + second.data[1:])
    decoder = codec.decoder()
    answers = feed(decoder, [first, forged, third, second, *codec.encode(line, fd=True)], step_ns=1)
    assert names(answers) == ["PENDING", "MAC", "PENDING", "REPLAY", "PENDING", "PENDING", "line"]


def test_values_grow_though_the_clock_stands_or_is_set_back(clock, lines):
    """A sender never gives a value twice."""
    codec = codec_of(clock=clock)
    frames = sent(codec, clock, lines[0], 3, step_ns=0) + sent(codec, clock, lines[0], 3, -S)
    decoder = codec_of().decoder()
    assert names(feed(decoder, frames)) == ["line"] * 6
    assert codec.authenticator.last_sent == NOW // US + 5


def test_a_sender_that_starts_anew(clock, lines):
    """Is heard at once if its clock went on; if that was set back, not until it has caught up."""
    decoder = codec_of().decoder()
    first = sent(codec_of(clock=clock), clock, lines[0], 10)
    clock.now += 3 * S
    again = sent(codec_of(clock=clock), clock, lines[0], 2)
    last = decoder_last(decoder, first + again)
    clock.now = NOW
    set_back = codec_of(clock=clock)
    assert names(feed(decoder, sent(set_back, clock, lines[0], 2), NOW + 9 * S)) == ["REPLAY"] * 2
    remembers = codec_of(clock=clock, not_before=last)
    # The first one is refused by E2E: a new sender begins with the counter that was the last.
    frames = sent(remembers, clock, lines[0], 2)
    assert "line" in names(feed(decoder, frames, NOW + 10 * S))


@pytest.mark.parametrize("apart", [3, 77, 128, 200])
def test_two_senders_with_the_same_key(clock, lines, apart):
    """Both are authentic and always newer: all is delivered, never VALID for long, and reported."""
    first, second, decoder = codec_of(clock=clock), codec_of(clock=clock), codec_of().decoder()
    sent(second, clock, lines[0], apart)
    answers = []
    for _ in range(20):
        answers += feed(decoder, sent(first, clock, lines[0], 1, 30 * MS), clock.now)
        answers += feed(decoder, sent(second, clock, lines[0], 1, 30 * MS), clock.now)
    check = decoder.checks[lines[0].slot]

    assert names(answers) == ["line"] * 40
    assert check.two_senders
    assert check.state is not E2EState.VALID


def decoder_last(decoder, frames):
    """Feed frames that are all good; returns the last freshness value."""
    answers = names(feed(decoder, frames))
    assert set(answers) <= {"line", "DUPLICATE"}
    assert answers.count("line") >= len(frames) - 1
    return decoder.verifier.last_accepted[DATA_ID]


def test_old_traffic_to_a_receiver_that_has_just_started(clock, lines):
    """Refused by its clock, or by what it has stored; without either it is taken, once."""
    recorded = sent(codec_of(clock=clock), clock, lines[0], 20)
    last = clock.now // US
    clock.now += 10 * S
    assert set(names(feed(codec_of(clock=clock).decoder(), recorded))) == {"AGE"}
    assert set(names(feed(codec_of(not_before=last).decoder(), recorded))) == {"REPLAY"}
    believer = codec_of().decoder()
    assert names(feed(believer, recorded * 2)) == ["line"] * 20 + ["REPLAY"] * 20


@pytest.mark.parametrize(
    ("ahead_ns", "answer"),
    [(-S - MS, "AGE"), (-S, "line"), (0, "line"), (S, "line"), (S + MS, "AGE")],
)
def test_the_window_about_now(clock, lines, ahead_ns, answer):
    """A frame that was held back, or that is of tomorrow, is not accepted."""
    receiver = codec_of(clock=clock).decoder()
    frames = codec_of(clock=Clock(NOW + ahead_ns)).encode(lines[0], fd=True)
    assert names(feed(receiver, frames)) == [answer]
    (good,) = codec_of(clock=Clock(NOW + S)).encode(lines[0], fd=True)
    assert receiver.feed(good.can_id, good.data, NOW + S) is not Reason.AGE


@pytest.mark.parametrize("freshness_bytes", [1, 2, 4, 7])
def test_narrow_freshness_with_a_counter(freshness_bytes):
    """Where the value counts frames, one byte will do: 255 lost ones are bridged, 256 are not."""
    form = replace(FORM, freshness_bytes=freshness_bytes, length=41 + freshness_bytes)
    count = Clock(0)
    sender = Authenticator(Key(SECRET), clock=count)
    verify = Verifier(Authenticator(Key(SECRET)), form)
    frames = []
    for i in range(1, 2000):
        count.now = 1000 * i
        frames.append(sender.secure(bytes(32), DATA_ID, form))
    kept = frames[:300] + frames[554:600]
    assert all(isinstance(verify(frame, DATA_ID), bytes) for frame in kept)
    assert verify(frames[598], DATA_ID) is Reason.REPLAY
    late = verify(frames[599 + 257], DATA_ID)
    assert late is Reason.MAC if freshness_bytes == 1 else isinstance(late, bytes)


def test_a_clock_completes_narrow_freshness_after_any_silence(tmp_path, clock, lines):
    """With 32 bits of microseconds a receiver without a clock is lost after 72 minutes."""
    path = tmp_path / "narrow.dbc"
    path.write_text(replace(SECURED, freshness_bytes=4, mac_bytes=8).dbc())
    sender = Codec.from_dbc(path, Authenticator(Key(SECRET), clock=clock))
    assert sender.layout.secured == SecuredForm(48, 4, 8)
    with_clock = Codec.from_dbc(path, Authenticator(Key(SECRET), clock=clock)).decoder()
    first = sent(sender, clock, lines[0], 1)
    base = (NOW - 60 * S) // US
    without = Codec.from_dbc(path, Authenticator(Key(SECRET), not_before=base)).decoder()
    clock.now -= 50 * MS
    assert names(feed(with_clock, first) + feed(without, first)) == ["line", "line"]
    clock.now += 3 * 3600 * S
    (later,) = sender.encode(lines[0], fd=True)
    answers = [
        decoder.feed(later.can_id, later.data, clock.now) for decoder in (with_clock, without)
    ]
    assert names(answers) == ["line", "MAC"]


# ---- what is refused -----------------------------------------------------------------------


def test_every_bit_counts(clock, lines):
    """Each of the 384 bits of a frame, flipped: refused, and the frame itself is still good."""
    codec = codec_of(Key(SECRET, 1), Key(OTHER, 2), clock=clock)
    (frame,) = codec.encode(lines[0], fd=True)
    decoder = codec.decoder()
    for bit in range(384):
        data = bytearray(frame.data)
        data[bit // 8] ^= 1 << bit % 8
        assert decoder.feed(frame.can_id, bytes(data), NOW).name in {"MAC", "KEY"}
    assert names(feed(decoder, [frame])) == ["line"]


@pytest.mark.parametrize("length", [0, 8, 32, 33, 47, 49, 64])
def test_another_length_is_refused(clock, lines, length):
    """Truncated or longer; a frame of 32 bytes is the record without its proof."""
    codec = codec_of(clock=clock)
    (frame,) = codec.encode(lines[0], fd=True)
    decoder = codec.decoder()
    cut = frame._replace(data=frame.data.ljust(64, b"\0")[:length])
    assert names(feed(decoder, [cut, frame])) == ["LENGTH", "line"]


@pytest.mark.parametrize("fd", [False, True])
def test_what_has_no_mac_is_refused(clock, lines, fd):
    """The other messages of the same slots, right to the last bit, and what they say of E2E."""
    codec = codec_of(clock=clock)
    decoder = codec.decoder()
    good = sent(codec, clock, lines[0], 20)
    assert names(feed(decoder, good)) == ["line"] * 20
    assert decoder.checks[Slot.EGO_LEFT].state is E2EState.VALID
    before = decoder.checks[Slot.EGO_LEFT].stats()
    plain = Codec.from_dbc()
    unproved = [frame for _ in range(20) for frame in plain.encode(lines[0], fd=fd)]
    spoilt = [frame._replace(data=b"?") for frame in [*unproved, *good]]
    answers = feed(decoder, unproved + spoilt, clock.now, step_ns=1)
    assert set(names(answers[: len(unproved) * 2])) == {"UNAUTHENTICATED"}
    assert set(names(answers[len(unproved) * 2 :])) == {"LENGTH"}
    assert decoder.checks[Slot.EGO_LEFT].stats() == before
    assert decoder.frames == decoder.line_frames + sum(decoder.counts.values()) + decoder.pending


def test_a_receiver_without_a_key_does_not_believe_a_mac(clock, lines):
    """It says that the key is missing, and takes the plain messages as before."""
    path = ROOT / "dbc" / "maplines-secoc.dbc"
    plain = Codec.from_dbc(path)
    decoder = plain.decoder()
    secured = sent(codec_of(clock=clock), clock, lines[0], 2)
    assert names(feed(decoder, [*secured, *plain.encode(lines[0], fd=True)])) == [
        *["KEY"] * 2,
        "line",
    ]


def test_classic_can_says_that_it_is_not_authenticated(clock, lines):
    """Rather than to send without a MAC what was meant to have one."""
    codec = codec_of(clock=clock)
    with pytest.raises(EncodeError, match="classic CAN is not authenticated; send CAN FD"):
        codec.encode(lines[0])
    with pytest.raises(LayoutError, match=r"maplines\.dbc has no authenticated message .*classic"):
        Codec.from_dbc(ROOT / "dbc" / "maplines.dbc", Authenticator(Key(SECRET)))
    with pytest.raises(EncodeError, match=r"needs a clock, such as time\.time_ns"):
        codec_of().encode(lines[0], fd=True)


@settings(max_examples=300, deadline=None)
@given(st.binary(max_size=64), st.sampled_from([0x340, 0x348, 0x350, 0x7FF]), st.booleans())
def test_no_bytes_from_the_bus_can_raise(data, can_id, is_extended):
    """Whatever comes is dropped with a reason."""
    decoder = CODEC.decoder()
    assert isinstance(decoder.feed(can_id, data, NOW, is_extended=is_extended), Reason)


CODEC = codec_of(Key(SECRET, 0), Key(OTHER, 255), clock=Clock())


# ---- keys -------------------------------------------------------------------------------------


def test_a_key_change_loses_no_line(clock, lines):
    """New key to the receiver, new key at the sender, old key away: every line arrives."""
    old, new = Key(SECRET, 1), Key(OTHER, 2)
    sender, receiver = codec_of(old, clock=clock), codec_of(old, clock=clock)
    decoder = receiver.decoder()

    def send():
        (frame,) = sender.encode(lines[0], fd=True)
        clock.now += 50 * MS
        return frame

    def take(frame):
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


def test_a_key_that_others_do_not_have(clock, lines):
    """Another secret, another number, or the same secret under two numbers."""
    sender = codec_of(Key(SECRET, 1), clock=clock)
    frames = sent(sender, clock, lines[0], 1)
    clock.now = NOW
    assert names(feed(codec_of(Key(OTHER, 1), clock=clock).decoder(), frames)) == ["MAC"]
    assert names(feed(codec_of(Key(SECRET, 2), clock=clock).decoder(), frames)) == ["KEY"]
    twice = codec_of(Key(SECRET, 1), Key(SECRET, 3), clock=clock).decoder()
    renumbered = frames[0]._replace(data=frames[0].data[:32] + b"\x03" + frames[0].data[33:])
    assert names(feed(twice, [renumbered, *frames])) == ["MAC", "line"]


def test_the_steps_of_a_key_change(clock, lines):
    """Those of docs/security.md: no line is lost, and in the end the old key is none any more."""
    old, new = Key(SECRET, 1), Key(OTHER, 2)
    sender, receiver = codec_of(old, clock=clock), codec_of(old, clock=clock)
    decoder = receiver.decoder()
    answers = feed(decoder, sent(sender, clock, lines[0], 2))
    receiver.authenticator.add(new)
    sender.authenticator.add(new)
    late = sent(sender, clock, lines[0], 1)
    sender.authenticator.use(2)
    answers += feed(decoder, late + sent(sender, clock, lines[0], 2), clock.now)
    receiver.authenticator.retire(1)
    sender.authenticator.retire(1)
    answers += feed(decoder, sent(sender, clock, lines[0], 1), clock.now)
    forged = sent(codec_of(old, clock=clock), clock, lines[0], 1)

    assert names(answers) == ["line"] * 6
    assert names(feed(decoder, forged)) == ["KEY"]
    assert [a.authenticator.keys for a in (sender, receiver)] == [(new,), (new,)]
    assert receiver.authenticator.active == new


def test_the_page_tells_the_steps_of_a_key_change():
    """The code of docs/security.md, run as it stands."""
    (steps,) = re.findall("```python\n(.*?)```", (ROOT / "docs" / "security.md").read_text(), re.S)
    old, new = Key(SECRET, 1), Key(OTHER, 2)
    sender, receiver = (Authenticator(old, clock=time.time_ns) for _ in range(2))
    sender.secure(bytes(32), DATA_ID, FORM)
    exec(steps, {"sender": sender, "receiver": receiver, "new": new})  # noqa: S102 - our own page

    assert sender.keys == receiver.keys == (new,)


def test_who_sends_keeps_the_key_it_sends_with(clock, lines):
    """And who has never sent keeps one; the first of those that are left is then sent with."""
    first, second, third = (Key(SECRET, number) for number in (7, 2, 3))
    authenticator = codec_of(first, second, third, clock=clock).authenticator
    authenticator.retire(7)
    assert authenticator.active == second
    Codec.from_dbc(None, authenticator).encode(lines[0], fd=True)
    with pytest.raises(ValueError, match=r"one of \[3\], got 2; the key that is in use, 2, cannot"):
        authenticator.retire(2)
    authenticator.retire(3)


@pytest.mark.parametrize(
    ("act", "message"),
    [
        (lambda _: Authenticator(), "needs a key or more"),
        (lambda _: Authenticator(Key(SECRET, 1), Key(OTHER, 1)), r"key_id 1 is taken by Key\("),
        (lambda _: Authenticator(Key(SECRET), window_ns=0), "must be at least 1000 ns .* got 0;"),
        (lambda _: Authenticator(Key(SECRET), window_ns=1), "a second is 1_000_000_000"),
        (lambda _: Authenticator(Key(SECRET), window_ns=float("inf")), "window_ns must .* got inf"),
        (lambda _: Authenticator(Key(SECRET), window_ns=float("nan")), "window_ns must .* got nan"),
        (lambda _: Authenticator(Key(SECRET), window_ns="1"), "window_ns must .* got '1'"),
        (lambda _: Authenticator(Key(SECRET), not_before=-1), r"from 0 to 2\^63 - 1 us, got -1"),
        (lambda _: Authenticator(Key(SECRET), not_before=2**63), "not_before must be a whole"),
        (lambda _: Authenticator(Key(SECRET), not_before=1.5), "a whole number .* us, got 1.5"),
        (lambda _: Authenticator(Key(SECRET), clock=time.time), r"time_ns, got \d+\.\d+ from <"),
        (lambda _: Authenticator(Key(SECRET), clock=lambda: 1e18), r"int, .* got 1e\+18 from <"),
        (lambda _: Authenticator(Key(SECRET), clock=5), "clock must be a function .* from 5$"),
        (lambda a: a.use(3), r"key_id must be one of \[1\], got 3; add it"),
        (lambda a: a.retire(1), r"one of \[\], got 1; the key that is in use, 1, cannot be"),
        (lambda a: a.retire(2), r"one of \[\], got 2"),
        (lambda _: Key(SECRET, 256), "key_id must be a whole number from 0 to 255, got 256"),
        (lambda _: Key(SECRET, "1"), "from 0 to 255, got a str"),
        (lambda _: Key(SECRET[:15]), "must have 16 or 32 bytes .* got 15"),
        (lambda _: Key(SECRET.hex()), r"must be bytes, got a str; Key\.from_hex reads hex digits"),
        (lambda _: Key.from_hex(SECRET), "a key must be text of hex digits, got a bytes"),
        (lambda _: Key(bytes(16)), "a single byte repeated"),
    ],
)
def test_a_mistake_of_the_caller_raises(act, message):
    """At once, with the cure."""
    with pytest.raises(ValueError, match=message):
        act(Authenticator(Key(SECRET)))


def test_a_clock_beyond_all_time_is_refused():
    """The value must fit 64 bits."""
    with pytest.raises(EncodeError, match="freshness must be"):
        Authenticator(Key(SECRET), clock=lambda: 1000 * 2**63).secure(bytes(32), 1, FORM)


def key_file(tmp_path, text, mode=0o600):
    path = tmp_path / "car.key"
    path.write_bytes(text)
    path.chmod(mode)
    return path


@pytest.mark.parametrize("text", [SECRET.hex(), f"\n {SECRET.hex().upper()}\r\n", AES_256.hex()])
def test_a_key_from_a_file_and_from_the_environment(tmp_path, monkeypatch, text):
    """Hex digits in either case, and the end of the line that an editor adds."""
    monkeypatch.setenv("CAR_KEY", text)
    key = key_from_file(key_file(tmp_path, text.encode()), key_id=7)
    assert key == key_from_env("CAR_KEY", 7) == Key(bytes.fromhex(text.strip()), 7)
    assert len({key, key_from_env("CAR_KEY", 7)}) == 1
    assert key != key_from_env("CAR_KEY", 8)
    assert key != Key(OTHER, 7)
    assert key != text


@pytest.mark.parametrize(
    ("text", "mode", "message"),
    [
        (SECRET.hex()[:-1].encode(), 0o600, "must hold 32 or 64 hex digits .* got 31 characters$"),
        (SECRET.hex().encode() + b"0" * 16, 0o600, "got 48 characters$"),
        (b"", 0o600, "got 0 characters$"),
        (SECRET.hex()[:-1].encode() + b"g", 0o600, "32 characters, not all of them hex digits$"),
        (SECRET, 0o600, "not all of them hex digits$"),
        (SECRET.hex().encode(), 0o604, r"everybody .* \(mode 0604\); chmod 600"),
        (SECRET.hex().encode(), 0o644, r"everybody .* \(mode 0644\); chmod 600"),
    ],
)
def test_a_bad_key_file_is_one_clear_error(tmp_path, text, mode, message):
    """It names the file and what is wrong, and not what is in it."""
    path = key_file(tmp_path, text, mode)
    with pytest.raises(KeyMaterialError, match=message) as caught:
        key_from_file(path)
    assert str(path) in str(caught.value)
    check_secret(str(caught.value))


def test_a_missing_key_is_one_clear_error(tmp_path, monkeypatch):
    """No such file, no such variable."""
    monkeypatch.delenv("CAR_KEY", raising=False)
    with pytest.raises(KeyMaterialError, match=r"none\.key: cannot be read: No such file"):
        key_from_file(tmp_path / "none.key")
    with pytest.raises(KeyMaterialError, match="environment variable CAR_KEY is not set"):
        key_from_env("CAR_KEY")


def test_without_cryptography_the_extra_is_named(monkeypatch):
    """And everything else works."""
    monkeypatch.setitem(sys.modules, "cryptography.hazmat.primitives.cmac", None)
    with pytest.raises(MissingExtraError, match=r'pip install "maplines_can\[secoc\]"'):
        Key(SECRET)


def test_the_package_starts_without_cryptography():
    """Who does not authenticate does not load it."""
    code = "import sys, maplines_can.cli; print('cryptography' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=ROOT
    )
    assert done.stdout.strip() == "False"


# ---- no key in any text ------------------------------------------------------------------------


def check_secret(text):
    """No eight digits in a row of the secret, and none of its bytes as Python prints them."""
    lowered = text.lower()
    for i in range(len(SECRET.hex()) - 7):
        assert SECRET.hex()[i : i + 8] not in lowered
    assert repr(SECRET)[2:-1] not in text
    assert str(list(SECRET))[1:-1] not in text


def test_no_text_of_any_object_holds_the_key(clock, lines):
    """Not repr, str, vars, pickle or a traceback with all locals, with logging at its loudest."""
    key = Key(SECRET)
    codec = codec_of(key, clock=clock)
    for thing in (key, codec.authenticator, codec, codec.decoder(), codec.verifier()):
        check_secret(f"{thing!r} {thing} {getattr(thing, '__dict__', '')} {dir(thing)}")
    assert repr(key) == f"Key(key_id=1, fingerprint='{key.fingerprint}')"
    with pytest.raises(TypeError, match="cannot be pickled"):
        pickle.dumps(key)
    try:
        codec.encode(lines[0])
    except EncodeError as error:
        check_secret(whole_traceback(error))


@pytest.mark.parametrize(
    "act",
    [
        pytest.param(lambda _: key_from_env("CAR_KEY_AND_MORE"), id="too-long"),
        pytest.param(lambda path: key_from_file(path.with_suffix(".bad")), id="no-digits"),
        pytest.param(lambda path: key_from_file(path, 300), id="number-in-file"),
        pytest.param(lambda _: key_from_env("CAR_KEY", "1"), id="number-in-env"),
        pytest.param(lambda _: Key.from_hex(SECRET.hex(), None), id="number-of-hex"),
        pytest.param(lambda _: Key(1, SECRET), id="the-wrong-way-round"),
        pytest.param(lambda _: Key(SECRET[:15]), id="too-short"),
        pytest.param(lambda _: Key(list(SECRET)), id="list"),
        pytest.param(lambda _: Key(SECRET.hex()), id="hex-for-bytes"),
        pytest.param(lambda _: Key.from_hex(SECRET), id="bytes-for-hex"),
        pytest.param(lambda _: Authenticator(SECRET), id="no-key"),
        pytest.param(lambda _: Authenticator(Key(SECRET)).add(SECRET), id="no-key-added"),
        pytest.param(lambda _: key_from_file(SECRET.hex()), id="key-for-file"),
        pytest.param(lambda _: key_from_env(SECRET.hex()), id="key-for-env"),
    ],
)
def test_no_traceback_of_a_bad_key_holds_it(tmp_path, monkeypatch, act):
    """Not even with the locals of every frame of ours, and their repr works."""
    monkeypatch.setenv("CAR_KEY", SECRET.hex())
    monkeypatch.setenv("CAR_KEY_AND_MORE", SECRET.hex() + "0")
    path = key_file(tmp_path, SECRET.hex().encode())
    path.with_suffix(".bad").write_bytes(SECRET.hex().encode() + b"zz")
    path.with_suffix(".bad").chmod(0o600)
    with pytest.raises((KeyMaterialError, TypeError)) as caught:
        act(path)
    check_traceback(caught.value)


def test_no_traceback_without_cryptography_holds_a_key(tmp_path, monkeypatch):
    """The key was read by then."""
    monkeypatch.setitem(sys.modules, "cryptography.hazmat.primitives.cmac", None)
    monkeypatch.setenv("CAR_KEY", SECRET.hex())
    path = key_file(tmp_path, SECRET.hex().encode())
    for act in (lambda: key_from_env("CAR_KEY"), lambda: key_from_file(path), lambda: Key(SECRET)):
        with pytest.raises(MissingExtraError) as caught:
            act()
        check_traceback(caught.value)


def check_traceback(error):
    text = whole_traceback(error)
    assert "path = " in text or "monkeypatch = " in text  # locals are there
    assert "repr() failed" not in text
    check_secret(text)


def whole_traceback(error):
    report = traceback.TracebackException.from_exception(error, capture_locals=True)
    return "".join(report.format())


COLONS = ":".join(f"{byte:02x}" for byte in SECRET)
HEX = SECRET.hex()


@pytest.mark.parametrize("option", ["--key-file", "--key-env"])
@pytest.mark.parametrize(
    "text",
    [
        *(HEX, HEX.upper(), f"0x{HEX}", f"./{HEX}", f"{HEX}.key", f"2:{HEX}", f"{HEX}:a"),
        *(HEX[:-1], HEX * 9, COLONS, f"12:{COLONS}"),
        *(COLONS.replace(":", "-"), COLONS.replace(":", " ")),
    ],
)
def test_a_key_on_the_command_line_is_not_repeated(capsys, option, text):
    """Who gives the key itself instead of its file is told so, without it."""
    assert main(["demo", option, text]) == 1
    out, err = capsys.readouterr()
    assert "looks like a key itself" in err
    check_typed(out + err)


@pytest.mark.parametrize(
    "words",
    [
        ["demo", f"--key={HEX}"],
        ["demo", f"--key=0x{HEX.upper()}"],
        ["demo", "--key", HEX],
        ["demo", "--keyfile", HEX],
        ["demo", "--key-files", COLONS],
        ["demo", f"-k{HEX}"],
        ["demo", "--key-env", "A", HEX],
        ["demo", "--key-env", "A", *COLONS.split(":")],
        ["demo", "--rate", HEX],
        ["receive", f"--key={HEX[:-1]}"],
        ["study", "report", "--out", "a", "b", f"--key={HEX}"],
        [HEX],
    ],
)
def test_a_wrong_command_line_is_not_repeated_where_it_may_hold_a_key(capsys, words):
    """No option is taken by its beginning, and what may be a key is left out of errors."""
    with pytest.raises(SystemExit, match="2"):
        main(words)
    out, err = capsys.readouterr()
    assert "(hidden)" in err
    check_typed(out + err)


def check_typed(text):
    """As check_secret, however the digits are set apart."""
    check_secret(text)
    check_secret(re.sub("[^0-9A-Za-z]", "", text))


def test_a_wrong_command_line_is_told_as_ever(capsys):
    """What cannot be a key is repeated."""
    with pytest.raises(SystemExit, match="2"):
        main(["demo", "--keyfile", "car.key", "--key", "2024-10-11"])
    assert "arguments: --keyfile car.key --key 2024-10-11\n" in capsys.readouterr().err


def test_a_name_like_a_key_is_a_name_where_there_is_such_a_thing(tmp_path, monkeypatch):
    """Files and variables may be named by numbers of their own."""
    path = key_file(tmp_path, HEX.encode()).rename(tmp_path / f"{OTHER.hex()}.key")
    monkeypatch.setenv("F47AC10B58CC4372A5670E02", HEX)
    assert key_from_file(path) == key_from_env("F47AC10B58CC4372A5670E02") == Key(SECRET)


# ---- over a bus ----------------------------------------------------------------------------------


@pytest.fixture
def channel():
    return f"test-{uuid.uuid4()}"


def test_over_a_bus_with_an_attacker_and_a_key_change(channel):
    """All that was sent arrives, once; what the attacker plays is counted."""
    old, new = Key(SECRET, 1), Key(OTHER, 2)
    sender, receiver = codec_of(old, clock=time.time_ns), codec_of(old, new, clock=time.time_ns)
    bus = {"interface": "virtual", "channel": channel, "fd": True}
    with Link(**bus) as out, Link(**bus) as back, can.Bus(**bus) as attacker:
        with Receiver(back, receiver.decoder(), can_ids=receiver.can_ids) as listening:
            transmitter = Transmitter(out, sender, period=0.01, fd=True, count=40)
            with transmitter:
                transmitter.publish(scene_lines(scenario("highway"), 2))
                heard = []
                while not transmitter.wait(0.001):
                    if (message := attacker.recv(0.001)) is not None:
                        heard.append(message)
                        attacker.send(changed(message, message.data))  # again
                        attacker.send(changed(message, message.data[:-1] + b"?"))
                    if len(heard) == 15:
                        sender.authenticator.add(new)
                        sender.authenticator.use(2)
            time.sleep(0.2)
        stats, sent_stats = listening.stats(), transmitter.stats()
    assert stats.lines == sent_stats.lines > 60
    assert stats.counts[Reason.REPLAY] >= len(heard) > 15
    assert stats.counts[Reason.MAC] >= len(heard) - 2
    assert stats.frames == stats.lines + sum(stats.counts.values())


@pytest.mark.parametrize("period", [0.01, 0.05, 0.4, 3.0, 3600.0])
def test_a_slow_sender_signs_just_before_it_sends(clock, period):
    """At any rate no line is older than a tenth of a second, so the window can be narrow."""
    sender, receiver = codec_of(clock=clock), codec_of(clock=clock, window_ns=AHEAD * S + MS)
    decoder = receiver.decoder(cycle_ms=min(1e3 * period, 60_000))
    tx_queue = TxQueue(sender, period, fd=True, count=3)
    tx_queue.put(scene_lines(scenario("highway"), 8), 0.0)
    now, answers = 0.0, []
    while not tx_queue.over:
        now += tx_queue.wait(now) + 1e-6
        clock.now = NOW + round(now * S)
        answers += feed(decoder, tx_queue.take(now).frames, clock.now)

    assert names(answers) == ["line"] * 24


def changed(message, data):
    return can.Message(
        arbitration_id=message.arbitration_id, is_extended_id=False, is_fd=True, data=data
    )


def test_the_demo_with_a_key(capsys, caplog, tmp_path, monkeypatch):
    """From a file for people and from the environment for machines, and no key anywhere."""
    caplog.set_level(logging.DEBUG)
    path = key_file(tmp_path, SECRET.hex().encode())
    assert main(["demo", "--key-file", str(path), "--seconds", "0.2"]) == 0
    text = capsys.readouterr()
    assert "over CAN FD, authenticated, 20 Hz" in text.out
    monkeypatch.setenv("CAR_KEY", SECRET.hex())
    assert main(["demo", "--key-env", "3:CAR_KEY", "--seconds", "0.2", "--json"]) == 0
    machine = capsys.readouterr()
    result = json.loads(machine.out)
    assert (result["lines_lost"], result["carrier"]) == (0, "CAN FD, authenticated")
    check_secret("".join([*text, *machine, caplog.text]))


def test_send_and_receive_with_keys(capsys, channel, tmp_path, monkeypatch):
    """Right key: lines. Wrong key: none, and why."""
    path = key_file(tmp_path, SECRET.hex().encode())
    monkeypatch.setenv("WRONG", OTHER.hex())
    bus = ["--interface", "virtual", "--channel", channel]
    authenticator = Authenticator(key_from_file(path, 2), clock=time.time_ns)
    with (
        Link(interface="virtual", channel=channel, fd=True) as link,
        Transmitter(link, Codec.from_dbc(None, authenticator), period=0.02, fd=True) as transmitter,
    ):
        transmitter.publish(scene_lines(scenario("highway"), 2))
        keys = ["--key-env", "1:WRONG", "--key-file", f"2:{path}"]
        assert main(["receive", *bus, *keys, "--count", "4", "--json"]) == 0
        rows = [json.loads(row) for row in capsys.readouterr().out.splitlines()]
        assert {row["slot"] for row in rows} == {"EGO_LEFT", "EGO_RIGHT"}
        assert main(["receive", *bus, "--key-env", "2:WRONG", "--timeout", "0.2"]) == 0
    out, err = capsys.readouterr()
    assert not out
    assert re.search(r"0 lines from \d+ frames.*dropped frames: \d+ mac", err)
    check_secret(out + err)


def test_a_recorded_log_is_decoded_with_its_key(capsys, tmp_path, clock, lines):
    """However old it is: only the order counts."""
    path, codec = tmp_path / "drive.log", codec_of(clock=clock)
    frames = sent(codec, clock, lines[0], 4)
    with can.Logger(path) as writer:
        for i, frame in enumerate([*frames, frames[1]]):
            writer(
                can.Message(
                    NOW / S + 0.05 * i,
                    frame.can_id,
                    is_extended_id=False,
                    is_fd=True,
                    data=frame.data,
                    channel="can0",
                )
            )
    assert (
        main(["decode", str(path), "--key-file", str(key_file(tmp_path, SECRET.hex().encode()))])
        == 0
    )
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 4
    assert "dropped frames: 1 replay" in err


def test_classic_can_with_a_key_is_an_error(capsys, tmp_path):
    """A DBC without authenticated messages cannot be sent or received with a key."""
    path = key_file(tmp_path, SECRET.hex().encode())
    dbc = str(ROOT / "dbc" / "maplines.dbc")
    for job in ("demo", "send", "receive"):
        assert main([job, "--key-file", str(path), "--dbc", dbc, "--interface", "virtual"]) == 1
        assert "plain CAN FD are not authenticated" in capsys.readouterr().err


def test_keys_are_sent_with_in_the_order_they_are_given():
    """Files and variables alike; a number before the colon, else 1."""
    words = ["send", "--key-env", "2:NEW", "--key-file", "a:b", "--key-file", "255:c"]
    parsed: argparse.Namespace = _parser(words).parse_args(words)
    assert [(name, number) for _, name, number in parsed.keys] == [
        ("NEW", 2),
        ("a:b", 1),
        ("c", 255),
    ]


# ---- the DBC ----------------------------------------------------------------------------


def test_the_page_names_the_ids_of_the_dbc():
    """The table of slots in dbc/README.md says what the DBC says."""
    page = (ROOT / "dbc" / "README.md").read_text()
    for channel in Layout.from_dbc(ROOT / "dbc" / "maplines-secoc.dbc").channels.values():
        assert f"| 0x{channel.secured_can_id:03X} | 0x{channel.secured_data_id:04X} |" in page


def test_the_record_is_the_same():
    """Fields, pages, IDs and checksums of maplines.dbc."""
    plain, secured = Layout.from_dbc(), Layout.from_dbc(ROOT / "dbc" / "maplines-secoc.dbc")
    assert plain.fields == secured.fields
    assert plain.page_of_id.items() <= secured.page_of_id.items()
    assert (plain.secured, secured.secured) == (None, FORM)


@pytest.mark.parametrize("code", ["MeanOnly", "Float16"])
def test_other_records_are_authenticated_too(tmp_path, clock, code):
    """Of 24 bytes, with padding that the MAC covers, and of 48, which fill the largest frame."""
    path = tmp_path / "other.dbc"
    path.write_text(replace(dbc_writer_for(code), first_secured_can_id=0x350).dbc())
    codec = Codec.from_dbc(path, Authenticator(Key(SECRET), clock=clock))
    (line,) = scene_lines(scenario("highway"), 1)
    (frame,) = codec.encode(line, fd=True)
    decoder = codec.decoder()
    padding = codec.layout.record_bytes
    spoilt = frame.data[:padding] + bytes([frame.data[padding] ^ 1]) + frame.data[padding + 1 :]
    assert names(feed(decoder, [frame._replace(data=spoilt)]))[0] in {"MAC", "KEY"}
    assert names(feed(decoder, [frame])) == ["line"]


@pytest.mark.parametrize(
    ("pattern", "replacement", "message"),
    [
        (r"SG_ Mac : 327\|64@0", "SG_ Mac : 320|64@1", "must end with KeyId, Freshness, Mac"),
        (r"SG_ KeyId : 263\|8@0", "SG_ KeyId : 263|7@0", "KeyId has 1 to 1 bytes"),
        (r"SG_ Freshness :.*\n", "", "must end with KeyId, Freshness, Mac"),
        (r"EgoLeftSecOc: 48", "EgoLeftSecOc: 64", "must end with KeyId, Freshness, Mac"),
        (
            r'"SecOCDataId" BO_ 848 \d+',
            '"SecOCDataId" BO_ 848 70000',
            "SecOCDataId must be a whole",
        ),
        (r'"VFrameFormat" BO_ 848 14', '"VFrameFormat" BO_ 848 0', "must be a CAN FD message"),
    ],
)
def test_a_dbc_whose_mac_is_elsewhere_is_refused(pattern, replacement, message):
    """Rather than to check the wrong bytes."""
    text, found = re.subn(
        pattern, replacement, (ROOT / "dbc" / "maplines-secoc.dbc").read_text(), count=1
    )
    assert found
    with pytest.raises(LayoutError, match=message):
        Layout.from_text(text)


def test_the_evidence_holds_for_few():
    """tools/evidence_secoc.py at a thousandth of its size."""
    tool = [sys.executable, ROOT / "tools" / "evidence_secoc.py", "--n", "1000", "--json"]
    done = subprocess.run(tool, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(done.stdout)
    assert result["met"]
    assert np.all([attack["accepted"] == 0 for attack in result["attacks"].values()])
