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
from dataclasses import replace
from functools import partial
from itertools import product
from typing import Any, Literal, NamedTuple

import numpy as np

from maplines_can import (
    Gaussian,
    MapError,
    MapLine,
    Motion,
    Polyline,
    Scene,
    Slot,
    map_lines,
    map_scene,
    predict_to,
)
from maplines_can.propagation import scene_mixture
from maplines_can.propagation.from_map import MAX_SIGMA, Query
from maplines_can.propagation.refit import MAX_MISFIT, Refit
from maplines_can.values.errors import EncodeError, MaplinesError
from maplines_can.values.line import lateral_jacobian

from .harness import evidence, progress
from .roads import SHAPES, Draw, maps_of, on_map, on_roads
from .sums import SIGMA_AT, Given, Tally
from .transfer import codec_of, transferred
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

#: Components of mixtures.
COMPONENTS = 3
#: The motion of lines that are predicted: time [s], speed [m/s], sigmas [m/s, rad/s], and its
#: largest yaw rate [rad/s].
SECONDS, SPEED, MOTION_SIGMA, MAX_YAW_RATE = 1.0, 12.0, (0.3, 0.01), 0.6


@evidence
def lines(
    n: int = 25,
    maps: tuple[str, ...] = (),
    shapes: tuple[str, ...] = tuple(SHAPES),
    by: Literal[
        "line", "wire", "scene", "scene-wire", "scene-mixture", "mixture", "predicted"
    ] = "line",
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
        by: how a consumer gets lines: of map_lines ("line"), the same over the wire, map_scene with
            all lines jointly, over the wire with conditional records, as mixtures of 3 components
            (of map_lines, or of a scene), or predicted by 1 s and 12 m.
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
    poses: Array  #: (D + 1, 3) true poses and, last, the mean one, from which these are seen


class Case(NamedTuple):
    """True lines around a mean pose, and what a map says of them."""

    true: Mapping[Slot, Array]  #: (n, 2) points in the direction of the car
    lines: Mapping[Slot, Polyline]  #: as the product gets them
    ego: Gaussian
    poses: Array  #: (D + 1, 3) true ones, and the mean
    error: MapError | None  #: that is stated
    rng: np.random.Generator

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
        every = np.vstack([about.draw(), pose]) if true else np.zeros((0, 3))
        return cls(true, given, Gaussian(pose, about.cov), every, error, rng)

    def measure(self, by: str, tally: Tally) -> None:
        """Add what a consumer has of the lines."""
        if not self.true:
            return
        excess = excess_covs(self.lines, self.ego, self.error) if by == "line" else {}
        there = set[Slot]()
        for got in WAYS[by](self):
            if got is None:
                tally.counts["lost"] += 1
                continue
            there |= {*got.slots}
            tally.counts["lines"] += len(got.slots)
            near = [near_points(self.true[slot], got.poses[-1]) for slot in got.slots]
            views = [(seen_from(points, got.poses[:-1]), s) for points, s in near]
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
    (low, high), mean, cov = given.ranges[0], given.means[0, 0], given.covs[0]
    for x in (x for x in SIGMA_AT if low <= x <= high):
        g = lateral_jacobian(mean, x)
        variance = g @ cov @ g
        rest = max(variance - g @ excess @ g, 1e-12)
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

#: From a line, the true poses with the mean one, and random numbers to what a consumer has.
Carry = Callable[[MapLine, Array, np.random.Generator], tuple[MapLine | None, Array]]


def given_of(line: MapLine) -> Given:
    """Return what a consumer has of a single line."""
    of, ranges = line.gaussian, np.array([[line.x_min, line.x_max]])
    if line.mixture is None:
        return Given(np.ones(1), of.mean[None, None], of.cov[None], ranges)
    return Given(line.mixture.weights, line.mixture.means[:, None], line.mixture.covs, ranges)


def lines_by(carry: Carry, components: int, case: Case) -> Iterator[Got | None]:
    """Yield the lines of ``map_lines`` that ``carry`` brings to a consumer, one by one."""
    found = map_lines(
        case.lines, case.ego, window=WINDOW, map_error=case.error, components=components
    )
    for line in found:
        got, poses = carry(line, case.poses, case.rng)
        yield None if got is None else Got([line.slot], given_of(got), poses)


def as_given(line: MapLine, poses: Array, _: Any) -> tuple[MapLine | None, Array]:
    """Return a line as the sender has it."""
    return line, poses


def sent(line: MapLine, poses: Array, _: Any) -> tuple[MapLine | None, Array]:
    """Return a line as a receiver gets it; None if it is not usable."""
    decoder, received = codec_of().decoder(), None
    for frame in codec_of().encoder().encode(line):
        received = decoder.feed(frame.can_id, frame.data, t_ns=0)
    return (received if isinstance(received, MapLine) and received.is_usable else None), poses


def predicted(line: MapLine, poses: Array, rng: Any) -> tuple[MapLine | None, Array]:
    """Return a line that is predicted, and the true poses of that time."""
    curvature = line.gaussian.mean[2] + line.gaussian.mean[3] * SPEED * SECONDS / 2
    yaw_rate = float(np.clip(SPEED * curvature, -MAX_YAW_RATE, MAX_YAW_RATE))
    motion = Motion.with_sigma(SPEED, yaw_rate, MOTION_SIGMA)
    rates = np.array([SPEED, yaw_rate]) + rng.standard_normal((len(poses), 2)) * MOTION_SIGMA
    rates[-1] = SPEED, yaw_rate  # of the mean pose
    try:
        later = predict_to(replace(line, t_ns=0), round(SECONDS * 1e9), motion)
    except MaplinesError:
        return None, poses
    return later, np.array([arc(*row) for row in np.column_stack([poses, rates])])


def arc(x: float, y: float, heading: float, speed: float, yaw_rate: float) -> Array:
    """Return the pose after a motion along an arc for ``SECONDS``, by closed form."""
    turn = yaw_rate * SECONDS / 2
    chord, middle = speed * SECONDS * np.sinc(turn / np.pi), heading + turn
    return np.array([x + chord * np.cos(middle), y + chord * np.sin(middle), heading + 2 * turn])


def scene_of(case: Case) -> Scene:
    """Return the scene of all lines."""
    return map_scene(case.lines, case.ego, window=WINDOW, map_error=case.error)


def scenes_by(carry: Callable[[Scene], Scene], case: Case) -> Iterator[Got | None]:
    """Yield the joint distribution of the lines of a scene that ``carry`` brings."""
    scene = scene_of(case)
    got = carry(scene)
    yield from [None] * (len(scene.lines) - len(got.lines))
    if got.lines:
        slots = [line.slot for line in got.lines]
        joint = got.joint(slots)
        ranges = np.array([[line.x_min, line.x_max] for line in got.lines])
        means = joint.mean.reshape(1, -1, 4)
        yield Got(slots, Given(np.ones(1), means, joint.cov[None], ranges), case.poses)


def scene_sent(scene: Scene) -> Scene:
    """Return a scene as a receiver gets it, without the lines that do not fit."""
    try:
        received = transferred(codec_of("maplines-pose.dbc"), scene)
    except EncodeError:
        received = None
    return scene.subset([]) if received is None else received


def mixtures_of_scene(case: Case) -> Iterator[Got | None]:
    """Yield the lines of a scene as mixtures that a receiver makes of it."""
    scene = scene_of(case)
    for line in scene.lines:
        found = scene_mixture(scene, line.slot, COMPONENTS)
        mixed = replace(line, gaussian=found.overall, mixture=found)
        yield Got([line.slot], given_of(mixed), case.poses)


#: What a consumer has of a case, by name.
WAYS: dict[str, Callable[[Case], Iterator[Got | None]]] = {
    "line": partial(lines_by, as_given, 1),
    "wire": partial(lines_by, sent, 1),
    "scene": partial(scenes_by, lambda scene: scene),
    "scene-wire": partial(scenes_by, scene_sent),
    "scene-mixture": mixtures_of_scene,
    "mixture": partial(lines_by, as_given, COMPONENTS),
    "predicted": partial(lines_by, predicted, 1),
}
