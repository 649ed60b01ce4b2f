"""Layout of a record, and the messages that carry it."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...dbc_files.dbc_cache import DbcFile, parsed_tables
from ...dbc_files.dbc_tables import DbcTables, database_tables
from ...dbc_files.encoding import say
from ...dbc_files.parser import default_dbc_path
from ...values.arrays import row_values
from ...values.errors import EncodeError, LayoutError
from ...values.line import Slot
from .dbc_reader import content_of
from .pose_layout import POSE, Owner, PoseLayout, owner_name
from .record_layout import RecordLayout, bits_of
from .record_signals import (
    COMPLETE_RECORD,
    CONDITIONAL_RECORD,
    FINE_SIGNALS,
    PAGE,
    PAGE_BYTES,
    PARAMETER_SIGNALS,
    SCENE_LINE,
    SLOT,
    SLOT_BOUNDS,
    TRANSFER_ID,
    Bounds,
)
from .scene_layout import SceneLayout
from .slot_messages import RecordMessages, Room, SecuredLayout, check_messages

if TYPE_CHECKING:
    from ...dbc_files.parser import Database

#: Covariance codes of records whose covariance is conditional on the pose error: those of lines,
#: and of whole scenes.
POSE_CONDITIONAL = "PoseConditional"
WHOLE_SCENE = "Scene"


@dataclass(frozen=True, eq=False, kw_only=True)
class Layout(RecordLayout):
    """Layout of a record and the messages that carry it, as a DBC describes them.

    A record is the concatenation of the pages of a multiplexed classic message, and the payload
    of one CAN FD message. A signal that every page repeats has the page number added to its name:
    ``Page0``, ``TransferId0``, ``Page1``, ... If the DBC has no transfer ID in the first page,
    that page's transfer ID is the low bits of ``Counter``.

    In a DBC of whole scenes, a record holds the pose error and several lines: ``scene`` is its
    layout, the signals here are those of its first line, and lines have no messages.

    Args:
        signals: of a line, by name, in the order of their bits.
        messages: of lines, by slot.
        covariance_code: name of the covariance code.
        source: name of the DBC in error messages.
        secured: layout of the authenticated messages; None if there are none.
        pose: layout of the records that have the pose error; None if there are none.
        sha256: of the text of the DBC in UTF-8; empty for a database of cantools.

    Raises:
        LayoutError: a signal is missing or is not within its bounds, two messages have
            the same CAN ID, two records the same data ID, or the covariance code needs other
            messages.
    """

    messages: Mapping[Slot, RecordMessages]
    covariance_code: str
    secured: SecuredLayout | None = None
    pose: PoseLayout | SceneLayout | None = None
    sha256: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if (self.covariance_code == WHOLE_SCENE) is (self.scene is None):
            raise LayoutError(
                f"{self.source}: the covariance code is {self.covariance_code}, but messages with "
                f"the attribute MapLineScene need {WHOLE_SCENE}, and others need another one; "
                "correct CovarianceCode"
            )
        self.check(self._bounds)
        check_messages(map(self._room, self.messages_of), self.source)
        if isinstance(self.pose, PoseLayout):
            counters = dict.fromkeys(self.messages, self["Counter"])
            self.pose.check_slots(counters, levels=not self.is_conditional)
        elif self.pose is None and self.is_conditional:
            raise LayoutError(
                f"{self.source}: records with the covariance code {POSE_CONDITIONAL} need a "
                "message of the pose error; add one with the attribute MapLinePose 1"
            )

    @property
    def _bounds(self) -> Mapping[str, Bounds]:
        if self.scene is not None:
            return SCENE_LINE if SLOT not in self.signals else {**SCENE_LINE, SLOT: SLOT_BOUNDS}
        return CONDITIONAL_RECORD if self.is_conditional else COMPLETE_RECORD

    def _room(self, owner: Owner) -> Room:
        layout, messages = self.record_of(owner), self.messages_of[owner]
        sizes = layout.record_bytes, layout.secured_bytes
        return Room(owner_name(owner), messages, layout.secured, *sizes)

    @classmethod
    def from_dbc(
        cls, dbc: str | Path | Database | None = None, *, encoding: str | None = None
    ) -> Layout:
        """Read a layout from a DBC file, or from a database that cantools has loaded from one.

        By default, the DBC is the project's ``maplines.dbc``.

        Args:
            dbc: path or database.
            encoding: of the file, such as ``cp936``; None to find it.

        Warns:
            UserWarning: the encoding is not stated, and a unit or a name is uncertain.

        Raises:
            LayoutError: the file is missing, is larger than 16 MB, is not a DBC, is not in the
                encoding, or does not describe a map line.
            TypeError: it is neither a path nor a ``cantools.database.can.Database``.
        """
        if not isinstance(dbc, str | Path | None):
            return cls.from_tables(database_tables(dbc), "the cantools database")
        file = DbcFile(default_dbc_path() if dbc is None else Path(dbc), encoding)
        with suppress(LayoutError):  # such tables were not kept by `DbcFile.keep`
            if (tables := file.kept()) is not None:
                layout = cls.from_tables(tables, file.source)
                say(tables.doubt, file.source)
                return layout
        tables = file.parsed()
        layout = cls.from_tables(tables, file.source)
        file.keep(tables)
        return layout

    @classmethod
    def from_text(cls, text: str, source: str = "DBC") -> Layout:
        """Read a layout from the text of a DBC, named ``source`` in error messages.

        Raises:
            LayoutError: the text is not a DBC, or does not describe a map line.
        """
        return cls.from_tables(parsed_tables(text, source), source)

    @classmethod
    def from_tables(cls, tables: DbcTables, source: str) -> Layout:
        """Return the layout that the tables of a DBC describe, named ``source`` in error messages.

        Raises:
            LayoutError: they do not describe a map line.
        """
        return cls(source=source, sha256=tables.sha256, **content_of(tables, source))

    def is_same_as(self, other: Layout) -> bool:
        """Whether records and messages are the same, as those of a DBC that was read twice."""
        return self is other or self._content == other._content

    @cached_property
    def _content(self) -> tuple[object, ...]:
        pose = None if self.pose is None else self.pose.content
        return self.signals, self.messages, self.covariance_code, self.secured, pose

    @property
    def scene(self) -> SceneLayout | None:
        """Layout of records of whole scenes; None if the records are of lines."""
        return self.pose if isinstance(self.pose, SceneLayout) else None

    @property
    def slots(self) -> tuple[Slot, ...]:
        """Slots of the lines that the messages can have."""
        return tuple(self.messages) if self.scene is None else self.scene.slots

    def record_of(self, owner: Owner) -> AnyLayout:
        """Return the layout of the records of an owner."""
        return self if isinstance(owner, Slot) or self.pose is None else self.pose

    @property
    def record_bytes(self) -> int:
        """Length of a record with a line."""
        return super().record_bytes if self.scene is None else self.scene.record_bytes

    @cached_property
    def resolution(self) -> NDArray[np.float64]:
        """(4,) variances of the mean's rounding error, factor^2 / 12, in SI units squared."""
        factors = np.array([self[name].factor for name in PARAMETER_SIGNALS])
        return factors * factors / 12

    @property
    def max_age(self) -> float:
        """Greatest age that a line can have [s]; that of a conditional record is of its pose."""
        if self.is_conditional and self.pose is not None:
            return self.pose.max_age
        return super().max_age

    @property
    def is_conditional(self) -> bool:
        """Whether the covariance of a line is conditional on the pose error."""
        return self.covariance_code in (POSE_CONDITIONAL, WHOLE_SCENE)

    @cached_property
    def short_pages(self) -> int:
        """Number of pages of a record without a covariance; fewer only if it is conditional.

        They are the pages up to the last one with another signal than those of the covariance
        and of the finer mean.
        """
        if self.covariance_code != POSE_CONDITIONAL:
            return self.pages
        names = CONDITIONAL_RECORD.keys() - {PAGE, TRANSFER_ID, *FINE_SIGNALS}
        return max(max(bits_of(self[name])) for name in names) // (8 * PAGE_BYTES) + 1

    @cached_property
    def messages_of(self) -> dict[Owner, RecordMessages]:
        """Messages of each owner, as far as the DBC has them."""
        owned: dict[Owner, RecordMessages] = dict(self.messages.items())
        if isinstance(self.pose, PoseLayout):
            owned[POSE] = self.pose.messages
        return owned if self.scene is None else dict(self.scene.messages.items())

    @cached_property
    def message_of_id(self) -> dict[tuple[int, bool], tuple[Owner, bool]]:
        """Map from (CAN ID, extended) to (owner, is_whole_record)."""
        return {
            key: (owner, is_whole)
            for owner, messages in self.messages_of.items()
            for key, is_whole in messages.ids.items()
        }

    @property
    def has_classic(self) -> bool:
        """Whether there is a message for classic CAN; if not, all frames are CAN FD."""
        return any(messages.can_id is not None for messages in self.messages_of.values())

    @property
    def can_ids(self) -> frozenset[int]:
        """CAN IDs of all lines and of the pose error, for filters."""
        return frozenset(can_id for can_id, _ in self.message_of_id)

    def data_ids(self, slot: ArrayLike, n: int) -> NDArray[np.uint16]:
        """Return the (n,) E2E data IDs of slots, (n,) or one for all.

        Raises:
            EncodeError: the DBC has no message for a slot.
        """
        given = row_values(slot, n)
        slots = given.astype(np.int64)
        table = np.full(max(Slot) + 1, -1)
        for known, messages in self.messages.items():
            table[known] = messages.data_id
        bad = (slots < 0) | (slots > max(Slot)) | (slots != given)
        bad |= table[slots.clip(0, max(Slot))] < 0
        if bad.any():
            raise EncodeError(f"{self.source} has no message for slot {given[bad][0]}")
        return np.broadcast_to(table[slots].astype(np.uint16), n)


#: Layout of the records of any owner.
AnyLayout: TypeAlias = Layout | PoseLayout | SceneLayout
