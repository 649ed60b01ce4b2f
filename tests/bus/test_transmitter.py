"""Every published line is sent once a period, whole or not at all."""

import json
import struct
import threading
from typing import Any

import pytest
from support.fake_bus import (
    FULL,
    GONE,
    LONG,
    Clock,
    FakeOpener,
    FakeTime,
    drive,
    map_line,
)
from support.fake_codec import PAGES, FakeCodec, sent_values

from maplines_can.bus import (
    Link,
    Transmitter,
)
from maplines_can.bus.transmitter import TransmitterStats
from maplines_can.values.errors import BusError
from maplines_can.values.line import LeftOut, MapLineList, Slot
from maplines_can.wire import Frame


def transfer(sent: Any, n: Any = PAGES) -> Any:
    """(page, counter) of the next n frames that were sent on a fake bus."""
    return [tuple(sent.get(timeout=LONG).data[:2]) for _ in range(n)]


def test_the_age_counts_from_the_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("maplines_can.bus.transmitter.time", now := FakeTime())
    opener, clock = FakeOpener(), Clock()
    with Link(opener) as link:
        transmitter = Transmitter(link, FakeCodec(), clock=clock)  # type: ignore[arg-type]
        transmitter.publish(map_line(age=77.0), t_pose_ns=now.ns - 2_000_000_000)
        drive(transmitter, clock, 1000.99)
    sent = sent_values(opener)
    assert sent[0][0] == 2000 + 4  # and the lateness that is allowed
    assert len(sent) == 20  # by default, 20 times a second


@pytest.mark.parametrize("lost_at", range(PAGES))
def test_a_transfer_is_whole_or_dropped(lost_at: Any) -> None:
    """After an error the rest of the transfer is dropped; the next transfer is whole."""
    opener = FakeOpener(*[None] * lost_at, GONE)
    with (
        Link(opener, backoff=(0.001, 0.001)) as link,
        Transmitter(link, FakeCodec(), period=0.01) as transmitter,  # type: ignore[arg-type]
    ):
        transmitter.publish(map_line())
        assert transfer(opener.sent, lost_at) == [(page, 1) for page in range(lost_at)]
        later = transfer(opener.sent)
        assert [page for page, _ in later] == [0, 1, 2, 3]
        assert len({counter for _, counter in later} - {1}) == 1
        transmitter.stop()
        stats = transmitter.stats()

    assert stats.down >= 1
    assert stats.frames == PAGES * stats.lines + lost_at
    assert link.outages == 1


def test_a_queue_that_stays_full_costs_the_line_its_period() -> None:
    """It is given up when the next transfer is due, and counted; it is no outage."""

    class Ticking(Clock):
        """A clock that each call advances, so that no thread is late."""

        def __call__(self) -> Any:
            self.now += 1e-3
            return self.now

    opener = FakeOpener(None, *[FULL] * 10_000)
    with Link(opener) as link:
        transmitter = Transmitter(link, FakeCodec(), period=0.02, count=2, clock=Ticking())  # type: ignore[arg-type]
        transmitter.publish(map_line())
        with transmitter:
            assert transmitter.wait(LONG)
        stats = transmitter.stats()

    assert (stats.lines, stats.frames) == (0, 1)
    assert (stats.full, stats.overruns) == (2, 0)
    assert stats.retries > 0
    assert link.outages == 0


def test_an_error_of_the_codec_reaches_the_caller(link: Any) -> None:
    """It ends the thread. wait and publish raise it; stop does not raise it again."""
    transmitter = Transmitter(link, FakeCodec(), period=0.001)  # type: ignore[arg-type]
    with transmitter:
        transmitter.publish(map_line(x_max=13.0))
        with pytest.raises(ValueError, match="13 m"):
            transmitter.wait(LONG)
        with pytest.raises(ValueError, match="13 m"):
            transmitter.publish(map_line())


def test_the_error_of_the_body_is_not_hidden(link: Any) -> None:
    with pytest.raises(KeyError), Transmitter(link, FakeCodec()) as transmitter:  # type: ignore[arg-type]  # noqa: PT012
        transmitter.publish(map_line(x_max=13.0))
        transmitter._join(LONG)
        raise KeyError


