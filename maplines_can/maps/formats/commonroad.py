"""Reader of CommonRoad XML, versions 2018b and 2020a: its lanelets and intersections.

Speed limits are those of the lanelets (2018b) or of their traffic signs (2020a) [m/s]. The position
``gpsLatitude`` and ``gpsLongitude`` of a scenario says nothing of its frame and is not used.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import BinaryIO

import numpy as np

from ...values.line import Kind
from ...values.polyline import Polyline
from ..lane import SkippedList
from ..model import Lane, LaneType, Map, Skipped
from .lanelets import boundary, centre_line, lanelet_map
from .xml_tree import Document, Element, number_in

#: Elements that say nothing of lanes.
_IGNORED = {
    "dynamicObstacle",
    "environmentObstacle",
    "obstacle",
    "phantomObstacle",
    "planningProblem",
    "staticObstacle",
    "trafficLight",
}
_KINDS = {
    "solid": Kind.SOLID,
    "broad_solid": Kind.SOLID,
    "dashed": Kind.DASHED,
    "broad_dashed": Kind.DASHED,
    "solid_solid": Kind.DOUBLE,
    "dashed_dashed": Kind.DOUBLE,
    "solid_dashed": Kind.DOUBLE,
    "dashed_solid": Kind.DOUBLE,
    "curb": Kind.KERB,
    "lowered_curb": Kind.KERB,
    "no_marking": Kind.VIRTUAL,
}
#: Types of lanelets; of several, the first of this table counts.
_LANE_TYPES = {
    "sidewalk": LaneType.SIDEWALK,
    "crosswalk": LaneType.CROSSWALK,
    "bicycleLane": LaneType.BIKING,
    "busLane": LaneType.BUS,
    "busStop": LaneType.BUS,
    "shoulder": LaneType.SHOULDER,
    "border": LaneType.BORDER,
    "parking": LaneType.PARKING,
    "restricted": LaneType.RESTRICTED,
    "accessRamp": LaneType.ENTRY,
    "exitRamp": LaneType.EXIT,
}
#: Traffic signs of a speed limit, by country.
_SPEED_SIGNS = {"274", "274.1", "r2-1", "r301"}
#: Speed limits from this one on are none [m/s].
_NO_LIMIT = 100.0


def read(stream: BinaryIO, name: str) -> Map:
    """Read a map from the bytes of a CommonRoad file.

    Lanes have the ids of their lanelets.

    Args:
        stream: of the XML document.
        name: of the file, for messages.

    Raises:
        MapFileError: it is not XML, is not CommonRoad, or has no usable lanelet.
    """
    reader = _Reader()
    document = Document(stream, name, ignored=_IGNORED)
    for element in document.elements():
        reader.add(element)
    reader.skipped += document.check_root("commonRoad", "a CommonRoad")
    return lanelet_map(reader.lanes(), name, reader.skipped, reader.projection)


class _Reader:
    """State of the reading: lanelets so far, and what they refer to."""

    def __init__(self) -> None:
        self.skipped: list[Skipped] = SkippedList()
        self.projection: str | None = None
        self._lanes: dict[str, Lane] = {}
        self._signs_of: dict[str, list[str]] = {}
        self._limits: dict[str, float] = {}
        self._junctions: dict[str, str] = {}

    def add(self, element: Element) -> None:
        """Read a child of the root."""
        if element.tag == "lanelet":
            self._add_lanelet(element)
        elif element.tag == "location":
            self._add_location(element)
        elif element.tag == "trafficSign":
            for sign in element.all("trafficSignElement"):
                value = number_in(_text(sign, "additionalValue"))
                if _text(sign, "trafficSignID").lower() in _SPEED_SIGNS and value > 0:
                    self._limits[element.get("id")] = value
        elif element.tag == "intersection":
            for incoming in element.all("incoming"):
                for child in incoming.children:
                    if child.tag.startswith("successors"):
                        self._junctions[child.get("ref")] = element.get("id")

    def lanes(self) -> Iterator[Lane]:
        """Yield the lanes with all their links, in both directions."""
        after: dict[str, dict[str, None]] = {key: {} for key in self._lanes}
        before: dict[str, dict[str, None]] = {key: {} for key in self._lanes}
        for lane in self._lanes.values():
            for other in lane.successors:
                after[lane.id][other] = before.setdefault(other, {})[lane.id] = None
            for other in lane.predecessors:
                before[lane.id][other] = after.setdefault(other, {})[lane.id] = None
        for lane in self._lanes.values():
            limits = [self._limits[one] for one in self._signs_of[lane.id] if one in self._limits]
            limit = min(limits, default=lane.speed_limit)
            same = {side: self._drivable(getattr(lane, side)) for side in _SIDES}
            yield replace(
                lane,
                **same,  # type: ignore[arg-type]
                successors=tuple(after[lane.id]),
                predecessors=tuple(before[lane.id]),
                speed_limit=limit if limit is not None and limit < _NO_LIMIT else None,
                junction=self._junctions.get(lane.id),
            )

    def _drivable(self, beside: str | None) -> str | None:
        """Return the id unless cars do not drive there; one that leads nowhere is listed later."""
        other = self._lanes.get(beside or "")
        return beside if other is None or other.type.is_drivable else None

    def _add_lanelet(self, element: Element) -> None:
        key, where = element.get("id").strip(), element.place
        try:
            if not key:
                raise ValueError("it has no id")  # noqa: TRY301 - as of an unusable boundary
            if key in self._lanes:
                raise ValueError("another one has the same id")  # noqa: TRY301
            left, right = (_bound(element, side) for side in ("leftBound", "rightBound"))
            centre = centre_line(left, right)
        except ValueError as error:
            self.skipped.append(Skipped(where, f"the lanelet is not used: {error}"))
            return
        beside: dict[str, str | None] = dict.fromkeys(_SIDES)
        for side in ("Left", "Right"):
            adjacent = element.first(f"adjacent{side}")
            if adjacent is not None and adjacent.get("drivingDir") == "same":
                beside[f"{side.lower()}_neighbour"] = adjacent.get("ref")
            elif adjacent is not None:
                beside["opposite_left"] = beside["opposite_left"] or adjacent.get("ref")
        limit = number_in(_text(element, "speedLimit"))
        self._signs_of[key] = _references(element.all("trafficSignRef"))
        self._lanes[key] = Lane(
            id=key,
            left=left,
            right=right,
            centre=centre,
            type=_lane_type(element),
            speed_limit=limit if limit > 0 else None,
            successors=tuple(_references(element.all("successor"))),
            predecessors=tuple(_references(element.all("predecessor"))),
            **beside,  # type: ignore[arg-type]
        )

    def _add_location(self, element: Element) -> None:
        transformation = element.first("geoTransformation")
        if transformation is None:
            return
        self.projection = _text(transformation, "geoReference") or None
        for more in transformation.all("additionalTransformation"):
            unit = {"scaling": 1.0}
            moved = [
                child.tag
                for child in more.children
                if number_in(child.text) != unit.get(child.tag, 0.0)
            ]
            if moved:
                why = f"{', '.join(moved)} not applied: apply it to positions that are projected"
                self.skipped.append(Skipped(more.place, why))


_SIDES = ("left_neighbour", "right_neighbour", "opposite_left")


def _bound(lanelet: Element, tag: str) -> Polyline:
    """Return a boundary.

    Raises:
        ValueError: it is missing, or has no two points.
    """
    bound = lanelet.first(tag)
    if bound is None:
        raise ValueError(f"it has no <{tag}>")
    points = []
    for point in bound.all("point"):
        points.append((number_in(_text(point, "x")), number_in(_text(point, "y"))))
        if not all(map(math.isfinite, points[-1])):
            raise ValueError(f"the point in line {point.line} has no finite x and y")
    kind = _KINDS.get(_text(bound, "lineMarking"), Kind.UNKNOWN)
    try:
        return boundary(np.array(points).reshape(-1, 2), kind)
    except ValueError as error:
        raise ValueError(f"<{tag}>: {error}") from None


def _lane_type(lanelet: Element) -> LaneType:
    types = {child.text.strip() for child in lanelet.all("laneletType")}
    found = next((use for name, use in _LANE_TYPES.items() if name in types), LaneType.DRIVING)
    users = {
        child.text.strip()
        for tag in ("userOneWay", "userBidirectional")
        for child in lanelet.all(tag)
    }
    if users and users <= {"bicycle", "pedestrian"} and found.is_drivable:
        return LaneType.BIKING if "bicycle" in users else LaneType.SIDEWALK
    both_ways = {child.text.strip() for child in lanelet.all("userBidirectional")}
    if found == LaneType.DRIVING and both_ways & {"vehicle", "car"}:
        return LaneType.BIDIRECTIONAL
    return found


def _references(elements: Iterable[Element]) -> list[str]:
    return [element.get("ref") for element in elements]


def _text(element: Element, tag: str) -> str:
    child = element.first(tag)
    return "" if child is None else child.text.strip()
