"""Cubics as lines, and what they are if they are seen from another pose.

A line is y(x) = y_off + tan(beta) x + c0/2 x^2 + c1/6 x^3 in a range, plus a multiple of what the
Chebyshev polynomial T_4 over that range is beside a cubic. To see it from another pose, transform
16 points of it, and fit a cubic to them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from .elementary import atan, sin_cos, tan
from .matrices import Matrix, Vector, diagonal, dot_by_halves, matrix, total

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

    mean: Vector  #: y_off [m], beta [rad], c0 [1/m], c1 [1/m^2]
    begin: float  #: of the range to which it was fitted [m]
    end: float
    quartic: float = 0.0  #: coefficient of T_4 [m]


#: Points: their x, and their y [m].
Points = tuple[Vector, Vector]


def cubic_fit(w: Vector, values: Vector, end_weight: float) -> tuple[Vector, Vector]:
    """Return the coefficients of w^0 .. w^3 of a cubic that is fitted to points, and the rest.

    It is fitted by polynomials that are orthogonal on the points (Forsythe 1957). Each of them is w
    times the one before, less its shares of the two before.
    """
    q, rest = Vector([0.0] * 4), values
    p, p_before = Vector([1.0] * len(w)), Vector([0.0] * len(w))
    c, c_before = Vector([1.0, 0.0, 0.0, 0.0]), Vector([0.0] * 4)  # coefficients of p
    norm_before = math.inf
    for _ in range(4):
        weighted = Vector([end_weight * p[0], *p[1:-1], end_weight * p[-1]])
        norm = dot_by_halves(weighted, p)
        share = dot_by_halves(weighted, rest) / norm
        q += share * c
        rest -= share * p
        a, b = dot_by_halves(weighted, w * p) / norm, norm / norm_before
        p, p_before = Vector(x - a for x in w) * p - b * p_before, p
        c, c_before = Vector([0.0, *c[:3]]) - a * c - b * c_before, c
        norm_before = norm
    return q, rest


def derivatives(q: Vector, centre: float, half: float) -> Vector:
    """Return value and derivatives at x = 0 of a cubic in w = (x - centre) / half."""
    r = 1 / half
    r2, w = 2 * r * r, -centre * r
    q3_w = q[3] * w
    value2 = q[2] + q3_w
    value1 = q[1] + w * value2
    slope2 = value2 + q3_w
    value = q[0] + w * value1
    return Vector([value, (value1 + w * slope2) * r, (slope2 + q3_w) * r2, q[3] * (3 * r2 * r)])


def extrema(n: int) -> Vector:
    """Return the n extrema of a Chebyshev polynomial, from 1 to -1."""
    return Vector(sin_cos(math.pi * k / (n - 1))[1] for k in range(n))


def places(begin: float, end: float, nodes: Sequence[float]) -> Vector:
    """Return the places of nodes from -1 to 1 in a range [m]."""
    centre, half = (begin + end) / 2, (end - begin) / 2
    return Vector(centre + half * node for node in nodes)


NODES = extrema(POINTS)
_T_4 = Vector(8 * (w * w * (w * w)) - 8 * (w * w) + 1 for w in NODES)
#: What a fitted cubic leaves of T_4.
BEND = cubic_fit(NODES, _T_4, END_WEIGHT)[1]


def y_of(mean: Vector, slope: float, x: float) -> float:
    """Return the lateral position of a line with tan(beta) at x [m]."""
    return mean[0] + x * (slope + x * (mean[2] / 2 + x * mean[3] / 6))


def lateral_row(slope: float, x: float) -> Vector:
    """Return the derivatives of the lateral position at x with respect to the parameters."""
    return Vector([1.0, (1 + slope * slope) * x, x * x / 2, x * x * x / 6])


def lateral_variance(slope: float, cov: Matrix, x: float) -> float:
    """Return the variance of the lateral position of a line with tan(beta) at x [m^2]."""
    row = lateral_row(slope, x)
    return Vector(row @ column for column in cov.T) @ row


#: Radius of the tightest turn of a car: a line may turn so beyond its range [m].
TIGHTEST_RADIUS = 5.0


def y_beyond(mean: Vector, cov: Matrix, end: float, x: float) -> tuple[float, float]:
    """Return the lateral position at x beyond an end of the range, and its standard deviation [m].

    The mean goes on with its second derivative at the end. The standard deviations of position,
    slope and second derivative there add up; a turn of ``TIGHTEST_RADIUS`` counts as three.
    """
    tangent = tan(mean[1])
    position = lateral_row(tangent, end)
    slope = Vector([0.0, 1 + tangent * tangent, end, end * end / 2])
    bend = Vector([0.0, 0.0, 1.0, end])
    s_y, s_m, s_k = (
        math.sqrt(max(0.0, Vector(row @ column for column in cov.T) @ row))
        for row in (position, slope, bend)
    )
    m, k = tangent + end * mean[2] + end * end / 2 * mean[3], bend @ mean
    y, d = y_of(mean, tangent, end), abs(x - end)
    turn = (1 + m * m) ** 1.5 / TIGHTEST_RADIUS / 3
    value = y + (x - end) * m + (x - end) ** 2 / 2 * k
    return value, s_y + s_m * d + (s_k + turn) * d * d / 2


def points_of(curve: Curve) -> Points:
    """Return 16 points of a line; y is NaN if it points backwards."""
    beta = curve.mean[1]
    slope = tan(beta) if abs(beta) < math.pi / 2 else math.nan
    x = places(curve.begin, curve.end, NODES)
    return x, Vector(y_of(curve.mean, slope, u) for u in x) + curve.quartic * BEND


def is_function(points: Points) -> bool:
    """Return whether points are those of a function of x that is nowhere too steep."""
    x, y = points
    sign = 1.0 if x[-1] > x[0] else -1.0
    pairs = zip(x, x[1:], y, y[1:], strict=False)
    return all(abs(t1 - t0) < STEEPEST * ((s1 - s0) * sign) for s0, s1, t0, t1 in pairs)


def is_line(curve: Curve) -> bool:
    """Return whether a line has a range, and is a function of x there."""
    return curve.begin < curve.end and is_function(points_of(curve))


def refitted(points: Points, pose: Sequence[float]) -> Vector | None:
    """Return the line of points from a pose (x, y, heading); None if it is no function of x."""
    d, c = sin_cos(pose[2])
    s, t = Vector(x - pose[0] for x in points[0]), Vector(y - pose[1] for y in points[1])
    u, v = c * s + d * t, c * t - d * s
    if not is_function((u, v)):
        return None
    centre, half = (u[0] + u[-1]) / 2, abs(u[0] - u[-1]) / 2
    coefficients, _ = cubic_fit(Vector((x - centre) / half for x in u), v, END_WEIGHT)
    line = derivatives(coefficients, centre, half)
    line[1] = atan(line[1])
    return line


def seen(points: Points, pose: Vector) -> Vector | None:
    """Return the line from a pose; where it is no function of x, it is extrapolated.

    From the mean pose through the farthest one, by halves, from where it is.
    """
    line = refitted(points, pose)
    if line is not None:
        return line
    mean, share = refitted(points, [0.0] * 3), 1.0
    for _ in range(HALVINGS if mean is not None else 0):
        share /= 2
        line = refitted(points, share * pose)
        if mean is not None and line is not None:
            return mean + (line - mean) / share
    return None


def seen_from(points: Points, poses: Sequence[Vector]) -> Matrix | None:
    """Return the lines from some poses; None if there is none from one of them."""
    found = Matrix(line for pose in poses if (line := seen(points, pose)) is not None)
    return found if len(found) == len(poses) else None


def pose_jacobian(points: Points) -> Matrix | None:
    """Return the (4, 3) derivatives of a line with respect to the pose."""
    steps = diagonal([STEP] * 3)
    ahead, back = seen_from(points, steps), seen_from(points, -1.0 * steps)
    return None if ahead is None or back is None else ((ahead - back) / (2 * STEP)).T


def bases(curve: Curve) -> Matrix:
    """Return the derivatives of a line with respect to its coefficients of T_0 .. T_3."""
    chebyshev = matrix([[1.0, 0, 0, 0], [0.0, 1, 0, 0], [-1.0, 0, 2, 0], [0.0, -3, 0, 4]])
    centre, half = (curve.begin + curve.end) / 2, (curve.end - curve.begin) / 2
    return line_derivatives(chebyshev, centre, half, curve.mean[1])


def line_derivatives(polynomials: Matrix, centre: float, half: float, beta: float) -> Matrix:
    """Return the derivatives of a line with respect to coefficients of cubics in its range."""
    J = Matrix(derivatives(q, centre, half) for q in polynomials).T
    _, cosine = sin_cos(beta)
    J[1] *= cosine * cosine
    return J


def sigma_points(P: Matrix) -> Matrix:
    """Return the six displaced sigma points of a pose error: columns of sqrt(3) L, then less them.

    P may be singular.
    """
    root = math.sqrt(3) * P.square_root().T
    return Matrix([*root, *(-1.0 * root)])


def centred(curve: Curve, poses: Matrix) -> Curve | None:
    """Return the line whose mean over the pose error is the given one, as seen from the mean pose.

    Twice, the mean over the sigma points is computed, and by how much it exceeds the line so far is
    subtracted from the given line. What is no function of x then is not taken.
    """
    line = curve
    for _ in range(2):
        found = seen_from(points_of(line), poses)
        if found is None:
            return None
        mean = Vector(total(column) / len(poses) for column in found.T)
        candidate = curve._replace(mean=curve.mean - (mean - line.mean))
        line = candidate if is_line(candidate) else line
    return line


def spread(curve: Curve, poses: Matrix) -> Matrix | None:
    """Return the (4, 7) factor A of the covariance that the pose error causes.

    Its columns are the deviations of the sigma points. The centre has the weights 0 in the mean and
    2 in the covariance. None if the line is no function of x near the mean pose.
    """
    line = centred(curve, poses)
    lines = line and seen_from(points_of(line), [Vector([0.0] * 3), *poses])
    if not lines:
        return None
    A = Matrix()
    for first, *others in lines.T:
        d = [x - first for x in others]
        mean = total(d) / len(d)
        A.append(Vector([*((x - mean) / math.sqrt(len(d)) for x in d), math.sqrt(2) * mean]))
    return A


def valid_range(curve: Curve, P: Matrix, own: Matrix, heading_sigma: float) -> tuple[float, float]:
    """Return the range of a line that is valid [m]: it does not end there from the true pose.

    Beside the pose error P, the map has an error of its heading [rad], and the line its own: the
    variance of the lateral position in the middle of the range is taken to act along the line, too.
    """
    mean, begin, end, _ = curve
    slope = tan(mean[1])
    shift = lateral_variance(slope, own, (begin + end) / 2)
    P += diagonal([shift, 0.0, heading_sigma * heading_sigma])
    margins = [margin_at(P, x, y_of(mean, slope, x)) for x in (begin, end)]
    return begin + margins[0], end - margins[1]


def margin_at(P: Matrix, x: float, y: float) -> float:
    """Return by how much pose errors with a covariance shorten a range at its end [m]."""
    variance = P[0][0] - 2 * y * P[0][2] + y * y * P[2][2]
    # A turned car sees the end of a line at x at about x cos(turn), which is nearer.
    shortening = 1 - sin_cos(min(MARGIN * math.sqrt(P[2][2]), math.pi / 2))[1]
    return MARGIN * math.sqrt(max(variance, 0.0)) + shortening * abs(x)
