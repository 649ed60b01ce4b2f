"""Assembly of Gaussian mixtures from the records of their components."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from ...values.fixed_order import is_definite
from ...values.gaussian import Gaussian
from ...values.line import Kind, MapLine, Slot, Status
from ...values.mixture import GaussianMixture
from ..layout.pose_layout import Owner
from ..reasons import Reason
from ..records.record import CompleteRecord

#: The status of a mixture is that of its worst component; from best to worst.
SEVERITY = (
    Status.FULL,
    Status.REPAIRED,
    Status.SATURATED,
    Status.DIAGONAL,
    Status.UNKNOWN,
    Status.OUT_OF_RANGE,
)
#: Weights are multiples of a power of two, so their float sum is exact; the tolerance is for a
#: factor rounded in the DBC.
WEIGHT_TOLERANCE = 1e-9
#: Share of the variances that is added to a covariance that rounding has made indefinite; that of
#: 64 components errs by less.
ROUNDING = 2.0**-40


class ReceivedLine(NamedTuple):
    """A line with all its components, and its pose error if its record is conditional on that."""

    line: MapLine
    frames: int  #: frames that carried it
    records: int = 1  #: records that carried it: components


class _Common(NamedTuple):
    """Values that all components of a line share."""

    first: int  #: counter of the first component
    components: int
    kind: Kind
    x_min: float
    x_max: float
    age: float


@dataclass
class _Incomplete:
    """The components of one mixture received so far."""

    common: _Common
    t_ns: int  #: time of the component received last
    components: dict[int, CompleteRecord] = field(default_factory=dict)
    frames: int = 0


class MixtureAssembler:
    """Assembler of the components of a line: all of them, by their counters, or none.

    Each slot has at most one incomplete mixture; time is an argument. The components of a line have
    the same count, kind, valid range and age, and counters in the order of their indices. If one of
    these differs, a component belongs to another line, and the incomplete mixture is dropped.

    Args:
        modulus: counter modulus.
        timeouts_ns: longest time between two components of a line, for each slot [ns]. It counts
            from the last component, since a slow bus takes long for many components.
    """

    def __init__(self, modulus: int, timeouts_ns: Mapping[Owner, int]) -> None:
        self._modulus, self._timeouts_ns = modulus, timeouts_ns
        self._incomplete: dict[Owner, _Incomplete] = {}
        #: Frames dropped here, by reason.
        self.counts: Counter[Reason] = Counter()

    @property
    def pending(self) -> int:
        """Frames of incomplete mixtures."""
        return sum(mixture.frames for mixture in self._incomplete.values())

    def add(self, record: CompleteRecord, frames: int, t_ns: int) -> ReceivedLine | Reason:
        """Add a record to its mixture; return the line that it completes.

        Returns:
            The line, or the reason why the record completes none.
        """
        line, first = record.line, (record.counter - record.index) % self._modulus
        slot = line.slot
        common = _Common(first, record.count, line.kind, line.x_min, line.x_max, line.age)
        held = self._incomplete.get(slot)
        if held and self._is_old(slot, held, t_ns):
            self._drop(slot, Reason.TIMEOUT)
        elif held and held.common != common:
            self._drop(slot, Reason.INCOMPLETE)
        if record.count == 1:
            return ReceivedLine(line, frames)
        mixture = self._incomplete.setdefault(slot, _Incomplete(common, t_ns))
        if record.index in mixture.components:
            self.counts[Reason.DUPLICATE] += frames
            return Reason.DUPLICATE
        mixture.components[record.index] = record
        mixture.frames += frames
        mixture.t_ns = t_ns
        if len(mixture.components) < record.count:
            return Reason.PENDING
        records = [mixture.components[i] for i in range(record.count)]
        if abs(_sum_of_weights(records) - 1) > WEIGHT_TOLERANCE:
            self._drop(slot, Reason.CONTENT)
            return Reason.CONTENT
        del self._incomplete[slot]
        return ReceivedLine(_mixture_line(records), mixture.frames, record.count)

    def drop(self, slot: Slot) -> None:
        """Drop the mixture of a slot, if there is one."""
        if slot in self._incomplete:
            self._drop(slot, Reason.INCOMPLETE)

    def drop_if_within(self, owner: Owner, counter: int) -> None:
        """Drop the mixture if the counter of a rejected (STALE) record falls in its range."""
        held = self._incomplete.get(owner)
        if held and (counter - held.common.first) % self._modulus < held.common.components:
            self._drop(owner, Reason.INCOMPLETE)  # two senders, or components out of order

    def expire(self, t_ns: int) -> None:
        """Drop the mixtures that have timed out at ``t_ns`` [ns]."""
        held = self._incomplete.items()
        for slot in [s for s, mixture in held if self._is_old(s, mixture, t_ns)]:
            self._drop(slot, Reason.TIMEOUT)

    def _is_old(self, owner: Owner, mixture: _Incomplete, t_ns: int) -> bool:
        return abs(t_ns - mixture.t_ns) > self._timeouts_ns[owner]

    def _drop(self, owner: Owner, reason: Reason) -> None:
        self.counts[reason] += self._incomplete.pop(owner).frames


def _sum_of_weights(records: Sequence[CompleteRecord]) -> float:
    """Return the sum of the weights, one after the other: ``sum`` compensates rounding errors."""
    total = 0.0
    for record in records:
        total += record.weight
    return total


def _definite(gaussian: Gaussian) -> Gaussian:
    """Return a Gaussian, made wider by rounding errors if these have made it indefinite."""
    if is_definite(gaussian.cov[None])[0]:
        return gaussian
    cov = gaussian.cov.copy()
    cov[range(len(cov)), range(len(cov))] += ROUNDING * cov.diagonal()
    return Gaussian.trusted(gaussian.mean, cov)


def _mixture_line(records: Sequence[CompleteRecord]) -> MapLine:
    """Return the line of all components of a mixture."""
    gaussians = tuple(record.line.gaussian for record in records)
    mixture = GaussianMixture(np.array([record.weight for record in records]), gaussians)
    first = min((record.line for record in records), key=lambda line: line.t_ns or 0)
    return replace(  # all components have its age, which is relative to ``t_ns``
        first,
        gaussian=_definite(mixture.overall),
        mixture=mixture,
        status=max((record.line.status for record in records), key=SEVERITY.index),
    )
