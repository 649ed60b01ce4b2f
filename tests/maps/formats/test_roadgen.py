"""The same network, written by roadgen in both formats, gives the same map."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import maplines_can as ml
from maplines_can.maps import Lane, Map
from maplines_can.values.polyline import Polyline

roadgen = pytest.importorskip("roadgen")
#: Spacing of the points in the Lanelet2 file [m]; on an arc of 8 m they are 1 mm off.
SAMPLING = 0.25


def lanes(*directions: str) -> list[Any]:
    return [roadgen.Lane(width=3.5, direction=one, speed_limit_kph=50) for one in directions]


def two_roads() -> Any:
    """Two roads with a bend between them."""
    network = roadgen.Map(sampling=SAMPLING)
    cross_section = ("forward", "forward", "backward")
    one = network.add_road(start=(0, 0, 0), end=(100, 0, 0), lanes=lanes(*cross_section))
    other = network.add_road(start=(100, 0, 0), end=(200, 50, 0), lanes=lanes(*cross_section))
    network.connect(one, other)
    return network


def bends() -> Any:
    """A road of a line, spirals and arcs to both sides."""
    network = roadgen.Map(sampling=SAMPLING)
    plan = roadgen.Alignment((10, 20, 0), 0.3)
    plan.line(50)
    plan.spiral(30, 0.02)
    plan.arc(60, 0.02)
    plan.spiral(60, -0.03)
    plan.arc(40, -0.03)
    network.add_road(lanes=lanes("forward", "forward", "backward", "backward"), alignment=plan)
    return network


def crossing() -> Any:
    """Four roads of two lanes that meet in a junction."""
    network = roadgen.Map(sampling=SAMPLING)
    junction = network.add_junction()
    into: list[Any] = []
    out: list[Any] = []
    for i in range(4):
        c, s = math.cos(i * math.pi / 2), math.sin(i * math.pi / 2)
        for roads, near, side in ((into, "end", 1.0), (out, "start", -1.0)):
            ends = [(r * c - 2 * side * s, r * s + 2 * side * c, 0) for r in (120, 25)]
            start, end = ends if near == "end" else ends[::-1]
            roads.append(network.add_road(start=start, end=end, lanes=lanes("forward")))
    for i, one in enumerate(into):
        for j, other in enumerate(out):
            if i != j:
                network.connect(one, other, junction=junction)
    return network


def worst_distance(line: Polyline, other: Polyline) -> float:
    """Return the largest distance of the points of a line from another one [m]."""
    start, step = other.points[:-1], np.diff(other.points, axis=0)
    to = line.points[:, None] - start
    share = ((to * step).sum(axis=2) / (step**2).sum(axis=1)).clip(0, 1)
    away = np.hypot(*np.moveaxis(to - share[..., None] * step, 2, 0))
    return float(away.min(axis=1).max())


def partner(lane: Lane, road_map: Map) -> Lane:
    """Return the lane of a map that begins and ends where a lane does."""

    def away(other: Lane) -> float:
        return float(np.abs((lane.centre.points - other.centre.points[0])[0]).sum()) + float(
            np.abs((lane.centre.points - other.centre.points[-1])[-1]).sum()
        )

    return min(road_map.lanes.values(), key=away)


@pytest.mark.parametrize("network", [two_roads, bends, crossing])
def test_both_formats_give_the_same_map(network: Any, tmp_path: Path) -> None:
    """Lines within 1 cm; links and speed limits are equal."""
    made = network()
    made.export_opendrive(str(tmp_path / "map.xodr"), trace=False)
    made.export_lanelet2(str(tmp_path / "map.osm"), trace=False)
    opendrive, lanelet2 = (ml.maps.load(tmp_path / name) for name in ("map.xodr", "map.osm"))
    assert len(opendrive.lanes) == len(lanelet2.lanes) > 2
    pairs = {lane.id: partner(lane, opendrive) for lane in lanelet2.lanes.values()}
    assert len({other.id for other in pairs.values()}) == len(pairs)
    name = {lane: other.id for lane, other in pairs.items()}
    for lane in lanelet2.lanes.values():
        other = pairs[lane.id]
        for line, its in (
            (lane.left, other.left),
            (lane.right, other.right),
            (lane.centre, other.centre),
        ):
            assert worst_distance(line, its) < 0.01
            assert worst_distance(its, line) < 0.01
        assert lane.speed_limit == pytest.approx(other.speed_limit)
        assert {name[one] for one in lane.successors} == set(other.successors)
        assert {name[one] for one in lane.predecessors} == set(other.predecessors)
        for side in ("left_neighbour", "right_neighbour", "opposite_left"):
            beside = getattr(lane, side)
            assert (beside and name[beside]) == getattr(other, side)
