"""Small maps of lanes for tests, without a file format."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from maplines_can.maps import Lane, Map, Road
from maplines_can.values.line import Kind
from maplines_can.values.polyline import Polyline

Start = tuple[float, float, float]
WIDTH = 3.5
CHORD_ERROR = 0.4e-3
STRAIGHT = 1e-9  # curvature that is none


def arc(
    start: Start, length: float, curvature: float, offsets: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return points beside an arc, at lateral offsets on the left of it [m]."""
    x, y, heading = start
    s = np.linspace(0.0, length, len(offsets))
    turn = heading + curvature * s
    if curvature:
        px = x + (np.sin(turn) - math.sin(heading)) / curvature
        py = y - (np.cos(turn) - math.cos(heading)) / curvature
    else:
        px, py = x + s * math.cos(heading), y + s * math.sin(heading)
    return np.column_stack([px - offsets * np.sin(turn), py + offsets * np.cos(turn)])


def end(start: Start, length: float, curvature: float = 0.0) -> Start:
    """Return the pose at the end of an arc."""
    x, y = arc(start, length, curvature, np.zeros(2))[-1].tolist()
    return x, y, start[2] + curvature * length


def lane(
    lane_id: str,
    start: Start = (0.0, 0.0, 0.0),
    length: float = 200.0,
    *,
    curvature: float = 0.0,
    t: float | tuple[float, float] = 0.0,
    width: float | tuple[float, float] = WIDTH,
    backward: bool = False,
    kinds: tuple[Kind, Kind] = (Kind.UNKNOWN, Kind.UNKNOWN),
    **rest: Any,
) -> Lane:
    """Return a lane along an arc.

    Args:
        lane_id: id.
        start: pose of the start of the arc.
        length: of the arc [m].
        curvature: of the arc [1/m].
        t: offset of the lane's centre from the arc [m], at its start and its end.
        width: of the lane [m], at its start and its end.
        backward: whether the lane is driven against the direction of the arc.
        kinds: of the left and the right boundary.
        rest: further arguments of ``Lane``.
    """
    if abs(curvature) < STRAIGHT:
        curvature = 0.0
    count = math.ceil(length * math.sqrt(abs(curvature) / CHORD_ERROR / 8)) + 2
    share = np.linspace(0.0, 1.0, count)
    ends = [value if isinstance(value, tuple) else (value, value) for value in (t, width)]
    centre, wide = (a + (b - a) * share for a, b in ends)
    lines = [arc(start, length, curvature, centre + k * wide / 2) for k in (1, -1, 0)]
    if backward:
        lines = [line[::-1] for line in (lines[1], lines[0], lines[2])]
    left, right, middle = lines
    return Lane(
        lane_id,
        Polyline(left, kinds[0]),
        Polyline(right, kinds[1]),
        Polyline(middle, Kind.VIRTUAL),
        road="1",
        **rest,
    )


def network(
    *lanes: Lane,
    links: Mapping[str, str] | None = None,
    rows: Iterable[str] = (),
    opposite: Iterable[str] = (),
    **rest: Any,
) -> Map:
    """Return a map with one road.

    Args:
        lanes: of the map, without links.
        links: ids of the successors of a lane, separated by spaces.
        rows: ids of lanes beside each other from left to right, separated by spaces.
        opposite: pairs of ids of lanes beside each other with opposite directions.
        rest: further arguments of ``Map``.
    """
    changes: defaultdict[str, dict[str, Any]] = defaultdict(dict)
    for lane_id, ids in (links or {}).items():
        changes[lane_id]["successors"] = tuple(ids.split())
        for other in ids.split():
            before = changes[other].get("predecessors", ())
            changes[other]["predecessors"] = (*before, lane_id)
    for row in map(str.split, rows):
        for on_left, on_right in pairwise(row):
            changes[on_left]["right_neighbour"] = on_right
            changes[on_right]["left_neighbour"] = on_left
    for one, other in map(str.split, opposite):
        changes[one]["opposite_left"] = other
        changes[other]["opposite_left"] = one
    known = {one.id: replace(one, **changes[one.id]) for one in lanes}
    length = sum(one.length for one in lanes)
    return Map(known, {"1": Road("1", "", length, tuple(known))}, **rest)


