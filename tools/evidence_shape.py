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

True lines are the points of random roads, or those of a map, seen from a pose that is drawn from
the stated Gaussian, where they cross x. With a map error, the product gets points that are off
those by independent errors; or, with --true-differs, the points of the map, and the true line
differs from them by another draw for each pose.

By: "line" (map_lines), "wire" (the same, encoded and decoded), "scene" (map_scene, all lines
jointly), "scene-wire" (by the DBC with conditional records), "mixture" (map_lines with 3
components), "scene-mixture" (scene_mixture of a scene), "predicted" (predict_to, 1 s and 12 m on).

"sigma ratio" is the median ratio of the standard deviation of y to that with the misfit of the
cubic in the variance of y_off alone. Of 2 lines per road, -n roads are drawn for each shape, and -n
poses for each map. Rows of single maps and of all roads and maps are compared with the bounds.

The exit status is 1 if a bound is missed, and 2 if there is nothing to measure.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from evidence_lines import over_the_wire
from evidence_maps import SLOTS, files_of, random_pose
from line_witness import (
    NEAR,
    POSES,
    WINDOW,
    Array,
    Poses,
    crossings,
    is_oncoming,
    place_of,
    seen_from,
)
from random_roads import SHAPES, random_scene
from reporting import bar, parser_of
from shape_figures import Given, Tally, missed, show

from maplines_can import (
    Codec,
    Gaussian,
    MapError,
    MapFileError,
    MapLine,
    Motion,
    Polyline,
    Slot,
    map_lines,
    map_scene,
    maps,
    predict_to,
    wire,
)
from maplines_can.errors import MaplinesError
from maplines_can.gaussian import block_diagonal, diagonal_blocks, nearest_covariance
from maplines_can.mixture import GaussianMixture
from maplines_can.polyline import stretches
from maplines_can.propagation import scene_mixture
from maplines_can.propagation.map_lines import view_of
from maplines_can.propagation.map_scene import STEP
from maplines_can.propagation.refit import Refit
from maplines_can.scene import Scene

#: Of --map-error [m].
MAP_ERRORS = (0.0, 0.05)
COMPONENTS = 3
#: The motion of --by predicted: time [s], speed [m/s], and sigmas [m/s, rad/s].
SECONDS, SPEED, MOTION_SIGMA = 1.0, 12.0, (0.3, 0.01)
#: Largest yaw rate of that motion [rad/s].
MOST_YAW_RATE = 0.6


class Case(NamedTuple):
    """True lines around a car whose pose is uncertain."""

    lines: dict[Slot, Array]  #: (n, 2) points in the map frame, in the direction of the car
    ego: Gaussian
    drawn: Array  #: (D, 3) true poses
    error: MapError | None
    rng: np.random.Generator

    def polylines(self, is_map_true: bool) -> dict[Slot, Polyline]:
        """Return the lines of the map that the product gets."""
        one = np.random.default_rng(self.rng.integers(2**63))
        return {
            slot: Polyline(
                points if is_map_true else erred(points, self.ego.mean, self.error, 1, one)[0]
            )
            for slot, points in self.lines.items()
        }


def erred(points: Array, pose: Array, error: MapError | None, draws: int, rng: Any) -> Array:
    """Return (draws, n, 2) points with errors; (1, n, 2) without an error."""
    if error is None:
        return points[None]
    turn = error.heading_sigma * rng.standard_normal(draws)
    about_car = seen_from(points, np.column_stack([np.tile(pose[:2], (draws, 1)), turn]))
    common = error.offset_sigma * rng.standard_normal((draws, 1, 2))
    local = error.point_sigma * rng.standard_normal(about_car.shape)
    return np.asarray(about_car + pose[:2] + common + local)


class Result(NamedTuple):
    """What a consumer has of a case: joint distributions of some of its lines."""

    slots: list[list[Slot]]
    given: list[Given]
    poses: list[Array]  #: (D + 1, 3) true poses and, last, the mean one, from which these are seen
    lost: int  #: lines that the transport or the prediction did not give


def reference_covs(
    polylines: list[Polyline], ego: Gaussian, error: MapError | None, step: float
) -> Array:
    """Return (L, 4, 4): what lines have beside a misfit in the variance of y_off alone.

    The lines are those of ``polylines`` that have a stretch in the window.
    """
    view = view_of(ego, WINDOW, error)
    seen = stretches(polylines, ego.mean, view.window, view.max_turn)
    refit = Refit(seen, ego.mean, room=view.room, step=step)
    excess = np.array(refit.noise_cov)
    excess[:, 0, 0] -= refit.misfit**2
    by_line = np.zeros((len(polylines), 4, 4))
    by_line[seen.given] = excess
    return by_line


def less(cov: Array, excess: Array) -> Array:
    """Return a covariance less a part of it; the same if there is none."""
    return nearest_covariance(cov - excess) if excess.any() else cov


