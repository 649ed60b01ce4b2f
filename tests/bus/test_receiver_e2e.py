"""The E2E state of a slot at a receiver on a bus."""

import pytest
from support.dbcs import default_codec
from support.e2e_streams import MS, SLOT, frames
from support.fake_bus import FakeTime, collect, message_of

from maplines_can import Link, Receiver
from maplines_can.bus import Sent


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
