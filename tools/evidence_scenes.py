#!/usr/bin/env python3
"""Measure what of the lines of a map a bus with maplines-pose.dbc delivers, and at what cost.

    evidence_scenes.py                    random roads of all shapes
    evidence_scenes.py DIR                and every map in a folder and in the folders below it
    evidence_scenes.py -n 2000 a.xodr     2000 scenes of each map and pose

Run it in the environment of the project: python3 tools/run.py python tools/evidence_scenes.py

Each scene has the lines around a random pose on a map (as in evidence_maps.py, the first four
slots), or 2 to 8 lines of a random road. There is a row for each source, pose and map error: exact,
or 5 cm. The frames of a scene pass the encoder and a decoder.

given       lines of map_scene; of the others, the reason
sent        with levels, with all entries, or left out by the encoder, with its reason
lost        share of the given lines with 10 m ahead that are left out
frames      classic frames of a scene and its pose error over four for each line sent: mean, max
width       sigma of the width of the ego lane at 0, 20 and 40 m, decoded over the true one with
            2 mm of resolution: median, 99 %
KL          divergence of a scene from the covered target (the covariance, the squares of the errors
            of the means and the resolution) to what is decoded: median, 99 %, largest
error       95 % of the errors of decoded usable lines, 20 m ahead within their valid ranges: what
            poses drawn from the stated error see of the points of the line, less what is decoded;
            of scenes, and of the complete records of maplines.dbc
saturated   share of the complete records that are saturated, or out of range

Overconfident is a scene whose decoded joint covariance does not cover the target without the
resolution. The exit status is 1 if a bound is missed, and 2 if a file is no map with lanes.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from evidence_maps import SLOTS, files_of, random_pose
from line_witness import NEAR, POSES, Array, Poses, crossings, place_of, seen_from
from random_roads import SHAPES, random_scene
from reporting import bar, parser_of
from scene_layouts import COMPLETE, CONDITIONAL, layout_of

from maplines_can import (
    Gaussian,
    MapError,
    MapFileError,
    MapLine,
    Polyline,
    Scene,
    Slot,
    Status,
    map_lines,
    map_scene,
    maps,
)
from maplines_can.study.scenes.source import noise_floor
from maplines_can.values.gaussian import block_diagonal
from maplines_can.values.seen_lines import bases
from maplines_can.wire import POSE, Codec
from maplines_can.wire.covariance.scene_code import RESOLUTION

#: Standard deviations of the points and of the offset of a map [m]; 0 for an exact one.
ERRORS = {"exact": 0.0, "5 cm": 0.05}
#: Lines with this much ahead must be sent [m], and the largest share of them that may be lost.
AHEAD, LOST = 10.0, 0.01
#: Most frames of a scene, in units of four for each line.
MAX_FRAMES = 1.0
#: Where the width of the lane is compared, and where errors of lines are [m].
WIDTH_AT, ERROR_AT = (0.0, 20.0, 40.0), 20.0
#: Draws of the pose for each line.
DRAWS = 10
RANDOM = "random roads"
#: Slots of the ego lane.
LANE = (Slot.EGO_LEFT, Slot.EGO_RIGHT)

#: Returns the lines around a random pose, and the pose.
Draw = Callable[[int, np.random.Generator], tuple[Mapping[Slot, Polyline], Array]]


class Figures(NamedTuple):
    """Counts and values by name."""

    counts: Counter[str]
    values: defaultdict[str, list[float]]


def on_map(found: maps.Map) -> Draw | None:
    """Return the drawing of poses on a map; None if it has no lanes to drive on."""
    lanes = [lane for lane in found.lanes.values() if lane.type.is_drivable and lane.length > 0]
    if not lanes:
        return None
    share = np.array([lane.length for lane in lanes])

    def draw(_: int, rng: np.random.Generator) -> tuple[Mapping[Slot, Polyline], Array]:
        pose = random_pose(lanes[rng.choice(len(lanes), p=share / share.sum())], rng)
        return {slot: x for slot, x in found.lines(pose).items() if slot in SLOTS}, pose

    return draw


def on_roads(number: int, rng: np.random.Generator) -> tuple[Mapping[Slot, Polyline], Array]:
    """Return lines of a random road; the number gives its shape."""
    shape = [*SHAPES][number % len(SHAPES)]
    case = random_scene(shape, rng, 2 + number // len(SHAPES) % 7)
    return {slot: Polyline(points) for slot, points in case.lines.items()}, case.pose


def measure(draw: Draw, pose: str, error: float, scenes: int, seed: int, step: Any) -> Figures:
    """Return the figures of scenes of one source, pose and map error [m]."""
    figures = Figures(Counter(), defaultdict(list))
    codec, complete = (Codec(layout_of(dbc)) for dbc in (CONDITIONAL, COMPLETE))
    map_error = MapError(error, error) if error else None
    for number in range(scenes):
        step()
        rng = np.random.default_rng([seed, number])
        lines, mean = draw(number, rng)
        drawn = Poses.about(mean, POSES[pose], DRAWS, rng)
        ego = Gaussian(mean, drawn.cov)
        scene = map_scene(lines, ego, map_error=map_error)
        figures.counts["scenes"] += 1
        figures.counts.update(f"not given, {why.name}" for why in scene.left_out.values())
        received = passed(codec, scene, figures)
        if received is not None:
            compare(scene, received, figures)
            for line in received.lines:
                errors(line, lines[line.slot], drawn, figures.values["error of scenes"])
        for line in through_complete(complete, map_lines(lines, ego, map_error=map_error), figures):
            errors(line, lines[line.slot], drawn, figures.values["error of records"])
    return figures


def passed(codec: Codec, scene: Scene, figures: Figures) -> Scene | None:
    """Return a scene as received, with the counts of its lines; None if no line is sent."""
    counts = figures.counts
    prepared = codec.prepare_scene(scene)
    far = [line.slot for line in scene.lines if line.x_max >= AHEAD]
    counts["given"] += len(scene.lines)
    counts["given with 10 m"] += len(far)
    counts["lost with 10 m"] += sum(slot not in prepared.sent_slots for slot in far)
    counts.update(f"not sent, {why.name}" for why in prepared.unfit.values())
    if not prepared.sent_slots:
        return None
    frames = codec.encode_scene(prepared)
    of_lines = [len(own) for owner, own in frames.items() if owner != POSE]
    counts["levels"] += of_lines.count(codec.layout.short_pages)
    counts["all entries"] += of_lines.count(codec.layout.pages)
    figures.values["frames"].append(sum(map(len, frames.values())) / (4 * len(of_lines)))
    decoder, t_ns = codec.decoder(), 0
    for frame in (frame for own in frames.values() for frame in own):
        decoder.feed(frame.can_id, frame.data, t_ns)
        t_ns += 250_000
    received = decoder.scene()
    counts["not received"] += received is None or len(received.scene.lines) < len(of_lines)
    return None if received is None else received.scene


def through_complete(codec: Codec, lines: list[MapLine], figures: Figures) -> Iterator[MapLine]:
    """Yield the usable lines of complete records."""
    for line, (frame,) in zip(lines, codec.encode_lines(lines, fd=True), strict=True):
        decoded = codec.decode_one(frame.data, line.slot)
        if not isinstance(decoded, MapLine):
            figures.counts["records rejected"] += 1
            continue
        figures.counts["records"] += 1
        figures.counts["records saturated"] += decoded.status is Status.SATURATED
        figures.counts["records out of range"] += decoded.status is Status.OUT_OF_RANGE
        if decoded.is_usable:
            yield decoded


def compare(scene: Scene, received: Scene, figures: Figures) -> None:
    """Add the divergence of a scene, whether it is covered, and the ratios of the width."""
    slots = [line.slot for line in received.lines]
    truth = scene.joint(slots)
    ranges = received.fit_ranges
    K = block_diagonal(np.asarray(np.linalg.inv(bases(received.means, ranges))))  # in metres
    d = truth.mean - received.means.ravel()
    L = np.linalg.cholesky(K @ received.cov @ K.T)
    floor = noise_floor(received.means, ranges, RESOLUTION)
    error = truth.cov + np.outer(d, d)
    figures.counts["overconfident"] += int(whitened(L, K @ error @ K.T)[-1] > 1)
    values = whitened(L, K @ (error + floor) @ K.T)
    figures.values["KL"].append(float((values - 1 - np.log(values)).sum() / 2))
    if set(LANE) <= set(slots):
        low, high = received.x_range(LANE)
        least = Scene(
            tuple(scene.line(slot) for slot in slots), truth.cov + floor, scene.pose_error, ranges
        )
        for x in (x for x in WIDTH_AT if low <= x <= high):
            ratio = received.width(x).sigma / least.width(x).sigma
            figures.values["width"].append(float(ratio))


def whitened(L: Any, cov: Array) -> Array:
    """Return the eigenvalues of a covariance in units of another one's Cholesky factor."""
    half = np.linalg.solve(L, cov)
    return np.asarray(np.linalg.eigvalsh(np.linalg.solve(L, half.T)))


