"""Protection of any message by AUTOSAR E2E: its counter and its checksum, as signals.

The counter and the checksum (CRC) are signals of the message. The CRC covers all other bytes
(AUTOSAR PRS_E2EProtocol):

====== ============= ======= ============= ==================================================
number CRC           counter CRC signal    order
====== ============= ======= ============= ==================================================
1, 11  8, SAE J1850  0 to 14 8 bits        data ID (16 bits, low byte first), then the payload
2      8, 0x2F       0 to 15 8 bits        payload, then the data ID of the counter (8 bits)
4      32, P4        16 bits 32, Motorola  payload, which contains the data ID (32 bits)
5      16, CCITT     8 bits  16, Intel     payload, then the data ID (16 bits), low byte first
6      16, CCITT     8 bits  16, Motorola  payload, then the data ID (16 bits), high byte first
7      64, ECMA      32 bits 64, Motorola  payload, which contains the data ID (32 bits)
====== ============= ======= ============= ==================================================

The length and the data ID that profiles 4, 6 and 7 send are signals like others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from ..values.errors import RestbusError
from .fields import Field, Fields, Raw
from .toml_tables import Table, number

if TYPE_CHECKING:
    from cantools.database.can import Message


class Profile(NamedTuple):
    """Profile of AUTOSAR E2E."""

    crc_bits: int
    counter_bits: int
    counters: int  #: number of counter values
    data_id_bits: int
    is_motorola: bool  #: byte order of the CRC


PROFILES = {
    "1": Profile(8, 4, 15, 16, is_motorola=False),
    "2": Profile(8, 4, 16, 8, is_motorola=False),
    "4": Profile(32, 16, 1 << 16, 32, is_motorola=True),
    "5": Profile(16, 8, 256, 16, is_motorola=False),
    "6": Profile(16, 8, 256, 16, is_motorola=True),
    "7": Profile(64, 32, 1 << 32, 32, is_motorola=True),
    "11": Profile(8, 4, 15, 16, is_motorola=False),
}
#: Which bytes of the data ID the CRC of profiles 1 and 11 covers: both; only the low one; one of
#: them, in turns by the counter; or the low one and a zero, while its high nibble is a signal.
DATA_ID_MODES = ("both", "low", "alternating", "nibble")


def _table(poly: int, bits: int) -> list[int]:
    """Return the table of a CRC whose bits are not reflected."""
    top, mask, table = 1 << (bits - 1), (1 << bits) - 1, []
    for byte in range(256):
        crc = byte << (bits - 8)
        for _ in range(8):
            crc = ((crc << 1) ^ poly if crc & top else crc << 1) & mask
        table.append(crc)
    return table


def _reflected_table(poly: int) -> list[int]:
    table = []
    for byte in range(256):
        crc = byte
        for _ in range(8):
            crc = (crc >> 1) ^ poly if crc & 1 else crc >> 1
        table.append(crc)
    return table


_J1850, _H2F, _CCITT = _table(0x1D, 8), _table(0x2F, 8), _table(0x1021, 16)
_P4 = _reflected_table(0xC8DF352F)  # 0xF4ACFB13, reflected
_ECMA = _reflected_table(0xC96C5795D7870F42)  # 0x42F0E1EBA9EA3693, reflected


def _crc8(data: bytes, table: list[int], crc: int = 0xFF) -> int:
    for byte in data:
        crc = table[crc ^ byte]
    return crc


def _crc16(data: bytes) -> int:
    crc = 0xFFFF
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _CCITT[crc >> 8 ^ byte]
    return crc


def _crc_reflected(data: bytes, table: list[int], bits: int) -> int:
    mask = (1 << bits) - 1
    crc = mask
    for byte in data:
        crc = crc >> 8 ^ table[(crc ^ byte) & 0xFF]
    return crc ^ mask


def checksum(
    profile: str, payload: bytes, data_id: int | Sequence[int], mode: str, counter: int
) -> int:
    """Return the CRC of a payload without the bytes of the CRC.

    Args:
        profile: number, a key of ``PROFILES``.
        payload: all other bytes, with the counter.
        data_id: the data ID; for profile 2, its 16 numbers by the counter.
        mode: of profiles 1 and 11, one of ``DATA_ID_MODES``.
        counter: in the payload.
    """
    if isinstance(data_id, Sequence):
        return _crc8(payload + bytes([data_id[counter]]), _H2F) ^ 0xFF
    if profile in ("1", "11"):
        low, high = data_id & 0xFF, data_id >> 8
        ids = {
            "both": bytes([low, high]),
            "low": bytes([low]),
            "alternating": bytes([high if counter % 2 else low]),
            "nibble": bytes([low, 0]),
        }[mode]
        return _crc8(ids + payload, _J1850, 0)
    return _OTHERS[profile](payload, data_id)


_OTHERS: dict[str, Callable[[bytes, int], int]] = {
    "4": lambda payload, _: _crc_reflected(payload, _P4, 32),
    "5": lambda payload, data_id: _crc16(payload + data_id.to_bytes(2, "little")),
    "6": lambda payload, data_id: _crc16(payload + data_id.to_bytes(2, "big")),
    "7": lambda payload, _: _crc_reflected(payload, _ECMA, 64),
}


class Protection:
    """Counter and checksum of a message by an AUTOSAR E2E profile; see ``restbus.e2e_protection``.

    Raises:
        RestbusError: the table is wrong, or a signal does not fit the profile.
    """

    def __init__(self, table: Table, message: Message, fields: Fields) -> None:
        self.number = str(table.take("profile", ""))
        if self.number not in PROFILES:
            known = ", ".join(PROFILES)
            raise RestbusError(f"{table.name}: profile must be one of {known}, got {self.number!r}")
        profile = PROFILES[self.number]
        self.profile, self._fields = profile, fields
        modes = {"1": DATA_ID_MODES, "11": ("both", "nibble")}.get(self.number)
        self.mode = "both" if modes is None else table.choice("data_id_mode", modes, "both")
        self.data_id = self._data_id(table)
        self.counter = self._field(table, "counter", profile.counter_bits)
        self.crc = self._field(table, "crc", profile.crc_bits)
        #: Signals that are set here, with their raw values; the counter has its own.
        self.fields: dict[Field, Raw] = {self.counter: 0, self.crc: 0}
        if self.mode == "nibble":
            self.fields[self._nibble(table, message)] = self.data_id >> 8  # type: ignore[operator]
        table.end()
        if self.counter == self.crc:
            raise RestbusError(
                f"{table.name}: counter and crc are the same signal {self.crc.name!r}"
            )
        self.first = self._crc_byte(table)
        self.last = self.first + profile.crc_bits // 8

    def protected(self, payload: bytes, counter: int) -> bytes:
        """Return a payload with its checksum; it has the counter already."""
        rest = payload[: self.first] + payload[self.last :]
        crc = checksum(self.number, rest, self.data_id, self.mode, counter)
        order = "big" if self.profile.is_motorola else "little"
        size = self.last - self.first
        return payload[: self.first] + crc.to_bytes(size, order) + payload[self.last :]  # type: ignore[arg-type]

    def _data_id(self, table: Table) -> int | list[int]:
        bits = 12 if self.mode == "nibble" else self.profile.data_id_bits
        value, most = table.take("data_id"), (1 << bits) - 1
        name = f"{table.name}: data_id"
        if self.number != "2":
            return int(number(name, value, 0, most, whole=True))
        if not isinstance(value, list) or len(value) != 16:
            raise RestbusError(f"{name} of profile 2 must be a list of 16 numbers, got {value!r}")
        return [int(number(name, each, 0, most, whole=True)) for each in value]

    def _field(self, table: Table, key: str, bits: int) -> Field:
        name, where = table.text(key), f"{table.name}: {key}"
        field = self._fields.named(name, where)
        if field.signal.length != bits:
            raise RestbusError(
                f"{where} of profile {self.number} has {bits} bits, "
                f"{name} has {field.signal.length}"
            )
        if field.unsendable:
            raise RestbusError(f"{where}: {name} cannot be sent: {field.unsendable}")
        return field

    def _nibble(self, table: Table, message: Message) -> Field:
        """Return the signal of the bits 8 to 11 of the data ID, by default beside the counter."""
        if "nibble" in table:
            return self._field(table, "nibble", 4)
        from cantools.database.can import Signal

        field = Field(
            Signal("nibble of the data ID", self.counter.signal.start // 8 * 8 + 4, 4), message
        )
        there = [other for other in self._fields.all if other.mask & field.mask]
        if [other.mask for other in there] == [field.mask]:
            return there[0]
        if there:
            raise RestbusError(
                f"{table.name}: nibble is missing; name the signal of 4 bits that has the high "
                "nibble of the data ID"
            )
        self._fields.add(field)
        return field

    def _crc_byte(self, table: Table) -> int:
        signal = self.crc.signal
        is_motorola = signal.byte_order == "big_endian"
        bit = signal.start % 8
        if bit != (7 if is_motorola else 0):
            raise RestbusError(f"{table.name}: crc must begin with a byte, {signal.name} does not")
        if signal.length > 8 and is_motorola != self.profile.is_motorola:
            order = "Motorola" if self.profile.is_motorola else "Intel"
            raise RestbusError(
                f"{table.name}: crc of profile {self.number} is {order} (@"
                f"{int(not self.profile.is_motorola)}), {signal.name} is not"
            )
        return int(signal.start) // 8
