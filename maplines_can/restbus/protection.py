"""Protection of a message by AUTOSAR E2E: its counter and its checksum, as signals."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..values.errors import RestbusError
from .e2e import DATA_ID_MODES, PROFILES, checksum
from .fields import Field, Fields, Raw
from .tables import Table, number

if TYPE_CHECKING:
    from cantools.database.can import Message


class Protection:
    """Counter and checksum of a message by an AUTOSAR E2E profile; see ``restbus.e2e``.

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
