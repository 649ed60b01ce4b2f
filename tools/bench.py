#!/usr/bin/env python3
"""Measure speed as ratios to peers, in the same run.

    python tools/bench.py                  all parts, about a minute
    python tools/bench.py --quick          a few seconds; small batches, so lower ratios
    python tools/bench.py scene one        these parts only
    python tools/bench.py --json > a.json  for other programs

That no call wakes a thread of BLAS, tests/test_blas_threads.py shows.

Method. Both sides do the same work on the same inputs, and must agree on the
results before anything is timed. They take turns: ours, peer, ours, peer, ...;
each turn repeats its call for 0.1 s. Each pair of turns gives a ratio. The table
shows the median and, in brackets, the minimum and the maximum. One thread, BLAS
included; garbage collector off.

Reading the table. A ratio is the peer's time over ours: 40x means that ours takes a
fortieth. Where the target is "< 1.3x", the ratio is the growth of our own time from
few points to many. Times are medians. "memory" is the peak allocation of one call,
with its results and without its inputs, as tracemalloc counts it. NumPy and Python
report to tracemalloc; scratch space inside LAPACK and C extensions may not.

The parts:
  refit     poses to lines, against one least-squares call per pose
  scene     eight lines by sigma points, against filterpy with np.polyfit per sigma
            point and line on given points; "new" makes the Refit in each cycle, as
            a car does: window, range, fit; "kept" reuses it. Of the city lines a
            cubic follows only a part of the window, and the range is searched. Also
            the lines with their joint covariance, against the same ones without
  window    what a car sees of a line of a million points, against one of a
            thousand; the car moves on by 1.5 m from query to query
  signals   packing and unpacking alone, against four calls of cantools per line;
            the target is for its default, strict
  batch     Gaussian to payload and back, against packing alone by cantools
  one       the same line by line, where arrays do not help
  cycle     each step of a cycle of a car, beside a peer
  map       loading of a map of a thousand roads (copies of the town of the package),
            against parsing its XML alone; lines around the first pose on each of 400
            lanes, and around later poses, against matching of the poses alone, and
            against loading

Times vary with the load of the machine: a missed target is an error with --strict only.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import platform
import statistics
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Callable, Iterator
from functools import partial
from importlib.metadata import version
from itertools import chain, count, cycle
from multiprocessing import Process
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

# BLAS reads these when NumPy is loaded.
os.environ.update(OPENBLAS_NUM_THREADS="1", MKL_NUM_THREADS="1", OMP_NUM_THREADS="1")

import cantools
import numpy as np
from cycle_calls import city_lines, highway_lines
from filterpy.kalman import MerweScaledSigmaPoints as MerwePoints
from filterpy.kalman import unscented_transform
from map_copies import copies_of_town

from maplines_can import maps
from maplines_can.maps.view import LaneView
from maplines_can.propagation import Refit, SigmaPoints, map_lines, map_scene, points_in_window
from maplines_can.simulation.scenarios import scenario
from maplines_can.study.sets import road
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import MapLine, Slot
from maplines_can.values.polyline import Polyline, to_ego, to_map
from maplines_can.wire import Codec, Reason, default_dbc_path
from maplines_can.wire.layout.packing import Packing

ENCODE, DECODE = "cantools encode", "cantools decode"
FILTERPY = "filterpy with np.polyfit"


class Sizes(NamedTuple):
    """Sizes of a measurement."""

    poses: int = 4096  #: of one refit call
    lines: int = 4096  #: of one batch
    singles: int = 256  #: lines coded one by one, a multiple of 8
    roads: int = 1000  #: of a map
    rounds: int = 9  #: pairs of turns
    seconds: float = 0.1  #: of one turn


QUICK = Sizes(poses=1024, lines=512, singles=64, roads=49, rounds=3, seconds=0.01)


class Pair(NamedTuple):
    """Two ways to do the same work."""

    what: str
    peer: str
    units: int  #: of work in one call
    call: Callable[[], Any]
    peer_call: Callable[[], Any]
    target: float | None = None
    growth: bool = False  #: the ratio is ours over the peer's, and must stay below the target


def agree(what: str, difference: float, limit: float = 0.0) -> None:
    """Exit if two sides differ by more than a limit: their times are not comparable."""
    if not difference <= limit:
        sys.exit(f"bench.py: {what} of the two sides differ by {difference:g}, over {limit:g}")


# -- parts: each yields a sentence about its checks, then its pairs ---------------


def refit(sizes: Sizes, seed: int) -> Iterator[str | Pair]:
    """Compare fits by moments of the points with least squares."""
    highway = scenario("highway")
    poses, n = highway.ego.sample(sizes.poses, seed), sizes.poses

    def curve(points: int) -> Polyline:
        x = np.linspace(*highway.window, points)
        return Polyline(np.column_stack([x, -1.75 + x**2 / (2 * 2000.0) + 1e-6 * x**3 / 6]))

    def system(pose: Any) -> tuple[Any, Any]:
        """Return matrix and right-hand side of the least squares for a cubic."""
        u, v = to_ego(points, pose).T
        return np.array([np.ones(len(u)), u, u * u, u * u * u]).T, v

    def least_squares() -> Any:
        lines = np.empty((n, 4))
        for line, pose in zip(lines, poses, strict=True):
            p0, p1, p2, p3 = np.linalg.lstsq(*system(pose), rcond=None)[0]
            line[:] = p0, np.arctan(p1), 2 * p2, 6 * p3
        return lines

    def solved() -> list[Any]:
        return [np.linalg.lstsq(A, v, rcond=None) for A, v in systems]

    few, many = (Refit(curve(count), highway.ego.mean, highway.window) for count in (50, 10_000))
    points = to_map(few.points[0], highway.ego.mean)
    systems = [system(pose) for pose in poses]
    theirs = least_squares()
    difference = np.abs((few(poses) - theirs) / theirs.std(axis=0)).max()
    agree("lines in standard deviations", difference, 1e-6)
    yield f"the same lines to {difference:.0e} standard deviations"
    ours, ours_many = partial(few, poses), partial(many, poses)
    yield Pair("refit, 50 points", "turn and np.linalg.lstsq", n, ours, least_squares, 30)
    yield Pair("refit, 50 points", "np.linalg.lstsq alone", n, ours, solved, 30)
    yield Pair("refit, 10000 points", "refit, 50 points", n, ours_many, ours, 1.3, growth=True)


def moments_by_filterpy(points_of_lines: list[Any], mean: Any, cov: Any) -> list[Any]:
    """Return the moments of lines by filterpy, with np.polyfit for each sigma point and line."""
    merwe = MerwePoints(3, alpha=1.0, beta=2.0, kappa=0.0)
    poses = merwe.sigma_points(mean, cov)
    moments = []
    for points in points_of_lines:
        values = np.empty((len(poses), 4))
        for value, pose in zip(values, poses, strict=True):
            u, v = to_ego(points, pose).T
            p3, p2, p1, p0 = np.polyfit(u, v, 3)
            value[:] = p0, np.arctan(p1), 2 * p2, 6 * p3
        moments.append(unscented_transform(values, merwe.Wm, merwe.Wc))
    return moments


def scene(sizes: Sizes, seed: int) -> Iterator[str | Pair]:
    """Compare sigma points over all lines of a car with filterpy."""
    del sizes, seed  # a scene has a fixed size
    highway = scenario("highway")
    transform = SigmaPoints()
    window = highway.window
    production = np.diag(np.square([0.1, 0.2, np.radians(0.2)]))

    def pairs(lines: list[Polyline], mean: Any, cov: Any) -> tuple[float, list[Callable[[], Any]]]:
        """Return how much the moments differ, and the calls: new, kept, and the peer."""
        kept = Refit(lines, mean, window)
        points_of_lines = [to_map(points, mean) for points in kept.points]

        def ours(refit: Refit | None = None) -> Any:
            ego = Gaussian.trusted(mean, cov)  # new: it caches the root of its covariance
            return transform.moments(refit or Refit(lines, mean, window), ego)

        peer = partial(moments_by_filterpy, points_of_lines, mean, cov)
        own, (means, covs) = ours(), zip(*peer(), strict=True)
        expected = np.array(covs) + np.asarray(kept.noise_cov)  # filterpy does not know the misfit
        sigma = np.sqrt(np.einsum("lii->li", expected))
        d_cov = (own.cov - expected) / (sigma[:, :, None] * sigma[:, None])
        difference = max(np.abs((own.mean - means) / sigma).max(), np.abs(d_cov).max())
        return difference, [ours, partial(ours, kept), peer]

    peer = FILTERPY
    difference, (new, kept, theirs) = pairs(highway_lines(), highway.ego.mean, highway.ego.cov)
    agree("moments in standard deviations", difference, 1e-6)
    yield f"the same moments to {difference:.0e} standard deviations"
    yield Pair("8 lines, Refit new", peer, 1, new, theirs, 10)
    yield Pair("8 lines, Refit kept", peer, 1, kept, theirs, 10)
    difference, (new, kept, theirs) = pairs(city_lines(), np.zeros(3), production)
    agree("moments in standard deviations", difference, 1e-6)
    yield f"the same moments to {difference:.0e} standard deviations"
    yield Pair("8 city lines, Refit new", peer, 1, new, theirs)
    slots, ego = dict(zip(Slot, highway_lines(), strict=True)), highway.ego
    joint, single = partial(map_scene, slots, ego), partial(map_lines, slots, ego)
    for one, other in zip(joint().lines, single(), strict=True):
        agree("means", np.abs(one.gaussian.mean - other.gaussian.mean).max(), 1e-3)
    yield "the same lines with their joint covariance"
    yield Pair("8 lines, map_scene", "map_lines", 1, joint, single, 2, growth=True)


def window(sizes: Sizes, seed: int) -> Iterator[str | Pair]:
    """Compare windows of a long line with those of a short one."""
    del sizes, seed  # the lines have fixed sizes

    def line(points: int, spacing: float) -> Polyline:
        x = np.arange(points) * spacing
        return Polyline(np.column_stack([x, 10 * np.sin(x / 50)]))

    def drive(line: Polyline) -> Any:
        """Return the windows of a drive of 300 m about the middle of a line."""
        x = line.points[len(line.points) // 2, 0] + np.arange(-150, 150, 1.5)
        poses = np.column_stack([x, 10 * np.sin(x / 50), np.arctan(np.cos(x / 50) / 5)])
        return [points_in_window(line, pose, (-20.0, 80.0)) for pose in poses]

    for spacing, text in ((1.0, "1 m"), (0.001, "1 mm")):
        few, many = line(1000, 1.0), line(10**6, spacing)
        short, long = partial(drive, few), partial(drive, many)
        farthest = max(
            np.abs(points[:, 1] - 10 * np.sin(points[:, 0] / 50)).max() for points in long()
        )
        agree("lateral positions", farthest, 0.01)
        yield f"the windows are on the line to {1e3 * farthest:.1g} mm"
        what = f"million points, {text}"
        yield Pair(what, "thousand points, 1 m", 200, long, short, 1.5, growth=True)


def each(call: Callable[..., Any], arguments: list[Any]) -> list[Any]:
    """Return the results of a call for each argument."""
    return [call(argument) for argument in arguments]


class Traffic:
    """The same lines as Gaussians, as payloads and as the signals of cantools."""

    def __init__(self, n: int, seed: int) -> None:
        gaussians = road(min(n, 400), seed)
        repeat = np.resize(np.arange(len(gaussians.mean)), n)
        self.n, self.mean, self.cov = n, gaussians.mean[repeat], gaussians.cov[repeat]
        self.codec = Codec.from_dbc()
        self.payloads = self.encoded()
        self.frames = [
            [page.tobytes() for page in line] for line in self.payloads.reshape(n, -1, 8)
        ]
        database: Any = cantools.database.load_file(default_dbc_path())
        self.message = database.get_message_by_name("EgoLeft")
        self.values = self.cantools_decoded(decode_choices=False)

    def encoded(self) -> Any:
        """Return the payloads by our codec."""
        return self.codec.batch.encode(self.mean, self.cov, kind=np.arange(self.n) % 8, age=0.05)

    def cantools_encoded(self, **options: bool) -> list[list[bytes]]:
        """Return the pages of each line by cantools."""
        encode = self.message.encode
        return [[encode(page, **options) for page in line] for line in self.values]

    def cantools_decoded(self, **options: bool) -> list[list[dict[str, Any]]]:
        """Return the signals of each page by cantools."""
        decode = self.message.decode
        return [[decode(page, **options) for page in line] for line in self.frames]

    def check(self) -> str:
        """Check that cantools encodes the values to the same bytes, strict or not."""
        for strict in (True, False):
            agree("bytes", self.cantools_encoded(strict=strict) != self.frames)
        return "the same bytes by cantools, strict or not"


def signals(sizes: Sizes, seed: int) -> Iterator[str | Pair]:
    """Compare packing and unpacking alone: physical values to bytes and back."""
    traffic = Traffic(sizes.lines, seed)
    fields = traffic.codec.layout.signals
    packing = Packing(list(fields.values()), traffic.codec.layout.record_bytes)

    def unpack() -> dict[str, Any]:
        raw = packing.unpack(traffic.payloads)
        return {name: signal.physical(raw[name]) for name, signal in fields.items()}

    physical = unpack()

    def pack() -> Any:
        raw = {name: field.raw(physical[name]).astype(np.int64) for name, field in fields.items()}
        return packing.pack(raw, traffic.n)

    agree("bytes", not np.array_equal(pack(), traffic.payloads))
    for i, pages in enumerate(zip(*traffic.values, strict=True)):
        for name in pages[0]:
            ours = physical[name if name in fields else f"{name}{i}"]
            agree(name, np.abs(ours - [page[name] for page in pages]).max())
    yield f"{traffic.check()}, and the same values"
    n, encode, decode = traffic.n, traffic.cantools_encoded, traffic.cantools_decoded
    yield Pair("pack", ENCODE, n, pack, encode, 50)
    yield Pair("pack", f"{ENCODE}, strict=False", n, pack, lambda: encode(strict=False))
    yield Pair("unpack", DECODE, n, unpack, decode, 50)


def batch(sizes: Sizes, seed: int) -> Iterator[str | Pair]:
    """Compare Gaussians to payloads and back with packing alone by cantools."""
    traffic = Traffic(sizes.lines, seed)
    decoded = partial(traffic.codec.batch.decode, traffic.payloads)
    agree("records sent and accepted", (~decoded().accepted).sum())
    yield traffic.check()
    n, encode, decode = traffic.n, traffic.cantools_encoded, traffic.cantools_decoded
    yield Pair("Gaussian to payload", ENCODE, n, traffic.encoded, encode, 2)
    yield Pair("payload to Gaussian", DECODE, n, decoded, decode, 10)


def one(sizes: Sizes, seed: int) -> Iterator[str | Pair]:
    """Compare single lines with packing alone by cantools."""
    n, traffic = sizes.singles, Traffic(sizes.singles, seed)
    codec, decoder, t_ns = traffic.codec, traffic.codec.decoder(), 0
    encoder = codec.encoder()
    gaussians = [Gaussian(mean, cov) for mean, cov in zip(traffic.mean, traffic.cov, strict=True)]
    lines = [MapLine(Slot(i % len(Slot)), gaussian) for i, gaussian in enumerate(gaussians)]
    singly = partial(each, encoder.encode, lines)
    eights = partial(each, encoder.encode_lines, list(zip(*[iter(lines)] * len(Slot), strict=True)))
    rounds = cycle(
        [list(chain.from_iterable(singly())) for _ in range(2)]
    )  # so that no counter repeats

    def fed() -> list[Any]:
        nonlocal t_ns
        t_ns += 10**9  # late enough for the counters to restart
        return [decoder.feed(frame.can_id, frame.data, t_ns) for frame in next(rounds)]

    delivered = sum(not isinstance(result, Reason) for result in fed() + fed())
    agree("lines fed and lines delivered", abs(delivered - 2 * n))
    yield traffic.check()
    encode, decode = traffic.cantools_encoded, traffic.cantools_decoded
    yield Pair("Encoder.encode", ENCODE, n, singly, encode)
    yield Pair("Encoder.encode_lines of 8", ENCODE, n, eights, encode)
    yield Pair("Decoder.feed, 4 frames", DECODE, n, fed, decode)


def large_map(sizes: Sizes, seed: int) -> Iterator[str | Pair]:
    """Compare loading and lines of a large map with parsing and with matching alone."""
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "copies.xodr"
        roads = copies_of_town(sizes.roads, path)
        load = partial(maps.load, path)
        gc.collect()
        tracemalloc.start()
        road_map = load()
        kept, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        lanes = [lane for lane in road_map.lanes.values() if lane.type.is_drivable]
        chosen = [lanes[i] for i in rng.permutation(len(lanes))[:400]]
        poses = [middle_of(lane) for lane in chosen]
        agree("roads", abs(len(road_map.roads) - roads))
        agree("poses with lines", sum(Slot.EGO_LEFT not in road_map.lines(pose) for pose in poses))

        def first() -> list[Any]:
            view = LaneView(road_map.lanes)  # new: it keeps the lines of the lanes
            matches = map(road_map.match, poses)
            return [view.lines(match, None) for match in matches if match is not None]

        match, again = (partial(each, call, poses) for call in (road_map.match, road_map.lines))
        memory = f"{kept / 1e6:.0f} MB kept, {peak / 1e6:.0f} MB at most"
        yield f"{roads} roads and {len(road_map.lanes)} lanes are loaded, with lines; {memory}"
        parse = partial(ET.parse, path)
        yield Pair("load, a road", "ElementTree.parse", roads, load, parse)
        yield Pair("first pose on a lane", "match alone", len(poses), first, match, 15, growth=True)
        yield Pair("later poses", "match alone", len(poses), again, match, 1.5, growth=True)
        yield Pair("400 first poses", "load", 1, first, load, growth=True)


def middle_of(lane: maps.Lane) -> Any:
    """Return a pose in the middle of a lane."""
    s = lane.length * np.array([0.49, 0.51])
    (x0, x1), (y0, y1) = (np.interp(s, lane.centre.distance, p) for p in lane.centre.points.T)
    return np.array([(x0 + x1) / 2, (y0 + y1) / 2, np.arctan2(y1 - y0, x1 - x0)])


def cycle_steps(_: Sizes, seed: int) -> Iterator[str | Pair]:
    """Compare each step of a cycle of a car with a peer."""
    traffic, highway, many = Traffic(8, seed), scenario("highway"), range(100)
    lines, ego = dict(zip(Slot, highway_lines(), strict=True)), highway.ego
    mean, cov = traffic.mean[0], np.array(traffic.cov[0])
    line = MapLine(Slot.EGO_LEFT, Gaussian(mean, cov))
    J = np.array([1.0, 30.0, 450.0, 4500.0])
    kept = Refit([*lines.values()], ego.mean, highway.window)
    points = [to_map(points, ego.mean) for points in kept.points]
    filtered = partial(moments_by_filterpy, points, ego.mean, ego.cov)
    ours = map_scene(lines, ego)
    encode, decode = traffic.cantools_encoded, traffic.cantools_decoded
    calls: dict[str, tuple[int, Callable[[], Any], str, Callable[[], Any], float | None]] = {
        "Gaussian": (
            100, lambda: [Gaussian(mean, cov) for _ in many],
            "np.linalg.cholesky", lambda: [np.linalg.cholesky(cov) for _ in many], None,
        ),
        "y_sigma(x)": (
            100, lambda: [line.y_sigma(30.0) for _ in many],
            "J S J by NumPy", lambda: [np.sqrt(J @ cov @ J) for _ in many], None,
        ),
        "map_lines, 8": (1, partial(map_lines, lines, ego), FILTERPY, filtered, 20),
        "map_scene, 8": (1, partial(map_scene, lines, ego), FILTERPY, filtered, 10),
        "Refit new, 8": (
            1,
            lambda: SigmaPoints().moments(
                Refit([*lines.values()], ego.mean, highway.window),
                Gaussian.trusted(ego.mean, ego.cov),
            ),
            FILTERPY, filtered, 20,
        ),
    }  # fmt: skip
    for what, (units, call, peer, peer_call, target) in calls.items():
        yield Pair(what, peer, units, call, peer_call, target)
    for short, name, fd in (
        ("", "maplines.dbc", False),
        ("pose: ", "maplines-pose.dbc", False),
        ("pose FD: ", "maplines-pose.dbc", True),
        ("whole: ", "maplines-scene.dbc", True),
    ):
        codec = Codec.from_dbc(default_dbc_path(name))
        encoder, decoder = codec.encoder(), codec.decoder()
        send = partial(encoder.encode_scene, fd=fd)
        yield Pair(f"{short}scene sent", ENCODE, 1, partial(send, ours), encode)
        prepared = encoder.prepare_scene(ours, fd=fd)
        cycles = repeated(lambda: chain(*send(prepared).values()))  # noqa: B023
        receive = partial(received_scene, decoder, cycles)
        yield Pair(f"{short}scene read", DECODE, 1, receive, decode)
    encoder, decoder = traffic.codec.encoder(), traffic.codec.decoder()
    singles = [MapLine(slot, Gaussian(*one)) for slot, one in
               zip(Slot, zip(traffic.mean, traffic.cov, strict=True), strict=True)]  # fmt: skip
    rounds = repeated(lambda: chain(*map(encoder.encode, singles)))
    yield Pair("line to frames", ENCODE, 8, partial(each, encoder.encode, singles), encode)
    yield Pair("8 lines in one call", ENCODE, 8, partial(encoder.encode_lines, singles), encode)
    yield Pair("frames to line", DECODE, 8, partial(received, decoder, rounds), decode)


def repeated(send: Callable[[], Any]) -> Iterator[list[tuple[int, bytes, int]]]:
    """Return the frames of cycle after cycle with their times; the counters come again."""
    cycles = [[(frame.can_id, frame.data) for frame in send()] for _ in range(256)]
    times = zip(cycle(cycles), count(0, 50_000_000))
    return ([(*frame, t_ns) for frame in frames] for frames, t_ns in times)


def received(decoder: Any, cycles: Iterator[list[tuple[int, bytes, int]]]) -> list[Any]:
    """Feed the frames of a cycle."""
    return [decoder.feed(*frame) for frame in next(cycles)]


def received_scene(decoder: Any, cycles: Iterator[list[tuple[int, bytes, int]]]) -> Any:
    """Feed the frames of a cycle, and build the scene."""
    received(decoder, cycles)
    return decoder.latest_scene(0)


PARTS = {
    "refit": (refit, "1  From poses to lines; times per pose"),
    "scene": (scene, "2  All lines of a scene by sigma points; times per cycle"),
    "window": (window, "3  What a car sees of a line; times per window"),
    "signals": (signals, "4  Signals alone, four pages per line; times per line"),
    "batch": (batch, "5  Whole batches, against packing alone by cantools; times per line"),
    "one": (one, "6  Single lines, against packing alone by cantools; times per line"),
    "cycle": (cycle_steps, "8  A cycle step by step; times per line, or per cycle"),
    "map": (large_map, "7  A large map"),
}


# -- measurement and output -------------------------------------------------------


def timed(call: Callable[[], Any], repeats: int = 1) -> float:
    """Return the seconds of one call, with the garbage collector off."""
    gc.collect()
    gc.disable()
    start = time.perf_counter()
    for _ in range(repeats):
        call()
    seconds = time.perf_counter() - start
    gc.enable()
    return seconds / repeats


def allocated(call: Callable[[], Any]) -> int:
    """Return the peak allocation of one call [bytes]."""
    gc.collect()
    tracemalloc.start()
    call()
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    return peak


def measured(pair: Pair, sizes: Sizes) -> dict[str, Any]:
    """Return times in seconds per unit of work, memory in bytes, and the ratio."""
    calls = (pair.call, pair.peer_call)
    # The first call warms up; the faster of the next two gives the repetitions of a turn.
    once = [min([timed(call) for _ in range(3)][1:]) for call in calls]
    repeats = [max(1, round(sizes.seconds / seconds)) for seconds in once]
    turns = [[*map(timed, calls, repeats)] for _ in range(sizes.rounds)]
    ratios = [ours / peer if pair.growth else peer / ours for ours, peer in turns]
    ratio = statistics.median(ratios)
    ours, peer = (statistics.median(side) / pair.units for side in zip(*turns, strict=True))
    result = {"what": pair.what, "peer": pair.peer, "ours_s": ours, "peer_s": peer}
    result |= {"ratio": ratio, "ratio_min": min(ratios), "ratio_max": max(ratios)}
    result |= {"target": None, "met": None}
    if pair.target is not None:
        result["target"] = f"{'<' if pair.growth else '>='} {pair.target:g}x"
        result["met"] = ratio < pair.target if pair.growth else ratio >= pair.target
    return result | dict(zip(("ours_bytes", "peer_bytes"), map(allocated, calls), strict=True))


COLUMNS = "   {:<25} {:<29} {:>9} {:>8} {:>6} {:>16} {:>7} {:>4}  {:>17}"
HEADING = "", "against", "ours", "peer", "ratio", "[min .. max]", "target", "met", "memory"


def shown(result: dict[str, Any]) -> str:
    """Return a row of the table."""
    ratios = [result[key] for key in ("ratio", "ratio_min", "ratio_max")]
    ratio, low, high = (f"{x:.{0 if x >= 20 else 1 if x >= 2 else 2}f}" for x in ratios)
    times = [scaled(1e6 * result[key], "us", "ms") for key in ("ours_s", "peer_s")]
    memory = [scaled(result[key] / 1e3, "kB", "MB") for key in ("ours_bytes", "peer_bytes")]
    met = {True: "yes", False: "NO", None: "-"}[result["met"]]
    rest = f"{ratio}x", f"[{low} .. {high}]", result["target"] or "-", met, " / ".join(memory)
    return COLUMNS.format(result["what"], result["peer"], *times, *rest)


def scaled(value: float, unit: str, thousand: str) -> str:
    """Return the value with three digits and its unit."""
    return f"{value:.3g} {unit}" if value < 999.5 else f"{value / 1e3:.3g} {thousand}"


def burn() -> None:
    """Keep a core busy."""
    while True:
        pass


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)} [all]")
    parser.add_argument("--busy", action="store_true", help="keep all cores busy meanwhile")
    parser.add_argument("--quick", action="store_true", help="small sizes, as a smoke test")
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    parser.add_argument("--seed", type=int, default=0, help="of the poses and roads [%(default)s]")
    parser.add_argument("--strict", action="store_true", help="exit with 1 if a target is missed")
    options = parser.parse_args(argv)
    if unknown := set(options.parts) - set(PARTS):
        parser.error(f"no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    sizes = QUICK if options.quick else Sizes()

    def say(text: str) -> None:
        if not options.json:
            print(text, flush=True)

    about = {"python": platform.python_version(), "system": platform.system()}
    about |= {name: version(name) for name in ("numpy", "cantools", "filterpy")}
    say(", ".join(f"{name} {value}" for name, value in about.items()))
    say(", ".join(f"{name} {value}" for name, value in sizes._asdict().items()))
    say("\n" + COLUMNS.format(*HEADING))
    results = []
    burners = [Process(target=burn, daemon=True) for _ in range(os.cpu_count() or 1)]
    for burner in burners if options.busy else ():
        burner.start()  # a daemon: it ends with this program
    for name in options.parts or PARTS:
        part, title = PARTS[name]
        say(f"\n{title}")
        for pair in part(sizes, options.seed):
            if isinstance(pair, str):
                say(f"   checked: {pair}")
            else:
                results.append({"part": name, **measured(pair, sizes)})
                say(shown(results[-1]))
    outcomes = [result["met"] for result in results if result["met"] is not None]
    say(f"\n{sum(outcomes)} of {len(outcomes)} targets met")
    if options.json:
        report = {"about": about, "sizes": sizes._asdict(), "seed": options.seed}
        print(json.dumps({**report, "results": results}, indent=2))
    return int(options.strict and not all(outcomes))


if __name__ == "__main__":
    sys.exit(main())
