"""A link reports each outage and reconnect once, and reopens the same interface."""

import errno
import gc
import io
import itertools
import logging
import random
import threading
from typing import Any

import can
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.fake_bus import (
    FRAME,
    FULL,
    GONE,
    LONG,
    NO_NUMBER,
    Clock,
    FakeBus,
    FakeOpener,
    collect,
    map_line,
)
from support.fake_codec import PAGES, FakeCodec
from support.kernel_can import Events, ip, set_up

from maplines_can.bus import (
    Link,
    Receiver,
    Sent,
    Transmitter,
)
from maplines_can.values.errors import BusError
from maplines_can.values.line import Slot


def test_an_outage_and_the_reconnect_are_each_reported_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """One warning and one event each, however often sending fails in between."""
    opener, clock, events = FakeOpener(None, GONE), Clock(), []
    with Link(opener, on_event=lambda up, text: events.append((up, text)), clock=clock) as link:
        assert link.send(FRAME) is Sent.OK
        assert link.send(FRAME) is Sent.DOWN
        assert not opener.opened[0].open
        opener.cannot_open = True
        for _ in range(50):
            clock.now += 0.1
            assert link.send(FRAME) is Sent.DOWN
            assert link.recv(0.0) is None
        assert (link.up, link.outages) == (False, 1)
        opener.cannot_open = False
        clock.now += 1.0
        assert link.send(FRAME) is Sent.OK
        assert link.send(FRAME) is Sent.OK
        assert (link.up, link.outages) == (True, 1)

    assert [up for up, _ in events] == [False, True]
    assert events[0][1] == ("fake is lost (No such device); it is reopened as soon as it is back")
    assert events[1][1] == "fake is back after 6.0 s"
    assert [text for _, text in events] == caplog.messages


#: What a bus raises; what concerns a frame of the caller is raised by `send`, see below.
ERRORS = {
    "full": FULL,
    "late": can.CanTimeoutError(),
    "unclear": NO_NUMBER,
    "gone": GONE,
    "closed": io.UnsupportedOperation("not writable"),  # a ValueError, too
}
OF_A_FRAME = {"refused": can.CanOperationError("Failed", errno.EINVAL), "odd": ValueError("odd")}
STEPS = st.lists(
    st.tuples(
        st.sampled_from([("send", each) for each in ("ok", *ERRORS)])
        | st.sampled_from([("recv", each) for each in ("ok", *ERRORS, *OF_A_FRAME)]),
        st.sampled_from([0.0, 0.125, 0.5, 1.0]),
        st.booleans(),
    ),
    max_size=50,
)


@settings(max_examples=300)
@given(STEPS)
def test_the_states_of_a_link_are_those_of_its_rules(steps: list[Any]) -> None:
    """Whatever a driver does: a full queue is no outage, an unclear error is one after a second.

    Opening is no evidence (SocketCAN opens what is down): the first success is. Attempts to open
    back off, and begin anew after it. An outage lasts from the first failure.
    """
    opener, clock, events = FakeOpener(), Clock(), list[str]()
    is_open, up, outages, lost_at, opened = True, True, 0, 0.0, 1
    retry_at, pause, since, expected = 0.0, 0.125, dict[str, float](), list[str]()
    with Link(
        opener, on_event=lambda _, text: events.append(text), clock=clock, backoff=(0.125, 1.0)
    ) as link:
        for (way, what), wait, opener.cannot_open in steps:
            clock.now += wait
            opener.script[:] = [(ERRORS | OF_A_FRAME).get(what)]
            answer = link.send(FRAME) if way == "send" else link.recv(0.0)
            result = Sent.DOWN
            if not is_open and clock.now >= retry_at:
                is_open = not opener.cannot_open
                opened += is_open
                if not is_open:
                    retry_at, pause = clock.now + pause, min(2 * pause, 1.0)
            if is_open and what == "ok":
                result = Sent.OK
                since.pop(way, None)
                if not up:
                    up, pause = True, 0.125
                    expected.append(f"fake is back after {clock.now - lost_at:.1f} s")
            elif is_open:
                result = Sent.FULL
                lasts = 0.0
                if what not in ("full", "late", "gone", "closed"):
                    lasts = clock.now - since.setdefault(way, clock.now)
                if what in ("gone", "closed") or lasts >= Link.UNCLEAR_TIMEOUT:
                    result, is_open = Sent.DOWN, False
                    retry_at, pause = clock.now + pause, min(2 * pause, 1.0)
                    since.clear()
                    if up:
                        up, outages, lost_at = False, outages + 1, clock.now
                        expected.append("fake is lost (")
            assert answer is (result if way == "send" else None)
            assert (link.up, link.outages, len(opener.opened)) == (up, outages, opened)
            assert len(events) == len(expected)
            assert all(map(str.startswith, events, expected))


