"""Slots of the lines at random poses on maps, against the lanes that the poses are in.

The slots of a pose are right if they are those of a lane that the car is in, which the boundaries
of the lanes tell: ego left is on the left at the left boundary of the lane, ego right on the right,
and next left and next right are there if the map has a drivable lane beside it, at its other
boundary, all within 0.1 m. Where a boundary begins or ends beside the car, only the order counts.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from maplines_can import Slot
from maplines_can import maps as map_model
from maplines_can.study.scenes.map_scenes import SLOTS, drivable, random_pose

from .figures import Share
from .harness import evidence, progress
from .roads import maps_of
from .witness import Array, beside, place_of, seen_from

#: Largest difference of the line of a slot from the boundary of a lane [m], and largest angle
#: between the car and its lane [rad].
TOLERANCE, SKEW = 0.1, np.radians(60.0)


@evidence
def slots(maps: tuple[str, ...] = (), n: int = 500, seed: int = 1) -> dict[str, Any]:
    """Compare the slots of n poses on each map with the lanes of the map; the town without one."""
    found = maps_of(maps or (str(map_model.town_path()),))
    return {
        name: figures(one, n, seed) for name, one in progress(found.items(), "maps", len(found))
    }


def figures(found: map_model.Map, poses: int, seed: int) -> dict[str, Any]:
    """Return the figures of a map."""
    witness, lanes, rng = Witness(found), drivable(found), np.random.default_rng(seed)
    wrong = []
    for _ in range(poses):
        pose = random_pose(lanes, rng)
        lines = {slot: line for slot, line in found.lines(pose).items() if slot in SLOTS}
        at_car = {slot: beside(x.points, pose) for slot, x in lines.items()}
        if not witness.is_right(at_car, pose):
            wrong.append([round(value, 2) for value in pose.tolist()])
    return {
        "lanes": len(lanes),
        "km": sum(lane.length for lane in lanes) / 1000,
        "skipped": len(found.skipped),
        "poses": poses,
        "right": Share(1 - len(wrong) / poses, poses),
        "wrong": wrong[:3],
    }


class Witness:
    """The lanes of a map, to find those that a pose is in and what is beside them."""

    def __init__(self, found: map_model.Map) -> None:
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

    def around(self, pose: Array) -> list[map_model.Lane]:
        """Return the lanes near a pose."""
        near = ((self._low <= pose[:2]) & (pose[:2] <= self._high)).all(axis=1)
        return [self._drivable[i] for i in np.flatnonzero(near)]

    def expected(self, lane: map_model.Lane, pose: Array) -> dict[Slot, float] | None:
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