def distribution(line: MapLine) -> tuple[Array, Array, Array]:
    """Return the shares, means and covariances of the components of a line."""
    if line.mixture is None:
        return np.ones(1), line.gaussian.mean[None], line.gaussian.cov[None]
    return line.mixture.weights, line.mixture.means, line.mixture.covs


def with_less(line: MapLine, excess: Array) -> MapLine:
    """Return a line with a part of its covariance taken off."""
    shares, means, covs = distribution(line)
    parts = [Gaussian(mean, less(cov, excess)) for mean, cov in zip(means, covs, strict=True)]
    if line.mixture is None:
        return replace(line, gaussian=parts[0])
    mixture = GaussianMixture(shares, parts)
    return replace(line, gaussian=mixture.overall, mixture=mixture)


def lines_by(carry: Any, components: int, case: Case, is_map_true: bool) -> Result:
    """Return the lines of ``map_lines`` that ``carry`` brings to a consumer, one by one."""
    polylines = case.polylines(is_map_true)
    lines = map_lines(
        polylines, case.ego, window=WINDOW, map_error=case.error, components=components
    )
    excess = dict(
        zip(
            polylines, reference_covs([*polylines.values()], case.ego, case.error, 0.0), strict=True
        )
    )
    result = Result([], [], [], 0)
    for line in lines:
        drawn = np.vstack([case.drawn, case.ego.mean])
        got, drawn = carry(line, drawn, case.rng)
        if got is None:
            result = result._replace(lost=result.lost + 1)
            continue
        reference, _ = carry(with_less(line, excess[line.slot]), drawn, np.random.default_rng(0))
        result.slots.append([line.slot])
        result.given.append(given_of(got, reference or got))
        result.poses.append(drawn)
    return result


def given_of(line: MapLine, reference: MapLine) -> Given:
    """Return what a consumer has of a single line."""
    shares, means, covs = distribution(line)
    return Given(
        shares,
        means[:, None],
        covs,
        distribution(reference)[2],
        np.array([[line.x_min, line.x_max]]),
    )


@cache
def codec(dbc: str | None = None) -> Codec:
    """Return the codec of a DBC of the package, the default one without a name."""
    return Codec.from_dbc() if dbc is None else Codec.from_dbc(wire.default_dbc_path(dbc))


def sent(line: MapLine, drawn: Array, _: Any) -> tuple[MapLine | None, Array]:
    """Return a line as a receiver gets it."""
    return over_the_wire(codec(), line), drawn


def predicted(line: MapLine, drawn: Array, rng: Any) -> tuple[MapLine | None, Array]:
    """Return a line that is predicted, and the true poses of that time."""
    curvature = line.gaussian.mean[2] + line.gaussian.mean[3] * SPEED * SECONDS / 2
    yaw_rate = float(np.clip(SPEED * curvature, -MOST_YAW_RATE, MOST_YAW_RATE))
    motion = Motion.with_sigma(SPEED, yaw_rate, MOTION_SIGMA)
    rates = np.array([SPEED, yaw_rate]) + rng.standard_normal((len(drawn), 2)) * MOTION_SIGMA
    rates[-1] = SPEED, yaw_rate  # of the mean pose
    try:
        later = predict_to(replace(line, t_ns=0), round(SECONDS * 1e9), motion)
    except MaplinesError:
        return None, drawn
    return later, np.array([arc(*row) for row in np.column_stack([drawn, rates])])


def arc(x: float, y: float, heading: float, speed: float, yaw_rate: float) -> Array:
    """Return the pose after a motion along an arc for ``SECONDS``, by closed form."""
    end = heading + yaw_rate * SECONDS
    if abs(yaw_rate) < 1e-9:
        return np.array(
            [x + speed * SECONDS * np.cos(heading), y + speed * SECONDS * np.sin(heading), end]
        )
    r = speed / yaw_rate
    return np.array(
        [x + r * (np.sin(end) - np.sin(heading)), y - r * (np.cos(end) - np.cos(heading)), end]
    )


def scene_pair(case: Case, is_map_true: bool) -> tuple[Scene, Scene]:
    """Return a scene, and the same with the misfit in the variance of y_off only."""
    polylines = case.polylines(is_map_true)
    scene = map_scene(polylines, case.ego, window=WINDOW, map_error=case.error)
    covs = reference_covs([*polylines.values()], case.ego, case.error, STEP)
    by_slot = dict(zip(polylines, covs, strict=True))
    excess = np.array([by_slot[line.slot] for line in scene.lines])
    return scene, scene_with_less(scene, excess) if excess.any() else scene


