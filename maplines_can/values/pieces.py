"""Values that apply along a line, from one position to the next."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TypeVar

T = TypeVar("T")
#: Pairs of the position from which a value applies [m], ascending from 0, and the value.
Pieces = tuple[tuple[float, T], ...]


def value_at(pieces: Sequence[tuple[float, T]], s: float) -> T:
    """Return the value at a position [m]; before the first one, that of the first piece.

    >>> [value_at([(0.0, "a"), (4.0, "b")], s) for s in (3.9, 4.0)]
    ['a', 'b']
    """
    return next((value for start, value in reversed(pieces) if start <= s), pieces[0][1])


def extents(pieces: Sequence[tuple[float, T]], end: float) -> list[tuple[tuple[float, float], T]]:
    """Return from where to where each value applies [m], if the last one does up to ``end``.

    >>> extents([(0.0, "a"), (4.0, "b")], 9.0)
    [((0.0, 4.0), 'a'), ((4.0, 9.0), 'b')]
    """
    stops = [start for start, _ in pieces] + [end]
    return list(zip(pairwise(stops), (value for _, value in pieces), strict=True))


def longest(pieces: Sequence[tuple[float, T]], end: float) -> T:
    """Return the value that applies to the greatest length up to ``end``; of equals, the first.

    >>> longest([(0.0, "a"), (4.0, "b"), (6.0, "a")], 7.0)
    'a'
    """
    lengths: dict[T, float] = {}
    for (start, stop), value in extents(pieces, end):
        lengths[value] = lengths.get(value, 0.0) + stop - start
    return max(lengths, key=lengths.__getitem__)


def merged(pieces: Sequence[tuple[float, T]]) -> Pieces[T]:
    """Return the pieces without those that continue the value before.

    >>> merged([(0.0, "a"), (4.0, "a"), (6.0, "b")])
    ((0.0, 'a'), (6.0, 'b'))
    """
    kept = [True, *(one != other for (_, one), (_, other) in pairwise(pieces))]
    return tuple(piece for piece, is_new in zip(pieces, kept, strict=True) if is_new)
