"""A log on a bus at its times: in virtual time, so that every time is exact."""

from __future__ import annotations

import argparse
import math
import threading
from collections.abc import Iterator
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can import Link
from maplines_can.bus import Sent
from maplines_can.bus.clock import VirtualClock
from maplines_can.bus.replay import LONG_PATIENCE, PATIENCE, Choice, Plan, Replay, planned
from maplines_can.bus.virtual_time import VirtualNetwork, VirtualTimeBus
from maplines_can.cli import main
from maplines_can.cli.replay import _has_key, _only, _spans
from maplines_can.logs.first_frames import CanId
from maplines_can.logs.frame_block import FrameBlock, LogFrame, block_of
from maplines_can.values.errors import BusError, LogError
from maplines_can.wire import SHIPPED, Layout, default_dbc_path

LAYOUTS = [Layout.from_dbc(default_dbc_path(name)) for name in SHIPPED]
BEGIN = 1_700_000_000_000_000_000


def frame(t_ms: float, can_id: int = 0x340, data: bytes = bytes(8), **members: Any) -> LogFrame:
    given: dict[str, Any] = {"channel": "can0", "has_time": True, **members}
    return LogFrame(can_id, data, BEGIN + round(t_ms * 1e6), can_id > 0x7FF, **given)


def blocks_of(frames: list[LogFrame], size: int = 3) -> list[FrameBlock]:
    """All with the channels of the first frames on."""
    numbers: dict[str, int] = {}
    return [block_of(frames[k : k + size], numbers) for k in range(0, len(frames), size)]


class Bench:
    """A bus in virtual time with a replay, and all that arrives on it."""

    def __init__(self) -> None:
        self.clock = VirtualClock(5 * 10**9)
        self.network = VirtualNetwork(self.clock)
        self.received: list[can.Message] = []
        self._buses = list[VirtualTimeBus]()
        self.bus().add_listener(self.received.append)
        self.link = Link(self.bus())

    def bus(self) -> VirtualTimeBus:
        self._buses.append(VirtualTimeBus(self.network))
        return self._buses[-1]

    def close(self) -> None:
        for bus in self._buses:
            bus.shutdown()

    def replay(
        self, frames: list[LogFrame], passes: int | None = 1, fd_keys: Any = (), **settings: Any
    ) -> Replay:
        blocks = blocks_of(frames)
        plan = planned(blocks, frozenset(fd_keys))
        replay = Replay(self.link, plan, clock=self.clock, **settings)
        replay.run(lambda: blocks, passes)
        return replay


@pytest.fixture
def bench() -> Iterator[Bench]:
    with closing(Bench()) as made:
        yield made


FRAMES = st.lists(
    st.builds(
        frame,
        st.floats(0, 5000),
        st.sampled_from([0x100, 0x340, 0x18FF0000]),
        st.sampled_from([0, 1, 8, 12, 64]).map(bytes),
    ),
    min_size=1,
    max_size=20,
).map(lambda frames: sorted(frames, key=lambda one: one.t_ns))


@given(FRAMES, st.sampled_from([0.1, 1.0, 3.0, 10.0]))
def test_frames_come_at_their_times(frames: list[LogFrame], speed: float) -> None:
    """All of them, in their order, with their flags; the speed divides their distances."""
    with closing(Bench()) as bench:
        stats = bench.replay(frames, speed=speed).stats()
    assert [(m.arbitration_id, bytes(m.data), m.is_extended_id) for m in bench.received] == [
        (f.can_id, f.data, f.is_extended) for f in frames
    ]
    long = {f.can_id for f in frames if len(f.data) > 8}  # short frames of these are of CAN FD, too
    assert [m.is_fd for m in bench.received] == [f.can_id in long for f in frames]
    expected = [5 + (f.t_ns - frames[0].t_ns) / 1e9 / speed for f in frames]
    assert [m.timestamp for m in bench.received] == pytest.approx(expected, abs=1e-8)
    assert (stats.frames, stats.late_max, stats.full) == (len(frames), 0, 0)


