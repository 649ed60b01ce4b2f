"""Cubics as lines, and what they are if they are seen from another pose.

A line is y(x) = y_off + tan(beta) x + c0/2 x^2 + c1/6 x^3 in a range, plus a multiple of what the
Chebyshev polynomial T_4 over that range is beside a cubic. To see it from another pose, transform
16 points of it, and fit a cubic to them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from .elementary import PI_BY_2, atan, sin_cos, tan
from .matrices import (
    Matrix,
    Row,
    diagonal,
    dot,
    dot_by_halves,
    entrywise,
    square_root,
    total,
    transposed,
)

#: Points of a line, and the weight of both ends in a fit; that of the others is 1.
POINTS, END_WEIGHT = 16, 0.62
#: A line that advances along x by less than this share of its length is no function of x.
MIN_ADVANCE = 0.17
STEEPEST = math.sqrt(1 / (MIN_ADVANCE * MIN_ADVANCE) - 1)
#: Halvings of the distance to a pose from which a line is no function of x.
HALVINGS = 60
#: Displacement for derivatives with respect to the pose [m, rad].
STEP = 1e-4
#: Standard deviations of the pose error by which a valid range is shortened.
MARGIN = 3.0


class Curve(NamedTuple):
    """A line."""

    mean: Row  #: y_off [m], beta [rad], c0 [1/m], c1 [1/m^2]
    begin: float  #: of the range to which it was fitted [m]
    end: float
    quartic: float  #: coefficient of T_4 [m]


#: Points: their x, and their y [m].
Points = tuple[Row, Row]


def cubic_fit(w: Row, values: Row, end_weight: float) -> tuple[Row, Row]:
    """Return the coefficients of w^0 .. w^3 of a cubic that is fitted to points, and the rest.

    It is fitted by polynomials that are orthogonal on the points (Forsythe 1957). Each of them is w
    times the one before, less its shares of the two before.
    """
    q, rest = [0.0] * 4, values
    p, p_before = [1.0] * len(w), [0.0] * len(w)
    c, c_before = [1.0, 0.0, 0.0, 0.0], [0.0] * 4  # coefficients of p
    norm_before = math.inf
    for _ in range(4):
        weighted = [end_weight * p[0], *p[1:-1], end_weight * p[-1]]
        norm = dot_by_halves(weighted, p)
        share = dot_by_halves(weighted, rest) / norm
        q = [x + share * y for x, y in zip(q, c, strict=True)]
        rest = [x - share * y for x, y in zip(rest, p, strict=True)]
        a = dot_by_halves(weighted, [x * y for x, y in zip(w, p, strict=True)]) / norm
        b = norm / norm_before
        p, p_before = [(x - a) * y - b * z for x, y, z in zip(w, p, p_before, strict=True)], p
        raised = [0.0, *c[:3]]
        c, c_before = [r - a * x - b * z for r, x, z in zip(raised, c, c_before, strict=True)], c
        norm_before = norm
    return q, rest


def derivatives(q: Row, centre: float, half: float) -> Row:
    """Return value and derivatives at x = 0 of a cubic in w = (x - centre) / half."""
    r = 1 / half
    r2, w = 2 * r * r, -centre * r
    q3_w = q[3] * w
    value2 = q[2] + q3_w
    value1 = q[1] + w * value2
    slope2 = value2 + q3_w
    return [
        q[0] + w * value1,
        (value1 + w * slope2) * r,
        (slope2 + q3_w) * r2,
        q[3] * (3 * r2 * r),
    ]


def extrema(n: int) -> Row:
    """Return the n extrema of a Chebyshev polynomial, from 1 to -1."""
    return [sin_cos(math.pi * k / (n - 1))[1] for k in range(n)]


NODES = extrema(POINTS)


def _t_4(w: float) -> float:
    square = w * w
    return 8 * (square * square) - 8 * square + 1


#: What a fitted cubic leaves of T_4.
BEND = cubic_fit(NODES, [_t_4(w) for w in NODES], END_WEIGHT)[1]


def y_of(mean: Row, slope: float, x: float) -> float:
    """Return the lateral position of a line with tan(beta) at x [m]."""
    return mean[0] + x * (slope + x * (mean[2] / 2 + x * mean[3] / 6))


def points_of(curve: Curve) -> Points:
    """Return 16 points of a line; y is NaN if it points backwards."""
    beta = curve.mean[1]
    slope = tan(beta) if abs(beta) < PI_BY_2 else math.nan
    middle, half = (curve.begin + curve.end) / 2, (curve.end - curve.begin) / 2
    x = [middle + half * node for node in NODES]
    bends = [curve.quartic * bend for bend in BEND]
    return x, [y_of(curve.mean, slope, u) + bend for u, bend in zip(x, bends, strict=True)]


def is_function(points: Points) -> bool:
    """Return whether points are those of a function of x that is nowhere too steep."""
    x, y = points
    sign = 1.0 if x[-1] > x[0] else -1.0
    pairs = zip(x, x[1:], y, y[1:], strict=False)
    return all(abs(t1 - t0) < STEEPEST * ((s1 - s0) * sign) for s0, s1, t0, t1 in pairs)


def refitted(points: Points, pose: Row) -> Row | None:
    """Return the line of points from a pose (x, y, heading); None if it is no function of x."""
    d, c = sin_cos(pose[2])
    s, t = [x - pose[0] for x in points[0]], [y - pose[1] for y in points[1]]
    u = [c * x + d * y for x, y in zip(s, t, strict=True)]
    v = [c * y - d * x for x, y in zip(s, t, strict=True)]
    if not is_function((u, v)):
        return None
    centre, half = (u[0] + u[-1]) / 2, abs(u[0] - u[-1]) / 2
    coefficients, _ = cubic_fit([(x - centre) / half for x in u], v, END_WEIGHT)
    line = derivatives(coefficients, centre, half)
    line[1] = atan(line[1])
    return line


def seen(points: Points, pose: Row) -> Row | None:
    """Return the line from a pose; where it is no function of x, it is extrapolated.

    From the mean pose through the farthest one, by halves, from where it is.
    """
    line = refitted(points, pose)
    if line is not None:
        return line
    mean, share = refitted(points, [0.0] * 3), 1.0
    for _ in range(HALVINGS if mean is not None else 0):
        share /= 2
        line = refitted(points, [share * x for x in pose])
        if mean is not None and line is not None:
            return [m + (x - m) / share for x, m in zip(line, mean, strict=True)]
    return None


def seen_from(points: Points, poses: Sequence[Row]) -> list[Row] | None:
    """Return the lines from some poses; None if there is none from one of them."""
    found = [line for pose in poses if (line := seen(points, pose)) is not None]
    return found if len(found) == len(poses) else None


def pose_jacobian(points: Points) -> Matrix | None:
    """Return the (4, 3) derivatives of a line with respect to the pose."""
    steps = diagonal([STEP] * 3)
    ahead, back = seen_from(points, steps), seen_from(points, [[-x for x in d] for d in steps])
    if ahead is None or back is None:
        return None
    return transposed(entrywise(lambda a, b: (a - b) / (2 * STEP), ahead, back))


def bases(curve: Curve) -> Matrix:
    """Return the derivatives of a line with respect to its coefficients of T_0 .. T_3."""
    chebyshev = ([1.0, 0, 0, 0], [0.0, 1, 0, 0], [-1.0, 0, 2, 0], [0.0, -3, 0, 4])
    centre, half = (curve.begin + curve.end) / 2, (curve.end - curve.begin) / 2
    J = transposed([derivatives(q, centre, half) for q in chebyshev])
    _, cosine = sin_cos(curve.mean[1])
    J[1] = [x * (cosine * cosine) for x in J[1]]
    return J


def sigma_points(P: Matrix) -> list[Row]:
    """Return the six displaced sigma points of a pose error: columns of sqrt(3) L, then less them.

    P may be singular.
    """
    root = [[math.sqrt(3) * x for x in column] for column in transposed(square_root(P))]
    return root + [[-x for x in column] for column in root]


def centred(curve: Curve, poses: list[Row]) -> Curve | None:
    """Return the line whose mean over the pose error is the given one, as seen from the mean pose.

    Twice, the mean over the sigma points is computed, and by how much it exceeds the line so far is
    subtracted from the given line. What is no function of x then is not taken.
    """
    line = curve
    for _ in range(2):
        found = seen_from(points_of(line), poses)
        if found is None:
            return None
        means = [total(column) / len(poses) for column in zip(*found, strict=True)]
        moved = [
            given - (mean - x) for given, mean, x in zip(curve.mean, means, line.mean, strict=True)
        ]
        candidate = curve._replace(mean=moved)
        line = candidate if is_function(points_of(candidate)) else line
    return line


def spread(curve: Curve, poses: list[Row]) -> Matrix | None:
    """Return the (4, 7) factor A of the covariance that the pose error causes.

    Its columns are the deviations of the sigma points. The centre has the weights 0 in the mean and
    2 in the covariance. None if the line is no function of x near the mean pose.
    """
    line = centred(curve, poses)
    if line is None:
        return None
    lines = seen_from(points_of(line), [[0.0] * 3, *poses])
    if lines is None:
        return None
    A = []
    for first, *others in zip(*lines, strict=True):
        d = [x - first for x in others]
        mean = total(d) / len(d)
        A.append([*((value - mean) / math.sqrt(len(d)) for value in d), math.sqrt(2) * mean])
    return A


def valid_range(curve: Curve, P: Matrix, own: Matrix, heading_sigma: float) -> tuple[float, float]:
    """Return the range of a line that is valid [m]: it does not end there from the true pose.

    Args:
        curve: the line with its fit range.
        P: covariance of the pose.
        own: line-specific covariance; the variance of the lateral position in the middle of the
            range is taken to act along the line, too.
        heading_sigma: of the map [rad].
    """
    slope = tan(curve.mean[1])
    middle = (curve.begin + curve.end) / 2
    square = middle * middle
    J = [1.0, (1 + slope * slope) * middle, square / 2, square * middle / 6]
    shift = dot([dot(J, column) for column in zip(*own, strict=True)], J)
    heading = P[2][2] + heading_sigma * heading_sigma
    # A turned car sees the end of a line at x at about x cos(turn), which is nearer.
    shortening = 1 - sin_cos(min(MARGIN * math.sqrt(heading), PI_BY_2))[1]

    def margin(x: float) -> float:
        y = y_of(curve.mean, slope, x)
        variance = P[0][0] + shift - 2 * y * P[0][2] + y * y * heading
        return MARGIN * math.sqrt(max(variance, 0.0)) + shortening * abs(x)

    return curve.begin + margin(curve.begin), curve.end - margin(curve.end)
