"""Frames become lines; everything else is counted."""

import itertools
import time
from typing import Any

import can
import numpy as np
import pytest
from support.dbcs import new_codec
from support.fake_bus import (
    LONG,
    FakeTime,
    collect,
    map_line,
    message_of,
    send_frames,
    wait_until,
)
from support.fake_codec import PAGES, FakeCodec

from maplines_can.bus import (
    Link,
    Receiver,
    Sent,
)
from maplines_can.values.errors import BusError
from maplines_can.values.line import MapLine, Slot
from maplines_can.wire import Codec, Frame, Reason


def test_everything_that_arrives_is_counted(link: Any, other: Any) -> None:
    """Lines, rejected frames, error frames, remote frames."""
    codec = FakeCodec()
    encoder = codec.encoder()
    frames = encoder.encode(map_line())
    with Receiver(other, codec.decoder(), can_ids=None) as receiver:
        link.send(can.Message(is_error_frame=True))
        link.send(can.Message(arbitration_id=0x100, is_remote_frame=True, is_extended_id=False))
        send_frames(
            link, Frame(0x7FF, b"other"), *frames[:2], frames[3], *encoder.encode(map_line())
        )
        received = receiver.get(LONG)
        stats = receiver.stats()

    assert abs(received.t_ns - time.time_ns()) < LONG * 1e9  # type: ignore[operator, union-attr]
    assert (stats.lines, stats.frames, stats.overflowed) == (1, 8, 0)
    assert (stats.error_frames, stats.remote_frames) == (1, 1)
    assert stats.counts == {
        Reason.FOREIGN: 1,
        Reason.PENDING: 5,
        Reason.INCOMPLETE: 1,
    }


def test_item_10_a_receiver_that_never_started_has_nothing_to_wait_for(other: Any) -> None:
    receiver = Receiver(other, FakeCodec().decoder())
    assert receiver.get() is None
    assert list(receiver) == []
    receiver.stop()
    assert receiver.get() is None


def test_the_queue_keeps_the_newest_lines(link: Any, other: Any) -> None:
    """A full queue drops the oldest lines and counts them."""
    codec = FakeCodec()
    encoder = codec.encoder()
    with Receiver(other, codec.decoder(), queue_size=3) as receiver:
        for y in range(10):
            send_frames(link, *encoder.encode(map_line(y=y)))
        wait_until(lambda: receiver.stats().lines == 10)
        assert [x.gaussian.mean[0] for x in collect(receiver, 3)] == [7, 8, 9]
        assert receiver.stats().overflowed == 7


def test_a_callback_gets_a_line_before_the_next_one_counts(link: Any, other: Any) -> None:
    """Though all frames have arrived: ``latest`` is the line of the callback, and none follow."""
    codec, seen = Codec.from_dbc(), []
    encoder = codec.encoder()
    lines = [MapLine(Slot.EGO_LEFT, map_line().gaussian, age=0.02 * k) for k in range(4)]
    receiver = Receiver(other, codec.decoder(), on_line=lambda line: on_line(line))

    def on_line(line: Any) -> None:
        latest: Any = receiver.latest(Slot.EGO_LEFT).line
        seen.append((line.age, latest.age, receiver.stats().lines))
        if len(seen) == 2:
            receiver.stop()

    for line in lines:
        send_frames(link, *encoder.encode(line))
    receiver.start()
    receiver._join(LONG)
    receiver.stop()
    assert [count for *_, count in seen] == [1, 2]
    assert all(own == latest for own, latest, _ in seen)
    assert seen[0][0] < seen[1][0]


def test_the_error_of_a_callback_is_raised_by_stop(link: Any, other: Any) -> None:
    codec = FakeCodec()

    def on_line(line: Any) -> None:
        raise ZeroDivisionError

    receiver = Receiver(other, codec.decoder(), on_line=on_line).start()
    send_frames(link, *codec.encoder().encode(map_line()))
    receiver._join(LONG)
    with pytest.raises(ZeroDivisionError):
        receiver.stop()
    receiver.stop()


