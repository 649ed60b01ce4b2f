"""The bus: what is sent, what is received, and what happens when the interface goes away."""

import contextlib
import errno
import gzip
import itertools
import logging
import queue
import random
import re
import struct
import subprocess
import threading
import time
import zlib
from pathlib import Path

import can
import numpy as np
import pytest
from fake_codec import PAGES, FakeCodec, Frame, Reason
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.bus import (
    Link,
    Receiver,
    Sent,
    Transmitter,
    bus_load,
    frame_bits,
    frame_time,
    read_log,
)
from maplines_can.bus.driver_errors import Fault, classify_error, error_text
from maplines_can.bus.schedule import LatenessHistogram, Schedule
from maplines_can.bus.stamp_clock import StampClock
from maplines_can.bus.tx_queue import AHEAD, TxQueue
from maplines_can.errors import BusError, LogError, MissingExtraError
from maplines_can.line import MapLine, Slot
from maplines_can.wire import Codec

LONG = 120.0  # seconds that a test waits for something that must happen
CHANNELS = (f"test-{number}" for number in itertools.count())


def line(slot=Slot.EGO_LEFT, y=1.75, **rest):
    return MapLine.with_sigma(slot, [y, 0, 0, 0], [0.1, 0.01, 0.001, 0.0001], **rest)


@pytest.fixture
def channel():
    return next(CHANNELS)


@pytest.fixture
def link(channel):
    with Link(interface="virtual", channel=channel) as link:
        yield link


@pytest.fixture
def other(channel):
    with Link(interface="virtual", channel=channel) as link:
        yield link


class FakeBus(can.BusABC):
    """A bus that does what the script says, then works."""

    def __init__(self, script=(), sent=None):
        super().__init__(channel="fake")
        self.channel_info = "fake"
        self.script = script if isinstance(script, list) else list(script)
        self.sent = queue.SimpleQueue() if sent is None else sent
        self.open = True

    def send(self, msg, timeout=None):  # noqa: ARG002
        if self.script and (error := self.script.pop(0)):
            raise error
        self.sent.put(msg)

    def _recv_internal(self, timeout):  # noqa: ARG002
        if self.script and (error := self.script.pop(0)):
            raise error
        return None, True

    def shutdown(self):
        super().shutdown()
        self.open = False


class FakePort:
    """Opens fake buses; the script of errors runs through all of them."""

    def __init__(self, *script):
        self.script, self.sent = list(script), queue.SimpleQueue()
        self.cannot_open = False
        self.opened = []

    def __call__(self):
        if self.cannot_open:
            raise OSError(errno.ENODEV, "No such device")
        self.opened.append(FakeBus(self.script, self.sent))
        return self.opened[-1]


class Clock:
    def __init__(self):
        self.now = 1000.0

    def __call__(self):
        return self.now


GONE = OSError(errno.ENODEV, "No such device")
FULL = can.CanOperationError("No buffer space available", errno.ENOBUFS)
NO_NUMBER = can.CanOperationError("something went wrong")
FRAME = can.Message(arbitration_id=0x100, data=b"\x01", is_extended_id=False)


def caused_by(error, cause):
    error.__cause__ = cause
    return error


# ---- faults -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("error", "fault"),
    [
        pytest.param(FULL, Fault.FULL, id="queue-full"),
        pytest.param(can.CanTimeoutError("late"), Fault.FULL, id="timeout"),
        pytest.param(caused_by(can.CanOperationError("x"), TimeoutError()), Fault.FULL, id="usb"),
        pytest.param(BlockingIOError(errno.EAGAIN, ""), Fault.FULL, id="would-block"),
        pytest.param(GONE, Fault.LOST, id="no-device"),
        pytest.param(can.CanOperationError("x", errno.ENETDOWN), Fault.LOST, id="down"),
        pytest.param(can.CanOperationError("x", errno.ENXIO), Fault.LOST, id="deleted"),
        pytest.param(caused_by(can.CanOperationError("x"), GONE), Fault.LOST, id="caused-by-gone"),
        pytest.param(OSError("device disconnected"), Fault.LOST, id="serial-pulled-out"),
        pytest.param(can.CanOperationError("x", errno.EINVAL), Fault.REFUSED, id="fd-frame"),
        pytest.param(NO_NUMBER, Fault.UNCLEAR, id="no-number"),
        pytest.param(can.CanOperationError("x", -13), Fault.UNCLEAR, id="number-of-a-driver"),
    ],
)
def test_fault_of_an_error(error, fault):
    """The system's number decides, wherever in the chain of causes it is."""
    assert fault is classify_error(error)


def test_text_of_an_error_is_the_system_s():
    assert error_text(caused_by(can.CanOperationError("Failed [19]"), GONE)) == "No such device"
    assert error_text(can.CanOperationError("two\nlines")) == "two lines"
    assert error_text(can.CanTimeoutError()) == "CanTimeoutError"


# ---- schedule -----------------------------------------------------------------------


@given(
    st.floats(0.001, 10), st.floats(0, 1e6), st.lists(st.floats(0, 30), min_size=1, max_size=100)
)
def test_deadlines_do_not_drift(period, t0, steps):
    """Whenever one comes, deadlines stay on one grid, each is served or skipped, none twice."""
    schedule = Schedule(period)
    now = t0
    schedule.add("key", 0.25, now)
    served = skipped = 0
    for step in steps:
        now += step * period
        while due := schedule.take(now):
            skipped += due.skipped
            assert due.deadline == pytest.approx(t0 + (served + skipped) * period, abs=1e-8)
            assert -1e-6 <= now - due.deadline < period * (1 + 1e-6) + 1e-6
            served += 1
        assert schedule.wait(now) <= period * (1 + 1e-6) + 1e-6


def test_keys_keep_their_places_and_their_count():
    """Each key has its own phase, and ``count`` deadlines of its own."""
    schedule = Schedule(1.0, count=2)
    schedule.add("b", 0.5, now=10.0)  # begins the clock
    schedule.add("a", 0.0, now=10.0)
    seen = []
    while not schedule.over:
        now = 10.0 if not seen else seen[-1][1]
        now += schedule.wait(now)
        due = schedule.take(now)
        seen.append((due.key, due.deadline))

    assert seen == [("b", 10.0), ("a", 10.5), ("b", 11.0), ("a", 11.5)]
    assert schedule.take(99.0) is None


@given(st.lists(st.floats(1e-6, 1.0), min_size=1, max_size=300))
def test_lateness_is_within_5_percent(values):
    histogram = LatenessHistogram()
    for value in values:
        histogram.add(value)
    summary = histogram.summary()

    inverted = {"method": "inverted_cdf"}
    assert summary.median == pytest.approx(np.quantile(values, 0.5, **inverted), rel=0.05)
    assert summary.p99 == pytest.approx(np.quantile(values, 0.99, **inverted), rel=0.05)
    assert summary.max == max(values)


# ---- link ---------------------------------------------------------------------------


def test_a_loss_and_the_return_are_each_reported_once(caplog):
    """One warning, one event, however often sending fails in between; likewise the return."""
    port, clock, events = FakePort(None, GONE), Clock(), []
    with Link(port, on_event=lambda up, text: events.append((up, text)), clock=clock) as link:
        assert link.send(FRAME) is Sent.OK
        assert link.send(FRAME) is Sent.DOWN
        assert not port.opened[0].open
        port.cannot_open = True
        for _ in range(50):
            clock.now += 0.1
            assert link.send(FRAME) is Sent.DOWN
            assert link.recv(0.0) is None
        assert (link.up, link.outages) == (False, 1)
        port.cannot_open = False
        clock.now += 1.0
        assert link.send(FRAME) is Sent.OK
        assert link.send(FRAME) is Sent.OK
        assert (link.up, link.outages) == (True, 1)

    assert [up for up, _ in events] == [False, True]
    assert events[0][1] == "fake is lost (No such device); looking for it until it is back"
    assert events[1][1] == "fake is back after 6.0 s"
    assert [text for _, text in events] == caplog.messages


