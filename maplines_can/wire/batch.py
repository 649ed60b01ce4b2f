"""Batches of lines as records, and back: arrays, without any state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.errors import EncodeError
from ..values.line import MapLine, Slot
from .layout.attributes import LINE_ATTRIBUTES, RecordAttributes, numbers
from .layout.validation import checked_gaussians, checked_mixtures, checked_payloads
from .reasons import Reason
from .records.complete_format import Batch
from .records.complete_writer import CompleteWriter
from .records.record import RecordReader


class BatchCodec:
    """Codec of many lines at once; ``Codec.batch`` is one.

    Args:
        again: returns that of the same codec.
        writer: writer of the records.
    """

    def __init__(self, again: Callable[[], BatchCodec], writer: CompleteWriter) -> None:
        self._again, self._writer, self._layout = again, writer, writer.layout
        self._reader = RecordReader(writer.format)

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
        return self._writer.write(
            gaussians, values.without_covariance() if covs is None else values
        )

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
        return self._writer.write_mixtures(*checked_mixtures(weights, means, covs), values)

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
        data_ids = self._layout.data_ids(numbers("slot", slot), len(records))
        return self._writer.format.read(records, data_ids)

    def decode_one(self, payload: bytes, slot: Slot, t_ns: int | None = None) -> MapLine | Reason:
        """Decode one record, received at ``t_ns`` [ns]; bit-identical to ``decode``.

        Returns:
            The line, or the reason why the record is rejected. For a component of a mixture it is
            the Gaussian of the component; ``Codec.reader`` has its index, count and weight, too.

        Raises:
            EncodeError: the DBC has no message for the slot.
        """
        if slot not in self._layout.messages:
            raise EncodeError(f"{self._layout.source} has no message for slot {slot!r}")
        record = self._reader.read(payload, slot, t_ns)
        return record if isinstance(record, Reason) else record.line
