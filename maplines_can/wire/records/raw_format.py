"""Formats of records that are raw values: of the pose error, and of lines conditional on it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import permutations

from ...values.errors import EncodeError
from ...values.line import Kind, Slot
from ..layout.message_layout import Layout
from ..layout.pose_layout import POSE, Owner, PoseLayout
from ..layout.record_layout import RecordLayout
from ..layout.signals import (
    FINE_SIGNALS,
    OWN_SIGNALS,
    PARAMETER_SIGNALS,
    POSE_ROWS,
    POSE_SIGNALS,
    SLOT_SIGNALS,
    SignalRow,
    slot_title,
)
from .packer import RecordPacker
from .record import RawRecord

LAST_KIND = max(Kind)


class RawFormat:
    """Format of records that are raw values.

    Args:
        layout: of the records.
        data_ids: E2E data ID by owner.
        names: signals that all records have a value of.
        covariance: signals that a record has in addition if ``HasCovariance`` is 1.
    """

    def __init__(
        self,
        layout: Layout | PoseLayout,
        data_ids: Mapping[Owner, int],
        names: Sequence[str],
        covariance: Sequence[str] = (),
    ) -> None:
        self.layout, self.packer = layout, RecordPacker(layout)
        self.data_ids = data_ids
        self._names, self._all_names = tuple(names), (*names, *covariance)
        self._covariance = frozenset(covariance)
        self._range = SignalRow(layout[name] for name in ("XMin", "XMax") if name in names)

    @classmethod
    def of_pose(cls, layout: PoseLayout) -> RawFormat:
        """Return the format of the records of the pose error."""
        levels = [f"{slot_title(slot)}{name}" for slot in Slot for name in SLOT_SIGNALS]
        names = [
            *(name for name in POSE_SIGNALS if name not in ("Crc", "Counter")),
            *_covariance_names(layout, POSE_ROWS),
            *(name for name in levels if name in layout.signals),
            *(signal.name for signal in layout.counters.values()),
        ]
        return cls(layout, {POSE: layout.messages.data_id}, names)

    @classmethod
    def of_lines(cls, layout: Layout) -> RawFormat:
        """Return the format of the records of lines that are conditional on the pose error.

        A record with a covariance and a finer mean has all pages, one without has the first
        ``Layout.short_pages``.
        """
        data_ids: dict[Owner, int] = {s: own.data_id for s, own in layout.messages.items()}
        names = ("Kind", "XMin", "XMax", "Quartic", *PARAMETER_SIGNALS, *OWN_SIGNALS)
        covariance = (*_covariance_names(layout, PARAMETER_SIGNALS), *FINE_SIGNALS)
        return cls(layout, data_ids, names, covariance)

    def write(self, record: RawRecord) -> bytes:
        """Return the bytes of a record.

        Raises:
            EncodeError: a raw value is missing, or out of its range; a record with a covariance
                has a level too, or the fit range is empty; or the DBC has no such owner.
        """
        data_id = self.data_ids.get(record.owner)
        if data_id is None:
            raise EncodeError(f"{self.layout.source} has no message for slot {record.owner!r}")
        has_covariance = not self._covariance.isdisjoint(record.raw)
        self._check(record.raw, self._all_names if has_covariance else self._names)
        raw = {**record.raw, "Counter": record.counter}
        if self._covariance:
            raw["HasCovariance"] = int(has_covariance)
        if (problem := self._problem(raw)) is not None:
            raise EncodeError(problem)
        return self.packer.pack_one(raw, data_id)

    def _problem(self, raw: Mapping[str, int]) -> str | None:
        """Return what is wrong with raw values of a line; None if nothing is."""
        if not self._covariance:
            return None
        if raw["Kind"] > LAST_KIND:
            return f"Kind must be at most {LAST_KIND}, got {raw['Kind']}"
        x_min, x_max = self._range.physical_one(raw)
        if x_min >= x_max:
            return f"XMin must be less than XMax, got {x_min:g} and {x_max:g} m"
        if raw["HasCovariance"] and any(raw[name] for name in OWN_SIGNALS):
            return f"{', '.join(OWN_SIGNALS)} must be 0 in a record with a covariance"
        return None

    def _check(self, raw: Mapping[str, int], names: Sequence[str]) -> None:
        """Check that there is a raw value of each of these signals, and that it is in its range."""
        if raw.keys() != set(names):
            differing = ", ".join(sorted(raw.keys() ^ set(names)))
            raise EncodeError(f"raw must have values of {', '.join(names)}; {differing} differ")
        for name in names:
            signal = self.layout.signals[name]
            if not signal.raw_min <= raw[name] <= signal.raw_max:
                raise EncodeError(
                    f"signal {name}: the raw value {raw[name]} is not from {signal.raw_min} to "
                    f"{signal.raw_max}"
                )


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


def _covariance_names(layout: RecordLayout, rows: Sequence[str]) -> list[str]:
    """Return the signals of the Cholesky code with these rows."""
    pairs = (f"Ratio{row}{column}" for row, column in permutations(rows, 2))
    names = (*(f"Pivot{row}" for row in rows), *pairs, "Inflation")
    return [name for name in names if name in layout.signals]
