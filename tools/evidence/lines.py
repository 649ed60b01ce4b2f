"""Whether the Gaussian of a line is true at each x, and of more than one x at a time.

The sums are of lateral positions: y at 0, 20 and 40 m and at the ends of the range, slopes
(y(x + d) - y(x))/d, second differences y(x) - 2 y(x + d) + y(x + 2 d), and the curvature averaged
over 10 m, (y(-5) - 2 y(0) + y(5))/25 about the car and (y(0) - 2 y(5) + y(10))/25 ahead of it. The
first of these two is the parameter c0 of the mean. For two lines of a scene there are the same sums
of their difference, the width. z is that of the true line less that of the mean, in units of the
stated standard deviation.

A true line is the points of a random road, or those of a map, seen from a pose that is drawn from
the stated Gaussian, where they cross x. A line that ends before x counts as beyond 3 sigma.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from itertools import product
from typing import Any, Literal, NamedTuple

import numpy as np

from maplines_can import (
    Gaussian,
    MapError,
    MapLine,
    Polyline,
    Slot,
    map_lines,
    map_scene,
)
from maplines_can.propagation.from_map import MAX_SIGMA, Query
from maplines_can.propagation.refit import MAX_MISFIT, Refit
from maplines_can.values.line import lateral_jacobian

from .harness import evidence, progress
from .roads import SHAPES, Draw, maps_of, on_map, on_roads
from .sums import SIGMA_AT, Given, Tally
from .witness import (
    AHEAD,
    POSES,
    WINDOW,
    Array,
    Poses,
    crossings,
    erred,
    is_oncoming,
    near_points,
    place_of,
    seen_from,
)


@evidence
def lines(
    n: int = 25,
    maps: tuple[str, ...] = (),
    shapes: tuple[str, ...] = tuple(SHAPES),
    by: Literal["line", "scene"] = "line",
    poses: tuple[str, ...] = tuple(POSES),
    map_error: tuple[float, ...] = (0.0, 0.05),
    draws: int = 10,
    seed: int = 1,
) -> dict[str, Any]:
    """Compare the Gaussian of lines with true ones, on random roads and on maps.

    Args:
        n: cases of two lines of each shape, or of up to four of each map.
        maps: folders and files of maps.
        shapes: of random roads; an empty text for none.
        by: how a consumer gets lines: one by one of map_lines, or jointly of map_scene.
        poses: errors of the car's pose.
        map_error: independent error of each point [m].
        draws: poses drawn for each case.
        seed: of the cases and of the draws.
    """
    groups: dict[str, dict[str, Draw]] = {
        "all maps": {name: on_map(found) for name, found in maps_of(maps).items()},
        "all roads": {shape: on_roads([shape], 2) for shape in shapes if shape},
    }
    result: dict[str, Any] = {}
    for pose, sigma in product(poses, map_error):
        title = f"{by}, {pose} pose, map error {sigma:g} m"
        rows = result[title] = {}
        for whole, group in groups.items():
            total = Tally()
            for place, (name, draw) in enumerate(progress(group.items(), title, len(group))):
                tally = Tally()
                for number in range(n):
                    rng = np.random.default_rng([seed, place, number])
                    case = Case.drawn(*draw(number, rng), POSES[pose], sigma, draws, rng)
                    case.measure(by, tally)
                total.add(tally)
                rows[name] = tally.figures()
            if group:
                rows[whole] = total.figures()
    return result


class Got(NamedTuple):
    """Lines that a consumer has jointly."""

    slots: list[Slot]
    given: Given


class Case(NamedTuple):
    """True lines around a mean pose, and what a map says of them."""

    true: Mapping[Slot, Array]  #: (n, 2) points in the direction of the car
    lines: Mapping[Slot, Polyline]  #: as the product gets them
    ego: Gaussian
    poses: Array  #: (D, 3) true ones
    error: MapError | None  #: that is stated

    @classmethod
    def drawn(
        cls,
        lines: Mapping[Slot, Polyline],
        pose: Array,
        sigma: tuple[float, float, float],
        point_sigma: float,
        draws: int,
        rng: np.random.Generator,
    ) -> Case:
        """Return a case with errors of the points [m] and with so many poses."""
        error = MapError(point_sigma) if point_sigma else None
        true = {
            slot: line.points[::-1]
            if is_oncoming(seen_from(line.points, pose[None])[0])
            else line.points
            for slot, line in lines.items()
        }
        about = Poses.about(pose, sigma, draws, rng)
        given = {
            slot: Polyline(erred(points, pose, error, 1, rng)[0]) for slot, points in true.items()
        }
        every = about.draw() if true else np.zeros((0, 3))
        return cls(true, given, Gaussian(pose, about.cov), every, error)

    def measure(self, by: str, tally: Tally) -> None:
        """Add what a consumer has of the lines."""
        if not self.true:
            return
        excess = excess_covs(self.lines, self.ego, self.error) if by == "line" else {}
        there = set[Slot]()
        for got in WAYS[by](self):
            there |= {*got.slots}
            tally.counts["lines"] += len(got.slots)
            near = [near_points(self.true[slot], self.ego.mean) for slot in got.slots]
            views = [(seen_from(points, self.poses), s) for points, s in near]
            tally.evaluate(got.given, lambda i, x: crossings(*views[i], x))  # noqa: B023
            if by == "line":
                compare_sigma(got.given, excess[got.slots[0]], tally)
        for slot, points in self.true.items():
            local = seen_from(points, self.ego.mean[None])[0]
            _, s = place_of(local)
            reach = s[(s >= 0) & (np.hypot(*local.T) <= WINDOW[1])].max(initial=0.0)
            tally.counts["ahead"] += reach >= AHEAD
            tally.counts["refused"] += reach >= AHEAD and slot not in there


def compare_sigma(given: Given, excess: Array, tally: Tally) -> None:
    """Add ratios of the sigmas of y to those with the misfit in the variance of y_off alone."""
    (low, high), mean, cov = given.ranges[0], given.means[0], given.cov
    for x in (x for x in SIGMA_AT if low <= x <= high):
        g = lateral_jacobian(mean, x)
        variance = float(g @ cov @ g)
        rest = max(variance - float(g @ excess @ g), 1e-12)
        tally.put(f"sigma ratio at {x:g} m", float(np.sqrt(variance / rest)))


def excess_covs(
    lines: Mapping[Any, Polyline], ego: Gaussian, error: MapError | None
) -> dict[Any, Array]:
    """Return what covariances have beyond a misfit in the variance of y_off alone, by slot.

    A refit without a limit of the misfit has the part of the covariance that is due to the map
    alone.
    """
    slots, refit, *_ = Query(lines, ego, WINDOW, error, MAX_MISFIT, MAX_SIGMA).fitted()
    covs = {}
    for i, slot in enumerate(slots):
        window = tuple(refit.x_range[i].tolist())
        of_map = Refit(lines[slot], ego.mean, window, error, max_misfit=np.inf).noise_cov
        cov = np.asarray(refit.noise_cov)[i] - (0.0 if of_map is None else of_map)
        cov[0, 0] -= refit.misfit[i] ** 2
        covs[slot] = cov
    return covs


# ---- ways by which a consumer gets lines -------------------------------------------------------


def given_of(line: MapLine) -> Given:
    """Return what a consumer has of a single line."""
    ranges = np.array([[line.x_min, line.x_max]])
    return Given(line.gaussian.mean[None], np.asarray(line.gaussian.cov), ranges)


def single(case: Case) -> Iterator[Got]:
    """Yield the lines of ``map_lines``, one by one."""
    for line in map_lines(case.lines, case.ego, window=WINDOW, map_error=case.error):
        yield Got([line.slot], given_of(line))


def scene(case: Case) -> Iterator[Got]:
    """Yield the joint distribution of the lines of ``map_scene``."""
    found = map_scene(case.lines, case.ego, window=WINDOW, map_error=case.error)
    if found.lines:
        slots = [line.slot for line in found.lines]
        joint = found.joint(slots)
        ranges = np.array([[line.x_min, line.x_max] for line in found.lines])
        yield Got(slots, Given(joint.mean.reshape(-1, 4), joint.cov, ranges))


#: What a consumer has of a case, by name.
WAYS: dict[str, Callable[[Case], Iterator[Got]]] = {"line": single, "scene": scene}
