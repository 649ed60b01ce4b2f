"""The receiver as an FMU gives the lines of the Python package."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.fmu_nodes import Node, transmission
from support.lines import random_lines
from support.scene_streams import new_codec, road_scene

from maplines_can import Codec, Gaussian, Kind, MapLine, Slot
from maplines_can.values.line import LEFT_OUT
from maplines_can.wire import Decoder, Reason

pytest.importorskip("fmpy", reason="the headers of FMI and the importer come from fmpy")

from maplines_can.cli import main


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fmu") / "receiver.fmu"
    assert main(["generate", "fmu", "receiver", "--out", str(path)]) == 0
    return path


@pytest.fixture
def node(fmu: Path) -> Iterator[Node]:
    made = Node(fmu, fmu.with_suffix(""))
    yield made
    made.close()


#: Where the receiver evaluates lines by default [m].
X = (0.0, 20.0, 40.0, 80.0)
ROWS, COLUMNS = np.tril_indices(4)


def check_slot(node: Node, decoder: Decoder, slot: Slot, t_ns: int) -> None:
    """Check that a slot is as the decoder of the Python package has it."""
    view, stats, name = decoder.latest(slot, t_ns), decoder.slots(t_ns).get(slot), slot.name
    assert node.get(f"{name}.usable") == view.usable
    assert node.get(f"{name}.stale") == view.stale
    assert node.get(f"{name}.two_senders") == view.two_senders
    assert node.get(f"{name}.e2e_state") == view.state
    assert node.get(f"{name}.e2e_status") == (0xFF if view.status is None else view.status)
    assert node.get(f"{name}.age") == view.age
    assert node.get(f"{name}.received") == (view.line is not None)
    is_whole = "scene" in decoder.checks
    if stats is not None and not is_whole:
        for count in ("ok", "lost", "repeated", "wrong_sequence", "errors", "no_new_data"):
            assert node.get(f"{name}.{count}") == getattr(stats, count)
    if is_whole:
        left_out = node.get(f"{name}.left_out")
        assert left_out == (0 if view.left_out is None else LEFT_OUT.index(view.left_out))
    if (line := view.line) is None:
        assert node.get(f"{name}.y_sigma") == [math.inf] * len(X)
        return
    assert node.get(f"{name}.mean") == line.gaussian.mean.tolist()
    np.testing.assert_allclose(
        node.get(f"{name}.cov"), line.gaussian.cov[ROWS, COLUMNS], rtol=1e-13, atol=1e-300
    )
    assert [node.get(f"{name}.{what}") for what in ("kind", "status", "x_min", "x_max")] == [
        line.kind, line.status, line.x_min, line.x_max,
    ]  # fmt: skip
    # Beyond the range nothing is known, as without a line: 0, and an infinite sigma.
    inside = line.is_valid_at(X)
    y, sigmas = np.where(inside, line.y(X), 0.0), np.where(inside, line.y_sigma(X), math.inf)
    np.testing.assert_allclose(node.get(f"{name}.y"), y, rtol=1e-13, atol=1e-14)
    np.testing.assert_allclose(node.get(f"{name}.y_sigma"), sigmas, rtol=1e-13)


def test_lines_are_those_of_python(node: Node) -> None:
    """Bit for bit: with lost, repeated and corrupt frames, at any time."""
    rng = np.random.default_rng(5)
    codec = Codec.from_dbc()
    encoder, decoder = codec.encoder(), codec.decoder()
    means, covs = random_lines(8 * 40, 1)
    for k in range(40):
        node.step(0.05 * (k + 1))
        t_ns = round(node.t * 1e9)
        frames = []
        for slot in Slot:
            mean, cov = means[8 * k + slot], covs[8 * k + slot]
            line = MapLine(slot, Gaussian(mean, cov), kind=Kind.SOLID, x_min=-3.0, x_max=60.0)
            frames += encoder.encode(line)
        kept = [frame for frame in frames if rng.random() > 0.02]
        if k % 7 == 3:
            kept.append(kept[-1])
        if k % 5 == 2:
            kept[0] = kept[0]._replace(data=bytes([kept[0].data[0], 0xFF, *kept[0].data[2:]]))
        node.take(b"".join(transmission(frame).packed() for frame in kept))
        for frame in kept:
            decoder.feed(frame.can_id, frame.data, t_ns)
        for slot in Slot:
            check_slot(node, decoder, slot, t_ns)
    for name in ("frames", "lines", "pending", "lost"):
        assert node.get(name) == getattr(decoder, name)
    for reason in list(Reason)[1:]:
        assert node.get(f"dropped.{reason.name}") == decoder.counts[reason]
    assert decoder.lines > 250


@pytest.mark.parametrize("dbc", ["maplines.dbc", "maplines-pose.dbc", "maplines-scene.dbc"])
def test_width_and_centre_are_those_of_python(dbc: str, tmp_path: Path) -> None:
    """With their standard deviations; without a scene, and beyond its lines, they are unknown."""
    path = tmp_path / "receiver.fmu"
    assert main(["generate", "fmu", "receiver", "--dbc", dbc, "--out", str(path)]) == 0
    node = Node(path, tmp_path / "receiver", {"x[4]": 500.0})
    assert node.get("lane.width_sigma") == [math.inf] * 4
    codec = new_codec(dbc)
    encoder, decoder = codec.encoder(), codec.decoder()
    is_whole = codec.layout.scene is not None
    scene = road_scene([Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.NEXT_LEFT])
    for k in range(20):
        node.step(0.05 * (k + 1))
        frames = [f for own in encoder.encode_scene(scene, fd=is_whole).values() for f in own]
        node.take(b"".join(transmission(frame).packed() for frame in frames))
        for frame in frames:
            decoder.feed(frame.can_id, frame.data, round(node.t * 1e9))
        for slot in codec.layout.slots if is_whole else ():
            check_slot(node, decoder, slot, round(node.t * 1e9))
    if is_whole:
        stats = decoder.messages(round(node.t * 1e9))["scene"]
        assert node.get("SCENE.ok") == stats.ok == 20
        assert node.get("SCENE.lost") == stats.lost
    view = decoder.latest_scene(round(node.t * 1e9))
    assert view.usable
    assert view.scene is not None
    assert node.get("scene.usable")
    assert node.get("scene.lines") == 3
    assert node.get("scene.age") == view.age
    for what in ("width", "centre"):
        estimate = getattr(view.scene, what)(np.array(X[:3]))
        np.testing.assert_allclose(node.get(f"lane.{what}")[:3], estimate.value, rtol=1e-13)
        np.testing.assert_allclose(node.get(f"lane.{what}_sigma")[:3], estimate.sigma, rtol=1e-9)
        assert node.get(f"lane.{what}_sigma")[3] == math.inf
    node.close()
