"""Our sender and receiver as FMUs on a bus: frames and lines are those of the Python package."""

from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
from support import fmus
from support.lines import random_lines

from maplines_can import Codec, Gaussian, Kind, MapLine, Slot, Status
from maplines_can.bus.tx_queue import TxQueue
from maplines_can.cosimulation import CoSimulation
from maplines_can.cosimulation.bus_operations import Transmit
from maplines_can.cosimulation.connections import SentFrame
from maplines_can.testing import FaultInjector, Faults
from maplines_can.wire import Frame

pytest.importorskip("fmpy")

from maplines_can.cli import main

pytestmark = fmus.needs_compiler
PERIOD = 0.05
BUS = "can-bus-simulation"


class Pair(NamedTuple):
    sender: Path
    receiver: Path


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Pair:
    folder = tmp_path_factory.mktemp("fmu")
    paths = Pair(folder / "sender.fmu", folder / "receiver.fmu")
    for path in paths:
        assert main(["generate", "fmu", path.stem, "--out", str(path)]) == 0
    return paths


def lines_at(k: int) -> list[MapLine]:
    """Return lines of a cycle; no age is a tie that the last bit of a time would round."""
    means, covs = random_lines(8, k)
    return [
        MapLine(slot, Gaussian(means[slot], covs[slot]), kind=Kind((k + slot) % 8),
                status=Status.DIAGONAL if k % 7 == slot else Status.FULL,
                x_min=-5.0, x_max=60.0 + slot, age=0.001 * (k % 90) + 0.00037)
        for slot in Slot
    ]  # fmt: skip


def inputs_of(line: MapLine) -> dict[tuple[str, str], Any]:
    """Return the inputs of the sender for a line."""
    slot, cov = line.slot.name, line.gaussian.cov
    values: dict[str, Any] = {"valid": True, "kind": int(line.kind), "status": int(line.status)}
    values |= {"x_min": line.x_min, "x_max": line.x_max, "age": line.age}
    values |= {f"mean[{i + 1}]": float(line.gaussian.mean[i]) for i in range(4)}
    values |= {f"cov[{i + 1},{j + 1}]": float(cov[i, j]) for i in range(4) for j in range(i + 1)}
    return {("sender", f"{slot}.{name}"): value for name, value in values.items()}


def cycles_of(seconds: float) -> list[float]:
    """Return the times at which new lines are published."""
    return [round(0.01 + PERIOD * k, 6) for k in range(round(seconds / PERIOD))]


def sent_by_python(seconds: float) -> list[tuple[float, Frame]]:
    """Return what a transmitter of the package sends, and when."""
    codec = Codec.from_dbc()
    queue = TxQueue(codec, PERIOD, fd=False, count=None, max_age=codec.layout.max_age)
    times, sent = [*cycles_of(seconds), seconds + PERIOD], []
    for k, (t, after) in enumerate(pairwise(times)):
        queue.put(lines_at(k), t)
        while (now := max(t, queue.first)) <= min(seconds, after - 1e-6):
            while (transfer := queue.take(now)) is not None:
                transfer = queue.renew(transfer, now) if now > transfer.latest else transfer
                sent += [(now, frame) for frame in transfer.frames]
    return sent


