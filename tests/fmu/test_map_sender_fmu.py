"""The sender with a map as an FMU sends the lines that the Python package computes."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmu_nodes import Node, frames_of, operations_of

from maplines_can import Codec, Gaussian, Slot, map_lines
from maplines_can.bus.tx_queue import TxQueue
from maplines_can.maps import Map, Route, load, town_path
from maplines_can.simulation import PoseSource
from maplines_can.simulation.trajectory import drive_along
from maplines_can.wire import Frame

pytest.importorskip("fmpy", reason="the headers of FMI and the importer come from fmpy")

from maplines_can.cli import main

#: From the country road across the town, with a roundabout and lane changes.
ROUTE = "15:0:-1..12:0:1"
SLOTS = list(Slot)


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("fmu") / "sender.fmu"
    options = ["--map", str(town_path()), "--route", ROUTE, "--lines", "8"]
    assert main(["generate", "fmu", "sender", *options, "--out", str(path)]) == 0
    return path


@pytest.fixture(scope="module")
def town() -> Map:
    return load(town_path())


def pose_inputs(pose: Gaussian, age: float = 0.0) -> Mapping[str, Any]:
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
