"""The line within the ranges of a message that is nearest to one that exceeds them.

To clip one parameter alone moves the line by up to tens of metres: the others have to make up for
it. In a short range they do so to a few centimetres, since there the parameters of a cubic can be
told apart only poorly.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from ..wire.layout.record_signals import Signal
from .elementary import atan, clipped, sin_cos, tan
from .lines import lateral_row, places
from .matrices import Matrix, Vector, diagonal, matrix

#: Largest deviation of such a line from the given one in its range [m]: as much as a cubic may
#: deviate from the line of the map.
MAX_DEVIATION = 0.1
#: Factor by which a range is shortened towards the car, until the deviation is that small, and the
#: most times.
SHORTER, TRIALS = 0.8, 24
#: Greatest direction of such a line [rad].
STEEPEST = 1.5
#: Steps of its signal that a parameter keeps from the end of its range, for the rounding.
STEPS = 8
#: Share of the largest standard deviation of a parameter that may make up for its deviation.
SHARE = 0.7
#: Nodes at which lines are compared, in the normalised variable of a range: the extrema of a
#: Chebyshev polynomial. Between them, two cubics are at most 5 % further apart.
NODES = [-sin_cos(math.pi / 15 * k)[1] for k in range(16)]
#: Most steps of the least squares in a box. Each moves one parameter to its limit, or off it.
BOX_STEPS = 32
#: Least gradient for which a parameter moves off its limit, relative to the largest possible one.
FLAT = 1e-10


def nearest_line(
    signals: Sequence[Signal],
    mean: Vector,
    x_range: Sequence[float],
    least: float,
    reach: Vector,
) -> tuple[Vector, list[float]] | None:
    """Return the nearest line, and where it deviates by at most ``MAX_DEVIATION``.

    By least squares in the longest range, which is shortened towards the car as far as necessary.
    None if no line is near enough in any range of the least length. A covariance, whose variances
    reach so far, has to cover the deviation.
    """
    low, high, line = Vector(), Vector(), Vector(mean)
    for signal, x, variance in zip(signals, mean, reach, strict=True):
        (first, last), away = bounds(signal), SHARE * math.sqrt(variance)
        low.append(max(first, x - away))
        high.append(min(last, x + away))
    low[1], high[1] = (tan(clipped(x, -STEEPEST, STEEPEST)) for x in (low[1], high[1]))
    line[1] = tan(mean[1])
    scale = Vector(max(abs(a), abs(b)) for a, b in zip(low, high, strict=True))
    if not all(b - a > 1e-9 * s for a, b, s in zip(low, high, scale, strict=True)):
        return None
    first, last = x_range
    car, share = clipped(0.0, first, last), 1.0
    for _ in range(TRIALS):
        start, end = car + share * (first - car), car + share * (last - car)
        if end - start < least:
            return None
        # The lateral positions [m] at the nodes, for parameters of a scale each:
        A = Matrix(lateral_row(0.0, x) * scale for x in places(start, end, NODES))
        step = _box_solution(_triangular(A), (low - line) / scale, (high - line) / scale)
        if all(abs(row @ step) <= MAX_DEVIATION for row in A):
            near = Vector(map(clipped, line + step * scale, low, high))
            near[1] = atan(near[1])
            return near, [start, end]
        share *= SHORTER
    return None


def bounds(signal: Signal) -> tuple[float, float]:
    """Return the least and the greatest value of a parameter, some steps within its range."""
    low, high = signal.physical_range
    step = STEPS * signal.factor
    return low + step, high - step


def slope_error(beta: float, near: float) -> float:
    """Return the error of beta whose first-order effect is that of the slopes."""
    sine, cosine = sin_cos(near)
    return (tan(beta) - sine / cosine) * (cosine * cosine)


# ---- least squares in a box -------------------------------------------------------------------


def _triangular(A: Matrix) -> Matrix:
    """Return the upper triangular (n, n) R with R^T R = A^T A, by modified Gram-Schmidt."""
    columns, R = A.T, diagonal([0.0] * len(A[0]))
    for j, column in enumerate(columns):
        R[j][j] = math.sqrt(column @ column)
        for k in range(j + 1, len(columns) if R[j][j] > 0 else 0):
            unit = column / R[j][j]
            R[j][k] = unit @ columns[k]
            columns[k] -= R[j][k] * unit
    return R


def _box_solution(R: Matrix, low: Vector, high: Vector) -> Vector:
    """Return the u between ``low`` and ``high`` with the least |R u|: by active sets.

    A parameter is fixed at a limit or free. The free ones move towards their least squares until
    one reaches a limit, and is fixed there. If none does, the fixed one whose gradient points most
    into the box becomes free (Stark and Parker, Computational Statistics 10, 1995).
    """
    u = Vector(map(clipped, [0.0] * len(R), low, high))
    free = [i for i, x in enumerate(u) if x == 0.0]
    for _ in range(BOX_STEPS):
        target = _free_solution(R, free, u)
        share, limit = 1.0, -1
        for i in free:
            end = clipped(target[i], low[i], high[i])
            if end != target[i] and (end - u[i]) / (target[i] - u[i]) < share:
                share, limit = (end - u[i]) / (target[i] - u[i]), i
        for i in free:
            moved = target[i] if limit < 0 else u[i] + share * (target[i] - u[i])
            u[i] = clipped(moved, low[i], high[i])
        if limit >= 0:
            u[limit] = low[limit] if target[limit] < low[limit] else high[limit]
            free.remove(limit)
            continue
        rest = Vector(row @ u for row in R)
        size = math.sqrt(rest @ rest)
        steepest, released = 0.0, -1
        for i, column in enumerate(R.T):
            gradient, norm = column @ rest, math.sqrt(column @ column)
            inwards = -gradient if u[i] == low[i] else gradient
            is_inwards = i not in free and inwards > FLAT * norm * size
            if is_inwards and inwards / norm > steepest:
                steepest, released = inwards / norm, i
        if released < 0:
            break
        free = sorted([*free, released])
    return u


def _free_solution(R: Matrix, free: list[int], u: Vector) -> Vector:
    """Return u with its free entries replaced by those of the least |R u|."""
    fixed = Vector(0.0 if i in free else x for i, x in enumerate(u))
    T = _triangular(matrix([*(row[i] for i in free), -(row @ fixed)] for row in R))
    solution, m = Vector(u), len(free)
    for j in reversed(range(m)):
        rest = T[j][m]
        for k in range(j + 1, m):
            rest -= T[j][k] * solution[free[k]]
        solution[free[j]] = rest / T[j][j] if T[j][j] > 0 else u[free[j]]
    return solution
