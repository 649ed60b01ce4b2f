"""In a forked child no thread of the parent runs: nothing waits for one (item 10)."""

import os
import queue
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import can
import pytest
from support.fake_bus import LONG, FakeBus, FakeOpener, collect, map_line, send_frames, wait_until
from support.fake_codec import FakeCodec

from maplines_can.bus import LineListener, Link, Receiver, Transmitter
from maplines_can.testing import FaultyBus

pytestmark = [
    pytest.mark.skipif(not hasattr(os, "fork"), reason="there is no fork on this system"),
    pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning"),  # Python 3.12: of threads
]


def in_child(check: Callable[[], bool]) -> Any:
    """Return the exit status of a forked child: 0 if the check is true there, and it ends."""
    child = os.fork()
    if child == 0:
        status = 2
        try:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(round(LONG))  # ends a child that hangs
            status = 0 if check() else 1
        finally:
            os._exit(status)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@contextmanager
def held(*locks: Any) -> Iterator[None]:
    """Let another thread hold locks, which are then never released in a forked child."""
    holds, release = threading.Event(), threading.Event()

    def hold() -> None:
        for lock in locks:
            lock.acquire()
        holds.set()
        release.wait()
        for lock in locks:
            lock.release()

    thread = threading.Thread(target=hold)
    thread.start()
    holds.wait()
    try:
        yield
    finally:
        release.set()
        thread.join()


def test_item_10_stop_wait_and_get_end_at_once_in_a_forked_child(link: Any, other: Any) -> None:
    """The lines that waited are still there, and the parent goes on."""
    codec = FakeCodec()
    with (
        Receiver(other, codec.decoder()) as receiver,
        Transmitter(link, codec, period=3600.0) as transmitter,  # type: ignore[arg-type]
    ):
        transmitter.publish(map_line(y=1))
        collect(receiver, 1)
        send_frames(link, *codec.encoder().encode(map_line(y=2)))
        wait_until(lambda: receiver.stats().lines == 2)

        def check() -> bool:
            waited, none = receiver.get(), receiver.get()
            ended = receiver.wait() and transmitter.wait()
            receiver.stop()
            transmitter.stop()
            stats = receiver.stats().lines, transmitter.stats().lines
            return (waited.gaussian.mean[0], none, ended, stats) == (2.0, None, True, (2, 1))  # type: ignore[union-attr]

        assert in_child(check) == 0
        assert not receiver.wait(0.0)
        assert not transmitter.wait(0.0)
        assert collect(receiver, 1)


def test_a_lock_that_a_thread_held_is_free_in_the_child() -> None:
    """Also if the child leaves the blocks of a link and of its threads."""
    codec, lines = FakeCodec(), queue.SimpleQueue[Any]()
    listener = LineListener(codec.decoder(), on_line=lines.put)
    with (
        Link(FakeOpener()) as link,
        Receiver(link, codec.decoder()) as receiver,
        Transmitter(link, codec) as transmitter,  # type: ignore[arg-type]
    ):

        def check() -> bool:
            with pytest.raises(RuntimeError, match="publish must come before stop"):
                transmitter.publish(map_line())
            transmitter.stop()
            receiver.stop()
            link.send(can.Message())
            link.close()
            for frame in codec.encoder().encode(map_line()):
                listener(can.Message(arbitration_id=frame.can_id, data=frame.data))
            ended = receiver.get() is None and receiver.stats().lines == 0
            return ended and lines.qsize() == listener.stats().lines == 1

        locks = [part._changed for part in (transmitter, receiver, listener)]
        with held(*locks, link._lock, link._send_lock):
            assert in_child(check) == 0


def test_what_was_never_started_can_be_started_in_the_child() -> None:
    bus = FakeBus()
    transmitter = Transmitter(bus, FakeCodec(), count=1)  # type: ignore[arg-type]
    transmitter.publish(map_line())

    def check() -> bool:
        with transmitter:
            return transmitter.wait(LONG) and transmitter.stats().lines == 1

    assert in_child(check) == 0
    assert transmitter.stats().lines == 0


def test_a_thread_object_is_made_when_it_is_started(monkeypatch: pytest.MonkeyPatch) -> None:
    """Since Python 3.13, one that was made before a fork has ended in the child."""
    made: list[threading.Thread] = []
    init = threading.Thread.__init__

    def noted(self: threading.Thread, *args: Any, **settings: Any) -> None:
        made.append(self)
        init(self, *args, **settings)

    monkeypatch.setattr(threading.Thread, "__init__", noted)
    codec, bus = FakeCodec(), FakeBus()
    transmitter = Transmitter(bus, codec)  # type: ignore[arg-type]
    receiver = Receiver(bus, codec.decoder())
    with FaultyBus(bus, "loss=0.5,delay=0.1"):
        assert not made
    for thread in (transmitter, receiver):
        with thread:
            assert made.pop().is_alive()
            assert not made
