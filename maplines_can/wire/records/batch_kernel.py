"""Batches of complete records in C: the loops over the rows, for the writer and the format."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...native import core
from ...values.elementary import exp2
from ..covariance import CholeskyCode
from ..layout.message_layout import Layout
from ..layout.validation import CheckedGaussians

Array = NDArray[np.float64]

#: Most values of a signal whose powers of 2 are held in a table.
MAX_TABLE = 1 << 16
#: Fields of a ``Batch`` that are decoded, in the order of the extension module, with their types.
FIELDS: dict[str, type] = {
    "mean": np.float64,
    "cov": np.float64,
    "verdict": np.int8,
    "status": np.int64,
    "kind": np.int64,
    "x_min": np.float64,
    "x_max": np.float64,
    "age": np.float64,
    "component_index": np.int64,
    "component_count": np.int64,
    "component_weight": np.float64,
    "counter": np.int64,
}
SHAPES = {"mean": (4,), "cov": (4, 4)}


class BatchKernel:
    """Encoding and decoding of checked arrays in C: bit for bit as in NumPy.

    Args:
        tables: of the layout, for the extension module.
        layout: of the records.
        covariance: code of the covariance.
    """

    def __init__(self, tables: Any, layout: Layout, covariance: CholeskyCode) -> None:
        self._tables, self._record_bytes = tables, layout.record_bytes
        *pivots, inflation = (
            signal.physical(np.arange(signal.raw_min, signal.raw_max + 1))
            for signal in (*covariance.factor.pivots, covariance.inflation)
        )
        self._variance_powers = (*map(exp2, pivots), exp2(inflation))
        self._sigma_powers = (*self._variance_powers[:-1], exp2(inflation * 0.5))
        #: Most components of a mixture.
        self.max_components = 2 ** layout["ComponentCount"].length

    @classmethod
    def of(cls, tables: Any, layout: Layout, covariance: CholeskyCode) -> BatchKernel | None:
        """Return the kernel of a layout; None without C, or if its tables were too large."""
        if tables is None:
            return None
        exponents = (*covariance.factor.pivots, covariance.inflation)
        if any(signal.raw_max - signal.raw_min >= MAX_TABLE for signal in exponents):
            return None
        return cls(tables, layout, covariance)

    def encode(
        self,
        gaussians: CheckedGaussians,
        cover: Array | None,
        numbers: Iterable[ArrayLike],
        reals: Iterable[ArrayLike],
    ) -> NDArray[np.uint8]:
        """Return the (n, record bytes) records of lines.

        Args:
            gaussians: n of them.
            cover: (n, 4, 4) that is added to the covered target, if any.
            numbers: slot, counter, kind, status, component index and count, in this order; each
                is (n,) or one for all.
            reals: component weight, start and end of the range, and age, likewise.
        """
        n = len(gaussians.mean)
        records = np.empty((n, self._record_bytes), dtype=np.uint8)
        core.encode_records(
            self._tables,
            self._variance_powers,
            np.ascontiguousarray(gaussians.mean),
            np.ascontiguousarray(gaussians.cov),
            np.ascontiguousarray(gaussians.indefinite),
            None if cover is None else np.ascontiguousarray(cover),
            *(_column(values, n, np.int64) for values in numbers),
            *(_column(values, n, np.float64) for values in reals),
            records,
        )
        return records

    def cover(self, weights: Array, means: Array, covs: Array, steps: int) -> tuple[Array, Array]:
        """Return the (n, k) decoded weights of mixtures, and the (n, 4, 4) deficit they leave."""
        n = len(weights)
        decoded, cover = np.empty(weights.shape), np.empty((n, 4, 4))
        given = map(np.ascontiguousarray, (weights, means, covs))
        core.cover_mixtures(self._tables, *given, steps, decoded, cover)
        return decoded, cover

    def read(
        self, payloads: NDArray[np.uint8], data_ids: NDArray[np.uint16]
    ) -> dict[str, NDArray[Any]]:
        """Return the fields of a ``Batch`` of (n, record bytes) records with (n,) data IDs."""
        n = len(payloads)
        fields: dict[str, NDArray[Any]] = {
            name: np.empty((n, *SHAPES.get(name, ())), dtype=kind) for name, kind in FIELDS.items()
        }
        core.decode_records(
            self._tables,
            np.ascontiguousarray(payloads),
            np.ascontiguousarray(data_ids),
            self._sigma_powers,
            *fields.values(),
        )
        return fields


def _column(values: ArrayLike, n: int, kind: type) -> NDArray[Any]:
    """Return (n,) values, or one for all, as the extension module reads them."""
    column: NDArray[Any] = np.empty(n, dtype=kind)
    column[:] = values
    return column