def test_a_loop_keeps_the_period(bench: Bench) -> None:
    """The first message comes a period after its last one, as if the log went on."""
    frames = [frame(t + d, can_id) for t in (0, 50, 100) for d, can_id in ((0, 0x340), (9, 0x341))]
    stats = bench.replay(frames, passes=3).stats()
    times = [m.timestamp for m in bench.received if m.arbitration_id == 0x340]
    assert np.diff(times) == pytest.approx(np.full(8, 0.05), abs=1e-8)
    assert (stats.frames, stats.passes) == (18, 3)
    alone = planned(blocks_of([frame(0)]))
    assert alone.loop_ns > 0


@pytest.mark.parametrize(
    ("choice", "expected"),
    [
        pytest.param(Choice(), [0, 10, 20, 30], id="all"),
        pytest.param(Choice(time=(0.01, 0.02)), [10, 20], id="part"),
        pytest.param(Choice(time=(0.015, math.inf)), [20, 30], id="from"),
        pytest.param(Choice(time=(BEGIN / 1e9 + 0.015, math.inf)), [20, 30], id="of-the-clock"),
        pytest.param(Choice(channel="can1"), [10, 30], id="channel"),
        pytest.param(Choice("can0", has_key=lambda keys: keys != 0x340), [20], id="key"),
    ],
)
def test_what_is_chosen(choice: Choice, expected: list[int]) -> None:
    """By channel, time from the first frame of the log on, and CAN ID."""
    frames = [frame(0), frame(10, channel="can1"), frame(20, 0x7), frame(30, channel="can1")]
    kept = [t for block in choice.of(blocks_of(frames, 2)) for t in block.t_ns - BEGIN]
    assert kept == [t * 10**6 for t in expected]


@pytest.mark.parametrize(
    ("periods", "listen"), [((50,), 0.1), ((50, 200), 0.4), ((50, 900), 1.0), ((50, None), 1.0)]
)
def test_who_is_alive_is_found_within_two_periods(
    bench: Bench, periods: tuple[int | None, ...], listen: float
) -> None:
    """Of the CAN IDs that are replayed only; a message that comes once is waited for 1 s."""
    frames = sorted(
        (frame(k * (period or 0), 0x340 + i)
         for i, period in enumerate(periods) for k in range(3 if period else 1)),
        key=lambda one: one.t_ns,
    )  # fmt: skip
    plan = planned(blocks_of(frames))
    assert plan.listen == pytest.approx(listen)
    replay = Replay(bench.link, plan, clock=bench.clock)
    assert replay.alive() == []
    assert bench.clock.now == pytest.approx(5 + listen)
    other = bench.bus()
    for can_id in (0x123, 0x340):
        message = can.Message(arbitration_id=can_id, is_extended_id=False)
        other.send_periodic(message, listen * 0.9)
    assert replay.alive() == [CanId(0x340, False)]


class SlowLink(Link):
    """Link with a queue that is full for a time, on a clock that passes while it sends."""

    def __init__(self, bench: Bench, full: tuple[float, float], takes: float = 0.0) -> None:
        super().__init__(bench.bus())
        self._bench, self._from, self._takes = bench, [5 + t for t in full], takes

    def send(self, message: can.Message) -> Sent:
        clock = self._bench.clock
        if self._from[0] <= clock.now < self._from[1]:
            return Sent.FULL
        clock.run_for(self._takes)
        return super().send(message)


