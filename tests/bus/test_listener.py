"""A listener turns the messages of python-can's notifiers and logs into lines (item 3)."""

import asyncio
import math
import threading
from typing import Any

import can
import pytest
from support.dbcs import new_codec
from support.fake_bus import (
    GONE,
    LONG,
    FakeBus,
    FakeTime,
    collect,
    map_line,
    message_of,
    wait_until,
)
from support.fake_codec import PAGES, FakeCodec
from support.scene_streams import CONDITIONAL, codec_of, road_scene

import maplines_can
from maplines_can.bus import LineListener
from maplines_can.values.line import Slot
from maplines_can.wire import POSE, E2EState

POLL = 0.02  #: after which a notifier sees that it shall stop [s]


@pytest.fixture
def buses(channel: str) -> Any:
    """Yield two open buses of one virtual channel."""
    with (
        can.Bus(interface="virtual", channel=channel, preserve_timestamps=True) as out,
        can.Bus(interface="virtual", channel=channel) as back,
    ):
        yield out, back


def send(bus: Any, encoder: Any, *lines: Any, **rest: Any) -> None:
    for line in lines:
        for frame in encoder.encode(line):
            bus.send(message_of(frame, **rest))


def test_item_3_a_notifier_passes_lines_to_a_listener(buses: Any) -> None:
    """As with a receiver: queue, newest line, states and counters."""
    out, back = buses
    codec = new_codec()
    encoder = codec.encoder()
    listener = maplines_can.LineListener(codec.decoder())
    with can.Notifier(back, [listener], timeout=POLL):
        for k in range(9):
            send(out, encoder, map_line(y=k / 8), timestamp=1e9 + k / 20)
        out.send(can.Message(arbitration_id=0x7FF, is_extended_id=False, timestamp=1e9))
        out.send(can.Message(is_error_frame=True))
        out.send(can.Message(is_remote_frame=True))
        lines = collect(listener, 9)
        assert [line.gaussian.mean[0] for line in lines] == [k / 8 for k in range(9)]
        wait_until(lambda: listener.stats().remote_frames)
        view = listener.latest(Slot.EGO_LEFT, now_ns=lines[-1].t_ns)
        assert (view.line, view.state) == (lines[-1], E2EState.VALID)
        assert view.usable
        assert list(listener.slots()) == [Slot.EGO_LEFT]
    stats = listener.stats()
    assert (stats.lines, stats.frames, stats.lost, stats.overflowed) == (9, 37, 0, 0)
    assert (stats.error_frames, stats.remote_frames) == (1, 1)
    assert stats.counts == {maplines_can.Reason.FOREIGN: 1}


def test_the_iteration_ends_with_the_notifier(buses: Any) -> None:
    """Lines that wait are still returned; frames that come later are ignored."""
    out, back = buses
    codec = FakeCodec()
    encoder = codec.encoder()
    listener = LineListener(codec.decoder())
    notifier = can.Notifier(back, [listener], timeout=POLL)
    send(out, encoder, map_line(y=1), map_line(y=2))
    wait_until(lambda: listener.stats().lines == 2)
    lines: list[Any] = []
    reading = threading.Thread(target=lambda: lines.extend(listener))
    reading.start()
    notifier.stop()
    reading.join(LONG)
    assert [line.gaussian.mean[0] for line in lines] == [1, 2]
    assert listener.get() is None
    listener(can.Message(arbitration_id=0x7FF))
    assert listener.stats().frames == 2 * PAGES


def test_an_event_loop_calls_the_listener(buses: Any) -> None:
    """The lines reach an ``asyncio.Queue``, in the thread of the loop."""
    out, back = buses
    codec = FakeCodec()
    encoder = codec.encoder()

    async def receive() -> Any:
        lines: asyncio.Queue[Any] = asyncio.Queue()
        listener = LineListener(codec.decoder(), on_line=lines.put_nowait)
        loop = asyncio.get_running_loop()
        with can.Notifier(back, [listener], timeout=POLL, loop=loop):
            send(out, encoder, map_line(y=1), map_line(y=2))
            return [await asyncio.wait_for(lines.get(), LONG) for _ in range(2)]

    assert [line.gaussian.mean[0] for line in asyncio.run(receive())] == [1, 2]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")
