"""Lines and their joint covariance, from the pose error and the records of the lines.

All lines of a scene are seen from one pose, so they share its error:

    C = covariance of the lines, seen from poses with the error N(0, P)
        + blkdiag(D_1, ..., D_L)

What there is of a line depends on its own record and on the pose error only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ..values.line import Kind, Slot, Status
from ..wire.layout import record_signals as names
from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import PoseLayout
from ..wire.layout.record_signals import Signal
from ..wire.layout.scene_layout import SceneLayout
from .covariance import code_of, decoded
from .elementary import exp2
from .levels import level_covariance
from .lines import (
    Changes,
    Curve,
    bases,
    changes_of,
    is_line,
    spread,
    valid_range,
)
from .matrices import Matrix, Vector, diagonal, matrix
from .records import Line, RawRecord, age_of
from .signals import Raw, level, nearest, of_slot, physical, value

#: About the standard deviation of the rounding errors of means, in coefficients of T_0 .. T_3 [m].
RESOLUTION = 2.0**-9
#: Share by which variances are enlarged, so that sums are definite in double precision.
ROUNDING = 2.0**-42
#: Steps of the ends of a valid range [1/m]: they are moved inwards to the next one.
STEPS = 10
#: Least derivative of beta with respect to the heading of the car; that of a straight line is 1.
MIN_TURN = 0.1


class Pose(NamedTuple):
    """Content of a record of the pose error, or of a whole scene."""

    layout: PoseLayout | SceneLayout
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
    counter: int
    content: RawRecord | Line  #: conditional on the pose error, or with a covariance of its own
    t_ns: int  #: time of its first frame
    frames: int  #: that belong to the scene alone


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
    left_out: dict[Slot, str]  #: why it has no lines of these slots, if a record says so


def pose_of(layout: PoseLayout | SceneLayout, record: RawRecord, t_ns: int) -> Pose:
    """Return the content of a record of the pose error. All bits mean something."""
    raw, cov = record.raw, decoded(code_of(layout, names.POSE_ROWS), record.raw)
    levels = ("CorrelationTime", "MapOffset", "MapHeading")
    time, *sigmas = (level(layout[name], raw[name]) for name in levels)
    age = age_of(layout, raw)
    return Pose(layout, raw, record.counter, t_ns, age, cov, time or math.inf, *sigmas)


def scene_line(layout: Layout, pose: Pose, member: Member) -> SceneLine | None:
    """Return a line with the pose error that it belongs to.

    None if it is no function of x in its range, or overflows; no sender sends such a line.
    """
    content, slot_signals = member.content, signals_of_slot(layout, member.slot)
    raw = content.raw if isinstance(content, RawRecord) else _sent(layout, pose, content)
    curve = curve_of(layout, slot_signals, raw)
    if not is_line(curve):
        return None
    changes = changes_of(curve)
    A = spread(changes, pose.cov)
    if A is None:
        return None
    own = own_covariance(layout, slot_signals, raw, curve, common_covariance(pose, changes))
    cov = enlarged(A @ A.T + own)
    if isinstance(content, RawRecord):
        x_min, x_max = _valid_range(pose, curve, changes, own)
        kind, age = Kind(raw["Kind"]), later(pose.age, member.t_ns - pose.t_ns)
        line = Line(member.slot, curve.mean, cov, kind, x_min, x_max, age, Status.FULL, member.t_ns)
    else:  # in a scene, all of its covariance is known
        is_partial = content.status in (Status.UNKNOWN, Status.DIAGONAL)
        line = content._replace(cov=cov, status=Status.FULL if is_partial else content.status)
    return SceneLine(line, curve, A, own)


def scene_of(
    pose: Pose, lines: Sequence[SceneLine], left_out: Mapping[Slot, str] | None = None
) -> Scene:
    """Return the scene of a pose error and its lines."""
    A, own = Matrix(row for line in lines for row in line.spread), [line.own for line in lines]
    return Scene(
        [line.line for line in lines],
        enlarged((A @ A.T).with_blocks(own)),
        pose,
        [(line.curve.begin, line.curve.end) for line in lines],
        [line.curve.quartic for line in lines],
        own,
        dict(left_out or {}),
    )


def enlarged(cov: Matrix) -> Matrix:
    """Return a covariance that is definite in double precision, whatever its parts are."""
    found = matrix(cov)
    for i, row in enumerate(found):
        row[i] *= 1 + ROUNDING
    return found


def common_covariance(pose: Pose, changes: Changes) -> Matrix:
    """Return what of D all lines have, in coefficients of T_0 .. T_3.

    It is the resolution of the means, and the errors of each line on the map, which act as errors
    of the pose.
    """
    sigmas = Vector([pose.offset_sigma, pose.offset_sigma, pose.heading_sigma])
    K = Matrix(row * sigmas for row in changes.first.T)
    return K @ K.T + diagonal([RESOLUTION * RESOLUTION] * 4)


def later(age: float, passed_ns: int) -> float:
    """Return an age [s] when some time has passed, in whole nanoseconds, and 0 or more.

    >>> later(0.008, 1_620_000), later(0.008, -9_000_000)
    (0.00962, 0.0)
    """
    return age if math.isinf(age) else max(float(round(1e9 * age)) + passed_ns, 0.0) / 1e9


# ---- what the records say of a line -------------------------------------------------------------


def signals_of_slot(layout: Layout, slot: Slot) -> dict[str, Signal]:
    """Return the signals of levels, quartic and fit range: of the record, or of the pose error."""
    if layout.is_conditional or layout.pose is None:
        of_levels = (*names.SLOT_SIGNALS, names.TILT)
        return {name: layout[name] for name in of_levels if name in layout.signals}
    return {name: layout.pose[of_slot(slot, name)] for name in names.SLOT_SIGNALS}


def _sent(layout: Layout, pose: Pose, line: Line) -> dict[str, int]:
    """Return the raw values of a complete record, and those in the record of the pose error."""
    of_line = (*names.PARAMETER_SIGNALS, "XMin", "XMax")
    values = zip(of_line, (*line.mean, line.x_min, line.x_max), strict=True)
    raw = {name: int(nearest(layout[name], x)) for name, x in values}
    return raw | {name: pose.raw[of_slot(line.slot, name)] for name in names.SLOT_SIGNALS}


def curve_of(layout: Layout, slot_signals: Mapping[str, Signal], raw: Raw) -> Curve:
    """Return mean and fit range of a line; its mean is finer with a covariance.

    That of a complete record was fitted beyond its valid range, by FitBehind and FitAhead.
    """
    mean = physical(layout, raw, *names.PARAMETER_SIGNALS)
    if raw.get("HasCovariance"):
        mean += physical(layout, raw, *names.FINE_SIGNALS)
    begin, end = physical(layout, raw, "XMin", "XMax")
    if "FitBehind" in slot_signals:
        begin -= value(slot_signals["FitBehind"], raw["FitBehind"])
        end += value(slot_signals["FitAhead"], raw["FitAhead"])
    has_quartic = "Quartic" in slot_signals
    quartic = value(slot_signals["Quartic"], raw["Quartic"]) if has_quartic else 0.0
    return Curve(mean, begin, end, quartic)


def own_covariance(
    layout: Layout, slot_signals: Mapping[str, Signal], raw: Raw, curve: Curve, common: Matrix
) -> Matrix:
    """Return D: all of its entries, or levels and what is common to all lines."""
    if raw.get("HasCovariance"):
        return decoded(code_of(layout), raw)
    cov = level_covariance(slot_signals, raw, curve) + common
    root = bases(curve) @ enlarged(cov).cholesky()
    return root @ root.T


def _valid_range(pose: Pose, curve: Curve, changes: Changes, own: Matrix) -> tuple[float, float]:
    """Return the valid range of a line that is conditional on the pose error [m].

    It leaves room for the errors of the pose and of the map. The heading of the map is a step
    larger than its level, since that was rounded. The greatest level may stand for more, but no
    more than the variance of beta has room for.
    """
    signal = pose.layout["MapHeading"]
    heading = pose.heading_sigma * exp2(signal.factor)
    is_greatest = pose.raw["MapHeading"] == signal.raw_max
    if is_greatest:
        turn = abs(changes.of_line()[0][2][1])
        heading = max(heading, math.sqrt(own[1][1]) / max(turn, MIN_TURN))
    x_min, x_max = valid_range(curve, pose.cov, own, heading)
    low, high = math.ceil(x_min * STEPS) / STEPS, math.floor(x_max * STEPS) / STEPS
    middle = (x_min + x_max) / 2
    return min(low, middle), max(high, middle) if low <= high else middle
