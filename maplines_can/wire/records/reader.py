"""Reader of records: many at once, or one as it comes from the bus."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...values.gaussian import Gaussian, nearest_covariance
from ...values.line import VAGUE_SIGMA, Kind, MapLine, Slot, Status
from ..covariance import CovarianceCode
from ..layout.message_layout import Layout
from ..layout.packing import Packing
from ..layout.signals import PAGE, PARAMETER_SIGNALS, TRANSFER_ID
from ..protection.e2e import record_crc, record_crc_one
from ..reasons import Reason

#: Outcomes of the checks of a record, in the order of their numbers in ``Batch.verdict``.
VERDICTS = (None, Reason.MIXED, Reason.CRC, Reason.CONTENT)

LAST_STATUS, LAST_KIND = max(Status), max(Kind)
#: Least eigenvalue of a repaired correlation matrix.
MIN_VARIANCE = 1e-9
_VAGUE = np.diag(np.square(VAGUE_SIGMA))


@dataclass(frozen=True, eq=False)
class Batch:
    """Many decoded records. Use a row only if it is ``accepted``."""

    mean: NDArray[np.float64]  #: (N, 4) in [m, rad, 1/m, 1/m^2]
    #: (N, 4, 4), positive definite in every row if the covariance code guarantees it. With another
    #: code a row may be indefinite; ``Codec.decode_one`` and a receiver repair it.
    cov: NDArray[np.float64]
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


@dataclass(frozen=True, slots=True, eq=False)
class DecodedRecord:
    """One decoded record: a line, or one component of a line that is a mixture."""

    line: MapLine
    index: int  #: of the component, from 0
    count: int  #: number of components of the line
    weight: float  #: of the component
    counter: int  #: E2E counter of the record


class RecordReader:
    """Reader of records of a layout; ``read`` and ``read_one`` give bit-identical results."""

    def __init__(self, layout: Layout, packing: Packing, covariance: CovarianceCode) -> None:
        self._signals = layout.signals
        self._pages = layout.pages
        self._mean = [layout[name] for name in PARAMETER_SIGNALS]
        self._too_old = layout["Age"].raw_max  # the raw value that means so, or more
        self._resolution = layout.resolution
        self._covariance = covariance
        self._packing = packing
        self._crc_offset = layout.crc_offset
        self._transfer_mask = 2 ** layout[f"{TRANSFER_ID}0"].length - 1

    def read(self, payloads: NDArray[np.uint8], data_ids: NDArray[np.uint16]) -> Batch:
        """Read (N, record bytes) records with (N,) E2E data IDs."""
        n = len(payloads)
        raw = self._packing.unpack(payloads)
        mean = np.empty((n, len(self._mean)))
        for i, signal in enumerate(self._mean):
            mean[:, i] = signal.physical(raw[signal.name])
        cov = self._covariance.decode(raw)
        status = raw["Status"]
        without_covariance = (status == Status.UNKNOWN) | (status == Status.OUT_OF_RANGE)
        if without_covariance.any():
            cov[without_covariance] = _VAGUE

        physical = {
            name: self._signals[name].physical(raw[name])
            for name in ("XMin", "XMax", "Age", "ComponentCount", "ComponentWeight")
        }
        index, count = raw["ComponentIndex"], physical["ComponentCount"].astype(np.int64)
        transfer = raw["Counter"] & self._transfer_mask
        verdict = np.zeros(n, dtype=np.int8)
        invalid = (status > LAST_STATUS) | (raw["Kind"] > LAST_KIND) | (index >= count)
        invalid |= (physical["XMin"] > physical["XMax"]) & (status != Status.OUT_OF_RANGE)
        invalid |= (physical["ComponentWeight"] <= 0) | (physical["ComponentWeight"] > 1)
        if not self._covariance.positive_definite:
            invalid |= ~np.isfinite(cov).all(axis=(1, 2))
            invalid |= (np.einsum("nii->ni", cov) < 0).any(axis=1)
        # The later checks overwrite the earlier ones: read_one makes them in the reverse order.
        verdict[invalid] = VERDICTS.index(Reason.CONTENT)
        crc = record_crc(payloads, data_ids, self._crc_offset)
        verdict[raw["Crc"] != crc] = VERDICTS.index(Reason.CRC)
        for page in range(self._pages):
            mixed = (raw[f"{PAGE}{page}"] != page) | (raw[f"{TRANSFER_ID}{page}"] != transfer)
            verdict[mixed] = VERDICTS.index(Reason.MIXED)
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

    def read_one(
        self, payload: bytes, slot: Slot, data_id: int, t_ns: int | None
    ) -> DecodedRecord | Reason:
        """Read one record, received at ``t_ns`` [ns]; as ``read``, without the array overhead."""
        if len(payload) != self._packing.record_bytes:
            return Reason.LENGTH
        raw, signals = self._packing.unpack_one(payload), self._signals
        transfer = raw["Counter"] & self._transfer_mask
        for page in range(self._pages):
            if raw[f"{PAGE}{page}"] != page or raw[f"{TRANSFER_ID}{page}"] != transfer:
                return Reason.MIXED
        if raw["Crc"] != record_crc_one(payload, data_id, self._crc_offset):
            return Reason.CRC
        weight = signals["ComponentWeight"].physical_one(raw["ComponentWeight"])
        index = raw["ComponentIndex"]
        count = int(signals["ComponentCount"].physical_one(raw["ComponentCount"]))
        if raw["Status"] > LAST_STATUS or raw["Kind"] > LAST_KIND:
            return Reason.CONTENT
        if index >= count or not 0 < weight <= 1:
            return Reason.CONTENT
        x_min, x_max = (signals[name].physical_one(raw[name]) for name in ("XMin", "XMax"))
        if x_min > x_max and raw["Status"] != Status.OUT_OF_RANGE:
            return Reason.CONTENT
        age = signals["Age"].physical_one(raw["Age"]) / 1000
        mean = np.array([signal.physical_one(raw[signal.name]) for signal in self._mean])
        without_covariance = raw["Status"] in (Status.UNKNOWN, Status.OUT_OF_RANGE)
        cov = _VAGUE.copy() if without_covariance else self._covariance.decode_one(raw)
        status = Status(raw["Status"])
        if not (without_covariance or self._covariance.positive_definite):
            if not np.isfinite(cov).all() or (cov.diagonal() < 0).any():
                return Reason.CONTENT
            if not _is_definite(cov):
                cov = nearest_covariance(cov)
                cov += np.diag(np.maximum(self._resolution, MIN_VARIANCE * cov.diagonal()))
                status = Status.REPAIRED
        line = MapLine(
            slot=slot,
            gaussian=Gaussian.trusted(mean, cov),
            kind=Kind(raw["Kind"]),
            x_min=min(x_min, x_max),
            x_max=x_max,
            age=age if raw["Age"] < self._too_old else math.inf,
            status=status,
            t_ns=t_ns,
        )
        return DecodedRecord(line, index, count, weight, raw["Counter"])


def _is_definite(cov: NDArray[np.float64]) -> bool:
    """Return whether a (4, 4) matrix is numerically positive definite."""
    sigma = np.sqrt(cov.diagonal())
    if not sigma.all():
        return False
    return bool(np.linalg.eigvalsh(cov / (sigma[:, None] * sigma))[0] > 1e-12)