def test_the_error_of_a_bus_is_raised_by_get() -> None:
    """Otherwise the caller would wait for ever for a notifier that has ended."""
    listener = LineListener(FakeCodec().decoder())
    notifier = can.Notifier(FakeBus([GONE]), [listener], timeout=POLL)
    for _ in range(2):
        with pytest.raises(OSError, match="No such device"):
            listener.get()
    notifier.stop()


@pytest.mark.parametrize("how", ["error", "stop"])
def test_what_waits_for_a_line_is_woken_by_the_end(how: str) -> None:
    """By ``on_error`` of python-can, or by ``stop``."""
    listener = LineListener(FakeCodec().decoder())
    entered, ended = threading.Event(), threading.Event()
    wait_for = listener._changed.wait_for

    def waiting(condition: Any, timeout: Any) -> Any:
        entered.set()  # under the lock, which only the wait releases
        return wait_for(condition, timeout)

    def get() -> None:
        try:
            assert listener.get(LONG) is None
        except KeyError:
            pass
        finally:
            ended.set()

    listener._changed.wait_for = waiting  # type: ignore[method-assign, assignment]
    thread = threading.Thread(target=get, daemon=True)
    thread.start()
    assert entered.wait(LONG)
    if how == "stop":
        listener.stop()
    else:
        with pytest.raises(NotImplementedError):
            listener.on_error(KeyError("lost"))
    assert ended.wait(LONG / 4)
    thread.join()


def test_a_scene_of_unknown_age_is_stale(monkeypatch: pytest.MonkeyPatch) -> None:
    """Frames may be of a backlog until 0.2 s have passed; a time that is given needs no clock.

    As with the lines of slots, then the time goes on with the clock of this host.
    """
    monkeypatch.setattr("maplines_can.bus.receiver.time", now := FakeTime())
    codec = codec_of(CONDITIONAL)
    listener: Any = LineListener(codec.decoder())
    assert listener.pose_error() is None
    assert listener.slots() == {}
    scene = codec.encoder().prepare_scene(road_scene())
    counters: dict[Any, int] = {}
    for cycle in range(8):
        for owner, frames in (
            codec.encoder().encode_scene(scene, age=0.02, counters=counters).items()
        ):
            counters[owner] = counters.get(owner, 0) + 1
            for frame in frames:
                listener(message_of(frame, timestamp=50 + 0.05 * cycle))
        for view in (listener.latest_scene(), listener.latest(Slot.EGO_LEFT)):
            assert (view.age, view.stale) == ((math.inf, True) if cycle < 4 else (view.age, False))
        given = listener.latest_scene(round(1e9 * (50.001 + 0.05 * cycle)))
        assert given.scene is not None
        assert not given.stale
        assert given.age == pytest.approx(0.021, abs=0.004)
        now.ns += 50_000_000
    assert listener.latest_scene().age == pytest.approx(given.age + 0.049)
    assert listener.latest(Slot.EGO_LEFT).age == pytest.approx(given.age + 0.049)
    assert not listener.latest_scene(stale_cycles=2).stale
    now.ns += 60_000_000
    assert listener.latest_scene(stale_cycles=2).stale
    assert not listener.latest_scene(stale_cycles=3).stale
    assert listener.pose_error().ok == listener.stats().pose_errors == 8
    assert listener.pose_error().state is E2EState.VALID
    assert listener.slots()[Slot.EGO_LEFT].state is E2EState.VALID
    later = round(51.5e9)
    assert listener.pose_error(later).state is E2EState.INVALID
    assert listener.slots(later)[Slot.EGO_LEFT].state is E2EState.INVALID
    assert set(counters) == {POSE, Slot.EGO_LEFT, Slot.EGO_RIGHT}
