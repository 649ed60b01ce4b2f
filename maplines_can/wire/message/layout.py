"""From a DBC to the layout of a record: the only place that knows what a DBC is."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any

import cantools
import numpy as np
from cantools.database.can import Database, Message
from cantools.database.can import Signal as DbcSignal
from numpy.typing import NDArray

from ...errors import LayoutError
from ...line import Slot
from .channel import Channel, SecuredForm
from .signals import Signal

__all__ = [
    "PAGE_BYTES",
    "STATE_SIGNALS",
    "Layout",
    "default_dbc_path",
    "fd_length",
]

#: A page is one classic CAN frame.
PAGE_BYTES = 8
#: Most bytes of a DBC; those of whole cars have a few million.
LARGEST_DBC = 64_000_000
#: Longer than an hour neither a transfer nor a cycle takes [ms].
LONGEST_MS = 3_600_000
#: Signals that each page carries: which page of which transfer it is.
PAGE, TRANSFER_ID = "Page", "TransferId"
#: DBC signals of the mean, in the order of the states.
STATE_SIGNALS = ("YOff", "Beta", "C0", "C1")
#: What a record holds besides its pages' numbers, the mean and the covariance.
SERVICE_SIGNALS = (
    *("Crc", "Counter", "Status", "Kind", "XMin", "XMax", "Age"),
    *("ComponentIndex", "ComponentCount", "ComponentWeight"),
)
#: What an authenticated message ends with, in this order, and the most bytes of each.
SECURED_SIGNALS = {"KeyId": 1, "Freshness": 7, "Mac": 8}


@dataclass(frozen=True, eq=False)
class Layout:
    """The record of a map line and the channels that carry it, as a DBC describes them.

    A record is the pages of a multiplexed classic message laid end to end, and
    the payload of one CAN FD message. Signals that each page repeats appear as
    ``Page0``, ``TransferId0``, ``Page1``, ...; where the DBC has no transfer number in the
    first page, it is the low bits of ``Counter`` there.

    Args:
        signals: by name, in the order of the DBC.
        pages: number of pages.
        channels: by slot.
        covariance_code: which code the covariance is written in.
        source: the file.
        secured: the bytes of the authenticated messages; None where there are none.
    """

    signals: Mapping[str, Signal]
    pages: int
    channels: Mapping[Slot, Channel]
    covariance_code: str
    source: str
    secured: SecuredForm | None = None

    @property
    def record_bytes(self) -> int:
        """Length of a record."""
        return self.pages * PAGE_BYTES

    def __post_init__(self) -> None:
        for name in SERVICE_SIGNALS:
            self[name]
        crc = self["Crc"]
        if crc.length != 16 or crc.start % 8 or crc.big_endian:
            raise LayoutError(f"{self.source}: Crc must be 16 bits, Intel, on a byte boundary")
        if self["Counter"].length < self[f"{TRANSFER_ID}0"].length:
            raise LayoutError(f"{self.source}: Counter must be as wide as Transfer or wider")

    @cached_property
    def resolution(self) -> NDArray[np.float64]:
        """(4,) variances of the mean's own rounding, factor^2 / 12, in SI units squared."""
        return np.array([self[name].factor ** 2 / 12 for name in STATE_SIGNALS])

    @property
    def crc_offset(self) -> int:
        """First byte of the checksum within the record."""
        return self["Crc"].start // 8

    @cached_property
    def page_of_id(self) -> dict[tuple[int, bool], tuple[Slot, bool]]:
        """(CAN ID, extended) to (slot, whether the message holds the whole record)."""
        ids = {}
        for channel in self.channels.values():
            if channel.can_id is not None:
                ids[channel.can_id, channel.is_extended] = (channel.slot, False)
            if channel.fd_can_id is not None:
                ids[channel.fd_can_id, channel.fd_is_extended] = (channel.slot, True)
            if channel.secured_can_id is not None:
                ids[channel.secured_can_id, channel.secured_is_extended] = (channel.slot, True)
        return ids

    @cached_property
    def data_id_of_secured(self) -> dict[tuple[int, bool], int]:
        """(CAN ID, extended) of each authenticated message to its SecOC data ID."""
        return {
            (channel.secured_can_id, channel.secured_is_extended): channel.secured_data_id
            for channel in self.channels.values()
            if channel.secured_can_id is not None
        }

    def __getitem__(self, name: str) -> Signal:
        try:
            return self.signals[name]
        except KeyError:
            raise LayoutError(
                f"{self.source}: there is no signal {name!r}; a map line needs it in each message"
            ) from None

    @classmethod
    def from_dbc(cls, path: str | Path | None = None) -> Layout:
        """Read a layout; without a path, the project's own ``maplines.dbc``.

        Raises:
            LayoutError: the file is missing, is larger than 64 MB, is not a DBC, or describes
                no map line.
        """
        path = default_dbc_path() if path is None else Path(path)
        try:
            with path.open("rb") as file:  # a pipe or device may never end
                data = file.read(LARGEST_DBC + 1)
        except OSError as error:
            raise LayoutError(f"{path}: cannot be read: {error.strerror or error}") from error
        if len(data) > LARGEST_DBC:
            raise LayoutError(
                f"{path}: is too large: a DBC must have {LARGEST_DBC:,} bytes at most"
            )
        try:
            text = data.decode("cp1252")  # what DBC tools write
        except UnicodeDecodeError as error:
            raise LayoutError(f"{path}: is not a valid DBC: {error}") from error
        return cls.from_text(text, str(path))

    @classmethod
    def from_text(cls, text: str, source: str = "DBC") -> Layout:
        """Read a layout from the text of a DBC.

        Args:
            text: as in the file.
            source: what errors call it.

        Raises:
            LayoutError: the text is not a DBC, or describes no map line.
        """
        if huge := _LONG.search(text) or _HUGE.search(_SAID.sub(" ", text)):
            raise LayoutError(
                f"{source}: is not a valid DBC: a place, length or range has too many digits: "
                f"{' '.join(huge[0].split())}"
            )
        try:
            database = cantools.database.load_string(text, database_format="dbc", strict=True)
        except Exception as error:  # the parser raises many kinds, and all mean this
            reason = " ".join(str(error).split()) or type(error).__name__
            raise LayoutError(f"{source}: is not a valid DBC: {reason}") from error
        if not isinstance(database, Database):
            raise LayoutError(f"{source}: is not a DBC of CAN messages")
        return _layout(database, source)


