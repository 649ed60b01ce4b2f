"""Exponents of 2: their range is checked when a DBC is read."""

import pytest

from maplines_can.values.errors import LayoutError
from maplines_can.wire.layout.record_signals import FARTHEST_OCTAVE, OCTAVES, Signal


def exponent(length: int, *, signed: bool, factor: float = 1.0, offset: float = 0.0) -> Signal:
    low = -(2 ** (length - 1)) if signed else 0
    return Signal(
        name="Pivot",
        start=0,
        length=length,
        big_endian=False,
        signed=signed,
        factor=factor,
        offset=offset,
        unit="",
        raw_min=low,
        raw_max=low + 2**length - 1,
        is_float=False,
    )


@pytest.mark.parametrize(
    ("signed", "factor", "offset", "fits"),
    [
        pytest.param(False, FARTHEST_OCTAVE / 255, 0.0, True, id="up-to-the-end"),
        pytest.param(False, FARTHEST_OCTAVE / 254, 0.0, False, id="beyond-the-end"),
        pytest.param(False, FARTHEST_OCTAVE / 255, 1.0, False, id="beyond-with-offset"),
        pytest.param(False, 1.0, -FARTHEST_OCTAVE, True, id="from-the-other-end"),
        pytest.param(False, 1.0, -FARTHEST_OCTAVE - 1, False, id="before-the-other-end"),
        pytest.param(True, FARTHEST_OCTAVE / 128, 0.0, True, id="signed"),
        pytest.param(True, FARTHEST_OCTAVE / 127, 0.0, False, id="signed-beyond"),
        pytest.param(True, FARTHEST_OCTAVE / 255, 0.0, True, id="signed-small"),
        pytest.param(False, -0.1, 0.0, False, id="negative-factor"),
    ],
)
def test_an_exponent_must_not_overflow(
    signed: bool, factor: float, offset: float, fits: bool
) -> None:
    """All bits count, whatever range the DBC gives; the ends are allowed."""
    signal = exponent(8, signed=signed, factor=factor, offset=offset)
    if fits:
        OCTAVES.check(signal, "test.dbc")
    else:
        with pytest.raises(LayoutError, match=r"test\.dbc: signal Pivot"):
            OCTAVES.check(signal, "test.dbc")
