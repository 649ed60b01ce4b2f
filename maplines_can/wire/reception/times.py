"""Times of frames and of callers, as the decoders in C and in Python take them."""

from __future__ import annotations

from operator import index

#: A time beyond this is taken as this one [ns]: 127 years from the zero of the clock.
MAX_TIME_NS = 4 * 10**18


def limited_ns(time: float, name: str) -> int:
    """Return a time as an integer of at most ``MAX_TIME_NS`` [ns].

    Args:
        time: an integer of any type, or a float without a fraction [ns].
        name: of the argument, for messages.

    Raises:
        ValueError: it is a float with a fraction, or not finite.
        TypeError: it is no number.

    >>> limited_ns(5.0, "now_ns"), limited_ns(-(10**30), "now_ns")
    (5, -4000000000000000000)
    """
    if isinstance(time, float):
        if not time.is_integer():
            raise ValueError(f"{name} must be whole [ns], got {time!r}")
        time = int(time)
    return max(-MAX_TIME_NS, min(index(time), MAX_TIME_NS))
