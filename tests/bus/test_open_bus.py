"""A python-can bus that is open is used as it is, and remains its owner's (item 3)."""

import threading
import time
from typing import Any

import can
import pytest
from support.dbcs import new_codec
from support.fake_bus import (
    FRAME,
    GONE,
    LONG,
    Clock,
    FakeBus,
    FakeOpener,
    collect,
    map_line,
)
from support.fake_codec import FakeCodec
from support.kernel_can import Events, ip

from maplines_can.bus import Link, Receiver, Sent, Transmitter
from maplines_can.values.line import Slot
from maplines_can.wire import Codec

HOUR_MS = 3_600_000  #: a time-out of the reassembly that no busy machine exceeds


@pytest.mark.parametrize("kind", [can.Bus, can.ThreadSafeBus])
@pytest.mark.parametrize("fd", [False, True])
def test_item_3_lines_pass_over_buses_that_are_open(channel: str, kind: Any, fd: bool) -> None:
    """They are still open afterwards."""
    codec = new_codec()
    with (
        kind(interface="virtual", channel=channel) as out,
        kind(interface="virtual", channel=channel) as back,
    ):
        with Receiver(back, codec.decoder(timeout_ms=HOUR_MS)) as receiver:
            transmitter = Transmitter(out, codec, period=0.02, fd=fd, count=3)
            transmitter.publish([map_line(slot, y=slot / 8) for slot in Slot])
            with transmitter:
                assert transmitter.wait(LONG)
            sent = transmitter.stats()
            lines = collect(receiver, sent.lines)
        out.send(can.Message(arbitration_id=min(codec.can_ids), is_extended_id=False))
        assert back.recv(LONG)

    assert sent.lines == 8 * 3 - sent.overruns > 0
    assert receiver.stats().frames == sent.frames == sent.lines * (1 if fd else 4)
    assert {line.slot for line in lines} <= set(Slot)
    assert all(line.gaussian.mean[0] == line.slot / 8 for line in lines)


@pytest.mark.parametrize("wrong", [None, "vcan0", can.Bus, FakeOpener(), Codec, 7])
def test_item_3_anything_else_is_refused_by_name(wrong: Any) -> None:
    codec = FakeCodec()
    words = r"link must be a maplines_can.Link or an open python-can bus, such as can.Bus\("
    for make in (
        lambda: Transmitter(wrong, codec),  # type: ignore[arg-type]
        lambda: Receiver(wrong, codec.decoder()),
    ):
        with pytest.raises(TypeError, match=words):
            make()


def test_wrong_arguments_of_a_link_raise() -> None:
    with pytest.raises(TypeError, match="an open bus takes no settings, got channel"):
        Link(FakeBus(), channel="can0")
    with pytest.raises(TypeError, match=r"opener must be an open python-can bus .* got 'can0'"):
        Link("can0")  # type: ignore[arg-type]


def test_a_given_bus_is_never_shut_down_and_tried_again_after_an_outage() -> None:
    """The error is reported once; sends count as down until the bus works again."""
    bus, clock, events = FakeBus([None, GONE, GONE, GONE]), Clock(), []
    with Link(bus, on_event=lambda up, text: events.append((up, text)), clock=clock) as link:
        assert (link.name, link.fd) == ("fake", False)
        results = []
        for _ in range(5):
            results.append(link.send(FRAME))
            clock.now += 2.0
        assert results == [Sent.OK, Sent.DOWN, Sent.DOWN, Sent.DOWN, Sent.OK]
        assert link.outages == 1
    assert bus.open
    assert events == [
        (False, "fake is lost (No such device); it is tried again, but not reopened, because "
         "the caller opened it"),
        (True, "fake is back after 6.0 s"),
    ]  # fmt: skip


def test_a_bus_that_its_owner_shuts_down_is_reported_once(channel: str) -> None:
    """Neither thread ends with an error, and nothing is raised."""
    bus, clock, events = can.Bus(interface="virtual", channel=channel), Clock(), []
    with Link(bus, on_event=lambda up, _: events.append(up), clock=clock) as link:
        bus.shutdown()
        for _ in range(10):
            assert link.recv(0.0) is None
            assert link.send(FRAME) is not Sent.OK
            clock.now += 0.6
    assert events == [False]


class Exclusive(FakeBus):
    """A bus that notices if two threads send at the same time."""

    def __init__(self) -> None:
        super().__init__()
        self.busy, self.overlaps = threading.Lock(), 0

    def send(self, msg: Any, timeout: Any = None) -> None:
        if not self.busy.acquire(blocking=False):
            self.overlaps += 1
            return
        time.sleep(1e-5)  # lets the other thread run
        super().send(msg, timeout)
        self.busy.release()


def test_all_links_of_a_bus_send_in_turn() -> None:
    bus, frames = Exclusive(), 500

    def send() -> None:
        link = Link(bus)
        for _ in range(frames):
            link.send(FRAME)

    threads = [threading.Thread(target=send) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (bus.overlaps, bus.sent.qsize()) == (0, 3 * frames)


@pytest.mark.socketcan
def test_a_given_socket_works_again_unless_its_interface_was_deleted(vcan: str) -> None:
    """The kernel binds a socket to the interface, not to its name."""
    events = Events()
    codec: Any = FakeCodec()
    with (
        can.Bus(interface="socketcan", channel=vcan) as bus,
        can.Bus(interface="socketcan", channel=vcan) as other,
    ):
        link = Link(bus, on_event=events)
        with (
            Receiver(other, codec.decoder()) as receiver,
            Transmitter(link, codec, period=0.005) as transmitter,
        ):
            transmitter.publish(map_line())
            collect(receiver, 5)
            ip(f"link set {vcan} down")
            events.expect(False, "is lost (")
            while receiver.get(0.0):
                pass
            ip(f"link set {vcan} up")
            events.expect(True, "is back after")
            collect(receiver, 5)
            ip(f"link del {vcan}")
            events.expect(False, "is lost (")
        assert transmitter.stats().down > 0
        ip(f"link add dev {vcan} type vcan")
        ip(f"link set {vcan} up")
        link._retry_at = 0.0  # as if the pause were over
        assert link.send(FRAME) is Sent.DOWN
        assert (link.up, link.outages) == (False, 2)


def test_a_given_bus_gets_its_own_filters_back(channel: str) -> None:
    """After stop, and also if it had filters of its own."""
    for own in (None, [{"can_id": 1, "can_mask": 0x7FF}]):
        with (
            can.Bus(interface="virtual", channel=channel, can_filters=own) as bus,
            can.Bus(interface="virtual", channel=channel) as other,
        ):
            with Receiver(bus, new_codec().decoder()):
                assert {entry["can_id"] for entry in bus.filters or ()} > {832}
            assert bus.filters == own
            with Receiver(bus, new_codec().decoder(), can_ids=None):
                assert bus.filters == own
            assert bus.filters == own
            other.send(can.Message(arbitration_id=1, is_extended_id=False))
            assert bus.recv(LONG) is not None