def test_an_interface_that_opens_but_does_not_work_is_not_back():
    """Opening proves nothing (SocketCAN opens what is down): the first frame does."""
    port, clock, events = FakePort(GONE, GONE, GONE), Clock(), []
    with Link(port, on_event=lambda up, _: events.append(up), clock=clock) as link:
        for _ in range(3):
            assert link.send(FRAME) is Sent.DOWN
            clock.now += 2.0
        assert events == [False]
        assert link.send(FRAME) is Sent.OK

    assert events == [False, True]
    assert len(port.opened) == 4


def test_attempts_to_reopen_back_off():
    """After 0.1, 0.2, 0.4, 0.8 s and then each second."""
    port, clock = FakePort(GONE), Clock()
    attempts = []
    with Link(port, clock=clock) as link:
        link.send(FRAME)
        start = clock.now

        def refuse():
            attempts.append(clock.now - start)
            raise GONE

        link._factory._opener = refuse
        for step in range(1, 4000):
            clock.now = start + step * 1e-3
            link.send(FRAME)

    assert attempts == pytest.approx([0.1, 0.3, 0.7, 1.5, 2.5, 3.5], abs=2e-3)


@pytest.mark.parametrize("error", [FULL, can.CanTimeoutError(), NO_NUMBER])
def test_a_full_queue_is_not_a_loss(error):
    with Link(FakePort(error)) as link:
        assert link.send(FRAME) is Sent.FULL
        assert link.send(FRAME) is Sent.OK
        assert link.outages == 0


@pytest.mark.parametrize("way", ["send", "recv"])
def test_a_driver_that_keeps_failing_is_opened_again(way):
    """Errors without a number count as a loss when nothing works for a second."""
    port, clock = FakePort(*[NO_NUMBER] * 3), Clock()
    with Link(port, clock=clock) as link:
        for step in (0.0, 0.5, 1.0):
            clock.now = 1000.0 + step
            link.send(FRAME) if way == "send" else link.recv(0.0)
            assert link.outages == (step == 1.0)
        clock.now += 1.0
        assert link.send(FRAME) is Sent.OK


def test_garbage_once_in_a_while_is_not_a_loss():
    port, clock = FakePort(*[NO_NUMBER, None] * 5), Clock()
    with Link(port, clock=clock) as link:
        for _ in range(10):
            clock.now += 10.0
            assert link.recv(0.0) is None
        assert link.outages == 0


def test_the_error_of_a_bus_that_another_thread_has_given_up_is_ignored():
    """Closing a socket under a reader makes it fail as well: one loss, not two."""
    clock = Clock()
    with Link(FakePort(GONE), clock=clock) as link:
        old = link._bus
        link.send(FRAME)
        clock.now += 1.0
        assert link.send(FRAME) is Sent.OK
        assert link._failed(old, ValueError("file descriptor cannot be -1"), "recv") is Sent.DOWN
        assert (link.up, link.outages) == (True, 1)


def test_a_frame_that_can_never_be_sent_raises():
    with (
        Link(FakePort(can.CanOperationError("Failed", errno.EINVAL))) as link,
        pytest.raises(BusError, match=r"fake refuses the frame: .* opened with fd=True"),
    ):
        link.send(FRAME)


def test_a_wrong_message_raises():
    with Link(FakePort(ValueError("no such frame"))) as link, pytest.raises(ValueError, match="no"):
        link.send(FRAME)


def test_a_closed_link_says_so(channel):
    link = Link(interface="virtual", channel=channel)
    link.close()
    link.close()
    for use in (lambda: link.send(FRAME), lambda: link.recv(0.0)):
        with pytest.raises(BusError, match=r"virtual test-.* is closed; stop its users before"):
            use()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        pytest.param({}, "no CAN interface is given; pass interface=", id="nothing"),
        pytest.param({"interface": "canny"}, 'Unknown interface type "canny"', id="unknown"),
        pytest.param({"interface": "socketcan"}, "socketcan needs a channel", id="no-channel"),
        pytest.param(
            {"interface": "socketcan", "channel": "nocan7"},
            "socketcan nocan7 cannot be opened: there is no such interface",
            id="no-such-interface",
        ),
        pytest.param({"interface": "slcan", "channel": "x"}, "slcan x cannot be", id="no-driver"),
        pytest.param(
            {"interface": "udp_multicast", "channel": "nowhere"},
            "udp_multicast nowhere cannot be opened",
            id="no-address",
        ),
    ],
)
def test_what_cannot_be_opened_is_one_clear_line(settings, words, monkeypatch, tmp_path):
    """At the first opening, not tried again."""
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(BusError) as caught:
        Link(**settings)

    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_opener_and_settings_contradict():
    with pytest.raises(TypeError, match=r"not both; got \['channel'\]"):
        Link(FakePort(), channel="can0")


@pytest.mark.parametrize("source", ["environment", "file", "context"])
def test_settings_come_from_python_can_s_configuration(source, monkeypatch, tmp_path, channel):
    monkeypatch.setenv("HOME", str(tmp_path))
    if source == "environment":
        monkeypatch.setenv("CAN_INTERFACE", "virtual")
        monkeypatch.setenv("CAN_CHANNEL", channel)
    else:
        section = {"file": "default", "context": "car"}[source]
        text = f"[{section}]\ninterface = virtual\nchannel = {channel}\n"
        (tmp_path / ".canrc").write_text(text)
    context = "car" if source == "context" else None
    with Link(interface=None, config_context=context) as link:
        assert link.name == f"virtual {channel}"


def test_filters_survive_a_loss():
    port, clock = FakePort(GONE), Clock()
    with Link(port, clock=clock) as link:
        link.accept_only({0x101, 0x100})
        link.send(FRAME)
        clock.now += 1.0
        link.send(FRAME)
        for bus in port.opened:
            assert bus.filters == [
                {"can_id": 0x100, "can_mask": 0x1FFFFFFF},
                {"can_id": 0x101, "can_mask": 0x1FFFFFFF},
            ]


# ---- transmitter ----------------------------------------------------------------------


def collect(receiver, n):
    lines = list(itertools.islice(iter(lambda: receiver.get(LONG), None), n))
    assert len(lines) == n
    return lines


def transfer(sent, n=PAGES):
    """(page, counter) of the next n frames that a fake bus was given."""
    return [tuple(sent.get(timeout=LONG).data[:2]) for _ in range(n)]


@pytest.mark.parametrize("fd", [False, True])
def test_lines_arrive_in_every_period(link, other, fd):
    """Eight lines, five periods each, nothing lost; the counters agree."""
    codec = FakeCodec()
    with Receiver(other, codec.decoder()) as receiver:
        transmitter = Transmitter(link, codec, period=0.05, fd=fd, count=5)
        for slot in Slot:
            transmitter.publish(line(slot, y=slot / 10))
        with transmitter:
            lines = collect(receiver, 40)
            assert transmitter.wait(LONG)

    for slot in Slot:
        assert [x.gaussian.mean[0] for x in lines if x.slot == slot] == [slot / 10] * 5
    stats = transmitter.stats()
    assert stats.lines + stats.overruns == 40
    assert stats.frames == stats.lines * (1 if fd else PAGES)
    assert 0 < stats.lateness.median <= stats.lateness.p99 <= stats.lateness.max
    assert receiver.stats().counts[Reason.DONE] == receiver.stats().lines == 40


