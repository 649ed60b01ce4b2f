"""A python-can bus with faults: both directions, threads, and outages."""

import errno
import itertools
import math
import queue
import threading
import time
from collections.abc import Iterator
from typing import Any

import can
import pytest
from support.fake_bus import LONG, Clock, FakeTime
from support.fault_streams import numbered

from maplines_can.bus import Link, Sent
from maplines_can.testing import (
    FaultInjector,
    FaultKind,
    Faults,
    FaultyBus,
    FaultyOpener,
)


@pytest.fixture
def channel(request: pytest.FixtureRequest) -> str:
    return f"faulty-{request.node.name}"


@pytest.fixture
def other(channel: str) -> Iterator[Any]:
    with can.Bus(interface="virtual", channel=channel) as bus:
        yield bus


@pytest.fixture
def inner(channel: str) -> Any:
    return can.Bus(interface="virtual", channel=channel)


@pytest.fixture
def clock() -> Any:
    return Clock()


def faulty(channel: Any, faults: Any, **rest: Any) -> Any:
    return FaultyBus(can.Bus(interface="virtual", channel=channel), faults, **rest)


def message(number: int = 1, can_id: int = 0x340, **rest: Any) -> Any:
    rest = {"data": bytes([number]), "is_extended_id": False, **rest}
    return can.Message(arbitration_id=can_id, **rest)


def all_of(bus: Any) -> Any:
    return list(iter(lambda: bus.recv(0), None))


def numbers(bus: Any) -> Any:
    return [m.data[0] for m in all_of(bus)]


def test_a_delayed_frame_has_a_delayed_time_stamp(channel: str, other: Any, clock: Any) -> None:
    with faulty(channel, "delay=0.5", clock=clock) as bus:
        other.send(message(7))
        assert bus.recv(0) is None
        before = bus.bus.recv(0)
        assert before is None  # the frame is held back
        clock.now += 0.5
        late = bus.recv(0)
        assert late.data[0] == 7
        stamp = late.timestamp
        other.send(message(8))
        assert bus.recv(0) is None
        clock.now += 2.0
        assert bus.recv(0).timestamp - stamp > 1.5


def test_pump_sends_delayed_frames(channel: str, other: Any, clock: Any) -> None:
    """A bus with a given clock has no thread."""
    threads = threading.active_count()
    with faulty(channel, "delay=0.5,direction=send", clock=clock) as bus:
        bus.send(message(1))
        bus.pump()
        assert numbers(other) == []
        clock.now += 0.5
        bus.pump()
        assert numbers(other) == [1]
        assert threading.active_count() == threads


def test_a_thread_sends_delayed_frames(channel: str, other: Any) -> None:
    """Without a given clock; the thread ends with the bus."""
    with faulty(channel, "delay=0.02,direction=send") as bus:
        bus.send(message(1))
        assert other.recv(LONG).data[0] == 1
        assert bus.sending.held == 0
        thread = bus._thread
    assert not thread.is_alive()


@pytest.mark.parametrize("direction", ["send", "both"])
def test_a_flood_that_is_too_fast_blocks_nothing(direction: str) -> None:
    """Sending, receiving and shutdown still work; frames that are left out are counted."""
    inner = Slow()
    bus = FaultyBus(inner, f"flood=1e6,flood_ids=5,direction={direction}")
    done = threading.Event()

    def use() -> None:
        start = time.monotonic()
        while time.monotonic() < start + 1.5:  # only the last second of a flood is made
            bus.send(message(1))
            bus.recv(0.001)
        bus.shutdown()
        done.set()

    threading.Thread(target=use, daemon=True).start()
    assert done.wait(LONG)
    counts = bus.as_dict()
    assert counts["flooded"] > 0
    assert counts["left_out"] > 0
    assert len(bus._incoming) <= 32
    if direction == "send":
        assert bus.sending.frames == inner.sent - counts["flooded"] > 0  # type: ignore[union-attr]


def test_pump_stops_during_a_flood_that_is_too_fast(clock: Any) -> None:
    """After a tenth of a second of its clock; the next call sends the rest."""
    inner = Slow()

    def running_clock() -> Any:
        clock.now += 1e-3
        return clock.now

    with FaultyBus(inner, "flood=1e5,direction=send", clock=running_clock) as bus:
        clock.now += 1.0
        start = clock.now
        bus.pump()
        assert 0.1 < clock.now - start < 0.2
        assert 0 < inner.sent < 10_000


def test_shutdown_sends_frames_that_are_held_back(channel: str, other: Any) -> None:
    bus = faulty(channel, "reorder=1,depth=1000,direction=send")
    for number in range(5):
        bus.send(message(number))
    bus.shutdown()
    bus.shutdown()
    assert sorted(numbers(other)) == [0, 1, 2, 3, 4]
    assert bus.as_dict()["held"] == bus.unsent == 0


