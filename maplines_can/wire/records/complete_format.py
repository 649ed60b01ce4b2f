"""Format of complete records: a line with a covariance of its own, or a part of its mixture."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from ...values.gaussian import Gaussian
from ...values.line import VAGUE_SIGMA, Kind, MapLine, Status
from ..covariance import CholeskyCode
from ..layout.message_layout import Layout
from ..layout.pose_layout import Owner, slot_of
from ..layout.signals import PARAMETER_SIGNALS, SignalRow
from ..reasons import Reason
from .packer import RecordPacker
from .record import CompleteRecord

#: Signals of the other numbers of a record.
NUMBERS = ("XMin", "XMax", "Age", "ComponentCount", "ComponentWeight")
LAST_STATUS, LAST_KIND = max(Status), max(Kind)
_VAGUE = np.diag(np.square(VAGUE_SIGMA))


class CompleteFormat:
    """Format of complete records.

    Args:
        layout: of the records.
        covariance: code of the covariance.
    """

    def __init__(self, layout: Layout, covariance: CholeskyCode) -> None:
        self.packer = RecordPacker(layout)
        self.data_ids: dict[Owner, int]
        self.data_ids = {slot: messages.data_id for slot, messages in layout.messages.items()}
        self._mean = SignalRow(layout[name] for name in PARAMETER_SIGNALS)
        self._numbers = SignalRow(layout[name] for name in NUMBERS)
        self._too_old = layout["Age"].raw_max  # the raw value that means so, or more
        self.covariance = covariance

    def content(
        self, raw: Mapping[str, int], owner: Owner, t_ns: int | None
    ) -> CompleteRecord | Reason:
        """Return the content of an intact record, or CONTENT."""
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
