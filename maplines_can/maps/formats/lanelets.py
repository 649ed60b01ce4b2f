"""Maps of lanelets: lanes with left and right boundaries, linked by the points that they share.

A lanelet belongs to no road in its file. Those beside each other become one ``Road``.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...values.errors import MapFileError
from ...values.line import Kind
from ...values.polyline import Polyline
from ..road_map import Lane, LaneType, Map, Road, Skipped

Array = NDArray[np.float64]

#: Points nearer to each other are one [m].
SAME = 1e-6
#: Largest coordinate [m].
MAX_COORDINATE = 1e8
#: Largest cosine of the angle between a lane and the line from a point of its left boundary to one
#: of its right that is across from it.
MAX_SKEW = 0.3
#: Most pairs of points and steps of which ``centre_line`` computes the distance.
MAX_PAIRS = 10**8
_PAIRS_AT_ONCE = 10**6


class Lanelet(NamedTuple):
    """A lane, and the identities of the points of its boundaries in driving order.

    Args:
        lane: without its links.
        left: of the left boundary. Boundaries with the same identities are the same.
        right: of the right boundary.
    """

    lane: Lane
    left: tuple[Hashable, ...]
    right: tuple[Hashable, ...]


def boundary(points: Array, kind: Kind = Kind.UNKNOWN) -> Polyline:
    """Return the points as a line, without those that repeat the one before.

    Raises:
        ValueError: a coordinate is not finite or too large, or there is only one point.
    """
    if not (np.abs(points) <= MAX_COORDINATE).all():  # false for NaN
        worst = points[~(np.abs(points) <= MAX_COORDINATE).all(axis=1)][0]
        raise ValueError(
            f"a point is at ({worst[0]:g}, {worst[1]:g}) m; coordinates must be finite, and at "
            f"most {MAX_COORDINATE:g} m"
        )
    step = np.hypot(*np.diff(points, axis=0, prepend=np.inf).T)
    keep = step > SAME
    if np.count_nonzero(keep) < 2:
        raise ValueError("a boundary needs two different points")
    return Polyline(points[keep], kind)


def centre_line(left: Polyline, right: Polyline) -> Polyline:
    """Return the line halfway between two boundaries that run in the same direction.

    If they have as many points, each across from one of the other, it is halfway between these.
    Otherwise it is halfway between points at the same fractions of both lengths, moved to halfway
    between the points of both boundaries that are nearest to them.

    Raises:
        ValueError: it has no length, or nowhere a width.

    >>> left, right = Polyline([[0, 3], [9, 3]]), Polyline([[0, 0], [4, 0], [9, 0]])
    >>> centre_line(left, right).points
    array([[0. , 1.5],
           [4. , 1.5],
           [9. , 1.5]])
    """
    if len(left.points) == len(right.points) and np.abs(left.points - right.points).max() <= SAME:
        raise ValueError("it has no width")
    if _is_paired(left.points, right.points):
        return boundary((left.points + right.points) / 2, Kind.VIRTUAL)
    fractions = np.unique(np.concatenate([line.distance / line.length for line in (left, right)]))
    pair = _at(left, fractions), _at(right, fractions)
    points, reach = (pair[0] + pair[1]) / 2, np.hypot(*(pair[0] - pair[1]).T)
    if len(points) * (len(left.points) + len(right.points)) <= MAX_PAIRS:
        (on_left, inside_left), (on_right, inside_right) = (
            _nearest(line, points, fractions * line.length, reach) for line in (left, right)
        )
        moved = inside_left & inside_right
        points[moved] = (on_left[moved] + on_right[moved]) / 2
    return boundary(points, Kind.VIRTUAL)


def _is_paired(left: Array, right: Array) -> bool:
    """Return whether each point, but for those at the ends, is across from one of the other."""
    if len(left) != len(right):
        return False
    across = (left - right)[1:-1]
    along = (left + right)[2:] - (left + right)[:-2]
    size = np.hypot(*across.T) * np.hypot(*along.T)
    return bool((np.abs((across * along).sum(axis=1)) <= MAX_SKEW * size).all())


def _at(line: Polyline, fractions: Array) -> Array:
    s = fractions * line.length
    return np.column_stack([np.interp(s, line.distance, values) for values in line.points.T])


def _nearest(
    line: Polyline, points: Array, s: Array, reach: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the nearest points of a line, and which of them are not at its ends.

    Args:
        line: of which they are points.
        points: (n, 2) to which they are near [m].
        s: (n,) arc lengths of the line around which they are [m].
        reach: (n,) largest distance from these along the line [m].
    """
    start, step = line.points[:-1], np.diff(line.points, axis=0)
    squared = (step**2).sum(axis=1)
    found, inside = np.empty_like(points), np.empty(len(points), dtype=bool)
    rows = max(1, _PAIRS_AT_ONCE // len(step))
    for first in range(0, len(points), rows):
        part = slice(first, first + rows)
        to = points[part, None] - start
        share = ((to * step).sum(axis=2) / squared).clip(0, 1)
        away = ((to - share[..., None] * step) ** 2).sum(axis=2)
        low, high = (s - reach)[part, None], (s + reach)[part, None]
        away[(line.distance[1:] < low) | (line.distance[:-1] > high)] = np.inf
        best = away.argmin(axis=1)
        share = share[np.arange(len(best)), best]
        found[part] = start[best] + share[:, None] * step[best]
        inside[part] = ~(((best == 0) & (share == 0)) | ((best == len(step) - 1) & (share == 1)))
    return found, inside


def linked(lanelets: Iterable[Lanelet]) -> Iterator[Lane]:
    """Yield the lanes with the links that follow from the points that their boundaries share.

    Lanes are beside each other if they share a whole boundary, and follow each other if the last
    points of both boundaries are the first ones of the other's.
    """
    lanelets = list(lanelets)
    of_left, of_right, of_start, of_end = (_Index() for _ in range(4))
    for lanelet in lanelets:
        lane, left, right = lanelet
        of_start[left[0], right[0]].append(lane)
        of_end[left[-1], right[-1]].append(lane)
        if lane.type.is_drivable:
            of_left[left].append(lane)
            of_right[right].append(lane)
    for lane, left, right in lanelets:
        yield replace(
            lane,
            left_neighbour=_other(lane, of_right[left]),
            right_neighbour=_other(lane, of_left[right]),
            opposite_left=_other(lane, of_left[left[::-1]]) or _other(lane, of_right[right[::-1]]),
            successors=tuple(other.id for other in of_start[left[-1], right[-1]]),
            predecessors=tuple(other.id for other in of_end[left[0], right[0]]),
        )


class _Index(defaultdict[Hashable, list[Lane]]):
    def __init__(self) -> None:
        super().__init__(list)


def _other(lane: Lane, lanes: Sequence[Lane]) -> str | None:
    return next((other.id for other in lanes if other is not lane), None)


def lanelet_map(
    lanes: Iterable[Lane],
    name: str,
    skipped: Iterable[Skipped] = (),
    projection: str | None = None,
    polylines: Mapping[str, Polyline] | None = None,
) -> Map:
    """Return the map of lanes that belong to no road. Lanes beside each other become one.

    Args:
        lanes: with their links. Links that lead nowhere are removed and listed.
        name: of the file.
        skipped: what in the file is not used.
        projection: of the map.
        polylines: lines of no lane.

    Raises:
        MapFileError: there are neither lanes nor lines, or all lanes are mirrored.
    """
    by_id, skipped = {lane.id: lane for lane in lanes}, list(skipped)
    if not by_id and not polylines:
        why = f"; first reason: {skipped[0]}" if skipped else ""
        raise MapFileError(f"{name} contains no usable lane or line{why}")
    if by_id and all(map(_is_mirrored, by_id.values())):
        raise MapFileError(
            f"{name}: the left boundary of each lane is on its right; write x (east) before y "
            "(north), or longitude before latitude, or exchange left and right"
        )
    if both_ways := sum(lane.type is LaneType.BIDIRECTIONAL for lane in by_id.values()):
        why = "they are used only in the direction of their boundaries"
        skipped.append(Skipped(f"{both_ways} lanelets that are not one-way", why))
    by_id = {lane.id: _without_dead_links(lane, by_id, skipped) for lane in by_id.values()}
    road_of: dict[str, str] = {}
    groups: list[list[Lane]] = []
    for lane in by_id.values():
        if lane.id not in road_of:
            groups.append(_beside(lane, by_id))
            road_of |= dict.fromkeys((other.id for other in groups[-1]), groups[-1][0].id)
    roads = [_road(group, road_of) for group in groups]
    on_left = on_right = 0
    for lane in by_id.values():
        if lane.opposite_left is not None and lane.type.is_drivable:
            is_right = _is_on_right(lane, by_id[lane.opposite_left])
            on_left, on_right = on_left + (not is_right), on_right + is_right
    return Map(
        lanes={lane.id: replace(lane, road=road_of[lane.id]) for lane in by_id.values()},
        roads={road.id: road for road in roads},
        skipped=tuple(skipped),
        projection=projection,
        name=name,
        left_hand_traffic=on_right > on_left,
        polylines=polylines or {},
    )


def _is_mirrored(lane: Lane) -> bool:
    """Return whether the left boundary of a lane begins on the right of the lane."""
    (x, y), (u, v) = (
        lane.left.points[0] - lane.right.points[0],
        np.diff(lane.centre.points[:2], axis=0)[0],
    )
    return bool(u * y - v * x < 0)


def _without_dead_links(lane: Lane, known: Mapping[str, Lane], skipped: list[Skipped]) -> Lane:
    dead = sorted({one for one in lane.linked if one not in known})
    if not dead:
        return lane
    skipped.append(Skipped(f"lane {lane.id}", f"its links to {', '.join(dead[:5])} lead nowhere"))
    beside = {
        side: None
        for side in ("left_neighbour", "right_neighbour", "opposite_left")
        if getattr(lane, side) in dead
    }
    along = {
        side: tuple(one for one in getattr(lane, side) if one in known)
        for side in ("successors", "predecessors")
    }
    return replace(lane, **beside, **along)  # type: ignore[arg-type]


def _beside(lane: Lane, lanes: Mapping[str, Lane]) -> list[Lane]:
    """Return the lane and all that are reached from it sideways."""
    group, todo = {lane.id: lane}, [lane]
    while todo:
        one = todo.pop()
        for other in (one.left_neighbour, one.right_neighbour, one.opposite_left):
            if other is not None and other not in group:
                group[other] = lanes[other]
                todo.append(lanes[other])
    return list(group.values())


def _road(group: Sequence[Lane], road_of: Mapping[str, str]) -> Road:
    own = group[0].id

    def roads(ids: Iterable[str]) -> tuple[str, ...]:
        return tuple(dict.fromkeys(road_of[one] for one in ids if road_of[one] != own))

    return Road(
        id=own,
        name="",
        length=max(lane.length for lane in group),
        lanes=tuple(lane.id for lane in group),
        junction=next((lane.junction for lane in group if lane.junction), None),
        successors=roads(one for lane in group for one in lane.successors),
        predecessors=roads(one for lane in group for one in lane.predecessors),
    )


def _is_on_right(lane: Lane, other: Lane) -> bool:
    """Return whether another lane is on the right of a lane, at the middle of the lane."""
    before, middle, after = _at(lane.centre, np.array([0.49, 0.5, 0.51]))
    away = other.centre.points - middle
    along, across = after - before, away[(away**2).sum(axis=1).argmin()]
    return bool(along[0] * across[1] < along[1] * across[0])
