"""Reader of Lanelet2 maps in OSM XML, which needs no other package.

``load`` always uses this reader, so that a map does not depend on what is installed.
The library ``lanelet2`` is its witness in the tests: it takes a missing latitude for 0, and reads
only files that are not compressed.

The frame of the map is the one of ``local_x`` and ``local_y`` if most lanelets have these tags of
Autoware at all their points, or else the UTM zone of the middle of the map. The height ``ele`` is
used only by the projection to a tangent plane.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...values.errors import MapFileError
from ..lane import SkippedList
from ..road_map import Map, Skipped
from .coordinate_systems import notices_of
from .lanelet_tags import RawLanelet, Side, Tags, lanelets
from .lanelets import lanelet_map, linked
from .projection import UTM_LATITUDES, middle, project, tangent, utm
from .xml_tree import Document, Element, memory_of, number_in

Array = NDArray[np.float64]


#: Most memory of the nodes, ways and relations of a file: 380 000 nodes without ways [bytes].
MAX_KEPT = 1 << 27
#: Memory of one of them, without what is in it [bytes].
NODE = 350


class _Node(NamedTuple):
    """A point: position in WGS84 [deg, m] and in a local frame [m]; NaN where it has none."""

    latitude: float
    longitude: float
    height: float
    x: float
    y: float


class _Way(NamedTuple):
    nodes: tuple[str, ...]
    tags: Tags


@dataclass
class _Relation:
    """A lanelet: ids of the ways of its boundaries."""

    id: str
    where: str
    tags: Tags
    left: list[str] = field(default_factory=list)
    right: list[str] = field(default_factory=list)


def read(stream: BinaryIO, name: str, projection: str | None = None) -> Map:
    """Read a map from the bytes of an OSM file with lanelets.

    Lanes have the ids of their relations.

    Args:
        stream: of the XML document.
        name: of the file, for messages.
        projection: PROJ string of the frame, as of ``maps.formats.projection``; by default, see the
            head of this module.

    Raises:
        MapFileError: it is not XML, is not OSM, or has no usable lanelet.
        ValueError: the projection is not one of ``maps.formats.projection``.
    """
    file = _OsmFile(name)
    document = Document(stream, name, text_in=())
    for element in document.elements():
        file.add(element)
    file.skipped += document.check_root("osm", "an OSM")
    if not file.relations:
        raise MapFileError(
            f"{name} contains no lanelet (a relation with the tag type=lanelet); "
            "a map of OpenStreetMap has none"
        )
    raw, projection = file.lanelets(projection)
    file.list_the_rest()
    lanes = linked(lanelets(raw, file.skipped))
    return lanelet_map(lanes, name, file.skipped, projection)


class _OsmFile:
    """Elements of an OSM file."""

    def __init__(self, name: str) -> None:
        self._name, self._kept = name, 0
        self.skipped: list[Skipped] = SkippedList()
        self.relations: dict[str, _Relation] = {}
        self._nodes: dict[str, _Node] = {}
        self._ways: dict[str, _Way] = {}
        self._others: Counter[tuple[str, str]] = Counter()

    def add(self, element: Element) -> None:
        """Read a child of the root."""
        if element.get("action") == "delete":
            return
        key = element.get("id").strip()
        known = {"node": self._nodes, "way": self._ways, "relation": self.relations}
        if element.tag not in known:
            return
        if not key or key in known[element.tag]:  # type: ignore[operator]
            why = "another one has the same id; only that is used" if key else "it has no id"
            self.skipped.append(Skipped(element.place, why))
            return
        self._keep(element)
        if element.tag == "node":
            self._nodes[key] = _node(element)
        elif element.tag == "way":
            refs = tuple(nd.get("ref").strip() for nd in element.all("nd"))
            self._ways[key] = _Way(refs, _tags(element))
        else:
            self._add_relation(key, element)

    def _keep(self, element: Element) -> None:
        """Count the memory of what is kept of an element.

        Raises:
            MapFileError: it is too much.
        """
        inside = () if element.tag == "node" else element.children
        self._kept += NODE + sum(memory_of(child.attributes) for child in inside)
        if self._kept > MAX_KEPT:
            raise MapFileError(
                f"{self._name}, {element.place}: the nodes, ways and relations up to here take "
                f"more than {MAX_KEPT >> 20} MB; divide the map into several"
            )

    def _add_relation(self, key: str, element: Element) -> None:
        tags = _tags(element)
        if tags.get("type") != "lanelet":
            self._others[tags.get("type", "no type"), tags.get("subtype", "no subtype")] += 1
            return
        found = self.relations[key] = _Relation(key, element.place, tags)
        for member in element.all("member"):
            if member.get("type") == "way" and member.get("role") in {"left", "right"}:
                getattr(found, member.get("role")).append(member.get("ref").strip())

    def list_the_rest(self) -> None:
        """List the relations that are no lanelets, counted by their types."""
        for type_ in sorted({type_ for type_, _ in self._others}):
            counts = {sub: n for (one, sub), n in self._others.items() if one == type_}
            named = ", ".join(f"{n} {sub[:40]}" for sub, n in sorted(counts.items())[:20])
            where = f"{sum(counts.values())} relations of type {type_[:40]}"
            self.skipped.append(Skipped(where, f"only lanelets are used, not: {named}"))

    def lanelets(self, projection: str | None) -> tuple[list[RawLanelet], str | None]:
        """Return the lanelets in the frame of the map, and its projection."""
        complete = list(self._complete())
        nodes = {key: self._nodes[key] for _, ways in complete for way in ways for key in way.nodes}
        local = {key: node for key, node in nodes.items() if _is_finite(node[3:])}
        globe = {key: node for key, node in nodes.items() if _is_finite(node[:2])}

        def usable(frame: dict[str, _Node]) -> int:
            return sum(frame.keys() >= {*left.nodes, *right.nodes} for _, (left, right) in complete)

        is_local = projection is None and bool(local) and usable(local) >= usable(globe)
        used = local if is_local else globe
        values = np.array(list(used.values())).reshape(-1, 5)
        if is_local:
            points = values[:, 3:]
        else:
            projection = projection or _around(values[:, :2])
            points = project(projection, *values[:, :3].T) if projection else values[:, 3:]
            notices = notices_of(projection, points) if projection else []
            self.skipped[:0] = [Skipped("the projection", why) for why in notices]
        positions = dict(zip(used, points, strict=True))
        frame = "local_x and local_y" if is_local else "latitude and longitude"
        return list(self._placed(complete, positions, frame)), projection

    def _complete(self) -> Iterator[tuple[_Relation, tuple[_Way, _Way]]]:
        """Yield the lanelets of which the file has all points."""
        for relation in sorted(self.relations.values(), key=lambda one: _order(one.id)):
            try:
                sides = [self._side(role, getattr(relation, role)) for role in ("left", "right")]
            except ValueError as error:
                why = f"the lanelet is not used: {error}"
                self.skipped.append(Skipped(relation.where, why))
            else:
                yield relation, (sides[0], sides[1])

    def _side(self, role: str, refs: list[str]) -> _Way:
        if len(refs) != 1:
            raise ValueError(f"it has {len(refs)} boundaries with the role {role}, not one")
        way = self._ways.get(refs[0])
        if way is None:
            raise ValueError(f"its {role} boundary, way {refs[0][:40]!r}, is not in the file")
        for node in way.nodes:
            if node not in self._nodes:
                raise ValueError(f"node {node[:40]!r} of way {refs[0]} is not in the file")
        if len(way.nodes) < 2:
            raise ValueError(f"way {refs[0]} has {len(way.nodes)} points, and needs two")
        return way

    def _placed(
        self,
        complete: Iterable[tuple[_Relation, tuple[_Way, _Way]]],
        positions: dict[str, Array],
        frame: str,
    ) -> Iterator[RawLanelet]:
        """Yield the lanelets of which all points have a position."""
        for relation, ways in complete:
            missing = [node for way in ways for node in way.nodes if node not in positions]
            if missing:
                why = f"the lanelet is not used: node {missing[0][:40]!r} has no usable {frame}"
                self.skipped.append(Skipped(relation.where, why))
                continue
            left, right = (
                Side(way.nodes, np.array([positions[node] for node in way.nodes]), way.tags)
                for way in ways
            )
            left, right = aligned(left, right)
            yield RawLanelet(relation.id, relation.where, relation.tags, left, right)


def _node(element: Element) -> _Node:
    latitude, longitude = number_in(element.get("lat")), number_in(element.get("lon"))
    if not (abs(latitude) <= 90 and abs(longitude) <= 360):
        latitude = longitude = math.nan
    if not element.children:  # most, so that this saves time
        return _Node(latitude, longitude, 0.0, math.nan, math.nan)
    tags = _tags(element)
    height, x, y = (number_in(tags.get(name, "")) for name in ("ele", "local_x", "local_y"))
    return _Node(latitude, longitude, height if math.isfinite(height) else 0.0, x, y)


def _tags(element: Element) -> dict[str, str]:
    return {tag.get("k"): tag.get("v") for tag in element.children if tag.tag == "tag"}


def _order(key: str) -> tuple[int, int, str]:
    """Return a sort key: numbers by their values, then texts."""
    is_number = key.removeprefix("-").isdecimal() and len(key) < 20
    return (0, int(key), "") if is_number else (1, 0, key)


def _is_finite(values: Iterable[float]) -> bool:
    return all(map(math.isfinite, values))


def _around(positions: Array) -> str | None:
    """Return the projection for (n, 2) latitudes and longitudes [deg]."""
    if not len(positions):
        return None
    latitude, longitude = middle(*positions.T)
    low, high = UTM_LATITUDES
    return (utm if low <= latitude <= high else tangent)(latitude, longitude)


def aligned(left: Side, right: Side) -> tuple[Side, Side]:
    """Return both boundaries in driving direction, as the library does.

    The right one is on the right of the left one, and the left one on the left of the right one.
    """
    if _is_left(left.points, _middle(right.points)):
        left = _reversed(left)
    if not _is_left(right.points, _middle(left.points)):
        right = _reversed(right)
    return left, right


def _reversed(side: Side) -> Side:
    return Side(side.nodes[::-1], side.points[::-1], side.tags)


def _middle(points: Array) -> Array:
    return points[len(points) // 2] if len(points) > 2 else (points[0] + points[-1]) / 2


def _is_left(line: Array, point: Array) -> bool:
    """Return whether a point is on the left of a line, at the nearest step of it."""
    step = np.diff(line, axis=0)
    squared = (step**2).sum(axis=1)
    steps = np.flatnonzero(squared)
    if not len(steps):
        return False
    start, step = line[steps], step[steps]
    share = (((point - start) * step).sum(axis=1) / squared[steps]).clip(0, 1)
    away = ((point - start - share[:, None] * step) ** 2).sum(axis=1)
    i = int(away.argmin())
    if share[i] == 0 and i > 0:
        i -= 1  # the point between both steps, and which of them is nearer is only rounding
        share[i] = 1
    is_left = _cross(step[i], point - start[i]) > 0
    if share[i] == 1 and i + 1 < len(steps):
        is_left_of_next = _cross(step[i + 1], point - start[i + 1]) > 0
        if is_left != is_left_of_next:  # outside of a corner
            return _cross(step[i], step[i + 1]) < 0
    return bool(is_left)


def _cross(one: Array, other: Array) -> float:
    return float(one[0] * other[1] - one[1] * other[0])