def test_stop_is_immediate_and_can_be_repeated(link: Any) -> None:
    """From any thread, with the next deadline an hour away, and before the start."""
    transmitter = Transmitter(link, FakeCodec(), period=3600.0).start()  # type: ignore[arg-type]
    transmitter.publish(map_line())
    threads = [threading.Thread(target=transmitter.stop) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(LONG)
        assert not thread.is_alive()
    transmitter.stop()
    assert transmitter.wait(0)
    Transmitter(link, FakeCodec()).stop()  # type: ignore[arg-type]


def test_a_callback_may_stop_the_transmitter() -> None:
    opener = FakeOpener(GONE)
    stopped = threading.Event()

    def on_event(up: Any, text: Any) -> None:
        transmitter.stop()
        stopped.set()

    with Link(opener, on_event=on_event) as link:
        transmitter = Transmitter(link, FakeCodec())  # type: ignore[arg-type]
        transmitter.publish(map_line())
        with transmitter:
            assert stopped.wait(LONG)
            assert transmitter.wait(LONG)


def test_can_fd_needs_a_link_with_can_fd() -> None:
    with (
        Link(FakeOpener()) as link,
        pytest.raises(BusError, match="fake is opened without CAN FD; open it with fd=True"),
    ):
        Transmitter(link, FakeCodec(), fd=True)  # type: ignore[arg-type]


@pytest.mark.parametrize(("ago_s", "allowed"), [
    (-1.0, True), (-1.5, False), (0.0, True), (3600.0, True), (3600.5, False), (-1e9, False),
])  # fmt: skip
def test_the_allowed_times_of_a_pose(
    monkeypatch: pytest.MonkeyPatch, ago_s: float, allowed: bool
) -> None:
    """From an hour ago to a second ahead, both included."""
    fake = FakeTime()
    monkeypatch.setattr("maplines_can.bus.transmitter.time", fake)
    with Link(FakeOpener()) as link:
        transmitter = Transmitter(link, FakeCodec(), clock=Clock())  # type: ignore[arg-type]
        t_pose_ns = fake.ns - int(ago_s * 1e9)
        if allowed:
            transmitter.publish(map_line(), t_pose_ns)
        else:
            with pytest.raises(ValueError, match=r"clock of time.time_ns\(\)"):
                transmitter.publish(map_line(), t_pose_ns)


def first_pages(opener: Any) -> Any:
    """(counter, slot) of the lines that were sent since the last call."""
    pages = [opener.sent.get(timeout=0).data for _ in range(opener.sent.qsize())]
    return [tuple(page[1:3]) for page in pages if page[0] == 0]


def test_item_12_lines_left_out_are_retracted_and_counted() -> None:
    """A slot that ``map_lines`` left out does not go on with its previous line."""
    opener, clock = FakeOpener(), Clock()
    reasons = {Slot.EGO_RIGHT: LeftOut.ACROSS, Slot.CENTRE: LeftOut.NOT_IN_WINDOW}
    with Link(opener) as link:
        transmitter = Transmitter(link, FakeCodec(), period=0.4, clock=clock)  # type: ignore[arg-type]
        transmitter.publish([map_line(Slot.EGO_LEFT), map_line(Slot.EGO_RIGHT)])
        drive(transmitter, clock, clock.now + 0.4)
        assert {slot for _, slot in first_pages(opener)} == {Slot.EGO_LEFT, Slot.EGO_RIGHT}
        transmitter.publish(MapLineList([map_line(Slot.EGO_LEFT)], reasons))
        drive(transmitter, clock, clock.now + 4.0)
        assert {slot for _, slot in first_pages(opener)} == {Slot.EGO_LEFT}
        transmitter.publish(MapLineList([map_line(Slot.EGO_RIGHT)], {Slot.CENTRE: LeftOut.ACROSS}))
        drive(transmitter, clock, clock.now + 0.4)
        counters = first_pages(opener)
    assert {slot for _, slot in counters} == {Slot.EGO_LEFT, Slot.EGO_RIGHT}
    assert (2, Slot.EGO_RIGHT) in counters  # the counter continues without a gap
    stats = transmitter.stats()
    assert stats.left_out == {LeftOut.ACROSS: 2, LeftOut.NOT_IN_WINDOW: 1}
    counters = json.loads(json.dumps(stats.as_dict()))
    assert counters["left_out"] == {"ACROSS": 2, "NOT_IN_WINDOW": 1}
    assert counters["lateness"] == {"median": 0.0, "p99": 0.0, "max": 0.0}
    assert list(counters) == list(TransmitterStats._fields)
    assert (counters["lines"], counters["frames"]) == (stats.lines, PAGES * stats.lines)


class Steps:
    """Stands in for the module ``time``: each pause advances a clock by a quarter of a second."""

    def __init__(self, clock: Clock) -> None:
        self.clock = clock

    def sleep(self, _: float) -> None:
        self.clock.now += 0.25


ON_TIME = 1000.0 + 0.004 - 1000.0  #: lateness that the age covers, as rounded [s]


@pytest.mark.parametrize(
    ("script", "late", "settings", "ages", "end", "counts"),
    [
        # A line is given up at its next deadline, not one attempt later.
        ([FULL] * 10, 0.0, {}, [], 0.5, {"full": 1, "retries": 2}),
        # Lateness counts to the first frame; a queue that is full later does not count.
        ([None, FULL], 0.0, {}, [4] * 4, None, {"lateness": (0.0,) * 3}),
        ([None, FULL], 0.125, {}, [250] * 4, None, {"lateness": (0.125,) * 3}),
        # Frames of one transfer state one age, although the others are sent later: it is encoded
        # again only before its first frame, for twice its lateness.
        ([None, FULL, FULL], 0.0, {"period": 1.0}, [4] * 4, 0.5, {}),
        ([FULL], 0.0, {"period": 1.0}, [500] * 4, None, {}),
        # There is no need to until the last moment that the age covers.
        ([], ON_TIME, {}, [4] * 4, None, {}),
        ([], ON_TIME + 1e-3, {}, [10] * 4, None, {}),
        # Of three deadlines that have passed, the newest one is met.
        ([], 1.25, {}, [1500] * 4, None, {"overruns": 2, "lines": 1}),
        # What was not handed over is neither told nor counted.
        ([FULL, None, None, FULL], 0.0, {"period": 2.0}, [500] * 4, None, {"frames": 4}),
        ([None, None, GONE], 0.0, {"period": 2.0}, [4] * 2, None, {"frames": 2, "down": 1}),
        ([GONE], 0.0, {"period": 2.0}, [], None, {"frames": 0, "down": 1}),
        # A line that is too old counts as expired only if it is sent.
        ([GONE] * 9, 0.25, {"max_age": 0.1}, [], None, {"down": 1, "full": 0, "expired": 0}),
        ([FULL] * 9, 0.25, {"max_age": 0.1}, [], None, {"down": 0, "full": 1, "expired": 0}),
        ([], 0.25, {"max_age": 0.1}, [60_000] * 4, None, {"lines": 1, "expired": 1}),
    ],
)
def test_a_line_is_late(
    script: list[Any],
    late: float,
    settings: dict[str, Any],
    ages: list[int],
    end: float | None,
    counts: dict[str, Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is sent over a bus with a script of errors; ages are in ms, and pauses last for 0.25 s."""
    clock, opener, told = Clock(), FakeOpener(*script), list[Frame]()
    monkeypatch.setattr("maplines_can.bus.transmitter.time", Steps(clock))
    with Link(opener) as link:
        options: Any = {"clock": clock, "on_sent": told.append, "period": 0.5} | settings
        transmitter = Transmitter(link, FakeCodec(), **options)  # type: ignore[arg-type]
        transmitter.publish(map_line())
        clock.now += late
        transmitter._send(transmitter._next_transfer())  # type: ignore[arg-type]
    pages = [bytes(opener.sent.get(timeout=0).data) for _ in range(opener.sent.qsize())]
    assert [struct.unpack_from("<BBBBH", page)[-1] for page in pages] == ages
    assert [frame.data for frame in told] == pages
    assert end in (None, clock.now - 1000.0)
    stats = transmitter.stats()
    assert {name: getattr(stats, name) for name in counts} == counts
