"""The command ``maplines send``."""

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from answers import one
from support.dbcs import edited
from support.fake_bus import FakeOpener, FakeTime
from support.fixtures import Capture, Patch
from support.lines import scenario_lines

from maplines_can import Link, MapLine, Transmitter
from maplines_can.cli import main
from maplines_can.simulation import scenario
from maplines_can.simulation.scenario_lines import AMPLITUDE, SPEED, weaving_ego
from maplines_can.values.line import lateral, transform_line


def test_it_ends_after_the_count(capsys: Capture, channel: str) -> None:
    """Each line is sent --count times, then the counters are printed."""
    bus = ["--interface", "virtual", "--channel", channel, "--rate", "200"]
    assert main(["send", *bus, "--count", "5", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["lines"] + result["overruns"] == 20  # a busy machine may skip periods
    assert result["frames"] == 4 * result["lines"] > 0
    assert result["down"] == result["full"] == 0


class Simulated(Transmitter):
    """A transmitter without a thread: ``wait`` sends on a simulated clock, and decodes."""

    made: "Simulated"
    now: FakeTime

    def __init__(self, _: Link, codec: Any, **settings: Any) -> None:
        self.opener, self.received = FakeOpener(), list[MapLine]()
        super().__init__(Link(self.opener), codec, clock=self.now.monotonic, **settings)
        self.decoder = codec.decoder(cycle_ms=1e3 * settings["period"])
        Simulated.made = self

    def start(self) -> "Simulated":
        return self

    def stop(self) -> None:
        super().stop()
        self._link.close()

    def wait(self, timeout: float | None = None) -> bool:
        assert timeout is not None
        end = self.now.ns + round(1e9 * timeout)
        while not self._tx_queue.over:
            step = self._tx_queue.wait(self.now.monotonic())
            due = None if step is None else self.now.ns + math.ceil(1e9 * step) + 1000
            if due is None or due > end:
                break
            self.now.ns = due
            transfer = self._next_transfer()
            assert transfer is not None
            self._send(transfer)
            for _ in range(self.opener.sent.qsize()):
                message = self.opener.sent.get(timeout=0)
                answer = one(self.decoder.feed(message.arbitration_id, message.data, self.now.ns))
                if isinstance(answer, MapLine):
                    self.received.append(answer)
        self.now.ns = max(end, self.now.ns)
        return self._tx_queue.over


@pytest.fixture
def simulated(monkeypatch: Patch) -> Any:
    """Return a function that runs ``maplines send`` on simulated time, and its transmitter."""
    now = Simulated.now = FakeTime(1_000_000_000_000)
    monkeypatch.setattr("maplines_can.cli.send.time", now)
    monkeypatch.setattr("maplines_can.bus.transmitter.time", now)
    monkeypatch.setattr("maplines_can.cli.send.Transmitter", Simulated)

    def run(*options: str) -> Simulated:
        bus = ["--interface", "virtual", "--channel", "simulated"]
        assert main(["send", *bus, "--json", *options]) == 0
        return Simulated.made

    return run


@pytest.mark.parametrize(
    "options",
    [
        pytest.param(["--rate", "1", "--count", "4"], id="slow"),
        pytest.param(["--count", "40", "--lines", "8"], id="rate of the DBC"),
        pytest.param(["--rate", "200", "--count", "100"], id="fast"),
        pytest.param(
            ["--components", "3", "--scenario", "street-turn", "--count", "9"], id="mixture"
        ),
        pytest.param(["--standstill", "--rate", "2", "--count", "4"], id="standstill"),
    ],
)
def test_item_11_the_lines_are_those_of_a_moving_car(
    simulated: Any, capsys: Capture, options: Any
) -> None:
    """Each is usable, and is that of the pose at its time, also at a low rate."""
    sender = simulated(*options)
    count = int(options[options.index("--count") + 1])
    scene = scenario("street-turn" if "street-turn" in options else "production")
    slots = {line.slot for line in sender.received}
    assert (
        len(sender.received) == count * len(slots) == json.loads(capsys.readouterr().out)["lines"]
    )
    for line in sender.received:
        assert line.is_usable
        assert line.age <= 0.24
        pose = scene.ego
        if "--standstill" not in options:
            pose = weaving_ego(scene, (line.t_ns or 0) / 1e9 - 1000 - line.age)
        components = 3 if "--components" in options else 1
        there = replace(scene, ego=pose)
        expected = {x.slot: x for x in scenario_lines(there, len(slots), components=components)}
        x = np.linspace(0.0, line.x_max, 5)
        assert line.y(x) == pytest.approx(expected[line.slot].y(x), abs=0.02)
    means = {line.gaussian.mean.tobytes() for line in sender.received}
    assert (len(means) == len(slots)) == ("--standstill" in options)


@pytest.mark.parametrize("name", ["production", "street-turn"])
def test_the_car_weaves_as_a_car_moves(name: str) -> None:
    """Moving its lines by its displacement gives those of the later pose, near the car."""
    scene, dt = scenario(name), 0.05
    curvature = 1 / 2000 if name == "production" else 0.0
    offsets = []
    for t in np.arange(0.0, 10.0, 0.7):
        old, new = weaving_ego(scene, t), weaving_ego(scene, t + dt)
        offsets.append(old.mean[1])
        c, s = np.cos(old.mean[2]), np.sin(old.mean[2])
        along, across = SPEED * dt, new.mean[1] - old.mean[1]
        turned = new.mean[2] - old.mean[2] + curvature * along
        displacement = [c * along + s * across, c * across - s * along, turned]
        before, after = (scenario_lines(replace(scene, ego=pose), 1)[0] for pose in (old, new))
        moved = transform_line(before.gaussian.mean, displacement, (-5.0, 10.0))
        x = np.linspace(-4.0, 4.0, 5)
        straight = 0.01 if name == "production" else 0.25  # the turn ahead of the car is fixed
        apart = lateral(moved, x) - lateral(after.gaussian.mean, x)
        assert np.abs(np.diff(apart)).max() < straight
        if name == "production":
            assert np.abs(apart).max() <= 0.01
    assert max(offsets) == pytest.approx(AMPLITUDE, rel=0.1)


def cycles(*can_ids: Any, to: str) -> Any:
    """Edits of a DBC: the cycle times of some messages, in milliseconds."""
    return [(rf'(BA_ "GenMsgCycleTime" BO_ {can_id}) 50;', rf"\1 {to};") for can_id in can_ids]


@pytest.mark.parametrize(
    ("edits", "rate"),
    [
        pytest.param([], 20.0, id="default"),
        pytest.param(cycles(r"\d+", to="100"), 10.0, id="all"),
        pytest.param(cycles(833, 841, to="25"), 40.0, id="shortest"),
        pytest.param(cycles(836, 844, to="25"), 20.0, id="of a line that is not sent"),
        pytest.param(cycles(r"\d+", to="0"), 20.0, id="none"),
    ],
)
def test_item_11_the_rate_is_that_of_the_dbc(
    simulated: Any, tmp_path: Any, capsys: Capture, edits: Any, rate: float
) -> None:
    """Of several lines the shortest cycle time; --rate takes precedence."""
    dbc = ["--dbc", str(edited(tmp_path, *edits)), "--lines", "3"]
    assert simulated(*dbc, "--count", "1")._period == pytest.approx(1 / rate)
    assert simulated(*dbc, "--count", "1", "--rate", "5")._period == 0.2
    capsys.readouterr()
    assert main(["demo", *dbc, "--seconds", "0.1", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rate"] == pytest.approx(rate)
