"""Lane sections of an OpenDRIVE road as values; nothing is evaluated."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

from ....values.line import Kind
from ...road_map import LaneType, Skipped
from ..xml_tree import Element
from .profiles import CubicPiece
from .xml_attributes import UnusableError, attempt, cubics, integer, number

_LANE_TYPES = {kind.value.lower(): kind for kind in LaneType} | {
    "mwyentry": LaneType.ENTRY,
    "mwyexit": LaneType.EXIT,
    "walking": LaneType.SIDEWALK,
}
_MARK_KINDS = {
    "none": Kind.VIRTUAL,
    "solid": Kind.SOLID,
    "broken": Kind.DASHED,
    "botts dots": Kind.DASHED,
    "solid solid": Kind.DOUBLE,
    "solid broken": Kind.DOUBLE,
    "broken solid": Kind.DOUBLE,
    "broken broken": Kind.DOUBLE,
    "curb": Kind.KERB,
    "grass": Kind.ROAD_EDGE,
    "edge": Kind.ROAD_EDGE,
}
_SPEED_UNITS = {"": 1.0, "m/s": 1.0, "km/h": 1 / 3.6, "mph": 0.44704}
_NO_LIMIT = {"no limit", "undefined"}

#: Markings, and speed limits [m/s]: each applies from an s of the road on.
Marks = tuple[tuple[float, Kind], ...]
Speeds = tuple[tuple[float, float | None], ...]


class LaneRecord(NamedTuple):
    """A lane of a lane section.

    Args:
        id: positive on the left of the reference line, negative on the right.
        line: of the file.
        type: use of the lane.
        is_reversed: whether it is used against the usual direction of its side.
        is_level: whether it is not rolled with the road.
        travel: travel direction along s that its ``userData`` states, or empty.
        width: pieces that begin at s of the road.
        border: likewise, used if ``width`` is empty.
        marks: of the outer boundary.
        speeds: of this lane only.
        predecessors: ids of lanes before the start of the lane section.
        successors: ids of lanes after its end.
    """

    id: int
    line: int
    type: LaneType
    is_reversed: bool
    is_level: bool
    travel: str
    width: tuple[CubicPiece, ...]
    border: tuple[CubicPiece, ...]
    marks: Marks
    speeds: Speeds
    predecessors: tuple[int, ...]
    successors: tuple[int, ...]


@dataclass(frozen=True)
class SectionRecord:
    """A lane section.

    Args:
        s: start [m].
        lanes: by id, without lane 0.
        centre_marks: marking of lane 0.
        gone: lanes that have no width in it.
        label: name in the ids of lanes.
    """

    s: float
    lanes: dict[int, LaneRecord]
    centre_marks: Marks
    gone: dict[int, LaneRecord] = field(default_factory=dict)
    label: str = ""


def read_sections(lanes: Element, end: float, skipped: list[Skipped]) -> tuple[SectionRecord, ...]:
    """Return the lane sections in the order of their s.

    Args:
        lanes: the element of the road.
        end: of the reference line [m].
        skipped: list that gets what is not used.

    Raises:
        UnusableError: the start of a lane section is not a number, or there is none.
    """
    found: list[SectionRecord] = []
    elements = [(number(e, "s", least=-1e-6), e) for e in lanes.all("laneSection")]
    elements.sort(key=lambda item: item[0])
    ends = [*(s for s, _ in elements[1:]), end]
    for (s, element), stop in zip(elements, ends, strict=False):
        if s > end:
            why = f"it begins at {s:g} m, after the end of the reference line at {end:g} m"
            skipped.append(Skipped(element.place, why))
            continue
        found.append(_section(element, (s, min(stop, end)), skipped))
        if element.get("singleSide").lower() in {"true", "1"} and len(found) > 1:
            found[-2:] = _continued(found[-2], found[-1])
    if not found:
        raise UnusableError(lanes, "there is no usable <laneSection>")
    return tuple(found)


def _section(
    element: Element, extent: tuple[float, float], skipped: list[Skipped]
) -> SectionRecord:
    s = extent[0]
    elements = [lane for side in element.children for lane in side.all("lane")]
    by_id: dict[int, Element] = {}
    for lane_id, lane in attempt(lambda lane: (integer(lane, "id"), lane), elements, skipped):
        if lane_id in by_id:
            why = f"the id is that of the lane in line {by_id[lane_id].line}; only that is used"
            skipped.append(Skipped(lane.place, why))
        else:
            by_id[lane_id] = lane
    lanes: dict[int, LaneRecord] = {}
    unusable: dict[bool, int] = {}  # on the left, and on the right
    for lane_id in sorted(by_id.keys() - {0}, key=abs):
        is_left = lane_id > 0
        if is_left in unusable:
            why = f"lane {unusable[is_left]}, from which its position follows, cannot be used"
            skipped.append(Skipped(by_id[lane_id].place, why))
        elif record := attempt(lambda e: _lane(e, extent, skipped), [by_id[lane_id]], skipped):
            lanes[lane_id] = record[0]
        else:
            unusable[is_left] = lane_id
    centre = _marks(by_id[0], s, skipped) if 0 in by_id else ()
    return SectionRecord(s, lanes, centre)


def _lane(element: Element, extent: tuple[float, float], skipped: list[Skipped]) -> LaneRecord:
    s = extent[0]
    width, border = (
        cubics(element.all(tag), "sOffset", extent, skipped) for tag in ("width", "border")
    )
    if first := width or border:
        gap = min(piece.start for piece in first) - s
        if gap > 1e-6:
            why = f"its width is not defined over the first {gap:g} m; that after them is used"
            skipped.append(Skipped(element.place, why))
    else:
        skipped.append(Skipped(element.place, "it has neither width nor border: its width is 0"))
    link = element.first("link") or Element("link", {}, element.line)
    type_ = _LANE_TYPES.get(element.get("type", "none").lower(), LaneType.OTHER)
    travel = _travel_direction(element)
    if type_ is LaneType.DRIVING and "both" in (element.get("direction"), travel):
        type_ = LaneType.BIDIRECTIONAL
    if type_.is_drivable and element.first("access"):
        why = "who has access to it is not read; cars drive on it, as its type says"
        skipped.append(Skipped(element.place, why))
    return LaneRecord(
        id=integer(element, "id"),
        line=element.line,
        type=type_,
        is_reversed=element.get("direction") == "reversed",
        is_level=element.get("level").lower() in {"true", "1"},
        travel=travel,
        width=width,
        border=border,
        marks=_marks(element, s, skipped),
        speeds=tuple(
            attempt(
                lambda e: (s + number(e, "sOffset", 0.0), speed(e, skipped)),
                element.all("speed"),
                skipped,
            )
        ),
        predecessors=_linked(link, "predecessor", skipped),
        successors=_linked(link, "successor", skipped),
    )


def _travel_direction(lane: Element) -> str:
    """Return "forward", "backward" or "both", as RoadRunner writes them, or "" for no direction."""
    vectors = (e for data in lane.all("userData") for e in data.all("vectorLane"))
    given = next((e.get("travelDir") for e in vectors), "").lower()
    return {"bidirectional": "both"}.get(given, given if given in {"forward", "backward"} else "")


def _linked(link: Element, tag: str, skipped: list[Skipped]) -> tuple[int, ...]:
    return tuple(attempt(lambda e: integer(e, "id"), link.all(tag), skipped))


def _marks(lane: Element, s: float, skipped: list[Skipped]) -> Marks:
    def read(e: Element) -> tuple[float, Kind]:
        return s + number(e, "sOffset", 0.0), _MARK_KINDS.get(e.get("type").lower(), Kind.UNKNOWN)

    return tuple(sorted(attempt(read, lane.all("roadMark"), skipped)))


def speed(element: Element | None, skipped: list[Skipped]) -> float | None:
    """Return a speed limit [m/s], or None if there is none, or none that can be used."""
    elements = [element] if element else []
    return next(iter(attempt(_speed, elements, skipped)), None)


def _speed(element: Element) -> float | None:
    if element.get("max").lower() in _NO_LIMIT:
        return None
    unit = element.get("unit")
    if unit not in _SPEED_UNITS:
        known = ", ".join(filter(None, _SPEED_UNITS))
        raise UnusableError(element, f"unit must be one of {known}, got {unit[:40]!r}")
    return number(element, "max", least=0.0) * _SPEED_UNITS[unit]


def _continued(before: SectionRecord, single: SectionRecord) -> tuple[SectionRecord, SectionRecord]:
    """Return both with the lanes of the other side continued in a section of a single side."""
    is_left = any(lane_id > 0 for lane_id in single.lanes)
    side = {i: lane for i, lane in before.lanes.items() if (i < 0) == is_left}
    lanes_before = before.lanes | {i: lane._replace(successors=(i,)) for i, lane in side.items()}
    lanes = single.lanes | {i: lane._replace(predecessors=(i,)) for i, lane in side.items()}
    return replace(before, lanes=lanes_before), replace(single, lanes=lanes)
