"""Roads of an OpenDRIVE file as values."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from ...road_map import Skipped
from ..xml_tree import Element
from .lane_section import SectionRecord, Speeds, read_sections, speed
from .profiles import CubicPiece, Profiles
from .reference_line import MAX_TURN, Geometry, Parameter, ReferenceLine
from .xml_attributes import UnusableError, attempt, cubic, cubics, number

#: Largest coordinate [m]. UTM has 1e7 m.
MAX_COORDINATE = 1e8
#: Longest road [m].
MAX_LENGTH = 1e6
#: Gap between geometries, and difference of lengths, that is listed [m].
LENGTH_TOLERANCE = 0.01
#: Excess of a width of 3.5 m that is not listed [mm].
MAX_EXCESS_MM = 0.5

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
    stretch = (0.0, reference.end)
    lateral = element.first("lateralProfile") or Element("lateralProfile", {}, element.line)
    offsets, rolls = (
        _from_the_start(
            cubics(parent.all(tag), "s", stretch, skipped), f"{element.place}, {tag}", skipped
        )
        for parent, tag in ((lanes, "laneOffset"), (lateral, "superelevation"))
    )
    _list_unused(lateral, reference.end, skipped)
    link = element.first("link") or Element("link", {}, element.line)
    junction = element.get("junction", "-1")
    return RoadRecord(
        id=road_id,
        name=element.get("name"),
        line=element.line,
        junction=None if junction in {"", "-1"} else junction,
        is_left_hand=element.get("rule").upper() == "LHT",
        reference=reference,
        lane_offset=Profiles([offsets]),
        roll=Profiles([rolls]) if any(any(piece[1:]) for piece in rolls) else None,
        speeds=tuple(
            attempt(
                lambda e: (number(e, "s", 0.0), speed(e.first("speed"), skipped)),
                element.all("type"),
                skipped,
            )
        ),
        sections=read_sections(lanes, reference.end, skipped),
        predecessor=_road_link(link, "predecessor", skipped),
        successor=_road_link(link, "successor", skipped),
    )


def _from_the_start(
    pieces: tuple[CubicPiece, ...], place: str, skipped: list[Skipped]
) -> tuple[CubicPiece, ...]:
    """Return a function that is 0 before its first piece: what is not defined is not there."""
    if not pieces or pieces[0].start <= 1e-6 or not pieces[0].a:
        return pieces
    why = f"it is not defined before s = {pieces[0].start:g} m; 0 is used there"
    skipped.append(Skipped(place, why))
    return (CubicPiece(0.0, 0.0), *pieces)


def _list_unused(lateral: Element, end: float, skipped: list[Skipped]) -> None:
    """List the shapes of a cross-section that are not used."""
    if pieces := attempt(lambda e: cubic(e, "s"), lateral.all("crossfall"), skipped):
        s = np.linspace(0.0, end, 33)
        angle = float(np.abs(Profiles([pieces])(s, s)).max())
        if (excess := 3500 * (1 - math.cos(angle))) > MAX_EXCESS_MM:
            why = f"crossfall is not used: a width of 3.5 m is {excess:.3g} mm too large"
            skipped.append(Skipped(lateral.place, why))
    if any(shape.get(name, "0").strip("+-.0") for shape in lateral.all("shape") for name in "bcd"):
        why = "shapes are not used: widths are those along a plane road"
        skipped.append(Skipped(lateral.place, why))


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
    elements = plan.all("geometry") if plan else []
    elements = [e for e in elements if number(e, "length", least=0.0) > 0] or elements[:1]
    geometries = sorted(map(_geometry, elements), key=lambda g: g.s)
    if not geometries:
        raise UnusableError(road, "the road has no <planView> with a <geometry>")
    for one, other in pairwise(geometries):
        if abs(one.s + one.length - other.s) > LENGTH_TOLERANCE:
            why = f"the geometry at s = {one.s:g} m ends at {one.s + one.length:g} m; it is used "
            skipped.append(Skipped(road.place, f"{why}up to the next one at {other.s:g} m"))
    line = ReferenceLine(geometries)
    joints = np.array(line.starts[1:])
    gaps = np.abs(line(joints, np.nextafter(joints, -np.inf))[0] - line(joints, joints)[0])
    if (jumps := joints[gaps > LENGTH_TOLERANCE]).size:
        why = (
            f"{jumps.size} geometries begin up to {gaps.max():.3g} m from the end of the one before"
        )
        skipped.append(Skipped(road.place, f"{why}; the lines jump, first at s = {jumps[0]:g} m"))
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
