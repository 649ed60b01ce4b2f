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

falls       share of the steps from a stated error to the next larger one in which the sigma of y
            falls, by more than rounding, at 0, 20 or 40 m, and the largest fall
frames, left out
            frames of a scene with its pose error over the lines sent, and share of its lines that
            the encoder leaves out, by the error of the pose and the kind of records
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np

from maplines_can import Gaussian, MapError, MapLine, Polyline, Slot, map_lines, map_scene
from maplines_can.values.line import lateral_jacobian

from .figures import Rms, Share
from .harness import bar, evidence
from .roads import maps_of
from .sampled_lines import (
    LANE,
    ROADS,
    STATED,
    Case,
    Row,
    TrueLine,
    cases_of,
    lasting_rows,
    of_map,
    on_map,
    on_road,
    rows,
)
from .scenes import RECORDS
from .ways import as_given, codec, predicted, sent
from .witness import POSES, Array

#: A pose that is known nearly exactly.
EGO = Gaussian(np.zeros(3), np.diag([1e-8, 1e-8, 1e-10]))
#: How a consumer gets a line.
WAYS = {"line": as_given, "wire": sent, "predicted": predicted}
#: Poses that are drawn for a predicted line, and the distance of the points that they see [m].
DRAWS, DENSE = 10, 0.2
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
def lines(
    n: int = 60,
    maps: tuple[str, ...] = (),
    roads: tuple[str, ...] = tuple(ROADS),
    spacings: tuple[float, ...] = (1.0, 2.0, 5.0, 10.0, 15.0, 30.0),
    noises: tuple[float, ...] = (0.0, 0.02, 0.05, 0.1, 0.2),
    stated: tuple[str, ...] = STATED,
    lasting: tuple[float, ...] = (0.05, 0.1),
    tolerances: tuple[float, ...] = (0.05, 0.1),
    by: Literal["line", "wire", "predicted"] = "line",
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
        by: how a consumer gets lines: as given, over the wire, or predicted by 1 s and 12 m.
        seed: of the cases and of the errors.
    """
    every = [
        *rows(spacings, noises, stated),
        *lasting_rows((2.0, 5.0), lasting, stated),
        *(Row(0.0, tolerance=t, stated=s) for t in tolerances for s in stated if s != "drift"),
    ]
    groups, result = sources(maps, roads), dict[str, Any]()
    totals = {kind_of(name): {row: Errors() for row in every} for name in groups}
    with bar(len(groups) * len(every), "lines") as shown:
        for place, (name, draw) in enumerate(groups.items()):
            cases, result[name] = cases_of(draw, n, [seed, place]), {}
            for row in every:
                errors = of_row(row, cases, by, seed)
                totals[kind_of(name)][row].add(errors)
                result[name][str(row)] = errors.figures()
                shown.update()
    for kind, total in totals.items():
        result[f"all {kind}"] = {str(row): errors.figures() for row, errors in total.items()}
    return result


def kind_of(name: str) -> str:
    """Return the kind of a source: closed forms, or the format of a map."""
    return "closed forms" if name in ROADS else "Lanelet2" if ".osm" in name else "OpenDRIVE"


def of_row(row: Row, cases: Sequence[Case], by: str, seed: int) -> Errors:
    """Return the errors of the lines of cases."""
    errors = Errors()
    for number, case in enumerate(cases):
        rng = np.random.default_rng([seed, number])
        errors.lines += len(case)
        for line in map_lines(sampled(case, row, rng), EGO, map_error=row.error):
            carry(line, case[line.slot], by, rng, errors)
    return errors


def sampled(case: Case, row: Row, rng: np.random.Generator) -> dict[Slot, Polyline]:
    """Return the lines of a case as a map has them."""
    return {slot: row.points(line, rng) for slot, line in case.items()}


def carry(line: MapLine, true: TrueLine, by: str, rng: Any, errors: Errors) -> None:
    """Add the errors of what a consumer has of a line."""
    got, poses = WAYS[by](line, np.zeros((DRAWS + 1, 3)), rng)
    if got is None:
        return
    errors.given += 1
    errors.reach.append(got.x_max)
    if by != "predicted":
        errors.evaluate(got, true)
        return
    points = true.places(np.arange(true.begin, true.end, DENSE))
    for pose in poses[:-1]:
        errors.evaluate(got, of_map(points, pose))


# ---- the stated error --------------------------------------------------------------------------


@evidence(n=4, spacings=(2.0, 15.0), noises=(0.05,))
def monotone(
    n: int = 40,
    maps: tuple[str, ...] = (),
    roads: tuple[str, ...] = tuple(ROADS),
    spacings: tuple[float, ...] = (1.0, 2.0, 5.0, 10.0, 15.0, 30.0),
    noises: tuple[float, ...] = (0.0, 0.02, 0.05, 0.1, 0.2),
    stated: tuple[float, ...] = (0.0, 0.02, 0.05, 0.1, 0.2),
    plot: Path | None = None,
    seed: int = 2,
) -> dict[str, Any]:
    """Compare the sigma of y of the same points with different stated errors of these.

    Args:
        n: cases of each road and map, with the two lines of a lane each.
        maps: folders and files of maps.
        roads: with closed forms; an empty text for none.
        spacings: of the points [m].
        noises: white, of the points [m].
        stated: errors of the points [m]; 0 for none.
        plot: picture of the sigma at 20 m to write; it needs the extra plot.
        seed: of the cases and of the errors.
    """
    every = {
        name: cases_of(draw, n, [seed, place])
        for place, (name, draw) in enumerate(sources(maps, roads).items())
    }
    kinds = [*product(spacings, noises)]
    result: dict[str, Any] = {}
    with bar(len(kinds) * len(every), "monotone") as shown:
        for spacing, noise in kinds:
            found = []
            for cases in every.values():
                found.append(stated_pairs(Row(spacing, noise), cases, stated, seed))
                shown.update()
            result[str(Row(spacing, noise))] = by_stated(np.concatenate(found, axis=1), stated)
    if plot is not None:
        from .pictures import draw_stated

        draw_stated(result, stated, plot)
    return result


def stated_pairs(row: Row, cases: Sequence[Case], stated: Sequence[float], seed: int) -> Array:
    """Return the (lines, stated, 3) errors of y at 0, 20 and 40 m, and their sigmas [m].

    They are NaN beyond the range, and where there is no line.
    """
    x = np.array([0.0, 20.0, 40.0])
    found = np.full((2, len(cases), len(LANE), len(stated), len(x)), np.nan)
    for number, case in enumerate(cases):
        points = sampled(case, row, np.random.default_rng([seed, number]))
        for k, sigma in enumerate(stated):
            error = MapError(point_sigma=sigma) if sigma else None
            for line in map_lines(points, EGO, map_error=error):
                own = np.stack([line.y(x) - case[line.slot].y(x), line.y_sigma(x)])
                own[:, (x < line.x_min) | (x > line.x_max)] = np.nan
                found[:, number, LANE.index(line.slot), k] = own
    return found.reshape(2, -1, len(stated), len(x))


def by_stated(pairs: Array, stated: Sequence[float]) -> dict[str, Any]:
    """Return sigma and error at 20 m by the stated error, and how often and far sigmas fall."""
    names = [f"{100 * sigma:g} cm" if sigma else "nothing" for sigma in stated]
    error, sigma = pairs
    there = np.isfinite(sigma[:, :, 1])
    ratio = sigma[:, 1:] / sigma[:, :-1]
    ratio = ratio[np.isfinite(ratio)]
    medians, errors = [], []
    for k, have in enumerate(there.T):
        medians.append(float(np.median(sigma[have, k, 1])) if have.any() else None)
        errors.append(rms(error[have, k, 1]) if have.any() else None)
    return {
        "sigma at 20 m [m]": dict(zip(names, medians, strict=True)),
        "rms at 20 m [m]": dict(zip(names, errors, strict=True)),
        "falls": float((ratio < 1 - 1e-6).mean()) if ratio.size else None,
        "largest fall": float((1 - ratio).max(initial=0.0)),
    }


# ---- scenes ------------------------------------------------------------------------------------


#: Rows of which scenes are made.
OF_SCENES = (
    Row(1.0),
    Row(5.0),
    Row(15.0),
    Row(2.0, 0.05),
    Row(2.0, 0.05, stated="points"),
    Row(5.0, 0.05),
    Row(5.0, 0.05, stated="points"),
    Row(5.0, 0.1, stated="points"),
    Row(10.0, 0.05, stated="points"),
    Row(5.0, 0.1, 20.0, stated="drift"),
)


@evidence(n=3)
def scenes(
    n: int = 40,
    maps: tuple[str, ...] = (),
    roads: tuple[str, ...] = tuple(ROADS),
    seed: int = 2,
) -> dict[str, Any]:
    """Compare width and centre of the lane of map_scene with true ones, and count its frames.

    Args:
        n: scenes of each road and map.
        maps: folders and files of maps.
        roads: with closed forms; an empty text for none.
        seed: of the cases and of the errors.
    """
    groups = sources(maps, roads)
    result: dict[str, Any] = {}
    every = {name: cases_of(draw, n, [seed, i]) for i, (name, draw) in enumerate(groups.items())}
    kinds = list(dict.fromkeys(map(kind_of, every)))
    with bar(len(OF_SCENES) * len(every), "scenes") as shown:
        for row in OF_SCENES:
            scenes = {kind: LaneErrors() for kind in kinds}
            for name, cases in every.items():
                for number, case in enumerate(cases):
                    rng = np.random.default_rng([seed, number])
                    scenes[kind_of(name)].measure(sampled(case, row, rng), case, row.error)
                shown.update()
            for kind, errors in scenes.items():
                result.setdefault(f"all {kind}", {})[str(row)] = errors.figures()
    return result


def pose_of(sigma: tuple[float, float, float]) -> Gaussian:
    """Return a pose at the origin with sigmas along [m], across [m] and of the heading [deg]."""
    along, across, turn = sigma
    return Gaussian(np.zeros(3), np.diag([along, across, np.radians(turn)]) ** 2)


#: Poses of the scenes that are sent.
POSES_SENT = {"exact pose": EGO, "production pose": pose_of(POSES["production"])}


class LaneErrors:
    """Errors of width and centre of the lane of scenes, and what of these scenes is sent."""

    def __init__(self) -> None:
        self.scenes = 0
        self.pairs: dict[str, list[Array]] = {"width": [], "centre": []}
        self.sent: dict[str, list[tuple[int, int, int]]] = {}

    def measure(self, points: Mapping[Slot, Polyline], true: Case, error: MapError | None) -> None:
        """Add a scene: errors of a pose that is known, and frames with each pose."""
        for name, ego in POSES_SENT.items():
            scene = map_scene(points, ego, map_error=error)
            if not scene.lines:
                continue
            for records, dbc in RECORDS.items():
                encoder = codec(dbc).encoder()
                prepared = encoder.prepare_scene(scene)
                count = len(prepared.sent_slots)
                frames = sum(map(len, encoder.encode_scene(prepared).values())) if count else 0
                counts = frames, count, len(scene.lines)
                self.sent.setdefault(f"{name}, {records}", []).append(counts)
            if ego is EGO and len(scene.lines) == len(LANE):
                self.scenes += 1
                low, high = scene.x_range(LANE)
                x = np.arange(low, high, PLACES)
                left, right = (true[slot].y(x) for slot in LANE)
                for what, truth in (("width", left - right), ("centre", (left + right) / 2)):
                    estimate = getattr(scene, what)(x)
                    pair = np.stack([estimate.value - truth, estimate.sigma])
                    self.pairs[what].append(pair)

    def figures(self) -> dict[str, Any]:
        """Return the figures by name."""
        found: dict[str, Any] = {"scenes": self.scenes}
        for what, many in self.pairs.items():
            if many:
                pairs = np.concatenate(many, axis=1)
                error, sigma = pairs
                found[f"{what}, sigma [m]"] = float(np.median(sigma))
                found[f"{what}, beyond 3 sigma"] = beyond(pairs, self.scenes)
                found[f"{what}, ratio"] = Rms(rms(error / sigma), self.scenes)
        for name, counts in self.sent.items():
            frames, count, given = np.sum(counts, axis=0)
            found[f"{name}, frames a line"] = float(frames / max(count, 1))
            found[f"{name}, left out"] = Share(float(1 - count / given), int(given))
        return found


# ---- beyond the range --------------------------------------------------------------------------


#: Distances beyond an end of the range at which an extrapolated line is compared [m].
BEYOND = (1.0, 2.0, 5.0, 10.0, 20.0, 40.0)
#: Windows of the lines: their ranges end with them, or before [m].
WINDOWS = ((-20.0, 80.0), (-20.0, 30.0), (-10.0, 12.0))


@evidence(n=4)
def extrapolated(
    n: int = 100,
    maps: tuple[str, ...] = (),
    roads: tuple[str, ...] = tuple(ROADS),
    seed: int = 2,
) -> dict[str, Any]:
    """Compare MapLine.y_extrapolated with true lines beyond both ends of the range.

    "cut" are ends that are not those of the window: the map, or what a cubic follows, ends there.
    Where a true line ends or turns back, nothing is compared.

    Args:
        n: cases of each road and map, with the two lines of a lane each.
        maps: folders and files of maps.
        roads: with closed forms; an empty text for none.
        seed: of the cases and of the errors.
    """
    groups = sources(maps, roads)
    found: dict[str, dict[str, list[Array]]] = {}
    counts: dict[str, int] = {}
    with bar(len(groups), "extrapolated") as shown:
        for place, (name, draw) in enumerate(groups.items()):
            for number, case in enumerate(cases_of(draw, n, [seed, place])):
                points = sampled(case, Row(1.0), np.random.default_rng([seed, number]))
                counts[kind_of(name)] = counts.get(kind_of(name), 0) + 1
                for window in WINDOWS:
                    for line in map_lines(points, EGO, window=window):
                        of_kind = found.setdefault(kind_of(name), {})
                        add_beyond(line, case[line.slot], window, of_kind)
            shown.update()
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
    d = np.array(BEYOND)
    for x, is_cut in (
        (line.x_min - d, line.x_min > window[0]),
        (line.x_max + d, line.x_max < window[1]),
    ):
        value, sigma = line.y_extrapolated(x)
        error = value - true.y(x)
        known = np.isfinite(error)
        pair = np.stack([error, sigma])
        pairs.setdefault("all ends", []).append(pair[:, known])
        if is_cut:
            pairs.setdefault("cut ends", []).append(pair[:, known])
        for k in np.flatnonzero(known):
            pairs.setdefault(f"{d[k]:g} m beyond", []).append(pair[:, [k]])
