"""Fault injection: what it does to frames, that it counts all of it, and that a receiver lives."""

import errno
import itertools
import json
import math
import os
import queue
import re
import subprocess
import sys
import threading
import time
from functools import cache
from pathlib import Path

import can
import numpy as np
import pytest
from dbcs import default_codec
from hypothesis import given, settings
from hypothesis import strategies as st

from maplines_can.bus import Link, Receiver, Sent, Transmitter
from maplines_can.cli import main
from maplines_can.line import MapLine, Slot
from maplines_can.study import road
from maplines_can.testing import Action, FaultInjector, FaultKind, Faults, FaultyBus, FaultyOpener
from maplines_can.testing.faults import LENGTHS
from maplines_can.wire import Frame

ROOT = Path(__file__).parents[1]
LONG = 20.0  # seconds that a test waits for something that must happen
MIX = "loss=0.1,dup=0.05,reorder=0.05,corrupt=0.02"


def numbered(n, size=8):
    """Frames that carry their numbers, all different."""
    return [Frame(0x340 + i % 8, i.to_bytes(size, "big")) for i in range(n)]


def number_of(frame):
    return int.from_bytes(frame.data, "big")


def run(injector, frames, step=0.0):
    """All that comes out, ``step`` [s] between two frames, and at the end what is held back."""
    out = [f for i, frame in enumerate(frames) for f in injector.apply(frame, i * step)]
    return out + injector.flush()


def check_sums(injector):
    done = injector.counts
    came = injector.frames + done[FaultKind.DUPLICATED] + done[FaultKind.FLOODED]
    assert came == injector.passed + done[FaultKind.LOST] + injector.held


def bits_apart(a, b):
    return (int.from_bytes(a, "big") ^ int.from_bytes(b, "big")).bit_count()


# ---- each kind alone ----------------------------------------------------------------


def flipped(before, after):
    return len(after.data) == 8 and 1 <= bits_apart(before.data, after.data) <= 3


def truncated(before, after):
    return len(after.data) < 8 and before.data.startswith(after.data)


def wrong_id(before, after):
    return (before.can_id ^ after.can_id).bit_count() == 1 and before.data == after.data


def garbage(before, after):
    return len(after.data) == 8 and before.data != after.data


@pytest.mark.parametrize(
    ("field", "what", "law"),
    [
        pytest.param("flip", FaultKind.FLIPPED, flipped, id="flip"),
        pytest.param("truncate", FaultKind.TRUNCATED, truncated, id="truncate"),
        pytest.param("wrong_dlc", FaultKind.WRONG_DLC, truncated, id="wrong-dlc-of-full-frames"),
        pytest.param("wrong_id", FaultKind.WRONG_ID, wrong_id, id="wrong-id"),
        pytest.param("garbage", FaultKind.GARBAGE, garbage, id="garbage"),
    ],
)
def test_damage_at_rate_1_hits_every_frame(field, what, law):
    """In its place, in its way, and counted."""
    injector = FaultInjector(Faults(**{field: 1.0}))
    frames = numbered(500)
    out = run(injector, frames)
    assert len(out) == 500
    assert all(law(*pair) for pair in zip(frames, out, strict=True))
    assert injector.counts == {what: 500}


def test_loss_at_rate_1_leaves_nothing():
    injector = FaultInjector(Faults(loss=1.0, duplicate=1.0, reorder=1.0))
    assert run(injector, numbered(100)) == []
    assert injector.counts == {FaultKind.LOST: 100}


def test_duplicates_at_rate_1():
    injector = FaultInjector(Faults(duplicate=1.0))
    frames = numbered(100)
    assert run(injector, frames) == [frame for frame in frames for _ in range(2)]
    assert injector.counts == {FaultKind.DUPLICATED: 100}


def test_reordering_at_rate_1():
    """All are held back by up to three frames: none is lost, and none further."""
    injector = FaultInjector(Faults(reorder=1.0, depth=3))
    out = [number_of(frame) for frame in run(injector, numbered(1000))]
    assert sorted(out) == list(range(1000))
    assert out != sorted(out)
    assert injector.counts == {FaultKind.REORDERED: 1000}


def test_nothing_happens_by_default():
    injector = FaultInjector(Faults())
    frames = numbered(1000)
    assert run(injector, frames) == frames
    assert injector.counts == {}


def test_a_length_of_can_fd_stays_one():
    """Whatever is cut or filled can be sent by an interface."""
    for field in ("truncate", "wrong_dlc"):
        frames = [Frame(0x348, bytes([255] * 32), True) for _ in range(500)]
        out = run(FaultInjector(Faults(**{field: 1.0})), frames)
        lengths = {len(frame.data) for frame in out}
        longest = 24 if field == "truncate" else 64
        assert lengths == {n for n in LENGTHS if n <= longest and n != 32}
        assert all(frame.data == (b"\xff" * 32)[:n].ljust(n, b"\0") for frame in out
                   for n in [len(frame.data)])  # fmt: skip


