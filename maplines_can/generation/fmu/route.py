"""Lines of a map along a route as C: the points that several lines share stand there once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from ...propagation import SigmaPoints
from ...values.errors import LayoutError
from ...values.gaussian import Gaussian
from ...values.line import Slot
from ...values.polyline import Polyline
from ...values.route_lines import RouteLines
from ...values.scene import MapError

#: Most points of a route with its lines: some 50 MB of C.
MAX_POINTS = 1_000_000

Point = tuple[float, float]


class SentRoute(NamedTuple):
    """Lines along a route that a sender has, and the start values of its parameters."""

    name: str  #: of the map
    lines: RouteLines
    slots: Sequence[Slot]  #: that are sent
    window: tuple[float, float]  #: that ranges may extend to [m]
    map_error: MapError
    max_sigma: float  #: of a lateral position [m]


def pool_of(lines: Iterable[Polyline]) -> tuple[list[Point], list[tuple[int, int]]]:
    """Return points, and which of them each line is: the first one, and how many.

    The lines of a route continue those before them, so most points are of several lines. A line
    is a part of a run, or continues the end of one; else it begins a run.

    >>> lines = [[0, 0], [1, 0], [2, 0]], [[1, 0], [2, 0], [3, 0]]
    >>> pool_of(map(Polyline, lines))
    ([(0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0)], [(0, 3), (1, 3)])
    """
    runs: list[list[Point]] = []
    places: dict[Point, list[tuple[int, int]]] = {}  # of each point: runs, and where in them
    parts: list[tuple[int, int, int]] = []
    for line in lines:
        points: list[Point] = [(x, y) for x, y in line.points.tolist()]
        for number, first in reversed(places.get(points[0], [])):
            known = runs[number][first : first + len(points)]
            if known == points[: len(known)]:
                break
        else:
            number, first, known = len(runs), 0, []
            runs.append([])
        run = runs[number]
        for point in points[len(known) :]:
            places.setdefault(point, []).append((number, len(run)))
            run.append(point)
        parts.append((number, first, len(points)))
    starts = np.cumsum([0, *map(len, runs)]).tolist()
    ranges = [(starts[number] + first, count) for number, first, count in parts]
    return [point for run in runs for point in run], ranges


def route_source(sent: SentRoute) -> str:
    """Return ``route.c``: the lines along a route, and the transform of a pose.

    Raises:
        LayoutError: the route is too long, or there is no line.
    """
    route, slots = sent.lines, sent.slots
    chosen = [
        [(slot, line) for slot, line in section.items() if slot in slots]
        for section in route.sections
    ]
    lines = [line for section in chosen for _, line in section]
    if not lines:
        names = ", ".join(slot.name for slot in slots)
        raise LayoutError(f"the map has no line along the route for the slots {names or '(none)'}")
    pool, ranges = pool_of(lines)
    if len(pool) + len(route.path.points) > MAX_POINTS:
        raise LayoutError(
            f"the lines of the route have {len(pool)} points, but an FMU takes {MAX_POINTS}; take "
            "a shorter route"
        )
    rule = SigmaPoints().rule(Gaussian([0, 0, 0], np.eye(3)))
    owners = [(slot, line.kind) for section in chosen for slot, line in section]
    firsts = np.cumsum([0, *map(len, chosen)]).tolist()
    tables = (
        ("double", "points[][2]", [f"{{{_pair(point)}}}" for point in pool]),
        ("maplines_route_line_t", "lines[]", [
            f"{{{first}, {count}, (maplines_owner_t){int(slot)}, (maplines_kind_t){int(kind)}}}"
            for (first, count), (slot, kind) in zip(ranges, owners, strict=True)
        ]),
        ("maplines_route_section_t", "sections[]", [
            f"{{{start.hex()}, {first}, {len(section)}}}"
            for start, first, section in zip(route.starts, firsts, chosen, strict=False)
        ]),
        ("double", "path[][2]", [f"{{{_pair(point)}}}" for point in route.path.points.tolist()]),
        ("double", "distance[]", _numbers(route.path.distance.tolist())),
        ("double", "z[]", _numbers(rule.z.ravel().tolist())),
        ("double", "mean_weights[]", _numbers(rule.mean_weights.tolist())),
        ("double", "cov_weights[]", _numbers(rule.cov_weights.tolist())),
    )  # fmt: skip
    most = max(sum(len(line.points) for _, line in section) for section in chosen)
    return "\n".join([
        "/* Lines of a map along a route, written by maplines generate fmu. */",
        '#include "route.h"',
        "",
        *(text for table in tables for text in _table(*table)),
        "const maplines_route_t maplines_route = {",
        f"    points, lines, sections, {len(chosen)}, {most}, path, distance,",
        f"    {len(route.path.points)}, {{{len(rule.z)}, z, mean_weights, cov_weights}},",
        "};",
        "",
    ])  # fmt: skip


def _table(ctype: str, name: str, values: Sequence[str]) -> Iterator[str]:
    yield f"static const {ctype} {name} = {{"
    yield from (f"    {value}," for value in values)
    yield from ("};", "")


def _numbers(values: Iterable[float]) -> list[str]:
    return [value.hex() for value in values]


def _pair(point: Iterable[float]) -> str:
    return ", ".join(_numbers(point))