@pytest.mark.parametrize(
    ("full", "lost"),
    [
        pytest.param((0.0, 0.0), 0, id="never"),
        pytest.param((0.09, 0.15), 0, id="shorter-than-the-patience"),
        # The frame at 0.1 s waits until 0.2 s; those at 0.15 and 0.2 s are late, and given up.
        pytest.param((0.09, 0.3001), 5, id="longer"),
    ],
)
def test_frames_that_the_bus_refuses_are_counted(
    bench: Bench, full: tuple[float, float], lost: int
) -> None:
    """The first one waits; the next ones are given up at once, so that the replay is in time."""
    bench.link = SlowLink(bench, full)
    stats = bench.replay([frame(50 * k) for k in range(20)]).stats()
    assert (stats.full, stats.frames) == (lost, 20 - lost)
    assert len(bench.received) == 20 - lost
    assert bench.received[-1].timestamp == pytest.approx(5.95, abs=1e-3)
    assert stats.late_max <= PATIENCE + 0.002


def test_lateness_is_that_of_the_sender(bench: Bench) -> None:
    """A bus that takes 30 ms a frame is late by 10 ms more with each frame of a period of 20 ms."""
    bench.link = SlowLink(bench, (0, 0), takes=0.03)
    stats = bench.replay([frame(20 * k) for k in range(11)]).stats()
    assert stats.late_mean == pytest.approx(0.05)
    assert stats.late_max == pytest.approx(0.1)
    assert stats.late_p99 == pytest.approx(0.1, rel=0.05)


def test_as_fast_as_possible_the_bus_sets_the_pace(bench: Bench) -> None:
    """It waits for room; a bus that takes nothing is an error that says what to check."""
    bench.link = SlowLink(bench, (0.0, 1.5))
    stats = bench.replay([frame(1000 * k) for k in range(5)], speed=math.inf).stats()
    assert (stats.frames, stats.full) == (5, 0)
    assert bench.received[-1].timestamp == pytest.approx(6.5, abs=0.01)
    assert math.isnan(stats.late_mean)
    assert stats.as_dict()["late_max"] is None
    bench.link = SlowLink(bench, (0.0, 1.5 + LONG_PATIENCE + 1))
    with pytest.raises(BusError, match="taken no frame for 2 s; check that another node"):
        bench.replay([frame(0)], speed=math.inf)


@pytest.mark.parametrize(
    ("frames", "fd_keys", "words"),
    [
        pytest.param([frame(0, 0x348, bytes(32))], (), "0x348 are of CAN FD", id="length"),
        pytest.param([frame(0, 0x348)], (0x348,), "0x348 are of CAN FD", id="message-of-the-dbc"),
    ],
)
def test_a_classic_bus_gets_no_frame_of_can_fd(
    bench: Bench, frames: list[LogFrame], fd_keys: Any, words: str
) -> None:
    """One clear error before anything is sent; on a bus with CAN FD they are flagged."""
    assert bench.replay(frames, fd_keys=fd_keys).stats().frames == 1
    assert bench.received[0].is_fd
    bench.link._factory.fd = False
    with pytest.raises(BusError, match=words):
        bench.replay([frame(0), *frames], fd_keys=fd_keys)
    assert len(bench.received) == 1


def test_frames_that_cannot_be_sent_are_counted(bench: Bench) -> None:
    """No frame has 10 bytes; a log without any other has nothing to send."""
    odd = frame(5, data=bytes(10))
    assert bench.replay([frame(0), odd]).stats().unfit == 1
    assert len(bench.received) == 1
    with pytest.raises(LogError, match="no frame to send"):
        planned(blocks_of([odd]))
    with pytest.raises(ValueError, match="speed=inf"):
        bench.replay([frame(0, has_time=False)])
    with pytest.raises(ValueError, match="speed must be positive, got 0"):
        Replay(bench.link, Plan(), speed=0)


