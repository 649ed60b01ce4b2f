"""History of the records of a slot, by counter."""

from __future__ import annotations

from typing import NamedTuple


class _Entry(NamedTuple):
    """A received record."""

    position: int  #: extended sequence number
    content: int
    is_new: bool  #: accepted when it came
    is_in_sequence: bool  #: new, or late and directly after one that is in sequence
    is_duplicated: bool = False  #: received again since


class RecordHistory:
    """Records of the last counter cycle, to recognise duplicates and late records that fill a gap.

    Each counter has one entry. Its position is the extended (unwrapped) sequence number, so that
    an entry of an earlier counter cycle is not mistaken for one of this cycle.
    """

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._entries: dict[int, _Entry] = {}
        self._newest = 0  # extended sequence number of the last new record

    def add_new(self, counter: int, content: int, ahead: int) -> None:
        """Add a new record, ``ahead`` positions after the last new one."""
        self._newest += ahead
        self._entries[counter] = _Entry(self._newest, content, is_new=True, is_in_sequence=True)

    def add_late(self, counter: int, content: int, behind: int) -> None:
        """Add a record that was not accepted, unless its position is taken."""
        if self._at(counter, behind) is None:
            self._entries[counter] = _Entry(
                self._newest - behind,
                content,
                is_new=False,
                is_in_sequence=self.fills_gap(counter, behind),
            )

    def has_other(self, counter: int, content: int, behind: int) -> bool:
        """Return whether another record came with this counter at this position."""
        entry = self._at(counter, behind)
        return entry is not None and entry.content != content

    def is_duplicate(self, counter: int, content: int, behind: int) -> bool:
        """Return whether the same record came before at this position."""
        entry = self._at(counter, behind)
        return entry is not None and entry.content == content

    def mark_duplicated(self, counter: int, behind: int) -> bool:
        """Mark a record as duplicated; return True the first time a new record is duplicated."""
        entry = self._at(counter, behind)
        if entry is None or not entry.is_new or entry.is_duplicated:
            return False
        self._entries[counter] = entry._replace(is_duplicated=True)
        return True

    def fills_gap(self, counter: int, behind: int) -> bool:
        """Return whether a late record directly follows one in sequence, as in a reordered run."""
        before = self._at((counter - 1) % self._modulus, behind + 1)
        return before is not None and before.is_in_sequence

    def _at(self, counter: int, behind: int) -> _Entry | None:
        entry = self._entries.get(counter)
        return entry if entry and entry.position == self._newest - behind else None