def test_what_cannot_be_damaged_is_not_counted():
    injector = FaultInjector(Faults(flip=0.4, truncate=0.3, garbage=0.3))
    frames = [Frame(1, b"")] * 50
    assert run(injector, frames) == frames
    assert injector.counts == {}


def test_29_bit_ids_stay_29_bit_ids():
    frames = [Frame(0x18FF3400, b"data", False, True)] * 300
    out = run(FaultInjector(Faults(wrong_id=1.0)), frames)
    assert all(frame.is_extended and frame.can_id <= 0x1FFFFFFF for frame in out)
    assert len({frame.can_id for frame in out}) == 29


# ---- rates, seeds, sums ---------------------------------------------------------------


def test_rates_are_kept():
    """Each within five standard deviations of the binomial law."""
    faults = Faults.parse(f"{MIX},garbage=0.03,late=0.2,delay=1")
    injector, n = FaultInjector(faults), 50_000
    run(injector, numbered(n))
    kept = n - injector.counts[FaultKind.LOST]
    copies = kept + injector.counts[FaultKind.DUPLICATED]
    on_time = copies - injector.counts[FaultKind.REORDERED]
    for what, rate, of in (
        (FaultKind.LOST, 0.1, n),
        (FaultKind.DUPLICATED, 0.05, kept),
        (FaultKind.REORDERED, 0.05, copies),
        (FaultKind.FLIPPED, 0.005, copies),
        (FaultKind.TRUNCATED, 0.005, copies),
        (FaultKind.WRONG_DLC, 0.005, copies),
        (FaultKind.WRONG_ID, 0.005, copies),
        (FaultKind.GARBAGE, 0.03, copies),
        (FaultKind.DELAYED, 0.2, on_time),
    ):
        sigma = math.sqrt(of * rate * (1 - rate))
        assert injector.counts[what] == pytest.approx(of * rate, abs=5 * sigma), what


def test_the_seed_decides():
    """The same again, another one for another seed, and for the other direction."""

    def outcome(seed, stream=""):
        return run(FaultInjector(Faults.parse(f"{MIX},seed={seed}"), stream=stream), numbered(500))

    assert outcome(1) == outcome(1)
    assert outcome(1) != outcome(2)
    assert outcome(1, "send") != outcome(1, "receive")


@given(st.integers(1, 9), st.integers(0, 2**32))
def test_no_frame_is_held_back_too_far(depth, seed):
    """None comes after one that was sent more than ``depth`` later."""
    injector = FaultInjector(Faults(reorder=0.4, depth=depth, seed=seed))
    newest = 0
    for frame in run(injector, numbered(60)):
        assert newest - number_of(frame) <= depth
        newest = max(newest, number_of(frame))


RATES = st.sampled_from([0.0, 0.01, 0.1, 0.5])
FAULTS = st.builds(
    Faults,
    loss=RATES, duplicate=RATES, reorder=RATES, depth=st.integers(1, 12),
    late=RATES, delay=st.sampled_from([0.0, 0.001]), jitter=st.sampled_from([0.0, 0.005]),
    flip=st.sampled_from([0, 0.1]), truncate=st.sampled_from([0, 0.1]),
    wrong_dlc=st.sampled_from([0, 0.1]), wrong_id=st.sampled_from([0, 0.1]),
    garbage=st.sampled_from([0, 0.1]), flood=st.sampled_from([0.0, 500.0]),
    flood_ids=st.sampled_from([(0,), tuple(range(0x33F, 0x351))]), seed=st.integers(0, 2**32),
)  # fmt: skip


@given(FAULTS)
def test_every_frame_is_accounted_for(faults):
    """Given, doubled and flooded ones are lost, held back or handed out, at any time."""
    injector = FaultInjector(faults)
    handed_out = 0
    for i, frame in enumerate(numbered(100)):
        handed_out += len(injector.apply(frame, i * 1e-3))
        handed_out += len(injector.due(i * 1e-3 + 5e-4))
        check_sums(injector)
    handed_out += len(injector.flush())
    check_sums(injector)
    assert injector.held == 0
    assert handed_out == injector.passed
    assert injector.as_dict()["passed"] == injector.passed


# ---- time -----------------------------------------------------------------------------


def test_a_delayed_frame_comes_when_its_time_has_come():
    """Time is an argument: nobody sleeps."""
    injector = FaultInjector(Faults(delay=0.02))
    (a, b) = numbered(2)
    assert injector.apply(a, 1.0) == []
    assert injector.next_due == pytest.approx(1.02)
    assert injector.due(1.019) == []
    assert injector.apply(b, 1.021) == [a]
    assert injector.due(2.0) == [b]
    assert injector.next_due == math.inf


def test_jitter_lets_frames_overtake_each_other():
    injector = FaultInjector(Faults(delay=0.1, jitter=0.05, seed=3))
    out = run(injector, numbered(200), step=0.001)
    late = [number_of(frame) for frame in out]
    assert sorted(late) == list(range(200))
    assert late != sorted(late)