def test_the_latest_value_wins(link, other):
    """What is published last is sent, once each period."""
    codec = FakeCodec()
    with (
        Receiver(other, codec.decoder()) as receiver,
        Transmitter(link, codec, period=0.02) as transmitter,
    ):
        for round_ in range(1, 4):
            for y in (0.5, -3.0, round_):
                transmitter.publish(line(y=y))
            while receiver.get(LONG).gaussian.mean[0] != round_:
                pass  # the values of the race before the last publish
            assert collect(receiver, 2)[-1].gaussian.mean[0] == round_


def test_a_retracted_line_is_not_sent_again(link):
    """Another slot's line stays."""
    transmitter = Transmitter(link, FakeCodec(), period=0.02)
    transmitter.publish(line())
    transmitter.retract(Slot.NEXT_LEFT)
    assert transmitter._tx_queue.wait(0.0) is not None
    transmitter.retract(Slot.EGO_LEFT)
    assert transmitter._tx_queue.wait(0.0) is None


class Recorder(FakeCodec):
    """Remembers the lines of each call, for a transmitter that is driven step by step."""

    def __init__(self):
        super().__init__()
        self.batches = []

    def encode_lines(self, lines, *, fd=False, counters=None):
        self.batches.append([(x.slot, x.gaussian.mean[0], round(x.age, 9)) for x in lines])
        return super().encode_lines(lines, fd=fd, counters=counters)


def run_until(transmitter, clock, end):
    """What the thread does until then, with perfect timing."""
    while clock.now + (step := transmitter._tx_queue.wait(clock.now)) < end:
        clock.now += step
        transmitter._send(transmitter._next())
    clock.now = end


def values(port):
    """(y_off [m], age [s]) of the lines that went out."""
    pages = [port.sent.get(timeout=0).data for _ in range(port.sent.qsize())]
    return [struct.unpack_from("<Hh", page, 4) for page in pages if page[0] == 0]


def test_lines_are_encoded_together_and_ages_are_those_of_the_sending():
    """One call a period; each age counts to the line's own place in it."""
    port, clock, codec = FakePort(), Clock(), Recorder()
    with Link(port) as link:
        transmitter = Transmitter(link, codec, period=0.08, clock=clock)
        transmitter.publish([line(slot, age=0.1) for slot in Slot])
        run_until(transmitter, clock, 1000.075)

        assert codec.batches == [[(slot, 1.75, round(0.1 + slot / 100, 9)) for slot in Slot]]
        assert values(port) == [(100 + 10 * slot, 1750) for slot in Slot]


@pytest.mark.parametrize("offset", [0.005, 0.035, 0.065])
def test_a_producer_of_the_same_period_is_never_behind(offset):
    """Wherever in the period it publishes: one call a period, no line waits longer than one."""
    port, clock, codec = FakePort(), Clock(), Recorder()
    with Link(port) as link:
        transmitter = Transmitter(link, codec, period=0.08, clock=clock)
        for k in range(10):
            transmitter.publish(line(slot, y=k) for slot in Slot)
            run_until(transmitter, clock, 1000.0 + offset + 0.08 * k)
            if k == 5:
                values(port)
                codec.batches.clear()

        assert [len(batch) for batch in codec.batches] == [8] * 4
        for batch in codec.batches:
            assert len({y for _, y, _ in batch}) == 1
            assert max(age for _, _, age in batch) < 0.08


def test_repetitions_are_encoded_half_a_period_ahead_at_most():
    port, clock, codec = FakePort(), Clock(), Recorder()
    with Link(port) as link:
        transmitter = Transmitter(link, codec, period=0.08, clock=clock)
        transmitter.publish(line(slot) for slot in Slot)
        run_until(transmitter, clock, 1000.0 + 0.08 * 3 - 0.001)

    assert [len(batch) for batch in codec.batches] == [8, 4, 4, 4, 4]


@pytest.mark.parametrize("period", [1.0, 3.0, 60.0])
def test_a_slow_sender_encodes_a_tenth_of_a_second_ahead_at_most(period):
    """A value that is published in time goes out at the next deadline; frames are stamped late."""
    port, clock, codec = FakePort(), Clock(), Recorder()
    with Link(port) as link:
        transmitter = Transmitter(link, codec, period=period, clock=clock)
        transmitter.publish(line(slot, y=1) for slot in Slot)
        run_until(transmitter, clock, 1000.0 + period * 5 / 8 - AHEAD - 0.01)
        transmitter.publish(line(slot, y=2) for slot in Slot)
        run_until(transmitter, clock, 1000.0 + period * 0.99)

    assert [y for _, y in values(port)] == [1000] * 5 + [2000] * 3
    assert max(map(len, codec.batches)) <= 1 + AHEAD / (period / 8)


def test_what_was_encoded_before_a_retract_is_not_sent_after_it():
    port, clock = FakePort(), Clock()
    with Link(port) as link:
        transmitter = Transmitter(link, FakeCodec(), period=0.08, clock=clock)
        transmitter.publish(line(slot, y=1) for slot in Slot)
        run_until(transmitter, clock, 1000.005)
        assert len(transmitter._tx_queue._ahead) == 7
        transmitter.retract(Slot.ROUTE)
        run_until(transmitter, clock, 1000.05)
        transmitter.publish(line(Slot.ROUTE, y=2))
        run_until(transmitter, clock, 1000.075)

        assert [y for _, y in values(port)] == [1000] * 7 + [2000]


def test_the_age_counts_from_the_pose():
    port, clock = FakePort(), Clock()
    with Link(port) as link:
        transmitter = Transmitter(link, FakeCodec(), period=1.0, clock=clock)
        transmitter.publish(line(age=77.0), t_pose_ns=time.time_ns() - 2_000_000_000)
        run_until(transmitter, clock, 1000.5)
        assert 2000 <= values(port)[0][0] < 2500


@pytest.mark.parametrize("t_pose_ns", [0, 2**62])
def test_a_time_of_another_clock_is_refused(link, t_pose_ns):
    with pytest.raises(ValueError, match=r"t_pose_ns must be on the clock of time.time_ns\(\)"):
        Transmitter(link, FakeCodec()).publish(line(), t_pose_ns)


@pytest.mark.parametrize("lost_at", range(PAGES))
def test_nothing_is_sent_half(lost_at):
    """After a loss in a transfer its other pages are never sent; a new transfer follows."""
    port = FakePort(*[None] * lost_at, GONE)
    with (
        Link(port, backoff=(0.001, 0.001)) as link,
        Transmitter(link, FakeCodec(), period=0.01) as transmitter,
    ):
        transmitter.publish(line())
        assert transfer(port.sent, lost_at) == [(page, 1) for page in range(lost_at)]
        later = transfer(port.sent)
        assert [page for page, _ in later] == [0, 1, 2, 3]
        assert len({counter for _, counter in later} - {1}) == 1
        transmitter.stop()
        stats = transmitter.stats()

    assert stats.down >= 1
    assert stats.frames == PAGES * stats.lines + lost_at
    assert link.outages == 1


def test_a_full_queue_is_waited_for():
    """The transfer goes on where it was when there is room again."""
    port = FakePort(None, FULL, FULL, FULL)
    with Link(port) as link, Transmitter(link, FakeCodec(), period=3600.0) as transmitter:
        transmitter.publish(line())
        assert transfer(port.sent) == [(0, 1), (1, 1), (2, 1), (3, 1)]

    assert transmitter.stats()[:6] == (1, 0, 0, 0, PAGES, 3)


