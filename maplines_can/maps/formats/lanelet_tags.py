"""Meaning of the tags of Lanelet2: use of a lanelet, marking of a boundary, speed limit."""

from __future__ import annotations

import math
import re
from collections.abc import Hashable, Iterable, Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...values.line import Kind
from ...values.polyline import Polyline
from ..road_map import Lane, LaneType, Skipped
from .lanelets import Lanelet, boundary, centre_line

Tags = Mapping[str, str]

_LANE_TYPES = {
    "road": LaneType.DRIVING,
    "highway": LaneType.DRIVING,
    "play_street": LaneType.DRIVING,
    "emergency_lane": LaneType.STOP,
    "bus_lane": LaneType.BUS,
    "bicycle_lane": LaneType.BIKING,
    "walkway": LaneType.SIDEWALK,
    "shared_walkway": LaneType.SHARED,
    "pedestrian_lane": LaneType.SIDEWALK,
    "stairs": LaneType.SIDEWALK,
    "crosswalk": LaneType.CROSSWALK,
    "road_shoulder": LaneType.SHOULDER,
    "rail": LaneType.RAIL,
}
#: Use of a lanelet by the first of its participants, of those that cars are not among.
_PARTICIPANTS = (
    ("vehicle:bus", LaneType.BUS),
    ("vehicle:taxi", LaneType.TAXI),
    ("vehicle:emergency", LaneType.STOP),
    ("bicycle", LaneType.BIKING),
    ("pedestrian", LaneType.SIDEWALK),
)
_LINE_KINDS = {"solid": Kind.SOLID, "dashed": Kind.DASHED, "": Kind.UNKNOWN}
_BOUNDARY_KINDS = {
    "virtual": Kind.VIRTUAL,
    "curbstone": Kind.KERB,
    "road_border": Kind.ROAD_EDGE,
    "road_boundary": Kind.ROAD_EDGE,
    "guard_rail": Kind.BARRIER,
    "jersey_barrier": Kind.BARRIER,
    "fence": Kind.BARRIER,
    "wall": Kind.BARRIER,
    "gate": Kind.BARRIER,
    "building": Kind.BARRIER,
}
_SPEED = re.compile(r"\s*(\d+(?:\.\d*)?)\s*(km/?h|kmh|m/?s|mps|mph)?\s*", re.I)
_SPEED_UNITS = {"": 1 / 3.6, "kmh": 1 / 3.6, "ms": 1.0, "mps": 1.0, "mph": 0.44704}


class Side(NamedTuple):
    """A boundary of a lanelet as in its file, in driving direction."""

    nodes: tuple[Hashable, ...]  #: identities of the points
    points: NDArray[np.float64]  #: (n, 2) [m]
    tags: Tags


class RawLanelet(NamedTuple):
    """A lanelet as in its file."""

    id: str
    where: str  #: in the file, for messages
    tags: Tags
    left: Side
    right: Side


def lanelets(raw: Iterable[RawLanelet], skipped: list[Skipped]) -> Iterator[Lanelet]:
    """Yield the lanelets that can be used, and list the others."""
    lines: dict[Hashable, Polyline] = {}
    for one in raw:
        try:
            left, right = (_line(side, lines) for side in (one.left, one.right))
            centre = centre_line(left, right)
        except ValueError as error:
            skipped.append(Skipped(one.where, f"the lanelet is not used: {error}"))
            continue
        if not one.tags.get("subtype"):
            skipped.append(Skipped(one.where, "it has no subtype; it is taken for a road"))
        lane = Lane(
            id=one.id,
            left=left,
            right=right,
            centre=centre,
            type=lane_type(one.tags),
            speed_limit=_speed_limit(one, skipped),
            junction=one.tags.get("intersection_area") or None,
        )
        yield Lanelet(lane, one.left.nodes, one.right.nodes)


def _line(side: Side, known: dict[Hashable, Polyline]) -> Polyline:
    """Return the line of a boundary; lanelets beside each other share it."""
    key = (side.nodes, boundary_kind(side.tags))
    if key not in known:
        known[key] = boundary(side.points, key[1])
    return known[key]


def lane_type(tags: Tags) -> LaneType:
    """Return the use of a lanelet.

    Participants that it states override those of its subtype.

    >>> lane_type({"subtype": "road", "one_way": "no"}).value
    'bidirectional'
    >>> lane_type({"subtype": "road", "participant:vehicle:bus": "yes"}).value
    'bus'
    """
    found = _LANE_TYPES.get(tags.get("subtype") or "road", LaneType.OTHER)
    allowed = {
        key.removeprefix("participant:")
        for key, value in tags.items()
        if key.startswith("participant:") and _is_true(value)
    }
    if allowed & {"vehicle", "vehicle:car"}:
        found = found if found.is_drivable else LaneType.DRIVING
    elif any(key.startswith("participant:") for key in tags) and found.is_drivable:
        found = next((use for name, use in _PARTICIPANTS if name in allowed), LaneType.OTHER)
    one_way = tags.get("one_way:vehicle", tags.get("one_way", "yes"))
    if found == LaneType.DRIVING and not _is_true(one_way):
        found = LaneType.BIDIRECTIONAL
    return found


def boundary_kind(tags: Tags) -> Kind:
    """Return the kind of a boundary.

    >>> boundary_kind({"type": "line_thin", "subtype": "solid_dashed"}).name
    'DOUBLE'
    """
    type_, subtype = tags.get("type", ""), tags.get("subtype", "")
    if type_ in {"line_thin", "line_thick"}:
        return _LINE_KINDS.get(subtype, Kind.DOUBLE if "_" in subtype else Kind.UNKNOWN)
    return _BOUNDARY_KINDS.get(type_, Kind.UNKNOWN)


def speed(text: str) -> float:
    """Return a speed [m/s]; without a unit it is in km/h. NaN if it is none.

    >>> speed("36 km/h"), speed("36"), speed("10 m/s"), speed("fast")
    (10.0, 10.0, 10.0, nan)
    """
    match = _SPEED.fullmatch(text)
    if match is None:
        return math.nan
    value = float(match[1]) * _SPEED_UNITS[(match[2] or "").lower().replace("/", "")]
    return value if 0 < value < math.inf else math.nan


def _speed_limit(one: RawLanelet, skipped: list[Skipped]) -> float | None:
    text = one.tags.get("speed_limit")
    if text is None:
        return None
    value = speed(text)
    if math.isnan(value):
        skipped.append(Skipped(one.where, f"speed_limit {text[:40]!r} is no speed; none is used"))
        return None
    return value


def _is_true(text: str) -> bool:
    return text.strip().lower() in {"yes", "true", "1"}
