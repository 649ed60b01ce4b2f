"""Reader of map lines as points: GeoJSON, and CSV.

Each line may name a ``lane`` and the ``side`` on which it is of it in driving direction, ``left``
or ``right``; a line between two lanes is listed with both. It may have a ``kind``, the name of a
``Kind`` such as ``solid`` or ``road_edge``. Lines run in driving direction, and lanes are beside
each other, or follow each other, if their boundaries have the same points. A side may be several
lines, such as one of each kind; each begins where the one before it in the file ends. A lane with
only one side is not used. Lines without a lane are ``Map.polylines``.

GeoJSON: each feature is a ``LineString`` or a ``MultiLineString`` with these as ``properties``.
Positions are longitude and latitude of WGS84, projected around the middle of the map, or those of
the system that a member ``crs`` names: see ``systems``. A geographic one has the longitude first.

CSV: the first line names the columns ``line``, ``x`` and ``y`` [m], and perhaps ``lane``, ``side``
and ``kind``. The points of a line are in their order, next to each other. A kind applies from its
point on, up to the next one that is given.
"""

from __future__ import annotations

import codecs
import csv
import io
import itertools
import json
import math
import zlib
from array import array
from collections.abc import Hashable, Iterable, Iterator, Sequence
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...values.errors import MapFileError
from ...values.input_files import lines_of
from ...values.line import Kind
from ...values.polyline import Polyline
from ..lane import SkippedList
from ..road_map import Lane, Map, Skipped
from .coordinate_systems import is_wgs84, notices_of, placed
from .lanelets import Lanelet, boundary, centre_line, lanelet_map, linked
from .projection import around, project
from .xml_tree import number_in

Array = NDArray[np.float64]

#: Largest file [bytes]; a million points are about 30 MB.
MAX_BYTES = 1 << 25
#: Largest GeoJSON file [bytes], and most memory of its values, by ``_check_json`` [bytes].
MAX_JSON_BYTES, MAX_JSON = 1 << 24, 3 << 25
#: Bytes that show the format.
HEAD = 1 << 16
#: Most lines, and most points of a line.
MAX_LINES, MAX_POINTS = 100_000, 2_000_000
#: From a point of a line to the next [deg], 11 km; more is metres that are taken for degrees.
MAX_STEP_DEG = 0.1


class _Line(NamedTuple):
    """A line as in its file."""

    name: str
    where: str
    points: Array  #: (n, 2)
    lane: str
    side: str
    kinds: Sequence[tuple[int, str]]  #: from which point on each applies


def read(stream: BinaryIO, name: str, projection: str | None = None) -> Map:
    """Read a map from the bytes of a GeoJSON or a CSV file; the first character shows which.

    Args:
        stream: of the text in UTF-8.
        name: of the file, for messages.
        projection: PROJ string of the frame of a GeoJSON map, as of ``maps.formats.projection``.

    Raises:
        MapFileError: it is neither, or has no usable line.
        ValueError: the projection is not one of ``maps.formats.projection``.
    """
    try:
        data = stream.read(MAX_BYTES + 1)
        if len(data) > MAX_BYTES:
            raise MapFileError(
                f"{name} has more than {MAX_BYTES >> 20} MB; divide the map into several"
            )
        skipped: list[Skipped] = SkippedList()
        if data[:HEAD].removeprefix(codecs.BOM_UTF8).lstrip().startswith((b"{", b"[")):
            _check_json(data, name)
            text = data.decode("utf-8-sig")
            del data
            lines, projection = _geojson(text, name, projection, skipped)
        else:
            file = io.TextIOWrapper(io.BytesIO(data), encoding="utf-8-sig", newline="")
            lines = list(_csv(lines_of(file, name, MapFileError), name, skipped))
    except (EOFError, OSError, UnicodeDecodeError, zlib.error) as error:
        raise MapFileError(f"{name} cannot be read as text in UTF-8: {error}") from None
    return _map(lines, name, skipped, projection)


def _check_json(data: bytes, name: str) -> None:
    """Raise MapFileError if the values of a document would take too much memory."""
    size = {b"{": 200, b"[": 64, b",": 40, b":": 60}  # about, with the value that follows
    memory = sum(data.count(sign) * each for sign, each in size.items())
    if len(data) > MAX_JSON_BYTES or memory > MAX_JSON:
        raise MapFileError(
            f"{name} has more than {MAX_JSON_BYTES >> 20} MB, or values of more than "
            f"{MAX_JSON >> 20} MB; divide the map into several"
        )


def _check_lines(count: int, name: str) -> None:
    """Raise MapFileError if a file has too many lines."""
    if count > MAX_LINES:
        raise MapFileError(f"{name} has more than {MAX_LINES} lines; divide the map into several")


