"""Co-simulations of test nodes: times, links, faults, values, and errors."""

import shutil
import zipfile
from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from support import fmus

from maplines_can.cosimulation import CoSimulation
from maplines_can.cosimulation.bus_operations import Transmit
from maplines_can.cosimulation.connections import SentFrame
from maplines_can.cosimulation.fmu_description import read_description
from maplines_can.cosimulation.runner import node_names
from maplines_can.testing import FaultInjector, Faults
from maplines_can.values.errors import FmuError

pytest.importorskip("fmpy")
pytestmark = fmus.needs_compiler
#: Longest time of a frame of 8 bytes at 500 kbit/s [s].
FRAME = 0.00027


class Recorder:
    """Frames on the bus and their times."""

    def __init__(self) -> None:
        self.frames: list[tuple[float, int]] = []

    def __call__(self, frame: Transmit, time: float) -> None:
        self.frames.append((time, frame.can_id))


@pytest.fixture
def node(tmp_path: Path) -> Path:
    return fmus.write_node(tmp_path / "node.fmu")


def run(fmu_paths: list[Path], seconds: float, **settings: Any) -> tuple[CoSimulation, Recorder]:
    """Run to an end; the simulation is closed."""
    recorder = Recorder()
    with CoSimulation(fmu_paths, record=recorder, **settings) as simulation:
        simulation.run(seconds)
        simulation.result = {  # type: ignore[attr-defined]
            name: {
                key: simulation.get(name, key)
                for key in ("received", "last", "last.at", "confirmed", "lost", "errors")
            }
            for name in simulation.nodes
        }
    return simulation, recorder


@pytest.mark.parametrize("clock", ["countdown", "fraction", "changing"])
def test_frames_are_sent_when_a_clock_ticks(tmp_path: Path, clock: str) -> None:
    """The step is as long as the simulation: only clocks make communication points."""
    path = fmus.write_node(tmp_path / "node.fmu", clock)
    values = {("node", "period"): 0.0123, ("node_2", "period"): 1e9}
    simulation, recorder = run([path, path], 1.0, values=values, step=1.0)
    assert recorder.frames == [(round(0.0123 * i, 9), 0x123) for i in range(1, 82)]
    assert simulation.result["node_2"]["received"] == 81  # type: ignore[attr-defined]
    assert simulation.points == 82


def test_a_constant_clock_ticks_with_its_interval_and_shift(tmp_path: Path) -> None:
    path = fmus.write_node(tmp_path / "node.fmu", "constant")
    values = {("node", "period"): 0.05, ("node_2", "period"): 1e9}
    _, recorder = run([path, path], 0.3, values=values, step=1.0)
    assert [time for time, _ in recorder.frames] == pytest.approx([0.05, 0.1, 0.15, 0.2, 0.25, 0.3])


@pytest.mark.parametrize(("step", "first"), [(0.001, 0.013), (0.01, 0.02), (0.05, 0.05)])
def test_a_triggered_clock_ticks_at_communication_points(
    tmp_path: Path, step: float, first: float
) -> None:
    path = fmus.write_node(tmp_path / "node.fmu", "triggered")
    values = {("node", "period"): 0.0123, ("node_2", "period"): 1e9}
    _, recorder = run([path, path], 0.1, values=values, step=step)
    assert recorder.frames[0] == (first, 0x123)
    assert len(recorder.frames) == 8


@pytest.mark.parametrize("clock", ["countdown", "triggered"])
def test_values_arrive_and_are_confirmed(tmp_path: Path, clock: str) -> None:
    path = fmus.write_node(tmp_path / "node.fmu", clock)
    values = {("node", "gain"): 2.5, ("node", "notifications"): "true", ("node_2", "gain"): 1.5}
    simulation, _ = run([path, path], 1.0, values=values)
    result = simulation.result  # type: ignore[attr-defined]
    assert result["node"] == {
        "received": 10, "last": [1.5, 1.5], "last.at": 1.0, "confirmed": 10, "lost": 0, "errors": 0
    }  # fmt: skip
    assert result["node_2"]["last"] == [2.5, 2.5]
    assert result["node_2"]["confirmed"] == 0
    assert simulation.link.frames == 20


def test_frames_take_their_time_on_the_bus(node: Path) -> None:
    values = {(name, "can_id"): can_id for name, can_id in zip(
        ("node", "node_2", "node_3"), (3, 1, 2), strict=True
    )}  # fmt: skip
    _, recorder = run([node] * 3, 0.25, values=values, bitrate=500_000)
    expected = [(0.1 * k + n * FRAME, n) for k in (1, 2) for n in (1, 2, 3)]
    assert [can_id for _, can_id in recorder.frames] == [can_id for _, can_id in expected]
    assert [t for t, _ in recorder.frames] == pytest.approx([t for t, _ in expected], abs=1e-12)


