#!/usr/bin/env python3
"""How fast is it? Everything as a ratio to a peer that is measured in the same run.

    python tools/bench.py                 all of it, about a minute
    python tools/bench.py --quick         a few seconds; small batches, so lower ratios
    python tools/bench.py scene           one part: refit, scene, signals, batch, one
    python tools/bench.py --json > a.json

How it is measured. Both sides do the same work on the same inputs, and must
agree on the results before the clock is started. They take turns, ours, peer,
ours, peer, ...; each turn repeats its call for --seconds. A ratio is formed for
each pair of turns; printed are the median and, in brackets, the least and the
greatest of them. Both sides run in one thread, BLAS included, with the garbage
collector off.

How to read it. A ratio is the peer's time over ours: 40x says that ours takes a
fortieth. The ratio "growth" is ours over ours. Times are medians, for one unit
of work: a pose, a cycle, a line. "memory" is the peak of what one call
allocates, its results included and its inputs not, ours / peer, as tracemalloc
counts it (NumPy and Python report to it; scratch space inside LAPACK does not).

Machines are noisy: a missed target is printed, and is an error with --strict only.
Needs the project's dev extra (filterpy).
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import platform
import statistics
import sys
import time
import tracemalloc
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import version
from itertools import chain
from typing import Any, NamedTuple

for _library in ("OPENBLAS", "MKL", "OMP", "VECLIB_MAXIMUM"):  # read when NumPy is loaded
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")

import cantools
import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform

from maplines_can.gaussian import Gaussian
from maplines_can.line import MapLine, Slot
from maplines_can.polyline import Polyline, to_ego
from maplines_can.propagation import Refit, SigmaPoints
from maplines_can.scenarios import parallel, scenario
from maplines_can.study.sets import road
from maplines_can.wire import Codec, default_dbc_path
from maplines_can.wire.packing import Packing

MESSAGE = "EgoLeft"
PAGE_BYTES = 8
#: Lateral places of a full scene, one line for each slot of the DBC [m].
OFFSETS = (3.5, 0.0, 7.0, -3.5, 1.75, 10.5, -7.0, -1.75)


class Sizes(NamedTuple):
    """How much is measured."""

    poses: int = 4096  #: of a refit
    lines: int = 4096  #: of a batch
    singles: int = 256  #: lines that are coded one by one
    rounds: int = 9  #: pairs of turns
    seconds: float = 0.1  #: of a turn


QUICK = Sizes(poses=1024, lines=512, singles=64, rounds=3, seconds=0.01)


class Pair(NamedTuple):
    """Two ways to do the same work."""

    what: str
    peer_name: str
    unit: str
    units: int  #: in one call of either side
    ours: Callable[[], Any]
    peer: Callable[[], Any]
    target: float | None = None
    growth: bool = False  #: the ratio is ours over the peer's, to stay below the target


@dataclass(frozen=True)
class Result:
    """One row of the table; times are seconds a unit, memory is bytes."""

    part: str
    what: str
    peer: str
    unit: str
    ours_s: float
    peer_s: float
    ratio: float
    ratio_min: float
    ratio_max: float
    target: str | None
    met: bool | None
    ours_bytes: int
    peer_bytes: int


class Disagreement(Exception):
    """The two sides of a pair do not give the same: there is nothing to compare."""


def agree(what: str, difference: float, limit: float) -> str:
    """A sentence on how well two sides agree; Disagreement where they do not."""
    if not difference <= limit:
        raise Disagreement(f"{what} differ by {difference:g}, more than {limit:g}")
    return f"{what} agree to {difference:.0e}" if difference else f"{what} are the same"


# -- what is compared: each part yields sentences of what it checked, then pairs --


def refit(sizes: Sizes, seed: int) -> Iterator[str | Pair]:
    """Poses to lines, by moments of the points and by least squares."""
    scene = scenario("highway")
    poses = scene.ego.sample(sizes.poses, seed)

    def road_of(n: int) -> Polyline:
        x = np.linspace(*scene.window, n)
        return Polyline(np.column_stack([x, -1.75 + x**2 / (2 * 2000.0) + 1e-6 * x**3 / 6]))

    polyline = road_of(50)
    fit = Refit(polyline, scene.ego.mean, scene.window)
    fit_10000 = Refit(road_of(10_000), scene.ego.mean, scene.window)
    systems = [cubic_system(to_ego(polyline.points, pose)) for pose in poses]

    def least_squares() -> Any:
        return np.array([cubic_by_lstsq(to_ego(polyline.points, pose)) for pose in poses])

    def solved() -> list[Any]:
        return [np.linalg.lstsq(A, v, rcond=None) for A, v in systems]

    ours, theirs = fit(poses), least_squares()
    yield agree("lines, in sigma,", np.abs((ours - theirs) / theirs.std(axis=0)).max(), 1e-6)
    n = len(poses)
    own = lambda: fit(poses)  # noqa: E731
    yield Pair("refit, 50 points", "turn + np.linalg.lstsq", "pose", n, own, least_squares, 30)
    yield Pair("refit, 50 points", "np.linalg.lstsq alone", "pose", n, own, solved, 30)
    yield Pair(
        "refit, 10 000 points",
        "refit, 50 points",
        "pose",
        n,
        lambda: fit_10000(poses),
        own,
        1.3,
        True,
    )


def cubic_system(points: Any) -> tuple[Any, Any]:
    """Matrix and right-hand side of the least squares for a cubic."""
    A = np.ones((len(points), 4))
    A[:, 1] = points[:, 0]
    np.multiply(A[:, 1], A[:, 1], out=A[:, 2])
    np.multiply(A[:, 2], A[:, 1], out=A[:, 3])
    return A, points[:, 1]


def cubic_by_lstsq(points: Any) -> tuple[float, ...]:
    p0, p1, p2, p3 = np.linalg.lstsq(*cubic_system(points), rcond=None)[0]
    return p0, np.arctan(p1), 2 * p2, 6 * p3


def scene(sizes: Sizes, seed: int) -> Iterator[str | Pair]:
    """All lines of a scene by sigma points."""
    del sizes, seed  # a scene has the size it has
    highway = scenario("highway")
    mean, cov, window = highway.ego.mean, highway.ego.cov, highway.window
    base = highway.polylines[1].points
    lines = [Polyline(parallel(base, offset)) for offset in OFFSETS]
    transform, sigmas = SigmaPoints(), MerweScaledSigmaPoints(3, alpha=1.0, beta=2.0, kappa=0.0)
    kept = Refit(lines, mean, window)
    kept_points = [line.window(mean, *window) for line in lines]

    def ours(refit: Refit | None) -> Any:  # a new Gaussian: the root of a pose is for one cycle
        ego = Gaussian.trusted(mean, cov)
        return transform.moments(refit or Refit(lines, mean, window), ego)

    def peer(points_of_lines: list[Any] | None) -> list[Any]:
        poses = sigmas.sigma_points(mean, cov)
        result = []
        for points in points_of_lines or [line.window(mean, *window) for line in lines]:
            values = np.empty((len(poses), 4))
            for value, pose in zip(values, poses, strict=True):
                u, v = to_ego(points, pose).T
                p3, p2, p1, p0 = np.polyfit(u, v, 3)
                value[:] = p0, np.arctan(p1), 2 * p2, 6 * p3
            result.append(unscented_transform(values, sigmas.Wm, sigmas.Wc))
        return result

    own, other = ours(None), peer(None)
    sigma = np.sqrt(np.einsum("lii->li", own.cov))
    d_mean = np.abs((own.mean - [m for m, _ in other]) / sigma).max()
    d_cov = np.abs((own.cov - [c for _, c in other]) / (sigma[:, :, None] * sigma[:, None])).max()
    yield agree("means and covariances, in sigma,", max(d_mean, d_cov), 1e-6)
    what, name = f"{len(lines)} lines of {len(base)} points", "filterpy + np.polyfit"
    yield Pair(f"{what}, Refit anew", name, "cycle", 1, lambda: ours(None), lambda: peer(None), 10)
    yield Pair(
        f"{what}, Refit kept", name, "cycle", 1, lambda: ours(kept), lambda: peer(kept_points), 10
    )


class Traffic:
    """The same lines as Gaussians, as payloads, and as cantools sees them."""

    def __init__(self, n: int, seed: int) -> None:
        gaussians = road(min(n, 400), seed)
        repeat = np.resize(np.arange(len(gaussians.mean)), n)
        self.n = n
        self.mean, self.cov = gaussians.mean[repeat], gaussians.cov[repeat]
        self.codec = Codec.from_dbc()
        self.payloads = self.encoded()
        pages = self.payloads.reshape(n, -1, PAGE_BYTES)
        self.frames = [[page.tobytes() for page in line] for line in pages]
        self.message: Any = cantools.database.load_file(default_dbc_path()).get_message_by_name(
            MESSAGE
        )
        self.values = self.cantools_decoded(decode_choices=False)

    def encoded(self) -> Any:
        return self.codec.encode_batch(self.mean, self.cov, kind=np.arange(self.n) % 8, age=0.05)

    def cantools_encoded(self, **options: bool) -> list[list[bytes]]:
        encode = self.message.encode
        return [[encode(page, **options) for page in line] for line in self.values]

    def cantools_decoded(self, **options: bool) -> list[list[dict[str, Any]]]:
        decode = self.message.decode
        return [[decode(page, **options) for page in line] for line in self.frames]

    def check(self) -> None:
        agree("bytes of cantools", float(self.cantools_encoded() != self.frames), 0)
        loose = self.cantools_encoded(strict=False)
        agree("bytes of cantools with strict=False", float(loose != self.frames), 0)


def signals(sizes: Sizes, seed: int) -> Iterator[str | Pair]:
    """Packing and unpacking alone, physical values to bytes and back."""
    traffic = Traffic(sizes.lines, seed)
    fields = traffic.codec.layout.fields
    packing = Packing(list(fields.values()), traffic.codec.layout.record_bytes)
    physical = packing.physical(traffic.payloads)

    def pack() -> Any:
        raw = {name: field.raw(physical[name]).astype(np.int64) for name, field in fields.items()}
        return packing.pack(raw, traffic.n)

    def unpack() -> Any:
        return packing.physical(traffic.payloads)

    traffic.check()
    yield agree("bytes", float(not np.array_equal(pack(), traffic.payloads)), 0)
    pages = range(len(traffic.frames[0]))
    theirs = [
        {**line[page], f"Page{page}": line[page]["Page"], f"Burst{page}": line[page]["Burst"]}
        for line in traffic.values
        for page in pages
    ]
    worst = max(
        np.abs(physical[name] - [page[name] for page in theirs if name in page]).max()
        for name in fields
    )
    yield agree("values", worst, 0)
    n, encode, decode = traffic.n, traffic.cantools_encoded, traffic.cantools_decoded
    yield Pair("pack", "cantools encode", "line", n, pack, encode, 50)
    yield Pair(
        "pack", "cantools encode, strict=False", "line", n, pack, lambda: encode(strict=False)
    )
    yield Pair("unpack", "cantools decode", "line", n, unpack, decode, 50)
    yield Pair(
        "unpack",
        "cantools decode, no choices",
        "line",
        n,
        unpack,
        lambda: decode(decode_choices=False),
    )


def batch(sizes: Sizes, seed: int) -> Iterator[str | Pair]:
    """Gaussians to payloads and back, against cantools' packing alone."""
    traffic = Traffic(sizes.lines, seed)
    traffic.check()

    def decoded() -> Any:
        return traffic.codec.decode_batch(traffic.payloads)

    back = decoded()
    yield agree("records that are not accepted: they", float((~back.accepted).sum()), 0)
    n, encode, decode = traffic.n, traffic.cantools_encoded, traffic.cantools_decoded
    yield Pair("Gaussian to payload", "cantools encode", "line", n, traffic.encoded, encode, 2)
    yield Pair("payload to Gaussian", "cantools decode", "line", n, decoded, decode, 10)