def _map(lines: Iterable[_Line], name: str, skipped: list[Skipped], projection: str | None) -> Map:
    sides: dict[str, dict[str, list[_Line]]] = {}
    polylines: dict[str, Polyline] = {}
    for line in lines:
        try:
            found = _boundary(line)
            if line.lane and line.side not in {"left", "right"}:
                raise ValueError(f"the side must be left or right, got {line.side[:40]!r}")  # noqa: TRY301
        except ValueError as error:
            skipped.append(Skipped(line.where, f"line {line.name[:40]!r} is not used: {error}"))
            continue
        if not line.lane:
            polylines[_unique(line.name, polylines)] = found
            continue
        parts = sides.setdefault(line.lane, {}).setdefault(line.side, [])
        if parts and (parts[-1].points[-1] != line.points[0]).any():
            why = f"lane {line.lane[:40]!r} has another {line.side} side; only that is used"
            skipped.append(Skipped(line.where, why))
        else:
            parts.append(line)
    lanelets = list(_lanelets(sides, skipped))
    return lanelet_map(linked(lanelets), name, skipped, projection, polylines)


def _lanelets(
    sides: dict[str, dict[str, list[_Line]]], skipped: list[Skipped]
) -> Iterator[Lanelet]:
    for lane, both in sides.items():
        whole = {side: _joined(parts) for side, parts in both.items()}
        try:
            if len(both) < 2:
                raise ValueError(f"it has only a {next(iter(both))} side")  # noqa: TRY301
            left, right = _boundary(whole["left"]), _boundary(whole["right"])
            centre = centre_line(left, right)
        except ValueError as error:
            where = next(iter(whole.values())).where
            skipped.append(Skipped(where, f"lane {lane[:40]!r} is not used: {error}"))
            continue
        ends: tuple[tuple[Hashable, ...], ...] = tuple(
            tuple(map(complex, *whole[side].points.T.tolist())) for side in ("left", "right")
        )
        yield Lanelet(Lane(id=lane, left=left, right=right, centre=centre), *ends)


def _joined(parts: Sequence[_Line]) -> _Line:
    """Return the line of several, each of which begins with the last point of the one before."""
    first, *others = parts
    first_rows = np.cumsum([0, *(len(part.points) - 1 for part in parts)]).tolist()
    return first._replace(
        points=np.concatenate([first.points, *(part.points[1:] for part in others)]),
        kinds=[
            (begin + row, kind)
            for begin, part in zip(first_rows, parts, strict=False)
            for row, kind in part.kinds
        ],
    )


def _boundary(line: _Line) -> Polyline:
    """Return the line with its kinds.

    Raises:
        ValueError: it is no line, or a kind is none.
    """
    found = boundary(line.points)
    distance = np.append(0.0, np.hypot(*np.diff(line.points, axis=0).T).cumsum()).tolist()
    kinds = {distance[row]: _kind(name) for row, name in line.kinds if row + 1 < len(distance)}
    return Polyline.trusted(found.points, [*kinds.items()], found.distance)


def _kind(text: str) -> Kind:
    name = text.strip().upper() or "UNKNOWN"
    if name not in Kind.__members__:
        known = ", ".join(kind.name.lower() for kind in Kind)
        raise ValueError(f"the kind must be one of {known}, got {text[:40]!r}")
    return Kind[name]


def _unique(name: str, known: dict[str, Polyline]) -> str:
    """Return the name, with a number if it is not the first of its kind."""
    if name not in known:
        return name
    return next(one for i in itertools.count(2) if (one := f"{name}#{i}") not in known)