def test_a_queue_that_stays_full_costs_the_line_its_period():
    """Given up when the next transfer is due, counted, and not a loss of the interface."""
    port = FakePort(None, *[FULL] * 10_000)
    with Link(port) as link:
        transmitter = Transmitter(link, FakeCodec(), period=0.02, count=2)
        transmitter.publish(line())
        with transmitter:
            assert transmitter.wait(LONG)
        stats = transmitter.stats()

    assert (stats.lines, stats.frames) == (0, 1)
    assert stats.full + stats.overruns == 2
    assert stats.retries > 0
    assert link.outages == 0


def test_virtual_receivers_that_are_full_do_not_hold_the_sender(link, channel):
    """The virtual bus would wait for ever."""
    with can.Bus(interface="virtual", channel=channel, rx_queue_size=2):
        transmitter = Transmitter(link, FakeCodec(), period=0.02, count=1)
        transmitter.publish(line())
        with transmitter:
            assert transmitter.wait(LONG)
        assert transmitter.stats().full == 1


def test_a_mistake_of_the_codec_reaches_the_caller(link):
    """It ends the thread, and publish and wait raise it; stop does not raise it again."""
    transmitter = Transmitter(link, FakeCodec(), period=0.001)
    with transmitter:
        transmitter.publish(line(x_max=13.0))
        with pytest.raises(ValueError, match="13 m"):
            transmitter.wait(LONG)
        with pytest.raises(ValueError, match="13 m"):
            transmitter.publish(line())

    with pytest.raises(ValueError, match="13 m"), Transmitter(link, FakeCodec()) as transmitter:  # noqa: PT012
        transmitter.publish(line(x_max=13.0))
        transmitter._worker.join(LONG)


def test_the_error_of_the_body_is_not_hidden(link):
    with pytest.raises(KeyError), Transmitter(link, FakeCodec()) as transmitter:  # noqa: PT012
        transmitter.publish(line(x_max=13.0))
        transmitter._worker.join(LONG)
        raise KeyError


def test_stop_is_immediate_and_can_be_repeated(link):
    """From any thread, while the next deadline is an hour away, and before the start."""
    transmitter = Transmitter(link, FakeCodec(), period=3600.0).start()
    transmitter.publish(line())
    threads = [threading.Thread(target=transmitter.stop) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LONG)
        assert not thread.is_alive()
    transmitter.stop()
    assert transmitter.wait(0)
    Transmitter(link, FakeCodec()).stop()


def test_a_callback_may_stop_the_transmitter():
    port = FakePort(GONE)
    stopped = threading.Event()

    def on_event(up, text):
        transmitter.stop()
        stopped.set()

    with Link(port, on_event=on_event) as link:
        transmitter = Transmitter(link, FakeCodec())
        transmitter.publish(line())
        with transmitter:
            assert stopped.wait(LONG)
            assert transmitter.wait(LONG)


def test_lines_have_places_in_the_period(link, other):
    """Slots are spread over the period, in their order, the pages of one line together."""
    codec = FakeCodec()
    transmitter = Transmitter(link, codec, period=0.4, count=2)
    for slot in reversed(Slot):
        transmitter.publish(line(slot))
    with transmitter:
        frames = [other.recv(LONG) for _ in range(2 * 8 * PAGES)]

    order = [frame.data[2] for frame in frames]
    rounds = [order[i : i + PAGES] for i in range(0, len(order), PAGES)]
    assert all(len(set(pages)) == 1 for pages in rounds)
    slots = [pages[0] for pages in rounds]
    assert all((b - a) % 8 == 1 for a, b in itertools.pairwise(slots))


@pytest.mark.parametrize("settings", [{"period": 0}, {"period": float("nan")}, {"count": 0}])
def test_wrong_settings_raise(link, settings):
    with pytest.raises(ValueError, match=rf"{next(iter(settings))} must be"):
        Transmitter(link, FakeCodec(), **settings)


def test_can_fd_needs_a_link_with_can_fd():
    with (
        Link(FakePort()) as link,
        pytest.raises(BusError, match="fake is opened without CAN FD; open it with fd=True"),
    ):
        Transmitter(link, FakeCodec(), fd=True)


# ---- receiver ---------------------------------------------------------------------------


def send_frames(link, *frames):
    for frame in frames:
        message = can.Message(
            arbitration_id=frame.can_id, data=frame.data, is_fd=frame.is_fd, is_extended_id=False
        )
        assert link.send(message) is Sent.OK


def test_everything_that_arrives_is_counted(link, other):
    """Lines, rejected frames, error frames, remote frames."""
    codec = FakeCodec()
    frames = codec.encode(line())
    with Receiver(other, codec.decoder()) as receiver:
        link.send(can.Message(is_error_frame=True))
        link.send(can.Message(arbitration_id=0x100, is_remote_frame=True, is_extended_id=False))
        send_frames(link, Frame(0x7FF, b"other"), *frames[:2], frames[3], *codec.encode(line()))
        received = receiver.get(LONG)
        stats = receiver.stats()

    assert abs(received.t_ns - time.time_ns()) < LONG * 1e9
    assert (stats.lines, stats.frames, stats.overflowed) == (1, 8, 0)
    assert (stats.error_frames, stats.remote_frames) == (1, 1)
    assert stats.counts == {
        Reason.UNKNOWN_ID: 1,
        Reason.PENDING: 5,
        Reason.BROKEN: 1,
        Reason.DONE: 1,
    }


def test_iteration_ends_with_stop(link, other):
    """Lines that wait are still delivered, then the iteration ends."""
    codec = FakeCodec()
    with Receiver(other, codec.decoder()) as receiver:
        send_frames(link, *codec.encode(line(y=1)), *codec.encode(line(y=2)))
        for received in receiver:
            receiver.stop()
            assert received.gaussian.mean[0] == 1
            break
    assert [x.gaussian.mean[0] for x in receiver] in ([2.0], [])
    assert receiver.get() is None
    receiver.stop()


def test_get_has_a_timeout(other):
    with Receiver(other, FakeCodec().decoder()) as receiver:
        assert receiver.get(0.0) is None


def test_stop_wakes_who_waits(other):
    receiver = Receiver(other, FakeCodec().decoder())
    waiting = threading.Thread(target=receiver.get)
    waiting.start()
    receiver.stop()  # never started
    waiting.join(LONG)
    assert not waiting.is_alive()


def test_the_newest_lines_wait(link, other):
    """A queue that nobody empties drops the oldest lines and counts them."""
    codec = FakeCodec()
    with Receiver(other, codec.decoder(), queue_size=3) as receiver:
        for y in range(10):
            send_frames(link, *codec.encode(line(y=y)))
        deadline = time.monotonic() + LONG
        while receiver.stats().lines < 10:
            assert time.monotonic() < deadline
        assert [x.gaussian.mean[0] for x in collect(receiver, 3)] == [7, 8, 9]
        assert receiver.stats().overflowed == 7


def test_a_callback_gets_the_lines(link, other):
    codec, lines = FakeCodec(), queue.SimpleQueue()
    with Receiver(other, codec.decoder(), on_line=lines.put) as receiver:
        send_frames(link, *codec.encode(line(y=3)))
        assert lines.get(timeout=LONG).gaussian.mean[0] == 3
        with pytest.raises(TypeError, match="go to on_line"):
            receiver.get()
    assert receiver.stats().overflowed == 0


def test_the_error_of_a_callback_comes_up_at_stop(link, other):
    codec = FakeCodec()

    def on_line(line):
        raise ZeroDivisionError

    receiver = Receiver(other, codec.decoder(), on_line=on_line).start()
    send_frames(link, *codec.encode(line()))
    receiver._worker.join(LONG)
    with pytest.raises(ZeroDivisionError):
        receiver.stop()
    receiver.stop()


