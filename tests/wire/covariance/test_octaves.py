"""Exponents of 2: their range is checked at load, and both ways to compute them agree."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from maplines_can.values.elementary import exp2
from maplines_can.values.errors import LayoutError
from maplines_can.wire.covariance.code import check_octaves
from maplines_can.wire.covariance.factor import PowersOfTwo
from maplines_can.wire.layout.signals import FARTHEST_OCTAVE, Signal

LAYOUT: Any = SimpleNamespace(source="test.dbc")


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
        check_octaves(LAYOUT, [signal])
    else:
        with pytest.raises(LayoutError, match=r"test\.dbc: signal Pivot"):
            check_octaves(LAYOUT, [signal])


@pytest.mark.parametrize("share", [1.0, 0.5])
@pytest.mark.parametrize("length", [4, 15, 16, 17])
@pytest.mark.parametrize("signed", [False, True])
def test_a_table_and_the_power_agree(length: int, signed: bool, share: float) -> None:
    """To the last bit, for one value and for many; a long signal has no table."""
    signal = exponent(length, signed=signed, factor=1 / 1024, offset=-3.3)
    powers = PowersOfTwo(signal, share)
    assert (powers.table is None) == (length > 16)
    raw = np.linspace(signal.raw_min, signal.raw_max, 50).astype(np.int64)
    wanted = np.asarray(exp2(share * signal.physical(raw)))
    assert np.array_equal(powers.of(raw), wanted)
    assert [powers.of_one(one) for one in raw.tolist()] == wanted.tolist()
    if powers.table is not None:
        outside = np.array([signal.raw_min - 1, signal.raw_max + 1])
        assert powers.of(outside).tolist() == [wanted[0], wanted[-1]]
        assert [powers.of_one(one) for one in outside.tolist()] == [wanted[0], wanted[-1]]
