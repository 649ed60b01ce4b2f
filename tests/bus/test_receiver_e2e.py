"""The E2E state of a slot at a receiver on a bus."""

import threading
from typing import Any

import pytest
from support.dbcs import default_codec, new_codec
from support.e2e_streams import MS, SLOT, frames
from support.fake_bus import FakeTime, collect, message_of, wait_until

from maplines_can import Link, MapLine, Receiver, Transmitter
from maplines_can.bus import Sent
from maplines_can.wire import E2EState


def test_a_controller_sees_a_slot_become_valid_and_stale(
    monkeypatch: pytest.MonkeyPatch, channel: Any
) -> None:
    """Many threads at once request the newest line: VALID while lines are received, then stale.

    The time is that of the test, which goes on when a line has been received.
    """
    monkeypatch.setattr("maplines_can.bus.receiver.time", now := FakeTime())
    bus = {"interface": "virtual", "channel": channel}
    codec, wrong = new_codec(), []
    with (
        Link(**bus, preserve_timestamps=True) as link,
        Link(**bus) as other,
        Receiver(other, codec.decoder()) as receiver,
    ):
        stop = threading.Event()

        def control() -> None:
            while not stop.is_set():
                view = receiver.latest(SLOT)
                if view.line is not None and view.age < view.line.age:
                    wrong.append(view)

        threads = [threading.Thread(target=control, daemon=True) for _ in range(3)]
        for thread in threads:
            thread.start()
        with Transmitter(link, codec, period=0.05, clock=now.monotonic) as transmitter:
            transmitter.publish(MapLine.mean_only(SLOT, [1.75, 0, 0, 0]))
            now.ns += MS  # beyond the rounding of deadlines
            for n in range(1, 11):
                wait_until(lambda: receiver.stats().lines == n)  # noqa: B023
                assert receiver.latest(SLOT).usable is (n > 6)
                if n < 10:
                    now.ns += 50 * MS
                    transmitter.publish(MapLine.mean_only(SLOT, [1.75, 0, 0, 0]))
        last_ns = now.ns
        for late_ms, stale, state in [
            (150, False, E2EState.VALID),
            (151, True, E2EState.VALID),
            (275, True, E2EState.INVALID),
        ]:
            now.ns = last_ns + late_ms * MS
            view = receiver.latest(SLOT)
            assert (view.stale, view.state, view.usable) == (stale, state, not stale)
        assert view.line.gaussian.mean[0] == 1.75  # type: ignore[union-attr]
        stop.set()
        for thread in threads:
            thread.join()
        assert wrong == []
        assert list(receiver.slots()) == [SLOT]


def test_age_is_by_the_clock_of_the_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if the time stamps of the adapter start at power-up."""
    monkeypatch.setattr("maplines_can.bus.receiver.time", now := FakeTime())
    bus = {"interface": "virtual", "channel": "since-power-up"}
    with (
        Link(**bus, preserve_timestamps=True) as link,  # type: ignore[arg-type]
        Link(**bus) as other,  # type: ignore[arg-type]
        Receiver(other, default_codec().decoder()) as receiver,
    ):
        for counter in range(2):  # one alone may be of a backlog
            for frame in frames(counter):
                message = message_of(frame, timestamp=12.5 + 0.25 * counter)
                assert link.send(message) is Sent.OK
            (line,) = collect(receiver, 1)
            now.ns += 250 * MS
        view = receiver.latest(SLOT)
        assert view.age - line.age == pytest.approx(0.25)
        assert receiver.latest(SLOT, now_ns=line.t_ns + 151 * MS).stale