def test_a_flood_has_its_rate_and_its_ids():
    """250 frames a second for two seconds, from the first moment on."""
    injector = FaultInjector(Faults(flood=250.0, flood_ids=(0, 0x340, 0x18FF0000)))
    injector.due(10.0)
    out = [frame for i in range(1, 201) for frame in injector.due(10.0 + i / 100)]
    assert len(out) == pytest.approx(500, abs=1)
    assert {(f.can_id, f.is_extended) for f in out} == {
        (0, False),
        (0x340, False),
        (0x18FF0000, True),
    }
    assert injector.counts == {FaultKind.FLOODED: len(out)}


def test_a_flood_of_an_hour_does_not_come_at_once():
    injector = FaultInjector(Faults(flood=1000.0))
    injector.due(0.0)
    (*batches, last) = iter(lambda: injector.due(3600.0), [])
    assert {len(batch) for batch in batches} == {32}
    assert 32 * len(batches) + len(last) == pytest.approx(1000, abs=1)
    assert injector.left_out == pytest.approx(3599 * 1000, abs=1)
    assert injector.next_due > 3600.0


def test_a_flood_of_next_to_nothing_never_comes():
    injector = FaultInjector(Faults(flood=5e-324))
    assert injector.due(0.0) == injector.due(3600.0) == []


def test_a_flood_is_drawn_from_ranges_as_from_their_ids():
    """Of any length: no list of them is made."""

    def ids(flood_ids):
        injector = FaultInjector(Faults(flood=1000.0, flood_ids=flood_ids))
        injector.due(0.0)
        return [f.can_id for i in range(1, 501) for f in injector.due(i / 100)]

    some = ids((7, *range(0x340, 0x348), 9))
    assert some == ids((7, range(0x340, 0x348), 9))
    assert set(some) == {7, *range(0x340, 0x348), 9}
    assert set(ids(range(5))) == set(range(5))
    assert max(ids((0, range(0x20000000)))) > 0x10000000
    assert Faults.parse("flood=1,flood_ids=0-0x1fffffff").flood_ids == (range(0x20000000),)


# ---- scripts --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("script", "numbers"),
    [
        pytest.param("loss 3", [1, 2, 4, 5, 6], id="loss"),
        pytest.param("loss 2-4", [1, 5, 6], id="range"),
        pytest.param("dup 2", [1, 2, 2, 3, 4, 5, 6], id="duplicate"),
        pytest.param("reorder 2 2", [1, 3, 4, 2, 5, 6], id="reorder"),
        pytest.param("reorder 6 2", [1, 2, 3, 4, 5, 6], id="reorder-the-last"),
        pytest.param("dup 2\nreorder 2 3", [1, 2, 3, 4, 5, 2, 6], id="late-duplicate"),
        pytest.param("delay 2 0.02", [1, 3, 2, 4, 5, 6], id="delay"),
        pytest.param("loss 1\nloss 6\ndup 4", [2, 3, 4, 4, 5], id="several"),
        pytest.param("loss 9", [1, 2, 3, 4, 5, 6], id="never"),
    ],
)
def test_a_script_says_what_happens_to_which_frame(script, numbers):
    """Frames are counted from 1; 10 ms lie between two."""
    faults = Faults(script=[Action.parse(line) for line in script.splitlines()])
    out = run(FaultInjector(faults), numbered(7)[1:], step=0.01)
    assert [number_of(frame) for frame in out] == numbers


@pytest.mark.parametrize(
    ("line", "law"),
    [
        pytest.param("flip 1 12", lambda f: bits_apart(f.data, bytes(8)) == 12, id="flip"),
        pytest.param("flip 1", lambda f: 1 <= bits_apart(f.data, bytes(8)) <= 3, id="flip-some"),
        pytest.param("flip 1 512", lambda f: f.data == b"\xff" * 8, id="flip-all"),
        pytest.param("truncate 1 4", lambda f: f.data == bytes(4), id="truncate"),
        pytest.param("wrong_dlc 1 5", lambda f: f.data == bytes(5), id="wrong-dlc"),
        pytest.param("wrong_id 1 0x123", lambda f: f.can_id == 0x123, id="wrong-id"),
        pytest.param("wrong_id 1 0x800", lambda f: f.is_extended, id="extended-id"),
        pytest.param("garbage 1", lambda f: f.data != bytes(8), id="garbage"),
    ],
)
def test_a_script_damages_as_it_says(line, law):
    (frame,) = run(FaultInjector(Faults(script=[Action.parse(line)])), [Frame(0x340, bytes(8))])
    assert law(frame)


def test_rates_are_for_the_frames_that_the_script_does_not_name():
    faults = Faults(loss=1.0, script=[Action.parse("dup 2")])
    assert [number_of(f) for f in run(FaultInjector(faults), numbered(9))] == [1, 1]


def test_a_script_from_a_file(tmp_path):
    """Comments and empty lines are left out; the rest is as of ``Action.parse``."""
    path = tmp_path / "faults.txt"
    path.write_text("# what frame value\n\nloss 3  # gone\nflip 20-29 3\n")
    assert Faults.parse(f"script={path},seed=3").script == (
        Action(FaultKind.LOST, 3, 3),
        Action(FaultKind.FLIPPED, 20, 29, 3),
    )


# ---- text -----------------------------------------------------------------------------