@pytest.mark.parametrize(
    ("text", "sent", "left_out"),
    [
        ("0x340-0x342", [0x340, 0x342], [0x343, 0x33F]),
        ("832", [0x340], [0x341]),
        ("0x340x", [CanId(0x340, True)], [0x340]),
        ("0x18ff0000-0x18ff00ff", [CanId(0x18FF0010, True)], [0x340]),
        ("ego-left", [0x340, 0x348, 0x350, 0x360], [0x341, 0x35C]),
        ("EgoLeft,pose", [0x340, 0x35C], [0x341]),
        ("lines", [0x340, 0x35C, 0x379], [0x123]),
        ("others", [0x123, CanId(0x340, True)], [0x340, 0x35C, 0x379]),
        ("scene", [0x379], [0x378]),
    ],
)
def test_only(text: str, sent: list[int | CanId], left_out: list[int | CanId]) -> None:
    """CAN IDs, ranges, slots, names of messages, lines and others."""
    spans = _spans(_only(text), LAYOUTS)

    def has(ids: list[int | CanId]) -> list[bool]:
        keys = [one.key if isinstance(one, CanId) else one for one in ids]
        return _has_key(spans, np.array(keys, np.uint32)).tolist()

    assert all(has(sent))
    assert not any(has(left_out))


@pytest.mark.parametrize(
    ("text", "words"),
    [("0x347-0x340", "a greater one"), ("0x7ff-0x800", "a greater one"), ("0x20000000", "29 bits")],
)
def test_ranges_that_are_none(text: str, words: str) -> None:
    """Wrong ones are errors of the option."""
    with pytest.raises(argparse.ArgumentTypeError, match=words):
        _only(text)


def written(path: Path, frames: list[LogFrame]) -> str:
    path.write_text(
        "".join(
            f"({f.t_ns // 10**9}.{f.t_ns % 10**9 // 1000:06d}) {f.channel} {f.can_id:03X}"
            f"{'##1' if len(f.data) > 8 else '#'}{f.data.hex()}\n"
            for f in frames
        )
    )
    return str(path)


LOG = [frame(k, 0x340 + k % 3, bytes([k] * 8)) for k in range(60)]


def test_the_command_sends_a_log(tmp_path: Path, capsys: Any) -> None:
    """On python-can's virtual bus: all frames of --only, twice, and says how late they were."""
    log = written(tmp_path / "a.log", LOG)
    with can.Bus(interface="virtual", channel="replay") as bus:
        words = ["--interface", "virtual", "--channel", "replay", "--only", "0x340,ego-right"]
        assert main(["replay", log, *words, "--loop", "2", "--speed", "10"]) == 0
        found = [bus.recv(5) for _ in range(80)]
        assert bus.recv(0) is None
    sent = [f for f in LOG if f.can_id < 0x342]
    assert [(m.arbitration_id, bytes(m.data)) for m in found if m] == [
        (f.can_id, f.data) for f in sent + sent
    ]
    out, err = capsys.readouterr()
    assert "sent 80 frames in 0.0" in out
    assert "in 2 passes" in out
    assert "(mean, 99 %, maximum)" in out
    assert "40 frames of 2 CAN IDs" in err
    assert "10 times as fast as recorded, 2 times" in err


def test_a_sender_that_is_alive_is_left_alone(tmp_path: Path, capsys: Any) -> None:
    """Its CAN IDs are named; --force sends all the same, and --only something else."""
    log = written(tmp_path / "a.log", LOG)
    words = ["--interface", "virtual", "--channel", "alive", "--as-fast-as-possible", "--json"]
    stop = threading.Event()

    def send() -> None:
        with can.Bus(interface="virtual", channel="alive") as bus:
            while not stop.wait(0.001):
                bus.send(can.Message(arbitration_id=0x341, is_extended_id=False))

    sender = threading.Thread(target=send)
    sender.start()
    try:
        with can.Bus(interface="virtual", channel="alive") as bus:
            assert bus.recv(30) is not None
            assert main(["replay", log, *words, "--time", "0..0.03"]) == 1
            err = capsys.readouterr().err
            assert "0x341 (ego right): another sender on virtual alive sends this" in err
            assert main(["replay", log, *words, "--force"]) == 0
            assert '"frames": 60' in capsys.readouterr().out
            assert main(["replay", log, *words, "--only", "0x340,0x342"]) == 0
            assert '"frames": 40' in capsys.readouterr().out
    finally:
        stop.set()
        sender.join()