def test_an_error_of_the_thread_comes_up_in_the_iteration(channel):
    link = Link(interface="virtual", channel=channel)
    receiver = Receiver(link, FakeCodec().decoder()).start()
    link.close()
    with pytest.raises(BusError, match="is closed"):
        list(receiver)
    receiver.stop()


def test_other_can_ids_do_not_reach_the_decoder(link, other):
    codec = FakeCodec()
    with Receiver(other, codec.decoder(), can_ids={0x100}) as receiver:
        send_frames(link, Frame(0x7FF, b""), *codec.encode(line()))
        assert receiver.get(LONG)
        assert receiver.stats().frames == PAGES


def test_a_queue_of_nothing_is_refused(other):
    with pytest.raises(ValueError, match="queue_size must be 1 line or more, got 0"):
        Receiver(other, FakeCodec().decoder(), queue_size=0)


def test_udp_multicast_carries_lines():
    """Classic and CAN FD over the loopback of this machine, where it routes multicast."""
    settings = {"interface": "udp_multicast", "channel": "239.74.163.2", "port": 43117}
    try:
        link, other = Link(**settings), Link(**settings)
    except BusError as error:
        pytest.skip(str(error))
    with link, other:
        send_frames(link, Frame(0x7FF, b"probe"))
        if not link.up or other.recv(2.0) is None:
            pytest.skip("multicast is not routed here")
        for fd in (False, True):
            codec = FakeCodec()
            with (
                Receiver(other, codec.decoder()) as receiver,
                Transmitter(link, codec, period=0.02, fd=fd) as transmitter,
            ):
                transmitter.publish(line())
                collect(receiver, 5)


@pytest.mark.parametrize("fd", [False, True])
def test_lines_of_the_real_codec(link, other, fd):
    """The whole way: nothing rejected, nothing lost, every value as sent to within a millimetre."""
    codec = Codec.from_dbc()
    sent = [line(slot, y=slot / 7, age=0.02) for slot in Slot]
    with Receiver(other, codec.decoder(), can_ids=codec.can_ids) as receiver:
        transmitter = Transmitter(link, codec, period=0.05, fd=fd, count=4)
        transmitter.publish(sent)
        with transmitter:
            lines = collect(receiver, 8 * 4 - transmitter.stats().overruns)
            assert transmitter.wait(LONG)
        stats = receiver.stats()

    for received in lines:
        assert received.gaussian.mean[0] == pytest.approx(received.slot / 7, abs=1e-3)
        assert received.age >= 0.02 - codec.layout["Age"].factor / 1000
    assert stats.frames == len(lines) * (1 if fd else 4)
    assert (stats.lost, {k: n for k, n in stats.counts.items() if n}) == (0, {})


# ---- load ---------------------------------------------------------------------------------


@pytest.mark.parametrize("length", range(9))
def test_bits_of_classic_frames_are_the_published_ones(length):
    """55 + 10 s and 80 + 10 s bits (Davis et al. 2007, equations 2 and 3)."""
    assert frame_bits(length).nominal == 55 + 10 * length
    assert frame_bits(length, is_extended=True).nominal == 80 + 10 * length


@pytest.mark.parametrize(
    ("length", "is_extended", "bits"),
    [
        pytest.param(0, False, (34, 5 + 1 + 27), id="empty"),
        pytest.param(8, False, (34, 69 + 17 + 27), id="8-bytes"),
        pytest.param(16, False, (34, 133 + 33 + 27), id="last-with-crc-17"),
        pytest.param(20, False, (34, 165 + 41 + 32), id="first-with-crc-21"),
        pytest.param(32, True, (57, 261 + 66 + 32), id="32-bytes-29-bit"),
        pytest.param(64, False, (34, 517 + 129 + 32), id="64-bytes"),
    ],
)
def test_bits_of_can_fd_frames(length, is_extended, bits):
    """Counted by hand: fields + stuff bits + CRC field."""
    assert frame_bits(length, is_extended=is_extended, is_fd=True) == bits


def stuffed(bits):
    """Indices in ``bits`` after which a bit of the other value is put in."""
    places, run, last = [], 0, None
    for index, bit in enumerate(bits):
        run, last = (run + 1 if bit == last else 1), bit
        if run == 5:
            places.append(index)
            run, last = 1, 1 - bit
    return places


def header(is_extended, is_fd, can_id, dlc):
    """Bits of a frame from SOF to DLC, and how many of them come before the faster ones."""
    number = [int(bit) for bit in f"{can_id:029b}"]
    bits = [0, *number[:11], 1, 1, *number[11:], 0] if is_extended else [0, *number[:11], 0]
    bits += [0] if not is_extended else []  # IDE
    bits += [1, 0, 1] if is_fd else [0, 0] if is_extended else [0]  # FDF, res, BRS; or r1, r0
    slow = len(bits)
    bits += [0] if is_fd else []  # ESI
    return bits + [int(bit) for bit in f"{dlc:04b}"], slow


@given(
    st.booleans(),
    st.booleans(),
    st.integers(0, 2**29 - 1),
    st.sampled_from([0, 1, 8, 12, 16, 20, 32, 64]),
    st.lists(st.sampled_from([b"\x00", b"\xff", b"\x0f", b"\x1e", b"\x78", b"\xf0"]), min_size=64),
    st.integers(0, 2**15 - 1),
)
def test_no_frame_is_longer_than_its_bound(is_extended, is_fd, can_id, length, data, crc):
    """Frames built and stuffed bit by bit; data that stuffs much; any CRC."""
    length = length if is_fd else min(length, 8)
    bits, slow = header(is_extended, is_fd, can_id, length if length <= 8 else 15)
    bits += [int(bit) for byte in data[:length] for bit in f"{byte[0]:08b}"]
    bound = frame_bits(length, is_extended=is_extended, is_fd=is_fd)
    if is_fd:
        places = stuffed(bits)
        early = sum(place < slow for place in places)
        crc_field = 27 if length <= 16 else 32
        nominal, fast = slow + early + 13, len(bits) - slow + len(places) - early + crc_field
    else:
        bits += [int(bit) for bit in f"{crc:015b}"]
        nominal, fast = len(bits) + len(stuffed(bits)) + 13, 0

    assert nominal <= bound.nominal
    for speed in (1, 2, 8):
        assert nominal + fast / speed <= bound.nominal + bound.data / speed


def test_the_bound_is_reached_by_alternating_runs():
    """1 + 4 k bits 0000 0 1111 0000 ... have a stuff bit for each four after the first."""
    bits = [0] + [bit for k in range(20) for bit in [k % 2] * 4]
    assert len(stuffed(bits)) == (len(bits) - 1) // 4


def test_bus_load_of_lines():
    """Eight lines each 50 ms at 500 kbit/s: four classic frames or one of CAN FD each."""
    classic = [Frame(0x100, bytes(8))] * 32
    fd = [Frame(0x100, bytes(32), is_fd=True)] * 8

    assert bus_load(classic, 0.05, 500e3) == pytest.approx(32 * 135 / 500e3 / 0.05)
    assert bus_load(fd, 0.05, 500e3, 2e6) == pytest.approx(8 * (34 / 500e3 + 358 / 2e6) / 0.05)
    assert frame_time(fd[0], 500e3) == pytest.approx(392 / 500e3)


@pytest.mark.parametrize("length", [-1, 9, 10, 65])
def test_lengths_that_no_frame_has(length):
    with pytest.raises(ValueError, match="length must be 0 to 8"):
        frame_bits(length, is_fd=length != 9)


def test_loads_without_a_sense_are_refused():
    with pytest.raises(ValueError, match="bit rates must be positive"):
        frame_time(Frame(1, b""), 0)
    with pytest.raises(ValueError, match="period must be positive"):
        bus_load([], 0, 500e3)


