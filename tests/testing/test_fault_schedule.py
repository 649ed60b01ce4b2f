"""Faults are active in their intervals, and can be set and cleared while frames flow."""

import math
import queue
import threading
from collections.abc import Iterator
from typing import Any

import can
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.fake_bus import LONG, Clock

from maplines_can.testing import (
    FaultInjector,
    FaultKind,
    Faults,
    FaultyBus,
    FaultyOpener,
    Interval,
    ScriptedFault,
)
from maplines_can.wire import Frame

TIMES = st.floats(0, 20) | st.integers(0, 20).map(float)
INTERVALS = st.lists(
    st.tuples(TIMES, TIMES | st.just(math.inf)).filter(lambda t: t[0] < t[1]),
    min_size=1,
    max_size=4,
)


def message(number: int, **rest: Any) -> Any:
    return can.Message(arbitration_id=0x340, data=[number % 256], is_extended_id=False, **rest)


@pytest.fixture
def clock() -> Any:
    return Clock()


@pytest.fixture
def other(request: pytest.FixtureRequest) -> Iterator[Any]:
    with can.Bus(interface="virtual", channel=request.node.name) as bus:
        yield bus


@pytest.fixture
def inner(request: pytest.FixtureRequest) -> Any:
    return can.Bus(interface="virtual", channel=request.node.name)


def numbers(bus: Any) -> list[int]:
    return [m.data[0] for m in iter(lambda: bus.recv(0), None)]


@pytest.mark.parametrize(
    ("text", "schedule"),
    [
        ("loss=1@2.0-2.6", [("loss", 2.0, 2.6)]),
        ("dup=0.5@0-.5", [("duplicate", 0.0, 0.5)]),
        ("loss=1@1e-3-2.", [("loss", 0.001, 2.0)]),
        ("flood=1000@5-, seed=3", [("flood", 5.0, math.inf)]),
        ("loss=1@2-3+5-6", [("loss", 2.0, 3.0), ("loss", 5.0, 6.0)]),
        ("delay=0.02@1-2,jitter=0.01@1-2", [("delay", 1.0, 2.0), ("jitter", 1.0, 2.0)]),
        (
            "corrupt=0.4@1-2",
            [(name, 1.0, 2.0) for name in ("flip", "truncate", "wrong_dlc", "wrong_id")],
        ),
    ],
)
def test_intervals_from_text(text: str, schedule: list[Any]) -> None:
    assert Faults.parse(text).schedule == tuple(Interval(*one) for one in schedule)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        pytest.param("loss=1@", "such as loss=1@2.0-2.6, got '1@'", id="none"),
        pytest.param("loss=1@2", "must be @FROM-TO or @FROM- [s]", id="one-time"),
        pytest.param("loss=1@-2", "must be @FROM-TO", id="no-begin"),
        pytest.param("loss=1@-2--1", "must be @FROM-TO", id="negative"),
        pytest.param("loss=1@a-b", "got '1@a-b'", id="no-numbers"),
        pytest.param("loss=1@2-3+", "must be @FROM-TO", id="plus"),
        pytest.param("loss=1@2-3@4-5", "must be @FROM-TO", id="twice"),
        pytest.param("loss=1@nan-2", "must be @FROM-TO", id="nan"),
        pytest.param(
            "loss=1@2.6-2.0",
            "interval of loss must have 0 <= begin < end [s], got 2.6 to 2",
            id="back",
        ),
        pytest.param("dup=1@2-2", "interval of duplicate must have 0 <= begin", id="empty"),
        pytest.param("loss=2@1-2", "loss must be in [0, 1], got 2", id="value"),
        pytest.param("loss=@1-2", "loss must be a number, got ''", id="no-value"),
        pytest.param("loss=0@1-2", "loss has an interval but is 0", id="zero"),
        pytest.param("seed=7@1-2", "seed cannot have an interval; loss, duplicate", id="seed"),
        pytest.param("direction=send@1-2", "direction cannot have an interval", id="direction"),
        pytest.param("flood=1,flood_ids=5@1-2", "flood_ids cannot have an interval", id="ids"),
        pytest.param("lost=1@1-2", "'lost' is unknown; use loss", id="unknown"),
        pytest.param("schedule=1", "'schedule' is unknown; use loss", id="schedule"),
        pytest.param("loss=1@1-2,loss=0.1", "loss is given twice", id="two-values"),
        pytest.param(
            "flip=0.6@1-3,garbage=0.6@2-4",
            "garbage must be 1 at most, got 1.2",
            id="sum-of-overlap",
        ),
    ],
)
def test_a_wrong_interval_raises(text: str, words: str) -> None:
    with pytest.raises(ValueError, match="faults: ") as caught:
        Faults.parse(text)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("schedule", [3, [3], [("loss", "a", "b")], [("loss", 1.0)], ["loss"]])
