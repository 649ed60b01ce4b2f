"""The sender with a map as an FMU sends the lines that the Python package computes."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from answers import one
from support.fmu_nodes import Node, frames_of, generate, operations_of, straight_route
from support.xodr_files import WIDTH, document, geometry, lane, road, section

from maplines_can import Codec, Gaussian, Kind, LayoutError, MapError, MapLine, Slot, map_lines
from maplines_can.bus.tx_queue import TxQueue
from maplines_can.generation.fmu.route import route_source
from maplines_can.maps import Map, Route, load, random_tour, town_path
from maplines_can.simulation import PoseSource
from maplines_can.simulation.trajectory import drive_along
from maplines_can.wire import Frame

pytest.importorskip("fmpy", reason="the headers of FMI and the importer come from fmpy")

from maplines_can.cli import main

#: From the country road across the town, with a roundabout and lane changes.
ROUTE = "15:0:-1..12:0:1"
MAPS = Path(__file__).parents[3] / "shared" / "maps"


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fmu") / "sender.fmu"
    options = ["--map", str(town_path()), "--route", ROUTE, "--lines", "8"]
    assert main(["generate", "fmu", "sender", *options, "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def town() -> Map:
    return load(town_path())


def pose_inputs(pose: Gaussian, age: float = 0.0) -> dict[str, Any]:
    """Return the inputs of a pose."""
    return {
        "pose.valid": True,
        "pose.age": age,
        **{f"pose.mean[{i + 1}]": pose.mean[i] for i in range(3)},
        **{f"pose.cov[{i + 1},{j + 1}]": pose.cov[i, j] for i in range(3) for j in range(i + 1)},
    }


def compared(node: Node, road_map: Map, route: Route, seconds: float, **settings: Any) -> int:
    """Drive along a route, and compare all frames that are sent; return how many there are."""
    along, codec = road_map.along(route), Codec.from_dbc()
    queue = TxQueue(codec, 0.05, fd=False, count=None, max_age=codec.layout.max_age)
    drive = drive_along(road_map, route)
    times = drive.times(20.0)
    states, source = drive.at(times), PoseSource((0.4, 0.2, 0.006), seed=3)
    place, count = None, 0
    for t, true_pose in zip((times - times[0]).tolist(), states.pose, strict=True):
        if t > seconds:
            break
        pose = source.pose(t, true_pose)
        place = along.locate(pose.mean, place)
        assert place is not None
        lines = along.sections[place.section]
        node.set(pose_inputs(pose, 0.01))
        given = map_lines(lines, pose, **{"window": (-4.0, 80.0)} | settings)
        queue.put([replace(line, age=0.01) for line in given], node.t)
        for slot in set(Slot).difference(lines):
            queue.drop(slot)
        while node.t < t + 0.05:
            interval = node.interval()
            due = np.inf if interval is None else node.t + interval
            node.step(min(due, t + 0.05)) if due > node.t else None
            if due <= node.t:
                frames = frames_of(operations_of(node.send()))
                now = max(node.t, queue.first) if queue.first <= node.t + 1e-9 else node.t
                expected: list[Frame] = []
                while (transfer := queue.take(now)) is not None:
                    expected += transfer.frames
                assert frames == expected
                count += len(frames)
    return count


def started(fmu: Path, **start: Any) -> Node:
    """Return a node whose configuration is sent."""
    node = Node(fmu, fmu.with_suffix(""), start)
    node.send()
    return node


def test_frames_are_those_of_python(fmu: Path, town: Map) -> None:
    """For a minute through the town: each byte, in the same order."""
    node = started(fmu)
    assert compared(node, town, town.route(*ROUTE.split("..")), 60.0) > 20_000
    assert node.get("lines") > 5000
    assert [node.get(name) for name in ("refused", "not_computed", "off_route")] == [0] * 3
    assert node.get("route.is_on")
    assert node.get("route.section") > 2
    node.close()


def test_parameters_are_those_of_map_lines(fmu: Path, town: Map) -> None:
    node = started(fmu, **{
        "window.x_min": -20.0, "window.x_max": 120.0, "max_sigma": 0.5, "max_misfit": 0.05,
        "map_error.point_sigma": 0.02, "map_error.offset_sigma": 0.1,
    })  # fmt: skip
    settings = {"window": (-20.0, 120.0), "max_sigma": 0.5, "max_misfit": 0.05,
                "map_error": MapError(0.02, 0.1)}  # fmt: skip
    assert compared(node, town, town.route(*ROUTE.split("..")), 10.0, **settings) > 2000
    node.close()


@pytest.mark.skipif(not MAPS.exists(), reason="the real maps are not here")
@pytest.mark.parametrize("name", ["esmini_e6mini.xodr", "lanelet2_mapping_example.osm.gz"])
def test_on_a_real_map(name: str, tmp_path: Path) -> None:
    """On the default route; lines of the map have up to 1590 points there."""
    out = tmp_path / "sender.fmu"
    options = ["--map", str(MAPS / name), "--lines", "8", "--out", str(out)]
    assert main(["generate", "fmu", "sender", *options]) == 0
    road_map = load(MAPS / name)
    node = started(out)
    assert compared(node, road_map, random_tour(road_map), 30.0) > 14_000
    node.close()


@pytest.fixture(scope="module")
def straight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("straight") / "sender.fmu"
    generate("map_sender", path)
    return path


def sent_slots(node: Node, seconds: float = 0.1) -> set[int]:
    """Return the slots of which a node sends frames."""
    slots = {own.can_id: slot for slot, own in Codec.from_dbc().layout.messages.items()}
    found, end = set[int](), node.t + seconds
    while node.t < end:
        interval = node.interval()
        node.step(min(end, node.t + (0.05 if interval is None else max(interval, 1e-4))))
        found.update(slots[frame.can_id] for frame in frames_of(operations_of(node.send())))
    return found


def at(x: float, y: float = 0.0, heading: float = 0.0, sigma: float = 0.1) -> dict[str, Any]:
    return pose_inputs(Gaussian([x, y, heading], np.diag([sigma, sigma, 0.01]) ** 2))


@pytest.mark.parametrize(
    ("pose", "why"),
    [
        (at(0.0, y=10.5), "off_route"),
        (at(0.0, heading=np.pi), "off_route"),
        (at(0.0) | {"pose.mean[1]": np.nan}, "not_computed"),
        (at(0.0) | {"pose.mean[2]": np.inf}, "not_computed"),
        (at(0.0) | {"pose.cov[2,2]": -0.01}, "not_computed"),
        (at(0.0) | {"pose.cov[2,1]": 5.0}, "not_computed"),
        (at(0.0) | {"pose.age": -1.0}, "not_computed"),
        (at(0.0) | {"pose.age": np.nan}, "not_computed"),
        ({"pose.valid": False}, None),
    ],
)
def test_without_a_pose_on_the_route_nothing_is_sent(
    straight: Path, pose: Mapping[str, Any], why: str | None
) -> None:
    """It is counted; the lines of the pose before are not repeated, and the next pose is taken."""
    node = started(straight)
    node.set(at(0.0))
    assert sent_slots(node) == {Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.NEXT_LEFT}
    node.set(pose)
    assert sent_slots(node) == set()
    assert [node.get(name) for name in ("off_route", "not_computed")] == [
        why == "off_route", why == "not_computed"
    ]  # fmt: skip
    assert not node.get("route.is_on")
    assert node.get("EGO_LEFT.left_out") == 6
    assert len(node.messages) == (why == "not_computed")
    node.set(at(1.0))
    assert sent_slots(node) == {Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.NEXT_LEFT}
    assert node.get("route.s") == 101.0
    node.close()


def test_slots_without_a_line_end_and_others_begin(straight: Path) -> None:
    node = started(straight)
    node.set(at(49.9))
    assert sent_slots(node) == {Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.NEXT_LEFT}
    node.set(at(50.0))
    assert sent_slots(node) == {Slot.CENTRE}
    assert node.get("route.section") == 2
    node.close()


def test_a_line_that_cannot_be_given_ages(straight: Path) -> None:
    """An uncertain pose leaves all lines out; those before are sent until they are too old."""
    node = started(straight)
    node.set(at(0.0))
    sent_slots(node)
    node.set(at(0.0, sigma=30.0))
    assert sent_slots(node) == {Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.NEXT_LEFT}
    assert node.get("EGO_LEFT.left_out") in (3, 4)
    assert node.get("expired") == 0
    sent_slots(node, 0.5)
    assert node.get("expired") > 0
    node.close()


@pytest.mark.parametrize(
    ("name", "value"),
    [("window.x_min", -61.0), ("window.x_max", 151.0), ("window.x_max", -4.0), ("max_misfit", 0.0),
     ("max_sigma", np.nan), ("map_error.point_sigma", -1.0),
     ("map_error.heading_sigma", np.inf)],
)  # fmt: skip
def test_wrong_parameters_are_refused(straight: Path, name: str, value: float) -> None:
    with pytest.raises(Exception, match="ExitInitializationMode"):
        started(straight, **{name: value})


def test_a_limit_may_be_infinite(tmp_path: Path) -> None:
    """Its start value is finite, as each in a description."""
    out = tmp_path / "sender.fmu"
    options = ["--map", "--route", "15:0:-1..14:0:1", "--max-sigma", "inf", "--map-error", "0.1"]
    assert main(["generate", "fmu", "sender", *options, "--out", str(out)]) == 0
    node = started(out)
    assert node.get("max_sigma") == 1e6
    assert node.get("map_error.offset_sigma") == 0.1
    node.close()


def test_a_route_without_lines_is_refused() -> None:
    route = straight_route()
    with pytest.raises(LayoutError, match="no line along the route for the slots ROUTE"):
        route_source(route._replace(slots=[Slot.ROUTE]))


def test_a_map_is_of_a_sender(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = ["--out", str(tmp_path / "node.fmu")]
    assert main(["generate", "fmu", "receiver", "--map", *out]) != 0
    assert "--map is of a sender" in capsys.readouterr().err
    assert main(["generate", "fmu", "sender", "--route", "1..7", *out]) != 0
    assert "--route is of a sender with a map" in capsys.readouterr().err
    assert main(["generate", "fmu", "sender", "--map", "--route", "1..nowhere", *out]) != 0
    assert "nowhere" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_kind_is_that_of_the_marking_beside_the_car(tmp_path: Path) -> None:
    """On a lane whose right line is broken for 350 m, and solid from there."""
    marks = '<roadMark sOffset="0" type="broken"/><roadMark sOffset="350" type="solid"/>'
    lanes = section(lane(-1, WIDTH + marks), lane(-2))
    road_map, out = tmp_path / "marks.xodr", tmp_path / "sender.fmu"
    road_map.write_text(document(road(lanes, plan=geometry(length=600.0), length=600.0)))
    options = ["--map", str(road_map), "--route", "1:0:-1..1:0:-1", "--out", str(out)]
    assert main(["generate", "fmu", "sender", *options]) == 0
    node, decoder, kinds = started(out), Codec.from_dbc().decoder(), dict[float, Kind]()
    for x in (100.0, 345.0, 355.0, 500.0, 100.0):
        node.set(at(x, -1.75))
        end = node.t + 0.1
        while node.t < end:
            interval = node.interval()
            node.step(min(end, node.t + (0.05 if interval is None else max(interval, 1e-4))))
            for frame in frames_of(operations_of(node.send())):
                line = one(decoder.feed(frame.can_id, frame.data, round(1e9 * node.t)))
                if isinstance(line, MapLine) and line.slot is Slot.EGO_RIGHT:
                    kinds[x] = line.kind
    assert kinds == {
        x: Kind.SOLID if x > 350 else Kind.DASHED for x in (100.0, 345.0, 355.0, 500.0)
    }
    node.close()
