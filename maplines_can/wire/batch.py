"""Batches of lines as records, and back: arrays, without any state."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core import ffi, lib
from ..core.memory import pointer, shaped
from ..values.errors import EncodeError
from ..values.gaussian import Gaussian
from ..values.line import Kind, MapLine, Slot, Status
from .core_tables import LineTables
from .layout.attributes import INTEGERS, LINE_ATTRIBUTES, REALS, RecordAttributes, numbers
from .layout.message_layout import Layout
from .layout.validation import (
    CheckedGaussians,
    checked_gaussians,
    checked_mixtures,
    checked_payloads,
)
from .reception.check import Reason

#: Outcomes of the checks of a record, in the order of their numbers in ``Batch.verdict``.
VERDICTS = (None, Reason.MIXED, Reason.CRC, Reason.CONTENT)


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


class BatchCodec:
    """Codec of many lines at once; ``Codec.batch`` is one.

    Args:
        again: returns that of the same codec.
        layout: of the records.
        tables: of the same DBC.
    """

    def __init__(self, again: Callable[[], BatchCodec], layout: Layout, tables: LineTables) -> None:
        self._again, self._layout, self._tables = again, layout, tables

    def __reduce__(self) -> tuple[Any, ...]:
        return self._again, ()

    def encode(
        self,
        means: ArrayLike,
        covs: ArrayLike | None = None,
        **attributes: ArrayLike | None,
    ) -> NDArray[np.uint8]:
        """Encode many lines into records.

        A value that does not fit is never clipped silently; the status reports it. An indefinite
        covariance is replaced by the nearest one that covers it (REPAIRED). A value beyond the end
        of its range is covered by a wider covariance (SATURATED). The line is OUT_OF_RANGE if the
        widest covariance does not cover the value, or if ``XMin`` and ``XMax`` cannot state a valid
        range within the given one.

        Args:
            means: (N, 4) lines [m, rad, 1/m, 1/m^2].
            covs: (N, 4, 4), which may be singular; None to send means only.
            **attributes: (N,) or one for all; see ``RecordAttributes``. Without ``x_min`` and
                ``x_max`` the lines are valid at x = 0 only; without covs the status is UNKNOWN.

        Returns:
            (N, record bytes) uint8.

        Raises:
            ValueError: a shape is wrong, or a value is not finite, asymmetric, or a negative
                variance; the message names the row.
            EncodeError: a value cannot be encoded in its signal, such as a slot that the DBC lacks.
            TypeError: there is no such attribute.

        >>> from maplines_can import Codec
        >>> codec = Codec.from_dbc()
        >>> codec.batch.encode([[1.75, 0, 0, 0]], x_min=-8.0, x_max=64.0, age=0.04).shape
        (1, 32)
        """
        gaussians = checked_gaussians(means, covs)
        values = RecordAttributes.from_keywords(attributes)
        return self._encode(gaussians, values.without_covariance() if covs is None else values)

    def encode_mixtures(
        self, weights: ArrayLike, means: ArrayLike, covs: ArrayLike, **attributes: ArrayLike | None
    ) -> NDArray[np.uint8]:
        """Encode many Gaussian mixtures into records, one for each component.

        The decoded weights are multiples of the signal's step and add up to 1. The decoded mixture
        covers each component and the mixture's overall covariance; components are widened where the
        rounding of the weights would shrink it.

        Args:
            weights: (N, k), each row of sum 1.
            means: (N, k, 4).
            covs: (N, k, 4, 4).
            **attributes: attributes of each line, (N,) or one for all: any of
                ``RecordAttributes`` except component_*. The counter of a line is that of its first
                component, by default 0, k, 2 k, ...

        Returns:
            (N, k, record bytes) uint8; ``decode`` reads the components one by one.

        Raises:
            ValueError, EncodeError, TypeError: as ``encode``; or the weights are not
                positive, or do not add up to 1.
        """
        values = RecordAttributes.from_keywords(attributes, LINE_ATTRIBUTES)
        weights, means, covs = checked_mixtures(weights, means, covs)
        n, k = weights.shape
        gaussians = checked_gaussians(means.reshape(-1, 4), covs.reshape(-1, 4, 4))
        self._layout["ComponentCount"].whole(np.full(n, k))
        decoded, cover = np.empty((n, k)), np.empty((n, 4, 4))
        given = shaped(weights, (n, k)), shaped(means, (n, k, 4))
        of_cov = shaped(gaussians.cov.reshape(covs.shape), covs.shape)
        arrays = (*given, of_cov, pointer(decoded), pointer(cover))
        if not lib.maplines_cover_mixtures(self._tables.dbc, n, k, *arrays):
            raise EncodeError(f"the core refuses mixtures of {k} components")
        records = self._encode(
            gaussians, values.of_components(decoded), np.repeat(cover, k, axis=0)
        )
        return records.reshape(n, k, -1)

    def decode(self, payloads: ArrayLike, slot: ArrayLike = Slot.EGO_LEFT) -> Batch:
        """Decode many records. Never raises on payload content.

        Args:
            payloads: (N, record bytes) uint8.
            slot: (N,) or one for all; their E2E data IDs are part of the checksums.

        Returns:
            The lines. Rejected rows hold whatever their bytes decode to.

        Raises:
            ValueError: the array has another shape or type.
        """
        records = checked_payloads(payloads, self._layout.record_bytes)
        n = len(records)
        data_ids = self._layout.data_ids(numbers("slot", slot), n)
        mean, cov, verdict = np.empty((n, 4)), np.empty((n, 4, 4)), np.empty(n, dtype=np.int8)
        integers = np.empty((len(INTEGERS), n), dtype=np.int64)
        reals = np.empty((len(REALS), n))
        lib.maplines_decode_lines(
            self._tables.dbc,
            self._tables.sigma_powers,
            n,
            shaped(records, records.shape),
            shaped(data_ids, (n,)),
            *(pointer(one) for one in (mean, cov, verdict, integers, reals)),
        )
        fields = dict(zip((*INTEGERS, *REALS), (*integers, *reals), strict=True))
        return Batch(mean, cov, verdict, **fields)

    def decode_one(self, payload: bytes, slot: Slot, t_ns: int | None = None) -> MapLine | Reason:
        """Decode one record, received at ``t_ns`` [ns]; bit-identical to ``decode``.

        Returns:
            The line, or the reason why the record is rejected. For a component of a mixture it is
            the Gaussian of the component; ``decode`` has its index, count and weight, too.

        Raises:
            EncodeError: the DBC has no message for the slot.
        """
        if slot not in self._layout.messages:
            raise EncodeError(f"{self._layout.source} has no message for slot {slot!r}")
        if len(payload) != self._layout.record_bytes:
            return Reason.LENGTH
        batch = self.decode(np.frombuffer(payload, np.uint8)[None], slot)
        if (reason := VERDICTS[batch.verdict[0]]) is not None:
            return reason
        return MapLine(
            slot=Slot(slot),
            gaussian=Gaussian.trusted(batch.mean[0], batch.cov[0]),
            kind=Kind(int(batch.kind[0])),
            x_min=float(batch.x_min[0]),
            x_max=float(batch.x_max[0]),
            age=float(batch.age[0]),
            status=Status(int(batch.status[0])),
            t_ns=t_ns,
        )

    def _encode(
        self,
        gaussians: CheckedGaussians,
        attributes: RecordAttributes,
        cover: NDArray[np.float64] | None = None,
    ) -> NDArray[np.uint8]:
        """Return the (N, record bytes) records of Gaussians.

        ``cover`` is (N, 4, 4): what the decoded covariances must cover besides.
        """
        n = len(gaussians.mean)
        rows = attributes.rows(self._layout, n)
        records = np.empty((n, self._layout.record_bytes), dtype=np.uint8)
        lib.maplines_encode_lines(
            self._tables.dbc,
            self._tables.variance_powers,
            n,
            shaped(gaussians.mean, (n, 4)),
            shaped(gaussians.cov, (n, 4, 4)),
            ffi.NULL if cover is None else shaped(cover, (n, 4, 4)),
            shaped(gaussians.indefinite, (n,)),
            *(pointer(one) for one in (*rows, records)),
        )
        return records
