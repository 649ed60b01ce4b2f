"""Cubics as lines, and how they change with the pose from which they are seen.

A line is y(x) = y_off + tan(beta) x + c0/2 x^2 + c1/6 x^3 in a range, plus a multiple of what the
Chebyshev polynomial T_4 over that range is beside a cubic.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from .elementary import sin_cos, tan
from .matrices import Matrix, Vector, diagonal, dot_by_halves, matrix

#: Points of a line, and the weight of both ends in a fit; that of the others is 1.
POINTS, END_WEIGHT = 16, 0.62
#: A line that advances along x by less than this share of its length is no function of x.
MIN_ADVANCE = 0.17
STEEPEST = math.sqrt(1 / (MIN_ADVANCE * MIN_ADVANCE) - 1)
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


def bases(curve: Curve) -> Matrix:
    """Return the derivatives of a line with respect to its coefficients of T_0 .. T_3.

    The rows are these polynomials and their derivatives at x = 0.
    """
    by_x, tangent = 1 / ((curve.end - curve.begin) / 2), tan(curve.mean[1])
    w = -((curve.begin + curve.end) / 2) * by_x
    slope, twice = by_x / (1 + tangent * tangent), by_x * by_x
    return matrix(
        [
            [1.0, w, 2 * (w * w) - 1, w * (4 * (w * w) - 3)],
            [0.0, slope, slope * 4 * w, slope * (12 * (w * w) - 3)],
            [0.0, 0.0, 4 * twice, 24 * w * twice],
            [0.0, 0.0, 0.0, 24 * (twice * by_x)],
        ]
    )


class Changes(NamedTuple):
    """How a line changes with the pose from which it is seen, to second order.

    From a pose that is ``a`` further along, ``b`` further across and turned by ``t``, the points of
    the line move by u1 + u2 along x and by v1 + v2 along y, with

        u1 = t y - a,  u2 = -t b - t^2 x / 2,  v1 = -t x - b,  v2 = t a - t^2 y / 2

    and the cubic that is fitted to them by p1 + p2. With F(v) a fit to values v at the points of
    the line, M(v) what moving the points by 1 m changes of it, if v is left by a fit, m and k the
    slope and the second derivative of the cubic, and r what it leaves of the line:

        f1 = v1 - m u1                          p1 = F(f1) + M(u1 r)
        f2 = v2 - m u2 - k u1^2 / 2 - p1' u1    p2 = F(f2) + M(u1 (f1 - p1))
    """

    bases: Matrix  #: derivatives of the line with respect to its coefficients of T_0 .. T_3
    tangent: float  #: tan(beta)
    first: Matrix  #: changes of these coefficients by a, b, t
    second: Matrix  #: by the products t^2, t a, t b, a^2

    def of_line(self) -> tuple[Matrix, Matrix]:
        """Return the changes of the line itself."""
        first, second = (self._in_line(rows) for rows in (self.first, self.second))
        a, t = first[0][1], first[2][1]
        second[0][1] -= self.tangent * t * t  # the second derivative of atan
        second[1][1] -= 2 * (self.tangent * t * a)
        second[3][1] -= self.tangent * a * a
        return first, second

    def _in_line(self, rows: Matrix) -> Matrix:
        upper = [Vector(row[i:]) for i, row in enumerate(self.bases)]
        return matrix([each @ row[i:] for i, each in enumerate(upper)] for row in rows)


#: Roots of T_8 that are positive, from the greatest on; and T_2 and T_3 there.
ROOTS = Vector(sin_cos(math.pi * (2 * k + 1) / 16)[1] for k in range(4))
_T_2 = 2.0 * ROOTS * ROOTS - Vector([1.0] * 4)
_T_3 = 2.0 * ROOTS * _T_2 - ROOTS


def _fitted(values: Sequence[float]) -> Vector:
    """Return the coefficients of T_0 .. T_3 of the cubic nearest to values at the roots of T_8."""
    first, last = Vector(values[:4]), Vector(values[:3:-1])
    even, odd = first + last, first - last
    ones = Vector([1.0] * 4)
    return Vector([even @ ones / 8, odd @ ROOTS / 4, even @ _T_2 / 4, odd @ _T_3 / 4])


def _moved(values: Sequence[float], by_x: float) -> Vector:
    """Return M of values that a fit leaves; by_x is 1 over half of the length of the range."""
    c = _fitted(values)
    # T_1' = T_0, T_2' = 4 T_1 and T_3' = 6 T_2 + 3 T_0; T_0 has twice the norm of the others.
    return Vector([0.0, 2 * c[0], 4 * c[1], 6 * (c[2] + c[0])]) * by_x


def changes_of(curve: Curve) -> Changes:
    """Return how a line changes with the pose from which it is seen."""
    y_off, beta, c0, c1 = curve.mean
    centre, half = (curve.begin + curve.end) / 2, (curve.end - curve.begin) / 2
    by_x, tangent, sixth, rows = 1 / half, tan(beta), c1 / 6, Matrix()
    triples = [*zip(ROOTS, _T_2, _T_3, strict=True)]
    places = [*((1, *each) for each in triples), *((-1, *each) for each in triples[::-1])]
    for sign, w, t2, _ in places:
        x = centre + sign * (half * w)
        bend = x * c1
        m, k = tangent + x * (c0 + bend / 2), c0 + bend
        rest = curve.quartic * (2 * (t2 * t2) - 1)
        y = y_off + x * (tangent + x * (c0 / 2 + x * sixth)) + rest
        rows.append(Vector([y, -(x + m * y), m, (m * x - y - k * y * y) / 2, k / 2, rest * y]))
    y_, f1, m_, f2, aa_, rest_y = rows.T
    t = _fitted(f1) + _moved(rest_y, by_x)
    left = Vector()
    for i, (sign, w, t2, t3) in enumerate(places):
        value = t[0] + t[2] * t2 + sign * (t[1] * w + t[3] * t3)
        slope = (t[1] + t[3] * (6 * t2 + 3) + sign * (4 * t[2] * w)) * by_x
        f2[i] -= slope * y_[i]
        left.append((f1[i] - value) * y_[i])
    a, tt, aa = _fitted(m_), _fitted(f2) + _moved(left, by_x), _fitted(aa_)
    ta = Vector([1 + (t[1] + 3 * t[3]) * by_x, 4 * t[2] * by_x, 6 * t[3] * by_x, 0.0])
    across = Vector([-1.0, 0.0, 0.0, 0.0])
    return Changes(bases(curve), tangent, Matrix([a, across, t]), Matrix([tt, ta, a, aa]))


def pose_roots(P: Matrix) -> tuple[Matrix, Matrix]:
    """Return the lower triangular root L of P, and what sigma points make of t^2, ta, tb and a^2.

    P may be singular. The points are sqrt(3) times the columns of L, and less them. With s_k these
    products for a column and m their sum, the second has the columns (3 s_k - m) / sqrt(3), and
    sqrt(2) m: the centre has the weights 0 in the mean and 2 in the covariance.
    """
    L = diagonal([0.0] * 3)
    for k in range(3):
        pivot = P[k][k]
        for j in range(k):
            pivot -= L[k][j] * L[k][j]
        L[k][k] = 0.0 if pivot < 0 else math.sqrt(pivot)
        for i in range(k + 1, 3):
            rest = P[i][k]
            for j in range(k):
                rest -= L[i][j] * L[k][j]
            L[i][k] = rest / L[k][k] if pivot > 0 else 0.0
    products = [Vector([t * t, t * a, t * b, a * a]) for a, b, t in L.T]
    m = products[0] + products[1] + products[2]
    columns = [*((3 * each - m) * (1 / math.sqrt(3)) for each in products), math.sqrt(2) * m]
    return L, Matrix(columns).T


def spread(changes: Changes, P: Matrix) -> Matrix | None:
    """Return the (4, 7) factor A of the covariance that a pose error with covariance P causes.

    It is that of sigma points to second order: with the changes W1, W2 and the roots L1, L2 of the
    pose error and of its products, A = [W1^T L1, W2^T L2]. None if it overflows.
    """
    (first, second), (L1, L2) = changes.of_line(), pose_roots(P)
    A = Matrix()
    for one, two in zip(first.T, second.T, strict=True):
        by_pose = [Vector(one[k:]) @ column[k:] for k, column in enumerate(L1.T)]
        A.append(Vector([*by_pose, *(two @ column for column in L2.T)]))
    return A if A.is_finite() else None


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