def test_error_and_remote_frames_get_no_faults(channel: str, other: Any) -> None:
    with faulty(channel, "loss=1") as bus:
        for sender, receiver in ((bus, other), (other, bus)):
            sender.send(message(is_error_frame=True))
            sender.send(message(is_remote_frame=True, data=None))
            assert len(all_of(receiver)) == 2
        assert bus.as_dict()["frames"] == 0


def test_filters_apply_before_and_after_the_faults(channel: str, other: Any) -> None:
    """Neither a frame of another ID is received, nor one whose ID a fault has changed."""
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


def test_filters_of_the_wrapped_bus_are_kept(channel: str) -> None:
    inner = can.Bus(interface="virtual", channel=channel)
    inner.set_filters([{"can_id": 1, "can_mask": 0x7FF}])
    with FaultyBus(inner, Faults()) as bus:
        assert bus.filters == inner.filters == [{"can_id": 1, "can_mask": 0x7FF}]


class Stubborn(can.BusABC):
    """A bus whose transmit queue is full where a script says so, and which can be lost."""

    def __init__(self, *full: Any) -> None:
        super().__init__(channel="stubborn")
        self.full, self.sent = list(full), queue.SimpleQueue[Any]()
        self.gone, self._state = False, can.BusState.PASSIVE
        self.received: list[Any] = []
        self.channel_info = "stubborn"

    def send(self, msg: Any, timeout: Any = None) -> None:  # noqa: ARG002
        if self.full and self.full.pop(0):
            raise can.CanOperationError("full")
        if self.gone:
            raise OSError(errno.ENODEV, "No such device")
        self.sent.put(msg.data[0])

    def _recv_internal(self, timeout: Any) -> Any:
        if not self.received:
            time.sleep(min(timeout, 0.01))
        return (self.received.pop(0) if self.received else None), True

    def fileno(self) -> int:
        return 7

    def flush_tx_buffer(self) -> None:
        self.full = [True]

    @property
    def state(self) -> Any:
        return self._state

    @state.setter
    def state(self, new_state: Any) -> None:
        self._state = new_state


class Slow(can.BusABC):
    """A bus that always has a frame to receive, and is slow to send one."""

    def __init__(self) -> None:
        super().__init__(channel="slow")
        self.channel_info, self.sent = "slow", 0

    def send(self, msg: Any, timeout: Any = None) -> None:  # noqa: ARG002
        time.sleep(1e-5)
        self.sent += 1

    def _recv_internal(self, timeout: Any) -> Any:  # noqa: ARG002
        time.sleep(1e-5)
        return message(1, timestamp=time.time()), False


