"""Bus load of CAN frames in the worst case of bit stuffing."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from ..wire import Frame
from ..wire.layout.slot_messages import FD_LENGTHS


class FrameBits(NamedTuple):
    """Bits of a frame on the bus, by bit rate."""

    nominal: int  #: at the nominal bit rate (arbitration phase)
    data: int = 0  #: at the bit rate of the data phase (CAN FD)


def frame_bits(length: int, *, is_extended: bool = False, is_fd: bool = False) -> FrameBits:
    """Return the largest number of bits of a data frame with its interframe space.

    Classic CAN, of s bytes (Davis, Burns, Bril and Lukkien: Controller Area
    Network (CAN) schedulability analysis: Refuted, revisited and revised,
    Real-Time Systems 35, 2007, eq. 1 to 3; g = 34, or 54 for 29-bit identifiers):

        C = g + 8 s + 13 + floor((g + 8 s - 1) / 4) = 55 + 10 s, or 80 + 10 s

    CAN FD, counted from its frame format (ISO 11898-1:2015) in the same way: 17 bits (29-bit
    identifiers: 36) up to BRS at the nominal rate; ESI, DLC and data at the data rate; over both
    together at most one stuff bit for each 4 bits after the first; then, at the data rate, stuff
    count and CRC of 4 + 17 bits with 6 fixed stuff bits (4 + 21 with 7 above 16 bytes); and 13
    nominal bits from the CRC delimiter to the end of the intermission.

    Args:
        length: of the payload [bytes].
        is_extended: 29-bit identifier.
        is_fd: CAN FD with bit-rate switch.

    Raises:
        ValueError: no frame has this length.

    >>> frame_bits(8), frame_bits(32, is_fd=True)
    (FrameBits(nominal=135, data=0), FrameBits(nominal=34, data=358))
    """
    if length not in (FD_LENGTHS if is_fd else FD_LENGTHS[:9]):
        lengths = "0 to 8, 12, 16, 20, 24, 32, 48 or 64" if is_fd else "0 to 8"
        raise ValueError(f"length must be {lengths} bytes, got {length!r}")
    if not is_fd:
        return FrameBits((80 if is_extended else 55) + 10 * length)
    head, body = (36 if is_extended else 17), 1 + 4 + 8 * length
    head_stuff = (head - 1) // 4  # as many as possible at the slower rate
    body_stuff = (head + body - 1) // 4 - head_stuff
    crc = 4 + 17 + 6 if length <= 16 else 4 + 21 + 7
    return FrameBits(head + head_stuff + 13, body + body_stuff + crc)


def frame_time(frame: Frame, bitrate: float, data_bitrate: float | None = None) -> float:
    """Return the longest time that a frame takes on the bus [s].

    Args:
        frame: a data frame.
        bitrate: nominal bit rate [bit/s].
        data_bitrate: bit rate of the data phase of CAN FD frames [bit/s]; None: the nominal one.

    Raises:
        ValueError: a rate is not positive, or no frame has this length.
    """
    data_bitrate = bitrate if data_bitrate is None else data_bitrate
    if not (0 < bitrate < math.inf and 0 < data_bitrate < math.inf):
        raise ValueError(f"bit rates must be positive [bit/s], got {bitrate!r}, {data_bitrate!r}")
    bits = frame_bits(len(frame.data), is_extended=frame.is_extended, is_fd=frame.is_fd)
    return bits.nominal / bitrate + bits.data / data_bitrate


def bus_load(
    frames: Iterable[Frame], period: float, bitrate: float, data_bitrate: float | None = None
) -> float:
    """Return the share of the bus time that these frames take, each sent once a period [s].

    At 1 the bus is never idle; above 1 the frames do not fit. Bit rates as in ``frame_time``.

    Raises:
        ValueError: the period or a rate is not positive.
    """
    if not 0 < period < math.inf:
        raise ValueError(f"period must be positive [s], got {period!r}")
    return sum(frame_time(frame, bitrate, data_bitrate) for frame in frames) / period


def transfers_within(
    share: float,
    transfer: Iterable[Frame],
    period: float,
    bitrate: float,
    data_bitrate: float | None = None,
) -> int:
    """Return how many transfers of these frames fit into a share of the bus time, each period [s].

    The share is more than 0 and at most 1. Bit rates as in ``frame_time``.

    Raises:
        ValueError: the share is out of range, the period or a rate is not positive, or the
            transfer has no frame.
    """
    if not 0 < share <= 1:
        raise ValueError(f"share must be more than 0 and at most 1, got {share!r}")
    load = bus_load(transfer, period, bitrate, data_bitrate)
    if not load:
        raise ValueError("transfer must have a frame or more, got none")
    # Rounding must not cost a transfer where they fill the share exactly.
    return math.floor(share / load * (1 + 1e-12))