FD = [frame(0, 0x348, bytes(32))]
TWO = [frame(0), frame(1, channel="can1")]


@pytest.mark.parametrize(
    ("frames", "words", "error"),
    [
        pytest.param(TWO, [], "has frames of the channels can0, can1; choose one by --log-channel",
                     id="channels"),
        pytest.param(TWO, ["--log-channel", "can9"], "its channels are can0, can1, not can9",
                     id="no-channel"),
        pytest.param(LOG, ["--time", "5..6"], "no frame to send", id="no-time"),
        pytest.param(LOG, ["--only", "warp"], "--only warp: is no CAN ID", id="no-name"),
        pytest.param([], [], "no frame to send", id="empty"),
    ],
)  # fmt: skip
def test_what_cannot_be_sent_is_one_line(
    frames: list[LogFrame], words: list[str], error: str, tmp_path: Path, capsys: Any
) -> None:
    """Before the bus is opened."""
    log = written(tmp_path / "a.log", frames)
    assert main(["replay", log, "--interface", "virtual", "--channel", "none", *words]) == 1
    err = capsys.readouterr().err
    assert error in err
    assert len(err.splitlines()) == 1


def test_a_log_without_times_or_with_damage(tmp_path: Path, capsys: Any) -> None:
    """The first is sent as fast as possible only; of the other, what is intact."""
    plain = tmp_path / "plain.log"
    plain.write_text("  can0  340   [2]  00 11\n")
    bus = ["--interface", "virtual", "--channel", "odd", "--force"]
    assert main(["replay", str(plain), *bus]) == 1
    assert "has no time stamps; give --as-fast-as-possible" in capsys.readouterr().err
    assert main(["replay", str(plain), *bus, "--as-fast-as-possible"]) == 0
    assert "sent 1 frames" in capsys.readouterr().out
    damaged = tmp_path / "damaged.log"
    damaged.write_text(
        "(1.0) can0 340#00\nno frame\n(1.001) can0 341#R\n(1.002) can0 20000080#0000000000000000\n"
    )
    assert main(["replay", str(damaged), *bus, "--loop", "2"]) == 1
    out, err = capsys.readouterr()
    assert err.count("error: ") == 1
    assert "not sent: 1 remote frame, 1 error frame" in out
    assert main(["replay", "-"]) == 1
    assert "give a file" in capsys.readouterr().err


def test_ctrl_c_ends_a_loop(tmp_path: Path, capsys: Any, monkeypatch: Any) -> None:
    """With the counters so far."""
    sent: list[Any] = []

    def send(_: Any, message: Any) -> Sent:
        sent.append(message)
        if len(sent) == 100:
            raise KeyboardInterrupt
        return Sent.OK

    monkeypatch.setattr(Link, "send", send)
    bus = ["--interface", "virtual", "--channel", "loop", "--loop", "--speed", "1000"]
    assert main(["replay", written(tmp_path / "a.log", LOG), *bus]) == 0
    assert "sent 99 frames" in capsys.readouterr().out


def test_faults_are_injected(tmp_path: Path, capsys: Any) -> None:
    """As with send."""
    bus = ["--interface", "virtual", "--channel", "faulty", "--as-fast-as-possible"]
    log = written(tmp_path / "a.log", LOG)
    assert main(["replay", log, *bus, "--faults", "loss=0.5,seed=1"]) == 0
    assert "faults: of 60 frames: " in capsys.readouterr().out


def test_times_of_the_log_are_kept_apart() -> None:
    """The plan is of all blocks, in whatever parts they come."""
    plans = [planned(blocks_of(LOG, size)) for size in (1, 7, 100)]
    for one, two in pairwise(plans):
        assert (one.frames, one.span, one.loop_ns) == (two.frames, two.span, two.loop_ns)
        assert one.can_ids == two.can_ids