def test_the_error_of_a_bus_that_another_thread_has_closed_is_ignored() -> None:
    """Closing a socket makes its reader fail, too: this is one outage, not two."""
    clock = Clock()
    with Link(FakeOpener(GONE), clock=clock) as link:
        old = link._bus
        link.send(FRAME)
        clock.now += 1.0
        assert link.send(FRAME) is Sent.OK
        assert link._failed(old, ValueError("file descriptor cannot be -1"), "recv") is Sent.DOWN  # type: ignore[arg-type]
        assert (link.up, link.outages) == (True, 1)


@pytest.mark.parametrize(
    ("raised", "error", "words"),
    [
        (can.CanOperationError("", errno.EINVAL), BusError, r"fake refuses the frame: .*fd=True"),
        (ValueError("no such frame"), ValueError, "no such frame"),
    ],
)
def test_a_frame_that_can_never_be_sent_raises(raised: Any, error: Any, words: str) -> None:
    with Link(FakeOpener(raised)) as link, pytest.raises(error, match=words):
        link.send(FRAME)


def test_a_closed_link_raises(channel: str) -> None:
    link = Link(interface="virtual", channel=channel)
    link.close()
    link.close()
    for use in (lambda: link.send(FRAME), lambda: link.recv(0.0)):
        with pytest.raises(BusError, match=r"virtual test-.* is closed; stop its users before"):
            use()


def test_each_bus_has_the_filters_of_now() -> None:
    """Also one that is opened after an outage, in which other ones were set; none lets all pass."""
    opener, clock = FakeOpener(), Clock()
    with Link(opener, clock=clock) as link:
        link.accept_only({0x101, 0x100})
        for ids in ([0x100, 0x101], [0x348]):
            opener.script[:] = [GONE]
            assert link.send(FRAME) is Sent.DOWN
            link.accept_only(ids)
            clock.now += 2.0
            assert link.send(FRAME) is Sent.OK
            filters = [{"can_id": can_id, "can_mask": 0x1FFFFFFF} for can_id in ids]
            assert opener.opened[-1].filters == filters
        assert opener.opened[0].filters == opener.opened[1].filters
        link.accept_only(None)
        assert opener.opened[-1].filters is None


class Unfiltered(FakeBus):
    """A bus whose driver fails to set filters."""

    def _apply_filters(self, filters: Any) -> None:
        if filters:
            raise GONE


def test_a_bus_that_cannot_be_filtered_counts_as_lost() -> None:
    """It would let frames of other IDs pass. It is shut down, and the reason is reported once."""
    clock, events = Clock(), []
    buses: list[FakeBus] = []

    def opener() -> FakeBus:
        buses.append(Unfiltered() if len(buses) < 3 else FakeBus())
        return buses[-1]

    with Link(opener, on_event=lambda up, text: events.append((up, text)), clock=clock) as link:
        link.accept_only({0x100})
        for _ in range(3):
            assert [bus.open for bus in buses] == [False] * len(buses)
            assert not link.up
            clock.now += 2.0
            link.send(FRAME)
        assert buses[-1].filters == [{"can_id": 0x100, "can_mask": 0x1FFFFFFF}]
        assert (len(buses), link.outages) == (4, 1)
    assert events == [
        (False, "fake is lost (its filters cannot be set: No such device); it is reopened as soon "
         "as it is back"),
        (True, "fake is back after 6.0 s"),
    ]  # fmt: skip


@pytest.mark.socketcan
@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("how", ["down", "delete"])
def test_a_socketcan_interface_is_lost_and_reopened(
    vcan: str, fd: bool, how: str, caplog: pytest.LogCaptureFixture
) -> None:
    """Each link reports the outage and the reconnect once."""
    sender_events, receiver_events = Events(), Events()
    settings = {"interface": "socketcan", "channel": vcan, "fd": fd}
    codec, decoder = FakeCodec(), FakeCodec().decoder()
    caplog.set_level(logging.WARNING)
    with (
        Link(**settings, on_event=sender_events) as link,  # type: ignore[arg-type]
        Link(**settings, on_event=receiver_events) as other,  # type: ignore[arg-type]
        Receiver(other, decoder) as receiver,
        Transmitter(link, codec, period=0.005, fd=fd) as transmitter,  # type: ignore[arg-type]
    ):
        for slot in Slot:
            transmitter.publish(map_line(slot))
        collect(receiver, 20)
        for _ in range(2):
            ip(f"link set {vcan} down" if how == "down" else f"link del {vcan}")
            # The socket reports an error, or the link first finds that the interface is gone.
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
def test_no_transfer_is_resumed_after_an_outage(vcan: str) -> None:
    """An independent socket sees whole transfers, and none that the outage interrupted."""
    events, raw = Events(), can.Bus(interface="socketcan", channel=vcan)
    with (
        Link(interface="socketcan", channel=vcan, on_event=events) as link,
        Transmitter(link, FakeCodec(), period=0.002) as transmitter,  # type: ignore[arg-type]
    ):
        for slot in Slot:
            transmitter.publish(map_line(slot))
        for _ in range(5):
            seen = [raw.recv(LONG).data[:3] for _ in range(101)]  # type: ignore[union-attr]
            assert seen[0][0] == 0  # raw was open before the first frame
            for old, new in itertools.pairwise(seen):
                same = old[1:] == new[1:]
                assert new[0] == (old[0] + 1 if same else 0)
                assert same or old[0] == PAGES - 1
            ip(f"link set {vcan} down")
            events.expect(False, "lost")
            raw.shutdown()
            raw = can.Bus(interface="socketcan", channel=vcan)  # open before the reconnect
            with pytest.raises(can.CanOperationError):
                raw.recv(0.0)
            ip(f"link set {vcan} up")
            events.expect(True, "back")
    raw.shutdown()


