"""Counters of a sender, as the core has them."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import repeat
from operator import index
from struct import Struct, error

from ..layout.pose_layout import OWNERS, Owner

_FORM = Struct(f"{len(OWNERS)}q")


def packed(counters: Mapping[Owner, int]) -> bytes:
    """Return the counters of all owners; 0 without one. Only their low 32 bits count.

    Raises:
        TypeError: one is no integer.

    >>> from maplines_can import Slot
    >>> unpacked(packed({Slot.ROUTE: 3}))[Slot.ROUTE]
    3
    """
    given = [*map(counters.get, OWNERS, repeat(0))]
    try:
        return _FORM.pack(*given)
    except error:  # one has more than 64 bits, or is no integer
        return _FORM.pack(*(index(one) & 0xFFFFFFFF for one in given))


def unpacked(counters: bytes) -> dict[Owner, int]:
    """Return the counters by owner."""
    return dict(zip(OWNERS, _FORM.unpack(counters), strict=True))