@pytest.mark.parametrize(
    ("settings", "foreign"), [({}, 0), ({"can_ids": {0x100}}, 0), ({"can_ids": None}, 1)]
)
def test_item_10_only_the_ids_of_the_decoder_pass_by_default(
    link: Any, other: Any, settings: Any, foreign: int
) -> None:
    codec = FakeCodec()
    with Receiver(other, codec.decoder(), **settings) as receiver:
        send_frames(link, Frame(0x7FF, b""), *codec.encoder().encode(map_line()))
        assert receiver.get(LONG)
        assert receiver.stats().frames == PAGES + foreign


@pytest.mark.parametrize("can_ids", [(), set(), "all"])
def test_wrong_can_ids_raise(other: Any, can_ids: Any) -> None:
    with pytest.raises(ValueError, match="can_ids must be 1 CAN ID or more, 'decoder' for"):
        Receiver(other, FakeCodec().decoder(), can_ids=can_ids)


@pytest.mark.socketcan
def test_kernel_filters_and_local_frames(vcan: str) -> None:
    """The kernel drops frames of other IDs; frames of local programs are received."""
    codec = FakeCodec()
    with (
        Link(interface="socketcan", channel=vcan) as link,
        Link(interface="socketcan", channel=vcan) as other,
        Receiver(other, codec.decoder()) as receiver,
    ):
        send_frames(link, *[Frame(0x7FF, b"")] * 20, *codec.encoder().encode(map_line()))
        assert abs(receiver.get(LONG).t_ns - time.time_ns()) < LONG * 1e9  # type: ignore[operator, union-attr]
        assert receiver.stats().frames == PAGES


def test_the_latest_line_of_a_backlog_is_not_new(
    channel: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The sender has died; then the receiver starts, and reads a backlog from the queue."""
    monkeypatch.setattr("maplines_can.bus.receiver.time", now := FakeTime())
    codec = new_codec()
    encoder = codec.encoder()
    with (
        Link(interface="virtual", channel=channel, preserve_timestamps=True) as sender,
        Link(interface="virtual", channel=channel) as late,
    ):

        def send(k: Any, age_ns: Any) -> None:
            for frame in encoder.encode(MapLine.mean_only(Slot.EGO_LEFT, [k / 16, 0, 0, 0])):
                message = message_of(frame, timestamp=(now.ns - age_ns) / 1e9)
                assert sender.send(message) is Sent.OK

        for k in range(20):
            send(k, 2_000_000_000 + (20 - k) * 50_000_000)
        with Receiver(late, codec.decoder(cycle_ms=200)) as receiver:
            collect(receiver, 20)
            view = receiver.latest(Slot.EGO_LEFT)
            assert (view.line.gaussian.mean[0], view.age, view.stale) == (19 / 16, np.inf, True)  # type: ignore[union-attr]
            assert not view.usable
            assert receiver.latest(Slot.EGO_LEFT, now_ns=view.line.t_ns).usable  # type: ignore[union-attr]  # the time is known
            for k in itertools.count(20):
                now.ns += 50_000_000
                send(k, 0)
                collect(receiver, 1)
                view = receiver.latest(Slot.EGO_LEFT)
                if view.usable:
                    break
                assert k < 100
            assert k >= 24
            assert view.age < 10.0


def test_lines_received_before_an_error_come_before_it(link: Any, other: Any) -> None:
    """`get` raises the error of the thread once no line waits."""
    codec = FakeCodec()
    receiver = Receiver(other, codec.decoder()).start()
    send_frames(link, *codec.encoder().encode(map_line()))
    wait_until(lambda: receiver.stats().lines == 1)
    other.close()
    with pytest.raises(BusError, match="is closed"):
        receiver.wait(LONG)
    assert isinstance(receiver.get(), MapLine)
    with pytest.raises(BusError, match="is closed"):
        receiver.get()
