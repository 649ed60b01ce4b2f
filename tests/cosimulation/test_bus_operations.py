"""The codec of bus operations: bytes as the tables of the standard say, and any bytes decode."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.cosimulation.bus_operations import (
    ArbitrationLost,
    ArbitrationLostBehavior,
    BusError,
    Configuration,
    Confirm,
    Corrupt,
    FormatError,
    NodeStatus,
    Operation,
    Parameter,
    Status,
    Transmit,
    Wakeup,
    decode,
    encode,
)

#: Bytes by operation: code and length, then the arguments, as the standard lists them.
EXAMPLES: list[tuple[Operation, str]] = [
    (Transmit(0x123, b"\x01\x02"), "10000000 12000000 23010000 00 00 0200 0102"),
    (Transmit(0x7FF, b"", is_remote=True), "10000000 10000000 ff070000 00 01 0000"),
    # FMI-LS-BUS since its pull request 393: a remote frame has a length, and no data ...
    (Transmit(0x7FF, b"", is_remote=True, requested=4), "10000000 10000000 ff070000 00 01 0400"),
    # ... and before it, the macro of its header wrote data, too.
    (
        Transmit(0x7FF, bytes(2), is_remote=True, requested=2),
        "10000000 12000000 ff070000 00 01 0200 0000",
    ),
    (
        Transmit(0x1ABCDEF0, b"\xaa" * 12, True, True, False, True, True),
        "11000000 1d000000 f0debc1a 01 01 01 0c00" + "aa" * 12,
    ),
    (Confirm(0x123), "20000000 0c000000 23010000"),
    (ArbitrationLost(0x123), "30000000 0c000000 23010000"),
    (BusError(0x123, 4, 1, True), "31000000 0f000000 23010000 04 01 01"),
    (Configuration(Parameter.CAN_BAUDRATE, 500_000), "40000000 0d000000 01 20a10700"),
    (Configuration(Parameter.CAN_FD_BAUDRATE, 2_000_000), "40000000 0d000000 02 80841e00"),
    (
        Configuration(
            Parameter.ARBITRATION_LOST_BEHAVIOR, ArbitrationLostBehavior.DISCARD_AND_NOTIFY
        ),
        "40000000 0a000000 04 02",
    ),
    (Status(NodeStatus.BUS_OFF), "41000000 09000000 03"),
    (Wakeup(), "42000000 08000000"),
    (FormatError(b"\x99"), "01000000 0b000000 0100 99"),
]


@pytest.mark.parametrize(("operation", "text"), EXAMPLES)
def test_operation_has_the_bytes_of_the_standard(operation: Operation, text: str) -> None:
    assert encode([operation]) == bytes.fromhex(text)
    assert decode(bytes.fromhex(text)) == [operation]


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("100000", "3 bytes are no operation"),
        ("10000000 ff000000", "length as 255 of 8 bytes"),
        ("10000000 07000000", "length as 7 of 8 bytes"),
        ("77000000 08000000", "no such operation"),
        ("12000000 08000000", "CAN XL is not supported"),
        ("10000000 12000000 23010000 00 00 0300 0102", "2 data bytes, where it says 3"),
        ("10000000 19000000 23010000 00 00 0900" + "00" * 9, "no such frame has 9 data bytes"),
        ("11000000 1a000000 23010000 00 00 00 0900" + "00" * 9, "no such frame has 9 data bytes"),
        ("10000000 10000000 00080000 00 00 0000", "more than 11 bits"),
        ("10000000 10000000 00000020 01 00 0000", "more than 29 bits"),
        ("10000000 10000000 00000000 02 00 0000", "IDE is 2"),
        ("20000000 08000000", "requires a buffer of 4 bytes"),
        ("40000000 08000000", "index out of range"),
        ("40000000 0d000000 09 20a10700", "9 is not a valid Parameter"),
        ("41000000 09000000 04", "4 is not a valid NodeStatus"),
        ("42000000 09000000 00", "no such operation"),
    ],
)
def test_corrupt_operation_is_kept_with_its_reason(text: str, reason: str) -> None:
    (found,) = decode(bytes.fromhex(text))
    assert isinstance(found, Corrupt)
    assert found.data == bytes.fromhex(text)
    assert reason in found.reason


def test_operations_after_a_corrupt_one_are_decoded() -> None:
    unknown = bytes.fromhex("77000000 09000000 00")
    first, second = decode(unknown + encode([Confirm(1)]))
    assert isinstance(first, Corrupt)
    assert second == Confirm(1)


@given(st.lists(st.binary(max_size=40) | st.sampled_from([bytes.fromhex(t) for _, t in EXAMPLES])))
def test_any_bytes_decode_to_operations_that_encode_to_them(parts: list[bytes]) -> None:
    """Bytes other than 0 and 1 for a truth value are the only ones that may change."""
    data = b"".join(parts)
    again = encode(decode(data))
    assert len(again) == len(data)
    assert decode(again) == decode(data)
