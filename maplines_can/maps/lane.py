"""Lanes with their boundary lines, and the roads that they belong to.

The values are the same whatever the format of the file. Positions are in the frame of the map,
x and y in metres, angles counter-clockwise.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from ..values.polyline import Pieces, Polyline

#: Points at which ``Lane.width`` measures.
WIDTH_SAMPLES = 33
#: Most entries of what is not used, so that no file fills the memory with them.
MAX_SKIPPED = 100_000


class LaneType(StrEnum):
    """Use of a lane, in the terms of OpenDRIVE."""

    DRIVING = "driving"
    ENTRY = "entry"  #: acceleration lane
    EXIT = "exit"  #: deceleration lane
    ON_RAMP = "onRamp"
    OFF_RAMP = "offRamp"
    CONNECTING_RAMP = "connectingRamp"
    SLIP_LANE = "slipLane"
    BIDIRECTIONAL = "bidirectional"  #: used in both directions, as a turning lane in the middle
    BUS = "bus"
    TAXI = "taxi"
    HOV = "HOV"  #: for cars with several occupants
    STOP = "stop"  #: hard shoulder for emergency stops
    SHOULDER = "shoulder"
    PARKING = "parking"
    BIKING = "biking"
    SIDEWALK = "sidewalk"
    CROSSWALK = "crosswalk"
    SHARED = "shared"  #: for pedestrians and cyclists
    BORDER = "border"
    CURB = "curb"
    MEDIAN = "median"
    RESTRICTED = "restricted"
    ROAD_WORKS = "roadWorks"
    TRAM = "tram"
    RAIL = "rail"
    NONE = "none"  #: surface without a use
    OTHER = "other"

    @property
    def is_drivable(self) -> bool:
        """Whether cars drive on it.

        >>> LaneType.EXIT.is_drivable, LaneType.BUS.is_drivable
        (True, False)
        """
        return self in _DRIVABLE


_DRIVABLE = frozenset(
    {
        LaneType.DRIVING,
        LaneType.ENTRY,
        LaneType.EXIT,
        LaneType.ON_RAMP,
        LaneType.OFF_RAMP,
        LaneType.CONNECTING_RAMP,
        LaneType.SLIP_LANE,
        LaneType.BIDIRECTIONAL,
    }
)


@dataclass(frozen=True, eq=False)
class Lane:
    """One lane of one lane section, or one lanelet.

    Its lines run in the driving direction, and left and right are as seen by its driver.

    Args:
        id: unique in the map; "road:section:lane" from OpenDRIVE.
        left: left boundary; its ``kind`` is that of the marking, and ``kinds`` are those of a
            marking that changes along it.
        right: right boundary, likewise.
        centre: line halfway between them.
        type: use of the lane.
        speed_limit: [m/s]; None if the map states none. Of several, that of the greatest length.
        speed_limits: pairs (s, limit) if the limit changes: each applies from the arc length s of
            the centre line [m] to the next pair. The first s is 0.
        left_neighbour: id of the drivable lane on the left with the same driving direction; the
            marking between them is ``left.kind``.
        right_neighbour: as ``left_neighbour``, on the right.
        opposite_left: id of the drivable lane beside it with the opposite driving direction. It is
            on the left, or on the right in left-hand traffic.
        successors: ids of the lanes that continue it.
        predecessors: ids of the lanes that it continues.
        road: id of its road.
        junction: id of the junction that it is in.
    """

    id: str
    left: Polyline
    right: Polyline
    centre: Polyline
    type: LaneType = LaneType.DRIVING
    speed_limit: float | None = None
    left_neighbour: str | None = None
    right_neighbour: str | None = None
    opposite_left: str | None = None
    successors: tuple[str, ...] = ()
    predecessors: tuple[str, ...] = ()
    road: str = ""
    junction: str | None = None
    speed_limits: Pieces[float | None] = ()

    @property
    def length(self) -> float:
        """Length of the centre line [m]."""
        return self.centre.length

    @property
    def width(self) -> float:
        """Mean distance of the left and the right boundary [m].

        >>> left, right = Polyline([[0, 3], [9, 3]]), Polyline([[0, 0], [9, 0]])
        >>> Lane("1", left, right, centre=Polyline([[0, 1.5], [9, 1.5]])).width
        3.0
        """
        left, right = (_at_fractions(line) for line in (self.left, self.right))
        return float(np.hypot(*(left - right)).mean())

    @property
    def linked(self) -> tuple[str, ...]:
        """Ids of all lanes that it names."""
        beside = (self.left_neighbour, self.right_neighbour, self.opposite_left)
        return (*filter(None, beside), *self.successors, *self.predecessors)


def _at_fractions(line: Polyline) -> np.ndarray:
    """Return (2, WIDTH_SAMPLES) points at even fractions of the length."""
    distance = line.distance
    at = np.linspace(0.0, distance[-1], WIDTH_SAMPLES)
    return np.array([np.interp(at, distance, values) for values in line.points.T])


@dataclass(frozen=True)
class Road:
    """Lanes that belong together: the coarse layer of the map.

    Args:
        id: unique in the map.
        name: as in the file, or empty.
        length: [m].
        lanes: ids of its lanes.
        junction: id of the junction that it is in.
        successors: ids of the roads that its lanes lead to.
        predecessors: ids of the roads that lead to its lanes.
    """

    id: str
    name: str
    length: float
    lanes: tuple[str, ...]
    junction: str | None = None
    successors: tuple[str, ...] = ()
    predecessors: tuple[str, ...] = ()


@dataclass(frozen=True)
class Skipped:
    """Something in a map file that is not used, or not as it stands there.

    Args:
        where: line or element of the file.
        why: reason, and what happens instead.
    """

    where: str
    why: str

    def __str__(self) -> str:
        return f"{self.where}: {self.why}"


class SkippedList(list[Skipped]):
    """What is not used, as it is found. After ``MAX_SKIPPED`` entries, one says that it ends."""

    def append(self, one: Skipped) -> None:
        """Add an entry, if there is room."""
        if len(self) < MAX_SKIPPED:
            super().append(one)
        elif len(self) == MAX_SKIPPED:
            why = f"only the first {MAX_SKIPPED} things that are not used are listed"
            super().append(Skipped("the rest of the file", why))