def errors(line: MapLine, road: Polyline, poses: Poses, into: list[float]) -> None:
    """Add the errors of a line at ``ERROR_AT``, if it is valid there."""
    if not line.x_min <= ERROR_AT <= line.x_max:
        return
    _, s = place_of(seen_from(road.points, poses.mean[None])[0])
    near = np.abs(s) <= NEAR + np.diff(s).max()
    y = crossings(poses.see(road.points[near]), s[near], ERROR_AT)
    into += np.abs(y[np.isfinite(y)] - float(line.y(ERROR_AT))).tolist()


def summary(figures: Figures) -> dict[str, Any]:
    """Return the figures as they are printed."""
    counts, values = figures
    names = ("frames", "width", "KL", "error of scenes", "error of records")
    return {
        "counts": dict(sorted(counts.items())),
        "lost": counts["lost with 10 m"] / max(counts["given with 10 m"], 1),
        **{name: quantiles(values[name]) for name in names},
    }


def quantiles(values: list[float]) -> dict[str, float] | None:
    """Return mean, median, 95 %, 99 % and maximum; None without values."""
    if not values:
        return None
    shares = np.quantile(values, [0.5, 0.95, 0.99, 1.0]).tolist()
    keys = ("mean", "50 %", "95 %", "99 %", "max")
    return dict(zip(keys, [float(np.mean(values)), *shares], strict=True))


