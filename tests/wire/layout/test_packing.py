"""Packing and unpacking of raw values, compared with cantools."""

from typing import Any

import numpy as np
import pytest
from cantools.database.can import Message
from cantools.database.can import Signal as DbcSignal
from cantools.database.conversion import BaseConversion
from hypothesis import given, settings
from hypothesis import strategies as st

from maplines_can.wire.layout.packing import Packing
from maplines_can.wire.layout.record_signals import Signal

LENGTHS = (8, 16, 24, 32, 48, 64)


@st.composite
def layouts(draw: Any) -> Any:
    """Random signals of both byte orders, 1 to 64 bits (unsigned 63), that do not overlap."""
    length = draw(st.sampled_from(LENGTHS))
    free = np.ones(8 * length, dtype=bool)  # numbered as Intel numbers bits
    signals = []
    for i in range(draw(st.integers(1, 12))):
        bits = draw(st.integers(1, 64))
        big_endian = draw(st.booleans())
        start = draw(st.integers(0, 8 * length - 1))
        if big_endian:
            first = start // 8 * 8 + 7 - start % 8
            stream = range(first, first + bits)
            taken = [p // 8 * 8 + 7 - p % 8 for p in stream]
        else:
            taken = list(range(start, start + bits))
        if max(taken) >= 8 * length or not free[taken].all():
            continue
        free[taken] = False
        signed = draw(st.booleans()) or bits == 64
        low = -(2 ** (bits - 1)) if signed else 0
        signals.append(
            Signal(f"S{i}", start, bits, big_endian, signed, 1.0, 0.0, "", low, low + 2**bits - 1)
        )
    return length, signals


def message_of(length: Any, signals: Any) -> Any:
    signals = [
        DbcSignal(
            s.name,
            s.start,
            s.length,
            "big_endian" if s.big_endian else "little_endian",
            s.signed,
            conversion=BaseConversion.factory(1, 0, None, False),
        )
        for s in signals
    ]
    return Message(1, "M", length, signals, is_fd=length > 8)


@settings(max_examples=100, deadline=None)
@given(layouts(), st.integers(0, 2**32))
def test_any_layout_agrees_with_cantools(layout: Any, seed: int) -> None:
    """Random bytes give the same raw values, and raw values the same bytes."""
    length, signals = layout
    packing = Packing(signals, length)
    payloads = np.random.default_rng(seed).integers(0, 256, (5, length), dtype=np.uint8)
    raw = packing.unpack(payloads)
    packed = packing.pack(raw, len(payloads))
    message = message_of(length, signals)
    for i, payload in enumerate(payloads):
        expected = message.decode(payload.tobytes())
        assert {name: int(raw[name][i]) for name in raw} == expected
        assert packed[i].tobytes() == message.encode(expected)
        assert packing.pack_one(expected) == packed[i].tobytes()


@pytest.mark.parametrize("n", [0, 1])
def test_no_records_and_one_record(n: int) -> None:
    """No records give no values."""
    packing = Packing([Signal("A", 0, 8, False, False, 1.0, 0.0, "", 0, 255)], 8)
    payloads = packing.pack({"A": np.full(n, 7)}, n)
    assert payloads.shape == (n, 8)
    assert packing.unpack(payloads)["A"].tolist() == [7] * n


def test_too_large_values_do_not_change_other_signals() -> None:
    """Only the low bits of a value are written."""
    a = Signal("A", 0, 4, False, False, 1.0, 0.0, "", 0, 15)
    b = Signal("B", 4, 4, False, False, 1.0, 0.0, "", 0, 15)
    packing = Packing([a, b], 8)
    payload = packing.pack({"A": np.array([0x1F]), "B": np.array([2])}, 1)
    assert payload[0, 0] == 0x2F
    assert packing.pack_one({"A": 0x1F, "B": 2}) == payload[0].tobytes()


@pytest.mark.parametrize(
    ("start", "big_endian", "length"), [(60, False, 8), (59, True, 5), (0, False, 12)]
)
def test_a_signal_beyond_a_record_is_refused(start: int, big_endian: bool, length: int) -> None:
    """Its bits would be those of the next one."""
    signal = Signal("A", start, 5, big_endian, False, 1.0, 0.0, "", 0, 31)
    with pytest.raises(ValueError, match=r"record_bytes must|signal A is not within 8 bytes"):
        Packing([signal], length)
