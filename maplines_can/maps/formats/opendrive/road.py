"""Roads of an OpenDRIVE file as values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

from ...model import Skipped
from ..xml_tree import Element
from .attributes import UnusableError, attempt, cubic, number
from .lane_section import SectionRecord, Speeds, read_sections, speed
from .profiles import Profiles
from .reference_line import MAX_TURN, Geometry, Parameter, ReferenceLine

#: Largest coordinate [m]. UTM has 1e7 m.
MAX_COORDINATE = 1e8
#: Longest road [m].
MAX_LENGTH = 1e6
#: Gap between geometries, and difference of lengths, that is listed [m].
LENGTH_TOLERANCE = 0.01

_SHAPES = ("line", "arc", "spiral", "poly3", "paramPoly3")


@dataclass(frozen=True)
class RoadLink:
    """Neighbour of a road at one of its ends.

    Args:
        id: of the neighbouring road or junction.
        is_junction: whether it is a junction.
        contact: end of the neighbouring road, "start" or "end"; empty if the file has none.
    """

    id: str
    is_junction: bool
    contact: str


@dataclass(frozen=True)
class RoadRecord:
    """A road.

    Args:
        id: unique in the file.
        name: may be empty.
        line: of the file.
        junction: id of the junction that it is in.
        is_left_hand: whether it has left-hand traffic.
        reference: reference line.
        lane_offset: offset of lane 0 from the reference line [m].
        roll: superelevation [rad]; None where there is none.
        speeds: of all lanes that have none of their own.
        sections: by their s.
        predecessor: neighbour at the start.
        successor: neighbour at the end.
    """

    id: str
    name: str
    line: int
    junction: str | None
    is_left_hand: bool
    reference: ReferenceLine
    lane_offset: Profiles
    roll: Profiles | None
    speeds: Speeds
    sections: tuple[SectionRecord, ...]
    predecessor: RoadLink | None
    successor: RoadLink | None

    def extent(self, section: int) -> tuple[float, float]:
        """Return the s at which a lane section begins and ends [m]."""
        is_last = section == len(self.sections) - 1
        end = self.reference.end if is_last else self.sections[section + 1].s
        return self.sections[section].s, end


def read_road(element: Element, skipped: list[Skipped]) -> RoadRecord:
    """Return the road of an element, and list what of it is not used.

    Raises:
        UnusableError: its reference line or its lane sections cannot be used.
    """
    if not (road_id := element.get("id")):
        raise UnusableError(element, "a road needs an id")
    reference = _reference_line(element, skipped)
    if not (lanes := element.first("lanes")):
        raise UnusableError(element, "the road has no <lanes>")
    lateral = element.first("lateralProfile")
    rolls = [cubic(e, "s") for e in (lateral.all("superelevation") if lateral else ())]
    link = element.first("link") or Element("link", {}, element.line)
    types = [kind for kind in element.all("type") if kind.first("speed")]
    junction = element.get("junction", "-1")
    return RoadRecord(
        id=road_id,
        name=element.get("name"),
        line=element.line,
        junction=None if junction in {"", "-1"} else junction,
        is_left_hand=element.get("rule").upper() == "LHT",
        reference=reference,
        lane_offset=Profiles([[cubic(e, "s") for e in lanes.all("laneOffset")]]),
        roll=Profiles([rolls]) if any(any(piece[1:]) for piece in rolls) else None,
        speeds=tuple(
            attempt(lambda e: (number(e, "s", 0.0), speed(e.first("speed") or e)), types, skipped)
        ),
        sections=read_sections(lanes, reference.end, skipped),
        predecessor=_road_link(link, "predecessor", skipped),
        successor=_road_link(link, "successor", skipped),
    )


def _road_link(link: Element, tag: str, skipped: list[Skipped]) -> RoadLink | None:
    element = link.first(tag)
    if element is None or not element.get("elementId"):
        return None
    if "elementS" in element.attributes:  # the road leaves another one between its ends
        why = "a connection between the ends of a road (virtual junction) is not used"
        skipped.append(Skipped(element.place, why))
        return None
    is_junction = element.get("elementType") == "junction"
    return RoadLink(element.get("elementId"), is_junction, contact_of(element))


def contact_of(element: Element) -> str:
    """Return the end of a road that an element names: "start", "end", or "" if it names none."""
    contact = element.get("contactPoint")
    return contact if contact in {"start", "end"} else ""


def _reference_line(road: Element, skipped: list[Skipped]) -> ReferenceLine:
    plan = road.first("planView")
    geometries = [_geometry(e) for e in (plan.all("geometry") if plan else ())]
    geometries = sorted((g for g in geometries if g.length > 0), key=lambda g: g.s)
    if not geometries:
        raise UnusableError(road, "the road has no <planView> with a <geometry>")
    for one, other in pairwise(geometries):
        if abs(one.s + one.length - other.s) > LENGTH_TOLERANCE:
            why = f"the geometry at s = {one.s:g} m ends at {one.s + one.length:g} m; it is used "
            skipped.append(Skipped(road.place, f"{why}up to the next one at {other.s:g} m"))
    line = ReferenceLine(geometries)
    if line.end > MAX_LENGTH:
        raise UnusableError(road, f"the road ends at s = {line.end:g} m, beyond {MAX_LENGTH:g} m")
    length = road.get("length")
    try:
        is_equal = abs(float(length) - line.end) <= LENGTH_TOLERANCE
    except ValueError:
        is_equal = False
    if not is_equal:
        why = f"length is {length[:40]!r}; that of the geometry is used, {line.end:.3f} m"
        skipped.append(Skipped(road.place, why))
    return line


def _geometry(element: Element) -> Geometry:
    shape = next((child for child in element.children if child.tag in _SHAPES), None)
    if shape is None:
        raise UnusableError(element, f"it has none of {', '.join(_SHAPES)}")
    base = Geometry(
        s=number(element, "s", least=-1e-6, most=MAX_LENGTH),
        x=number(element, "x", least=-MAX_COORDINATE, most=MAX_COORDINATE),
        y=number(element, "y", least=-MAX_COORDINATE, most=MAX_COORDINATE),
        heading=number(element, "hdg"),
        length=number(element, "length", least=0.0, most=MAX_LENGTH),
    )
    if shape.tag == "line" or base.length == 0:
        return base
    if shape.tag in {"poly3", "paramPoly3"}:
        return replace(base, **_cubics(shape))
    if shape.tag == "arc":
        found = replace(base, curvature=number(shape, "curvature"))
    else:
        start, end = number(shape, "curvStart"), number(shape, "curvEnd")
        found = replace(base, curvature=start, curvature_rate=(end - start) / base.length)
    if not found.turn <= MAX_TURN:
        raise UnusableError(shape, f"it turns by {found.turn:g} rad, more than {MAX_TURN:g} rad")
    return found


def _cubics(shape: Element) -> dict[str, Any]:
    """Return the arguments of ``Geometry`` for a poly3 or a paramPoly3."""
    if shape.tag == "poly3":
        v = tuple(number(shape, name) for name in "abcd")
        return {"u": (0.0, 1.0, 0.0, 0.0), "v": v, "parameter": Parameter.ABSCISSA}
    u, v = (tuple(number(shape, f"{name}{axis}") for name in "abcd") for axis in "UV")
    if not any(u[1:]) and not any(v[1:]):
        raise UnusableError(shape, "u and v are constant: the curve is a point")
    is_arc_length = shape.get("pRange").lower() == "arclength"
    parameter = Parameter.ARC_LENGTH if is_arc_length else Parameter.NORMALIZED
    return {"u": u, "v": v, "parameter": parameter}
