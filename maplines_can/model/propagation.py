"""Lines of a map as a car with an uncertain pose sees them, one by one or as a scene.

A transform takes points of the Gaussian of the pose, and the weighted moments of the lines seen
from there are their Gaussian. A range ends where the line is no longer certain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from ..values.scene import MapError
from .certain_range import certain_range
from .cubic_ranges import Limits
from .elementary import clipped, sin_cos
from .lines import Curve, margin_at, valid_range
from .matrices import Matrix, Vector, diagonal, matrix
from .refits import UNKNOWN, Refit, is_across, line_at, line_or_extended, refit
from .stretches import Look, Path, Stretch, Stretches, stretch_of

#: Largest and least limit of the angle between a line and the x axis, 65 and 20 degrees, and
#: standard deviations of the heading for which it leaves room.
MAX_TURN, MIN_TURN, TURN_MARGIN = 65 * (math.pi / 180), 20 * (math.pi / 180), 3.0
#: Lateral distance for which the window is widened [m].
ASIDE = 10.0
#: Shortest range of a line [m], and of what the ends of those of scenes are multiples [m].
MIN_RANGE, WHOLE_STEP = 1.0, 1.0
#: Most times that a line of a scene is fitted again, and most lines of a scene.
TRIALS, MOST_LINES = 8, 8
#: Largest entry of a covariance, and its rounding, as a share of the standard deviations.
MAX_COV, ROUNDING = 1e307, 1e-9


class Rule(NamedTuple):
    """Points mean + L z of a transform, with L L^T the covariance; the first is at the mean."""

    z: Matrix
    mean_weights: Sequence[float]
    cov_weights: Sequence[float]


class Query(NamedTuple):
    """What is asked for."""

    mean: Sequence[float]  #: of the pose in the frame of the map [m, m, rad]
    cov: Sequence[Sequence[float]]
    window: tuple[float, float]  #: that the ranges may extend to [m]
    max_misfit: float  #: [m]
    max_sigma: float  #: of the lateral position [m]
    error: MapError | None


class MapLine(NamedTuple):
    """A line of the map as seen from an uncertain pose."""

    mean: Vector
    cov: Matrix
    begin: float
    end: float


class Scene(NamedTuple):
    """Lines with a joint covariance, without those that are left out."""

    means: Matrix
    cov: Matrix
    ranges: list[tuple[float, float]]  #: in which they are valid [m]
    refits: list[Refit]
    quartics: list[float]  #: coefficients of T_4 [m]


def sigma_points(alpha: float = 1.0, kappa: float = 0.0, beta: float = 2.0) -> Rule:
    """Return the rule of the scaled unscented transform of a pose."""
    scale = alpha * alpha * (3 + kappa)
    z = diagonal([math.sqrt(scale)] * 3)
    weights, first = [1 / (2 * scale)] * 6, 1 - 3 / scale
    points = Matrix([Vector([0.0] * 3), *z, *(-1.0 * z)])
    return Rule(points, [first, *weights], [first + (1 - alpha * alpha + beta), *weights])


def rule_points(rule: Rule, mean: Sequence[float], cov: Sequence[Sequence[float]]) -> list[Vector]:
    """Return the points of a Gaussian."""
    root = matrix(cov).square_root()
    return [Vector(m + row @ z for m, row in zip(mean, root, strict=True)) for z in rule.z]


def weighted_moments(rule: Rule, values: Sequence[Vector]) -> tuple[Vector, Matrix]:
    """Return mean and covariance of the values at the points of a rule.

    The sums are over differences from the first one, which avoids cancellation.
    """
    first, *others = values
    d = [one - first for one in others]
    shift = Vector([0.0] * len(first))
    for weight, one in zip(rule.mean_weights[1:], d, strict=True):
        shift += weight * one
    cov = diagonal([0.0] * len(first))
    for weight, one in zip(rule.cov_weights[1:], d, strict=True):
        cov += (weight * (one - shift)).outer(one - shift)
    return first + shift, cov + (rule.cov_weights[0] * shift).outer(shift)


def is_covariance(S: Matrix) -> bool:
    """Return whether a matrix is a covariance up to rounding."""
    if not all(abs(x) <= MAX_COV for row in S for x in row) or min(S.diagonal()) < 0:
        return False
    R = S / S.scale().outer()
    for i, variance in enumerate(S.diagonal()):
        R[i][i] = (1.0 if variance > 0 else 0.0) + ROUNDING
    return R.is_definite()


# ---- what both share --------------------------------------------------------------------------


class PoseView(NamedTuple):
    """What follows from an uncertain pose."""

    look: Look
    pose_cov: Matrix  #: in the frame of the car: along, across [m], heading [rad]
    cov: Matrix  #: with what of the error of the map acts as a pose error
    room: float  #: that ranges leave at their ends, at most [m]


def pose_view(query: Query) -> PoseView:
    """Return what follows from the pose of a query."""
    s, c = sin_cos(query.mean[2])
    R = matrix([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    cov = pose_cov = R.congruence(matrix(query.cov))
    turn = max(MIN_TURN, MAX_TURN - TURN_MARGIN * math.sqrt(pose_cov[2][2]))
    if query.error is not None:  # it moves the ends of a line as the pose error does
        shift, heading = (
            query.error.offset_sigma * query.error.offset_sigma,
            query.error.heading_sigma,
        )
        cov = cov + diagonal([shift, shift, heading * heading])
    low, high = query.window
    farthest = max(abs(low), abs(high))
    room = max(margin_at(cov, farthest, y) for y in (ASIDE, -ASIDE))
    look = Look(query.mean, low - room, high + room, turn, query.max_misfit)
    return PoseView(look, pose_cov, cov, room)


def seen_of(paths: Sequence[Path], look: Look) -> tuple[list[Stretch], list[int], dict[int, str]]:
    """Return what is seen of lines, of which ones, and why nothing of the others."""
    found = {i: stretch_of(path, look) for i, path in enumerate(paths)}
    given = {i: one for i, one in found.items() if isinstance(one, Stretch)}
    return [*given.values()], [*given], {i: o for i, o in found.items() if isinstance(o, str)}


# ---- lines one by one -------------------------------------------------------------------------


def map_lines(
    paths: Sequence[Path], query: Query, rule: Rule
) -> tuple[dict[int, MapLine], dict[int, str]] | None:
    """Return lines by their index, and why others are left out; None if one is refused."""
    view = pose_view(query)
    stretches, given, left_out = seen_of(paths, view.look)
    seen, limits = Stretches(stretches), Limits(query.max_misfit, view.room)
    points = rule_points(rule, query.mean, query.cov)
    found: dict[int, MapLine] = {}
    for i, path in enumerate(given):
        one = refit(seen, i, query.mean, limits, query.error)
        line = "TOO_SHORT" if one is None else _line(query, view, rule, one, points)
        if line is None:
            return None
        if isinstance(line, str):
            left_out[path] = line
        else:
            found[path] = line
    return found, left_out


def _line(
    query: Query, view: PoseView, rule: Rule, one: Refit, points: Sequence[Vector]
) -> MapLine | str | None:
    """Return a line, or why it is left out; None if it is refused."""
    begin = clipped(one.begin + margin_at(view.cov, one.x[0], one.y[0]), *query.window)
    end = clipped(one.end - margin_at(view.cov, one.x[-1], one.y[-1]), *query.window)
    if end - begin < MIN_RANGE or is_across(one):
        return "TOO_SHORT"
    values = [line_or_extended(one, point) or UNKNOWN for point in points]
    mean, cov = weighted_moments(rule, values)
    cov = (cov + one.noise).symmetric()
    if not all(map(math.isfinite, mean)) or not is_covariance(cov):
        return None
    if any(any(row) for i, row in enumerate(cov) if row[i] == 0):
        return None
    certain = certain_range(mean, cov, begin, end, query.max_sigma)
    if certain is None or (certain != (begin, end) and certain[1] - certain[0] < MIN_RANGE):
        return "UNCERTAIN"
    return MapLine(mean, cov, *certain)


# ---- lines of a scene -------------------------------------------------------------------------


@dataclass(eq=False)
class _Trial:
    """A line of a scene while its range is sought."""

    place: int  #: of its stretch
    refit: Refit | None  #: None if no cubic follows it, or if it is dropped
    count: int = 0  #: times that it was fitted again, since it was uncertain


def map_scene(
    paths: Sequence[Path], query: Query, rule: Rule
) -> tuple[Scene | None, dict[int, str]] | None:
    """Return lines with their joint covariance, and why others are left out; None if refused.

    Where a line is uncertain at an end, it is fitted again in a shorter range. One whose range is
    too short is dropped, and the others are propagated again.
    """
    view = pose_view(query)
    if len(paths) > MOST_LINES:
        return None
    stretches, given, left_out = seen_of(paths, view.look)
    points = [_moved(query.mean, d) for d in rule_points(rule, [0.0] * 3, view.pose_cov)]
    seen, limits = Stretches(stretches), Limits(query.max_misfit, view.room, WHOLE_STEP)

    def fitted(place: int) -> Refit | None:
        return refit(seen, place, query.mean, limits, query.error)

    trials = [_Trial(place, fitted(place)) for place in range(len(given))]
    for _ in range(MOST_LINES * (TRIALS + 3)):
        kept = [one for one in trials if _is_kept(query, view, one.refit)]
        why = {
            given[one.place]: "UNCERTAIN" if one.count else "TOO_SHORT"
            for one in trials
            if one not in kept
        }
        refits = [one.refit for one in kept if one.refit is not None]
        if not refits:
            return None, left_out | why
        scene = _joint(query, view, rule, refits, points)
        if scene is None:
            return None
        ended = [end - begin < MIN_RANGE for begin, end in scene.ranges]
        certain = scene.ranges if any(ended) else _certain_ranges(query, scene)
        if not any(ended) and certain == scene.ranges:
            is_good = all(map(is_covariance, [*(one.noise for one in refits), scene.cov]))
            return (scene, left_out | why) if is_good else None
        for trial, one, ends, part, has_ended in zip(
            kept, refits, scene.ranges, certain, ended, strict=True
        ):
            if has_ended:
                trial.refit = None
            elif part != ends:
                begin, end = seen.ranges[trial.place] = _shorter((one.begin, one.end), ends, part)
                is_dropped = trial.count >= TRIALS or not end - begin >= MIN_RANGE
                trial.refit = None if is_dropped else fitted(trial.place)
                trial.count += 1
    return None


def _moved(pose: Sequence[float], d: Vector) -> Vector:
    """Return the pose after a displacement in the frame of the car."""
    s, c = sin_cos(pose[2])
    x, y, turn = d
    return Vector([pose[0] + (x * c + y * -s), pose[1] + (x * s + y * c), pose[2] + turn])


def _valid_range(query: Query, view: PoseView, one: Refit, mean: Vector) -> tuple[float, float]:
    heading_sigma = 0.0 if query.error is None else query.error.heading_sigma
    return valid_range(Curve(mean, one.begin, one.end), view.pose_cov, one.noise, heading_sigma)


def _is_kept(query: Query, view: PoseView, one: Refit | None) -> bool:
    """Return whether a line is to be in the scene, as far as is known before the propagation."""
    if one is None or is_across(one):
        return False
    begin, end = _valid_range(query, view, one, line_at(one, one.pose) or UNKNOWN)
    is_whole = one.begin == math.floor(one.begin) and one.end == math.floor(one.end)
    return end - begin >= MIN_RANGE and is_whole


def _joint(
    query: Query, view: PoseView, rule: Rule, refits: list[Refit], points: Sequence[Vector]
) -> Scene | None:
    """Return lines with their joint moments; None if one has no value."""
    values = [
        Vector(x for one in refits for x in line_or_extended(one, point) or UNKNOWN)
        for point in points
    ]
    mean, cov = weighted_moments(rule, values)
    cov = cov.with_blocks([one.noise for one in refits]).symmetric()
    if not Matrix([mean, *cov]).is_finite():
        return None
    means = matrix(mean[i : i + 4] for i in range(0, len(mean), 4))
    ranges = [_valid_range(query, view, *pair) for pair in zip(refits, means, strict=True)]
    return Scene(means, cov, ranges, refits, [one.quartic for one in refits])


def _certain_ranges(query: Query, scene: Scene) -> list[tuple[float, float] | None]:
    """Return the parts of the ranges of a scene in which its lines are certain enough."""
    found = []
    for i, (mean, ends) in enumerate(zip(scene.means, scene.ranges, strict=True)):
        cov = scene.cov.block_of(i, i)
        found.append(certain_range(mean, cov, *ends, query.max_sigma))
    return found


def _shorter(
    fit: tuple[float, float], ends: tuple[float, float], certain: tuple[float, float] | None
) -> tuple[float, float]:
    """Return the range in which a line is to be fitted again, by the part that is certain.

    A line that is certain nowhere may be so if less of it is fitted: half of what is ahead.
    """
    if certain is None:
        car = clipped(0.0, *fit)
        return car + (fit[0] - car) / 2, car + (fit[1] - car) / 2
    return certain[0] + (fit[0] - ends[0]), certain[1] + (fit[1] - ends[1])
