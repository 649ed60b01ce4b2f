"""Cubics of map lines: the longest range in which one follows its line, and what it misses there.

The points of a line are samples of the road, each with an error. A range is divided into cells, and
a cubic is fitted by least squares so that the means of its chords between the points are those of
the line: it is exact where the points lie on a cubic, however far apart they are. Weights of the
cells are their shares of the measure of Chebyshev, so that the fit is best near the ends, too. What
is left of the line after averages over some metres is compared with what errors of the points
leave; the rest is the shape of the road that the cubic misses.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import accumulate, pairwise
from typing import NamedTuple

from .elementary import atan, clipped
from .levels import SHAPE
from .matrices import Matrix, Vector, dot_by_halves, matrix
from .stretches import Cells, Shown, Stretches

#: Cells of a range, and of a range that is tried.
CELLS, COARSE_CELLS = 64, 16
#: Damping of the inverse that takes curvatures of chords to those of a cubic.
DAMPING = 0.05
#: A cubic may differ from its chords by this share of the sagittas that points show.
BULGE = 0.5
#: Length over which what a cubic leaves is averaged [m].
AVERAGE = 4.0
#: Variances of a mean that errors of the points explain in the greatest one, and of the rest in a
#: cell.
NOISE_LIMIT, NARROW_LIMIT = 14.0, 25.0
#: Points in a range of which half of what they show is taken for their errors.
SHARED_POINTS = 20.0
#: Squared misfit of kinks that errors hide, by their intensity and the cubed length; level of the
#: shape for them.
BY_KINKS, SHAPE_BY_KINKS = 3e-4, 7e-4
#: Starts of the ranges that are tried, as shares of the way from the car back to the window's end;
#: ends of each, evenly from the car to the window's end.
STARTS, ENDS = (0.0, 0.15, 0.35, 0.65, 1.0), 6
#: Width of the root of the misfit in which a range becomes bad; least step of the root.
SOFT, LEAST_STEP = 0.2, 1e-6
#: A metre behind the car counts this share of a metre ahead; ranges whose reach is less than the
#: best by up to this length count, too [m].
BEHIND, NEARLY = 0.5, 8.0
#: Share of a range that is kept at most if its misfit is still too large, and how often at most.
SHRINK, SHRINKS = 0.998, 200
#: Distances over which second differences are covered [m]. For each of these, variances of noise
#: that explain the largest second differences, and their mean square. Those over short distances,
#: which tell least of the shape, are hardest to tell from noise.
SPACINGS, FAR_NOISE, MEAN_NOISE = (5.0, 10.0, 20.0), (25.0, 12.0, 7.0), (8.0, 6.0, 4.0)
#: Least level of the shape, and standard deviation of T_0 beside the misfit [m].
MIN_SIGMA = 0.004
#: Variance of T_0, and least one of the level of the shape, in units of the squared misfit.
LATERAL_SHARE, MIN_SHAPE = 0.2, 0.1
#: Places of second differences in a range; their greatest distance, as a share of it.
PLACES, LONGEST = 32, 0.4
#: Standard deviations within which second differences lie, but for one; mean square of these, in
#: units of their variances, at most.
LIMIT, MEAN_SQUARE = 2.3, 1.4
#: For T_4 and T_5: mean squares of second derivatives, in units of the variance that they need;
#: variances of noise that explain them; and these by the errors of one point.
MODE_LEVELS, MODE_NOISE, MODE_VARIANCES = (2.6, 6.5), (0.1, 0.8), (3.8, 3.62)


def cell_means(n: int) -> Matrix:
    """Return the (6, n) means of w^0 .. w^5 in n cells of equal length, from -1 to 1."""
    h = 1 / n
    w = Vector((2 * k + 1) * h - 1 for k in range(n))
    ones, square, h2 = Vector([1.0] * n), w * w, h * h
    fourth = square * square + 2 * h2 * square + h2 * h2 / 5 * ones
    fifth = (fourth + 4 / 3 * h2 * square + 4 / 5 * h2 * h2 * ones) * w
    return Matrix([ones, w, square + h2 / 3 * ones, (square + h2 * ones) * w, fourth, fifth])


def cell_weights(n: int) -> Vector:
    """Return the shares of the cells of the measure of Chebyshev, times pi."""
    ends = [2 * k / n - 1 for k in range(n + 1)]
    angles = [atan(w / math.sqrt(1 - w * w)) if abs(w) < 1 else w * math.pi / 2 for w in ends]
    return Vector(b - a for a, b in pairwise(angles))


def cell_rows(n: int) -> Matrix:
    """Return the (6, n) matrix from means in cells to the coefficients of a fit.

    They are those of w^0 .. w^3, and of T_4 and T_5 in what these leave.
    """
    means, weights = cell_means(n), cell_weights(n)
    weighted = Matrix(weights * row for row in means[:4])
    gram = matrix([dot_by_halves(a, b) for b in means[:4]] for a in weighted)
    rows = gram.inverse() @ weighted
    for mode in (
        8 * means[4] - 8 * means[2] + means[0],
        16 * means[5] - 20 * means[3] + 5 * means[1],
    ):
        rest = mode
        for row, mean in zip(rows[:4], means[:4], strict=True):
            rest = rest - dot_by_halves(row, mode) * mean
        own = weights * rest
        rows.append(own / dot_by_halves(own, rest))
    return rows


ROWS = {n: cell_rows(n) for n in (CELLS, COARSE_CELLS)}


class Fitted(NamedTuple):
    """Cubic of a line in a range."""

    begin: float  #: of the range [m]
    end: float
    q: Vector  #: coefficients of w^0 .. w^3 [m]
    modes: tuple[float, float]  #: of T_4 and T_5, which it leaves of the line [m]
    cells: Cells
    rest: Vector  #: what it leaves in the cells [m]
    fit: Matrix  #: (4, 4), from the coefficients of chords between the points to q
    square: float  #: of the misfit, what it misses beside errors of the points at most [m^2]

    @property
    def misfit(self) -> float:
        """What the cubic misses of the line at most, beside errors of its points [m]."""
        return math.sqrt(self.square)


class Limits(NamedTuple):
    """How far a cubic may go."""

    max_misfit: float  #: largest deviation from the line [m]
    room: float = 0.0  #: distance behind the car at which a range begins at least [m]
    step: float = 0.0  #: of which the ends of ranges are multiples; 0 for any [m]


def cubic_at(q: Vector, w: float) -> float:
    """Return the value of a cubic."""
    return q[0] + w * (q[1] + w * (q[2] + w * q[3]))


# ---- the cubic of a range ---------------------------------------------------------------------


def chord_fit(squares: Vector, cubes: Vector) -> Matrix:
    """Return the (4, 4) matrix from the coefficients of chords to those of their cubic.

    The chords of w^2 and w^3 exceed these by what has the given coefficients. The curvature
    (q2, q3) solves M q = that of the chords. M is 1 for close points. Where few points cannot tell
    the curvature, M is nearly singular, and the least curvature is taken.
    """
    a, b, c, d = 1 + squares[2], cubes[2], squares[3], 1 + cubes[3]
    weight = DAMPING * DAMPING
    aa, ab, bb = a * a + c * c + weight, a * b + c * d, b * b + d * d + weight
    scale = (1 + weight) / (aa * bb - ab * ab)
    by_square = (bb * a - ab * b) * scale, (bb * c - ab * d) * scale
    by_cube = (aa * b - ab * a) * scale, (aa * d - ab * c) * scale
    fit = [[float(i == j) for j in range(2)] for i in range(2)] + [[0.0, 0.0], [0.0, 0.0]]
    for i in range(2):
        fit[i] += [
            -(squares[i] * s + cubes[i] * c) for s, c in zip(by_square, by_cube, strict=True)
        ]
    fit[2] += by_square
    fit[3] += by_cube
    return matrix(fit)


def fitted_in(seen: Stretches, line: int, begin: float, end: float, count: int = CELLS) -> Fitted:
    """Return the cubic in a range."""
    cells, shown = seen.cells(line, begin, end, count), seen.shown[line]
    of_chords, squares, cubes = (
        Vector(row @ means for row in ROWS[count]) for means in (cells.y, cells.square, cells.cube)
    )
    fit = chord_fit(squares, cubes)
    q = Vector(row @ of_chords[:4] for row in fit)
    quartic, quintic = (of_chords[m] - (q[2] * squares[m] + q[3] * cubes[m]) for m in (4, 5))
    usual, h, rest = BULGE * math.sqrt(shown.sagitta), 1 / count, []
    for k in range(count):
        w = (2 * k + 1) * h - 1
        square, cube = w * w + h * h / 3, w * (w * w + h * h)
        bulge = q[2] * cells.square[k] + q[3] * cells.cube[k]
        cubic = q[0] + q[1] * w + (q[2] * square + q[3] * cube)
        more = abs(bulge) - usual if abs(bulge) > usual else 0.0
        rest.append(cells.y[k] - (cubic + bulge) + (more if bulge > 0 else -more))
    found = Fitted(begin, end, q, (quartic, quintic), cells, Vector(rest), fit, 0.0)
    return found._replace(square=squared_misfit(found, shown))


def noise_share(points: float) -> float:
    """Return the share of what points show of their errors that is taken for errors.

    The rest, and all of it where points are few, may be the shape of the road.
    """
    square = points * points
    return square / (square + SHARED_POINTS * SHARED_POINTS)


def sums_of(rest: Vector) -> list[float]:
    """Return the sums of what a cubic leaves, from the first cell to the begin of each."""
    sums = [*accumulate(rest, initial=0.0)]
    return [*sums, sums[-1]]  # of a place at the end


def sum_between(sums: Sequence[float], begin: float, end: float) -> float:
    """Return the sum between two places, which may lie within cells."""
    i, j = int(begin), int(end)
    to_end = sums[j] + (end - j) * (sums[j + 1] - sums[j])
    return to_end - (sums[i] + (begin - i) * (sums[i + 1] - sums[i]))


def squared_misfit(fitted: Fitted, shown: Shown) -> float:
    """Return the square of the greatest mean over some metres or a cell, or of the modes [m^2].

    What errors of the points explain of it is taken off, and kinks that they hide are added.
    """
    position, count = fitted.cells.position, len(fitted.rest)
    points = position[-1] - position[0]
    length, error = fitted.end - fitted.begin, shown.error
    width = clipped(AVERAGE * count / length, 1.0, count / 4)
    noise = NOISE_LIMIT * noise_share(points) * error / (1 + width * points / count)
    narrow = NARROW_LIMIT * noise_share(points) * error / (1 + points / count)
    step, scale, sums = (count - width) / (count - 1), 1 / width, sums_of(fitted.rest)
    quartic, quintic = fitted.modes
    greatest = quartic * quartic + quintic * quintic
    for k in range(count):
        mean = sum_between(sums, k * step, k * step + width) * scale
        greatest = max(greatest, mean * mean - noise, fitted.rest[k] * fitted.rest[k] - narrow)
    return greatest + BY_KINKS * shown.kinks * (length * length * length)


# ---- the longest range ------------------------------------------------------------------------


def longest_range(seen: Stretches, line: int, limits: Limits) -> Fitted | None:
    """Return the cubic in the longest range with at most the greatest misfit; None without one.

    It is the whole range, the one that is found by search, or that one, shortened to the car.
    """
    ends = _whole(seen.ranges[line], limits.step)
    found = fitted_in(seen, line, *ends)
    for trial in range(SHRINKS + 2):
        if not found.misfit > limits.max_misfit:
            break
        if trial == 0:
            ends = _search(seen, line, limits)
        else:  # what a cubic misses grows with the fourth power of a range
            share = SHRINK * math.sqrt(math.sqrt(limits.max_misfit / found.misfit))
            car = clipped(0.0, *ends)
            ends = car + share * (ends[0] - car), car + share * (ends[1] - car)
        ends = _whole(ends, limits.step)
        if not ends[0] < ends[1]:
            return None
        found = fitted_in(seen, line, *ends)
    return found if found.misfit <= limits.max_misfit and math.isfinite(found.misfit) else None


def _whole(ends: tuple[float, float], step: float) -> tuple[float, float]:
    """Return a range with its ends moved inwards to multiples of a step, if it is long."""
    if step == 0:
        return ends
    begin, end = (x / step for x in ends)
    low = math.copysign(math.ceil(begin), begin) * step  # -0.0 remains
    high = math.copysign(math.floor(end), end) * step
    return (low, high) if low + step <= high else ends


def _goodness_to(root: float) -> float:
    """Return the integral from 0 of how good a range is: 1, and 0 from the root 1 on."""
    v = root - (1 - SOFT)
    w = min(v, SOFT)
    return 1 - SOFT + (w - w * w / (2 * SOFT)) if v > 0 else root


def goodness(begin: float, end: float) -> float:
    """Return the mean goodness while the root of the misfit goes from one value to another."""
    step = end - begin
    if abs(step) > LEAST_STEP:
        return (_goodness_to(end) - _goodness_to(begin)) / step
    return clipped((1 - begin) / SOFT, 0.0, 1.0)


def _search(seen: Stretches, line: int, limits: Limits) -> tuple[float, float]:
    """Return the range with the longest reach.

    All ends from the car on count by how good they are, and all starts by their reach. So the range
    moves with the car.
    """
    low, high = seen.ranges[line]
    car = clipped(-limits.room, low, high)

    def root(begin: float, end: float) -> float:
        if not begin < end:
            return 0.0
        square = fitted_in(seen, line, begin, end, COARSE_CELLS).square
        return math.sqrt(math.sqrt(square)) / math.sqrt(limits.max_misfit)

    tried, best = [], -math.inf
    for share in STARTS:
        begin, end = car + (low - car) * share, car
        before = root(begin, car)
        weight = goodness(before, before)
        for k in range(1, ENDS + 1):
            after = root(begin, car + (high - car) * (k / ENDS) if k < ENDS else high)
            end += (high - car) / ENDS * goodness(before, after)
            before = after
        reach = end - BEHIND * begin
        best = reach if weight > 0 and reach > best else best
        tried.append((begin, end, weight))
    begin = end = total = 0.0
    for one_begin, one_end, weight in tried:
        lack = (best - (one_end - BEHIND * one_begin)) / NEARLY
        nearness = 1 - lack if lack < 1 else 0.0
        weight = weight * (nearness * nearness) if weight > 0 else 0.0
        begin += weight * one_begin
        end += weight * one_end
        total += weight
    return begin / total, end / total


# ---- what a cubic misses ----------------------------------------------------------------------


def coefficient_variances(seen: Stretches, line: int, fitted: Fitted) -> Vector:
    """Return the variances of the coefficients of T_0 .. T_3 that cover what a cubic misses [m^2].

    T_0 has a share of the misfit. T_1 .. T_3 have ``SHAPE`` times a level: the least one with which
    second differences of means of the rest, over 5, 10 and 20 m, have a mean square of 1.4
    variances, and nearly all are at most 2.3 standard deviations. What errors of the points explain
    of them is taken off. T_4 and T_5 tell what is smooth from noise better, so the level is at
    least what they need. Both have what a line may do between its points in addition, and the level
    what kinks may that errors hide.
    """
    shown, cells = seen.shown[line], fitted.cells
    length, points = fitted.end - fitted.begin, cells.position[-1] - cells.position[0]
    noise, squared = noise_share(points) * shown.error, fitted.misfit * fitted.misfit
    floor, level = MIN_SIGMA * MIN_SIGMA, level_of_modes(fitted, noise / points)
    level = max(floor, MIN_SHAPE * squared, level)
    sums = sums_of(fitted.rest)
    for spacing, *noises in zip(SPACINGS, FAR_NOISE, MEAN_NOISE, strict=True):
        seen_spacing = max(spacing, length / points)  # less is not seen
        distance = CELLS * min(seen_spacing, LONGEST * length) / length
        kept = 1 / (1 + distance / 2 * points / CELLS)
        level = max(level, least_level(sums, distance, 6 * kept * noise, *noises))
    level += 2 * shown.unseen
    level += SHAPE_BY_KINKS * shown.kinks * (length * length * length)
    lateral = LATERAL_SHARE * (squared + shown.unseen) + floor
    return Vector([lateral, *(level * SHAPE.diagonal())[1:]])


def level_of_modes(fitted: Fitted, variance: float) -> float:
    """Return the least squared level for T_4 and T_5 [m^2]."""
    level = 0.0
    for mode, scale, explained, of_point in zip(
        fitted.modes, MODE_LEVELS, MODE_NOISE, MODE_VARIANCES, strict=True
    ):
        square = mode * mode - explained * of_point * variance
        level += scale * square / MEAN_SQUARE if square > 0 else 0.0
    return level


def least_level(
    sums: Sequence[float], distance: float, noise: float, far_noise: float, mean_noise: float
) -> float:
    """Return the least squared level for second differences over a distance in cells [m^2].

    They are those of means over half of it. Errors of the points give each a variance of ``noise``.
    """
    width = distance / 2
    step = (CELLS - width - 2 * distance) / (PLACES - 1)
    h = distance * 2 / CELLS
    scale, shrink = 1 / (h * h * (h * h)), 1 / (width * width)
    near, levels = 0.0, []
    for i in range(PLACES):
        # Second differences of T_2 are 4 h^2, those of T_3 are 24 w h^2, with w in the middle.
        begin = i * step
        middle = begin + distance
        of_cubic = 24 * ((2 * middle + width) / CELLS - 1)
        unit = scale / (16 * SHAPE[2][2] + of_cubic * of_cubic * SHAPE[3][3])
        first, second, third = (
            sum_between(sums, place, place + width) for place in (begin, middle, middle + distance)
        )
        difference = first - 2 * second + third
        square = difference * difference * shrink
        levels.append((square - far_noise * noise) * unit)
        near += (square - mean_noise * noise) * unit
    far = sorted(levels)[-2] / (LIMIT * LIMIT)  # one of 32 may be beyond
    return max(far, near / (PLACES * MEAN_SQUARE))
