"""Conversion of one number: the same raw values as of many."""

import math
from typing import Any

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from maplines_can.wire.layout.signals import Signal

#: Numbers of all sizes, and those within and hardly beyond the steps of a signal.
NUMBERS = st.floats(allow_nan=False) | st.builds(
    lambda steps, factor, beyond: steps * factor + beyond,
    st.integers(-40, 40).map(lambda halves: halves / 2),
    st.sampled_from([1.0, 0.02, 1e-7]),
    st.sampled_from([0.0, 1e-12, -1e-12, 1e-9, -1e-9, 1e-3]),
)


def signal(factor: float, offset: float, bits: int, *, signed: bool) -> Signal:
    low = -(2 ** (bits - 1)) if signed else 0
    return Signal("S", 0, bits, False, signed, factor, offset, "", low, low + 2**bits - 1)


SIGNALS = st.builds(
    signal,
    st.sampled_from([1.0, 0.02, 1e-7, 1e-30]),
    st.sampled_from([0.0, -8.0, 0.3]),
    st.sampled_from([1, 4, 53]),
    signed=st.booleans(),
)


@given(SIGNALS, NUMBERS)
@example(signal(1e-30, 0.0, 4, signed=True), 1e300)
@example(signal(1.0, 0.0, 4, signed=False), 15.5)
@example(signal(1.0, 0.0, 4, signed=False), 16.0)
@example(signal(1.0, 0.0, 4, signed=True), -8.5)
@example(signal(1.0, 0.0, 4, signed=True), -9.0)
@example(signal(1.0, -8.0, 4, signed=True), math.inf)
def test_one_number_is_converted_as_one_of_many(of: Signal, number: float) -> None:
    """The nearest raw value and those rounded up and down, infinite ones included."""
    with np.errstate(over="ignore", invalid="ignore"):
        nearest = of.nearest([number])
        above, below = of.raw_above(np.array([number])), of.raw_below(np.array([number]))
    expected: list[Any] = [nearest.raw[0], nearest.physical[0], nearest.clipped[0]]

    assert list(of.nearest_one(number)) == expected
    for raw, one in ((above, of.above_one(number)), (below, of.below_one(number))):
        assert one == (of.limited(raw)[0], raw[0] != of.limited(raw)[0])
