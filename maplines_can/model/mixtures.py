"""Assembly of a line from the records of its components: all of them, by their counters, or none.

The components of a line have the same count, kind, valid range and age, and consecutive counters.
"""

from __future__ import annotations

from collections import Counter
from functools import reduce
from operator import add
from typing import NamedTuple

from ..values.line import Status
from .matrices import diagonal, is_definite
from .records import Component, Line
from .weights import moments

#: The status of a line is that of its worst component; from best to worst.
SEVERITY = (
    Status.FULL, Status.REPAIRED, Status.SATURATED, Status.DIAGONAL, Status.UNKNOWN,
    Status.OUT_OF_RANGE,
)  # fmt: skip
#: The sum of the weights may differ from 1 by this.
WEIGHT_TOLERANCE = 1e-9
#: Share of the variances that is added to a covariance that rounding has made indefinite.
ROUNDING = 2.0**-40


class Received(NamedTuple):
    """A line all of whose records have come."""

    line: Line
    frames: int  #: that carried it
    records: int = 1  #: its components


class Mixtures:
    """The mixture of one slot that is not complete yet; ``counts`` are of dropped frames."""

    def __init__(self, modulus: int, timeout_ns: int, counts: Counter[str]) -> None:
        self._modulus, self._counts = modulus, counts
        self._timeout_ns = timeout_ns  # longest time between two components, one after the other
        self._held: list[Component] = []  # that have come
        self._t_ns = 0  # time of the one that came last
        self.pending = 0  #: frames of these components

    def add(self, component: Component, frames: int, t_ns: int) -> Received | str:
        """Add a component; return the line that it completes, or why none."""
        self.expire(t_ns)
        if any(self._common(held) != self._common(component) for held in self._held):
            self.drop("INCOMPLETE")
        if component.size == 1:
            return Received(component.line, frames)
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
        received = Received(mixture_line(components), self.pending, component.size)
        self._held, self.pending = [], 0
        return received

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
    if not is_definite(cov):
        cov += ROUNDING * diagonal(cov.diagonal())
    status = max((line.status for line in lines), key=SEVERITY.index)
    first = min(lines, key=lambda line: line.t_ns)
    return first._replace(mean=mean, cov=cov, status=status, components=components)