# ---- logs ---------------------------------------------------------------------------------

LOGGED = [
    can.Message(timestamp=100.0, arbitration_id=0x123, is_extended_id=False, data=b"12345678"),
    can.Message(timestamp=100.25, arbitration_id=0x123, is_extended_id=True, data=b""),
    can.Message(timestamp=100.5, arbitration_id=0x100, is_extended_id=False, is_remote_frame=True),
    can.Message(timestamp=100.5, is_error_frame=True),
    can.Message(timestamp=101.0, arbitration_id=0x1ABCDEF0, is_extended_id=True, data=b"\xff\x00"),
]
LOGGED_FD = can.Message(
    timestamp=102.0, arbitration_id=0x124, is_extended_id=False, is_fd=True, data=bytes(range(32))
)
FORMATS = ["asc", "blf", "csv", "db", "log", "mf4", "trc", "asc.gz", "blf.gz", "csv.gz", "log.gz"]


def written(path, messages):
    """The path of a log, written by python-can."""
    if path.name.endswith(".blf.gz"):  # which it reads only
        path.write_bytes(gzip.compress(written(path.with_suffix(""), messages).read_bytes()))
        return path
    for message in messages:
        message.channel = 1
    writer = can.Logger(path)
    try:
        for message in messages:
            if isinstance(writer, can.TRCWriter) and message.is_error_frame:
                continue  # it writes these as data frames
            writer.on_message_received(message)
        while isinstance(writer, can.SqliteWriter) and writer.num_frames < len(messages):
            assert writer._writer_thread.is_alive()  # it would lose what is not yet written
    finally:
        writer.stop()
    return path


@pytest.mark.parametrize("suffix", FORMATS)
def test_every_format_is_read_back(tmp_path, suffix):
    """What python-can writes; error and remote frames are left out."""
    if suffix == "mf4":
        pytest.importorskip("asammdf")
    with_fd = suffix[:3] in {"asc", "blf", "log", "mf4"}
    messages = [*LOGGED, LOGGED_FD] if with_fd else LOGGED
    frames = list(read_log(written(tmp_path / f"drive.{suffix}", messages)))

    wanted = [m for m in messages if not (m.is_error_frame or m.is_remote_frame)]
    assert [(f.can_id, f.data, f.is_extended) for f in frames] == [
        (m.arbitration_id, bytes(m.data), m.is_extended_id) for m in wanted
    ]
    times = [(f.t_ns - frames[0].t_ns) * 1e-9 for f in frames]
    assert times == pytest.approx([m.timestamp - 100.0 for m in wanted], abs=2e-3)


def test_candump_logs_keep_their_channels_and_times(tmp_path):
    path = tmp_path / "drive.log"
    path.write_text(
        "(1700000000.123456) vcan0 100#0011223344556677\n"
        "(1700000000.123556) can1 124##1DEADBEEF\n"
        "\n"
        "(1700000000.2) can1 00000100#\n"
    )
    first, second, third = read_log(path)

    assert first == (0x100, bytes.fromhex("0011223344556677"), first.t_ns, False, "vcan0")
    assert abs(first.t_ns - 1_700_000_000_123_456_000) < 1000  # a float of seconds
    assert (second.data.hex(), second.channel) == ("deadbeef", "can1")
    assert (third.is_extended, third.data) == (True, b"")


def read_until_error(path):
    frames = []
    with pytest.raises(LogError) as caught:
        frames.extend(read_log(path))
    assert "\n" not in str(caught.value)
    return frames, str(caught.value).removeprefix(str(path))


@pytest.mark.parametrize("packed", [False, True])
@pytest.mark.parametrize(
    ("suffix", "header", "good", "bad"),
    [
        pytest.param("log", "", "(1.5) can0 {:03X}#0001", "(1.5) can0 1\xff3#0001", id="log"),
        pytest.param("csv", "names", "1.5,{:#x},0,0,0,2,AAE=", "1.5,\xff,0", id="csv"),
        pytest.param(
            "asc",
            "date Fri Nov 21 2025\nbase hex  timestamps absolute\nno internal events logged",
            " 1.5 1  {:X}  Rx  d 2 00 01",
            " 1.5 1  123  Rx  d 2 00 \xff",
            id="asc",
        ),
        pytest.param(
            "trc",
            ";$FILEVERSION=1.1\n;$STARTTIME=40000.0",
            "  1)  1500.0  Rx  {:04X}  2  00 01",
            "  1)  1500.0  Rx  0123  2  00 \xff",
            id="trc",
        ),
    ],
)
def test_a_damaged_line_costs_only_itself(tmp_path, suffix, header, good, bad, packed):
    """All others are read, before, between and behind the damage; then the error."""
    lines = header.split("\n") if header else []
    lines += [bad if i % 10 == 5 else good.format(i) for i in range(1, 31)]
    content = "\n".join(lines).encode("latin-1") + b"\n"
    path = tmp_path / (f"drive.{suffix}.gz" if packed else f"drive.{suffix}")
    path.write_bytes(gzip.compress(content) if packed else content)
    frames, text = read_until_error(path)

    assert [f.can_id for f in frames] == [i for i in range(1, 31) if i % 10 != 5]
    assert {f.data for f in frames} == {b"\x00\x01"}
    first = lines.index(bad) + 1
    assert text.startswith(f": 3 of 30 records are damaged (the first: line {first}: ")


@pytest.mark.parametrize("suffix", ["blf", "log.gz", "blf.gz", "db"])
def test_of_a_file_that_is_cut_off_the_beginning_is_read(tmp_path, suffix):
    rng = random.Random(1)  # noqa: S311 - not a secret
    messages = [
        can.Message(timestamp=100 + i, arbitration_id=i % 2048, data=rng.randbytes(8))
        for i in range(20_000 if suffix != "db" else 500)
    ]
    path = written(tmp_path / f"drive.{suffix}", messages)
    content = path.read_bytes()
    path.write_bytes(content[: int(len(content) * 0.6)])
    frames, text = read_until_error(path)

    if suffix != "db":  # sqlite does not open half a file
        assert len(messages) * 0.2 < len(frames) < len(messages) * 0.7
        assert f"after {len(frames)} good records" in text
    assert [f.can_id for f in frames] == [m.arbitration_id for m in messages[: len(frames)]]


@pytest.mark.parametrize("suffix", [".blf", ".db", ".blf.gz", ".log.gz", ".csv", ".log"])
def test_a_file_of_something_else_is_one_clear_error(tmp_path, suffix):
    path = tmp_path / f"drive{suffix}"
    path.write_bytes(b"This is not a log.\n" * 20)
    frames, text = read_until_error(path)

    assert frames == []
    if suffix == ".log":
        assert "none of 20 records can be read (line 1: " in text
        assert text.endswith("; it should be written by candump -L")


@pytest.mark.parametrize("length", [0, 1, 15])
def test_a_blf_object_that_is_shorter_than_its_header_ends_the_file(tmp_path, length):
    """python-can would read it again and again."""
    messages = [can.Message(timestamp=100 + i, arbitration_id=i, data=b"abc") for i in range(50)]
    path = written(tmp_path / "drive.blf", messages)
    content = path.read_bytes()
    start = 144 + 32  # of the file's header, and of the only container's
    objects = bytearray(zlib.decompress(content[start:]))
    places = [match.start() for match in re.finditer(b"LOBJ", objects)]
    objects[places[30] + 8 : places[30] + 12] = length.to_bytes(4, "little")
    packed = zlib.compress(objects)
    head = content[: 144 + 8] + (32 + len(packed)).to_bytes(4, "little") + content[144 + 12 : start]
    path.write_bytes(head + packed)
    frames, text = read_until_error(path)

    assert [frame.can_id for frame in frames] == list(range(30))
    assert "damaged after 30 good records (BLFParseError: an object is shorter" in text


