"""Piecewise cubic functions of s: widths, borders, lane offset, superelevation."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class CubicPiece(NamedTuple):
    """A cubic a + b ds + c ds^2 + d ds^3 from ``start`` on, with ds = s - start."""

    start: float
    a: float
    b: float = 0.0
    c: float = 0.0
    d: float = 0.0


_ZERO, _PADDING = CubicPiece(0.0, 0.0), CubicPiece(np.inf, 0.0)


class Profiles:
    """Several piecewise cubic functions, evaluated together.

    Before its first piece, a function has the value at the start of that piece. Without pieces it
    is 0.

    Args:
        functions: the pieces of each function, in any order. Of pieces with one start, the last
            one applies.
    """

    def __init__(self, functions: Sequence[Sequence[CubicPiece]]) -> None:
        rows = [sorted(pieces, key=lambda piece: piece.start) for pieces in functions]
        most = max(map(len, rows), default=0) or 1
        padded = [row + [_PADDING if row else _ZERO] * (most - len(row)) for row in rows]
        table = np.array(padded, dtype=float).reshape(len(rows), most, 5).transpose(2, 0, 1)
        #: Starts of all pieces [m], sorted.
        self.starts = sorted(piece.start for row in rows for piece in row)
        self._start, self._coefficients = table[0], table[1:]  # (count, most), (4, count, most)

    def __call__(self, s: Array, at: Array) -> Array:
        """Return (count, n) values at ``s``, of the pieces that apply at ``at``.

        At the end of a piece, its own value and that of the next one can differ. A position within
        the stretch of interest as ``at`` selects the piece.

        >>> step = Profiles([[CubicPiece(0.0, 1.0), CubicPiece(10.0, 6.0)]])
        >>> step(np.array([10.0, 10.0]), at=np.array([9.0, 11.0]))
        array([[1., 6.]])
        """
        if self._start.shape[1] == 1:
            start, (a, b, c, d) = self._start, self._coefficients
        else:
            found = [np.searchsorted(row, at, side="right") - 1 for row in self._start]
            index = np.maximum(found, 0)  # (count, n)
            rows = np.arange(len(index))[:, np.newaxis]
            start, (a, b, c, d) = self._start[rows, index], self._coefficients[:, rows, index]
        ds = np.maximum(s - start, 0.0)
        return a + ds * (b + ds * (c + ds * d))
