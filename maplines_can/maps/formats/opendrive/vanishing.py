"""Lanes of an OpenDRIVE road where they have no width, and so are none.

A lane may have no width in a part of its lane section: it opens after it, or has ended before. A
lane section is divided where that changes, and the lane is left out of the parts without it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...road_map import Skipped
from .boundaries import WIDTH_TOLERANCE, Boundaries
from .lane_section import LaneRecord, SectionRecord
from .profiles import Array
from .road import RoadRecord

#: Shortest stretch without a width that counts [m].
MIN_LENGTH = 1.0


def without_vanished(road: RoadRecord, skipped: list[Skipped]) -> RoadRecord:
    """Return the road with its lane sections divided where a drivable lane gets or loses its width.

    The first part keeps the name of the lane section; the next ones of the first are "0.1", "0.2".

    Args:
        road: with the lane sections of the file.
        skipped: list that gets the stretches without a width.
    """
    sections: list[SectionRecord] = []
    for index, section in enumerate(road.sections):
        start, end = road.extent(index)
        if end - start >= MIN_LENGTH and any(map(_may_vanish, section.lanes.values())):
            sections += _parts(road, index, skipped)
        else:
            sections.append(replace(section, label=str(index)))
    return replace(road, sections=tuple(sections))


def _may_vanish(lane: LaneRecord) -> bool:
    starts_at_0 = any(piece.a <= WIDTH_TOLERANCE for piece in lane.width)
    return lane.type.is_drivable and (starts_at_0 or not lane.width)


def _parts(road: RoadRecord, index: int, skipped: list[Skipped]) -> list[SectionRecord]:
    """Return the parts of a lane section, each with the lanes that have a width in it."""
    section, boundaries = road.sections[index], Boundaries(road, index)
    breaks = boundaries.breaks()
    s = breaks[:-1, None] + np.diff(breaks)[:, None] * np.linspace(0, 1, 5)
    t = boundaries.offsets(s.ravel(), s[:, 2].repeat(5)).reshape(-1, *s.shape)
    gone: dict[int, NDArray[np.bool_]] = {}  # by lane, for each interval of the breaks
    for lane_id, (inner, outer) in boundaries.rows.items():
        lane = section.lanes[lane_id]
        is_flat = np.abs(t[outer] - t[inner]).max(axis=1) <= WIDTH_TOLERANCE
        for first, last in _runs(is_flat, breaks) if lane.type.is_drivable else ():
            why = f"it has no width from s = {breaks[first]:g} to {breaks[last]:g} m, "
            where = f"line {lane.line}, lane {road.id}:{index}:{lane_id}"
            skipped.append(Skipped(where, f"{why}and is no lane there"))
            gone.setdefault(lane_id, np.zeros(len(is_flat), bool))[first:last] = True
    table = np.array([*gone.values()]).reshape(len(gone), len(s))
    firsts = [0, *(np.flatnonzero((table[:, 1:] != table[:, :-1]).any(axis=0)) + 1).tolist()]
    parts = []
    for number, first in enumerate(firsts):
        lanes = {
            i: lane._replace(
                predecessors=(i,) if number else lane.predecessors,
                successors=lane.successors if first == firsts[-1] else (i,),
            )
            for i, lane in section.lanes.items()
        }
        missing = {i: lane for i, lane in lanes.items() if i in gone and gone[i][first]}
        parts.append(
            replace(
                section,
                s=float(breaks[first]),
                lanes={i: lane for i, lane in lanes.items() if i not in missing},
                gone=missing,
                label=f"{index}.{number}" if number else str(index),
            )
        )
    return parts


def _runs(is_flat: NDArray[np.bool_], breaks: Array) -> list[tuple[int, int]]:
    """Return the first intervals of stretches, and those after them, of at least ``MIN_LENGTH``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], is_flat, [False]]).astype(int)))
    runs = edges.reshape(-1, 2).tolist()
    return [(a, b) for a, b in runs if breaks[b] - breaks[a] >= MIN_LENGTH]