def test_nodes_configure_the_bus(node: Path) -> None:
    """The first node discards the frame that loses arbitration, and is told so."""
    values = {
        ("node", "bit_rate"): 250_000,
        ("node", "discard"): True,
        ("node", "can_id"): 2,
        ("node_2", "can_id"): 1,
    }
    simulation, recorder = run([node, node], 1.05, values=values, bitrate=0)
    assert [can_id for _, can_id in recorder.frames] == [1] * 10
    assert recorder.frames[0][0] == pytest.approx(0.1 + 2 * FRAME, abs=1e-12)
    assert simulation.result["node"]["lost"] == 10  # type: ignore[attr-defined]


def test_faults_are_injected_before_the_bus(node: Path) -> None:
    faults = Faults.parse("loss=1@0.25-0.55,delay=0.0043@0.65-,flood=100@0.05-0.09")
    injector = FaultInjector[SentFrame](faults, stream="send", make_frame=SentFrame)
    values = {("node", "gain"): 1.0, ("node_2", "period"): 1e9}
    _, recorder = run([node, node], 1.0, values=values, injector=injector)
    sent = [time for time, can_id in recorder.frames if can_id == 0x123]
    assert sent == [0.1, 0.2, 0.6, 0.7043, 0.8043, 0.9043]
    assert [time for time, can_id in recorder.frames if can_id == 0] == pytest.approx(
        [0.06, 0.07, 0.08]
    )
    counts = injector.as_dict()
    assert (counts["lost"], counts["flooded"], counts["held"]) == (3, 3, 1)


def test_a_corrupt_operation_is_counted_and_answered(node: Path) -> None:
    values = {("node", "corrupt"): True, ("node_2", "period"): 1e9}
    simulation, recorder = run([node, node], 0.55, values=values)
    assert recorder.frames == []
    assert simulation.result["node"]["errors"] == 5  # type: ignore[attr-defined]
    assert simulation.link.problems == Counter(
        {"node.Can: operation 0x77 of 8 bytes: there is no such operation": 5}
    )


def test_inputs_are_set_at_their_times(node: Path) -> None:
    seen: list[tuple[float, float]] = []
    inputs = [(0.05, {("node", "gain"): "3"}), (0.2342, {("node", "gain"): "4"})]
    with CoSimulation([node, node], inputs=inputs, step=0.1) as simulation:
        simulation.run(
            0.3, lambda: seen.append((simulation.now, simulation.get("node_2", "last")[0]))
        )
        simulation.set("node", "store", [1.0, 2.0])
        simulation.run(0.4)
        assert simulation.get("node", "store") == [1.0, 2.0]
        assert simulation.get("node_2", "last") == [4.0, 4.0]
    assert seen == [(0.0, 0.0), (0.1, 3.0), (0.2, 3.0), (0.3, 4.0)]


def test_each_step_is_called_at_the_end_too(node: Path) -> None:
    """It is, whether or not the end is a multiple of the step, and once."""
    seen: list[float] = []
    with CoSimulation([node, node], step=0.1) as simulation:
        simulation.run(0.25, lambda: seen.append(simulation.now))
        simulation.run(0.3, lambda: seen.append(simulation.now))
        simulation.set("node", "store", [1.0, 2.0])
        simulation.run(0.3, lambda: seen.append(simulation.now))
    assert seen == [0.0, 0.1, 0.2, 0.25, 0.3]
    values = {("node", "end_at"): 0.123}
    with CoSimulation([node, node], values=values, step=0.1) as simulation:
        simulation.run(1.0, lambda: seen.append(simulation.now))
        assert seen[-1] == simulation.now < 0.3


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["a/n.fmu", "n_2.fmu", "b/n.fmu"], ["n", "n_2", "n_3"]),
        (["a/n.fmu", "b/n.fmu", "n_2.fmu"], ["n", "n_3", "n_2"]),
        (["n_2.fmu", "a/n.fmu", "b/n.fmu", "c/n_2.fmu"], ["n_2", "n", "n_3", "n_2_2"]),
        (["n.fmu"] * 4, ["n", "n_2", "n_3", "n_4"]),
    ],
)
def test_each_node_has_a_name_of_its_own(paths: list[str], names: list[str]) -> None:
    assert [(name, str(path)) for name, path in node_names(paths).items()] == [
        *zip(names, paths, strict=True)
    ]


