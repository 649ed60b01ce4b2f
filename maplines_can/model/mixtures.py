"""Assembly of a line from the records of its components: all of them, by their counters, or none.

The components of a line have the same count, kind, valid range and age, and consecutive counters.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import NamedTuple

from ..values.line import Status
from .matrices import dot, is_definite
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


@dataclass
class _Mixture:
    """The components of a line that have come, and what they have in common."""

    common: tuple[object, ...]
    first: int  #: counter of the first component
    size: int  #: number of its components
    t_ns: int  #: time of the component that came last
    components: dict[int, Component] = field(default_factory=dict)
    frames: int = 0


class Mixtures:
    """The mixture of one slot that is not complete yet; ``counts`` are of dropped frames."""

    def __init__(self, modulus: int, timeout_ns: int, counts: Counter[str]) -> None:
        self._modulus, self._counts = modulus, counts
        self._timeout_ns = timeout_ns  # longest time between two components, one after the other
        self._held: _Mixture | None = None

    @property
    def pending(self) -> int:
        """Frames of the components that wait for others."""
        return 0 if self._held is None else self._held.frames

    def add(self, component: Component, frames: int, t_ns: int) -> Received | str:
        """Add a component; return the line that it completes, or why none."""
        line, place = component.line, component.place
        first = (component.counter - place) % self._modulus
        common = (first, component.size, line.kind, line.x_min, line.x_max, line.age)
        self.expire(t_ns)
        if self._held is not None and self._held.common != common:
            self.drop("INCOMPLETE")
        if component.size == 1:
            return Received(line, frames)
        if self._held is None:
            self._held = _Mixture(common, first, component.size, t_ns)
        held = self._held
        if place in held.components:
            self._counts["DUPLICATE"] += frames
            return "DUPLICATE"
        held.components[place] = component
        held.frames += frames
        held.t_ns = t_ns
        if len(held.components) < component.size:
            return "PENDING"
        components = tuple(held.components[i] for i in range(component.size))
        weights = dot([one.weight for one in components], [1.0] * component.size)
        if abs(weights - 1) > WEIGHT_TOLERANCE:
            self.drop("CONTENT")
            return "CONTENT"
        self._held = None
        return Received(mixture_line(components), held.frames, component.size)

    def drop_if_within(self, counter: int) -> None:
        """Drop the mixture if the counter of a record that is STALE is one of it."""
        if self._held and (counter - self._held.first) % self._modulus < self._held.size:
            self.drop("INCOMPLETE")  # two senders, or components out of order

    def drop(self, reason: str) -> None:
        """Drop the mixture if there is one."""
        if self._held is not None:
            self._counts[reason] += self._held.frames
            self._held = None

    def expire(self, t_ns: int) -> None:
        """Drop the mixture if it has timed out."""
        if self._held is not None and abs(t_ns - self._held.t_ns) > self._timeout_ns:
            self.drop("TIMEOUT")


def mixture_line(components: tuple[Component, ...]) -> Line:
    """Return the line of all components: its Gaussian has the mean and covariance of the mixture.

    Time and status are those of the earliest and of the worst component.
    """
    lines = [one.line for one in components]
    weights = [one.weight for one in components]
    mean, cov = moments(weights, [one.mean for one in lines], [one.cov for one in lines])
    if not is_definite(cov):
        for i in range(4):
            cov[i][i] += ROUNDING * cov[i][i]
    status = max((line.status for line in lines), key=SEVERITY.index)
    first = min(lines, key=lambda line: line.t_ns)
    return first._replace(mean=mean, cov=cov, status=status, components=components)