def test_a_schedule_of_a_wrong_type_raises(schedule: Any) -> None:
    with pytest.raises(TypeError, match="faults: schedule must"):
        Faults(loss=1.0, schedule=schedule)


def test_damage_of_one_time_after_the_other_may_sum_up_to_more() -> None:
    faults = Faults.parse("flip=0.6@1-2,garbage=0.6@2-4")
    assert (faults.at(1.5).garbage, faults.at(2.0).flip) == (0.0, 0.0)


@given(intervals=INTERVALS, times=st.lists(TIMES, min_size=1), start=st.floats(-1e3, 1e3))
def test_a_frame_is_lost_in_an_interval_and_only_there(
    intervals: list[Any], times: list[float], start: float
) -> None:
    """Whatever the intervals, which may overlap, from `start` on."""
    injector = FaultInjector[Any](Faults(loss=1.0, schedule=[("loss", *i) for i in intervals]))  # type: ignore[arg-type]
    injector.start(start)
    for elapsed in sorted(times):
        now = start + elapsed
        lost = any(begin <= now - start < end for begin, end in intervals)
        assert bool(injector.apply(Frame(1, b""), now)) != lost


@given(intervals=INTERVALS, calls=st.lists(st.floats(0.01, 0.9), min_size=1, max_size=30))
def test_a_flood_flows_in_its_intervals_and_only_there(
    intervals: list[Any], calls: list[float]
) -> None:
    """10 frames a second, however often it is called; the time of each is `next_due`."""
    faults = Faults(flood=10.0, schedule=[("flood", *i) for i in intervals])  # type: ignore[arg-type]
    injector, now, due = FaultInjector[Any](faults), 0.0, []
    injector.start(now)
    for wait in calls:
        now += wait
        while injector.next_due <= now:
            due.append(injector.next_due)
            assert len(injector.due(injector.next_due)) == 1
    assert all(any(b < t < e for b, e in intervals) for t in due)
    expected = sum(
        math.ceil(10 * (min(end, now) - begin) - 1 - 1e-9)
        for begin, end in faults.intervals("flood")
        if begin < now
    )
    assert len(due) == pytest.approx(max(expected, 0), abs=len(intervals))
    assert injector.left_out == 0
    assert injector.counts[FaultKind.FLOODED] == len(due)


def test_a_flood_that_nobody_asked_for_is_left_out_in_its_intervals_only() -> None:
    """10 frames a second from 1 s to 2 s and from 5 s on, asked for at 7 s."""
    injector = FaultInjector[Any](Faults.parse("flood=10@1-2+5-"))
    injector.start(0.0)
    made = injector.due(7.0)
    assert len(made) + injector.left_out == pytest.approx(9 + 20, abs=1)
    assert len(made) == pytest.approx(10, abs=1)


def test_the_injection_starts_with_the_first_frame() -> None:
    injector = FaultInjector[Any](Faults.parse("loss=1@1-2"))
    passed = [bool(injector.apply(Frame(1, b""), 1e6 + 0.25 * k)) for k in range(12)]
    assert passed == [not 4 <= k < 8 for k in range(12)]


def test_new_faults_begin_anew_and_the_counters_go_on() -> None:
    """Seed, intervals and the frames of the script; frames that are held back remain so."""
    script = (ScriptedFault(FaultKind.LOST, 2, 2),)
    faults = Faults(delay=900.0, schedule=(Interval("delay", 0.0, 1.0),), script=script)
    injector = FaultInjector[Any](faults)
    for _ in range(2):
        begin = injector.frames
        assert [bool(injector.apply(Frame(k, b""), 10.0 * begin)) for k in range(2)] == [False] * 2
        assert injector.apply(Frame(9, b""), 10.0 * begin + 1.0)
        injector.faults = faults
    assert (injector.frames, injector.held) == (6, 2)
    assert injector.counts == {FaultKind.LOST: 2, FaultKind.DELAYED: 2}
    injector.faults = Faults()
    assert [frame.can_id for frame in injector.apply(Frame(5, b""), 1e3)] == [0, 0, 5]
    same = [FaultInjector[Any](Faults.parse("loss=0.5,seed=4")) for _ in range(2)]
    same[1].apply(Frame(1, b""))
    same[1].faults = same[1].faults
    answers = [[bool(one.apply(Frame(1, b""))) for _ in range(50)] for one in same]
    assert answers[0] == answers[1]


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
