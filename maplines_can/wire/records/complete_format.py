"""Format of complete records: a line with a covariance of its own, or a part of its mixture."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...values.gaussian import Gaussian
from ...values.line import VAGUE_SIGMA, Kind, MapLine, Status
from ..covariance import CholeskyCode
from ..layout.message_layout import Layout
from ..layout.pose_layout import Owner, slot_of
from ..layout.signals import PARAMETER_SIGNALS, SignalRow
from ..reasons import Reason
from .batch_kernel import BatchKernel
from .packer import VERDICTS, RecordPacker
from .record import CompleteRecord

#: Signals of the other numbers of a record.
NUMBERS = ("XMin", "XMax", "Age", "ComponentCount", "ComponentWeight")
LAST_STATUS, LAST_KIND = max(Status), max(Kind)
_VAGUE = np.diag(np.square(VAGUE_SIGMA))


@dataclass(frozen=True, eq=False)
class Batch:
    """Many decoded records. Use a row only if it is ``accepted``."""

    mean: NDArray[np.float64]  #: (N, 4) in [m, rad, 1/m, 1/m^2]
    cov: NDArray[np.float64]  #: (N, 4, 4), positive definite in every row
    verdict: NDArray[np.int8]  #: (N,) 0 if accepted, else an index into VERDICTS
    status: NDArray[np.int64]  #: (N,) as ``Status``
    kind: NDArray[np.int64]  #: (N,) as ``Kind``
    x_min: NDArray[np.float64]  #: (N,) [m]
    x_max: NDArray[np.float64]  #: (N,) [m]
    age: NDArray[np.float64]  #: (N,) time from the pose to the sending [s]; inf if too old
    component_index: NDArray[np.int64]  #: (N,)
    component_count: NDArray[np.int64]  #: (N,)
    component_weight: NDArray[np.float64]  #: (N,)
    counter: NDArray[np.int64]  #: (N,)

    @property
    def accepted(self) -> NDArray[np.bool_]:
        """(N,) True where the record passed all checks."""
        return self.verdict == 0

    @property
    def rejects(self) -> Counter[Reason]:
        """Number of rejected records, by reason."""
        numbers = np.bincount(self.verdict, minlength=len(VERDICTS))
        pairs = zip(VERDICTS, numbers.tolist(), strict=True)
        return Counter({reason: n for reason, n in pairs if reason and n})


class CompleteFormat:
    """Format of complete records; ``read`` and ``content`` give bit-identical results.

    Args:
        layout: of the records.
        covariance: code of the covariance.
        kernel: decodes and encodes batches in C; None for NumPy.
    """

    def __init__(
        self, layout: Layout, covariance: CholeskyCode, kernel: BatchKernel | None = None
    ) -> None:
        self.kernel = kernel
        self.packer = RecordPacker(layout)
        self.data_ids: dict[Owner, int]
        self.data_ids = {slot: messages.data_id for slot, messages in layout.messages.items()}
        self._mean = SignalRow(layout[name] for name in PARAMETER_SIGNALS)
        self._numbers = SignalRow(layout[name] for name in NUMBERS)
        self._too_old = layout["Age"].raw_max  # the raw value that means so, or more
        self.covariance = covariance

    def read(self, payloads: NDArray[np.uint8], data_ids: NDArray[np.uint16]) -> Batch:
        """Read (N, record bytes) records with (N,) E2E data IDs."""
        if self.kernel is not None:
            return Batch(**self.kernel.read(payloads, data_ids))
        raw, verdict = self.packer.unpack(payloads, data_ids)
        mean = self._mean.physical_of(raw)
        cov = self.covariance.decode(raw)
        status = raw["Status"]
        without_covariance = (status == Status.UNKNOWN) | (status == Status.OUT_OF_RANGE)
        if without_covariance.any():
            cov[without_covariance] = _VAGUE

        physical = dict(zip(NUMBERS, self._numbers.physical_of(raw).T, strict=True))
        index, count = raw["ComponentIndex"], physical["ComponentCount"].astype(np.int64)
        invalid = (status > LAST_STATUS) | (raw["Kind"] > LAST_KIND) | (index >= count)
        invalid |= (physical["XMin"] > physical["XMax"]) & (status != Status.OUT_OF_RANGE)
        invalid |= (physical["ComponentWeight"] <= 0) | (physical["ComponentWeight"] > 1)
        verdict[invalid & (verdict == 0)] = VERDICTS.index(Reason.CONTENT)
        return Batch(
            mean=mean,
            cov=cov,
            verdict=verdict,
            status=status,
            kind=raw["Kind"],
            x_min=np.minimum(physical["XMin"], physical["XMax"]),
            x_max=physical["XMax"],
            age=np.where(raw["Age"] < self._too_old, physical["Age"] / 1000, np.inf),
            component_index=index,
            component_count=count,
            component_weight=physical["ComponentWeight"],
            counter=raw["Counter"],
        )

    def content(
        self, raw: Mapping[str, int], owner: Owner, t_ns: int | None
    ) -> CompleteRecord | Reason:
        """Return the content of an intact record, or CONTENT: as ``read``, without arrays."""
        x_min, x_max, age_ms, components, weight = self._numbers.physical_one(raw)
        index, count = raw["ComponentIndex"], int(components)
        if raw["Status"] > LAST_STATUS or raw["Kind"] > LAST_KIND:
            return Reason.CONTENT
        if index >= count or not 0 < weight <= 1:
            return Reason.CONTENT
        if x_min > x_max and raw["Status"] != Status.OUT_OF_RANGE:
            return Reason.CONTENT
        mean = np.array(self._mean.physical_one(raw))
        without_covariance = raw["Status"] in (Status.UNKNOWN, Status.OUT_OF_RANGE)
        cov = _VAGUE.copy() if without_covariance else self.covariance.decode_one(raw)
        line = MapLine(
            slot=slot_of(owner),
            gaussian=Gaussian.trusted(mean, cov),
            kind=Kind(raw["Kind"]),
            x_min=min(x_min, x_max),
            x_max=x_max,
            age=age_ms / 1000 if raw["Age"] < self._too_old else math.inf,
            status=Status(raw["Status"]),
            t_ns=t_ns,
        )
        return CompleteRecord(line, index, count, weight, raw["Counter"])