@pytest.mark.socketcan
def test_can_fd_on_classic_socketcan(vcan: str) -> None:
    """The transmitter raises at construction, the link at the first frame."""
    with Link(interface="socketcan", channel="vcan2") as link:
        with pytest.raises(BusError, match="opened without CAN FD"):
            Transmitter(link, FakeCodec(), fd=True)  # type: ignore[arg-type]
        frame = can.Message(is_fd=True, data=bytes(32))
        with pytest.raises(BusError, match="socketcan vcan2 refuses the frame: Invalid argument"):
            link.send(frame)


@pytest.mark.socketcan
@pytest.mark.filterwarnings("ignore:unclosed <socket:ResourceWarning")
def test_a_link_survives_random_outages(vcan: str) -> None:
    """Set down or deleted at random times: each outage is reported, and in the end it works."""
    rng = random.Random(7)  # noqa: S311 - not a secret
    events = []
    codec = FakeCodec()
    with (
        Link(interface="socketcan", channel=vcan) as other,
        Link(interface="socketcan", channel=vcan, on_event=lambda up, _: events.append(up)) as link,
        Receiver(other, codec.decoder()) as receiver,
        Transmitter(link, codec, period=0.01) as transmitter,  # type: ignore[arg-type]
    ):
        for slot in Slot:
            transmitter.publish(map_line(slot))
        for _ in range(20):
            ip(f"link set {vcan} down" if rng.random() < 0.5 else f"link del {vcan}")
            if rng.random() < 0.5:
                receiver.get(rng.random() / 10)
            set_up(vcan)
        while receiver.get(0.0):
            pass
        collect(receiver, 50)
    assert events == [False, True] * link.outages
    # python-can does not close its socket if the interface goes down between our check and bind.
    gc.collect()


@pytest.mark.parametrize("settings", [{}, {"interface": "virtual", "channel": "x"}])
def test_sending_does_not_wait(settings: Any) -> None:
    """The virtual bus takes None for "for ever", other drivers for "not at all"."""
    timeouts = []

    class Timed(FakeBus):
        def send(self, msg: Any, timeout: Any = None) -> None:  # noqa: ARG002
            timeouts.append(timeout)

    with Link(lambda **_: Timed(), **settings) as link:
        link.send(FRAME)
    (timeout,) = timeouts
    assert (0 < timeout < 0.1) if settings else (timeout is None)


def test_closing_ends_a_wait_for_the_interface() -> None:
    """In `recv`, by any thread."""
    link = Link(FakeOpener(GONE), backoff=(LONG, LONG))
    link.send(FRAME)
    waits, wait_for = threading.Event(), link._lock.wait_for

    def waiting(condition: Any, timeout: Any) -> Any:
        waits.set()  # under the lock, which only the wait releases
        return wait_for(condition, timeout)

    link._lock.wait_for = waiting  # type: ignore[method-assign, assignment]
    thread = threading.Thread(target=link.recv, args=(LONG,), daemon=True)
    thread.start()
    assert waits.wait(LONG)
    link.close()
    thread.join(LONG / 4)
    assert not thread.is_alive()


@pytest.mark.parametrize(
    ("script", "expected"),
    [
        ([], (Sent.OK, 3)),
        ([FULL], (Sent.FULL, 0)),
        ([None, None, FULL], (Sent.FULL, 2)),
        ([None, GONE], (Sent.DOWN, 1)),
    ],
)
def test_several_frames_are_handed_over_until_one_is_not_taken(script: Any, expected: Any) -> None:
    """The first ones stay sent, in their order, and none follows the one that failed."""
    messages = [can.Message(arbitration_id=i) for i in range(3)]
    with Link(opener := FakeOpener(*script)) as link:
        assert link.send_all(messages) == expected
    sent = [opener.sent.get(timeout=0).arbitration_id for _ in range(opener.sent.qsize())]
    assert sent == list(range(expected[1]))


def test_a_frame_that_is_sent_before_an_outage_shows_that_the_interface_was_back() -> None:
    """Both are reported, in this order."""
    events: list[bool] = []
    clock, opener = Clock(), FakeOpener(GONE, None, GONE)
    with Link(opener, clock=clock, on_event=lambda up, _: events.append(up)) as link:
        assert link.send_all([FRAME]) == (Sent.DOWN, 0)
        clock.now += 1.0
        assert link.send_all([FRAME, FRAME]) == (Sent.DOWN, 1)
        assert (events, link.outages) == ([False, True, False], 2)
