#!/usr/bin/env python3
"""Measure whether the Gaussian of a line is true of more than one x at a time.

    evidence_shape.py                             all shapes of random roads
    evidence_shape.py -n 500 DIR                  and every map in a folder and those below it
    evidence_shape.py --by scene-wire --no-roads a.xodr

Run it in the environment of the project: python3 tools/run.py python tools/evidence_shape.py DIR

The sums are of lateral positions: y at 0, 20 and 40 m, slopes (y(x + d) - y(x))/d, second
differences y(x) - 2 y(x + d) + y(x + 2 d), and the curvature averaged over 10 m, (y(-5) - 2 y(0)
+ y(5))/25 about the car and (y(0) - 2 y(5) + y(10))/25 ahead of it. The first of these two is the
parameter c0 of the mean. For two lines of a scene there are the same sums of their difference, the
width. z is that of the true line less that of the mean, in units of the stated standard deviation.

A true line is the points of a random road, or those of a map, seen from a pose that is drawn from
the stated Gaussian, where they cross x. Of a map error, one draw is added to the points that the
product gets (--errors-in map). With --errors-in truth, the product gets the points themselves, and
the true line differs from them by another draw for each pose, so it is as rough as the errors.
With --errors-in none, a map error is stated, and there is none.

By: "line" (map_lines), "wire" (the same, encoded and decoded), "scene" (map_scene, all lines
jointly), "scene-wire" (by the DBC with conditional records), "mixture" (map_lines with 3
components), "scene-mixture" (scene_mixture of a scene), "predicted" (predict_to, 1 s and 12 m on).

"sigma ratio" is the median ratio of the standard deviation of y to that with the misfit of the
cubic in the variance of y_off alone. Of 2 lines each, -n roads are drawn for each shape, and -n
poses for each map. The rows of all maps and of all roads are compared with the bounds.

The exit status is 1 if a bound is missed, and 2 if there is nothing to measure.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from evidence_maps import SLOTS, files_of, random_pose
from line_witness import NEAR, POSES, Array, Poses, crossings, is_oncoming, place_of, seen_from
from random_roads import SHAPES, random_scene
from reporting import bar, parser_of
from shape_figures import Tally, missed, show
from shape_ways import WAYS, Case

from maplines_can import Gaussian, MapError, MapFileError, Polyline, Slot, maps

#: Of --map-error [m].
MAP_ERRORS = (0.0, 0.05)


class Settings(NamedTuple):
    """What is measured of each case."""

    way: str
    pose: str
    error: MapError | None
    errors_in: str
    cases: int
    draws: int
    seed: int


def evaluate(
    lines: dict[Slot, Array], pose: Array, settings: Settings, rng: Any, tally: Tally
) -> None:
    """Evaluate what a consumer has of true lines, (n, 2) points each, around a mean pose."""
    poses = Poses.about(pose, POSES[settings.pose], settings.draws, rng)
    error = settings.error if settings.errors_in == "map" else None
    given = {
        slot: Polyline(erred(points, pose, error, 1, rng)[0]) for slot, points in lines.items()
    }
    case = Case(given, Gaussian(pose, poses.cov), poses.draw(), settings.error, rng)
    result = WAYS[settings.way](case)
    tally.lost += result.lost
    for slots, joint, seen_at in zip(result.slots, result.given, result.poses, strict=True):
        tally.lines += len(slots)
        views = [view(lines[slot], seen_at, settings, rng) for slot in slots]
        tally.evaluate(joint, partial(crossing, views))


def view(points: Array, seen_at: Array, settings: Settings, rng: Any) -> tuple[Array, Array]:
    """Return (D, n, 2) true points near a car, and their (n,) arc lengths from there.

    They are seen from (D + 1, 3) poses, but for the last one, which is the mean.
    """
    _, s = place_of(seen_from(points, seen_at[-1:])[0])
    near = np.abs(s) <= NEAR + np.diff(s).max()
    error = settings.error if settings.errors_in == "truth" else None
    true = erred(points[near], seen_at[-1], error, settings.draws, rng)
    return seen_from(true, seen_at[:-1]), s[near]


def erred(points: Array, pose: Array, error: MapError | None, draws: int, rng: Any) -> Array:
    """Return (draws, n, 2) points with errors; (1, n, 2) without an error."""
    if error is None:
        return points[None]
    turn = error.heading_sigma * rng.standard_normal(draws)
    about_car = seen_from(points, np.column_stack([np.tile(pose[:2], (draws, 1)), turn]))
    common = error.offset_sigma * rng.standard_normal((draws, 1, 2))
    local = error.point_sigma * rng.standard_normal(about_car.shape)
    return np.asarray(about_car + pose[:2] + common + local)


def crossing(views: Sequence[tuple[Array, Array]], i: int, x: float) -> Array:
    """Return the (D,) lateral positions at x of true lines of a view."""
    local, s = views[i]
    return crossings(local, s, x)


def roads(shape: str, settings: Settings, step: Callable[[], Any]) -> Tally:
    """Return the figures of lines of random roads of a shape."""
    tally = Tally()
    for number in range(settings.cases):
        step()
        rng = np.random.default_rng([settings.seed, list(SHAPES).index(shape), number])
        case = random_scene(shape, rng, 2)
        lines = {
            slot: points[::-1] if is_oncoming(seen_from(points, case.pose[None])[0]) else points
            for slot, points in case.lines.items()
        }  # a road that crosses itself
        evaluate(lines, case.pose, settings, rng, tally)
    return tally


def on_map(road_map: maps.Map, settings: Settings, step: Callable[[], Any]) -> Tally:
    """Return the figures of lines at random poses on a map."""
    tally = Tally()
    lanes = [x for x in road_map.lanes.values() if x.type.is_drivable and x.length > 0]
    lengths = np.array([lane.length for lane in lanes])
    for number in range(settings.cases):
        step()
        rng = np.random.default_rng([settings.seed, number])
        pose = random_pose(lanes[rng.choice(len(lanes), p=lengths / lengths.sum())], rng)
        lines = {s: x.points for s, x in road_map.lines(pose).items() if s in SLOTS}
        if lines:
            evaluate(lines, pose, settings, rng, tally)
    return tally


def rows_of(
    shapes: list[str], found: dict[str, maps.Map], settings: Settings, progress: Any
) -> tuple[dict[str, Any], list[str]]:
    """Return the figures of maps and shapes of roads by name, and the names of the totals."""
    rows: dict[str, Any] = {}
    totals = []
    for whole, names in (("all maps", [*found]), ("all roads", shapes)):
        total = Tally()
        for name in names:
            progress.set_description(f"{settings.way}, {settings.pose}, {name}")
            if name in found:
                tally = on_map(found[name], settings, progress.update)
            else:
                tally = roads(name, settings, progress.update)
            rows[name] = tally.figures()
            total.add(tally)
        if names:
            rows[whole] = total.figures()
            totals.append(whole)
    return rows, totals


def maps_of(paths: list[str]) -> Iterator[tuple[str, maps.Map]]:
    """Yield the maps with lanes below folders, with their names."""
    for path in files_of(paths):
        try:
            road_map = maps.load(path)
        except (MapFileError, ImportError, OSError):
            continue
        if any(x.type.is_drivable and x.length > 0 for x in road_map.lanes.values()):
            yield path.name, road_map


def main(argv: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("paths", nargs="*", metavar="DIR", help="folders or files of maps")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument("--seed", type=int, default=1, help="seed of the cases and of the draws")
    parser.add_argument("-n", "--cases", type=int, default=200, help="of each map and shape")
    parser.add_argument("--draws", type=int, default=10, help="poses drawn for each case")
    parser.add_argument("--by", action="append", choices=WAYS, help="can be repeated; line")
    parser.add_argument("--pose", action="append", choices=POSES, help="can be repeated; all")
    parser.add_argument(
        "--map-error",
        action="append",
        type=float,
        metavar="M",
        help="independent error of each point [m]; can be repeated; 0 and 0.05",
    )
    parser.add_argument("--offset", type=float, default=0.0, help="common to a line [m]")
    parser.add_argument("--turn", type=float, default=0.0, help="common to a line [deg]")
    parser.add_argument(
        "--errors-in",
        choices=["map", "truth", "none"],
        default="map",
        help="which of them has a draw of the stated map error",
    )
    parser.add_argument("--shape", action="append", choices=SHAPES, help="can be repeated; all")
    parser.add_argument("--no-roads", action="store_true", help="maps only")
    arguments = parser.parse_args(argv)
    if arguments.cases < 1 or arguments.draws < 1:
        parser.error("--cases and --draws must be 1 or more")
    try:
        found = dict(maps_of(arguments.paths))
    except FileNotFoundError as error:
        parser.error(str(error))
    if not found and (arguments.paths or arguments.no_roads):
        print("evidence_shape.py: none of the files is a map with lanes", file=sys.stderr)
        return 2
    result, misses = evidence(found, arguments)
    if arguments.json:
        print(json.dumps(result | {"missed": misses}, indent=2))
    else:
        for title, rows in result.items():
            show(title, rows)
        print("", *(misses or ["All bounds are met."]), sep="\n")
    return 1 if misses else 0


def evidence(
    found: dict[str, maps.Map], arguments: argparse.Namespace
) -> tuple[dict[str, Any], list[str]]:
    """Return the figures by what is measured, and the bounds that they miss."""
    shapes = [] if arguments.no_roads else arguments.shape or [*SHAPES]
    combinations = [
        *product(
            arguments.by or ["line"], arguments.pose or POSES, arguments.map_error or MAP_ERRORS
        )
    ]
    result: dict[str, Any] = {}
    misses: list[str] = []
    total = arguments.cases * (len(shapes) + len(found)) * len(combinations)
    with bar(total, unit=" cases", leave=False) as progress:
        for way, pose, point_sigma in combinations:
            sigmas = point_sigma, arguments.offset, np.radians(arguments.turn)
            error = MapError(*sigmas) if any(sigmas) else None
            settings = Settings(
                way,
                pose,
                error,
                arguments.errors_in,
                arguments.cases,
                arguments.draws,
                arguments.seed,
            )
            title = f"{way}, {pose} pose, map error {point_sigma:g} m"
            result[title], compared = rows_of(shapes, found, settings, progress)
            for name in compared:
                misses += missed(f"MISSED  {title}: {name}", result[title][name])
    return result, misses


if __name__ == "__main__":
    sys.exit(main())
