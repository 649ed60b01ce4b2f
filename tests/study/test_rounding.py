"""Directed rounding: the end of a range that is sent is never outside of the one that is given."""

import math

import numpy as np
from hypothesis import example, given
from hypothesis import strategies as st

from maplines_can.study.codes.code import raw_above, raw_below
from maplines_can.wire.layout.record_signals import Signal

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
    st.sampled_from([1, 4, 16]),
    signed=st.booleans(),
)


@given(SIGNALS, NUMBERS)
@example(signal(1e-30, 0.0, 4, signed=True), 1e300)
@example(signal(1.0, 0.0, 4, signed=False), 15.5)
@example(signal(1.0, 0.0, 4, signed=True), -8.5)
@example(signal(1.0, -8.0, 4, signed=True), math.inf)
def test_a_number_is_between_its_raw_values(of: Signal, number: float) -> None:
    """The next raw values above and below it, or the ends of the range beyond it."""
    with np.errstate(over="ignore", invalid="ignore"):
        above, below = raw_above(of, number), raw_below(of, number)

    assert above == of.raw_max or of.physical_one(above) >= number
    assert above == of.raw_min or of.physical_one(above - 1) < number
    assert below == of.raw_min or of.physical_one(below) <= number
    assert below == of.raw_max or of.physical_one(below + 1) > number
