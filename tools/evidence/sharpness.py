"""What the points of a map tell of a line: how sharp its band is, how true and how far.

The pose is known nearly exactly, so that the map alone speaks. Points are 1 m to 30 m apart along
the true line, from a random phase on, or those that Douglas and Peucker's algorithm leaves. Their
errors are white or last for some metres, in both coordinates, and are stated as errors of the
points, as drift (offset and heading), or not at all.

given       share of the lines that are given
reach       x_max in the median
rms, sigma  rms of the error of y and median of its standard deviation, each 5 m of the range
beyond 3 sigma, ratio
            share of these errors, and rms of the error over its standard deviation
2nd, 3rd    second differences over 10 m and third differences over 5 m: shares beyond 3 sigma

A line that does not cross x counts as beyond 3 sigma.
"""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from maplines_can import Gaussian, MapLine, Polyline, Slot, map_lines
from maplines_can.values.line import lateral_jacobian

from .figures import Rms, Share
from .harness import bar, evidence, progress
from .sampled_lines import ROADS, STATED, Case, Row, TrueLine, cases_of, kind_of, rows_of
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

    def put(self, name: str, line: MapLine, true: TrueLine, begins: Any, d: float, w: Any) -> None:
        """Add sums with weights w of places d apart [m]."""
        x = np.asarray(begins)[:, None] + d * np.arange(len(w))
        error = (line.y(x) - true.y(x)) @ w
        J = np.einsum("k,fkp->fp", w, lateral_jacobian(line.gaussian.mean, x))
        sigma = np.sqrt(np.einsum("fi,ij,fj->f", J, line.gaussian.cov, J))
        self.pairs.setdefault(name, []).append(np.stack([error, sigma]))

    def evaluate(self, line: MapLine, true: TrueLine) -> None:
        """Add the sums of a line."""
        self.given += 1
        self.reach.append(line.x_max)
        for name, step, d, w in (
            ("y", PLACES, 0.0, (1.0,)),
            ("2nd", SECOND, SECOND, (1.0, -2.0, 1.0)),
            ("3rd", THIRD, THIRD, (-1.0, 3.0, -3.0, 1.0)),
        ):
            begins = np.arange(line.x_min, line.x_max - d * (len(w) - 1), step)
            if len(begins):
                self.put(name, line, true, begins, d, w)

    def figures(self) -> dict[str, Any]:
        """Return the figures by name."""
        n = self.given
        found: dict[str, Any] = {"given": Share(n / max(self.lines, 1), self.lines)}
        if not n:
            return found
        pairs = {name: np.concatenate(many, axis=1) for name, many in self.pairs.items()}
        error, sigma = pairs["y"]
        return found | {
            "reach [m]": float(np.median(self.reach)),
            "rms [m]": rms(error),
            "sigma [m]": float(np.median(sigma)),
            "beyond 3 sigma": beyond(pairs["y"], n),
            "ratio": Rms(rms(error / sigma), n),
            **{name: beyond(pairs[name], n) if name in pairs else None for name in ("2nd", "3rd")},
        }


def rms(values: Array) -> float:
    """Return the root mean square of values that are there."""
    return float(np.sqrt(np.nanmean(values**2)))


def beyond(pairs: Array, cases: int) -> Share:
    """Return the share of errors beyond 3 sigma."""
    error, sigma = pairs
    return Share(float((~(np.abs(error) <= 3 * sigma)).mean()), cases)


def sampled(case: Case, row: Row, seed: Any) -> dict[Slot, Polyline]:
    """Return the lines of a case as a map has them."""
    rng = np.random.default_rng(seed)
    return {slot: row.points(line, rng) for slot, line in case.items()}


@evidence
def lines(
    n: int = 60,
    maps: tuple[str, ...] = (),
    roads: tuple[str, ...] = tuple(ROADS),
    spacings: tuple[float, ...] = (1.0, 2.0, 5.0, 10.0, 15.0, 30.0),
    noises: tuple[float, ...] = (0.0, 0.02, 0.05, 0.1, 0.2),
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
        lasting: noises that last for 5 m and 20 m, with points 2 m and 5 m apart [m].
        tolerances: of Douglas and Peucker's algorithm [m].
        seed: of the cases and of the errors.
    """
    every = [
        *rows_of(spacings, noises, (0.0,), STATED[:2]),
        *rows_of((2.0, 5.0), lasting, (5.0, 20.0), STATED),
        *(Row(0.0, tolerance=t, stated=s) for t in tolerances for s in STATED[:2]),
    ]
    groups, result = cases_of(maps, roads, n, seed), dict[str, Any]()
    totals = {kind_of(name): {row: Errors() for row in every} for name in groups}
    with bar(len(groups) * len(every), "lines") as shown:
        for (name, cases), row in product(groups.items(), every):
            errors = Errors()
            for number, case in enumerate(cases):
                errors.lines += len(case)
                points = sampled(case, row, [seed, number])
                for line in map_lines(points, EGO, map_error=row.error):
                    errors.evaluate(line, case[line.slot])
            totals[kind_of(name)][row].add(errors)
            result.setdefault(name, {})[str(row)] = errors.figures()
            shown.update()
    for kind, total in totals.items():
        result[f"all {kind}"] = {str(row): errors.figures() for row, errors in total.items()}
    return result


# ---- beyond the range --------------------------------------------------------------------------


#: Distances beyond an end of the range at which an extrapolated line is compared [m].
BEYOND = np.array([1.0, 2.0, 5.0, 10.0, 20.0, 40.0])
#: Windows of the lines: their ranges end with them, or before [m].
WINDOWS = ((-20.0, 80.0), (-20.0, 30.0), (-10.0, 12.0))


@evidence
def extrapolated(
    n: int = 100,
    maps: tuple[str, ...] = (),
    roads: tuple[str, ...] = tuple(ROADS),
    seed: int = 2,
) -> dict[str, Any]:
    """Compare MapLine.y_extrapolated with true lines beyond both ends of the range.

    "cut" are ends that are not those of the window: the map, or what a cubic follows, ends there.
    Where a true line ends or turns back, nothing is compared. The options are those of "lines".
    """
    found: dict[str, dict[str, list[Array]]] = {}
    counts: dict[str, int] = {}
    for name, cases in progress(cases_of(maps, roads, n, seed).items(), "extrapolated"):
        kind = kind_of(name)
        counts[kind] = counts.get(kind, 0) + len(cases)
        for (number, case), window in product(enumerate(cases), WINDOWS):
            points = sampled(case, Row(1.0), [seed, number])
            for line in map_lines(points, EGO, window=window):
                add_beyond(line, case[line.slot], window, found.setdefault(kind, {}))
    return {
        f"all {kind}": {
            ends: beyond(np.concatenate(pairs, axis=1), counts[kind])
            for ends, pairs in of_kind.items()
        }
        for kind, of_kind in found.items()
    }


def add_beyond(
    line: MapLine, true: TrueLine, window: tuple[float, float], pairs: dict[str, list[Array]]
) -> None:
    """Add the errors beyond both ends of a line, and their standard deviations."""
    for x, is_cut in (
        (line.x_min - BEYOND, line.x_min > window[0]),
        (line.x_max + BEYOND, line.x_max < window[1]),
    ):
        value, sigma = line.y_extrapolated(x)
        error = value - true.y(x)
        pair = np.stack([error, sigma])[:, np.isfinite(error)]
        for name in ["all ends"] + ["cut ends"] * is_cut:
            pairs.setdefault(name, []).append(pair)
