#!/usr/bin/env python3
"""Measure the joint covariance of the lines of a scene that a receiver rebuilds.

    evidence_joint.py                       10^5 scenes of all shapes of roads
    evidence_joint.py --shape city -n 1000  1000 scenes of one shape
    evidence_joint.py --jobs 2              in two processes

Run it in the environment of the project: python3 tools/run.py python tools/evidence_joint.py

Each scene has 2 to 8 lines of a random road, a production pose or a poor one, and a map error of
3 to 10 cm, known to the sender, or none. There are two carriers of the joint: records that are
conditional on the pose error, of dbc/maplines-pose.dbc, and the complete records of
dbc/maplines.dbc with levels in the Pose message.

Definite: the decoded joint covariance has a Cholesky factor. Overconfident: it does not cover the
true joint covariance plus the square of the errors of the means. Both are counted in floating point
for all scenes, in exact arithmetic for some. Ratios of standard deviations are those of the decoded
joint to the true one plus 2 mm of resolution; width, centre and difference of the
directions are those of the first two lines, where both are valid. KL is that of a line, from the
covered target to the decoded block, as in the study: the target is the true covariance plus the
square of the error of the mean plus that resolution. KL and lateral position are not compared for
lines that exceed the message, of which the nearest line is sent. The excess of a standard deviation
is the decoded one less the true one with the resolution, 99 %.

The witness draws poses and errors of the map, moves the points of the map, and measures where both
lines cross x. z is the width or the centre, less that of the decoded lines, in units of its decoded
standard deviation. The exit status is 1 if a bound is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from exact import covers, is_positive_definite
from joint_figures import CARRIERS, SIGMAS, Figures, missed, show, summary
from line_witness import NEAR, POSES, Array, Poses, crossings, place_of, seen_from
from random_roads import SHAPES, SceneCase, random_scene
from reporting import bar, parser_of
from scene_layouts import (
    COMPLETE,
    CONDITIONAL,
    layout_of,
    pose_layout_of,
    scene_code,
    scene_encoder,
)

from maplines_can import Gaussian, MapError, MapLine, Polyline, Scene, Slot
from maplines_can.propagation import map_scene
from maplines_can.study.scenes.source import noise_floor
from maplines_can.values.gaussian import block_diagonal
from maplines_can.values.line import lateral_jacobian
from maplines_can.values.seen_lines import bases
from maplines_can.wire import Codec
from maplines_can.wire.covariance.scene_code import RESOLUTION, DecodedLines
from maplines_can.wire.covariance.scene_encoder import EncodedScene
from maplines_can.wire.layout.signals import PARAMETER_SIGNALS

#: Range of the standard deviations of the map error: of the points and of the offset [m].
MAP_ERROR = (0.03, 0.10)
X = (0.0, 20.0, 40.0)
FAR = 80.0
#: Error of a coefficient of T_0 .. T_3 beyond which a line exceeds the message [m].
MAX_ROUNDING = 0.02
#: Scenes that a process takes at a time.
CHUNK = 50


class Settings(NamedTuple):
    """What is measured."""

    shapes: tuple[str, ...]
    scenes: int
    seed: int
    exact: int  #: scenes that are checked in exact arithmetic
    witnessed: int  #: scenes with a witness
    draws: int  #: of the pose and of the map error for each of them


class Drawn(NamedTuple):
    """A random scene."""

    case: SceneCase
    ego: Gaussian
    root: Array  #: (3, 3) of the covariance of ego
    scene: Scene
    group: str


def drawn(number: int, settings: Settings) -> Drawn:
    """Return a scene; its number gives the shape, the pose, the map error and the lines."""
    rng = np.random.default_rng([settings.seed, number])
    rest, shape = divmod(number, len(settings.shapes))
    rest, pose = divmod(rest, len(POSES))
    rest, with_error = divmod(rest, 2)
    case = random_scene(settings.shapes[shape], rng, 2 + rest % 7)
    name, sigma = list(POSES.items())[pose]
    poses = Poses.about(case.pose, sigma, settings.draws, rng)
    ego = Gaussian(case.pose, poses.cov)
    error = MapError(*rng.uniform(*MAP_ERROR, 2)) if with_error else None
    lines = {slot: Polyline(points) for slot, points in case.lines.items()}
    scene = map_scene(lines, ego, map_error=error, correlation_time=2.0)
    return Drawn(case, ego, poses.root, scene, f"{name}, {'map error' if error else 'no error'}")


def encoded(carrier: str, scene: Scene) -> EncodedScene:
    """Return a scene as a carrier sends it."""
    encoder = scene_encoder(CARRIERS[carrier])
    if CARRIERS[carrier] == CONDITIONAL:
        return encoder.encode(scene)
    return encoder.encode_levels(scene, sent_means(scene))


@lru_cache
def complete_codec() -> Codec:
    """Return the codec of complete records."""
    return Codec(layout_of(COMPLETE))


def sent_means(scene: Scene) -> list[dict[str, int] | None]:
    """Return the raw values of mean and range of the complete records of lines; None if unfit."""
    layout, codec = layout_of(COMPLETE), complete_codec()
    rows: list[dict[str, int] | None] = []
    for line, frames_ in zip(scene.lines, codec.encode_lines(scene.lines, fd=True), strict=True):
        received = codec.decode_one(frames_[0].data, line.slot)
        if isinstance(received, MapLine) and received.is_usable:
            values = (*received.gaussian.mean, received.x_min, received.x_max)
            pairs = zip((*PARAMETER_SIGNALS, "XMin", "XMax"), values, strict=True)
            rows.append({name: int(layout[name].raw(value)) for name, value in pairs})
        else:
            rows.append(None)
    return rows


def measure(number: int, settings: Settings) -> Figures:
    """Return the figures of one scene."""
    figures, one = Figures(), drawn(number, settings)
    figures.counts["", "scenes"] += 1
    figures.counts["", "no line"] += not one.scene.lines
    for carrier in CARRIERS if one.scene.lines else ():
        code = scene_code(CARRIERS[carrier])
        started = time.perf_counter()
        sent = encoded(carrier, one.scene)
        between = time.perf_counter()
        figures.counts[carrier, "lines"] += len(one.scene.lines)
        figures.counts[carrier, "lines left out"] += len(one.scene.lines) - len(sent.lines)
        if not sent.lines:
            continue
        decoded = code.decode(code.decode_pose(sent.pose), list(sent.lines.values()))
        ended = time.perf_counter()

        def add(what: str, *values: float, carrier: str = carrier) -> None:
            figures.values[carrier, one.group, what] += values

        add("encode [us]", 1e6 * (between - started))
        add("decode [us]", 1e6 * (ended - between))
        add("all entries", *("Inflation" in row for row in sent.lines.values()))
        add(f"frames, {len(sent.lines)} lines", frames(carrier, sent))
        truth = true_part(one.scene, list(sent.lines))
        if not check(carrier, truth, decoded, figures.counts, number < settings.exact):
            continue
        compare(truth, decoded, add)
        if number < settings.witnessed:
            witness(one, truth, decoded, settings.draws, [settings.seed, number, 1], add)
    return figures


def frames(carrier: str, sent: EncodedScene) -> int:
    """Return the number of classic frames of a scene."""
    layout = layout_of(CARRIERS[carrier])
    pages = (
        layout.pages if "Inflation" in row else layout.short_pages for row in sent.lines.values()
    )
    return pose_layout_of(CARRIERS[carrier]).pages + sum(pages)


class Truth(NamedTuple):
    """The lines of a scene that are sent."""

    lines: list[MapLine]
    means: Array  #: (L, 4)
    cov: Array  #: (4 L, 4 L)


def true_part(scene: Scene, places: list[int]) -> Truth:
    """Return the part of a scene with these lines."""
    lines = [scene.lines[i] for i in places]
    joint = scene.joint([line.slot for line in lines])
    return Truth(lines, joint.mean.reshape(-1, 4), joint.cov)


def check(
    carrier: str, truth: Truth, decoded: DecodedLines, counts: Counter[Any], exactly: bool
) -> bool:
    """Count whether a joint covariance is indefinite or overconfident; return whether definite."""
    K = block_diagonal(np.asarray(np.linalg.inv(bases(decoded.means, decoded.fit_ranges))))
    d = (truth.means - decoded.means).ravel()
    counts[carrier, "checked"] += 1
    try:
        L = np.linalg.cholesky(K @ decoded.cov @ K.T)
    except np.linalg.LinAlgError:
        counts[carrier, "indefinite"] += 1
        return False
    error = K @ (truth.cov + np.outer(d, d)) @ K.T
    largest = np.linalg.eigvalsh(np.linalg.solve(L, np.linalg.solve(L, error).T))[-1]
    counts[carrier, "overconfident"] += int(largest > 1)
    if exactly:
        counts[carrier, "checked exactly"] += 1
        definite = is_positive_definite(decoded.cov.tolist())
        covered = covers(decoded.cov, decoded.means.ravel(), truth.cov, truth.means.ravel())
        counts[carrier, "indefinite, exactly"] += not definite
        counts[carrier, "overconfident, exactly"] += not covered
    return True


def compare(truth: Truth, decoded: DecodedLines, add: Callable[..., None]) -> None:
    """Add the divergence of the lines and the ratios of standard deviations."""
    inverse = np.linalg.inv(bases(decoded.means, decoded.fit_ranges))
    true = truth.cov + noise_floor(decoded.means, decoded.fit_ranges, RESOLUTION)
    for i, line in enumerate(truth.lines):
        block = np.s_[4 * i : 4 * i + 4]
        d = truth.means[i] - decoded.means[i]
        target = true[block, block] + np.outer(d, d)
        if np.abs(inverse[i] @ d).max() > MAX_ROUNDING:
            continue
        T, C = (inverse[i] @ cov @ inverse[i].T for cov in (target, decoded.cov[block, block]))
        L = np.linalg.cholesky(C)
        values = np.linalg.eigvalsh(np.linalg.solve(L, np.linalg.solve(L, T).T))
        add("KL", float((values - 1 - np.log(values)).sum() / 2))
        g = lateral_jacobian(decoded.means[i], min(FAR, line.x_max))
        ratio = (g @ decoded.cov[block, block] @ g) / (g @ true[block, block] @ g)
        add("lateral at 80 m", float(np.sqrt(ratio)))
    for x in common_places(truth):
        for what, g in directions(decoded.means[:2], x).items():
            sigma, least = (np.sqrt(g @ cov[:8, :8] @ g) for cov in (decoded.cov, true))
            add(what, float(sigma / least))
            add(f"{what}, excess", 1000 * float(sigma - least))


def common_places(truth: Truth) -> Iterator[float]:
    """Yield the places where the first two lines are valid, if they are those beside the car."""
    if [line.slot for line in truth.lines[:2]] == [Slot.EGO_LEFT, Slot.EGO_RIGHT]:
        low = max(line.x_min for line in truth.lines[:2])
        high = min(line.x_max for line in truth.lines[:2])
        yield from (x for x in X if low <= x <= high)


def directions(means: Array, x: float) -> dict[str, Array]:
    """Return the (8,) derivatives of width, centre and difference of directions of two lines."""
    left, right = lateral_jacobian(means, x)
    slopes = [[0, 1 + np.tan(mean[1]) ** 2, x, x * x / 2] for mean in means]
    vectors = (np.r_[left, -right], np.r_[left, right] / 2, np.r_[slopes[0], -np.array(slopes[1])])
    return dict(zip(SIGMAS, vectors, strict=True))


def witness(
    one: Drawn, truth: Truth, decoded: DecodedLines, draws: int, seed: Any, add: Callable[..., None]
) -> None:
    """Add z of width and centre of the lines beside the car, seen from drawn poses."""
    rng = np.random.default_rng(seed)
    poses = one.ego.mean + rng.standard_normal((draws, 3)) @ one.root.T
    lines = []
    for slot in (Slot.EGO_LEFT, Slot.EGO_RIGHT):
        if slot not in one.case.lines:
            return
        points = one.case.lines[slot]
        _, s = place_of(seen_from(points, one.ego.mean[None])[0])
        near = np.abs(s) <= NEAR + np.diff(s).max()
        true = moved(points[near], one.scene.map_error, draws, rng)
        lines.append((seen_from(true, poses), s[near]))
    for x in common_places(truth):
        left, right = (crossings(local, s, x) for local, s in lines)
        sampled = {"width": left - right, "centre": (left + right) / 2}
        J = directions(decoded.means[:2], x)
        y = [line_at(mean, x) for mean in decoded.means[:2]]
        mean = {"width": y[0] - y[1], "centre": (y[0] + y[1]) / 2}
        for what, values in sampled.items():
            sigma = np.sqrt(J[what] @ decoded.cov[:8, :8] @ J[what])
            add(f"z of {what}", *((values - mean[what]) / sigma).tolist())


def line_at(mean: Array, x: float) -> float:
    """Return the lateral position of a line (Map Line Interface, eq. 1)."""
    return float(mean[0] + np.tan(mean[1]) * x + mean[2] * x**2 / 2 + mean[3] * x**3 / 6)


def moved(points: Array, error: MapError | None, draws: int, rng: Any) -> Array:
    """Return the (n, 2) points, or with a map error (draws, n, 2) draws of the true ones."""
    if error is None:
        return points
    common = error.offset_sigma * rng.standard_normal((draws, 1, 2))
    local = error.point_sigma * rng.standard_normal((draws, *points.shape))
    return np.asarray(points + common + local)


def figures_of(settings: Settings, jobs: int) -> Figures:
    """Return the figures of all scenes."""
    figures = Figures()
    chunks = [
        (range(start, min(start + CHUNK, settings.scenes)), settings)
        for start in range(0, settings.scenes, CHUNK)
    ]
    with bar(settings.scenes, unit=" scenes") as done:
        if jobs == 1:
            parts: Any = map(measure_chunk, chunks)
        else:
            pool = ProcessPoolExecutor(jobs)
            parts = pool.map(measure_chunk, chunks)
        for part, (numbers, _) in zip(parts, chunks, strict=True):
            figures.add(part)
            done.update(len(numbers))
    return figures


def measure_chunk(chunk: tuple[range, Settings]) -> Figures:
    """Return the figures of some scenes."""
    figures = Figures()
    for number in chunk[0]:
        figures.add(measure(number, chunk[1]))
    return figures


def main(argv: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument("--seed", type=int, default=1, help="seed of the scenes and of the draws")
    parser.add_argument("-n", "--scenes", type=int, default=100_000, help="number of scenes")
    parser.add_argument("--shape", action="append", choices=SHAPES, help="can be repeated")
    parser.add_argument("--exact", type=int, default=1000, help="scenes checked exactly")
    parser.add_argument("--witness", type=int, default=5000, help="scenes with a witness")
    parser.add_argument("--draws", type=int, default=20, help="draws for each of them")
    parser.add_argument("--jobs", type=int, default=1, help="number of processes")
    arguments = parser.parse_args(argv)
    result = evidence(arguments)
    misses = [f"MISSED  {miss}" for miss in missed(result)]
    if arguments.json:
        print(json.dumps(result | {"missed": misses}, indent=2))
    else:
        show(result)
        print("", *(misses or ["All bounds are met."]), sep="\n")
    return 1 if misses else 0


def evidence(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the figures that the command line asks for."""
    settings = Settings(
        tuple(arguments.shape or SHAPES),
        arguments.scenes,
        arguments.seed,
        arguments.exact,
        arguments.witness,
        arguments.draws,
    )
    return summary(figures_of(settings, arguments.jobs))


if __name__ == "__main__":
    sys.exit(main())