@pytest.mark.parametrize("faults", ["loss=1", "delay=60", "wrong_id=1"])
@pytest.mark.parametrize("timeout", [0, 0.1])
def test_recv_returns_after_its_timeout_on_a_busy_bus(faults: str, timeout: float) -> None:
    """Although frames keep arriving, all of which are lost or held back."""
    done = threading.Event()
    with FaultyBus(Slow(), f"{faults},direction=receive") as bus:
        bus.set_filters([{"can_id": 0x340, "can_mask": 0x7FF}])

        def use() -> None:
            assert bus.recv(timeout) is None
            done.set()

        threading.Thread(target=use, daemon=True).start()
        assert done.wait(LONG)


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
def test_a_delay_starts_at_the_time_stamp(
    age: float, left: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the frame waited for `recv`, and the stamp can be one of this clock."""
    monkeypatch.setattr("maplines_can.testing.faulty_bus.time", now := FakeTime())
    inner = Stubborn()
    with FaultyBus(inner, "delay=5,direction=receive") as bus:
        inner.received = [message(7, timestamp=now.time() - age)]
        late = bus.recv(0)
        if left:
            assert late is None
            assert bus.receiving.next_due - now.monotonic() == pytest.approx(left, abs=1e-5)  # type: ignore[union-attr]
        else:
            assert late.timestamp == pytest.approx(now.time(), abs=1e-5)  # type: ignore[union-attr]


def test_a_retried_frame_gets_its_faults_once() -> None:
    """After a full queue the same message continues where it stopped; no new faults are drawn."""
    inner = Stubborn(False, True, True)
    with FaultyBus(inner, "dup=1") as bus:
        retried = message(1)
        for _ in range(2):
            with pytest.raises(can.CanOperationError):
                bus.send(retried)
        bus.send(retried)
        assert [inner.sent.get(timeout=0) for _ in range(inner.sent.qsize())] == [1, 1]
        assert bus.counts == {FaultKind.DUPLICATED: 1}
        bus.send(retried)  # after success the same object is another frame
        assert inner.sent.qsize() == 2
        assert bus.as_dict()["frames"] == 2


def test_a_frame_that_is_given_up_is_counted() -> None:
    with FaultyBus(Stubborn(True), "dup=1") as bus:
        with pytest.raises(can.CanOperationError):
            bus.send(message(1))
        bus.send(message(2))
        assert bus.unsent == 2


def test_a_faulty_bus_has_the_properties_of_the_wrapped_bus() -> None:
    with FaultyBus(Stubborn(), "loss=1,direction=send") as bus:
        assert str(bus) == "stubborn with faults"
        assert bus.protocol is can.CanProtocol.CAN_20
        assert bus.fileno() == 7
        assert bus.state is can.BusState.PASSIVE
        bus.state = can.BusState.ACTIVE
        assert bus.bus.state is can.BusState.ACTIVE
        bus.flush_tx_buffer()
        assert bus.bus.full == [True]  # type: ignore[attr-defined]
    with FaultyBus(Stubborn(), "loss=1") as bus, pytest.raises(NotImplementedError):
        bus.fileno()


def test_random_numbers_and_counters_continue_after_an_outage(clock: Any) -> None:
    """They are those of one stream, in spite of the second bus."""
    opened = []

    def opener() -> Any:
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
    reference = FaultInjector[Any](faults, stream="send")
    for frame in numbered(total["frames"]):
        reference.apply(frame)
    assert total["lost"] == reference.counts[FaultKind.LOST]


@pytest.mark.parametrize("direction", ["send", "receive", "both"])
def test_faults_of_a_bus_can_be_set_and_cleared_at_any_time(
    inner: Any, other: Any, clock: Any, direction: str
) -> None:
    """From the next frame on, also on a bus that began without any."""
    with FaultyBus(inner, Faults(direction="send"), clock=clock) as bus:
        sent, received, number = [], [], 0
        for faults in (f"loss=1,direction={direction}", None, "loss=1", Faults(), "loss=1", None):
            bus.faults = faults
            for _ in range(3):
                bus.send(message(number))
                other.send(message(number))
                sent += numbers(other)
                received += numbers(bus)
                number += 1
        lost = {*range(3), *range(6, 9), *range(12, 15)}
        others = set(range(3))
        assert set(range(18)) - set(sent) == (lost if direction != "receive" else lost - others)
        assert set(range(18)) - set(received) == (lost if direction != "send" else lost - others)
        assert bus.counts[FaultKind.LOST] == 36 - len(sent) - len(received)
        assert bus.faults == Faults()


def test_what_is_held_back_comes_after_the_faults_are_cleared(
    inner: Any, other: Any, clock: Any
) -> None:
    with FaultyBus(inner, "delay=0.5", clock=clock) as bus:
        bus.send(message(1))
        other.send(message(2))
        assert numbers(bus) == []
        bus.faults = None
        bus.send(message(3))
        other.send(message(4))
        bus.pump()
        assert (numbers(other), numbers(bus)) == ([3], [4])
        clock.now += 0.5
        bus.pump()
        assert (numbers(other), numbers(bus)) == ([1], [2])


def test_a_flood_that_is_set_reaches_who_waits(inner: Any) -> None:
    """In another thread, which waits for a frame on a silent bus without faults."""
    with FaultyBus(inner, Faults(direction="send")) as bus:
        received = queue.SimpleQueue[Any]()
        thread = threading.Thread(target=lambda: received.put(bus.recv(LONG)))
        thread.start()
        bus.faults = "flood=1000,flood_ids=5,direction=receive"
        assert received.get(timeout=LONG).arbitration_id == 5
        thread.join()


def test_a_flood_that_is_set_is_sent(inner: Any, other: Any) -> None:
    """Without a frame of the sender; a second one after the first was cleared."""
    with FaultyBus(inner, Faults()) as bus:
        for can_id in (5, 6):
            bus.faults = f"flood=1000,flood_ids={can_id},direction=send"
            while other.recv(LONG).arbitration_id != can_id:
                pass
            bus.faults = None
            assert bus.sending is not None
            assert bus.sending.next_due == math.inf


def test_an_opener_keeps_faults_and_intervals_over_an_outage(clock: Any) -> None:
    opener = FaultyOpener("loss=1@2-3,direction=send", clock=clock)
    settings: dict[str, Any] = {"interface": "virtual", "channel": "opener-schedule"}
    start = clock.now
    with can.Bus(**settings) as other:
        for k in range(5):
            clock.now = start + k
            with opener(**settings) as bus:  # the first opening starts the injection
                bus.send(message(k))
        assert numbers(other) == [0, 1, 3, 4]
        opener.faults = "loss=1"
        with opener(**settings) as bus:
            bus.send(message(9))
            opener.faults = None
            bus.send(message(10))
        assert numbers(other) == [10]
        assert opener.faults == Faults()
        assert opener.as_dict()["lost"] == 2


@pytest.mark.parametrize("faults", [3, "loss", "loss=1@3-2"])
def test_wrong_faults_leave_those_that_there_are(inner: Any, faults: Any) -> None:
    with FaultyBus(inner, "loss=1") as bus:
        with pytest.raises((TypeError, ValueError), match="faults"):
            bus.faults = faults
        assert bus.faults == Faults(loss=1.0)
