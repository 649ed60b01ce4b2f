"""Reader of CommonRoad XML, versions 2018b and 2020a: its lanelets and intersections.

Speed limits are those of the lanelets (2018b) or of their traffic signs (2020a) [m/s]. The position
``gpsLatitude`` and ``gpsLongitude`` of a scenario says nothing of its frame and is not used.
Positions are those of the system ``geoReference``, less the translation of the scenario: see
``systems``. Without one they are in metres.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import replace
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...values.errors import MapFileError
from ...values.line import Kind
from ...values.polyline import Polyline
from ..lane import SkippedList
from ..road_map import Lane, LaneType, Map, Skipped
from .coordinate_systems import is_wgs84, placed
from .lanelets import boundary, centre_line, lanelet_map
from .projection import shifted, utm_of
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
    try:
        reader.place()
    except ValueError as error:
        raise MapFileError(f"{name}, geoReference: {error}") from None
    return lanelet_map(reader.lanes(), name, reader.skipped, reader.projection)


class _Bound(NamedTuple):
    """A boundary as in the file: (n, 2) points in the system of the file, and its marking."""

    tag: str
    points: NDArray[np.float64]
    kind: Kind


class _Raw(NamedTuple):
    """A lanelet as in its file: its boundaries, and the arguments of ``Lane`` that it gives."""

    where: str
    left: _Bound
    right: _Bound
    given: dict[str, Any]


class _Reader:
    """State of the reading: lanelets so far, and what they refer to."""

    def __init__(self) -> None:
        self.skipped: list[Skipped] = SkippedList()
        self.projection: str | None = None
        self._geo_reference: Element | None = None
        self._translation = (0.0, 0.0)
        self._raw: dict[str, _Raw] = {}
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

    def place(self) -> None:
        """Bring all lanelets into the frame of the map.

        Raises:
            ValueError: there is no such system, or the positions are not in it.
        """
        bounds = [bound for raw in self._raw.values() for bound in (raw.left, raw.right)]
        if not bounds:
            return
        points = np.concatenate([bound.points for bound in bounds])
        if self._geo_reference is not None:
            points = self._in_metres(points, self._geo_reference)
        parts = iter(np.split(points, np.cumsum([len(bound.points) for bound in bounds[:-1]])))
        for key, raw in self._raw.items():
            sides = [bound._replace(points=next(parts)) for bound in (raw.left, raw.right)]
            try:
                left, right = map(_line, sides)
                centre = centre_line(left, right)
            except ValueError as error:
                self.skipped.append(Skipped(raw.where, f"the lanelet is not used: {error}"))
            else:
                self._lanes[key] = Lane(id=key, left=left, right=right, centre=centre, **raw.given)

    def _in_metres(self, points: NDArray[np.float64], reference: Element) -> NDArray[np.float64]:
        """Return positions in the frame of the map, and note its projection."""
        system, (x, y) = reference.text.strip(), self._translation
        if is_wgs84(system):
            system = "+proj=longlat +datum=WGS84 +no_defs"
        found = placed(system, points + self._translation)
        notices, self.projection = found.notices, found.projection
        if found.projection == system and (x or y):
            self.projection = shifted(utm_of(system) or system, x, y)
            if self.projection is None:
                notices.append(f"a translation in {system[:200]} has no projection of its own")
        is_same = found.projection == system
        self.skipped[:0] = [Skipped(reference.place, why) for why in notices]
        return points if is_same else found.points

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
            if key in self._raw:
                raise ValueError("another one has the same id")  # noqa: TRY301
            left, right = (_bound(element, side) for side in ("leftBound", "rightBound"))
        except ValueError as error:
            self.skipped.append(Skipped(where, f"the lanelet is not used: {error}"))
            return
        beside: dict[str, Any] = dict.fromkeys(_SIDES)
        for side in ("Left", "Right"):
            adjacent = element.first(f"adjacent{side}")
            if adjacent is not None and adjacent.get("drivingDir") == "same":
                beside[f"{side.lower()}_neighbour"] = adjacent.get("ref")
            elif adjacent is not None:
                beside["opposite_left"] = beside["opposite_left"] or adjacent.get("ref")
        limit = number_in(_text(element, "speedLimit"))
        self._signs_of[key] = _references(element.all("trafficSignRef"))
        given = beside | {
            "type": _lane_type(element),
            "speed_limit": limit if limit > 0 else None,
            "successors": tuple(_references(element.all("successor"))),
            "predecessors": tuple(_references(element.all("predecessor"))),
        }
        self._raw[key] = _Raw(where, left, right, given)

    def _add_location(self, element: Element) -> None:
        transformation = element.first("geoTransformation")
        if transformation is None:
            return
        reference = transformation.first("geoReference")
        if reference is None or not reference.text.strip():
            return
        moved = {
            child.tag: number_in(child.text)
            for more in transformation.all("additionalTransformation")
            for child in more.children
        }
        x, y = moved.pop("xTranslation", 0.0), moved.pop("yTranslation", 0.0)
        is_moved_only = moved.get("zRotation", 0.0) == 0 and moved.get("scaling", 1.0) == 1
        if is_moved_only and math.isfinite(x + y):
            self._geo_reference, self._translation = reference, (x, y)
        else:
            why = (
                "zRotation and scaling are not applied: positions are taken as metres, and "
                "latitude and longitude have no place among them"
            )
            self.skipped.append(Skipped(transformation.place, why))


_SIDES = ("left_neighbour", "right_neighbour", "opposite_left")


def _bound(lanelet: Element, tag: str) -> _Bound:
    """Return a boundary as in the file.

    Raises:
        ValueError: it is missing, or a point is not finite.
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
    return _Bound(tag, np.array(points).reshape(-1, 2), kind)


def _line(bound: _Bound) -> Polyline:
    """Return the line of a boundary.

    Raises:
        ValueError: it has no two points.
    """
    try:
        return boundary(bound.points, bound.kind)
    except ValueError as error:
        raise ValueError(f"<{bound.tag}>: {error}") from None


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