def pose_on(lane: Lane, s: float, t: float = 0.0, turn: float = 0.0) -> NDArray[np.float64]:
    """Return a pose on a lane, ``t`` [m] to the left of its centre line."""
    line = lane.centre
    k = min(max(1, int(line.distance.searchsorted(s))), len(line.points) - 1)
    dx, dy = line.points[k] - line.points[k - 1]
    heading = math.atan2(dy, dx)
    x, y = (np.interp(s, line.distance, values) for values in line.points.T)
    return np.array([x - t * math.sin(heading), y + t * math.cos(heading), heading + turn])


def carriageway(
    forward: int, backward: int, *, left_hand: bool = False, sections: int = 3, **rest: Any
) -> Map:
    """Return a road of sections "0", "1" ... with lanes "0:1" ... and "0:-1" ... of each direction.

    Lanes are counted from the line between the directions; the sections are 100 m long.
    """
    side = 1 if left_hand else -1
    lanes, links, rows, opposite = [], {}, [], []
    start = (0.0, 0.0, 0.3)
    for k in range(sections):
        for i in range(1, forward + 1):
            lanes.append(lane(f"{k}:{i}", start, 100.0, t=side * (i - 0.5) * WIDTH, **rest))
            links[f"{k}:{i}"] = f"{k + 1}:{i}" if k + 1 < sections else ""
        for i in range(1, backward + 1):
            offset = -side * (i - 0.5) * WIDTH
            lanes.append(lane(f"{k}:-{i}", start, 100.0, t=offset, backward=True, **rest))
            links[f"{k}:-{i}"] = f"{k - 1}:-{i}" if k else ""
        ahead = [f"{k}:{i}" for i in range(1, forward + 1)]
        back = [f"{k}:-{i}" for i in range(1, backward + 1)]
        rows += [" ".join(ids[::-1] if left_hand else ids) for ids in (ahead, back)]
        if forward and backward:
            opposite.append(f"{k}:1 {k}:-1")
        start = end(start, 100.0, rest.get("curvature", 0.0))
    return network(*lanes, links=links, rows=rows, opposite=opposite, left_hand_traffic=left_hand)


def crossing(arm: float = 80.0, size: float = 20.0) -> Map:
    """Return a crossing of two two-way roads with right-hand traffic.

    Lane "in0" comes from the west, "in1" from the south, "in2" from the east and "in3" from the
    north; "out0" leads to the west, and so on. Lane "0>2" leads straight on from west to east.
    """
    lanes, links, opposite = [], defaultdict(list), []
    for k in range(4):
        heading = k * math.pi / 2
        c, s = math.cos(heading), math.sin(heading)
        far = (-(arm + size / 2) * c, -(arm + size / 2) * s, heading)
        lanes.append(lane(f"in{k}", far, arm, t=-WIDTH / 2))
        lanes.append(lane(f"out{k}", far, arm, t=WIDTH / 2, backward=True))
        opposite.append(f"in{k} out{k}")
        x, y, _ = end(far, arm)
        begin = (x + s * WIDTH / 2, y - c * WIDTH / 2, heading)
        for turn in (1, 0, -1):
            radius = size / 2 + turn * WIDTH / 2
            curvature = turn / radius
            length = radius * math.pi / 2 if turn else size
            to = (k + 2 + turn) % 4
            lanes.append(lane(f"{k}>{to}", begin, length, curvature=curvature, junction="j"))
            links[f"in{k}"].append(f"{k}>{to}")
            links[f"{k}>{to}"].append(f"out{to}")
    joined = {key: " ".join(ids) for key, ids in links.items()}
    return network(*lanes, links=joined, opposite=opposite)


def roundabout(radius: float = 20.0) -> Map:
    """Return a roundabout with one lane and four arms, driven counter-clockwise.

    Lanes "ring0" to "ring3" follow each other; "in0" joins at the start of "ring0", and "out0"
    leaves at its end.
    """
    lanes, links = [], {}
    quarter = radius * math.pi / 2
    for k in range(4):
        angle = k * math.pi / 2
        start = (radius * math.sin(angle), -radius * math.cos(angle), angle)
        lanes.append(lane(f"ring{k}", start, quarter, curvature=1 / radius))
        c, s = math.cos(angle), math.sin(angle)
        lanes.append(lane(f"in{k}", (start[0] - 50 * c, start[1] - 50 * s, angle), 50))
        lanes.append(lane(f"out{k}", end(start, quarter, 1 / radius), 50))
        links[f"in{k}"] = f"ring{k}"
        links[f"ring{k}"] = f"ring{(k + 1) % 4} out{k}"
    return network(*lanes, links=links)
