#!/usr/bin/env python3
"""Measure how honest the lines are, and how right their slots, at random poses on real maps.

    evidence_maps.py DIR              every map in a folder and in the folders below it
    evidence_maps.py -n 2000 a.xodr   2000 poses on one map

Run it in the environment of the project: python3 tools/run.py python tools/evidence_maps.py DIR

The poses are on lanes drawn by their lengths, up to 0.5 m beside the centre line and 3 deg
(standard deviation) off its direction. For each there is the table of z of evidence_lines.py: the
lines are those that Map.lines and map_lines give, and z is evaluated from their points.

The slots of a pose are right if they are those of a lane that the car is in, which the boundaries
of the lanes tell: ego left is on the left at the left boundary of the lane, ego right on the right,
and next left and next right are there if the map has a drivable lane beside it, at its other
boundary, all within 0.1 m. Where a boundary begins or ends beside the car, only the order counts.

The exit status is 1 if a bound is missed, and 2 if there is no map.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from line_witness import (
    HEADINGS,
    POSES,
    WINDOW,
    Array,
    Poses,
    Tally,
    cells,
    crossings,
    missed,
    place_of,
    seen_from,
)
from reporting import bar, parser_of

from maplines_can import Gaussian, MapFileError, Slot, map_lines, maps

SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.NEXT_LEFT, Slot.NEXT_RIGHT)
#: Largest offset from the centre line [m], and standard deviation of the direction [rad].
OFFSET, TURN = 0.5, np.radians(3.0)
#: Largest difference of the line of a slot from the boundary of a lane [m], and largest angle
#: between the car and its lane [rad].
TOLERANCE, SKEW = 0.1, np.radians(60.0)
#: Least share of right slots, and the least number of poses for which it is a bound.
RIGHT, MIN_POSES = 0.995, 200


def random_pose(lane: maps.Lane, rng: np.random.Generator) -> Array:
    """Return a pose on a lane, in its direction."""
    points = lane.centre.points
    s = rng.uniform(0, lane.length)
    k = min(int(lane.centre.distance.searchsorted(s, side="right")), len(points) - 1)
    step = points[k] - points[k - 1]
    heading = np.arctan2(step[1], step[0])
    x, y = (np.interp(s, lane.centre.distance, values) for values in points.T)
    side = np.clip(rng.normal(0, OFFSET / 2), -OFFSET, OFFSET)
    side = np.clip(side, -lane.width / 4, lane.width / 4)
    return np.array(
        [x - side * np.sin(heading), y + side * np.cos(heading), heading + rng.normal(0, TURN)]
    )


def beside(points: Array, pose: Array) -> float:
    """Return the lateral position at the car of (n, 2) points; NaN if they do not pass it."""
    local = seen_from(points, pose[None])
    _, s = place_of(local[0])
    return float(crossings(local, s, 0.0)[0])


class Witness:
    """The lanes of a map, to find those that a pose is in and what is beside them."""

    def __init__(self, found: maps.Map) -> None:
        self._lanes = found.lanes
        self._left_hand = found.left_hand_traffic
        self._drivable = [lane for lane in found.lanes.values() if lane.type.is_drivable]
        low, high = (
            np.array(
                [
                    pick([pick(line.points, axis=0) for line in (lane.left, lane.right)], axis=0)
                    for lane in self._drivable
                ]
            )
            for pick in (np.min, np.max)
        )
        self._low, self._high = low - 1.0, high + 1.0

    def around(self, pose: Array) -> list[maps.Lane]:
        """Return the lanes near a pose."""
        near = ((self._low <= pose[:2]) & (pose[:2] <= self._high)).all(axis=1)
        return [self._drivable[i] for i in np.flatnonzero(near)]

    def expected(self, lane: maps.Lane, pose: Array) -> dict[Slot, float] | None:
        """Return where the line of each slot is if the car is on a lane; None if it is not."""
        local = seen_from(lane.centre.points, pose[None])[0]
        nearest, s = place_of(local)
        if not s[0] - TOLERANCE <= 0 <= s[-1] + TOLERANCE:
            return None
        step = local[nearest + 1] - local[nearest]
        against = step[0] < 0
        if abs(np.arctan2(step[1], step[0]) - (np.sign(step[1]) * np.pi if against else 0)) > SKEW:
            return None
        sides = [(lane.left, lane.left_neighbour), (lane.right, lane.right_neighbour)]
        if lane.opposite_left is not None:
            i = int(self._left_hand)
            own = sides[i][1]
            sides[i] = (sides[i][0], own if own is not None else lane.opposite_left)
        result = {}
        for ego, beyond_it, (line, other) in zip(
            (Slot.EGO_LEFT, Slot.EGO_RIGHT), (Slot.NEXT_LEFT, Slot.NEXT_RIGHT), sides, strict=True
        ):
            result[ego] = self._at(line.points, pose, against)
            if other is not None and self._lanes[other].type.is_drivable:
                far = [self._at(x.points, pose, against) for x in self._sides(other)]
                away = 1 if ego is Slot.EGO_LEFT else -1
                away = -away if against else away
                result[beyond_it] = away * float(np.max(away * np.array(far)))  # NaN if one is
        if against:
            mirrored = dict(zip(SLOTS, (SLOTS[1], SLOTS[0], SLOTS[3], SLOTS[2]), strict=True))
            result = {mirrored[slot]: y for slot, y in result.items()}
        is_outside = result[Slot.EGO_LEFT] < -TOLERANCE or result[Slot.EGO_RIGHT] > TOLERANCE
        return None if is_outside else result

    def _sides(self, lane_id: str) -> tuple[Any, Any]:
        lane = self._lanes[lane_id]
        return lane.left, lane.right

    @staticmethod
    def _at(points: Array, pose: Array, against: bool) -> float:
        """Return the lateral position of a boundary at the car, whatever its direction."""
        along, back = beside(points, pose), beside(points[::-1], pose)
        first, second = (back, along) if against else (along, back)
        return first if np.isfinite(first) else second

    def is_right(self, slots: dict[Slot, float], pose: Array) -> bool:
        """Return whether the lateral positions of the slots are those of a lane of the car.

        They are in order from right to left. Beside a joint of lanes, where a boundary begins or
        ends beside the car, there is only the order to compare.
        """
        order = [slots.get(slot, np.nan) for slot in (SLOTS[3], SLOTS[1], SLOTS[0], SLOTS[2])]
        y = np.array([*order[:2], 0.0, *order[2:]])
        if (np.diff(y[np.isfinite(y)]) < -TOLERANCE).any():
            return False
        for lane in self.around(pose):
            expected = self.expected(lane, pose)
            if expected is not None and expected.keys() == slots.keys():
                pairs = [(slots[slot], y) for slot, y in expected.items()]
                if all(abs(a - b) <= TOLERANCE for a, b in pairs if np.isfinite([a, b]).all()):
                    return True
        return False


def measure(found: maps.Map, sigma: Any, poses: int, draws: int, seed: int, step: Any) -> Any:
    """Return the figures of a map."""
    tally, right, wrong = Tally(), 0, []
    witness = Witness(found)
    lanes = [lane for lane in found.lanes.values() if lane.type.is_drivable and lane.length > 0]
    lengths_of_lanes = np.array([lane.length for lane in lanes])
    rng = np.random.default_rng(seed)
    for _ in range(poses):
        step()
        lane = lanes[rng.choice(len(lanes), p=lengths_of_lanes / lengths_of_lanes.sum())]
        pose = random_pose(lane, rng)
        given = {slot: line for slot, line in found.lines(pose).items() if slot in SLOTS}
        at_car = {slot: beside(x.points, pose) for slot, x in given.items()}
        is_right = witness.is_right(at_car, pose)
        right += is_right
        if not is_right:
            wrong.append({"lane": lane.id, "pose": pose.tolist()})
        drawn = Poses.about(pose, sigma, draws, rng)
        lines = map_lines(given, Gaussian(pose, drawn.cov), window=WINDOW)
        by_slot = {line.slot: line for line in lines}
        for slot, line in given.items():
            local = seen_from(line.points, pose[None])[0]
            _, s = place_of(local)
            tally.count(local, s, "given" if slot in by_slot else lines.left_out[slot].name)
            if slot in by_slot:
                tally.evaluate(by_slot[slot], line.points, s, drawn.see)
    return {
        "lanes": len(lanes),
        "km": float(lengths_of_lanes.sum()) / 1000,
        "skipped": len(found.skipped),
        "poses": poses,
        **tally.figures(),
        "slots right": right / poses,
        "slots wrong": wrong[:10],
    }


def missed_slots(name: str, row: Any) -> Iterator[str]:
    """Yield the bound of the slots if it is missed."""
    if row["poses"] >= MIN_POSES and row["slots right"] < RIGHT:
        yield f"{name}: the slots of {row['slots right']:.2%} of the poses are right"


def show(rows: Any) -> None:
    """Print the figures of the maps as a table."""
    width = max(map(len, rows), default=0) + 1
    print(
        f"{'':{width}} lanes     km  poses  right  refused  {HEADINGS[0]}\n"
        f"{'':{width}}{'':39}{HEADINGS[1]}"
    )
    for name, row in rows.items():
        print(
            f"{name:{width}}{row['lanes']:6}{row['km']:7.1f}{row['poses']:7}"
            f"{row['slots right']:8.2%}{row['refused']:8.1%}  {cells(row)}"
        )


def files_of(paths: list[str]) -> list[Path]:
    """Return the files below the folders, and the files.

    Raises:
        FileNotFoundError: there is no such file or folder.
    """
    found: list[Path] = []
    for path in map(Path, paths):
        if not path.exists():
            raise FileNotFoundError(f"{path}: there is no such file or folder")
        below = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
        found += below
    return found


def main(argv: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("paths", nargs="+", metavar="DIR", help="folders or files of maps")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument("--seed", type=int, default=1, help="seed of the poses and of the draws")
    parser.add_argument("-n", "--poses", type=int, default=500, help="poses on each map")
    parser.add_argument("--draws", type=int, default=10, help="poses drawn for each line and x")
    parser.add_argument(
        "--pose", choices=POSES, default="production", help="errors of the pose of the car"
    )
    arguments = parser.parse_args(argv)
    if arguments.poses < 1 or arguments.draws < 1:
        parser.error("--poses and --draws must be 1 or more")
    try:
        files = files_of(arguments.paths)
    except FileNotFoundError as error:
        parser.error(str(error))
    rows, not_used, misses = evidence(files, arguments)
    if arguments.json:
        print(json.dumps({"maps": rows, "not used": not_used, "missed": misses}, indent=2))
    else:
        show(rows)
        print("", *(f"not used: {name}: {why}" for name, why in not_used.items()), sep="\n")
        print(*(misses or ["All bounds are met."] * bool(rows)), sep="\n")
    if not rows:
        print("evidence_maps.py: none of the files is a map with lanes", file=sys.stderr)
        return 2
    return 1 if misses else 0


def evidence(
    files: list[Path], arguments: argparse.Namespace
) -> tuple[dict[str, Any], dict[str, str], list[str]]:
    """Return the figures by file, the files that are not used, and the bounds that are missed."""
    rows: dict[str, Any] = {}
    not_used: dict[str, str] = {}
    misses: list[str] = []
    with bar(arguments.poses * len(files), unit=" poses", leave=False) as progress:
        for path in files:
            name = path.name if path.name not in rows else str(path)
            progress.set_description(name)
            try:
                found = maps.load(path)
            except (MapFileError, ImportError, OSError) as error:
                not_used[str(path)] = " ".join(str(error).split())
                continue
            if not any(x.type.is_drivable and x.length > 0 for x in found.lanes.values()):
                not_used[str(path)] = "has no lanes to drive on"
                continue
            rows[name] = measure(
                found,
                POSES[arguments.pose],
                arguments.poses,
                arguments.draws,
                arguments.seed,
                progress.update,
            )
            title = f"MISSED  {name}"
            misses += [*missed(title, rows[name]), *missed_slots(title, rows[name])]
    return rows, not_used, misses


if __name__ == "__main__":
    sys.exit(main())