#: Exponents that take cantools for ever where it wants whole numbers, also within quotes.
_LONG = re.compile(r"(?<![\w.])\d[\d.]*[eE]\+?\d{4}")
#: What a DBC says to people: texts and remarks, by cantools' tokens.
_SAID = re.compile(r'"(?:\\"|[^"])*?"|//.*?\n', re.DOTALL)
#: Messages of 5 digits, places and lengths of signals and ranges of multiplexers of 6 digits and
#: more, where cantools makes lists as long as these numbers say; no bus has them.
_HUGE = re.compile(
    r":\s*[+-]?\d{5,}\s*\w|:[\s\d|+-]*\d{6}"
    r"|SG_MUL_VAL_\b\s*[+-]?\d++\s*+\w++\s++\w++[\s\d,+-]*\d{6}"
)


def default_dbc_path(name: str = "maplines.dbc") -> Path:
    """Where a DBC of the project is: inside an installed package, else in the checkout.

    Raises:
        LayoutError: in neither place.
    """
    packaged = resources.files(__package__.partition(".")[0]) / "dbc" / name
    checkout = Path(__file__).parents[3] / "dbc" / name
    for path in (Path(str(packaged)), checkout):
        if path.is_file():
            return path
    raise LayoutError(f"{name} is neither at {packaged} nor at {checkout}; reinstall")


def fd_length(length: int) -> int:
    """The least CAN FD payload length that holds ``length`` bytes (ISO 11898-1).

    >>> fd_length(24), fd_length(25)
    (24, 32)
    """
    return next(n for n in (*range(9), 12, 16, 20, 24, 32, 48, 64) if n >= length)


class Carrier(Enum):
    """Which message of a slot."""

    CLASSIC, FD, SECURED = range(3)


