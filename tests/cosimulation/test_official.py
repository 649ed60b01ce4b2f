"""The official examples of FMI-LS-BUS: checks of them, and co-simulations."""

from pathlib import Path

import pytest
from support import fmus

from maplines_can.cosimulation import CoSimulation, check, read_description
from maplines_can.cosimulation.bus_operations import Transmit
from maplines_can.values.errors import FmuError

pytest.importorskip("fmpy")
pytestmark = [fmus.needs_compiler, fmus.needs_official]
NODE, BUS = "can-node-triggered-output", "can-bus-simulation"


def test_the_node_is_refused_for_its_version_and_its_clock() -> None:
    found = {f"{one.where}: {one.what}" for one in check(read_description(fmus.official(NODE)))}
    assert "manifest: fmi-ls-version is '1.0.0-beta.1'" in found
    assert "clock CanChannel.Tx_Clock: does not stand under InitialUnknown" in found
    with pytest.raises(FmuError, match=r"1\.0\.0-beta\.1"):
        CoSimulation([fmus.official(NODE)])


def test_the_bus_simulation_connects_the_nodes_and_confirms() -> None:
    times = []
    paths = [fmus.official(NODE), fmus.official(BUS), fmus.official(NODE)]

    def record(frame: Transmit, time: float) -> None:
        times.append(time)
        assert frame == Transmit(1, bytes((1, 2, 3, 4)))

    with CoSimulation(paths, ignore_findings=True, record=record) as simulation:
        simulation.run(1.0)
        link = simulation.link
        counts = [(link.sent[c.label], link.received[c.label]) for c in link.channels]
        assert counts == [(3, 3), (3, 3)]
        assert [link.confirmed[channel.label] for channel in link.channels] == [3, 3]
    # 44 + 4 bits at the 100 kbit/s that the nodes configure
    expected = [0.3 * k + n * 48e-5 for k in (1, 2, 3) for n in (1, 2)]
    assert times == pytest.approx(expected, abs=1e-9)


def test_our_node_beside_the_official_one(tmp_path: Path) -> None:
    own = fmus.write_node(tmp_path / "own.fmu")
    values = {("own", "bit_rate"): 100_000, ("own", "notifications"): True, ("own", "gain"): 7.0}
    paths = [own, fmus.official(BUS), fmus.official(NODE)]
    with CoSimulation(paths, ignore_findings=True, values=values) as simulation:
        simulation.run(3.0)
        assert simulation.get("own", "received") == 9  # the tenth is still on the bus
        assert simulation.get("own", "confirmed") == 29
        assert simulation.get("own", "errors") == 0
