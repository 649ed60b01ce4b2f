#!/usr/bin/env python3
"""Measure how honest and how long the lines are that ``map_lines`` gives on random roads.

    evidence_lines.py                     all shapes of roads, production pose and poor pose
    evidence_lines.py --shape city -n 50  50 lines of one shape
    evidence_lines.py --map-error         the true line deviates from the map as ``MapError`` says
    evidence_lines.py --wire              the decoded band and the decoded range

Run it in the environment of the project: python3 tools/run.py python tools/evidence_lines.py

z is the lateral position of the line at x, seen from a pose drawn from the Gaussian, less the mean
y(x), in units of the standard deviation of y(x). The lateral position is where the points of the
map, transformed to the drawn pose, cross x; a line that does not is counted as |z| > 3. Roads have
random curvatures, lane widths and distances of their points, which are in random order, direction
and place (UTM). The limit of a range is the longest one in which any cubic deviates from the line
by at most ``max_misfit`` (Chebyshev fit, by linear programming).

The exit status is 1 if a bound is missed.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from line_witness import (
    AHEAD,
    HEADINGS,
    POSES,
    WINDOW,
    Array,
    Poses,
    Tally,
    cells,
    is_oncoming,
    missed,
    place_of,
    quantiles,
    seen_from,
)
from random_roads import SHAPES, random_case
from reporting import bar, parser_of
from scipy.optimize import linprog

from maplines_can import Codec, Gaussian, MapError, MapLine, Polyline, Slot, map_lines

MAX_MISFIT = 0.1
#: Of --map-error.
MAP_ERROR = MapError(point_sigma=0.05, offset_sigma=0.1, heading_sigma=np.radians(0.1))
#: Bounds: rms of z, and least ratio of the range to its limit (median, 5 % quantile).
RMS, RATIO = (0.85, 1.08), (0.85, 0.6)
#: A line that reaches farther both ways from x = 0 could be given there [m].
AT_CAR = 2.0
#: A line is a function y(x) while it deviates by less from the car's x axis [rad].
TURN = np.radians(65.0)


def chebyshev_misfit(x: Array, y: Array) -> float:
    """Return the least possible largest deviation of a cubic from (n,) points [m]."""
    w = (x - x.mean()) / max(np.ptp(x) / 2, 1e-9)
    A, one = np.vander(w, 4), np.ones((len(x), 1))
    solution = linprog(
        [0, 0, 0, 0, 1],
        A_ub=np.block([[A, -one], [-A, -one]]),
        b_ub=np.append(y, -y),
        bounds=[(None, None)] * 4 + [(0, None)],
        method="highs",
    )
    return float(solution.x[4])


class View:
    """Line as a function y(x), as a car sees it from its mean pose."""

    def __init__(self, local: Array, nearest: int) -> None:
        steps = np.diff(local, axis=0)
        along = steps[:, 0] >= np.cos(TURN) * np.hypot(*steps.T)
        self.is_seen = bool(along[nearest])
        across = np.flatnonzero(~along)
        first = across[across < nearest].max(initial=-1) + 1
        last = across[across > nearest].min(initial=len(steps))
        self.x, self.y = local[first : last + 1].T
        self.low, self.high = max(WINDOW[0], self.x[0]), min(WINDOW[1], self.x[-1])

    def holds(self, low: float, high: float) -> bool:
        """Return whether a cubic follows the line from low to high within ``MAX_MISFIT``."""
        inside = self.x[(self.x > low) & (self.x < high)]
        if len(inside) > 60:
            inside = inside[np.linspace(0, len(inside) - 1, 60).astype(int)]
        x = np.union1d(np.linspace(low, high, 61), inside)
        y = np.interp(x, self.x, self.y)
        squares = np.polynomial.Polynomial.fit(x, y, 3)
        return np.abs(squares(x) - y).max() <= MAX_MISFIT or chebyshev_misfit(x, y) <= MAX_MISFIT

    def farthest(self, low: float, least: float) -> float:
        """Return how far a cubic follows the line from low, at least to ``least`` [m]."""
        if self.holds(low, self.high):
            return self.high
        inner, outer = least, self.high
        while outer - inner > 0.1:
            middle = (inner + outer) / 2
            inner, outer = (middle, outer) if self.holds(low, middle) else (inner, middle)
        return inner

    def longest(self, known: float) -> float:
        """Return the longest range about the car that a cubic follows, at least ``known`` [m]."""
        car, best = min(max(0.0, self.low), self.high), known
        for begin in np.linspace(car, self.low, 11 if self.low < car else 1):
            end = max(begin + best + 0.1, car)
            if end < self.high and self.holds(begin, end):
                best = self.farthest(begin, end) - begin
            elif end >= self.high > begin + best and self.holds(begin, self.high):
                best = self.high - begin
        return float(best)


def over_the_wire(codec: Codec, line: MapLine) -> MapLine | None:
    """Return a line as a receiver gets it; None if it is not usable."""
    decoder, received = codec.decoder(), None
    for frame in codec.encode(line):
        received = decoder.feed(frame.can_id, frame.data, t_ns=0)
    return received if isinstance(received, MapLine) and received.is_usable else None


class Settings(NamedTuple):
    """What is measured."""

    lines: int
    draws: int
    ranges: int  #: lines of which the limit of the range is computed
    map_error: bool
    codec: Codec | None


def measure(shape: str, sigma: Any, settings: Settings, seed: int, step: Callable[[], Any]) -> Any:
    """Return the figures of one shape of road and one pose."""
    tally = Tally()
    same: list[float] = []
    longest: list[float] = []
    visible = refused_visible = at_car = not_at_car = 0
    for number in range(settings.lines):
        step()
        rng = np.random.default_rng([seed, list(SHAPES).index(shape), number])
        points, pose, is_reversed = random_case(shape, rng)
        local = seen_from(points, pose[None])[0]
        if is_oncoming(local):  # a road that crosses itself
            points, local, is_reversed = points[::-1], local[::-1], not is_reversed
        nearest, s = place_of(local)
        view = View(local, nearest)
        poses = Poses.about(pose, sigma, settings.draws, rng)
        ego = Gaussian(pose, poses.cov)
        line = given(points[:: -1 if is_reversed else 1], ego, settings)
        is_given = isinstance(line, MapLine)
        tally.count(local, s, line if isinstance(line, str) else "given")
        is_visible = view.is_seen and view.low <= 0 and view.high >= AHEAD
        visible += is_visible
        refused_visible += is_visible and not is_given
        if not isinstance(line, MapLine):
            continue
        is_at_car = view.is_seen and view.low <= -AT_CAR and view.high >= AT_CAR
        at_car += is_at_car
        not_at_car += is_at_car and not line.x_min <= 0 <= line.x_max
        length = line.x_max - line.x_min
        if view.is_seen and number < settings.ranges and length > 0:
            begin = max(line.x_min, view.low)
            same.append(length / max(view.farthest(begin, begin + 0.5 * length) - begin, length))
            longest.append(length / max(view.longest(length / same[-1]), length))
        tally.evaluate(line, points, s, partial(seen, poses=poses, settings=settings))
    return {
        "lines": settings.lines,
        "refused in view": refused_visible / max(visible, 1),
        "not at the car": not_at_car / max(at_car, 1),
        **tally.figures(),
        "ratio, same x_min": quantiles(same),
        "ratio, any x_min": quantiles(longest),
    }


def given(points: Array, ego: Gaussian, settings: Settings) -> MapLine | str:
    """Return the line that is sent, or the reason for which it is not."""
    slot = Slot.EGO_LEFT
    error = MAP_ERROR if settings.map_error else None
    lines = map_lines({slot: Polyline(points)}, ego, window=WINDOW, map_error=error)
    if not lines:
        return lines.left_out[slot].name
    if settings.codec is None:
        return lines[0]
    return over_the_wire(settings.codec, lines[0]) or "OUT_OF_RANGE"


def seen(points: Array, poses: Poses, settings: Settings) -> Array:
    """Return the (D, n, 2) true points as seen from a draw of the poses."""
    return poses.see(drawn(points, poses.mean, settings, poses.rng))


def drawn(points: Array, pose: Array, settings: Settings, rng: Any) -> Array:
    """Return the (n, 2) points, or with a map error (D, n, 2) draws of the true ones."""
    if not settings.map_error:
        return points
    draws = settings.draws
    turn = MAP_ERROR.heading_sigma * rng.standard_normal(draws)
    about_car = seen_from(points, np.column_stack([np.tile(pose[:2], (draws, 1)), turn]))
    common = MAP_ERROR.offset_sigma * rng.standard_normal((draws, 1, 2))
    local = MAP_ERROR.point_sigma * rng.standard_normal(about_car.shape)
    return about_car + pose[:2] + common + local


def missed_ratios(name: str, row: Any) -> Iterator[str]:
    """Yield the ratios of the ranges to their limits that are too small."""
    for which in ("ratio, same x_min", "ratio, any x_min"):
        for value, bound, what in zip(row[which], RATIO, ("median", "5 %"), strict=False):
            if value < bound:
                yield f"{name}: {which}: the {what} is {value:.2f}"


def show(title: str, rows: Any) -> None:
    """Print the figures of a pose as a table."""
    print(
        f"\n{title}\n{'':16} refused in view  no x=0  {HEADINGS[0]}  ratio, same   any x_min\n"
        f"{'':42}{HEADINGS[1]}   50 %  5 %   50 %  5 %"
    )
    for name, row in rows.items():
        ratios = " ".join(
            f"{row[which][0]:6.2f}{row[which][1]:5.2f}" if row[which] else f"{'-':>11}"
            for which in ("ratio, same x_min", "ratio, any x_min")
        )
        lost = "".join(
            f"{row[key]:8.1%}" for key in ("refused", "refused in view", "not at the car")
        )
        print(f"{name:16}{lost}  {cells(row)} {ratios}")


def main(argv: list[str] | None = None) -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument("--seed", type=int, default=1, help="seed of the roads and of the draws")
    parser.add_argument("-n", "--lines", type=int, default=1000, help="lines of each shape")
    parser.add_argument("--draws", type=int, default=10, help="poses drawn for each line and x")
    parser.add_argument(
        "--ranges", type=int, default=100, help="lines of each shape whose limit is computed"
    )
    parser.add_argument("--quick", action="store_true", help="20 lines of each shape")
    parser.add_argument("--shape", action="append", choices=SHAPES, help="can be repeated")
    parser.add_argument("--pose", action="append", choices=POSES, help="can be repeated")
    parser.add_argument("--map-error", action="store_true", help="with a map error")
    parser.add_argument("--wire", action="store_true", help="encoded and decoded")
    arguments = parser.parse_args(argv)
    result, misses = evidence(arguments)
    if arguments.json:
        print(json.dumps(result | {"missed": misses}, indent=2))
    else:
        for name, rows in result.items():
            show(f"{name} pose: sigma {POSES[name]} (m, m, deg)", rows)
        print("", *(misses or ["All bounds are met."]), sep="\n")
    return 1 if misses else 0


def evidence(arguments: argparse.Namespace) -> tuple[dict[str, Any], list[str]]:
    """Return the figures by pose and shape, and the bounds that they miss."""
    settings = Settings(
        20 if arguments.quick else arguments.lines,
        arguments.draws,
        3 if arguments.quick else arguments.ranges,
        arguments.map_error,
        Codec.from_dbc() if arguments.wire else None,
    )
    shapes, poses = arguments.shape or SHAPES, arguments.pose or POSES
    result: dict[str, Any] = {}
    misses: list[str] = []
    with bar(settings.lines * len(shapes) * len(poses), unit=" lines", leave=False) as progress:
        for pose_name in poses:
            result[pose_name] = {}
            for shape in shapes:
                progress.set_description(f"{pose_name}, {shape}")
                sigma = POSES[pose_name]
                row = measure(shape, sigma, settings, arguments.seed, progress.update)
                result[pose_name][shape] = row
                name = f"MISSED  {pose_name}, {shape}"
                if pose_name == "production":
                    misses += [*missed(name, row, RMS), *missed_ratios(name, row)]
                else:
                    misses += missed(name, row)
    return result, misses


if __name__ == "__main__":
    sys.exit(main())
