"""Records of a layout by their owners: one reader, and formats that say what the values mean.

There are three formats. A complete record is a line with a covariance of its own, or a component
of its mixture. A record that is conditional on the pose error, and that of the pose error itself,
are raw values, since only both together make a line.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

from ...values.line import MapLine, Slot
from ..layout.pose_layout import Owner
from ..reasons import Reason
from .packer import RecordPacker

#: Content of a record.
Content = TypeVar("Content")
Content_co = TypeVar("Content_co", covariant=True)


@dataclass(frozen=True, slots=True, eq=False)
class CompleteRecord:
    """Content of a record with a covariance of its own: a line, or one component of a mixture."""

    line: MapLine
    index: int  #: of the component, from 0
    count: int  #: number of components of the line
    weight: float  #: of the component
    counter: int  #: E2E counter of the record

    @property
    def owner(self) -> Slot:
        """Slot of the line."""
        return self.line.slot


@dataclass(frozen=True, slots=True)
class RawRecord:
    """Content of a record of the pose error, or of one that is conditional on it.

    Args:
        owner: ``POSE``, or the slot of the line.
        counter: E2E counter.
        raw: raw values by signal, of all but page numbers, transfer IDs, counter and checksum, and
            ``HasCovariance``.
    """

    owner: Owner
    counter: int
    raw: Mapping[str, int]

    @property
    def count(self) -> int:
        """Number of components: a line in a scene is no mixture."""
        return 1


class RecordFormat(Protocol[Content_co]):
    """Format of records: their bits, and what their values mean."""

    @property
    def packer(self) -> RecordPacker:
        """Packer of the raw values."""

    @property
    def data_ids(self) -> Mapping[Owner, int]:
        """E2E data ID of each owner of such records."""

    def content(
        self, raw: Mapping[str, int], owner: Owner, t_ns: int | None
    ) -> Content_co | Reason:
        """Return the content of an intact record, or CONTENT if no sender may send its values."""


class RecordReader(Generic[Content]):
    """Reader of the records of all owners: of each slot, and of the pose error.

    Args:
        formats: of the records of lines, and of the pose error if the DBC has such a message.
    """

    def __init__(self, *formats: RecordFormat[Content]) -> None:
        #: Format of the records of each owner.
        self.formats = {owner: form for form in formats for owner in form.data_ids}

    def read(self, payload: bytes, owner: Owner, t_ns: int | None = None) -> Content | Reason:
        """Return the content of a record, or the reason why it is rejected.

        Args:
            payload: bytes of the record.
            owner: one of ``formats``; its E2E data ID is part of the checksum.
            t_ns: time of reception [ns].
        """
        form = self.formats[owner]
        raw = form.packer.unpack_one(payload, form.data_ids[owner])
        return raw if isinstance(raw, Reason) else form.content(raw, owner, t_ns)