def one(sizes: Sizes, seed: int) -> Iterator[str | Pair]:
    """Lines on their own, against cantools' packing alone."""
    n = -(-sizes.singles // 8) * 8
    traffic = Traffic(n, seed)
    traffic.check()
    codec, decoder = traffic.codec, traffic.codec.decoder()
    back = codec.decode_batch(traffic.payloads)
    gaussians = [Gaussian(mean, cov) for mean, cov in zip(back.mean, back.cov, strict=True)]
    lines = [MapLine(Slot.EGO_LEFT, gaussian, age=0.05) for gaussian in gaussians]
    cycles = [
        [MapLine(slot, gaussian, age=0.05) for slot, gaussian in zip(Slot, eight, strict=True)]
        for eight in zip(*[iter(gaussians)] * 8, strict=True)
    ]
    frames = list(chain.from_iterable(codec.encode(line) for line in lines))

    def encoded() -> list[Any]:
        return [codec.encode(line) for line in lines]

    def encoded_by_eights() -> list[Any]:
        return [codec.encode_lines(eight) for eight in cycles]

    t_ns = 0

    def fed() -> list[Any]:
        nonlocal t_ns
        results = []
        t_ns += 10**9  # long enough for the counter to start anew
        for frame in frames:
            t_ns += 100_000
            results.append(decoder.feed(frame.can_id, frame.data, t_ns))
        return results

    delivered = sum(isinstance(result, MapLine) for result in fed() + fed())
    yield agree("lines fed and lines delivered", abs(delivered - 2 * n), 0)
    encode, decode = traffic.cantools_encoded, traffic.cantools_decoded
    yield Pair("Codec.encode", "cantools encode", "line", n, encoded, encode)
    yield Pair("Codec.encode_lines of 8", "cantools encode", "line", n, encoded_by_eights, encode)
    yield Pair("Decoder.feed, 4 frames", "cantools decode", "line", n, fed, decode)


PARTS: dict[str, tuple[str, Callable[[Sizes, int], Iterator[str | Pair]]]] = {
    "refit": ("1  from poses to lines", refit),
    "scene": ("2  all lines of a scene by sigma points", scene),
    "signals": ("3  signals alone, four pages a line", signals),
    "batch": ("4  the whole way, against cantools' packing alone", batch),
    "one": ("5  one line on its own, against cantools' packing alone", one),
}


# -- how it is measured ----------------------------------------------------------


def timed(call: Callable[[], Any], repeats: int) -> float:
    """Seconds of one call, the collector off."""
    gc.collect()
    gc.disable()
    try:
        start = time.perf_counter()
        for _ in range(repeats):
            call()
        return (time.perf_counter() - start) / repeats
    finally:
        gc.enable()


def allocated(call: Callable[[], Any]) -> int:
    """Bytes at the peak of one call, beyond what there was before."""
    gc.collect()
    tracemalloc.start()
    try:
        call()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def measured(part: str, pair: Pair, sizes: Sizes) -> Result:
    repeats = []
    for call in (pair.ours, pair.peer):
        timed(call, 1)  # warm
        once = min(timed(call, 1) for _ in range(2))
        repeats.append(max(1, round(sizes.seconds / once)))
    turns = [
        (timed(pair.ours, repeats[0]), timed(pair.peer, repeats[1])) for _ in range(sizes.rounds)
    ]
    ratios = [ours / peer if pair.growth else peer / ours for ours, peer in turns]
    ratio, target = statistics.median(ratios), pair.target
    return Result(
        part=part,
        what=pair.what,
        peer=pair.peer_name,
        unit=pair.unit,
        ours_s=statistics.median(ours for ours, _ in turns) / pair.units,
        peer_s=statistics.median(peer for _, peer in turns) / pair.units,
        ratio=ratio,
        ratio_min=min(ratios),
        ratio_max=max(ratios),
        target=None if target is None else f"{'<' if pair.growth else '>='} {target:g}x",
        met=None if target is None else ratio < target if pair.growth else ratio >= target,
        ours_bytes=allocated(pair.ours),
        peer_bytes=allocated(pair.peer),
    )


# -- how it is shown -------------------------------------------------------------

COLUMNS = "  {:<30} {:<30} {:>10} {:>10} {:>8} {:>18}  {:>7} {:>4}  {:>19}"
HEAD = COLUMNS.format(
    "what", "peer", "ours", "peer", "ratio", "[min .. max]", "target", "met", "memory, ours / peer"
)


def shown(result: Result) -> str:
    """A row of the table."""
    figures = "{:.2f}x" if result.ratio < 10 else "{:.0f}x"
    met = {True: "yes", False: "NO", None: "-"}[result.met]
    return COLUMNS.format(
        result.what,
        result.peer,
        duration(result.ours_s),
        duration(result.peer_s),
        figures.format(result.ratio),
        f"[{figures} .. {figures}]".format(result.ratio_min, result.ratio_max),
        result.target or "-",
        met,
        f"{size(result.ours_bytes)} / {size(result.peer_bytes)}",
    )


def duration(seconds: float) -> str:
    return f"{1e6 * seconds:.3g} us" if seconds < 999e-6 else f"{1e3 * seconds:.3g} ms"


def size(n: int) -> str:
    return f"{n / 1e3:.3g} kB" if n < 999_500 else f"{n / 1e6:.3g} MB"


def about() -> dict[str, str | int | None]:
    """What it was measured on."""
    libraries = {name: version(name) for name in ("numpy", "cantools", "filterpy")}
    system = f"{platform.system()} {platform.machine()}"
    return {"python": platform.python_version(), **libraries, "system": system}


def main(argv: list[str] | None = None) -> int:
    """The command; returns its exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)} [all]")
    parser.add_argument("--quick", action="store_true", help="small sizes, to see that it runs")
    parser.add_argument("--json", action="store_true", help="print JSON instead of the table")
    parser.add_argument("--seed", type=int, default=0, help="of poses and roads [%(default)s]")
    parser.add_argument("--rounds", type=int, help="pairs of turns [9, quick: 3]")
    parser.add_argument("--seconds", type=float, help="length of a turn [0.1, quick: 0.01]")
    parser.add_argument("--strict", action="store_true", help="exit with 1 if a target is missed")
    options = parser.parse_args(argv)
    if unknown := set(options.parts) - set(PARTS):
        parser.error(f"no part {', '.join(sorted(unknown))}; there are {', '.join(PARTS)}")
    sizes = QUICK if options.quick else Sizes()
    wishes = {"rounds": options.rounds, "seconds": options.seconds}
    sizes = sizes._replace(**{name: wish for name, wish in wishes.items() if wish is not None})
    if sizes.rounds < 1 or not 0 <= sizes.seconds < np.inf:
        parser.error("--rounds must be 1 or more and --seconds 0 or more")

    def say(line: str) -> None:
        if not options.json:
            print(line, flush=True)

    say(", ".join(f"{name} {value}" for name, value in about().items()))
    say(f"{sizes.rounds} rounds of {sizes.seconds:g} s a side, {sizes.poses} poses, ")
    say("")
    say(HEAD)
    results = []
    for part in options.parts or PARTS:
        title, pairs = PARTS[part]
        say(f"\n{title}")
        for pair in pairs(sizes, options.seed):
            if isinstance(pair, str):
                say(f"     {pair}")
                continue
            results.append(measured(part, pair, sizes))
            say(shown(results[-1]))
    missed = [result for result in results if result.met is False]
    if options.json:
        report = {"about": about(), "sizes": sizes._asdict(), "seed": options.seed}
        print(json.dumps({**report, "results": [asdict(result) for result in results]}, indent=2))
    judged = sum(result.met is not None for result in results)
    say(f"\n{judged - len(missed)} of {judged} targets met")
    return int(options.strict and bool(missed))


if __name__ == "__main__":
    try:
        sys.exit(main())
    except Disagreement as error:
        sys.exit(f"bench.py: {error}")
