"""The virtual clock makes calls in order of time, and its buses work as real ones do."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from typing import Any

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.fake_bus import map_line

from maplines_can import Codec, Slot
from maplines_can.bus.clock import RealClock, VirtualClock
from maplines_can.bus.periodic import PeriodicCall, QueueSending
from maplines_can.bus.tx_queue import TxQueue
from maplines_can.bus.virtual_time import VirtualCyclicTask, VirtualNetwork, VirtualTimeBus
from maplines_can.testing import FaultyBus


def message(can_id: int, data: bytes = b"", *, is_extended: bool = False) -> can.Message:
    return can.Message(arbitration_id=can_id, data=data, is_extended_id=is_extended)


@given(
    st.lists(st.tuples(st.integers(0, 50), st.booleans()), max_size=30),
    st.integers(0, 60),
)
def test_calls_are_made_in_order_of_time_and_then_of_scheduling(
    calls: list[tuple[int, bool]], end_ns: int
) -> None:
    clock, seen = VirtualClock(), []

    def note(number: int) -> None:
        seen.append((clock.now_ns, number))

    for number, (t_ns, is_cancelled) in enumerate(calls):
        handle = clock.call_at(t_ns, partial(note, number))
        if is_cancelled:
            handle.cancel()
    clock.run_until(end_ns)
    due = [(t, n) for n, (t, cancelled) in enumerate(calls) if t <= end_ns and not cancelled]
    assert seen == sorted(due)
    assert clock.now_ns == end_ns


def test_a_call_may_schedule_and_cancel_others() -> None:
    clock = VirtualClock(start_ns=100)
    seen: list[Any] = []
    later = clock.call_at(300, lambda: seen.append("cancelled"))

    def first() -> None:
        later.cancel()
        clock.call_at(clock.now_ns, lambda: seen.append(clock.now_ns))
        clock.call_at(0, lambda: seen.append(clock.now_ns))  # a time that is over: now

    clock.call_at(200, first)
    clock.run_until(1000)
    assert seen == [200, 200]
    assert clock.next_ns is None


def test_an_error_of_a_call_leaves_the_clock_usable() -> None:
    clock, seen = VirtualClock(), []

    def fail() -> None:
        raise ValueError("of the call")

    clock.call_at(1, fail)
    clock.call_at(2, lambda: seen.append(2))
    with pytest.raises(ValueError, match="of the call"):
        clock.run_until(5)
    assert clock.now_ns == 1
    clock.run_until(5)
    assert seen == [2]


@pytest.mark.parametrize("seconds", [-1.0, float("nan"), float("inf")])
def test_seconds_to_run_are_checked(seconds: float) -> None:
    with pytest.raises(ValueError, match="seconds must be 0 s or more, and finite, got"):
        VirtualClock().run_for(seconds)


def test_the_real_clock_calls_at_the_time_or_soon_after() -> None:
    clock, seen = RealClock(), []
    start_ns = clock.now_ns

    def note(ms: int) -> None:
        seen.append((ms, clock.now_ns))

    for ms in (30, 10, 20):
        clock.call_at(start_ns + ms * 1_000_000, partial(note, ms))
    clock.run_for(0.05)
    assert [ms for ms, _ in seen] == [10, 20, 30]
    assert all(t_ns >= start_ns + ms * 1_000_000 for ms, t_ns in seen)
    assert abs(clock.now - time.time()) < 1.0


def test_the_thread_of_the_real_clock_takes_calls_of_others_and_raises_their_error() -> None:
    done = threading.Event()

    def fail() -> None:
        done.set()
        raise ValueError("in the thread")

    def run() -> None:
        with RealClock() as clock:
            clock.call_at(clock.now_ns, fail)
            assert done.wait(5.0)

    with pytest.raises(ValueError, match="in the thread"):
        run()


def test_periods_of_odd_nanoseconds_do_not_drift() -> None:
    clock, seen = VirtualClock(), []
    call = PeriodicCall(clock, 33_333_333, lambda t_ns: seen.append((t_ns, clock.now_ns)))
    clock.run_for(600.0)
    assert seen == [(33_333_333 * k,) * 2 for k in range(len(seen))]
    assert len(seen) == 600_000_000_000 // 33_333_333 + 1
    call.stop()
    clock.run_for(1.0)
    assert len(seen) == 600_000_000_000 // 33_333_333 + 1


def test_missed_deadlines_are_skipped_and_counted() -> None:
    clock = VirtualClock()
    seen: list[int] = []
    call = PeriodicCall(clock, 10, seen.append, start_ns=-35)
    clock.run_until(9)
    assert (seen, call.overruns) == ([-5, 5], 3)


def test_a_queue_sends_at_its_deadlines() -> None:
    clock, sent = VirtualClock(start_ns=1_000_000_007), []
    codec = Codec.from_dbc()
    queue = TxQueue(codec, 0.05, fd=False, count=None, max_age=codec.layout.max_age)
    sending = QueueSending(clock, queue, lambda frame: sent.append((clock.now_ns, frame.can_id)))
    queue.put([map_line(slot) for slot in Slot], sending.now)
    sending.update()
    clock.run_for(1.0)
    times: dict[int, list[int]] = {}
    for t_ns, can_id in sent:
        times.setdefault(can_id, []).append(t_ns)
    assert len(times) == 8
    for stamps in times.values():
        starts = sorted(set(stamps))
        gaps = {b - a for a, b in pairwise(starts)}
        assert all(abs(gap - 50_000_000) <= 1 for gap in gaps)
        assert len(starts) >= 20
    sending.stop()
    count = len(sent)
    clock.run_for(1.0)
    assert len(sent) == count


def test_a_frame_without_a_bit_rate_arrives_at_once_with_the_time_of_the_clock() -> None:
    clock = VirtualClock(start_ns=2_500_000_000)
    network = VirtualNetwork(clock)
    with VirtualTimeBus(network) as a, VirtualTimeBus(network) as b, VirtualTimeBus(network) as c:
        sent = message(0x123, b"abc")
        a.send(sent)
        for bus in (b, c):
            received = bus.recv(0)
            assert received is not None
            assert received.equals(sent, timestamp_delta=None, check_direction=False)
            assert (received.timestamp, received.is_rx) == (2.5, True)
        assert a.recv(0) is None


def test_recv_lets_the_time_pass() -> None:
    clock = VirtualClock()
    network = VirtualNetwork(clock)
    with VirtualTimeBus(network) as a, VirtualTimeBus(network) as b:
        clock.call_at(300_000_000, lambda: a.send(message(1)))
        assert b.recv(0.2) is None
        assert clock.now_ns == 200_000_000
        received = b.recv(0.2)
        assert received is not None
        assert received.timestamp == 0.3
        assert clock.now_ns == 300_000_000
        with pytest.raises(can.CanOperationError, match="no frame can arrive any more"):
            b.recv()


def test_listeners_are_called_at_the_time_of_the_frame_and_cannot_wait() -> None:
    clock, seen = VirtualClock(), []
    network = VirtualNetwork(clock)
    with VirtualTimeBus(network) as a, VirtualTimeBus(network) as b:
        b.add_listener(lambda m: seen.append((clock.now, m.timestamp, b.recv(0))))
        clock.call_at(5_000_000, lambda: a.send(message(1)))
        clock.run_for(0.1)
        assert seen == [(0.005, 0.005, None)]
        b.add_listener(lambda _: b.recv(1.0))
        clock.call_at(0, lambda: a.send(message(1)))
        with pytest.raises(RuntimeError, match="inside its own calls"):
            clock.run_for(0.1)


def test_filters_and_own_messages() -> None:
    network = VirtualNetwork(VirtualClock())
    filters: can.typechecking.CanFilters = [{"can_id": 2, "can_mask": 0x7FF}]
    with (
        VirtualTimeBus(network, receive_own_messages=True) as a,
        VirtualTimeBus(network, can_filters=filters) as b,
    ):
        for number in (1, 2):
            a.send(message(number))
        own = [m.is_rx for m in iter(lambda: a.recv(0), None)]
        others = [m.arbitration_id for m in iter(lambda: b.recv(0), None)]
    assert (own, others) == ([False, False], [2])
    with pytest.raises(can.CanOperationError, match="shut down"):
        a.send(message(1))


def test_arbitration_and_time_on_the_wire() -> None:
    clock, seen = VirtualClock(), []
    network = VirtualNetwork(clock, bitrate=500_000)
    a, b, c = (VirtualTimeBus(network) for _ in range(3))
    c.add_listener(lambda m: seen.append((m.arbitration_id, clock.now_ns)))
    for can_id in (0x300, 0x100):
        a.send(message(can_id, bytes(8)))
    b.send(message(0x200 << 18, bytes(8), is_extended=True))
    clock.run_for(0.01)
    # 135 and 160 bits at 2 us
    assert seen == [(0x200 << 18, 320_000), (0x300, 590_000), (0x100, 860_000)]
    for bus in (a, b, c):
        bus.shutdown()


def test_send_periodic_of_a_virtual_bus() -> None:
    clock = VirtualClock()
    network = VirtualNetwork(clock)
    with VirtualTimeBus(network) as a, VirtualTimeBus(network) as b:

        def add_one(m: can.Message) -> None:
            m.data[0] += 1

        task = a.send_periodic(message(1, b"\0"), 0.01, duration=0.05, modifier_callback=add_one)
        got = [(round(m.timestamp, 6), m.data[0]) for m in iter(lambda: b.recv(0.02), None)]
        assert got == [(0.01 * k, k + 1) for k in range(5)]
        assert isinstance(task, VirtualCyclicTask)
        task.start()
        clock.run_for(0.01)
        task.stop()
        clock.run_for(0.1)
        assert len(list(iter(lambda: b.recv(0), None))) == 2


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"bitrate": 0}, "bitrate must be positive"),
        ({"bitrate": 500_000, "data_bitrate": float("nan")}, "data_bitrate must be positive"),
        ({"data_bitrate": 2_000_000}, "needs a bitrate"),
    ],
)
def test_bit_rates_are_checked(settings: dict[str, float], text: str) -> None:
    with pytest.raises(ValueError, match=text):
        VirtualNetwork(VirtualClock(), **settings)


def test_a_notifier_is_refused_when_it_is_made() -> None:
    """Its thread would let the time pass; a bus with faults, and a proxy, are no way around."""
    clock = VirtualClock()
    network = VirtualNetwork(clock)
    with VirtualTimeBus(network) as plain, FaultyBus(VirtualTimeBus(network), "loss=0.1") as faulty:
        for bus in (plain, faulty):
            with pytest.raises(TypeError, match=r"can.Notifier cannot .* bus.add_listener"):
                can.Notifier(bus, [])
    assert clock.now_ns == 0


def test_one_thread_lets_the_time_pass() -> None:
    """The first one, as long as it lives: a second one would make the result a matter of luck."""
    clock = VirtualClock()
    network = VirtualNetwork(clock)
    go_on, is_first = threading.Event(), threading.Event()

    def first() -> None:
        clock.run_for(1.0)
        is_first.set()
        go_on.wait()

    thread = threading.Thread(target=first, name="reader")
    thread.start()
    is_first.wait()
    with VirtualTimeBus(network) as bus:
        calls: tuple[Callable[[], object], ...] = (
            lambda: clock.run_for(1.0),
            lambda: bus.recv(timeout=0.1),
            bus.recv,
        )
        for call in calls:
            with pytest.raises(RuntimeError, match="run by one thread, 'reader' here"):
                call()
        assert clock.now == 1.0
        go_on.set()
        thread.join()
        clock.run_for(1.0)
    assert clock.now == 2.0
