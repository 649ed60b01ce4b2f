"""Records of the pose error, and records of lines that are conditional on it, as raw values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

from ...values.errors import EncodeError
from ...values.line import Kind, Slot
from ..layout.message_layout import Layout
from ..layout.pose_layout import PoseLayout
from ..layout.record_layout import RecordLayout
from ..layout.signals import (
    FINE_SIGNALS,
    OWN_SIGNALS,
    PARAMETER_SIGNALS,
    POSE_ROWS,
    POSE_SIGNALS,
    SLOT_SIGNALS,
    slot_title,
)
from ..reasons import Reason
from .raw_records import RawRecords

#: Signals that the writers of records fill in.
_FILLED = ("Crc", "Counter", "Kind", "HasCovariance")
LAST_KIND = max(Kind)


@dataclass(frozen=True, slots=True)
class PoseRecord:
    """One record of the pose error.

    Args:
        raw: raw values by signal, of all but page numbers, transfer IDs and counters.
        counter: E2E counter.
        slot_counters: for each slot of the DBC, the counter of the record that belongs to the
            pose, of which the record holds the low bits, or ``absent_counter``.
    """

    raw: Mapping[str, int]
    counter: int
    slot_counters: Mapping[Slot, int]


@dataclass(frozen=True, slots=True)
class ConditionalRecord:
    """One record of a line that is conditional on the pose error.

    Args:
        raw: raw values by signal: mean, fit range, Quartic and ``OWN_SIGNALS``; with the signals
            of the covariance and ``FINE_SIGNALS``, the record has all pages.
        counter: E2E counter.
        kind: kind of the line.
        slot: line slot.
    """

    raw: Mapping[str, int]
    counter: int
    kind: Kind
    slot: Slot


def absent_counter(last: int, following: int, bits: int) -> int:
    """Return the low bits that a pose error states for a slot without a record of its cycle.

    They are as far as possible from the counters of the slot's records of other cycles: those up
    to ``last``, before this cycle, and those from ``following`` on, after it. Between the two are
    the components of a mixture, which belongs to no pose error.

    >>> absent_counter(255, 256, bits=3), absent_counter(7, 11, bits=3)  # a mixture of 3 components
    (4, 1)
    """
    modulus = 2**bits
    both = (last - following) % modulus  # steps ahead of ``following`` and behind ``last``
    if both + modulus <= 2 * (modulus - 1):
        both += modulus
    return (following + (both + 1) // 2) % modulus


class PoseRecords:
    """Writer and reader of records of the pose error."""

    def __init__(self, layout: PoseLayout) -> None:
        self._layout = layout
        self._records = RawRecords(layout)
        self._data_id = layout.messages.data_id
        self._counter_names = {slot: signal.name for slot, signal in layout.counters.items()}
        levels = [f"{slot_title(slot)}{name}" for slot in Slot for name in SLOT_SIGNALS]
        self._names = [
            *(name for name in POSE_SIGNALS if name not in _FILLED),
            *_covariance_names(layout, POSE_ROWS),
            *(name for name in levels if name in layout.signals),
        ]

    def write(self, record: PoseRecord) -> bytes:
        """Return the bytes of a record.

        Raises:
            EncodeError: a raw value or a counter is missing, or out of its range.
        """
        _check_raw(record.raw, self._names, self._layout)
        missing = self._counter_names.keys() - record.slot_counters.keys()
        if missing or record.slot_counters.keys() - self._counter_names.keys():
            raise EncodeError(
                f"slot_counters must be of {_listed(self._counter_names)}, got "
                f"{_listed(record.slot_counters)}"
            )
        counters = {name: record.slot_counters[slot] for slot, name in self._counter_names.items()}
        return self._records.pack_one({**record.raw, **counters}, record.counter, self._data_id)

    def read(self, payload: bytes) -> PoseRecord | Reason:
        """Return the record of its bytes, or the reason why it is rejected."""
        raw = self._records.unpack_one(payload, self._data_id)
        if isinstance(raw, Reason):
            return raw
        return PoseRecord(
            {name: raw[name] for name in self._names},
            raw["Counter"],
            {slot: raw[name] for slot, name in self._counter_names.items()},
        )


class ConditionalRecords:
    """Writer and reader of records of lines that are conditional on the pose error.

    A record with a covariance and a finer mean has all pages, one without has the first
    ``Layout.short_pages``.
    """

    def __init__(self, layout: Layout) -> None:
        self._layout = layout
        self._long, self._short = RawRecords(layout), RawRecords(layout, layout.short_pages)
        self._covariance = [*_covariance_names(layout, PARAMETER_SIGNALS), *FINE_SIGNALS]
        self._own = ("XMin", "XMax", "Quartic", *PARAMETER_SIGNALS, *OWN_SIGNALS)

    def write(self, record: ConditionalRecord) -> bytes:
        """Return the bytes of a record.

        Raises:
            EncodeError: a raw value is missing, or out of its range; a record with a covariance
                has a level too, or the fit range is empty; or the DBC has no such slot.
        """
        messages = self._layout.messages.get(record.slot)
        if messages is None:
            raise EncodeError(f"{self._layout.source} has no message for slot {record.slot!r}")
        has_covariance = not record.raw.keys().isdisjoint(self._covariance)
        names = [*self._own, *(self._covariance if has_covariance else ())]
        _check_raw(record.raw, names, self._layout)
        raw = {**record.raw, "Kind": record.kind, "HasCovariance": int(has_covariance)}
        if (problem := self._problem(raw)) is not None:
            raise EncodeError(problem)
        records = self._long if has_covariance else self._short
        return records.pack_one(raw, record.counter, messages.data_id)

    def read(self, payload: bytes, slot: Slot) -> ConditionalRecord | Reason:
        """Return the record of its bytes, or the reason why it is rejected."""
        is_long = len(payload) == self._long.record_bytes
        records = self._long if is_long else self._short
        raw = records.unpack_one(payload, self._layout.messages[slot].data_id)
        if isinstance(raw, Reason):
            return raw
        has_one_form = self._short.record_bytes == self._long.record_bytes
        if not has_one_form and bool(raw["HasCovariance"]) is not is_long:
            return Reason.LENGTH
        if raw["Kind"] > LAST_KIND or self._problem(raw) is not None:
            return Reason.CONTENT
        names = [*self._own, *(self._covariance if raw["HasCovariance"] else ())]
        values = {name: raw[name] for name in names}
        return ConditionalRecord(values, raw["Counter"], Kind(raw["Kind"]), slot)

    def _problem(self, raw: Mapping[str, int]) -> str | None:
        """Return what is wrong with raw values that are in their ranges; None if nothing is."""
        x_min, x_max = (self._layout[name].physical_one(raw[name]) for name in ("XMin", "XMax"))
        if x_min >= x_max:
            return f"XMin must be less than XMax, got {x_min:g} and {x_max:g} m"
        if raw["HasCovariance"] and any(raw[name] for name in OWN_SIGNALS):
            return f"{', '.join(OWN_SIGNALS)} must be 0 in a record with a covariance"
        return None


def _covariance_names(layout: RecordLayout, rows: Sequence[str]) -> list[str]:
    """Return the signals of the Cholesky code with these rows."""
    pairs = (f"Ratio{row}{column}" for row, column in permutations(rows, 2))
    names = (*(f"Pivot{row}" for row in rows), *pairs, "Inflation")
    return [name for name in names if name in layout.signals]


def _check_raw(raw: Mapping[str, int], names: Sequence[str], layout: RecordLayout) -> None:
    """Check that there is a raw value of each of these signals, and that it is in its range."""
    if raw.keys() != set(names):
        differing = ", ".join(sorted(raw.keys() ^ set(names)))
        raise EncodeError(f"raw must have values of {', '.join(names)}; {differing} differ")
    for name in names:
        signal = layout[name]
        if not signal.raw_min <= raw[name] <= signal.raw_max:
            raise EncodeError(
                f"signal {name}: the raw value {raw[name]} is not from {signal.raw_min} to "
                f"{signal.raw_max}"
            )


def _listed(slots: Iterable[Slot]) -> str:
    return ", ".join(slot.name for slot in sorted(slots)) or "no slot"
