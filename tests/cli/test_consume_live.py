"""maplines consume on a live bus."""

import argparse
import json
import re
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import can
import cantools
import numpy as np
import pytest
from support.drive_files import CAR_DBC, car_signals
from support.fake_bus import FakeTime, message_of, wait_until
from support.fixtures import Capture, Patch

from maplines_can import (
    Codec,
    Gaussian,
    MapLine,
    Motion,
    Polyline,
    Receiver,
    Slot,
    map_scene,
)
from maplines_can.cli import main
from maplines_can.cli.consume_input import motion_of
from maplines_can.wire import Frame, Reason, default_dbc_path

DBC = "maplines-pose.dbc"
STEP_NS = 50_000_000
NOISE = np.diag([0.05, 0.003, 2e-4, 2e-6]) ** 2


CODEC = Codec.from_dbc(default_dbc_path(DBC))
LANE = {
    slot: Polyline([[x, y] for x in range(-50, 121, 5)])
    for slot, y in ((Slot.EGO_LEFT, 1.75), (Slot.EGO_RIGHT, -1.75))
}
#: A straight lane of 3.5 m.
SCENE = map_scene(
    LANE, Gaussian(np.zeros(3), np.diag([0.1, 0.1, 0.003]) ** 2), correlation_time=5.0
)


def seen() -> list[MapLine]:
    """Return what a camera sees."""
    return [
        MapLine(line.slot, Gaussian(line.gaussian.mean, NOISE), x_max=40.0) for line in SCENE.lines
    ]


def has_arrived(receiver: Receiver, sent: list[int]) -> bool:
    """Return whether the frames of its messages have arrived; without any, all those that pass."""
    stats = receiver.stats()
    own = sum(can_id in receiver._decoder.can_ids for can_id in sent)
    if not own and receiver._can_ids is None:
        return stats.frames >= len(sent)
    return stats.frames - stats.counts.get(Reason.FOREIGN, 0) >= own


class Sender:
    """Sender in step with the consumer: while that waits, it sends a cycle and sets the clock.

    So what is received depends on no time of this machine.
    """

    def __init__(self, channel: str, clock: FakeTime, capsys: Capture) -> None:
        self.channel, self.clock, self.capsys = channel, clock, capsys
        self.send: Callable[[int, Any], None]
        self.receivers: list[Receiver] = []
        self._cycle = 0
        self._buses: dict[str, can.BusABC] = {}
        self._sent: dict[str, list[int]] = {}

    def run(
        self, send: Callable[[int, Any], None], *options: object
    ) -> tuple[int, list[str], list[Any], str]:
        """Return status, output, its rows and standard error of a consumer.

        It receives what a function sends in each cycle.
        """
        self.send, self._cycle = send, 0
        self.receivers.clear()
        self._sent.clear()
        given = [str(option) for option in options]
        given += [] if "--dbc" in given else ["--dbc", DBC]
        status = main(["consume", *given, "--interface", "virtual", "--channel", self.channel])
        out, err = self.capsys.readouterr()
        rows = [json.loads(line) for line in out.splitlines()] if "--json" in given else []
        return status, out.splitlines(), rows, err

    def put(self, frames: Any, channel: str | None = None) -> None:
        """Send frames, by default on the channel of the map lines."""
        name = channel or self.channel
        if name not in self._buses:
            self._buses[name] = can.Bus(interface="virtual", channel=name, preserve_timestamps=True)
        for frame in frames:
            self._sent.setdefault(name, []).append(frame.can_id)
            self._buses[name].send(message_of(frame, timestamp=self.clock.ns / 1e9))

    def wait(self, *_: Any) -> bool:
        """Stand in for ``Receiver.wait``, which a consumer calls once in each cycle."""
        self.clock.ns += STEP_NS
        self.send(self._cycle, self.put)
        self._cycle += 1
        for receiver in self.receivers:
            sent = self._sent.get(receiver._link.name.split()[-1], [])
            wait_until(lambda one=receiver, sent=sent: has_arrived(one, sent))
        return False

    def close(self) -> None:
        for bus in self._buses.values():
            bus.shutdown()


