"""Lines and their joint covariance, from the pose error and the records of the lines.

All lines of a scene are seen from one pose, so they share its error:

    C = covariance of the lines, seen from poses with the error N(0, P)
        + blkdiag(D_1, ..., D_L)

What there is of a line depends on its own record and on the pose error only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from ..values.line import Kind, Slot, Status
from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import PoseLayout
from ..wire.layout.signals import FINE, OWN_SIGNALS, PARAMETER_SIGNALS, POSE_ROWS
from .elementary import exp2
from .levels import Levels, LevelSignals, level_covariance
from .lines import (
    Curve,
    bases,
    is_function,
    points_of,
    pose_jacobian,
    sigma_points,
    spread,
    valid_range,
)
from .matrices import Matrix, added, cholesky, diagonal, product, square, upper_solution
from .records import Line, RawRecord, age_of, cholesky_factor, covariance, order_of
from .signals import Raw, level, nearest_raw, of_slot, physical

#: About the standard deviation of the rounding errors of means, in coefficients of T_0 .. T_3 [m].
RESOLUTION = 2.0**-9
#: Share by which variances are enlarged, so that sums are definite in double precision.
ROUNDING = 2.0**-42
#: Steps of the ends of a valid range [1/m]: they are moved inwards to the next one.
STEPS = 10
#: Least derivative of beta with respect to the heading of the car; that of a straight line is 1.
MIN_TURN = 0.1


class Pose(NamedTuple):
    """Content of a record of the pose error."""

    layout: PoseLayout
    raw: Raw
    counter: int
    t_ns: int  #: time of its first frame
    age: float  #: [s]; infinite if it is too old
    cov: Matrix  #: P, over along [m], across [m] and heading [rad]
    correlation_time: float  #: [s]; infinite if it is unknown
    offset_sigma: float  #: of each line on the map [m]
    heading_sigma: float  #: of each line on the map [rad]


class Member(NamedTuple):
    """What was received of a line of a scene."""

    slot: Slot
    content: RawRecord | Line  #: conditional on the pose error, or with a covariance of its own
    t_ns: int  #: time of its first frame


class SceneLine(NamedTuple):
    """A line of a scene."""

    line: Line  #: with its block of the joint covariance
    curve: Curve  #: with the range to which it was fitted
    spread: Matrix  #: (4, 7) A_i: the pose error causes the covariances A_i A_j^T
    own: Matrix  #: (4, 4) D_i


class Scene(NamedTuple):
    """Lines that are seen from one pose."""

    lines: list[Line]
    cov: Matrix  #: (4 L, 4 L)
    pose: Pose
    fit_ranges: list[tuple[float, float]]
    quartics: list[float]
    own: list[Matrix]


def pose_of(layout: PoseLayout, record: RawRecord, t_ns: int) -> Pose:
    """Return the content of a record of the pose error. All bits mean something."""
    raw = record.raw
    time, offset, heading = (
        level(layout[name], raw) for name in ("CorrelationTime", "MapOffset", "MapHeading")
    )
    cov = covariance(layout, POSE_ROWS, raw)
    time = time if raw["CorrelationTime"] else math.inf
    return Pose(layout, raw, record.counter, t_ns, age_of(layout, raw), cov, time, offset, heading)


def scene_line(layout: Layout, pose: Pose, member: Member) -> SceneLine | None:
    """Return a line with the pose error that it belongs to.

    None if it is no function of x in its range; no sender sends such a line.
    """
    content = member.content
    if isinstance(content, RawRecord):
        curve, signals, raw = _conditional(layout, content.raw)
    else:
        curve, signals, raw = _with_levels(layout, pose, content)
    if not curve.begin < curve.end or not is_function(points_of(curve)):
        return None
    A, common = spread(curve, sigma_points(pose.cov)), common_covariance(pose, curve)
    if A is None or common is None:
        return None
    if isinstance(content, RawRecord) and content.raw["HasCovariance"]:
        own = square(_in_order_of_states(layout, content.raw))
    else:
        own = square(_level_factor(added(level_covariance(signals, raw, curve), common), curve))
    cov = enlarged(added(square(A), own))
    if isinstance(content, RawRecord):
        x_min, x_max = _valid_range(pose, curve, own)
        kind, age = Kind(content.raw["Kind"]), later(pose.age, member.t_ns - pose.t_ns)
        line = Line(member.slot, curve.mean, cov, kind, x_min, x_max, age, Status.FULL, member.t_ns)
    else:  # in a scene, all of its covariance is known
        is_partial = content.status in (Status.UNKNOWN, Status.DIAGONAL)
        line = content._replace(cov=cov, status=Status.FULL if is_partial else content.status)
    return SceneLine(line, curve, A, own)


def scene_of(pose: Pose, lines: Sequence[SceneLine]) -> Scene:
    """Return the scene of a pose error and its lines."""
    cov = square([row for line in lines for row in line.spread])
    for i, line in enumerate(lines):
        for j, row in enumerate(line.own):
            for k, value in enumerate(row):
                cov[4 * i + j][4 * i + k] += value
    return Scene(
        [line.line for line in lines],
        enlarged(cov),
        pose,
        [(line.curve.begin, line.curve.end) for line in lines],
        [line.curve.quartic for line in lines],
        [line.own for line in lines],
    )


def enlarged(cov: Matrix) -> Matrix:
    """Return a covariance that is definite in double precision, whatever its parts are."""
    return [
        [x * (1 + ROUNDING) if i == j else x for j, x in enumerate(row)]
        for i, row in enumerate(cov)
    ]


def common_covariance(pose: Pose, curve: Curve) -> Matrix | None:
    """Return what of D all lines have, in coefficients of T_0 .. T_3.

    It is the resolution of the means, and the errors of each line on the map, which act as errors
    of the pose. None if the line is no function of x near the mean pose.
    """
    cov = diagonal([RESOLUTION * RESOLUTION] * 4)
    if pose.offset_sigma == 0 and pose.heading_sigma == 0:
        return cov
    G = pose_jacobian(points_of(curve))
    if G is None:
        return None
    sigmas = pose.offset_sigma, pose.offset_sigma, pose.heading_sigma
    scaled = [[x * sigma for x, sigma in zip(row, sigmas, strict=True)] for row in G]
    return added(cov, square(upper_solution(bases(curve), scaled)))  # T_k has k derivatives


def later(age: float, passed_ns: int) -> float:
    """Return an age [s] when some time has passed, in whole nanoseconds, and 0 or more.

    >>> later(0.008, 1_620_000), later(0.008, -9_000_000)
    (0.00962, 0.0)
    """
    return age if math.isinf(age) else max(float(round(1e9 * age)) + passed_ns, 0.0) / 1e9


# ---- what the records say of a line -------------------------------------------------------------


def _conditional(layout: Layout, raw: Raw) -> tuple[Curve, LevelSignals, Levels]:
    """Return mean, range and levels of a conditional record; with a covariance it is finer."""
    mean = [physical(layout[name], raw) for name in PARAMETER_SIGNALS]
    if raw["HasCovariance"]:
        fine = [physical(layout[f"{name}{FINE}"], raw) for name in PARAMETER_SIGNALS]
        mean = [x + added_x for x, added_x in zip(mean, fine, strict=True)]
    begin, end, quartic = (physical(layout[name], raw) for name in ("XMin", "XMax", "Quartic"))
    signals = LevelSignals(*(layout[name] for name in OWN_SIGNALS))
    return Curve(mean, begin, end, quartic), signals, Levels(*(raw[name] for name in OWN_SIGNALS))


def _with_levels(layout: Layout, pose: Pose, line: Line) -> tuple[Curve, LevelSignals, Levels]:
    """Return mean and range of a complete record, and its levels in that of the pose error.

    The range was fitted beyond the valid one, by FitBehind and FitAhead.
    """

    def sent(name: str, value: float) -> float:
        raw = {name: nearest_raw(layout[name], value)}
        return physical(layout[name], raw)

    def of_pose(name: str) -> float:
        return physical(pose.layout[of_slot(line.slot, name)], pose.raw)

    mean = [sent(name, x) for name, x in zip(PARAMETER_SIGNALS, line.mean, strict=True)]
    begin = sent("XMin", line.x_min) - of_pose("FitBehind")
    end = sent("XMax", line.x_max) + of_pose("FitAhead")
    names = [of_slot(line.slot, name) for name in OWN_SIGNALS]
    signals, raw = (pose.layout[name] for name in names), (pose.raw[name] for name in names)
    return Curve(mean, begin, end, of_pose("Quartic")), LevelSignals(*signals), Levels(*raw)


def _in_order_of_states(layout: Layout, raw: Raw) -> Matrix:
    """Return the factor of all entries of D, with its rows in the order of the parameters."""
    rows, F = order_of(layout, PARAMETER_SIGNALS), cholesky_factor(layout, PARAMETER_SIGNALS, raw)
    return [F[rows.index(name)] for name in PARAMETER_SIGNALS]


def _level_factor(cov: Matrix, curve: Curve) -> Matrix:
    """Return a factor of D, from the covariance of the coefficients of T_0 .. T_3."""
    return product(bases(curve), cholesky(enlarged(cov)))


def _valid_range(pose: Pose, curve: Curve, own: Matrix) -> tuple[float, float]:
    """Return the valid range of a line that is conditional on the pose error [m].

    It leaves room for the errors of the pose and of the map. The heading of the map is a step
    larger than its level, since that was rounded. The greatest level may stand for more, but no
    more than the variance of beta has room for.
    """
    signal = pose.layout["MapHeading"]
    heading = pose.heading_sigma * exp2(signal.factor)
    is_greatest = pose.raw["MapHeading"] == signal.raw_max
    if is_greatest and (G := pose_jacobian(points_of(curve))) is not None:
        heading = max(heading, math.sqrt(own[1][1]) / max(abs(G[1][2]), MIN_TURN))
    x_min, x_max = valid_range(curve, pose.cov, own, heading)
    low, high = math.ceil(x_min * STEPS) / STEPS, math.floor(x_max * STEPS) / STEPS
    middle = (x_min + x_max) / 2
    return min(low, middle), max(high, middle) if low <= high else middle