def test_a_reader_that_never_gets_further_is_left(tmp_path):
    """A version that python-can cannot read fails again at each attempt."""
    path = tmp_path / "drive.trc"
    path.write_text(";$FILEVERSION=2.0\n   1   1059.9 DT 0300 Rx 7 00 00 00 00 04 00 00\n")
    frames, text = read_until_error(path)

    assert frames == []
    assert "File has no column information" in text


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("missing.log", "there is no such file"),
        ("missing.db", "there is no such file"),
        ("drive.pcap", "the format '.pcap' is unknown; use .asc, .blf, .csv, .db, .log, .mf4, .tr"),
        ("drive", "the format '' is unknown"),
        ("drive.gz", "the format '' is unknown"),
        ("drive.db.gz", ".db cannot be read while packed; unpack it with gunzip"),
    ],
)
def test_what_cannot_be_read_raises_at_once(tmp_path, name, words):
    with pytest.raises(LogError) as caught:
        read_log(tmp_path / name)
    assert words in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_mf4_without_its_package_names_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr("maplines_can.bus.logs.find_spec", lambda _: None)
    path = tmp_path / "drive.mf4"
    path.touch()
    with pytest.raises(MissingExtraError, match=r'pip install "maplines_can\[mf4\]"'):
        read_log(path)


@given(st.binary(max_size=300), st.sampled_from(["asc", "blf", "csv", "log", "trc", "log.gz"]))
def test_no_log_can_do_worse_than_a_log_error(tmp_path_factory, content, suffix):
    """Whatever a file holds."""
    path = tmp_path_factory.getbasetemp() / f"any.{suffix}"
    header = {"asc": b"base hex\n", "csv": b"t\n", "trc": b";$FILEVERSION=1.1\n", "blf": b"LOGG"}
    path.write_bytes(header.get(suffix, b"") + content)
    with contextlib.suppress(LogError):
        list(read_log(path))


# ---- SocketCAN, under a kernel that has it ------------------------------------------------


def ip(arguments):
    subprocess.run(["ip", *arguments.split()], check=True)


def set_up(name, mtu=72):
    if not Path("/sys/class/net", name).exists():
        ip(f"link add dev {name} type vcan")
    ip(f"link set {name} down")
    ip(f"link set {name} mtu {mtu} up")


@pytest.fixture
def vcan():
    if not Path("/sys/class/net/vcan0").exists():
        pytest.skip("there is no vcan0; run this inside tools/vcan")
    yield "vcan0"
    set_up("vcan0")


class Outages:
    """Waits for the events of a link."""

    def __init__(self):
        self.events = queue.SimpleQueue()

    def __call__(self, up, text):
        self.events.put((up, text))

    def expect(self, up, words):
        got, text = self.events.get(timeout=LONG)
        assert got is up
        assert words in text


@pytest.mark.socketcan
@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("how", ["down", "delete"])
def test_a_socketcan_interface_goes_and_comes_back(vcan, fd, how, caplog):
    """Reported once by each link, and back by itself."""
    sender_events, receiver_events = Outages(), Outages()
    settings = {"interface": "socketcan", "channel": vcan, "fd": fd}
    codec, decoder = FakeCodec(), FakeCodec().decoder()
    caplog.set_level(logging.WARNING)
    with (
        Link(**settings, on_event=sender_events) as link,
        Link(**settings, on_event=receiver_events) as other,
        Receiver(other, decoder) as receiver,
        Transmitter(link, codec, period=0.005, fd=fd) as transmitter,
    ):
        for slot in Slot:
            transmitter.publish(line(slot))
        collect(receiver, 20)
        for _ in range(2):
            ip(f"link set {vcan} down" if how == "down" else f"link del {vcan}")
            # By the error of the socket, or because the link looked first and it was not there.
            sender_events.expect(False, "is lost (")
            receiver_events.expect(False, "is lost (")
            while receiver.get(0.0):
                pass
            set_up(vcan)
            sender_events.expect(True, "is back after")
            receiver_events.expect(True, "is back after")
            collect(receiver, 20)
        transmitter.stop()
        assert transmitter.stats().down > 0
        assert (link.outages, other.outages) == (2, 2)
    assert len(caplog.messages) == 8


@pytest.mark.socketcan
def test_an_independent_socket_sees_no_half_burst(vcan):
    """After the return nothing comes of the transfer in which it went, and no page is left out."""
    events, raw = Outages(), can.Bus(interface="socketcan", channel=vcan)
    with (
        Link(interface="socketcan", channel=vcan, on_event=events) as link,
        Transmitter(link, FakeCodec(), period=0.002) as transmitter,
    ):
        for slot in Slot:
            transmitter.publish(line(slot))
        for _ in range(5):
            seen = [raw.recv(LONG).data[:3] for _ in range(101)]
            assert seen[0][0] == 0  # raw was there before the first frame
            for old, new in itertools.pairwise(seen):
                same = old[1:] == new[1:]
                assert new[0] == (old[0] + 1 if same else 0)
                assert same or old[0] == PAGES - 1
            ip(f"link set {vcan} down")
            events.expect(False, "lost")
            raw.shutdown()
            raw = can.Bus(interface="socketcan", channel=vcan)  # hears all from the first
            with pytest.raises(can.CanOperationError):
                raw.recv(0.0)
            ip(f"link set {vcan} up")
            events.expect(True, "back")
    raw.shutdown()


@pytest.mark.socketcan
def test_a_socket_that_has_gone_silent_is_found(vcan):
    """Its only error was taken by somebody else, and the name exists again."""
    events = Outages()
    codec = FakeCodec()
    with (
        Link(interface="socketcan", channel=vcan, on_event=events) as other,
        Receiver(other, codec.decoder()) as receiver,
    ):
        other._factory._index = -1  # as if it had been opened before the one that is there now
        events.expect(False, "it was deleted")
        events.expect(True, "is back")
        with Link(interface="socketcan", channel=vcan) as link:
            send_frames(link, *codec.encode(line()))
            assert receiver.get(LONG)


@pytest.mark.socketcan
@pytest.mark.parametrize(
    ("before", "settings", "words"),
    [
        ("link set vcan0 down", {}, "the interface is down; 'ip link set vcan0 up'"),
        ("link del vcan0", {}, "there is no such interface"),
        ("link show vcan2", {"channel": "vcan2", "fd": True}, "the interface has no CAN FD"),
    ],
)
def test_socketcan_that_cannot_be_opened(vcan, before, settings, words):
    ip(before)
    with pytest.raises(BusError) as caught:
        Link(**{"interface": "socketcan", "channel": vcan, **settings})
    assert words in str(caught.value)


@pytest.mark.socketcan
def test_an_interface_that_comes_back_without_can_fd_is_told_once(vcan):
    """It is there and up again, so somebody has to know why no line comes."""
    events = Outages()
    ip("link set vcan1 up")
    try:
        with (
            Link(interface="socketcan", channel="vcan1", fd=True, on_event=events) as link,
            Receiver(link, FakeCodec().decoder()),
        ):
            ip("link set vcan1 down")
            events.expect(False, "is lost")
            ip("link set vcan1 mtu 16 up")
            events.expect(False, "the interface has no CAN FD (its MTU is 16")
            ip("link set vcan1 down")
            ip("link set vcan1 mtu 72 up")
            events.expect(True, "is back")
            assert link.outages == 1
    finally:
        ip("link set vcan1 down")
        ip("link set vcan1 mtu 72 up")


