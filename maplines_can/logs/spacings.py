"""When the frames of each CAN ID come: their period and their gaps, from times in blocks."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

#: Most CAN IDs that are told apart; more are noise.
MAX_IDS = 4096
_NO_TIME = -(1 << 63)


class Spacing(NamedTuple):
    """When frames came, or lines.

    Args:
        n: how many there are.
        first_ns: time of the first one [ns].
        last_ns: time of the last one [ns].
        period: mean time between two [s]; nan if there are not two.
        gap: longest time between two [s]; nan as well.
        gap_ns: time at which that begins [ns].
    """

    n: int
    first_ns: int
    last_ns: int
    period: float
    gap: float
    gap_ns: int

    def as_dict(self, begin_ns: int) -> dict[str, Any]:
        """Return it for JSON, with the time of the gap from a time on [s]."""
        has_gap = self.n > 1
        return {
            "count": self.n,
            "period": self.period if has_gap else None,
            "gap": self.gap if has_gap else None,
            "gap_at": (self.gap_ns - begin_ns) / 1e9 if has_gap else None,
        }


class Spacings:
    """Spacings by a key, of times that come in blocks; memory is that of the keys.

    Args:
        most: number of keys; the times of others are counted together.

    >>> spacings = Spacings()
    >>> _ = spacings.add(np.array([7, 9, 7]), np.array([0, 5, 50_000_000]))
    >>> _ = spacings.add(np.array([7]), np.array([150_000_000]))
    >>> spacings.of(7)
    Spacing(n=3, first_ns=0, last_ns=150000000, period=0.075, gap=0.1, gap_ns=50000000)
    """

    def __init__(self, most: int = MAX_IDS) -> None:
        self.beyond = 0  #: times of keys beyond the most
        self._most = most
        self._keys = np.empty(0, np.int64)  # sorted
        self._table = np.empty((5, 0), np.int64)  # count, first, last, gap and its begin

    @property
    def keys(self) -> list[int]:
        """The keys in their order."""
        return [int(key) for key in self._keys]

    def add(self, keys: NDArray[Any], t_ns: NDArray[np.int64]) -> NDArray[np.int64]:
        """Add times (n,) [ns] of keys; return the place of each among the keys, or -1."""
        keys = keys.astype(np.int64)
        place = self._places(keys)
        if (place < 0).any():
            self._learn(np.unique(keys[place < 0]))
            place = self._places(keys)
        known = np.flatnonzero(place >= 0)
        self.beyond += len(keys) - len(known)
        if len(known):
            self._add(place[known], t_ns[known])
        return place

    def of(self, key: int) -> Spacing:
        """Return the spacing of a key."""
        place = int(np.searchsorted(self._keys, key))
        count, first, last, gap, gap_ns = self._table[:, place].tolist()
        if count < 2:
            return Spacing(count, first, last, np.nan, np.nan, first)
        period = (last - first) / 1e9 / (count - 1)
        return Spacing(count, first, last, period, gap / 1e9, gap_ns)

    def _places(self, keys: NDArray[np.int64]) -> NDArray[np.int64]:
        if not len(self._keys):
            return np.full(len(keys), -1)
        place = np.searchsorted(self._keys, keys).clip(max=len(self._keys) - 1)
        return np.where(self._keys[place] == keys, place, -1)

    def _learn(self, new: NDArray[np.int64]) -> None:
        new = new[: self._most - len(self._keys)]
        rows = np.zeros((5, len(new)), np.int64)
        rows[2], rows[3] = _NO_TIME, -1
        keys = np.concatenate([self._keys, new])
        order = np.argsort(keys)
        self._keys = keys[order]
        self._table = np.concatenate([self._table, rows], axis=1)[:, order]

    def _add(self, place: NDArray[np.int64], t_ns: NDArray[np.int64]) -> None:
        order = np.argsort(place.astype(np.uint16), kind="stable")  # a radix sort
        place, t_ns = place[order], t_ns[order]
        starts = np.flatnonzero(np.diff(place, prepend=-1))
        own, table = place[starts], self._table
        before = np.empty_like(t_ns)
        before[1:] = t_ns[:-1]
        is_new = table[2, own] == _NO_TIME
        before[starts] = np.where(is_new, t_ns[starts], table[2, own])
        table[1, own] = np.where(is_new, t_ns[starts], table[1, own])
        gaps = (t_ns - before).clip(0)  # of a log whose times begin again
        gaps[starts[is_new]] = -1
        for begin, end in pairwise([*starts.tolist(), len(place)]):
            row = table[:, place[begin]]
            row[0] += end - begin
            row[2] = t_ns[end - 1]
            longest = begin + int(gaps[begin:end].argmax())
            if gaps[longest] > row[3]:
                row[3], row[4] = gaps[longest], before[longest]