def test_a_spec_is_the_fields():
    faults = Faults.parse(
        "loss=0.1, dup=0.2, flip=0.3, flip_bits=2, depth=5, flood=10, flood_ids=0x340-0x342+7,"
        "direction=send, seed=0x10"
    )
    assert faults == Faults(
        loss=0.1, duplicate=0.2, flip=0.3, flip_bits=2, depth=5, flood=10,
        flood_ids=(range(0x340, 0x343), 7), direction="send", seed=16,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("text", "words"),
    [
        pytest.param("", "must be KEY=VALUE,KEY=VALUE, got ''", id="empty"),
        pytest.param("loss", "must be KEY=VALUE", id="no-value"),
        pytest.param("lost=0.1", "'lost' is unknown; use loss, duplicate (dup)", id="key"),
        pytest.param("loss=much", "loss must be a number, got 'much'", id="no-number"),
        pytest.param("loss=1.5", "loss must be in [0, 1], got 1.5", id="above"),
        pytest.param("loss=-0.1", "loss must be in [0, 1], got -0.1", id="below"),
        pytest.param("loss=nan", "loss must be in [0, 1], got nan", id="nan"),
        pytest.param("loss=0.1,loss=0.2", "loss is given twice", id="twice"),
        pytest.param("dup=0.1,duplicate=0.2", "duplicate is given twice", id="twice-by-alias"),
        pytest.param("corrupt=0.1,flip=0.1", "corrupt stands for flip too", id="corrupt-and-one"),
        pytest.param("corrupt=2", "corrupt must be in [0, 1], got 2", id="corrupt"),
        pytest.param("flip=0.6,garbage=0.6", "must be 1 together at most, got 1.2", id="sum"),
        pytest.param("depth=0", "depth must be a whole number in [1, 10000] frames", id="depth"),
        pytest.param("depth=1.5", "depth must be a whole number", id="half-a-frame"),
        pytest.param("delay=-1", "delay must be in [0, 3600] s, got -1", id="delay"),
        pytest.param("flood=1,flood_ids=x", "flood_ids must be such as 0x340-0x347+0", id="ids"),
        pytest.param("flood_ids=0x20000000", "CAN IDs in [0, 0x1fffffff]", id="id-range"),
        pytest.param("flood_ids=5-3", "CAN IDs in", id="ids-backwards"),
        pytest.param("direction=up", "direction must be both, send, receive, got 'up'", id="way"),
        pytest.param("seed=-1", "seed must be a whole number in [0, 1.84467e+19]", id="seed"),
        pytest.param(f"seed=0x{'f' * 400}", "19], got more than 1e308", id="seed-of-400-digits"),
        pytest.param(f"loss=0x{'f' * 400}", "1], got more than 1e308", id="loss-of-400-digits"),
        pytest.param(f"corrupt=0x{'f' * 400}", "1], got more than 1e308", id="corrupt-of-400"),
        pytest.param(
            "script=/dev/zero", "/dev/zero must have 1,000,000 bytes at most", id="endless"
        ),
        pytest.param("script=/nowhere", "script /nowhere cannot be read: No such", id="script"),
    ],
)
def test_a_wrong_spec_is_told(text, words):
    """What is wrong, and what would be right, in one line."""
    with pytest.raises(ValueError, match="faults: ") as caught:
        Faults.parse(text)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("loss", "must be WORD FRAME [VALUE]"),
        ("loss 1 2 3", "must be WORD FRAME [VALUE]"),
        ("burn 1", "'burn' is unknown; use loss, duplicate, reorder"),
        ("flood 1", "'flood' is unknown"),
        ("loss 0", "frames must be N or N-M from 1 on, got 0-0"),
        ("loss 5-3", "frames must be N or N-M from 1 on, got 5-3"),
        ("loss 1-", "frames must be N or N-M from 1 on, got '1-'"),
        (f"loss {'9' * 5000}", "frames must be N or N-M from 1 on, got '999"),
        (f"loss 1 0x{'f' * 400}", "'loss' takes no value, got more than 1e308"),
        (f"wrong_id 1 0x{'f' * 400}", "must be in [0, 5.36871e+08], got more than 1e308"),
        ("loss x", "frames must be N or N-M from 1 on, got 'x'"),
        ("loss 1 2", "'loss' takes no value, got 2"),
        ("reorder 1 0", "must be in [1, 10000] frames, got 0"),
        ("reorder 1 1.5", "must be a whole number, got 1.5"),
        ("flip 1 many", "must be a number, got 'many'"),
        ("truncate 1 9", "a length of CAN: 0, 1, 2"),
        ("delay 1 -1", "must be in [0, 3600] s, got -1"),
    ],
)
def test_a_wrong_line_of_a_script_is_told(tmp_path, line, words):
    path = tmp_path / "faults.txt"
    path.write_text(f"dup 1\n{line}\n")
    with pytest.raises(ValueError, match=r"faults: .*faults.txt, line 2: ") as caught:
        Faults.parse(f"script={path}")
    assert words in str(caught.value)


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("loss", None, "loss must be in [0, 1], got None"),
        ("seed", "1", "seed must be a whole number in [0, 1.84467e+19], got '1'"),
        ("flood_ids", None, "flood_ids must be a tuple, got None"),
        ("flood_ids", ("a",), "flood_ids must be CAN IDs in [0, 0x1fffffff] or ranges"),
        ("flood_ids", (0.5,), "or ranges of them, got 0.5"),
        ("script", 3, "script must be a tuple, got 3"),
        ("script", ["loss 3"], "script must be of Action.parse, got 'loss 3'"),
    ],
)
def test_a_value_of_another_kind_is_told(field, value, words):
    with pytest.raises(TypeError, match="faults: ") as caught:
        Faults(**{field: value})
    assert words in str(caught.value)