@pytest.fixture
def live(channel: str, monkeypatch: Patch, capsys: Capture) -> Iterator[Sender]:
    clock, start = FakeTime(), Receiver.start
    sender = Sender(channel, clock, capsys)

    def started(receiver: Receiver) -> Receiver:
        sender.receivers.append(receiver)
        return start(receiver)

    monkeypatch.setattr("maplines_can.bus.receiver.time", clock)
    monkeypatch.setattr("maplines_can.cli.consume_input.time", clock)
    monkeypatch.setattr(Receiver, "start", started)
    monkeypatch.setattr(Receiver, "wait", sender.wait)
    yield sender
    sender.close()


def scenes(cycles: int = 10**6) -> Callable[[int, Any], None]:
    """Return a function that sends the scene in each of the first cycles."""
    encoder = CODEC.encoder()
    prepared = encoder.prepare_scene(SCENE)

    def send(cycle: int, put: Any) -> None:
        if cycle < cycles:
            for frames in encoder.encode_scene(prepared, age=0.02).values():
                put(frames)

    return send


def test_fusion_with_the_camera_of_another_channel(live: Sender) -> None:
    """Its lines are used from the scenes on, each once; without it, none are."""
    send_scene, plain, lines = scenes(), Codec.from_dbc().encoder(), seen()
    camera = f"{live.channel}-camera"

    def send(cycle: int, put: Any) -> None:
        send_scene(cycle, put)
        for line in lines if cycle % 2 == 0 else []:
            put(plain.encode(line), camera)

    fusion = ["fusion", "--speed", 0, "--seconds", 2, "--json"]
    status, _, found, err = live.run(send, *fusion, "--camera-channel", camera, "--every", 0.05)
    assert (status, err) == (0, "")
    used = [row["camera"] for row in found]
    assert 15 <= sum(map(bool, used)) <= 20
    assert all(not (one and other) for one, other in pairwise(used))
    with_camera = found[-1]["centre"][0]["sigma"]
    status, _, found, _ = live.run(send_scene, *fusion)
    assert status == 0
    assert not any(row["camera"] for row in found)
    assert with_camera < 0.7 * found[-1]["centre"][0]["sigma"]
    assert found[-1]["centre"][0]["value"] == pytest.approx(0.0, abs=0.02)


@pytest.fixture
def signals(tmp_path: Path) -> list[object]:
    """Options of the signals of a car."""
    return car_signals(tmp_path)


def esp(speed: float, yaw_rate: float) -> list[Frame]:
    """Return the frame of a speed [m/s] and a yaw rate [rad/s], as cantools encodes it."""
    database: Any = cantools.database.load_string(CAR_DBC, "dbc")
    values = {"VehicleSpeed": 3.6 * speed, "YawRate": np.degrees(yaw_rate)}
    return [Frame(1, database.encode_message("ESP", values))]


@pytest.mark.parametrize("separate", [False, True])
def test_fusion_with_the_motion_of_signals_on_the_bus(
    live: Sender, separate: bool, signals: list[object]
) -> None:
    """A car in a bend sees a straight lane turn, also without scenes."""
    bend, send_scene = esp(10.0, 0.2), scenes(20)
    other = f"{live.channel}-car" if separate else live.channel

    def send(cycle: int, put: Any) -> None:
        send_scene(cycle, put)
        if cycle < 30:
            put([bend[0]._replace(data=b"\x01")] if cycle == 5 else bend, other)

    where = ["--signals-channel", other] if separate else []
    fusion = ["fusion", *signals, *where, "--seconds", 2.2, "--every", 0.05, "--json"]
    status, _, found, err = live.run(send, *fusion)
    assert status == 0
    assert "skipped: the data do not fit the message ESP (1)" in err
    by_t = {round(row["t"] - found[0]["t"], 2): row["centre"] for row in found}
    begin, end = (by_t[t][1] for t in (1.05, 1.45))  # without scenes, 20 m ahead
    # The lane moves by the turn of the car over these 20 m, and over the way driven.
    turn = 0.2 * 0.4
    assert end["value"] - begin["value"] == pytest.approx(-20 * turn - 4.0 * 0.04, rel=0.1)


