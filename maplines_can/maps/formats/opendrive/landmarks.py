"""Landmarks of an OpenDRIVE road: its poles and trees, its signals, and its buildings."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from ....values.polyline import Polyline
from ...road_map import Landmark, LandmarkKind, Skipped
from ..xml_tree import Element
from .road import RoadRecord
from .xml_attributes import UnusableError, attempt, number

#: Types of objects that are landmarks; a street lamp is one of OpenDRIVE 1.4.
POLES = frozenset({"pole", "streetLamp", "tree"})
BUILDING = "building"
#: Longest side of a building [m].
MAX_LENGTH = 1000.0
#: Most landmarks of one <repeat>; more are a mistake in the file.
MAX_REPEATS = 10_000

#: Positions along and across the reference line, (n, 2) [m].
Places = NDArray[np.float64]


def read_landmarks(
    element: Element, road: RoadRecord, skipped: list[Skipped]
) -> Iterator[Landmark]:
    """Yield the landmarks of a road, and list those that cannot be used.

    An object with <repeat> is a row of landmarks. The superelevation of the road is neglected.

    Args:
        element: of the road.
        road: what is read of it.
        skipped: takes what is not used.
    """
    poles = [one for one in _objects(element) if one.get("type") in POLES]
    signs = [one for group in element.all("signals") for one in group.all("signal")]
    read = partial(_places, road)
    for kind, upright in ((LandmarkKind.POLE, poles), (LandmarkKind.SIGN, signs)):
        for name, places in attempt(read, upright, skipped):
            position, tangent = road.reference(places[:, 0], places[:, 0])
            points = position + 1j * tangent * places[:, 1]
            for i, point in enumerate(points):
                number_ = f":{i}" if len(points) > 1 else ""
                id_ = f"{road.id}:{kind}:{name}{number_}"
                yield Landmark(id_, kind, float(point.real), float(point.imag))


def read_buildings(
    element: Element, road: RoadRecord, skipped: list[Skipped]
) -> Iterator[Polyline]:
    """Yield the outlines of the buildings beside a road: rectangles of their length and width.

    A building with <repeat> is a row of them. Other outlines are not read.

    Args:
        element: of the road.
        road: what is read of it.
        skipped: takes what is not used.
    """

    def read(one: Element) -> tuple[Places, complex, float]:
        length, width = (number(one, name, least=0.1, most=MAX_LENGTH) for name in _SIDES)
        return _places(road, one)[1], complex(length, width) / 2, number(one, "hdg", 0.0)

    found = [one for one in _objects(element) if one.get("type") == BUILDING]
    for places, half, heading in attempt(read, found, skipped):
        position, tangent = road.reference(places[:, 0], places[:, 0])
        centre = position + 1j * tangent * places[:, 1]
        corners = np.array([half, -half.conjugate(), -half, half.conjugate(), half])
        outlines = centre[:, None] + (tangent * np.exp(1j * heading))[:, None] * corners
        for outline in outlines:
            yield Polyline(np.column_stack([outline.real, outline.imag]))


_SIDES = ("length", "width")


def _objects(element: Element) -> list[Element]:
    return [one for group in element.all("objects") for one in group.all("object")]


def _places(road: RoadRecord, element: Element) -> tuple[str, Places]:
    """Return the id of an object or signal, and where it stands.

    Raises:
        UnusableError: it has no id or position, or too many repetitions.
    """
    if not (name := element.get("id")):
        raise UnusableError(element, f"a {element.tag} needs an id")
    end = road.reference.end
    at = partial(number, least=-1e-6, most=end + 1e-6)
    rows = [_row(repeat, at(repeat, "s"), end) for repeat in element.all("repeat")]
    if not rows:
        rows = [np.array([[at(element, "s"), number(element, "t")]])]
    return name, np.vstack(rows)


def _row(repeat: Element, start: float, end: float) -> Places:
    """Return the places of a <repeat>."""
    length = min(number(repeat, "length", least=0.0), end - start)
    distance = number(repeat, "distance")
    if not distance > 0:
        raise UnusableError(repeat, f"distance must be more than 0, got {distance:g}")
    count = int(np.floor(max(length, 0.0) / distance + 1e-9)) + 1
    if count > MAX_REPEATS:
        raise UnusableError(repeat, f"it has {count} objects, more than {MAX_REPEATS}")
    s = start + distance * np.arange(count)
    first = number(repeat, "tStart")
    last = number(repeat, "tEnd", first)
    share = (s - start) / length if length > 0 else np.zeros(count)
    return np.column_stack([s, first + share * (last - first)])