@pytest.mark.parametrize("ids", [range(0), range(-1, 3), range(3, 0x20000001), 0x20000000, -1])
def test_ids_that_no_bus_has_are_refused(ids):
    with pytest.raises(ValueError, match=r"flood_ids must be CAN IDs in \[0, 0x1fffffff\], got"):
        Faults(flood_ids=(0, ids))


def test_a_script_may_be_a_pipe(tmp_path):
    """As a shell makes it of <(command)."""
    path = tmp_path / "pipe"
    os.mkfifo(path)
    threading.Thread(target=path.write_text, args=("loss 3\n",), daemon=True).start()
    assert Faults.parse(f"script={path}").script == (Action(FaultKind.LOST, 3, 3),)


# ---- a bus ----------------------------------------------------------------------------


@pytest.fixture
def channel(request):
    return f"faulty-{request.node.name}"


@pytest.fixture
def other(channel):
    with can.Bus(interface="virtual", channel=channel) as bus:
        yield bus


class Clock:
    now = 100.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def faulty(channel, faults, **rest):
    return FaultyBus(can.Bus(interface="virtual", channel=channel), faults, **rest)


def message(number=1, can_id=0x340, **rest):
    rest = {"data": bytes([number]), "is_extended_id": False, **rest}
    return can.Message(arbitration_id=can_id, **rest)


def all_of(bus):
    return list(iter(lambda: bus.recv(0), None))


def numbers(bus):
    return [m.data[0] for m in all_of(bus)]


@pytest.mark.parametrize("direction", ["send", "receive", "both"])
def test_a_bus_in_one_direction_or_both(channel, other, direction):
    """Half of the frames are lost where it says, and none elsewhere."""
    with faulty(channel, f"loss=0.5,direction={direction}") as bus:
        for number in range(100):
            bus.send(message(number))
            other.send(message(number))
        received, sent = len(all_of(bus)), len(all_of(other))
        assert (received < 80) == (direction != "send")
        assert (sent < 80) == (direction != "receive")
        assert bus.counts[FaultKind.LOST] == 200 - received - sent
        assert bus.as_dict()["passed"] + bus.as_dict()["lost"] == bus.as_dict()["frames"]


def test_time_stamps_of_what_is_delayed(channel, other, clock):
    """It has the time at which it comes."""
    with faulty(channel, "delay=0.5", clock=clock) as bus:
        other.send(message(7))
        assert bus.recv(0) is None
        before = bus.bus.recv(0)
        assert before is None  # it is held by the faults
        clock.now += 0.5
        late = bus.recv(0)
        assert late.data[0] == 7
        stamp = late.timestamp
        other.send(message(8))
        assert bus.recv(0) is None
        clock.now += 2.0
        assert bus.recv(0).timestamp - stamp > 1.5


def test_what_is_sent_late_goes_out_when_pumped(channel, other, clock):
    """With a clock of one's own there is no thread."""
    threads = threading.active_count()
    with faulty(channel, "delay=0.5,direction=send", clock=clock) as bus:
        bus.send(message(1))
        bus.pump()
        assert numbers(other) == []
        clock.now += 0.5
        bus.pump()
        assert numbers(other) == [1]
        assert threading.active_count() == threads


def test_what_is_sent_late_goes_out_by_itself(channel, other):
    """Without one, by a thread, which ends with the bus."""
    with faulty(channel, "delay=0.02,direction=send") as bus:
        bus.send(message(1))
        assert other.recv(LONG).data[0] == 1
        assert bus.sending.held == 0
        thread = bus._thread
    assert not thread.is_alive()


@pytest.mark.parametrize("direction", ["send", "receive"])
def test_a_flood_needs_no_frame(channel, other, direction):
    """It is there on a silent bus, in both directions."""
    with faulty(channel, f"flood=1000,flood_ids=5,direction={direction}") as bus:
        for _ in range(3):
            assert (other if direction == "send" else bus).recv(LONG).arbitration_id == 5