def _layout(database: Database, source: str) -> Layout:
    records: dict[str, dict[str, Signal]] = {}
    found: dict[Slot, dict[Carrier, Message]] = {}
    forms: dict[str, SecuredForm] = {}
    for message in database.messages:
        attributes = message.dbc.attributes if message.dbc else {}
        if "MapLineSlot" not in attributes:
            continue
        where = f"{source}: message {message.name}: MapLineSlot"
        slot = Slot(_whole(attributes["MapLineSlot"].value, where, len(Slot) - 1))
        carrier = Carrier.FD if message.is_fd else Carrier.CLASSIC
        if "SecOCDataId" in attributes:
            carrier, forms[message.name] = Carrier.SECURED, _secured_form(message, source)
        if found.setdefault(slot, {}).setdefault(carrier, message) is not message:
            raise LayoutError(f"{source}: slot {slot.name} has two messages of the same carrier")
        records[message.name] = _record(message, source)
    if not records:
        raise LayoutError(
            f"{source}: no message has the attribute MapLineSlot, so none carries a map line"
        )
    (first, fields), *others = records.items()
    for name, other in others:
        if other != fields:
            differing = sorted({f for f in {*fields, *other} if fields.get(f) != other.get(f)})
            raise LayoutError(
                f"{source}: messages {first} and {name} must hold the same signals at the same "
                f"places, but {', '.join(differing)} differ"
            )
    if len(set(forms.values())) > 1:
        raise LayoutError(f"{source}: messages {', '.join(forms)} must have the same lengths")
    code = database.dbc.attributes.get("CovarianceCode") if database.dbc else None
    return Layout(
        signals=fields,
        pages=sum(name.startswith(PAGE) for name in fields),
        channels={slot: _channel(slot, found[slot], source) for slot in sorted(found)},
        covariance_code="Cholesky" if code is None else str(code.value),
        source=source,
        secured=next(iter(forms.values()), None),
    )


def _secured_form(message: Message, source: str) -> SecuredForm:
    """Lengths of the freshness value and the MAC, which must lie where AUTOSAR has them."""
    where = f"{source}: message {message.name}"
    signals = {signal.name: signal for signal in message.signals}
    end, sizes = message.length, {}
    for name, most in reversed(SECURED_SIGNALS.items()):
        signal = signals.get(name)
        size, odd_bits = divmod(signal.length if signal else 0, 8)
        end -= size
        motorola = signal is not None and signal.byte_order == "big_endian"
        if (
            signal is None
            or odd_bits
            or not 1 <= size <= most
            or signal.start != 8 * end + (7 if motorola else 0)
            or not (motorola or size == 1)
        ):
            raise LayoutError(
                f"{where}: must end with {', '.join(SECURED_SIGNALS)}, Motorola, of whole bytes; "
                f"{name} has 1 to {most} bytes"
            )
        sizes[name] = size
    if not message.is_fd or message.length != fd_length(message.length):
        raise LayoutError(f"{where}: must be a CAN FD message, of a length that CAN FD has")
    return SecuredForm(message.length, sizes["Freshness"], sizes["Mac"])


def _channel(slot: Slot, carriers: dict[Carrier, Message], source: str) -> Channel:
    classic, fd, secured = (carriers.get(carrier) for carrier in Carrier)
    data_ids: set[Any] = set()
    for message in carriers.values():
        attributes = message.dbc.attributes if message.dbc else {}
        data_ids.add(attributes["E2EDataId"].value if "E2EDataId" in attributes else None)
    data_id = data_ids.pop()
    if data_ids or data_id is None:
        raise LayoutError(
            f"{source}: slot {slot.name}: its messages need the same attribute E2EDataId"
        )
    message = next(m for m in (classic, fd, secured) if m is not None)
    where = f"{source}: message {message.name}"
    return Channel(
        slot=slot,
        name=message.name,
        can_id=classic.frame_id if classic else None,
        fd_can_id=fd.frame_id if fd else None,
        is_extended=bool(classic and classic.is_extended_frame),
        fd_is_extended=bool(fd and fd.is_extended_frame),
        fd_length=fd_length(fd.length) if fd else 0,
        data_id=_whole(data_id, f"{where}: E2EDataId", 0xFFFF),
        cycle_ms=_whole(message.cycle_time or 0, f"{where}: GenMsgCycleTime", LONGEST_MS),
        secured_can_id=secured.frame_id if secured else None,
        secured_is_extended=bool(secured and secured.is_extended_frame),
        secured_data_id=_secured_data_id(secured, source) if secured else 0,
    )


def _secured_data_id(message: Message, source: str) -> int:
    value = message.dbc.attributes["SecOCDataId"].value if message.dbc else -1
    return _whole(value, f"{source}: message {message.name}: SecOCDataId", 0xFFFF)


def _whole(value: Any, what: str, most: int) -> int:
    """The value of an attribute, whatever it is, as a whole number up to ``most``."""
    try:
        number = int(value)
    except (ValueError, TypeError, OverflowError):
        number = -1
    if not 0 <= number <= most:
        raise LayoutError(f"{what} must be a whole number from 0 to {most}, got {value!r}")
    return number


