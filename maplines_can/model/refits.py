"""A map line as a function of the pose: the cubic that it is, seen from there.

Points of its cubic in the longest range, and of the T_4 that it leaves, are turned, and a cubic is
fitted to them by least squares. As a rotation mixes u and v linearly, each sum of the normal
equations is a polynomial in the cosine and sine of the turn. What the map's error and the misfit
add to the covariance is independent of it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from itertools import accumulate, pairwise, repeat
from operator import mul
from typing import NamedTuple

from ..values.scene import MapError
from .cubic_ranges import (
    CELLS,
    ROWS,
    Fitted,
    Limits,
    coefficient_variances,
    cubic_at,
    longest_range,
)
from .elementary import atan, hypot, sin_cos
from .levels import NODES
from .lines import (
    MIN_ADVANCE,
    Curve,
    bases,
    cubic_fit,
    derivatives,
    places,
)
from .matrices import Matrix, Vector, diagonal, dot_by_halves, total
from .stretches import Stretches

#: Share of the advance of the chords that must not run backwards.
MIN_PROGRESS = 1 / 3
#: Smallest pivot of the normal equations; below it there are fewer than 4 distinct points.
MIN_PIVOT = 1e-13
#: The shape of a line is checked by chords from each third node to the next.
CHORD = 3
#: Highest power of u in the normal equations.
DEGREE = 6


#: A line that is no function of x.
UNKNOWN = Vector([math.nan] * 4)
#: Most halvings of the distance to a pose from which a line is no function of x.
HALVINGS = 60
#: Displacement for derivatives with respect to the pose [m, rad].
STEP = 1e-4
#: What a fit leaves of T_4, whose w^4 is rounded once, and of which a line has a multiple.
_T_4 = Vector(8 * float(Fraction(w) ** 4) - 8 * (w * w) + 1 for w in NODES)
BEND = cubic_fit(NODES, _T_4, end_weight=1.0)[1]


class Refit(NamedTuple):
    """A line as a function of the pose."""

    begin: float  #: of the range that the cubic describes, seen from the mean pose [m]
    end: float
    misfit: float  #: largest deviation of the cubic from the line [m]
    quartic: float  #: coefficient of T_4 that the cubic leaves of the line [m]
    x: Vector  #: points to which cubics are fitted [m]
    y: Vector
    pose: Vector  #: the mean pose
    centre: tuple[float, float]  #: of the points [m]
    half: float  #: of their range [m]
    of_u: list[Vector]  #: coefficients of mean(u^k) for k of 1 .. 6, see ``turned``
    of_v: list[Vector]  #: those of mean(v u^k) for k of 0 .. 3
    chords: list[tuple[float, float]]  #: [m]
    noise: Matrix  #: covariance of the map's error and of the misfit


def line_derivatives(polynomials: Matrix, centre: float, half: float, beta: float) -> Matrix:
    """Return the derivatives of a line with respect to coefficients of cubics in its range."""
    J = Matrix(derivatives(q, centre, half) for q in polynomials).T
    _, cosine = sin_cos(beta)
    J[1] *= cosine * cosine
    return J


def refit(
    seen: Stretches, line: int, pose: Sequence[float], limits: Limits, error: MapError | None
) -> Refit | None:
    """Return a stretch as a function of the pose; None if a cubic follows it nowhere."""
    fitted = longest_range(seen, line, limits)
    if fitted is None:
        return None
    begin, end = fitted.begin, fitted.end
    x = places(begin, end, NODES)
    y = Vector(
        cubic_at(fitted.q, w) + fitted.modes[0] * b for w, b in zip(NODES, BEND, strict=True)
    )
    centre, half = ((begin + end) / 2, (min(y) + max(y)) / 2), (end - begin) / 2
    of_u, of_v = sums_of(Vector((v - centre[1]) / half for v in y))
    points, noise = [*zip(x, y, strict=True)][::CHORD], diagonal([0.0] * 4)
    chords = [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(points)]
    found = Refit(
        begin, end, fitted.misfit, fitted.modes[0], x, y, Vector(pose), centre, half, of_u, of_v,
        chords, noise,
    )  # fmt: skip
    mean, variance = line_at(found, pose) or UNKNOWN, 0.0
    if error is not None:
        variance = error.point_sigma * error.point_sigma
        noise = drift_noise(found, error)
    if math.isfinite(limits.max_misfit):
        widened = seen.shown[line].widened
        variance = widened if widened > variance else variance
        J = bases(Curve(mean, begin, end))
        noise += Matrix(row * coefficient_variances(seen, line, fitted) for row in J) @ J.T
    if variance > 0:
        J = line_derivatives(diagonal([1.0] * 4), centre[0], half, mean[1])
        noise += variance * J.congruence(fit_covariance(seen, fitted))
    return found._replace(noise=noise)


# ---- the line seen from a pose ----------------------------------------------------------------


def sums_of(b: Vector) -> tuple[list[Vector], list[Vector]]:
    """Return the coefficients of c^(d - j) s^j in the sums of degree d of turned points.

    The points (a, b), with the nodes as a, become u = c a + s b and v = c b - s a.
    """
    ones = Vector([1.0] * len(NODES))
    powers_a, powers_b = ([*accumulate(repeat(x, DEGREE), mul, initial=ones)] for x in (NODES, b))

    def moment(i: int, j: int) -> float:
        return dot_by_halves(powers_a[i], powers_b[j]) / len(NODES)

    of_u = [
        Vector(math.comb(k, j) * moment(k - j, j) for j in range(k + 1))
        for k in range(1, DEGREE + 1)
    ]
    of_v = []
    for k in range(4):
        ahead = [math.comb(k, j) * moment(k - j, j + 1) for j in range(k + 1)]
        aside = [math.comb(k, j) * moment(k + 1 - j, j) for j in range(k + 1)]
        of_v.append(Vector([*ahead, 0.0]) - Vector([0.0, *aside]))
    return of_u, of_v


def turned(coefficients: Vector, c: list[float], s: list[float]) -> float:
    """Return a sum of turned points, from the powers of the cosine and sine."""
    d = len(coefficients) - 1
    return coefficients @ [c[d - j] * s[j] for j in range(d + 1)]


def normal_solution(m: Sequence[float], r: Sequence[float]) -> Vector | None:
    """Return the cubic v(u) from mean(u^k) and mean(v u^k); None for too few distinct points."""
    m1, m2, m3, m4, m5, m6 = m
    a11, a12, a13 = m2 - m1 * m1, m3 - m1 * m2, m4 - m1 * m3
    if not a11 > MIN_PIVOT:
        return None
    f2, f3 = a12 / a11, a13 / a11
    a22, a23 = m4 - m2 * m2 - f2 * a12, m5 - m2 * m3 - f2 * a13
    if not a22 > MIN_PIVOT:
        return None
    f = a23 / a22
    a33 = m6 - m3 * m3 - f3 * a13 - f * a23
    if not a33 > MIN_PIVOT:
        return None
    r1, r2, r3 = (r[k] - r[0] * m[k - 1] for k in (1, 2, 3))
    r2 = r2 - f2 * r1
    r3 = r3 - f3 * r1 - f * r2
    q3 = r3 / a33
    q2 = r2 / a22 - f * q3
    q1 = r1 / a11 - f2 * q2 - f3 * q3
    return Vector([r[0] - (m1 * q1 + m2 * q2 + m3 * q3), q1, q2, q3])


def is_function_after(chords: Sequence[tuple[float, float]], c: float, s: float) -> bool:
    """Return whether points are a function of x after a turn, and not nearly across it."""
    net = abs(c * total([x for x, _ in chords]) + s * total([y for _, y in chords]))
    if not net >= least_advance(chords):
        return False
    slopes = [y / x for x, y in chords]
    if c + s * min(slopes) > 0 and c + s * max(slopes) > 0:
        return True  # all of it runs ahead
    return net >= MIN_PROGRESS * total([abs(c * x + s * y) for x, y in chords])


def least_advance(chords: Sequence[tuple[float, float]]) -> float:
    """Return the least distance that the points must advance along the x axis [m]."""
    return MIN_ADVANCE * total([hypot(x, y) for x, y in chords])


def is_across(line: Refit) -> bool:
    """Return whether a line is nearly perpendicular to the x axis of the mean pose."""
    return 2 * line.half < least_advance(line.chords)


def line_at(line: Refit, pose: Sequence[float]) -> Vector | None:
    """Return the line from a pose in the frame of the map; None if it is no function of x there."""
    s, c = sin_cos(pose[2] - line.pose[2])
    of_c, of_s = ([*accumulate(repeat(x, DEGREE), mul, initial=1.0)] for x in (c, s))
    m, r = ([turned(row, of_c, of_s) for row in rows] for rows in (line.of_u, line.of_v))
    q = normal_solution(m, r)
    if q is None or not is_function_after(line.chords, c, s):
        return None
    east, north = pose[0] - line.pose[0], pose[1] - line.pose[1]
    sine, cosine = sin_cos(line.pose[2])
    x = line.centre[0] - (cosine * east + sine * north)
    y = line.centre[1] - (cosine * north - sine * east)
    q *= line.half
    q[0] += c * y - s * x
    found = derivatives(q, c * x + s * y, line.half)
    found[1] = atan(found[1])
    return found


def line_or_extended(line: Refit, pose: Sequence[float]) -> Vector | None:
    """Return the line from a pose, extrapolated from the mean pose where it is no function."""
    found = line_at(line, pose)
    if found is not None:
        return found
    mean, share = line_at(line, line.pose) or UNKNOWN, 1.0
    for _ in range(HALVINGS):
        share /= 2
        found = line_at(line, line.pose + share * (Vector(pose) - line.pose))
        if found is not None:
            found = mean + (found - mean) / share
            return None if math.isnan(found[0]) else found
    return None


# ---- errors of the map ------------------------------------------------------------------------


def drift_noise(line: Refit, error: MapError) -> Matrix:
    """Return the covariance due to what of the error of the map acts as a pose error."""
    columns, sigmas = Matrix(), (error.offset_sigma, error.offset_sigma, error.heading_sigma)
    for step, sigma in zip(diagonal([STEP] * 3), sigmas, strict=True):
        ahead, back = (line_at(line, one) for one in (line.pose + step, line.pose - step))
        columns.append(((ahead or UNKNOWN) - (back or UNKNOWN)) / (2 * STEP) * sigma)
    return columns.T @ columns


def fit_covariance(seen: Stretches, fitted: Fitted) -> Matrix:
    """Return the covariance of the coefficients of a cubic for independent errors of 1 m.

    They are those of the points, in any direction. A cell has the errors of its chords, and a chord
    those of its two ends.
    """
    position, q, rows = fitted.cells.position, fitted.q, ROWS[CELLS][:4]
    half = (fitted.end - fitted.begin) / 2
    length = 2 * half / CELLS
    before, after, S = Vector([0.0] * 4), Vector([0.0] * 4), diagonal([0.0] * 4)
    i = int(position[0])
    for k, (start, to) in enumerate(pairwise(position)):
        w = (2 * k + 1) / CELLS - 1
        slope = (q[1] + (2 * q[2] + 3 * q[3] * w) * w) / half
        factor = math.sqrt(1 + slope * slope)  # errors in x act by the slope
        row = Vector(one[k] for one in rows)
        while start < to:
            until = min(to, i + 1.0)
            share = (until - start) * (seen.keys[i + 1] - seen.keys[i]) / length * factor
            ahead = share * ((start + until) / 2 - i)
            before, after = before + row * (share - ahead), after + row * ahead
            start = until
            if until == i + 1:
                S += before.outer()
                before, after, i = after, Vector([0.0] * 4), i + 1
    S += before.outer()
    S += after.outer()
    return fitted.fit.congruence(S)