@pytest.mark.parametrize("direction", ["send", "receive", "both"])
def test_a_flood_that_is_too_fast_lets_others_in(direction):
    """Sending, receiving and the end have their turn; what is left out is counted."""
    inner = Slow()
    bus = FaultyBus(inner, f"flood=1e6,flood_ids=5,direction={direction}")
    done = threading.Event()

    def use():
        start = time.monotonic()
        while time.monotonic() < start + 1.5:  # a second is made up for
            bus.send(message(1))
            bus.recv(0.001)
        bus.shutdown()
        done.set()

    threading.Thread(target=use, daemon=True).start()
    assert done.wait(LONG)
    told = bus.as_dict()
    assert told["flooded"] > 0
    assert told["left_out"] > 0
    assert len(bus._incoming) <= 32
    if direction == "send":
        assert bus.sending.frames == inner.sent - told["flooded"] > 0


def test_a_pump_that_is_too_slow_stops(clock):
    """After a tenth of a second of its clock; what is still due is sent by the next."""
    inner = Slow()

    def goes_on():
        clock.now += 1e-3
        return clock.now

    with FaultyBus(inner, "flood=1e5,direction=send", clock=goes_on) as bus:
        clock.now += 1.0
        start = clock.now
        bus.pump()
        assert 0.1 < clock.now - start < 0.2
        assert 0 < inner.sent < 10_000


def test_what_is_held_back_is_sent_at_the_end(channel, other):
    bus = faulty(channel, "reorder=1,depth=1000,direction=send")
    for number in range(5):
        bus.send(message(number))
    bus.shutdown()
    bus.shutdown()
    assert sorted(numbers(other)) == [0, 1, 2, 3, 4]
    assert bus.as_dict()["held"] == bus.unsent == 0


def test_error_and_remote_frames_pass(channel, other):
    with faulty(channel, "loss=1") as bus:
        for way_out, way_in in ((bus, other), (other, bus)):
            way_out.send(message(is_error_frame=True))
            way_out.send(message(is_remote_frame=True, data=None))
            assert len(all_of(way_in)) == 2
        assert bus.as_dict()["frames"] == 0


def test_filters_hold_before_and_after(channel, other):
    """Neither a foreign frame nor one whose ID has become foreign is received."""
    with faulty(channel, "wrong_id=1,direction=receive") as bus:
        bus.set_filters([{"can_id": 0x340, "can_mask": 0x7FE}])
        assert bus.bus.filters == bus.filters
        for number in range(200):
            other.send(message(number, can_id=0x340 + number % 4))
        other.send(message(is_remote_frame=True, data=None))  # the last
        received = list(itertools.takewhile(lambda m: m.data, iter(lambda: bus.recv(LONG), None)))
        assert {m.arbitration_id for m in received} == {0x340, 0x341}
        assert bus.as_dict()["frames"] == 100
        assert 0 < len(received) < 50


def test_filters_that_were_set_before_stay(channel):
    inner = can.Bus(interface="virtual", channel=channel)
    inner.set_filters([{"can_id": 1, "can_mask": 0x7FF}])
    with FaultyBus(inner, Faults()) as bus:
        assert bus.filters == inner.filters == [{"can_id": 1, "can_mask": 0x7FF}]


class Stubborn(can.BusABC):
    """A bus whose queue is full when it likes."""

    def __init__(self, *full):
        super().__init__(channel="stubborn")
        self.full, self.sent = list(full), queue.SimpleQueue()
        self.gone, self._state = False, can.BusState.PASSIVE
        self.received = []
        self.channel_info = "stubborn"

    def send(self, msg, timeout=None):  # noqa: ARG002
        if self.full and self.full.pop(0):
            raise can.CanOperationError("full")
        if self.gone:
            raise OSError(errno.ENODEV, "No such device")
        self.sent.put(msg.data[0])

    def _recv_internal(self, timeout):
        if not self.received:
            time.sleep(min(timeout, 0.01))
        return (self.received.pop(0) if self.received else None), True

    def fileno(self):
        return 7

    def flush_tx_buffer(self):
        self.full = [True]

    @property
    def state(self):
        return self._state

    @state.setter
    def state(self, new_state):
        self._state = new_state


class Slow(can.BusABC):
    """A bus that always has a frame, and takes its time to send one."""

    def __init__(self):
        super().__init__(channel="slow")
        self.channel_info, self.sent = "slow", 0

    def send(self, msg, timeout=None):  # noqa: ARG002
        time.sleep(1e-5)
        self.sent += 1

    def _recv_internal(self, timeout):  # noqa: ARG002
        time.sleep(1e-5)
        return message(1, timestamp=time.time()), False


@pytest.mark.parametrize("faults", ["loss=1", "delay=60", "wrong_id=1"])
@pytest.mark.parametrize("timeout", [0, 0.1])
def test_recv_keeps_its_time_on_a_busy_bus(faults, timeout):
    """Though frames keep coming, of which none is left."""
    done = threading.Event()
    with FaultyBus(Slow(), f"{faults},direction=receive") as bus:
        bus.set_filters([{"can_id": 0x340, "can_mask": 0x7FF}])

        def use():
            assert bus.recv(timeout) is None
            done.set()

        threading.Thread(target=use, daemon=True).start()
        assert done.wait(LONG)


def test_a_receiver_on_a_busy_bus_that_loses_all_can_be_stopped():
    with Link(Slow, faults=Faults(loss=1.0)) as link:
        with Receiver(link, default_codec().decoder()) as receiver:
            pass
        assert receiver.stats().frames == 0


