"""Batches of complete records in C: the loops over the rows, for the writer and the format."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core import ffi, lib
from ...core.memory import pointer, pointers, shaped
from ...values.elementary import exp2
from ..covariance import CholeskyCode
from ..layout.message_layout import Layout
from ..layout.validation import CheckedGaussians

Array = NDArray[np.float64]

#: Most values of a signal whose powers of 2 are held in a table.
MAX_TABLE = 1 << 16
#: Rows of the arrays of values beside mean and covariance: fields of a ``Batch``.
INTEGERS = ("counter", "kind", "status", "component_index", "component_count")
REALS = ("component_weight", "x_min", "x_max", "age")


class BatchKernel:
    """Encoding and decoding of checked arrays in C: bit for bit as in NumPy.

    Args:
        tables: of the layout: see ``tables_of``.
        layout: of the records.
        covariance: code of the covariance.
    """

    def __init__(self, tables: Any, layout: Layout, covariance: CholeskyCode) -> None:
        self._tables, self._record_bytes = tables, layout.record_bytes
        *pivots, inflation = (
            signal.physical(np.arange(signal.raw_min, signal.raw_max + 1))
            for signal in (*covariance.factor.pivots, covariance.inflation)
        )
        powers = (*map(exp2, pivots), exp2(inflation))
        #: Of 2, of the values of the pivots and of the inflation; see ``maplines_encode_lines``.
        self.variance_powers = pointers(powers)
        self._sigma_powers = pointers((*powers[:-1], exp2(inflation * 0.5)))
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
        slot: ArrayLike,
        integers: Iterable[ArrayLike],
        reals: Iterable[ArrayLike],
    ) -> NDArray[np.uint8]:
        """Return the (n, record bytes) records of lines.

        Args:
            gaussians: n of them.
            cover: (n, 4, 4) that is added to the covered target, if any.
            slot: (n,) or one for all.
            integers: each of INTEGERS, likewise.
            reals: each of REALS, likewise.
        """
        n = len(gaussians.mean)
        records = np.empty((n, self._record_bytes), dtype=np.uint8)
        lib.maplines_encode_lines(
            self._tables,
            self.variance_powers,
            n,
            shaped(gaussians.mean, (n, 4)),
            shaped(gaussians.cov, (n, 4, 4)),
            ffi.NULL if cover is None else shaped(cover, (n, 4, 4)),
            shaped(gaussians.indefinite, (n,)),
            pointer(_rows((slot,), n, np.int64)),
            pointer(_rows(integers, n, np.int64)),
            pointer(_rows(reals, n, np.float64)),
            pointer(records),
        )
        return records

    def cover(self, weights: Array, means: Array, covs: Array, steps: int) -> tuple[Array, Array]:
        """Return the (n, k) decoded weights of mixtures, and the (n, 4, 4) deficit they leave."""
        n, k = weights.shape
        decoded, cover = np.empty((n, k)), np.empty((n, 4, 4))
        given = shaped(weights, (n, k)), shaped(means, (n, k, 4)), shaped(covs, (n, k, 4, 4))
        arrays = (*given, pointer(decoded), pointer(cover))
        if not lib.maplines_cover_mixtures(self._tables, n, k, steps, *arrays):
            raise ValueError(f"the core holds up to 64 components, got {k}")
        return decoded, cover

    def read(
        self, payloads: NDArray[np.uint8], data_ids: NDArray[np.uint16]
    ) -> dict[str, NDArray[Any]]:
        """Return the fields of a ``Batch`` of (n, record bytes) records with (n,) data IDs."""
        n = len(payloads)
        mean, cov, verdict = np.empty((n, 4)), np.empty((n, 4, 4)), np.empty(n, dtype=np.int8)
        integers = np.empty((len(INTEGERS), n), dtype=np.int64)
        reals = np.empty((len(REALS), n))
        given = shaped(payloads, (n, self._record_bytes)), shaped(data_ids, (n,))
        made = mean, cov, verdict, integers, reals
        arrays = (*given, *(pointer(one) for one in made))
        lib.maplines_decode_lines(self._tables, self._sigma_powers, n, *arrays)
        fields = dict(zip((*INTEGERS, *REALS), (*integers, *reals), strict=True))
        return {"mean": mean, "cov": cov, "verdict": verdict, **fields}


def _rows(values: Iterable[ArrayLike], n: int, kind: type) -> NDArray[Any]:
    """Return (K, n) values of K rows, each of (n,) or one for all."""
    given = tuple(values)
    rows: NDArray[Any] = np.empty((len(given), n), dtype=kind)
    for row, value in zip(rows, given, strict=True):
        row[:] = value
    return rows
