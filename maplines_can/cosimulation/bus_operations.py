"""Bus operations of FMI-LS-BUS 1.0.0 for CAN: the content of the binary variables of an FMU.

A binary variable holds any number of operations one after the other, each with an operation code,
its whole length, and its arguments; all numbers are little-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import NamedTuple

from ..wire.layout.slot_messages import FD_LENGTHS

#: Operation code and length of an operation [bytes].
HEADER = struct.Struct("<II")
FORMAT_ERROR, CAN_TRANSMIT, CAN_FD_TRANSMIT, CAN_XL_TRANSMIT = 0x01, 0x10, 0x11, 0x12
CONFIRM, ARBITRATION_LOST, BUS_ERROR = 0x20, 0x30, 0x31
CONFIGURATION, STATUS, WAKEUP = 0x40, 0x41, 0x42

#: Arguments before the data: CAN ID, IDE, RTR, length.
_CAN = struct.Struct("<IBBH")
#: CAN ID, IDE, BRS, ESI, length.
_CAN_FD = struct.Struct("<IBBBH")
_ID = struct.Struct("<I")
_BUS_ERROR = struct.Struct("<IBBB")
_LENGTH = struct.Struct("<H")
#: Bits of a standard and of an extended CAN ID.
_ID_BITS = {0: 11, 1: 29}
#: Lengths of the data of a CAN frame [bytes].
_CAN_LENGTHS = FD_LENGTHS[:9]


class ArbitrationLostBehavior(IntEnum):
    """What a bus simulation does with a frame that loses arbitration."""

    BUFFER_AND_RETRANSMIT = 1
    DISCARD_AND_NOTIFY = 2


class NodeStatus(IntEnum):
    """State of the CAN controller of a node."""

    ERROR_ACTIVE = 1
    ERROR_PASSIVE = 2
    BUS_OFF = 3


class Parameter(IntEnum):
    """Parameter of a configuration."""

    CAN_BAUDRATE = 1
    CAN_FD_BAUDRATE = 2
    CAN_XL_BAUDRATE = 3
    ARBITRATION_LOST_BEHAVIOR = 4


class Transmit(NamedTuple):
    """Frame to be transmitted, CAN or CAN FD.

    The first fields are those of ``wire.Frame``, so that faults can be injected.
    """

    can_id: int
    data: bytes
    is_fd: bool = False
    is_extended: bool = False
    is_remote: bool = False  #: CAN only
    bit_rate_switch: bool = False  #: CAN FD only
    error_state: bool = False  #: CAN FD only
    requested: int = 0  #: bytes that a remote frame asks for; the operation may have no data for it


class Confirm(NamedTuple):
    """Confirmation that a frame was transmitted."""

    can_id: int


class ArbitrationLost(NamedTuple):
    """Notification that a frame lost arbitration and was discarded."""

    can_id: int


class BusError(NamedTuple):
    """Simulated error of the bus."""

    can_id: int
    code: int  #: 1 to 6: bit, stuffing, form, CRC, acknowledge, broken error frame
    flag: int  #: 1 for the node that detects it first, 2 for others
    is_sender: bool


class Configuration(NamedTuple):
    """Parameter that a node gives to the bus simulation."""

    parameter: Parameter
    value: int  #: bit rate [bit/s], or ``ArbitrationLostBehavior``


class Status(NamedTuple):
    """State of the CAN controller of a node."""

    status: NodeStatus


class Wakeup(NamedTuple):
    """Wake-up pulse."""


class FormatError(NamedTuple):
    """Answer to a corrupt operation."""

    data: bytes


class Corrupt(NamedTuple):
    """Bytes that are no operation of CAN or CAN FD, and why."""

    data: bytes
    reason: str


Operation = (
    Transmit
    | Confirm
    | ArbitrationLost
    | BusError
    | Configuration
    | Status
    | Wakeup
    | FormatError
    | Corrupt
)


def encode(operations: Iterable[Operation]) -> bytes:
    """Return operations as the value of a binary variable.

    >>> encode([Confirm(0x123)]).hex(" ", 4)
    '20000000 0c000000 23010000'
    """
    return b"".join(map(_encoded, operations))


def decode(data: bytes) -> list[Operation]:
    """Return the operations in the value of a binary variable.

    What is no operation becomes ``Corrupt``: one operation if its length can be believed, otherwise
    all bytes to the end.

    >>> decode(encode([Confirm(1), Wakeup()]))
    [Confirm(can_id=1), Wakeup()]
    """
    operations: list[Operation] = []
    at = 0
    while at < len(data):
        if len(data) - at < HEADER.size:
            operations.append(Corrupt(data[at:], f"{len(data) - at} bytes are no operation"))
            break
        code, length = HEADER.unpack_from(data, at)
        if not HEADER.size <= length <= len(data) - at:
            reason = f"operation {code:#x} gives its length as {length} of {len(data) - at} bytes"
            operations.append(Corrupt(data[at:], reason))
            break
        operations.append(_decoded(code, data[at : at + length]))
        at += length
    return operations


def _encoded(operation: Operation) -> bytes:
    match operation:
        case Transmit(can_id, data, True, extended, _, switch, error):
            head = _CAN_FD.pack(can_id, extended, switch, error, len(data))
            return _framed(CAN_FD_TRANSMIT, head + data)
        case Transmit(can_id, data, _, extended, remote, _, _, requested):
            head = _CAN.pack(can_id, extended, remote, requested if remote else len(data))
            return _framed(CAN_TRANSMIT, head + data)
        case Confirm(can_id):
            return _framed(CONFIRM, _ID.pack(can_id))
        case ArbitrationLost(can_id):
            return _framed(ARBITRATION_LOST, _ID.pack(can_id))
        case BusError():
            return _framed(BUS_ERROR, _BUS_ERROR.pack(*operation))
        case Configuration(Parameter.ARBITRATION_LOST_BEHAVIOR, value):
            return _framed(CONFIGURATION, bytes((Parameter.ARBITRATION_LOST_BEHAVIOR, value)))
        case Configuration(parameter, value):
            return _framed(CONFIGURATION, bytes((parameter,)) + _ID.pack(value))
        case Status(status):
            return _framed(STATUS, bytes((status,)))
        case Wakeup():
            return _framed(WAKEUP, b"")
        case FormatError(data):
            return _framed(FORMAT_ERROR, _LENGTH.pack(len(data)) + data)
        case Corrupt(data):
            return data


def _framed(code: int, arguments: bytes) -> bytes:
    return HEADER.pack(code, HEADER.size + len(arguments)) + arguments


def _decoded(code: int, operation: bytes) -> Operation:
    """Return one operation, whose length field is right."""
    try:
        return _parsed(code, operation[HEADER.size :])
    except (struct.error, ValueError, IndexError) as error:
        return Corrupt(operation, f"operation {code:#x} of {len(operation)} bytes: {error}")


def _parsed(code: int, arguments: bytes) -> Operation:
    """Return the operation of a code with these arguments.

    Raises:
        ValueError, struct.error, IndexError: there is none.
    """
    match code:
        case 0x10:
            can_id, extended, remote, length = _CAN.unpack_from(arguments)
            # A remote frame states the length that it asks for; nodes give it data, too, or none.
            is_short = remote == 1 and len(arguments) == _CAN.size
            data = b"" if is_short else _data(arguments, _CAN.size, length)
            _check_length(length, _CAN_LENGTHS)
            _check_id(can_id, extended)
            frame = Transmit(can_id, data, False, bool(extended), bool(remote))
            return frame._replace(requested=length) if remote else frame
        case 0x11:
            can_id, extended, switch, error, length = _CAN_FD.unpack_from(arguments)
            data = _data(arguments, _CAN_FD.size, length)
            _check_length(length, FD_LENGTHS)
            _check_id(can_id, extended)
            return Transmit(can_id, data, True, bool(extended), False, bool(switch), bool(error))
        case 0x20:
            return Confirm(*_ID.unpack(arguments))
        case 0x30:
            return ArbitrationLost(*_ID.unpack(arguments))
        case 0x31:
            can_id, error, flag, sender = _BUS_ERROR.unpack(arguments)
            return BusError(can_id, error, flag, bool(sender))
        case 0x40:
            return _configuration(Parameter(arguments[0]), arguments[1:])
        case 0x41:
            (status,) = arguments
            return Status(NodeStatus(status))
        case 0x42 if not arguments:
            return Wakeup()
        case 0x01:
            (length,) = _LENGTH.unpack_from(arguments)
            return FormatError(_data(arguments, _LENGTH.size, length))
        case 0x12:
            raise ValueError("CAN XL is not supported")
    raise ValueError("there is no such operation")


def _configuration(parameter: Parameter, value: bytes) -> Configuration:
    if parameter is Parameter.ARBITRATION_LOST_BEHAVIOR:
        (behavior,) = value
        return Configuration(parameter, ArbitrationLostBehavior(behavior))
    return Configuration(parameter, *_ID.unpack(value))


def _data(arguments: bytes, at: int, length: int) -> bytes:
    data = arguments[at:]
    if len(data) != length:
        raise ValueError(f"{len(data)} data bytes, where it says {length}")
    return data


def _check_length(length: int, lengths: Sequence[int]) -> None:
    if length not in lengths:
        raise ValueError(f"no such frame has {length} data bytes")


def _check_id(can_id: int, extended: int) -> None:
    bits = _ID_BITS.get(extended)
    if bits is None:
        raise ValueError(f"IDE is {extended}")
    if can_id >> bits:
        raise ValueError(f"CAN ID {can_id:#x} has more than {bits} bits")