def scenes_by(carry: Callable[[Scene], Scene], case: Case, is_map_true: bool) -> Result:
    """Return the joint distribution of the lines of a scene that ``carry`` brings."""
    scene, reference = scene_pair(case, is_map_true)
    if not scene.lines:
        return Result([], [], [], 0)
    got, expected = carry(scene), carry(reference)
    slots = [line.slot for line in got.lines if line.slot in expected.index]
    lost = len(scene.lines) - len(got.lines)
    if not slots:
        return Result([], [], [], lost)
    joint, wanted = got.joint(slots), expected.joint(slots)
    ranges = np.array([[got.line(slot).x_min, got.line(slot).x_max] for slot in slots])
    given = Given(
        np.ones(1), joint.mean.reshape(1, -1, 4), joint.cov[None], wanted.cov[None], ranges
    )
    return Result([slots], [given], [np.vstack([case.drawn, case.ego.mean])], lost)


def scene_with_less(scene: Scene, excess: Array) -> Scene:
    """Return a scene with a part of what each line has of its own taken off."""
    cov = nearest_covariance(scene.cov - block_diagonal(excess))
    own = np.zeros_like(excess) if scene.own_covs is None else scene.own_covs
    own = np.array([nearest_covariance(o - e) for o, e in zip(own, excess, strict=True)])
    lines = tuple(
        replace(line, gaussian=Gaussian(line.gaussian.mean, block))
        for line, block in zip(scene.lines, diagonal_blocks(cov, 4), strict=True)
    )
    return replace(scene, cov=cov, own_covs=own, lines=lines)


def scene_sent(scene: Scene) -> Scene:
    """Return a scene as a receiver gets it, without the lines that do not fit."""
    by = codec("maplines-pose.dbc")
    decoder = by.decoder()
    for frames in by.encode_scene(scene).values():
        for frame in frames:
            decoder.feed(frame.can_id, frame.data, t_ns=0)
    received = decoder.scene()
    return scene.subset([]) if received is None else received.scene


def mixtures_of_scene(case: Case, is_map_true: bool) -> Result:
    """Return the lines of a scene as mixtures that a receiver makes of it."""
    scene, reference = scene_pair(case, is_map_true)
    result = Result([], [], [], 0)
    for line in scene.lines:
        found, wanted = (scene_mixture(of, line.slot, COMPONENTS) for of in (scene, reference))
        result.slots.append([line.slot])
        result.given.append(
            given_of(
                replace(line, gaussian=found.overall, mixture=found),
                replace(line, gaussian=wanted.overall, mixture=wanted),
            )
        )
        result.poses.append(np.vstack([case.drawn, case.ego.mean]))
    return result


#: What a consumer has of a case, by name: (case, whether the map is as the points say).
WAYS: dict[str, Callable[[Case, bool], Result]] = {
    "line": lambda *a: lines_by(lambda line, drawn, _: (line, drawn), 1, *a),
    "wire": lambda *a: lines_by(sent, 1, *a),
    "scene": lambda *a: scenes_by(lambda scene: scene, *a),
    "scene-wire": lambda *a: scenes_by(scene_sent, *a),
    "scene-mixture": mixtures_of_scene,
    "mixture": lambda *a: lines_by(lambda line, drawn, _: (line, drawn), COMPONENTS, *a),
    "predicted": lambda *a: lines_by(predicted, 1, *a),
}


class Settings(NamedTuple):
    """What is measured of each case."""

    way: str
    pose: str
    error: MapError | None
    is_map_true: bool
    cases: int
    draws: int
    seed: int


def evaluate(
    lines: dict[Slot, Array], pose: Array, settings: Settings, rng: Any, tally: Tally
) -> None:
    """Evaluate what a consumer has of true lines around a mean pose."""
    poses = Poses.about(pose, POSES[settings.pose], settings.draws, rng)
    case = Case(lines, Gaussian(pose, poses.cov), poses.draw(), settings.error, rng)
    result = WAYS[settings.way](case, settings.is_map_true)
    tally.lost += result.lost
    for slots, given, seen_at in zip(result.slots, result.given, result.poses, strict=True):
        tally.lines += len(slots)
        views = [view(lines[slot], seen_at, case, settings) for slot in slots]
        tally.evaluate(given, partial(crossing, views))


def crossing(views: Sequence[tuple[Array, Array]], i: int, x: float) -> Array:
    """Return the (D,) lateral positions at x of true lines of a view."""
    local, s = views[i]
    return crossings(local, s, x)


def view(points: Array, seen_at: Array, case: Case, settings: Settings) -> tuple[Array, Array]:
    """Return (D, n, 2) true points near a car, seen from true poses, and their arc lengths."""
    _, s = place_of(seen_from(points, seen_at[-1:])[0])
    near = np.abs(s) <= NEAR + np.diff(s).max()
    true = points[near]
    if settings.is_map_true:
        true = erred(true, seen_at[-1], case.error, settings.draws, case.rng)
    return seen_from(true, seen_at[:-1]), s[near]


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
    """Return the figures of maps and shapes of roads by name, and the names to compare."""
    rows: dict[str, Any] = {}
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
    return rows, [name for name in rows if name not in SHAPES]


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
    parser.add_argument("--true-differs", action="store_true", help="the map is given as it is")
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
                arguments.true_differs,
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