def test_an_archive_may_have_entries_of_folders(tmp_path: Path, node: Path) -> None:
    """``shutil.make_archive``, ``zip -r`` and ``fmpy compile`` write them."""
    with zipfile.ZipFile(node) as fmu:
        fmu.extractall(tmp_path / "files")
    (tmp_path / "files" / "binaries" / "x86_64-windows").mkdir()
    (tmp_path / "files" / "binaries" / "readme.txt").touch()
    packed = shutil.make_archive(str(tmp_path / "packed"), "zip", tmp_path / "files")
    again = Path(packed).rename(tmp_path / "again.fmu")
    assert "binaries/" in zipfile.ZipFile(again).namelist()
    assert read_description(again).platforms == read_description(node).platforms
    simulation, _ = run([again, node], 0.25)
    assert simulation.link.frames == 4


def test_a_node_of_fixed_steps_steps_at_the_grid_only(tmp_path: Path, node: Path) -> None:
    """It receives what was sent between its steps at the next of them."""
    fixed = fmus.write_node(tmp_path / "fixed.fmu", "triggered", ('Size="true"', 'Size="false"'))
    values = {("node", "period"): 0.0123, ("fixed", "period"): 1e9}
    simulation, recorder = run([node, fixed], 0.1, values=values, step=0.02)
    assert [time for time, _ in recorder.frames] == [round(0.0123 * i, 9) for i in range(1, 9)]
    result = simulation.result["fixed"]  # type: ignore[attr-defined]
    assert (result["received"], result["last.at"]) == (8, pytest.approx(0.1))


def test_a_node_ends_the_simulation(node: Path) -> None:
    simulation, _ = run([node, node], 1.0, values={("node_2", "end_at"): 0.405})
    assert (simulation.ended_by, simulation.now_ns) == ("node_2", 410_000_000)


def test_an_error_of_a_node_names_it_and_the_time(node: Path) -> None:
    with pytest.raises(FmuError, match=r"node_2: doStep failed at 0\.4 s"):
        run([node, node], 1.0, values={("node_2", "fail_at"): 0.405})


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"values": {("other", "gain"): "1"}}, "no node 'other'; there are node, node_2"),
        ({"values": {("node", "other"): "1"}}, "node has no variable 'other'"),
        ({"values": {("node", "Can.Tx_Data"): "1"}}, "node has no variable 'Can.Tx_Data'"),
        ({"values": {("node", "gain"): "much"}}, "node.gain is a Float64, got 'much'"),
        ({"values": {("node", "notifications"): "2"}}, "is a Boolean, got '2'"),
        ({"values": {("node", "can_id"): "1.5"}}, "is a UInt32, got '1.5'"),
        ({"step": 1e-12}, "step must be at least a nanosecond"),
    ],
)
def test_wrong_settings(node: Path, settings: dict[str, Any], message: str) -> None:
    with pytest.raises(FmuError, match=message):
        CoSimulation([node, node], **settings)


def test_an_fmu_that_breaks_the_standard_is_refused(tmp_path: Path) -> None:
    broken = ("version=&quot;1.0.0&quot;", "version=&quot;2.0.0&quot;")
    path = fmus.write_node(tmp_path / "node.fmu", "countdown", broken)
    with pytest.raises(FmuError, match=r"mimeType is .* \(and 1 more\); 'maplines fmu check'"):
        CoSimulation([path, path])
    simulation, _ = run([path, path], 0.1, ignore_findings=True)
    assert simulation.link.frames == 2


def test_an_fmu_without_a_binary_for_this_platform_is_refused(tmp_path: Path) -> None:
    path = fmus.write_node(tmp_path / "node.fmu", with_binary=False)
    with pytest.raises(FmuError, match=r"has no binary for .* \(binaries: none\)"):
        CoSimulation([path, path])


def test_an_fmu_that_refuses_its_token_is_an_error(tmp_path: Path) -> None:
    path = fmus.write_node(tmp_path / "node.fmu", "countdown", ('"test-node"', '"another"'))
    with pytest.raises(FmuError, match="node: cannot be loaded"):
        CoSimulation([path])


def test_a_clock_that_never_rests_is_an_error(tmp_path: Path) -> None:
    path = fmus.write_node(tmp_path / "node.fmu")
    with pytest.raises(FmuError, match=r"(events at .* s do not end|is to tick in)"):
        run([path, path], 1.0, values={("node", "period"): -0.001})
