"""Messages of any DBC: signals over time, packed, with the counter and checksum of their E2E."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from cantools.database.can import Message, Signal

from ..values.errors import RestbusError
from ..wire import Frame
from .e2e import DATA_ID_MODES, PROFILES, checksum
from .signals import Value, fixed, initial, value_of
from .tables import Table, nearest, number

#: Most payloads of a message that are kept, to pack each only once.
MAX_KEPT = 1024
#: Longest cycle, gap and delay [ms].
MAX_MS = 3_600_000.0


class Protection:
    """Counter and checksum of a message by an AUTOSAR E2E profile; see ``restbus.e2e``.

    Raises:
        RestbusError: the table is wrong, or a signal does not fit the profile.
    """

    def __init__(self, table: Table, message: Message) -> None:
        self.number = str(table.take("profile", ""))
        if self.number not in PROFILES:
            known = ", ".join(PROFILES)
            raise RestbusError(f"{table.name}: profile must be one of {known}, got {self.number!r}")
        profile = PROFILES[self.number]
        self.profile = profile
        self.mode = table.choice("data_id_mode", DATA_ID_MODES, "both")
        self.data_id = self._data_id(table)
        self.counter = self._signal(table, "counter", message, profile.counter_bits)
        self.crc = self._signal(table, "crc", message, profile.crc_bits)
        table.end()
        if self.counter == self.crc:
            raise RestbusError(f"{table.name}: counter and crc are the same signal {self.crc!r}")
        self.first = self._crc_byte(table, message)
        self.last = self.first + profile.crc_bits // 8

    def protected(self, payload: bytes, counter: int) -> bytes:
        """Return a payload with its checksum; it has the counter already."""
        rest = payload[: self.first] + payload[self.last :]
        crc = checksum(self.number, rest, self.data_id, self.mode, counter)
        order = "big" if self.profile.is_motorola else "little"
        size = self.last - self.first
        return payload[: self.first] + crc.to_bytes(size, order) + payload[self.last :]  # type: ignore[arg-type]

    def _data_id(self, table: Table) -> int | list[int]:
        value, most = table.take("data_id"), 2**self.profile.data_id_bits - 1
        name = f"{table.name}: data_id"
        if self.number != "2":
            return int(number(name, value, 0, most, whole=True))
        if not isinstance(value, list) or len(value) != 16:
            raise RestbusError(f"{name} of profile 2 must be a list of 16 numbers, got {value!r}")
        return [int(number(name, each, 0, most, whole=True)) for each in value]

    def _signal(self, table: Table, key: str, message: Message, bits: int) -> str:
        name = table.text(key)
        signal = signal_of(message, name, f"{table.name}: {key}")
        if signal.length != bits:
            raise RestbusError(
                f"{table.name}: {key} of profile {self.number} has {bits} bits, "
                f"{name} has {signal.length}"
            )
        return name

    def _crc_byte(self, table: Table, message: Message) -> int:
        signal = message.get_signal_by_name(self.crc)
        is_motorola = signal.byte_order == "big_endian"
        bit = signal.start % 8
        if bit != (7 if is_motorola else 0):
            raise RestbusError(f"{table.name}: crc must begin with a byte, {self.crc} does not")
        if signal.length > 8 and is_motorola != self.profile.is_motorola:
            order = "Motorola" if self.profile.is_motorola else "Intel"
            raise RestbusError(
                f"{table.name}: crc of profile {self.number} is {order} (@"
                f"{int(not self.profile.is_motorola)}), {self.crc} is not"
            )
        return int(signal.start) // 8


class DbcMessage:
    """A message that is sent periodically: signals, protection and times.

    Args:
        table: of the configuration.
        message: of the DBC.
        folder: where the files of scripts are.

    Raises:
        RestbusError: the table is wrong.
    """

    def __init__(self, table: Table, message: Message, folder: Path) -> None:
        name = message.name
        self.name, self.message = name, message
        default = message.cycle_time or None
        self.cycle_ms = table.number("cycle_ms", 0.1, MAX_MS, "ms", default)
        self.start_ms = table.number("start_ms", 0.0, MAX_MS, "ms", 0.0)
        self.count = int(table.number("count", 1, 1000, "frames", 1, whole=True))
        gap = 0.0 if self.count == 1 else None
        self.gap_ms = table.number("gap_ms", 0.0, MAX_MS, "ms", gap)
        if self.gap_ms * (self.count - 1) >= self.cycle_ms:
            most = self.cycle_ms / (self.count - 1)
            raise RestbusError(
                f"{table.name}: gap_ms must be less than {most:g} ms, so that {self.count} frames "
                f"fit into a cycle of {self.cycle_ms:g} ms, got {self.gap_ms:g} ms"
            )
        self.is_on = table.flag("on", default=True)
        e2e = table.table("e2e")
        self.protection = None if e2e is None else Protection(e2e, message)
        self._signals = {signal.name: signal for signal in message.signals}
        self._values: dict[str, Value] = {}
        own = {} if self.protection is None else {self.protection.counter, self.protection.crc}
        described = table.take("signals", {})
        if not isinstance(described, Mapping):
            raise RestbusError(f"{table.name}: signals must be a table, got {described!r}")
        for key, values in described.items():
            where = f"{table.name}: {key}"
            signal = signal_of(message, key, where)
            if key in own:
                raise RestbusError(f"{where} is set by e2e; leave it out of the signals")
            self._values[key] = value_of(where, values, signal, folder)
        table.end()
        self._initial = {name: initial(signal) for name, signal in self._signals.items()}
        self._overrides: dict[str, float] = {}
        self._kept: dict[tuple[float, ...], bytes] = {}
        self.sent = 0  #: frames that were made

    def check(self, signal: str, value: object = None) -> float:
        """Return the number of a value of a signal.

        Raises:
            RestbusError: there is no such signal, or it cannot have this value.
        """
        name = f"{self.name}.{signal}"
        found = signal_of(self.message, signal, name)
        if self.protection and signal in (self.protection.counter, self.protection.crc):
            raise RestbusError(f"{name} is set by e2e; damage it with a fault instead")
        return 0.0 if value is None else fixed(name, value, found)

    def set(self, signal: str, value: object) -> None:
        """Set a signal to a value from now on, instead of what the configuration says.

        Raises:
            RestbusError: there is no such signal, or it cannot have this value.
        """
        self._overrides[signal] = self.check(signal, value)

    def reset(self, signal: str) -> None:
        """Let a signal have the values of the configuration again.

        Raises:
            RestbusError: there is no such signal.
        """
        self.check(signal)
        self._overrides.pop(signal, None)

    def frame(self, t: float) -> Frame:
        """Return the next frame, with the values of a time since the start [s].

        Raises:
            RestbusError: a script fails, or returns what the signal cannot have.
        """
        values, n = dict(self._initial), self.sent
        for name, value in self._values.items():
            values[name] = value(t, n)
        values |= self._overrides
        counter, protection = 0, self.protection
        if protection is not None:
            counter = n % protection.profile.counters
            values[protection.counter] = counter
            values[protection.crc] = 0
        key = tuple(values.values())
        data = self._kept.get(key)
        if data is None:
            data = self._packed(values, counter)
            if len(self._kept) >= MAX_KEPT:
                self._kept.clear()
            self._kept[key] = data
        self.sent += 1
        message = self.message
        return Frame(message.frame_id, data, message.is_fd, message.is_extended_frame)

    def _packed(self, values: Mapping[str, float], counter: int) -> bytes:
        protection, raw = self.protection, dict(values)
        if protection is not None:  # raw values, whatever their scale
            for name, number_ in ((protection.counter, counter), (protection.crc, 0)):
                signal = self._signals[name]
                raw[name] = signal.offset + number_ * signal.scale
        try:
            data = self.message.encode(raw, strict=False)
        except Exception as error:
            raise RestbusError(f"{self.name} cannot be packed: {error}") from error
        return bytes(data) if protection is None else protection.protected(bytes(data), counter)


def signal_of(message: Message, name: str, where: str) -> Signal:
    """Return a signal of a message by its name."""
    for signal in message.signals:
        if signal.name == name:
            return signal
    hint = nearest(name, [signal.name for signal in message.signals], "its signals are")
    raise RestbusError(f"{where}: {message.name} has no signal {name!r}{hint}")