def test_the_last_signals_count_for_half_a_second(channel: str, signals: list[object]) -> None:
    """Frames of other messages, and frames without data, change nothing."""
    arguments = argparse.Namespace(
        **dict.fromkeys(("log", "motion", "speed", "signals_channel", "bitrate", "data_bitrate")),
        encoding=None, interface="virtual", channel=channel, fd=False,
        signals=signals[1], signals_dbc=signals[3],
    )  # fmt: skip
    with (
        can.Bus(interface="virtual", channel=channel) as bus,
        motion_of(arguments, Motion(15.0, 0.0)) as motion,
    ):
        assert motion(0) is None
        for frame in (*esp(20.0, 0.3), *esp(10.0, -0.2), Frame(2, bytes(8)), Frame(1, b"")):
            bus.send(message_of(frame))
        for now_ns in (STEP_NS, STEP_NS + 500_000_000):
            known = motion(now_ns)
            assert known is not None
            assert [known.speed, known.yaw_rate] == pytest.approx([10.0, -0.2], abs=2e-3)
        assert motion(STEP_NS + 500_000_001) is None
        bus.send(message_of(esp(30.0, 0.0)[0]))
        assert motion(STEP_NS + 3_000_000_000) is None  # it may have waited for all this time
        bus.send(message_of(esp(30.0, 0.0)[0]))
        assert motion(STEP_NS + 3_050_000_000) is not None


def test_signals_that_do_not_arrive_are_reported(live: Sender, signals: list[object]) -> None:
    status, _, _, err = live.run(scenes(), "fusion", *signals, "--seconds", 1.5)
    assert status == 0
    assert "no speed and no yaw_rate has arrived; check --signals-channel" in err


CONSUMERS = [["steer"], ["fusion"], ["check", "--simulate"]]


@pytest.mark.parametrize("consumer", CONSUMERS)
def test_a_consumer_runs_until_ctrl_c(live: Sender, consumer: list[str]) -> None:
    """Ctrl-C while it has results: status 0, no traceback."""
    send_scene = scenes()

    def send(cycle: int, put: Any) -> None:
        if cycle == 20:
            raise KeyboardInterrupt
        send_scene(cycle, put)

    status, out, _, err = live.run(send, *consumer, "--every", "0.05")
    assert (status, "error" in err) == (0, False), err
    assert len(out) > 5


@pytest.mark.parametrize("consumer", CONSUMERS)
@pytest.mark.parametrize(
    ("sent", "words"),
    [
        ("nothing", "no frame has arrived; check .*--fd"),
        ("others", r"records? of maplines\.dbc are whole; take --dbc maplines\.dbc"),
        ("damaged", r"frames have arrived, but none completed a line \(dropped: .*\); no record of "
         r"maplines-pose\.dbc is whole .*; take the --dbc of the sender"),
        ("lines", "the sender must send the pose error, too"),
    ],
)  # fmt: skip
def test_a_bus_without_scenes_is_one_clear_line(
    live: Sender, consumer: list[str], sent: str, words: str
) -> None:
    """Of another DBC, or without the pose error; status 1."""
    plain = [one for line in SCENE.lines for one in Codec.from_dbc().encoder().encode(line)]
    own = [one for frames in CODEC.encoder().encode_scene(SCENE).values() for one in frames]
    damaged = [one._replace(data=bytes(len(one.data))) for one in own]
    frames = {"nothing": [], "others": plain, "damaged": damaged, "lines": plain}[sent]
    dbc = "maplines.dbc" if sent == "lines" else DBC
    options = [*consumer, "--seconds", 0.5, "--dbc", dbc]
    status, _, _, err = live.run(lambda _, put: put(frames), *options)
    assert status == 1
    (error,) = [line for line in err.splitlines() if "error:" in line]
    assert re.search(words, error), error