def simulate(
    fmu_paths: list[Path], seconds: float, faults: str | None = None, **settings: Any
) -> tuple[list[tuple[float, Frame]], list[Frame]]:
    """Run the sender, check the receiver every half a second, and return the frames.

    Returns:
        Time and frame on the bus, and the frames that the sender gave to the bus.
    """
    inputs = [
        (t, {key: v for line in lines_at(k) for key, v in inputs_of(line).items()})
        for k, t in enumerate(cycles_of(seconds))
    ]
    on_bus: list[tuple[float, Frame]] = []
    decoder = Codec.from_dbc().decoder()

    def record(frame: Transmit, time: float) -> None:
        assert not frame.is_remote
        if frame.can_id != 1:  # not that of the official node
            on_bus.append((time, Frame(*frame[:4])))
            decoder.feed(frame.can_id, frame.data, round(time * 1e9))

    injector = None
    if faults is not None:
        injector = FaultInjector[SentFrame](Faults.parse(faults), make_frame=SentFrame)
    values = settings.pop("values", {})
    with CoSimulation(
        fmu_paths, values=values, inputs=inputs, injector=injector, record=record, step=0.5,
        ignore_findings=True, **settings
    ) as simulation:  # fmt: skip
        given: list[Frame] = []
        accept = simulation.link.accept

        def accepted(channel: Any, operations: Any, now_ns: int) -> None:
            if channel.node.name == "sender":
                given.extend(Frame(*one[:4]) for one in operations if isinstance(one, Transmit))
            accept(channel, operations, now_ns)

        simulation.link.accept = accepted  # type: ignore[method-assign]

        def check() -> None:
            if simulation.now_ns == 0:
                return
            for slot in Slot:
                view = decoder.latest(slot, simulation.now_ns)
                assert simulation.get("receiver", f"{slot.name}.usable") == view.usable
                assert simulation.get("receiver", f"{slot.name}.age") == view.age
                if view.line is not None:
                    mean = [
                        simulation.get("receiver", f"{slot.name}.mean[{i}]") for i in range(1, 5)
                    ]
                    assert mean == view.line.gaussian.mean.tolist()
                    for i in range(4):
                        for j in range(i + 1):
                            name = f"{slot.name}.cov[{i + 1},{j + 1}]"
                            entry = view.line.gaussian.cov[i, j]
                            assert simulation.get("receiver", name) == pytest.approx(
                                entry, rel=1e-13
                            )

        simulation.run(seconds, check)
        assert simulation.get("receiver", "lines") == decoder.lines > 0
    return on_bus, given


def test_frames_and_lines_are_those_of_python(pair: Pair) -> None:
    on_bus, given = simulate(list(pair), 3.0)
    expected = sent_by_python(3.0)
    assert len(expected) > 1500
    assert given == [frame for _, frame in expected]
    # Frames of one instant arbitrate; otherwise the bus has no delay.
    times = [time for time, _ in on_bus]
    assert times == pytest.approx([time for time, _ in expected], abs=2e-9)
    assert sorted(frame for _, frame in on_bus) == sorted(given)


@pytest.mark.parametrize("faults", ["loss=0.05,dup=0.03,corrupt=0.05,seed=3", "loss=1@0.6-1.6"])
def test_lines_are_those_of_python_with_faults(pair: Pair, faults: str) -> None:
    on_bus, given = simulate(list(pair), 2.5, faults, bitrate=500_000)
    assert len(on_bus) != len(given)


@fmus.needs_official
def test_lines_pass_through_the_official_bus_simulation(pair: Pair) -> None:
    """Its frames take 52 bits each, and it sends those of a node in their order."""
    on_bus, given = simulate([*pair, fmus.official(BUS)], 2.0)
    expected = [frame for _, frame in sent_by_python(2.0)]
    assert given == expected
    # After the wait for both bit rates, 4 frames of a slot follow each other in 104 us.
    assert [frame for _, frame in on_bus] == expected[: len(on_bus)]
    assert len(on_bus) > len(given) - 8
    gaps = np.diff([time for time, _ in on_bus])
    assert min(gaps) == pytest.approx(104e-6, abs=1e-9)


@fmus.needs_official
def test_the_official_node_shares_the_bus(pair: Pair) -> None:
    """Three nodes: the bus of this package, at the bit rate of the official node."""
    node = fmus.official("can-node-triggered-output")
    rate = {(name, "CAN.baud_rate"): 100_000 for name in ("sender", "receiver")}
    cycle = {("sender", "cycle_time"): 0.5}
    on_bus, _ = simulate([*pair, node], 3.0, values=rate | cycle, bitrate=0)
    assert len(on_bus) > 30
