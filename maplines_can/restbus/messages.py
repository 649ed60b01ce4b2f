"""Messages of any DBC: signals over time, packed, with the counter and checksum of their E2E."""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING

from ..logs.j1939 import MOST, pgn_of
from ..values.errors import RestbusError
from ..wire import Frame
from ..wire.layout.slot_messages import FD_LENGTHS, fd_length
from .broadcasts import packets
from .e2e_protection import Protection
from .fields import Field, Fields, Raw
from .signal_values import Value, value_of
from .toml_tables import Table

if TYPE_CHECKING:
    from cantools.database.can import Message

#: Most payloads of a message that are kept, to pack each only once.
MAX_KEPT = 1024
#: Longest cycle, gap and delay [ms].
MAX_MS = 3_600_000.0
#: Longest payload of a classic frame [byte].
CLASSIC = 8
#: Least address that is none of a sender in J1939: the null address.
NULL_ADDRESS = 254


class Rank(IntEnum):
    """Rank of the value of a signal: of signals that share bits, the highest one is sent."""

    UNSET = 0
    START = 1  #: as the DBC states
    PAGE = 2  #: of a multiplexer that nobody sets
    SET = 3  #: by the configuration or a command
    E2E = 4


class DbcMessage:
    """A message that is sent periodically: signals, protection and times.

    Args:
        table: of the configuration.
        message: of the DBC.
        folder: where the files of scripts are.
        address: of the sender in J1939; None if it is no message of J1939.

    Raises:
        RestbusError: the table is wrong, or the message cannot be sent.
    """

    def __init__(
        self, table: Table, message: Message, folder: Path, address: int | None = None
    ) -> None:
        self.name, self.message = message.name, message
        self.notices: list[str] = []  #: what is sent otherwise than the DBC says, or cannot be
        self.is_broadcast = address is not None and message.length > CLASSIC
        self.can_id = message.frame_id if address is None else self._j1939_id(table, address)
        self.is_fd, self.length = self._format(table.name)
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
        self._fields = Fields(message)
        e2e = table.table("e2e")
        self.protection = None if e2e is None else Protection(e2e, message, self._fields)
        self._own = {} if self.protection is None else self.protection.fields
        self._values: dict[Field, Value] = {}
        self._fixed = dict(self._own)  # raw values that never change
        self._read_signals(table, folder)
        table.end()
        self._overrides: dict[Field, Raw] = {}
        self._start: dict[Field, Raw] = {}
        self._ranks: dict[Field, Rank] = {}
        self._find_starts(table.name)
        self._order: list[Field] = []  # in which the signals are placed
        self._sort()
        self._check_shared_bits(table.name)
        self._pages_sent: dict[Field, int] = {}  # of multiplexers whose pages are sent in turn
        self._kept: dict[tuple[Raw, ...], bytes] = {}
        self.sent = 0  #: messages that were made

    @property
    def frames_each(self) -> int:
        """Number of frames of one message that is a broadcast."""
        return len(packets(self.can_id, bytes(self.length)))

    def check(self, signal: str, value: object = None) -> Raw:
        """Return the raw value of a value of a signal.

        Raises:
            RestbusError: there is no such signal, or it cannot have this value.
        """
        name = f"{self.name}.{signal}"
        field = self._fields.named(signal, name)
        if field in self._own:
            raise RestbusError(f"{name} is set by e2e; damage it with a fault instead")
        if value is None:
            return 0
        raw = field.raw(name, value)
        for other, rank in self._ranks.items():
            rank = Rank.SET if other in self._overrides else rank
            if rank > Rank.START and not self._agree(field, raw, other, self._known(other)):
                raise RestbusError(
                    f"{name} has bits of {other.name}, which has another value; reset "
                    f"{other.name}, or leave it out of the configuration"
                )
        return raw

    def set(self, signal: str, value: object) -> None:
        """Set a signal to a value from now on, instead of what the configuration says.

        Raises:
            RestbusError: there is no such signal, or it cannot have this value.
        """
        raw = self.check(signal, value)
        self._overrides[self._fields.named(signal, self.name)] = raw
        self._sort()

    def reset(self, signal: str | None = None) -> None:
        """Let a signal have the values of the configuration again; without one, all of them.

        Raises:
            RestbusError: there is no such signal.
        """
        if signal is None:
            self._overrides.clear()
        else:
            self.check(signal)
            self._overrides.pop(self._fields.named(signal, self.name), None)
        self._sort()

    def frames(self, t: float) -> list[Frame]:
        """Return the frames of the next message, with the values of a time since the start [s].

        It has several if the transport protocol of J1939 sends it.

        Raises:
            RestbusError: a script fails, or returns what the signal cannot have.
        """
        raws, n = dict(self._start), self.sent
        for field, value in self._values.items():
            raws[field] = value(t, n)
        raws |= self._overrides
        counter, protection = 0, self.protection
        if protection is not None:
            counter = n % protection.profile.counters
            raws |= protection.fields | {protection.counter: counter}
        if self._turning:
            self._turn_pages(raws)
        key = tuple(raws.values())
        data = self._kept.get(key)
        if data is None:
            data = self._packed(raws, counter)
            if len(self._kept) >= MAX_KEPT:
                self._kept.clear()
            self._kept[key] = data
        self.sent += 1
        if self.is_broadcast:
            return packets(self.can_id, data)
        return [Frame(self.can_id, data, self.is_fd, self.message.is_extended_frame)]

    # ---- at the start --------------------------------------------------------------

    def _j1939_id(self, table: Table, address: int) -> int:
        """Return the identifier with the priority and the source address of the configuration."""
        stated, most = self.message.frame_id, NULL_ADDRESS - 1
        priority = int(table.number("priority", 0, 7, "", stated >> 26, whole=True))
        if "source_address" in table:
            address = int(table.number("source_address", 0, most, whole=True))
        if address > most:
            self.notices.append(
                f"the DBC has no address of the sender; {address} is sent, set source_address"
            )
        if self.is_broadcast and pgn_of(stated) >> 8 & 0xFF < 240 and stated >> 8 & 0xFF != 0xFF:
            raise RestbusError(
                f"{table.name}: has {self.message.length} bytes for one address, for which J1939 "
                "needs the answers of its receiver, and they are not read here; leave it out"
            )
        return priority << 26 | stated & 0x3FFFF00 | address

    def _format(self, where: str) -> tuple[bool, int]:
        """Return whether the frame is of CAN FD, and the length of the payload [byte]."""
        message, size = self.message, self.message.length
        most = MOST if self.is_broadcast else FD_LENGTHS[-1]
        if size > most:
            raise RestbusError(
                f"{where}: has {size} bytes, and {most} can be sent at most; correct the DBC, or "
                "leave it out"
            )
        if self.is_broadcast:
            return False, size
        is_fd, length = message.is_fd or size > CLASSIC, fd_length(size)
        if is_fd > message.is_fd:
            self.notices.append("sent as CAN FD for its length, not for its VFrameFormat")
        if length > size:
            self.notices.append(f"no frame has {size} bytes; {length} are sent, the last ones 0")
        return is_fd, length

    def _read_signals(self, table: Table, folder: Path) -> None:
        described = table.take("signals", {})
        if not isinstance(described, Mapping):
            raise RestbusError(f"{table.name}: signals must be a table, got {described!r}")
        for key, values in described.items():
            where = f"{table.name}: {key}"
            field = self._fields.named(key, where)
            if field in self._own:
                raise RestbusError(f"{where} is set by e2e; leave it out of the signals")
            self._values[field] = value_of(where, values, field, folder)
            if not isinstance(values, list | dict):
                self._fixed[field] = self._values[field](0.0, 0)

    def _find_starts(self, where: str) -> None:
        """Find the start values, and the ranks that signals have before any command."""
        self._turning: set[Field] = set()
        for field in self._fields.all:
            rank, start = Rank.UNSET, None
            if field in self._own:
                rank = Rank.E2E
            elif field in self._values:
                rank = Rank.SET
            elif not field.unsendable:
                start = field.stated(f"{where}: {field.name}")
                rank = Rank.UNSET if start is None else Rank.START
            if field.pages and rank < Rank.SET:
                rank = Rank.PAGE
                if start not in field.pages:
                    start = field.turns[0]
                    self._turning.add(field)
            self._start[field] = field.unset if start is None else start
            self._ranks[field] = rank
        left_out = [field for field in self._fields.all if field.unsendable]
        if left_out:
            names = ", ".join(field.name for field in left_out)
            self.notices.append(f"sent without {names}: {left_out[0].unsendable}")

    def _check_shared_bits(self, where: str) -> None:
        """Check that signals with common bits agree in them, if a user or the DBC sets them."""
        ranked = [field for field, rank in self._ranks.items() if rank > Rank.UNSET]
        disputed = []
        for one, other in combinations(ranked, 2):
            if self._agree(one, self._known(one), other, self._known(other)):
                continue
            low, high = sorted((other, one), key=self._ranks.__getitem__)
            if self._ranks[low] >= Rank.PAGE and self._ranks[high] >= Rank.SET:
                raise RestbusError(
                    f"{where}: {one.name} and {other.name} have common bits, in which their "
                    "values differ; leave one of them out"
                )
            if self._ranks[high] <= Rank.PAGE:
                disputed.append(f"{high.name} before {low.name}")
        if disputed:
            pairs = ", ".join(disputed)
            self.notices.append(f"start values differ in common bits, in which are sent: {pairs}")

    # ---- at each message -----------------------------------------------------------

    def _sort(self) -> None:
        """Order the signals so that of those with common bits the highest rank is placed last."""
        ranks = self._ranks | dict.fromkeys(self._overrides, Rank.SET)
        self._order = self._fields.all[::-1]  # of one rank, the first of the DBC wins
        self._order.sort(key=ranks.__getitem__)
        self._kept = {}

    def _known(self, field: Field) -> Raw | None:
        """Return the raw value that a signal has in each message; None if it changes."""
        if field in self._overrides or field in self._fixed:
            return self._overrides.get(field, self._fixed.get(field))
        changes = field in self._values or field in self._turning
        return None if changes else self._start[field]

    def _agree(self, one: Field, raw: Raw | None, other: Field, its: Raw | None) -> bool:
        """Return whether two signals have the same values in all bits that they share."""
        shared = self._fields.shared(one, other)
        if not shared:
            return True
        if raw is None or its is None:
            return False
        return not (one.place(0, raw) ^ other.place(0, its)) & shared

    def _turn_pages(self, raws: dict[Field, Raw]) -> None:
        """Let each multiplexer that nobody sets take its next page, on the pages of the others."""
        for field in self._fields.present(raws):
            if field in self._turning and field not in self._overrides:
                n = self._pages_sent.get(field, 0)
                raws[field] = field.turns[n % len(field.turns)]
                self._pages_sent[field] = n + 1

    def _packed(self, raws: Mapping[Field, Raw], counter: int) -> bytes:
        present, payload = set(self._fields.present(raws)), 0
        for field in self._order:
            if field in present:
                payload = field.place(payload, raws[field])
        data = payload.to_bytes(self.message.length, "little")
        if self.protection is not None:
            data = self.protection.protected(data, counter)
        return data.ljust(self.length, b"\0")
