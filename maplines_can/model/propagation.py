"""Lines of a map as a car with an uncertain pose sees them, one by one or as a scene.

A transform takes points of the Gaussian of the pose, and the weighted moments of the lines seen
from there are their Gaussian. A range ends where the line is no longer certain.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from .certain_range import certain_range
from .cubic_ranges import Limits
from .elementary import PI_BY_2, sin_cos
from .lines import MARGIN, Curve, valid_range
from .matrices import (
    Matrix,
    Row,
    added,
    congruence,
    dot,
    is_definite,
    scale_of,
    square_root,
    symmetric,
)
from .refits import MapError, Refit, is_across, line_at, line_or_extended, quartic, refit
from .stretches import Look, Path, Stretch, Stretches, limited, stretch_of

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
    mean_weights: Row
    cov_weights: Row


class Query(NamedTuple):
    """What is asked for."""

    mean: Row  #: of the pose in the frame of the map [m, m, rad]
    cov: Matrix
    window: tuple[float, float]  #: that the ranges may extend to [m]
    max_misfit: float  #: [m]
    max_sigma: float  #: of the lateral position [m]
    error: MapError | None


class MapLine(NamedTuple):
    """A line of the map as seen from an uncertain pose."""

    mean: Row
    cov: Matrix
    begin: float
    end: float


class Scene(NamedTuple):
    """Lines with a joint covariance, without those that are left out."""

    means: Matrix
    cov: Matrix
    ranges: list[tuple[float, float]]  #: in which they are valid [m]
    refits: list[Refit]
    quartics: Row  #: coefficients of T_4 [m]


def sigma_points(alpha: float = 1.0, kappa: float = 0.0, beta: float = 2.0) -> Rule:
    """Return the rule of the scaled unscented transform of a pose."""
    scale = alpha * alpha * (3 + kappa)
    far = math.sqrt(scale)
    z = [[0.0] * 3 for _ in range(7)]
    for k in range(3):
        z[1 + k][k], z[4 + k][k] = far, -far
    weights, first = [1 / (2 * scale)] * 6, 1 - 3 / scale
    return Rule(z, [first, *weights], [first + (1 - alpha * alpha + beta), *weights])


def rule_points(rule: Rule, mean: Row, cov: Matrix) -> Matrix:
    """Return the points of a Gaussian."""
    root = square_root(cov)
    return [[m + dot(row, z) for m, row in zip(mean, root, strict=True)] for z in rule.z]


def weighted_moments(rule: Rule, values: Matrix) -> tuple[Row, Matrix]:
    """Return mean and covariance of the values at the points of a rule.

    The sums are over differences from the first one, which avoids cancellation.
    """
    first, n = values[0], len(values[0])
    d = [[x - y for x, y in zip(row, first, strict=True)] for row in values[1:]]
    shift = [0.0] * n
    for weight, row in zip(rule.mean_weights[1:], d, strict=True):
        shift = [m + weight * x for m, x in zip(shift, row, strict=True)]
    cov = [[0.0] * n for _ in range(n)]
    for weight, row in zip(rule.cov_weights[1:], d, strict=True):
        rest = [x - m for x, m in zip(row, shift, strict=True)]
        cov = [
            [c + weight * a * b for c, b in zip(entries, rest, strict=True)]
            for entries, a in zip(cov, rest, strict=True)
        ]
    weight = rule.cov_weights[0]
    cov = [
        [c + weight * a * b for c, b in zip(entries, shift, strict=True)]
        for entries, a in zip(cov, shift, strict=True)
    ]
    return [x + m for x, m in zip(first, shift, strict=True)], cov


def is_covariance(S: Matrix) -> bool:
    """Return whether a matrix is a covariance up to rounding."""
    n = range(len(S))
    if not all(abs(x) <= MAX_COV for row in S for x in row) or any(S[i][i] < 0 for i in n):
        return False
    scale = scale_of(S)
    R = [[S[i][j] / (scale[i] * scale[j]) for j in n] for i in n]
    for i in n:
        R[i][i] = (1.0 if S[i][i] > 0 else 0.0) + ROUNDING
    return is_definite(R)


# ---- what both share --------------------------------------------------------------------------


class PoseView(NamedTuple):
    """What follows from an uncertain pose."""

    look: Look
    pose_cov: Matrix  #: in the frame of the car: along, across [m], heading [rad]
    cov: Matrix  #: with what of the error of the map acts as a pose error
    room: float  #: that ranges leave at their ends, at most [m]


def margin_at(P: Matrix, x: float, y: float) -> float:
    """Return the distance by which pose errors shorten a range at its end [m]."""
    variance = P[0][0] - 2 * y * P[0][2] + y * y * P[2][2]
    _, cosine = sin_cos(min(PI_BY_2, MARGIN * math.sqrt(P[2][2])))
    return MARGIN * math.sqrt(max(0.0, variance)) + (1 - cosine) * abs(x)


def pose_view(query: Query) -> PoseView:
    """Return what follows from the pose of a query."""
    s, c = sin_cos(query.mean[2])
    pose_cov = congruence([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]], query.cov)
    turn = max(MIN_TURN, MAX_TURN - TURN_MARGIN * math.sqrt(pose_cov[2][2]))
    cov = [[*row] for row in pose_cov]
    if query.error is not None:  # it moves the ends of a line as the pose error does
        points, offset, heading = query.error
        shift = offset * offset + points * points
        for i, variance in enumerate((shift, shift, heading * heading)):
            cov[i][i] += variance
    low, high = query.window
    farthest = max(abs(low), abs(high))
    room = max(margin_at(cov, farthest, y) for y in (ASIDE, -ASIDE))
    return PoseView(Look(query.mean, low - room, high + room, turn), pose_cov, cov, room)


def seen_of(paths: Sequence[Path], look: Look) -> tuple[list[Stretch], list[int], dict[int, str]]:
    """Return what is seen of lines, of which ones, and why nothing of the others."""
    found = [stretch_of(path, look) for path in paths]
    given = [i for i, one in enumerate(found) if isinstance(one, Stretch)]
    left_out = {i: one for i, one in enumerate(found) if isinstance(one, str)}
    return [one for one in found if isinstance(one, Stretch)], given, left_out


# ---- lines one by one -------------------------------------------------------------------------


def map_lines(
    paths: Sequence[Path], query: Query, rule: Rule
) -> tuple[dict[int, MapLine], dict[int, str]] | None:
    """Return lines by their index, and why others are left out; None if one is refused."""
    view = pose_view(query)
    stretches, given, left_out = seen_of(paths, view.look)
    seen = Stretches(stretches)
    points = rule_points(rule, query.mean, query.cov)
    found: dict[int, MapLine] = {}
    for i, path in enumerate(given):
        limits = Limits(query.max_misfit, view.room)
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
    query: Query, view: PoseView, rule: Rule, one: Refit, points: Matrix
) -> MapLine | str | None:
    """Return a line, or why it is left out; None if it is refused."""
    begin = limited(one.begin + margin_at(view.cov, one.x[0], one.y[0]), *query.window)
    end = limited(one.end - margin_at(view.cov, one.x[-1], one.y[-1]), *query.window)
    if end - begin < MIN_RANGE or is_across(one):
        return "TOO_SHORT"
    values = [line_or_extended(one, point) for point in points]
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return None
    mean, cov = weighted_moments(rule, known)
    cov = symmetric(added(cov, one.noise))
    if not all(map(math.isfinite, mean)) or not is_covariance(cov):
        return None
    if any(any(row) for i, row in enumerate(cov) if row[i] == 0):
        return None
    certain = certain_range(mean, cov, begin, end, query.max_sigma)
    if certain is None or (certain != (begin, end) and certain[1] - certain[0] < MIN_RANGE):
        return "UNCERTAIN"
    return MapLine(mean, cov, *certain)


# ---- lines of a scene -------------------------------------------------------------------------


@dataclass
class _Trial:
    """A line of a scene while its range is sought."""

    stretch: Stretch
    refit: Refit | None = None  #: None if no cubic follows it
    is_new: bool = True  #: it is to be fitted
    is_shorter: bool = False  #: it was fitted again, since it was uncertain
    is_dropped: bool = False
    trials: int = 0


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
    trials = [_Trial(stretch) for stretch in stretches]
    points = [_moved(query.mean, d) for d in rule_points(rule, [0.0] * 3, view.pose_cov)]
    limits = Limits(query.max_misfit, view.room, WHOLE_STEP)
    seen = Stretches(stretches)
    for _ in range(MOST_LINES * (TRIALS + 3)):
        for i, trial in enumerate(trials):
            seen.ranges[i] = trial.stretch.begin, trial.stretch.end
            if trial.is_new:
                trial.refit = refit(seen, i, query.mean, limits, query.error)
                trial.is_new = False
        kept = [trial for trial in trials if _is_kept(query, view, trial)]
        why = {
            given[i]: "UNCERTAIN" if trial.is_shorter else "TOO_SHORT"
            for i, trial in enumerate(trials)
            if trial not in kept
        }
        if not kept:
            return None, left_out | why
        scene = _joint(query, view, rule, kept, points)
        if scene is None:
            return None
        ended = [end - begin < MIN_RANGE for begin, end in scene.ranges]
        for trial, has_ended in zip(kept, ended, strict=True):
            trial.is_dropped |= has_ended
        if not any(ended) and not _shorten(query, kept, scene):
            own = [one.noise for one in scene.refits]
            is_good = all(map(is_covariance, [*own, scene.cov]))
            return (scene, left_out | why) if is_good else None
    return None


def _moved(pose: Row, d: Row) -> Row:
    """Return the pose after a displacement in the frame of the car."""
    s, c = sin_cos(pose[2])
    x, y, turn = d
    return [pose[0] + (x * c + y * -s), pose[1] + (x * s + y * c), pose[2] + turn]


def _valid_range(query: Query, view: PoseView, one: Refit, mean: Row) -> tuple[float, float]:
    heading_sigma = 0.0 if query.error is None else query.error.heading
    curve = Curve(mean, one.begin, one.end, 0.0)
    return valid_range(curve, view.pose_cov, one.noise, heading_sigma)


def _is_kept(query: Query, view: PoseView, trial: _Trial) -> bool:
    """Return whether a line is to be in the scene, as far as is known before the propagation."""
    one = trial.refit
    if one is None or is_across(one) or trial.is_dropped:
        return False
    begin, end = _valid_range(query, view, one, line_at(one, one.pose) or [math.nan] * 4)
    is_whole = one.begin == math.floor(one.begin) and one.end == math.floor(one.end)
    return end - begin >= MIN_RANGE and is_whole


def _joint(
    query: Query, view: PoseView, rule: Rule, kept: list[_Trial], points: Matrix
) -> Scene | None:
    """Return the lines that are kept with their joint moments; None if one has no value."""
    refits = [trial.refit for trial in kept if trial.refit is not None]
    values: Matrix = []
    for point in points:
        lines = [line_or_extended(one, point) for one in refits]
        values.append([x for line in lines for x in line or [math.nan]])
    n = 4 * len(refits)
    if any(len(row) < n for row in values):
        return None
    means, cov = weighted_moments(rule, values)
    for i in range(n):
        for j in range(4):
            cov[i][i // 4 * 4 + j] += refits[i // 4].noise[i % 4][j]
    cov = symmetric(cov)
    if not all(map(math.isfinite, [*means, *(x for row in cov for x in row)])):
        return None
    each = [means[i : i + 4] for i in range(0, n, 4)]
    ranges = [_valid_range(query, view, *pair) for pair in zip(refits, each, strict=True)]
    return Scene(each, cov, ranges, refits, [quartic(one) for one in refits])


def _shorten(query: Query, kept: list[_Trial], scene: Scene) -> bool:
    """Shorten the ranges of the lines that are uncertain at an end; whether there are any.

    A line that is certain nowhere may be so if less of it is fitted: half of what is ahead.
    """
    is_any = False
    for i, (trial, one) in enumerate(zip(kept, scene.refits, strict=True)):
        cov = [row[4 * i : 4 * i + 4] for row in scene.cov[4 * i : 4 * i + 4]]
        ends = scene.ranges[i]
        certain = certain_range(scene.means[i], cov, *ends, query.max_sigma)
        if certain == ends:
            continue
        is_any = True
        fit = one.begin, one.end
        if certain is None:
            car = limited(0.0, *fit)
            begin, end = (car + (x - car) / 2 for x in fit)
        else:
            begin, end = (c + (x - v) for c, x, v in zip(certain, fit, ends, strict=True))
        trial.is_shorter = True
        trial.is_dropped = trial.trials >= TRIALS or not end - begin >= MIN_RANGE
        trial.trials += 1
        if not trial.is_dropped:
            trial.stretch = trial.stretch._replace(begin=begin, end=end)
            trial.is_new = True
    return is_any
