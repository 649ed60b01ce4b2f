"""Mixtures: a line from the records of its components, and what their rounding leaves.

The components of a line have the same count, kind, valid range and age, and consecutive counters.
Without one of them, none is delivered.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from functools import reduce
from operator import add, mul

from ..values.line import Status
from .matrices import Matrix, Vector, diagonal
from .records import Component, Line

#: The status of a line is that of its worst component; from best to worst.
SEVERITY = (
    Status.FULL, Status.REPAIRED, Status.SATURATED, Status.DIAGONAL, Status.UNKNOWN,
    Status.OUT_OF_RANGE,
)  # fmt: skip
#: The sum of the weights may differ from 1 by this.
WEIGHT_TOLERANCE = 1e-9
#: Share of the variances that is added to a covariance that rounding has made indefinite.
ROUNDING = 2.0**-40
#: More than what the rounding of weights leaves, so that a check with another rounding passes.
MORE = 1e-6


class Mixtures:
    """The mixture of one slot that is not complete yet; ``counts`` are of dropped frames."""

    def __init__(self, modulus: int, timeout_ns: int, counts: Counter[str]) -> None:
        self._modulus, self._counts = modulus, counts
        self._timeout_ns = timeout_ns  # longest time between two components, one after the other
        self._held: list[Component] = []  # that have come
        self._t_ns = 0  # time of the one that came last
        self.pending = 0  #: frames of these components

    def add(self, component: Component, frames: int, t_ns: int) -> tuple[Line, int] | str:
        """Add a component; return the line that it completes and its frames, or why none."""
        self.expire(t_ns)
        if any(self._common(held) != self._common(component) for held in self._held):
            self.drop("INCOMPLETE")
        if component.size == 1:
            return component.line, frames
        if any(held.place == component.place for held in self._held):
            self._counts["DUPLICATE"] += frames
            return "DUPLICATE"
        self._held.append(component)
        self._t_ns = t_ns
        self.pending += frames
        if len(self._held) < component.size:
            return "PENDING"
        components = tuple(sorted(self._held, key=lambda one: one.place))
        if abs(reduce(add, (one.weight for one in components)) - 1) > WEIGHT_TOLERANCE:
            self.drop("CONTENT")
            return "CONTENT"
        frames, self._held, self.pending = self.pending, [], 0
        return mixture_line(components), frames

    def drop_if_within(self, counter: int) -> None:
        """Drop the mixture if the counter of a record that is STALE is one of it."""
        if any((counter - self._first(one)) % self._modulus < one.size for one in self._held):
            self.drop("INCOMPLETE")  # two senders, or components out of order

    def drop(self, reason: str) -> None:
        """Drop the mixture if there is one."""
        self._counts[reason] += self.pending
        self._held, self.pending = [], 0

    def expire(self, t_ns: int) -> None:
        """Drop the mixture if it has timed out."""
        if abs(t_ns - self._t_ns) > self._timeout_ns:
            self.drop("TIMEOUT")

    def _first(self, component: Component) -> int:
        """Return the counter of the first component."""
        return (component.counter - component.place) % self._modulus

    def _common(self, component: Component) -> tuple[object, ...]:
        """Return what all components of a line have alike."""
        line = component.line
        alike = line.kind, line.x_min, line.x_max, line.age
        return self._first(component), component.size, *alike


def mixture_line(components: tuple[Component, ...]) -> Line:
    """Return the line of all components: its Gaussian has the mean and covariance of the mixture.

    Time and status are those of the earliest and of the worst component.
    """
    lines = [one.line for one in components]
    weights = [one.weight for one in components]
    mean, cov = moments(weights, [one.mean for one in lines], [one.cov for one in lines])
    if not cov.is_definite():
        cov += ROUNDING * diagonal(cov.diagonal())
    status = max((line.status for line in lines), key=SEVERITY.index)
    first = min(lines, key=lambda line: line.t_ns)
    return first._replace(mean=mean, cov=cov, status=status, components=components)


# ---- weights and moments ------------------------------------------------------------------------


def quantized_weights(weights: Sequence[float], steps: int) -> list[int]:
    """Round weights to positive multiples of ``1 / steps`` that add up to 1.

    The largest remainders are rounded up (Hamilton's method). Where weights had to be raised to one
    step, those with the greatest excess lose it.

    >>> quantized_weights([0.005, 0.335, 0.66], 32)
    [1, 10, 21]
    """
    exact, places = [weight * steps for weight in weights], range(len(weights))
    multiples = [max(1, math.floor(x)) for x in exact]
    for _ in weights:
        excess = [multiples[i] - exact[i] for i in places]
        if sum(multiples) < steps:
            multiples[min(places, key=excess.__getitem__)] += 1
        elif sum(multiples) > steps:
            multiples[max((i for i in places if multiples[i] > 1), key=excess.__getitem__)] -= 1
    return multiples


def moments(
    weights: Sequence[float], means: Sequence[Vector], covs: Sequence[Matrix]
) -> tuple[Vector, Matrix]:
    """Return mean and covariance of a mixture; the components are added one after the other."""
    mean = reduce(add, map(mul, means, weights))
    return mean, reduce(add, map(mul, about(means, [mean] * len(means), covs), weights))


def about(
    means: Sequence[Vector], points: Sequence[Vector], covs: Sequence[Matrix]
) -> list[Matrix]:
    """Return the mean squares about a point of each component."""
    return [S + (m - point).outer() for m, point, S in zip(means, points, covs, strict=True)]


def deficit(
    weights: Sequence[float],
    means: Sequence[Vector],
    covs: Sequence[Matrix],
    decoded_weights: Sequence[float],
    decoded_means: Sequence[Vector],
) -> Matrix:
    """Return what to add to the covariance of each component, so that the mixture is covered.

    The decoded components cover their own mean square errors, so the decoded mixture has at least
    their covariance B. It must cover T, the true mean square error about the decoded mean: the
    positive part of T - B closes the gap.
    """
    mean, cov = moments(weights, means, covs)
    own = about(means, decoded_means, covs)
    decoded_mean, B = moments(decoded_weights, decoded_means, own)
    (T,) = about([mean], [decoded_mean], [cov])
    sigmas = map(math.sqrt, T.diagonal())
    units = Vector(sigma if 0 < sigma < math.inf else 1.0 for sigma in sigmas).outer()
    gap = (T - B) / units
    if not gap.is_finite():  # a component is so far out of range that its record is OUT_OF_RANGE
        gap = diagonal([0.0] * len(gap))
    return gap.positive_part(MORE) * units
