"""Lines and counters of a sender as the core takes them: bytes of their values, one by one."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import chain, repeat
from operator import attrgetter, index
from struct import Struct, error
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.line import MapLine, Slot
from .layout.pose_layout import OWNERS, Owner

#: Bytes of a mean and of its covariance.
GAUSSIAN_BYTES = 160
_FIELDS = attrgetter("slot", "kind", "status", "x_min", "x_max", "age")
_MIXTURE, _ARRAYS = attrgetter("mixture"), attrgetter("gaussian.mean", "gaussian.cov")
_SLOT, _OF_COMPONENT = attrgetter("slot"), attrgetter("mean", "cov")
_ONE = np.ones(1)


class GivenLines(NamedTuple):
    """N lines, of M components in all. Without a mixture, the last two are empty."""

    slots: list[Slot]
    lines: bytes  #: N ``maplines_given_line_t``
    gaussians: bytes  #: M means and covariances
    parts: bytes | array[int]  #: components of each line, int32; 0 if it is no mixture
    weights: bytes  #: of the components


def given_lines(lines: Sequence[MapLine]) -> GivenLines:
    """Return lines as the core takes them.

    Raises:
        ValueError: a Gaussian is not over four parameters, or a component has no weight.
        struct.error: a value is no number, or no integer where that is needed.
    """
    slots = [*map(_SLOT, lines)]
    given = _form(len(slots)).pack(*chain.from_iterable(map(_FIELDS, lines)))
    mixtures = [*map(_MIXTURE, lines)]
    if mixtures.count(None) == len(slots):
        gaussians = _bytes(chain.from_iterable(map(_ARRAYS, lines)))
        if len(gaussians) != GAUSSIAN_BYTES * len(slots):
            raise ValueError("each Gaussian of a line must be over four parameters")
        return GivenLines(slots, given, gaussians, b"", b"")
    components = [
        (line.gaussian,) if mixture is None else mixture.components
        for line, mixture in zip(lines, mixtures, strict=True)
    ]
    n = sum(map(len, components))
    parts = array("i", [0 if one is None else len(one.components) for one in mixtures])
    arrays = map(_OF_COMPONENT, chain.from_iterable(components))
    gaussians = _bytes(chain.from_iterable(arrays))
    weights = _bytes(_ONE if mixture is None else mixture.weights for mixture in mixtures)
    if (len(gaussians), len(weights)) != (GAUSSIAN_BYTES * n, 8 * n):
        raise ValueError("each component must be over four parameters, and have a weight")
    return GivenLines(slots, given, gaussians, parts, weights)


@lru_cache(maxsize=64)
def _form(n: int) -> struct.Struct:
    """Return the form of n lines: ``maplines_given_line_t``."""
    return struct.Struct("=" + "3i4x3d" * n)


def _bytes(arrays: Iterable[NDArray[np.float64]]) -> bytes:
    """Return the values of arrays one after the other, by rows."""
    kept: list[Any] = [*arrays]
    try:
        return b"".join(kept)
    except (BufferError, ValueError, TypeError):  # one is not in C order
        kept = [*map(np.ascontiguousarray, kept)]
        return b"".join(kept)


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
