"""Is a frame authentic? AUTOSAR SecOC with a truncated freshness value and MAC.

A secured I-PDU is the authentic one (the record, padding, and the key ID in its last byte), then
the low bytes of the freshness value, then the first bytes of the MAC, which covers

    data ID in 16 bits | authentic I-PDU | whole freshness value in 64 bits

All numbers are big-endian. The freshness value is the sender's time [us].
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from ..wire.layout.slot_messages import SecuredLayout

MAX_FRESHNESS = 2**63 - 1


@dataclass
class Keys:
    """Keys of a receiver, and the last freshness value of each data ID."""

    #: Returns the whole MAC of a key ID and data, AES-CMAC (RFC 4493); None without such a key.
    mac: Callable[[int, bytes], bytes | None]
    clock_us: Callable[[], int] | None = None  #: returns the time
    window_us: int = 1_000_000  #: greatest difference between a freshness value and the clock
    last_us: dict[int, int] = field(default_factory=dict)


def verified(keys: Keys, layout: SecuredLayout, data: bytes, data_id: int) -> bytes | str:
    """Return the authentic I-PDU of a secured one, or why it is rejected.

    Only a valid MAC changes anything. A freshness value is accepted if it is greater than the last
    one, and not beyond the window about the clock.
    """
    if len(data) != layout.length:
        return "LENGTH"
    authentic, trailer = data[: layout.authentic_bytes], data[layout.authentic_bytes :]
    low, mac = trailer[: layout.freshness_bytes], trailer[layout.freshness_bytes :]
    last, floor, latest = keys.last_us.get(data_id, 0), 0, MAX_FRESHNESS
    if keys.clock_us is not None:
        now = keys.clock_us()
        floor, latest = now - keys.window_us - 1, min(now + keys.window_us, MAX_FRESHNESS)
    freshness = completed(low, max(last, floor))

    def is_valid(value: int) -> bool:
        covered = data_id.to_bytes(2, "big") + authentic + value.to_bytes(8, "big")
        found = keys.mac(authentic[-1], covered)
        return found is not None and found[: len(mac)] == mac

    if keys.mac(authentic[-1], b"") is None:
        return "KEY"
    if is_valid(freshness):
        if freshness > latest:
            return "AGE"
        keys.last_us[data_id] = freshness
        return authentic
    # It is never accepted, but an old frame is to be told from a forged one.
    freshness -= 256 ** len(low)
    if freshness < 0 or not is_valid(freshness):
        return "MAC"
    return "REPLAY" if freshness <= last else "AGE"


def completed(low: bytes, floor: int) -> int:
    """Return the least freshness value above ``floor`` with these low bytes.

    >>> [hex(completed(bytes([low]), 0x1FE)) for low in (0xFF, 0xFE, 0x00)]
    ['0x1ff', '0x2fe', '0x200']
    """
    span = 256 ** len(low)
    value = floor // span * span + int.from_bytes(low, "big")
    return value if value > floor else value + span