def missed(name: str, row: Mapping[str, Any]) -> Iterator[str]:
    """Yield the bounds that a row misses."""
    if row["lost"] > LOST:
        yield f"{name}: {row['lost']:.1%} of the lines with {AHEAD:g} m ahead are lost"
    if row["frames"] and row["frames"]["max"] > MAX_FRAMES:
        yield f"{name}: a scene takes {row['frames']['max']:.2f} of four frames a line"
    for what in ("overconfident", "not received"):
        if count := row["counts"].get(what, 0):
            yield f"{name}: {count} scenes are {what}"


def show(rows: Mapping[str, Any]) -> None:
    """Print the figures as a table."""
    width = max(map(len, rows), default=0)
    print(
        f"{'':{width}}  given levels    all unsent   lost  frames        width         KL"
        "                   error at 20 m    records\n"
        f"{'':{width}}{'':32}10 m   mean   max   50 %  99 %   50 %   99 %    max"
        "   scene  records  satur.  out"
    )
    for name, row in rows.items():
        counts = Counter(row["counts"])
        unsent = counts["given"] - counts["levels"] - counts["all entries"]
        records = max(counts["records"], 1)
        print(
            f"{name:{width}}{counts['given']:7}{counts['levels']:7}{counts['all entries']:7}"
            f"{unsent:7}{row['lost']:7.2%}"
            + cells(row["frames"], {"mean": "7.2f", "max": "6.2f"})
            + cells(row["width"], {"50 %": "7.2f", "99 %": "6.2f"})
            + cells(row["KL"], {"50 %": "7.3f", "99 %": "7.3f", "max": "7.2f"})
            + cells(row["error of scenes"], {"95 %": "8.2f"})
            + cells(row["error of records"], {"95 %": "9.2f"})
            + f"{counts['records saturated'] / records:8.1%}"
            f"{counts['records out of range'] / records:5.1%}"
        )
    for name, row in rows.items():
        reasons = [f"{n} {key}" for key, n in row["counts"].items() if key.startswith("not ") and n]
        if reasons:
            print(f"{name}: {', '.join(reasons)}")


def cells(figures: Mapping[str, float] | None, formats: Mapping[str, str]) -> str:
    """Return figures as columns."""
    widths = {key: shape.split(".")[0] for key, shape in formats.items()}
    if figures is None:
        return "".join(f"{'-':>{width}}" for width in widths.values())
    return "".join(f"{figures[key]:{shape}}" for key, shape in formats.items())


def main(argv: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("paths", nargs="*", metavar="DIR", help="folders or files of maps")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument("--seed", type=int, default=1, help="seed of the scenes")
    parser.add_argument("-n", "--scenes", type=int, default=500, help="scenes of each row")
    parser.add_argument("--pose", action="append", choices=POSES, help="can be repeated")
    parser.add_argument("--error", action="append", choices=ERRORS, help="of the map; as --pose")
    arguments = parser.parse_args(argv)
    if arguments.scenes < 1:
        parser.error("--scenes must be 1 or more")
    try:
        sources = dict(sources_of(arguments.paths))
    except (FileNotFoundError, MapFileError) as error:
        parser.error(str(error))
    rows = evidence(sources, arguments)
    misses = [f"MISSED  {miss}" for name, row in rows.items() for miss in missed(name, row)]
    if arguments.json:
        print(json.dumps({"rows": rows, "missed": misses}, indent=2))
    else:
        show(rows)
        print("", *(misses or ["All bounds are met."]), sep="\n")
    return 1 if misses else 0


def sources_of(paths: list[str]) -> Iterator[tuple[str, Draw]]:
    """Yield the sources of scenes: the maps, without the other files of folders, and the roads.

    Raises:
        FileNotFoundError: there is no such file or folder.
        MapFileError: a file that is named is no map with lanes to drive on.
    """
    for path in files_of(paths):
        try:
            draw = on_map(maps.load(path))
        except (MapFileError, ImportError, OSError):
            draw = None
        if draw is not None:
            yield path.name, draw
        elif str(path) in {str(Path(name)) for name in paths}:
            raise MapFileError(f"{path}: is no map with lanes to drive on")
    yield RANDOM, on_roads


def evidence(sources: Mapping[str, Draw], arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the figures by row."""
    poses, errors_ = arguments.pose or [*POSES], arguments.error or [*ERRORS]
    kinds = [(pose, error) for pose in poses for error in errors_]
    rows = {}
    with bar(arguments.scenes * len(kinds) * len(sources), unit=" scenes", leave=False) as progress:
        for name, draw in sources.items():
            for pose, error in kinds:
                row = f"{name}, {pose}, {error}"
                progress.set_description(row)
                figures = measure(
                    draw, pose, ERRORS[error], arguments.scenes, arguments.seed, progress.update
                )
                rows[row] = summary(figures)
    return rows


if __name__ == "__main__":
    sys.exit(main())