@pytest.mark.parametrize(
    ("age", "left"),
    [
        pytest.param(6.0, 0.0, id="over"),
        pytest.param(3.0, 2.0, id="waited"),
        pytest.param(0.0, 5.0, id="new"),
        pytest.param(3600.0, 5.0, id="another-clock"),
        pytest.param(-3.0, 5.0, id="of-the-future"),
    ],
)
def test_a_delay_counts_from_the_time_stamp(age, left):
    """Of a frame that waited for `recv`, if the stamp can be one of this clock."""
    inner = Stubborn()
    with FaultyBus(inner, "delay=5,direction=receive") as bus:
        inner.received = [message(7, timestamp=time.time() - age)]
        late = bus.recv(0)
        if left:
            assert late is None
            assert bus.receiving.next_due - time.monotonic() == pytest.approx(left, abs=1)
        else:
            assert late.timestamp == pytest.approx(time.time(), abs=1)


@pytest.mark.parametrize(
    ("bus", "faults", "words"),
    [
        (None, "loss=0.1", "bus must be a python-can bus, got None"),
        (lambda: "vcan0", "loss=0.1", "bus must be a python-can bus, got 'vcan0'"),
        (Slow, None, "faults must be Faults or a text such as 'loss=0.1', got None"),
    ],
)
def test_a_bus_of_nothing_is_told(bus, faults, words):
    with pytest.raises(TypeError) as caught:
        FaultyBus(bus and bus(), faults)
    assert str(caught.value) == words


def test_a_frame_that_is_tried_again_suffers_once():
    """After a full queue the same message goes on where it stopped; its fate is decided."""
    inner = Stubborn(False, True, True)
    with FaultyBus(inner, "dup=1") as bus:
        tried = message(1)
        for _ in range(2):
            with pytest.raises(can.CanOperationError):
                bus.send(tried)
        bus.send(tried)
        assert [inner.sent.get(timeout=0) for _ in range(inner.sent.qsize())] == [1, 1]
        assert bus.counts == {FaultKind.DUPLICATED: 1}
        bus.send(tried)  # the same object once more is another frame
        assert inner.sent.qsize() == 2
        assert bus.as_dict()["frames"] == 2


def test_a_frame_that_is_given_up_is_counted():
    with FaultyBus(Stubborn(True), "dup=1") as bus:
        with pytest.raises(can.CanOperationError):
            bus.send(message(1))
        bus.send(message(2))
        assert bus.unsent == 2


def test_a_faulty_bus_is_what_it_wraps():
    with FaultyBus(Stubborn(), "loss=1,direction=send") as bus:
        assert str(bus) == "stubborn with faults"
        assert bus.protocol is can.CanProtocol.CAN_20
        assert bus.fileno() == 7
        assert bus.state is can.BusState.PASSIVE
        bus.state = can.BusState.ACTIVE
        assert bus.bus.state is can.BusState.ACTIVE
        bus.flush_tx_buffer()
        assert bus.bus.full == [True]
    with FaultyBus(Stubborn(), "loss=1") as bus, pytest.raises(NotImplementedError):
        bus.fileno()


def test_a_link_that_comes_back_goes_on(clock):
    """Its random numbers and counts are those of one stream, whatever was lost in between."""
    opened = []

    def opener():
        opened.append(Stubborn())
        return opened[-1]

    faults = Faults(loss=0.5, seed=4)
    faulty_opener = FaultyOpener(faults, opener)
    with Link(faulty_opener, clock=clock) as link:
        for number in range(20):
            link.send(message(number))
        opened[0].gone = True
        while link.send(message(99)) is Sent.OK:
            pass
        clock.now += 10.0
        for number in range(20, 40):
            link.send(message(number))
        assert link.outages == 1
        assert len(opened) == 2
        total = faulty_opener.as_dict()
    straight = FaultInjector(faults, stream="send")
    for frame in numbered(total["frames"]):
        straight.apply(frame)
    assert total["lost"] == straight.counts[FaultKind.LOST]


# ---- lines through it -------------------------------------------------------------------


