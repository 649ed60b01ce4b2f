"""Whether the Gaussian of a line is true at each x, and of more than one x at a time.

The sums are of lateral positions: y at 0, 20 and 40 m and at the ends of the range, slopes
(y(x + d) - y(x))/d, second differences y(x) - 2 y(x + d) + y(x + 2 d), and the curvature averaged
over 10 m, (y(-5) - 2 y(0) + y(5))/25 about the car and (y(0) - 2 y(5) + y(10))/25 ahead of it. The
first of these two is the parameter c0 of the mean. For two lines of a scene there are the same sums
of their difference, the width. z is that of the true line less that of the mean, in units of the
stated standard deviation.

A true line is the points of a random road, or those of a map, seen from a pose that is drawn from
the stated Gaussian, where they cross x. A line that ends before x counts as beyond 3 sigma.

The limit of a range is the longest one in which any cubic deviates from the line by at most 0.1 m.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import partial
from itertools import product
from typing import Any, Literal, NamedTuple

import numpy as np

from maplines_can import Gaussian, MapError, Polyline, Slot
from maplines_can.values.line import lateral_jacobian

from .excess import excess_covs
from .harness import evidence, progress
from .range_limit import View
from .roads import SHAPES, Draw, maps_of, on_map, on_roads
from .sums import SIGMA_AT, Tally
from .ways import WAYS, Case, Result
from .witness import (
    AHEAD,
    POSES,
    WINDOW,
    Array,
    Poses,
    crossings,
    erred,
    is_oncoming,
    near_points,
    place_of,
    seen_from,
)


class Settings(NamedTuple):
    """What is measured of each case."""

    way: str
    sigma: tuple[float, float, float]
    error: MapError | None
    errors_in: str
    cases: int
    draws: int
    ranges: int  #: cases of which the limit of the range is computed
    seed: int


@evidence(
    n=3,
    draws=5,
    ranges=1,
    shapes=("motorway", "rural", "city"),
    poses=("production",),
    map_error=(0.05,),
)
def lines(
    n: int = 25,
    maps: tuple[str, ...] = (),
    shapes: tuple[str, ...] = tuple(SHAPES),
    by: Literal[
        "line", "wire", "scene", "scene-wire", "scene-mixture", "mixture", "predicted"
    ] = "line",
    poses: tuple[str, ...] = tuple(POSES),
    map_error: tuple[float, ...] = (0.0, 0.05),
    offset: float = 0.0,
    turn_deg: float = 0.0,
    errors_in: Literal["map", "truth", "none"] = "map",
    draws: int = 10,
    ranges: int = 0,
    seed: int = 1,
) -> dict[str, Any]:
    """Compare the Gaussian of lines with true ones, on random roads and on maps.

    Args:
        n: cases of two lines of each shape, or of up to four of each map.
        maps: folders and files of maps.
        shapes: of random roads; an empty text for none.
        by: how a consumer gets lines: of map_lines ("line"), the same over the wire, map_scene with
            all lines jointly, over the wire with conditional records, as mixtures of 3 components
            (of map_lines, or of a scene), or predicted by 1 s and 12 m.
        poses: errors of the car's pose.
        map_error: independent error of each point [m].
        offset: error that is common to a line [m].
        turn_deg: the same, of its direction [deg].
        errors_in: which of them has a draw of the stated map error: the lines that the product gets
            (map), the true ones, with another draw for each pose (truth), or none.
        draws: poses drawn for each case.
        ranges: cases of each row of which the limit of the range is computed.
        seed: of the cases and of the draws.
    """
    groups: dict[str, dict[str, Draw]] = {
        "all maps": {name: on_map(found) for name, found in maps_of(maps).items()},
        "all roads": {shape: on_roads([shape], 2) for shape in shapes if shape},
    }
    result: dict[str, Any] = {}
    for pose, point_sigma in product(poses, map_error):
        sigmas = point_sigma, offset, np.radians(turn_deg)
        error = MapError(*sigmas) if any(sigmas) else None
        settings = Settings(by, POSES[pose], error, errors_in, n, draws, ranges, seed)
        title = f"{by}, {pose} pose, map error {point_sigma:g} m"
        result[title] = dict(rows(groups, settings, title))
    return result


def rows(
    groups: Mapping[str, Mapping[str, Draw]], settings: Settings, title: str
) -> Iterator[tuple[str, Any]]:
    """Yield the names and figures of the maps and shapes of road, and of all together."""
    for whole, group in groups.items():
        total = Tally()
        for place, (name, draw) in enumerate(progress(group.items(), title, len(group))):
            tally = Tally()
            for number in range(settings.cases):
                rng = np.random.default_rng([settings.seed, place, number])
                evaluate(draw, number, settings, rng, tally)
            total.add(tally)
            yield name, tally.figures()
        if group:
            yield whole, total.figures()


def evaluate(draw: Draw, number: int, settings: Settings, rng: Any, tally: Tally) -> None:
    """Evaluate what a consumer has of true lines around a mean pose."""
    drawn, pose = draw(number, rng)
    along = {slot: in_direction(line.points, pose) for slot, line in drawn.items()}
    if not along:
        return
    poses = Poses.about(pose, settings.sigma, settings.draws, rng)
    error = settings.error if settings.errors_in == "map" else None
    given = {slot: Polyline(erred(line, pose, error, 1, rng)[0]) for slot, line in along.items()}
    case = Case(given, Gaussian(pose, poses.cov), poses.draw(), settings.error, rng)
    result = WAYS[settings.way](case)
    tally.counts["lost"] += result.lost
    for slots, joint, seen_at in zip(result.slots, result.given, result.poses, strict=True):
        tally.counts["lines"] += len(slots)
        views = [view(along[slot], seen_at, settings, rng) for slot in slots]
        tally.evaluate(joint, partial(crossing, views))
    count_refused(along, pose, result, tally)
    if settings.way == "line":
        compare_sigma(case, result, tally)
    if number < settings.ranges and settings.way in ("line", "wire"):
        compare_range(given, pose, result, tally)


def in_direction(points: Array, pose: Array) -> Array:
    """Return the points of a line in the direction of the car, where it is."""
    return points[::-1] if is_oncoming(seen_from(points, pose[None])[0]) else points


def view(points: Array, seen_at: Array, settings: Settings, rng: Any) -> tuple[Array, Array]:
    """Return (D, n, 2) true points near a car, and their (n,) arc lengths from there.

    They are seen from (D + 1, 3) poses, but for the last one, which is the mean.
    """
    near, s = near_points(points, seen_at[-1])
    error = settings.error if settings.errors_in == "truth" else None
    true = erred(near, seen_at[-1], error, settings.draws, rng)
    return seen_from(true, seen_at[:-1]), s


def crossing(views: list[tuple[Array, Array]], i: int, x: float) -> Array:
    """Return the (D,) lateral positions at x of true lines of a view."""
    local, s = views[i]
    return crossings(local, s, x)


def count_refused(lines: Mapping[Slot, Array], pose: Array, result: Result, tally: Tally) -> None:
    """Count the lines that the map has ahead of the car, and those of them that are not there."""
    there = {slot for slots in result.slots for slot in slots}
    for slot, points in lines.items():
        local = seen_from(points, pose[None])[0]
        _, s = place_of(local)
        reach = s[(s >= 0) & (np.hypot(*local.T) <= WINDOW[1])].max(initial=0.0)
        tally.counts["ahead"] += reach >= AHEAD
        tally.counts["refused"] += reach >= AHEAD and slot not in there


def compare_sigma(case: Case, result: Result, tally: Tally) -> None:
    """Add the ratios of the sigmas of y to those with the misfit in the variance of y_off alone."""
    excess = excess_covs(case.lines, case.ego, case.error)
    for (slot,), given in zip(result.slots, result.given, strict=True):
        for x in (x for x in SIGMA_AT if given.ranges[0, 0] <= x <= given.ranges[0, 1]):
            g = lateral_jacobian(given.means[0, 0], x)
            variance = g @ given.covs[0] @ g
            rest = max(variance - g @ excess[slot] @ g, 1e-12)
            tally.put(f"sigma ratio at {x:g} m", float(np.sqrt(variance / rest)))


def compare_range(
    lines: Mapping[Slot, Polyline], pose: Array, result: Result, tally: Tally
) -> None:
    """Add the ratios of the ranges to the longest ones in which a cubic follows the line."""
    for (slot,), given in zip(result.slots, result.given, strict=True):
        local = seen_from(lines[slot].points, pose[None])[0]
        seen, (x_min, x_max) = View(local, place_of(local)[0]), given.ranges[0]
        length = x_max - x_min
        if seen.is_seen and length > 0:
            begin = max(x_min, seen.low)
            same = max(seen.farthest(begin, begin + 0.5 * length) - begin, length)
            tally.put("range over limit, same x_min", length / same)
            tally.put("range over limit, any x_min", length / max(seen.longest(same), length))