def _record(message: Message, source: str) -> dict[str, Signal]:
    """Fields of a message at their places in the record, the same for all carriers."""
    where = f"{source}: message {message.name}"
    multiplexers = [signal for signal in message.signals if signal.is_multiplexer]
    if not multiplexers:
        own = [signal for signal in message.signals if signal.name not in SECURED_SIGNALS]
        fields = [_field(signal, where) for signal in own]
    else:
        if len(multiplexers) > 1 or multiplexers[0].name != PAGE:
            raise LayoutError(f"{where}: must have one multiplexer, named {PAGE}")
        if message.length != PAGE_BYTES:
            raise LayoutError(f"{where}: a page must have 8 bytes, got {message.length}")
        ids = sorted({i for s in message.signals for i in s.multiplexer_ids or ()})
        if ids != list(range(len(ids))):
            raise LayoutError(f"{where}: pages must be numbered 0, 1, ..., got {ids}")
        fields = []
        for signal in message.signals:
            field = _field(signal, where)
            if signal.multiplexer_ids is None:  # in each page
                for page in ids:
                    start = field.start + 8 * PAGE_BYTES * page
                    fields.append(replace(field, name=f"{field.name}{page}", start=start))
            elif len(signal.multiplexer_ids) == 1:
                start = field.start + 8 * PAGE_BYTES * signal.multiplexer_ids[0]
                fields.append(replace(field, start=start))
            else:
                raise LayoutError(f"{where}: signal {signal.name} must be in one page or in all")
    record = {field.name: field for field in sorted(fields, key=lambda field: field.start)}
    if f"{TRANSFER_ID}0" not in record and {"Counter", f"{TRANSFER_ID}1"} <= set(record):
        record[f"{TRANSFER_ID}0"] = _low_bits(
            record["Counter"], f"{TRANSFER_ID}0", record[f"{TRANSFER_ID}1"].length
        )
    pages = sum(name.startswith(PAGE) for name in record)
    for page in range(pages):
        for name in (f"{PAGE}{page}", f"{TRANSFER_ID}{page}"):
            if name not in record:
                raise LayoutError(f"{where}: signal {name} is missing")
    for field in record.values():
        if field.start >= 8 * PAGE_BYTES * pages:
            raise LayoutError(f"{where}: signal {field.name} lies beyond the {pages} pages")
    if not pages or (not multiplexers and message.length < pages * PAGE_BYTES):
        raise LayoutError(
            f"{where}: must have pages of 8 bytes, each with {PAGE} and {TRANSFER_ID}"
        )
    return record


def _low_bits(field: Signal, name: str, length: int) -> Signal:
    """The low bits of an unsigned field, as a field."""
    start = field.start
    if field.big_endian:  # numbered downwards within a byte, upwards from byte to byte
        place = start // 8 * 8 + 7 - start % 8 + field.length - length
        start = place // 8 * 8 + 7 - place % 8
    return replace(field, name=name, start=start, length=length, raw_min=0, raw_max=2**length - 1)


def _field(signal: DbcSignal, where: str) -> Signal:
    numbers = (signal.scale, signal.offset, signal.minimum, signal.maximum)
    if not all(number is None or abs(number) < 1e300 for number in numbers):  # a NaN neither
        raise LayoutError(f"{where}: signal {signal.name} needs a finite factor, offset and range")
    factor, offset = float(signal.scale), float(signal.offset)
    if signal.is_float and (signal.length, factor, offset) != (32, 1, 0):
        raise LayoutError(
            f"{where}: signal {signal.name} is a float; it needs 32 bits, factor 1 and offset 0, "
            "or an integer type"
        )
    low, high = (-(2 ** (signal.length - 1)), 2 ** (signal.length - 1) - 1)
    signed = signal.is_signed and not signal.is_float
    if not signed:
        low, high = 0, 2**signal.length - 1
    if signal.length > (64 if signed else 63):
        raise LayoutError(f"{where}: signal {signal.name} has more than 63 bits; make it narrower")
    if not factor:
        raise LayoutError(f"{where}: signal {signal.name} needs a finite factor other than 0")
    bounds = sorted(
        (bound - offset) / factor for bound in (signal.minimum, signal.maximum) if bound is not None
    )
    if len(bounds) == 2 and not signal.is_float:  # the DBC's range, where it is the narrower
        bounds = np.clip(bounds, -(2.0**65), 2.0**65).tolist()  # beyond all raw values
        slack = 1e-6  # a bound printed in decimals still admits the raw value that it means
        low = max(low, int(np.ceil(bounds[0] - slack)))
        high = max(low, min(high, int(np.floor(bounds[1] + slack))))
    return Signal(
        name=signal.name,
        start=signal.start,
        length=signal.length,
        big_endian=signal.byte_order == "big_endian",
        signed=signed,
        factor=factor,
        offset=offset,
        unit=signal.unit or "",
        raw_min=low,
        raw_max=high,
        is_float=bool(signal.is_float),
    )