@pytest.mark.socketcan
def test_can_fd_on_classic_socketcan(vcan):
    """Told at construction where it can be told, else by the first frame."""
    with Link(interface="socketcan", channel="vcan2") as link:
        with pytest.raises(BusError, match="opened without CAN FD"):
            Transmitter(link, FakeCodec(), fd=True)
        frame = can.Message(is_fd=True, data=bytes(32))
        with pytest.raises(BusError, match="socketcan vcan2 refuses the frame: Invalid argument"):
            link.send(frame)


@pytest.mark.socketcan
def test_kernel_filters_and_local_frames(vcan):
    """Frames of other IDs stay in the kernel; those of this host's programs are heard."""
    codec = FakeCodec()
    with (
        Link(interface="socketcan", channel=vcan) as link,
        Link(interface="socketcan", channel=vcan) as other,
        Receiver(other, codec.decoder(), can_ids={0x100}) as receiver,
    ):
        send_frames(link, *[Frame(0x7FF, b"")] * 20, *codec.encode(line()))
        assert abs(receiver.get(LONG).t_ns - time.time_ns()) < LONG * 1e9
        assert receiver.stats().frames == PAGES


@pytest.mark.socketcan
def test_under_random_flapping_it_ends_up_working(vcan):
    """Down, up, deleted and made again at random times: every outage is told, then all is well."""
    rng = random.Random(7)  # noqa: S311 - not a secret
    events = []
    codec = FakeCodec()
    with (
        Link(interface="socketcan", channel=vcan) as other,
        Link(interface="socketcan", channel=vcan, on_event=lambda up, _: events.append(up)) as link,
        Receiver(other, codec.decoder()) as receiver,
        Transmitter(link, codec, period=0.002) as transmitter,
    ):
        for slot in Slot:
            transmitter.publish(line(slot))
        for _ in range(20):
            ip(f"link set {vcan} down" if rng.random() < 0.5 else f"link del {vcan}")
            if rng.random() < 0.5:
                receiver.get(rng.random() / 10)
            set_up(vcan)
        while receiver.get(0.0):
            pass
        collect(receiver, 50)
    assert events == [False, True] * link.outages


def test_frames_that_waited_do_not_make_now_earlier():
    """A process that was stopped takes its backlog: now is when it is taken, not when it came."""
    clock, second = StampClock(), 1_000_000_000
    clock.heard(100 * second, 0)
    for i in range(50):  # 2.5 s of frames, taken at once after 3 s
        clock.heard(100 * second + i * second // 20, 3 * second + i * 10_000)
        assert clock.now(3 * second) >= 103 * second - 1_000_000


def test_a_clock_that_was_set_back_is_believed_after_a_second():
    """Until then lines look older than they are; a clock set forward is believed at once."""
    clock, second = StampClock(), 1_000_000_000
    for i in range(40):
        clock.heard(100 * second + i * second // 20, i * second // 20)
    for i in range(40, 80):
        clock.heard(50 * second + i * second // 20, i * second // 20)
        believed = clock.now(i * second // 20) == 50 * second + i * second // 20
        assert believed == (i >= 61)
    clock.heard(900 * second, 4 * second)
    assert clock.now(4 * second) == 900 * second


MS = 1_000_000


def test_a_backlog_at_the_start_is_not_taken_for_new():
    """Its frames are taken at once; steady is a clock whose frames come as time goes by."""
    clock = StampClock()
    for i in range(41):  # 2 s of frames, the last of which waited for 0.9 s, in 4 ms
        clock.heard(i * 50 * MS, i * MS // 10)
        assert not clock.steady
    for i in range(41, 60):  # and then as they come, 3 s after the first
        at_ns = 3000 * MS + i * 50 * MS
        clock.heard(at_ns + 2900 * MS, at_ns)
        assert clock.steady == (i >= 45)
        assert clock.now(at_ns) == at_ns + 2900 * MS


@pytest.mark.parametrize("wait_ns", [0, 700 * MS])
def test_a_queue_that_is_never_empty_is_lived_with(wait_ns):
    """Frames without a pause, each of which waited as long, and some longer: steady in 0.2 s."""
    clock = StampClock()
    for i in range(2000):
        at_ns = i * MS // 4
        clock.heard(at_ns - wait_ns - i % 7 * 9 * MS, at_ns)
        assert clock.steady == (at_ns >= 200 * MS)


def test_a_slow_end_of_a_backlog_is_of_the_backlog():
    """A callback that takes 35 ms for a line of 50 ms."""
    clock = StampClock()
    for i in range(40):
        clock.heard(i * 50 * MS, i * 35 * MS)
        assert not clock.steady


@pytest.mark.parametrize("ppm", [-200, 200])
def test_a_clock_that_drifts_stays_steady(ppm):
    """An adapter's quartz against ours, for an hour."""
    clock = StampClock()
    for i in range(36_000):
        at_ns = i * 100 * MS
        clock.heard(at_ns + at_ns * ppm // 10**6, at_ns)
        assert clock.steady == (i >= 2)


def test_the_latest_line_of_a_link_that_was_open_before_is_not_new(channel):
    """The sender has died; then the receiver starts, and finds what waited in the queue."""
    codec = Codec.from_dbc()
    with (
        Link(interface="virtual", channel=channel) as sender,
        Link(interface="virtual", channel=channel) as late,
    ):

        def send(k, age):
            line = MapLine.mean_only(Slot.EGO_LEFT, [k / 16, 0, 0, 0])
            for frame in codec.encode(line):
                sender.send(
                    can.Message(
                        timestamp=time.time() - age,
                        arbitration_id=frame.can_id,
                        data=frame.data,
                        is_extended_id=False,
                    )
                )

        for k in range(20):
            send(k, 2 + (20 - k) * 0.05)
        with Receiver(late, codec.decoder(cycle_ms=200)) as receiver:
            for _ in range(20):
                assert receiver.get(20.0) is not None
            view = receiver.latest(Slot.EGO_LEFT)
            assert (view.line.gaussian.mean[0], view.age, view.stale) == (19 / 16, np.inf, True)
            assert not view.usable
            assert receiver.latest(Slot.EGO_LEFT, now_ns=view.line.t_ns).usable  # who knows, says
            deadline = time.monotonic() + 20.0
            for k in itertools.count(20):
                send(k, 0)
                assert receiver.get(20.0) is not None
                view = receiver.latest(Slot.EGO_LEFT)
                if view.usable:
                    break
                assert time.monotonic() < deadline
                time.sleep(0.05)
            assert k >= 24
            assert view.age < 10.0


# ---- what is encoded ahead ----------------------------------------------------------------


@given(st.lists(st.sampled_from([0.2, 0.9, 1.1, 2.7]), min_size=1, max_size=30), st.integers(1, 3))
def test_counters_have_no_gap_whatever_deadlines_are_skipped(steps, drop_every):
    """Frames that were encoded ahead and never sent do not count as lost lines."""
    codec, period, now = Codec.from_dbc(), 0.05, 100.0
    tx_queue = TxQueue(codec, period, fd=True, count=None)
    decoder = codec.decoder(cycle_ms=1e3 * period)
    for number, step in enumerate(steps):
        tx_queue.put([line(slot) for slot in (Slot.EGO_LEFT, Slot.ROUTE)], now)
        if number % drop_every == 0:
            tx_queue.drop(Slot.ROUTE)
        now += step * period
        while (transfer := tx_queue.take(now)) is not None:
            for frame in transfer.frames:
                decoder.feed(frame.can_id, frame.data, round(1e9 * now))
    assert decoder.lost == 0
    assert not any(decoder.counts.values())
