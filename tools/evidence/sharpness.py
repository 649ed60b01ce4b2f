"""What the points of a map tell of a line: how sharp its band is, how true and how far.

The pose is known nearly exactly, so that the map alone speaks. Points are 1 m to 30 m apart along
the true line, from a random phase on, or those that Douglas and Peucker's algorithm leaves. Their
errors are white or last for some metres, in both coordinates, and are stated as errors of the
points, as drift (offset and heading), or not at all.

given       share of the lines that are given
reach       x_max in the median
rms, sigma  rms of the error of y and median of its standard deviation, each 5 m of the range; at
            20 m both as rms
beyond 3 sigma, ratio
            share of these errors, and rms of the error over its standard deviation
2nd, 3rd    second differences over 10 m, those that end at x_max, and third differences over 5 m:
            shares beyond 3 sigma

A line that does not cross x counts as beyond 3 sigma.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np

from maplines_can import Gaussian, MapLine, map_lines
from maplines_can.values.line import lateral_jacobian

from .figures import Rms, Share
from .harness import bar, evidence
from .roads import maps_of
from .sampled_lines import ROADS, Case, Row, TrueLine, cases_of, lasting_rows, on_map, on_road, rows
from .witness import Array

#: A pose that is known nearly exactly.
EGO = Gaussian(np.zeros(3), np.diag([1e-8, 1e-8, 1e-10]))
#: Distance of the places of y, and of second and third differences [m].
PLACES, SECOND, THIRD = 5.0, 10.0, 5.0


class Errors:
    """Errors of weighted sums of lateral positions, and their standard deviations."""

    def __init__(self) -> None:
        self.lines = self.given = 0
        self.reach: list[float] = []
        self.pairs: dict[str, list[Array]] = {}

    def add(self, other: Errors) -> None:
        """Add those of others."""
        self.lines += other.lines
        self.given += other.given
        self.reach += other.reach
        for name, pairs in other.pairs.items():
            self.pairs.setdefault(name, []).extend(pairs)

    def put(
        self, name: str, line: MapLine, true: TrueLine, begins: Any, d: float, *w: float
    ) -> None:
        """Add sums with weights w of places d apart [m]."""
        x = np.asarray(begins)[:, None] + d * np.arange(len(w))
        error = (line.y(x) - true.y(x)) @ w
        J = np.einsum("k,fkp->fp", w, lateral_jacobian(line.gaussian.mean, x))
        sigma = np.sqrt(np.einsum("fi,ij,fj->f", J, line.gaussian.cov, J))
        self.pairs.setdefault(name, []).append(np.stack([error, sigma]))

    def evaluate(self, line: MapLine, true: TrueLine) -> None:
        """Add the sums of a line."""
        low, high = line.x_min, line.x_max
        self.given += 1
        self.reach.append(high)
        self.put("y", line, true, np.arange(low, high, PLACES), 0.0, 1.0)
        if low <= 20.0 <= high:
            self.put("20 m", line, true, [20.0], 0.0, 1.0)
        if high - low > 2 * SECOND:
            begins = np.arange(low, high - 2 * SECOND, SECOND)
            self.put("2nd", line, true, begins, SECOND, 1.0, -2.0, 1.0)
            self.put("2nd at the end", line, true, [high - 2 * SECOND], SECOND, 1.0, -2.0, 1.0)
        if high - low > 3 * THIRD:
            begins = np.arange(low, high - 3 * THIRD, THIRD)
            self.put("3rd", line, true, begins, THIRD, -1.0, 3.0, -3.0, 1.0)

    def figures(self) -> dict[str, Any]:
        """Return the figures by name."""
        n = self.given
        found: dict[str, Any] = {"given": Share(n / max(self.lines, 1), self.lines)}
        if not n:
            return found
        pairs = {name: np.concatenate(many, axis=1) for name, many in self.pairs.items()}
        error, sigma = pairs["y"]
        found["reach [m]"] = float(np.median(self.reach))
        found["rms [m]"] = rms(error)
        found["sigma [m]"] = float(np.median(sigma))
        found["beyond 3 sigma"] = beyond(pairs["y"], n)
        found["ratio"] = Rms(rms(error / sigma), n)
        for name in ("2nd", "2nd at the end", "3rd"):
            found[name] = beyond(pairs[name], n) if name in pairs else None
        for name, values in zip(
            ("rms at 20 m [m]", "sigma at 20 m [m]"), pairs.get("20 m", ()), strict=False
        ):
            found[name] = rms(values)
        return found


def rms(values: Array) -> float:
    """Return the root mean square of values that are there."""
    return float(np.sqrt(np.nanmean(values**2)))


def beyond(pairs: Array, cases: int) -> Share:
    """Return the share of errors beyond 3 sigma."""
    error, sigma = pairs
    return Share(float((~(np.abs(error) <= 3 * sigma)).mean()), cases)


def sources(paths: Sequence[str], roads: Sequence[str]) -> dict[str, Any]:
    """Return what draws a case, of roads with closed forms and of maps, by name."""
    return {name: partial(on_road, name) for name in roads if name} | {
        name: partial(on_map, found) for name, found in maps_of(paths).items()
    }


@evidence(n=6, spacings=(1.0, 5.0, 15.0), noises=(0.0, 0.05), lasting=(), tolerances=(0.05,))
def sharpness(
    n: int = 60,
    maps: tuple[str, ...] = (),
    roads: tuple[str, ...] = tuple(ROADS),
    spacings: tuple[float, ...] = (1.0, 2.0, 5.0, 10.0, 15.0, 30.0),
    noises: tuple[float, ...] = (0.0, 0.02, 0.05, 0.1, 0.2),
    stated: tuple[str, ...] = ("nothing", "points", "drift"),
    lasting: tuple[float, ...] = (0.05, 0.1),
    tolerances: tuple[float, ...] = (0.05, 0.1),
    seed: int = 2,
) -> dict[str, Any]:
    """Compare lines of map_lines with true ones, by spacing and noise of their points.

    Args:
        n: cases of each road and map, with the two lines of a lane each.
        maps: folders and files of maps.
        roads: with closed forms; an empty text for none.
        spacings: of the points [m].
        noises: white, of the points [m].
        stated: of the errors: nothing, points (the same), drift (of noise that lasts).
        lasting: noises that last for 5 m and 20 m, with points 2 m and 5 m apart [m].
        tolerances: of Douglas and Peucker's algorithm [m].
        seed: of the cases and of the errors.
    """
    every = [
        *rows(spacings, noises, stated),
        *lasting_rows((2.0, 5.0), lasting, stated),
        *(Row(0.0, tolerance=t, stated=s) for t in tolerances for s in stated if s != "drift"),
    ]
    groups, result = sources(maps, roads), dict[str, Any]()
    totals = {kind_of(name): {row: Errors() for row in every} for name in groups}
    with bar(len(groups) * len(every), "sharpness") as shown:
        for place, (name, draw) in enumerate(groups.items()):
            cases, result[name] = cases_of(draw, n, [seed, place]), {}
            for row in every:
                errors = of_row(row, cases, seed)
                totals[kind_of(name)][row].add(errors)
                result[name][str(row)] = errors.figures()
                shown.update()
    for kind, total in totals.items():
        result[f"all {kind}"] = {str(row): errors.figures() for row, errors in total.items()}
    return result


def kind_of(name: str) -> str:
    """Return the kind of a source: closed forms, or the format of a map."""
    return "closed forms" if name in ROADS else "Lanelet2" if ".osm" in name else "OpenDRIVE"


def of_row(row: Row, cases: Sequence[Case], seed: int) -> Errors:
    """Return the errors of the lines of cases."""
    errors = Errors()
    for number, case in enumerate(cases):
        rng = np.random.default_rng([seed, number])
        points = {slot: row.points(line, rng) for slot, line in case.items()}
        errors.lines += len(case)
        for line in map_lines(points, EGO, map_error=row.error):
            errors.evaluate(line, case[line.slot])
    return errors