@cache
def sent_lines(n=120, fd=False):
    """Frames of n lines of three slots in turn, and what must be read of each."""
    codec = default_codec()
    means, covs = road(n, seed=3)
    slots = np.arange(n) % 3
    payloads = codec.encode_batch(means, covs, slot=slots, counter=np.arange(n) // 3)
    frames = [codec.frames(p, Slot(s), fd=fd) for p, s in zip(payloads, slots, strict=True)]
    known = {
        key_of(codec.decode_one(p.tobytes(), Slot(s))): i
        for i, (p, s) in enumerate(zip(payloads, slots, strict=True))
    }
    assert len(known) == n
    return frames, known


def key_of(line):
    return line.slot, line.gaussian.mean.tobytes(), line.gaussian.cov.tobytes()


@settings(max_examples=150, deadline=None)
@given(FAULTS, st.booleans())
def test_whatever_the_mischief_lines_are_sent_ones_and_come_once(faults, fd):
    """Bit for bit; and every frame is accounted for, by the faults and by the decoder."""
    frames, known = sent_lines(fd=fd)
    codec = default_codec()
    injector, decoder, delivered = FaultInjector(faults), codec.decoder(), []

    def receive(out, now):
        for frame in out:
            answer = decoder.feed(
                frame.can_id, frame.data, round(now * 1e9), is_extended=frame.is_extended
            )
            if isinstance(answer, MapLine):
                delivered.append(key_of(answer))

    now = 0.0
    for transfer in frames:
        for frame in transfer:
            now += 0.5e-3
            receive(injector.apply(frame, now), now)
    receive(injector.flush(), now)
    assert set(delivered) <= set(known)
    assert len(delivered) == len(set(delivered)) == decoder.lines
    assert decoder.frames == injector.passed
    assert decoder.frames == decoder.line_frames + sum(decoder.counts.values()) + decoder.pending


@pytest.mark.parametrize("fd", [False, True])
def test_sums_over_a_virtual_bus(channel, fd):
    """Transmitter, faults, Receiver: sent and doubled frames are lost or received, each once."""
    codec = default_codec()
    means, covs = road(8, seed=5)
    payloads = codec.encode_batch(means, covs, slot=np.arange(8))
    lines = [codec.decode_one(p.tobytes(), Slot(i)) for i, p in enumerate(payloads)]
    reference = codec.from_dbc().encode_lines(lines, fd=fd)
    expected = {
        key_of(codec.decode_one(b"".join(f.data for f in frames)[:32], line.slot))
        for line, frames in zip(lines, reference, strict=True)
    }
    received = []
    with Link(interface="virtual", channel=channel) as back:
        spec = Faults.parse(f"{MIX},direction=send,seed=2")
        out = Link(interface="virtual", channel=channel, faults=spec)
        with Receiver(back, codec.decoder(), on_line=received.append) as receiver:
            with Transmitter(out, codec, period=0.02, fd=fd, count=30) as transmitter:
                transmitter.publish(lines)
                assert transmitter.wait(LONG)
            out.close()  # which sends what is held back
            done, stats = out.faults, transmitter.stats()
            arrived = stats.frames + done["duplicated"] - done["lost"]
            while receiver.stats().frames < arrived:
                time.sleep(0.001)
    assert done["frames"] == stats.frames
    assert done["held"] == done["unsent"] == 0
    assert receiver.stats().frames == arrived == done["passed"]
    assert {key_of(line) for line in received} <= expected
    assert 0 < len(received) < stats.lines


# ---- the command ------------------------------------------------------------------------


def test_the_demo_tells_what_was_done(capsys):
    """In words and for machines; the sums are right."""
    command = ["demo", "--seconds", "0.5", "--rate", "50", "--faults", f"{MIX},seed=3"]
    assert main([*command, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    done = result["faults"]
    assert done["frames"] == result["sent"]["frames"]
    assert (
        result["received"]["frames"]
        == done["frames"] + done["duplicated"] - done["lost"] - (done["held"])
    )
    assert result["frames_lost"] == done["lost"] + done["held"] > 0
    assert result["lines_lost"] > 0
    assert main(command) == 0
    told = capsys.readouterr().out
    (sent,) = re.findall(r"^sent .* (\d+) frames$", told, re.MULTILINE)
    (lost,) = re.findall(r"^lost .* (\d+) frames$", told, re.MULTILINE)
    (line,) = re.findall(r"^faults    .*", told, re.MULTILINE)
    done = {name: int(n) for n, name in re.findall(r"(\d+) (\w+)", line)}
    assert done["frames"] == int(sent)
    assert done["lost"] + done["held"] == int(lost)
    assert done["frames"] + done["duplicated"] == done["passed"] + done["lost"] + done["held"]


def test_send_and_receive_tell_what_was_done(capsys, channel):
    bus = ["--interface", "virtual", "--channel", channel]
    send = ["send", *bus, "--rate", "200", "--count", "5", "--faults", "dup=1"]
    assert main([*send, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["faults"]["duplicated"] == result["frames"]
    assert main(send) == 0
    assert "duplicated" in capsys.readouterr().out
    flood = ["--faults", "flood=1000,flood_ids=0x340"]
    assert main(["receive", *bus, *flood, "--count", "1", "--timeout", "0.05"]) == 1
    assert "flooded" in capsys.readouterr().err


def test_a_wrong_spec_is_wrong_usage(capsys):
    with pytest.raises(SystemExit) as end:
        main(["demo", "--faults", "lost=0.1"])
    assert end.value.code == 2
    assert "'lost' is unknown; use loss, duplicate (dup)" in capsys.readouterr().err


def test_the_soak_runs():
    """A short one keeps its promises and says so."""
    command = [sys.executable, ROOT / "tools" / "soak.py", "--lines", "2000", "--json"]
    command += ["--only", "classic", "fd", "bus", "checksum"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr
    result = json.loads(done.stdout)
    for part in ("classic", "fd"):
        assert result[part]["lines sent"] == 2000
        assert 0 < result[part]["delivered"] < 2000
        assert result[part]["lines delivered twice"] == 0