def _csv(text: Iterable[str], name: str, skipped: list[Skipped]) -> Iterator[_Line]:
    rows = csv.reader(text, skipinitialspace=True)
    try:
        columns = [column.strip() for column in next(rows, [])]
        if missing := {"line", "x", "y"} - set(columns):
            raise MapFileError(
                f"{name}: a map has the columns line, x and y; "
                f"there is no {', '.join(sorted(missing))}"
            )
        place = {column: columns.index(column) for column in columns}

        def field(row: list[str], column: str) -> str:
            i = place.get(column, len(row))
            return row[i].strip() if i < len(row) else ""

        seen: set[str] = set()
        given = (row for row in rows if any(row))  # not the blank lines
        for key, group in itertools.groupby(given, lambda row: field(row, "line")):
            first = next(group)
            where = bad_at = f"line {rows.line_num}"
            points, bad = array("d"), ""
            kinds = [(0, field(first, "kind"))]
            for row in itertools.chain([first], group):
                kind = field(row, "kind")
                if kind and kind != kinds[-1][1]:
                    kinds.append((len(points) // 2, kind))
                points.extend((number_in(field(row, "x")), number_in(field(row, "y"))))
                if len(points) > 2 * MAX_POINTS:
                    raise MapFileError(
                        f"{name}, {where}: a line has more than {MAX_POINTS} points; divide it"
                    )
                if not bad and not all(map(math.isfinite, points[-2:])):
                    bad_at = f"line {rows.line_num}"
                    bad = f"{','.join(row)[:80]!r} is not a point of a map"
            if key in seen:
                bad_at = where
                bad = "points at two places; put the points of a line next to each other"
            seen.add(key)
            _check_lines(len(seen), name)
            if bad:
                skipped.append(Skipped(bad_at, f"line {key[:40]!r} is not used: {bad}"))
            else:
                lane, side = field(first, "lane"), field(first, "side").lower()
                yield _Line(key, where, _array(points), lane, side, kinds)
    except csv.Error as error:
        raise MapFileError(f"{name}, line {rows.line_num}: {error}") from None


def _geojson(
    text: str, name: str, projection: str | None, skipped: list[Skipped]
) -> tuple[list[_Line], str | None]:
    """Return the lines in the frame of the map, and its projection."""
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise MapFileError(f"{name} is not JSON: {error}") from None
    kind = document.get("type") if isinstance(document, dict) else None
    features = document.get("features") if kind == "FeatureCollection" else None
    if kind == "Feature":
        features = [document]
    if not isinstance(features, list):
        raise MapFileError(f"{name} is not GeoJSON with a FeatureCollection of lines")
    lines: list[_Line] = []
    for i, one in enumerate(features):
        lines += _feature(one, i, skipped)
        _check_lines(len(lines), name)
    if document.get("crs") is None:
        return _projected(lines, projection, skipped)
    system = _system(document["crs"])
    if is_wgs84(system):
        return _projected(lines, projection, skipped)
    try:
        found = placed(system, np.concatenate([np.empty((0, 2)), *_points(lines)]), projection)
    except ValueError as error:
        raise MapFileError(f"{name}, member crs: {error}") from None
    skipped[:0] = [Skipped("member crs", why) for why in found.notices]
    return _with_points(lines, found.points), found.projection


def _system(crs: Any) -> str:
    """Return the name of the system of a member ``crs``, or its text if it names none."""
    given = crs.get("properties") if isinstance(crs, dict) else None
    given = given if isinstance(given, dict) else {}
    if isinstance(code := given.get("code"), int):  # of drafts of GeoJSON
        return f"EPSG:{code}"
    return str(given["name"]) if "name" in given else json.dumps(crs)


def _points(lines: Iterable[_Line]) -> list[Array]:
    return [line.points for line in lines]


def _with_points(lines: Sequence[_Line], points: Array) -> list[_Line]:
    """Return the lines with other points, which follow each other."""
    ends = np.cumsum([len(line.points) for line in lines])
    parts = zip(lines, np.split(points, ends[:-1]), strict=True)
    return [line._replace(points=part) for line, part in parts]


def _feature(feature: Any, index: int, skipped: list[Skipped]) -> Iterator[_Line]:
    """Yield the lines of a feature with longitude and latitude, and list what is none."""
    where = f"feature {index}"
    feature = feature if isinstance(feature, dict) else {}
    geometry, given = feature.get("geometry"), feature.get("properties")
    geometry = geometry if isinstance(geometry, dict) else {}
    given = given if isinstance(given, dict) else {}
    shape, coordinates = geometry.get("type"), geometry.get("coordinates")
    if shape not in {"LineString", "MultiLineString"}:
        skipped.append(Skipped(where, f"its geometry is {str(shape)[:40]}, not a line"))
        return
    parts: Any = coordinates if shape == "MultiLineString" else [coordinates]
    named = str(feature.get("id", given.get("id", given.get("line", index))))
    lane, side, kind = (
        "" if given.get(key) is None else str(given[key]) for key in ("lane", "side", "kind")
    )
    if lane and shape == "MultiLineString" and isinstance(parts, list) and len(parts) > 1:
        skipped.append(Skipped(where, "a side of a lane must be one LineString"))
        return
    for part in parts if isinstance(parts, list) else [parts]:
        try:
            points = _array([_coordinate(p[axis]) for p in part for axis in (0, 1)])
        except (IndexError, KeyError, OverflowError, TypeError):
            skipped.append(Skipped(where, "its coordinates are not lists of two numbers"))
        else:
            yield _Line(named, where, points, lane.strip(), side.strip().lower(), [(0, kind)])


def _array(values: Sequence[float]) -> Array:
    """Return (n, 2) points from their values one after the other."""
    return np.array(values, dtype=float).reshape(-1, 2)


def _coordinate(value: object) -> float:
    """Return a number of a JSON document, in which true and "1" are none."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError
    return float(value)


def _are_degrees(points: Array) -> bool:
    """Return whether points are longitudes and latitudes of a road."""
    if not (np.abs(points) <= (360, 90)).all():  # also for NaN
        return False
    steps = (np.diff(points, axis=0) + 180) % 360 - 180  # also across the antimeridian
    return bool((np.abs(steps) <= MAX_STEP_DEG).all())


def _projected(
    lines: Iterable[_Line], projection: str | None, skipped: list[Skipped]
) -> tuple[list[_Line], str | None]:
    """Return the lines around the middle of the map, and their projection."""
    usable = []
    for line in lines:
        if _are_degrees(line.points):
            usable.append(line)
        else:
            why = (
                "a position is no longitude and latitude [deg]; if it is in metres, name its "
                "system in the member crs"
            )
            skipped.append(Skipped(line.where, why))
    if not usable or not len(points := np.concatenate(_points(usable))):
        return [], None
    longitude, latitude = points.T
    projection = projection or around(latitude, longitude)
    plane = project(projection, latitude, longitude)
    skipped[:0] = [Skipped("the projection", why) for why in notices_of(projection, plane)]
    return _with_points(usable, plane), projection
