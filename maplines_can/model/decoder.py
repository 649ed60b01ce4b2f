"""Receiver of all lines of a DBC: frames in; lines, scenes and counted reasons out.

Every record passes the same stations. Each may drop it, with a reason that is counted::

    frame          secoc.py        with keys: MAC and freshness, before all others
      |            reassembly.py   all pages of one transfer, or none; time-outs
    record         records.py      page numbers, transfer IDs, checksum; what no sender sends
      |            sequence.py     counter: duplicate, late or new; E2E status and state
    new record     mixtures.py     a line of all its components, or none
      |            epochs.py       lines of one pose error; records that wait for theirs
      |            whole_scenes.py a scene of one record, or two
    lines, scene   scenes.py
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

from ..values.line import Slot, Status
from ..wire.layout.message_layout import Layout
from ..wire.layout.pose_layout import POSE, SCENE, Owner, PoseLayout, slot_of
from ..wire.layout.scene_layout import SceneLayout
from .epochs import Epochs
from .mixtures import Mixtures
from .reassembly import Content, Reassembly, Record
from .records import Component, Line, RawRecord, complete, conditional, intact
from .scenes import Member, Pose, Scene, pose_of, scene_line, scene_of
from .secoc import Keys, verified
from .sequence import SHORT_ROW, SequenceCheck
from .settings import ALL, Settings, Sizes, settings_of
from .whole_scenes import SceneContent, WholeRecord, WholeScenes, whole

#: A line is stale if nothing newer has come for so many cycles.
STALE_CYCLES = 3.0
#: The time of a question may be before a reception by this [ns]; by more, the clock was set back.
CLOCK_JITTER_NS = 1_000_000
#: Longest payload of a CAN FD frame.
FRAME_BYTES = 64
#: Times are limited to this [ns].
MAX_TIME_NS = 4 * 10**18


class View(NamedTuple):
    """The newest line of a slot, or the newest scene, and whether it may be used now."""

    content: Line | Scene | None
    age: float  #: from its pose to now [s]; infinite if too old, unknown, or without content
    is_stale: bool
    state: str  #: of the slot, and of the pose error if the line depends on it; or of that
    status: str | None  #: of the last check of the slot, or of the pose error
    may_be_two: bool  #: senders
    slot_states: dict[Slot, str]  #: of the lines of a scene
    left_out: str | None = None  #: why the newest whole scene has no line of the slot

    @property
    def is_usable(self) -> bool:
        """Whether a controller may use it."""
        line = self.content
        is_sent = not isinstance(line, Line) or line.status is not Status.OUT_OF_RANGE
        are_valid = {self.state, *self.slot_states.values()} == {"VALID"}
        is_new = math.isfinite(self.age) and not self.is_stale
        return is_sent and are_valid and is_new and not self.may_be_two


class _Owner:
    """What there is of the records of a slot, of the pose error, or of whole scenes."""

    def __init__(
        self,
        layout: Layout,
        owner: Owner,
        settings: Settings,
        counts: Counter[str],
        sizes: Sizes,
        *,
        keys: bool,
    ) -> None:
        timeout_ns, cycle_ns, windows = settings
        self.owner, self._lines, self._components = owner, layout, sizes.components
        self.layout = layout.record_of(owner)
        self.messages = layout.messages_of[owner]
        #: Layout of its authenticated message; None if its frames are not authenticated.
        self.secured = self.layout.secured if keys else None
        modulus, is_authentic = 2 ** self.layout["Counter"].length, self.secured is not None
        #: None: each frame is a record.
        self.reassembly: Reassembly | None = None
        if not isinstance(self.layout, SceneLayout):
            parts = self.layout, self._content, timeout_ns, counts, sizes.transfers
            self.reassembly = Reassembly(*parts)
        self.check = SequenceCheck(
            windows,
            modulus,
            max(self.layout.pages, 1),
            cycle_ns,
            is_authentic=is_authentic,
            history=sizes.history,
        )
        self.mixtures = Mixtures(modulus, timeout_ns, counts)

    @property
    def pending(self) -> int:
        """Frames of transfers and mixtures that are not complete yet."""
        transfers = 0 if self.reassembly is None else self.reassembly.pending
        return transfers + self.mixtures.pending

    def expire(self, t_ns: int) -> None:
        """Drop what has timed out."""
        if self.reassembly is not None:
            self.reassembly.expire(t_ns)
        self.mixtures.expire(t_ns)

    def _content(self, payload: bytes, t_ns: int) -> Content | str:
        """Return what a record says, or why it is rejected."""
        raw = intact(self.layout, payload, self.messages.data_id)
        if isinstance(raw, str):
            return raw
        if self.owner == POSE:
            return RawRecord(raw["Counter"], raw)
        if self._lines.is_conditional:
            return conditional(self._lines, raw)
        found = complete(self._lines, slot_of(self.owner), raw, t_ns)
        is_held = isinstance(found, str) or found.size <= self._components
        return found if is_held else "CONTENT"

    def whole(self, record: bytes, t_ns: int, *, is_secured: bool) -> WholeRecord | str:
        """Return what a record of a whole scene says, or why it is rejected."""
        raw = intact(self.layout, record, self.messages.data_id)
        if isinstance(raw, str):
            return raw
        return whole(self._lines, self.owner, record, raw, t_ns, is_secured=is_secured)


class Receiver:
    """Receiver of frames; time is an argument [ns].

    At any time ``frames == line_frames + pose_frames + sum(counts.values()) + pending``; the frames
    of whole scenes are counted as those of pose errors. Settings
    of the owners are those that the DBC implies, unless they are given, and sizes those of the
    Python package. With keys, frames of each owner with such a message must be authenticated.

    >>> receiver = Receiver(Layout.from_dbc())
    >>> receiver.feed(0x340, bytes(8), t_ns=0), receiver.feed(0x123, bytes(8), t_ns=0)
    ('PENDING', 'FOREIGN')
    """

    def __init__(
        self,
        layout: Layout,
        settings: Mapping[Owner, Settings] | None = None,
        keys: Keys | None = None,
        sizes: Sizes = ALL,
        *,
        refuses_short_spacings: bool = False,
    ) -> None:
        self.short_spacings = 0  #: of lines of a slot, and pose errors, below 1 % of the cycle
        self._refuses_short_spacings = refuses_short_spacings
        self.counts: Counter[str] = Counter()  #: dropped frames by reason
        self.frames = 0  #: received
        self.lines = self.line_frames = 0  #: delivered
        self.pose_errors = self.pose_frames = 0  #: received
        self._layout, self._keys, self._sizes = layout, keys, sizes
        of_owners = settings_of(layout) if settings is None else settings
        self._owners = {
            owner: _Owner(layout, owner, own, self.counts, sizes, keys=keys is not None)
            for owner, own in of_owners.items()
            if sizes.has(owner)
        }
        self._pose_is_too_old = False
        self._newest: dict[Slot, tuple[Line, Owner]] = {}  # with the owner of its record
        cycle_ns = {owner: own.cycle_ns for owner, own in of_owners.items()}
        self._epochs = Epochs(
            cycle_ns.get(POSE, 1), self.counts, sizes.epochs, has_mixtures=not layout.is_conditional
        )
        self._whole: WholeScenes | None = None
        if layout.scene is not None and sizes.scenes:
            self._whole = WholeScenes(layout.scene, cycle_ns[SCENE])

    @property
    def checks(self) -> dict[Owner, SequenceCheck]:
        """Checks of the records of each owner."""
        return {owner: own.check for owner, own in self._owners.items()}

    @property
    def pending(self) -> int:
        """Frames of transfers, mixtures and lines that are not complete yet."""
        return sum(own.pending for own in self._owners.values()) + self._epochs.pending

    # ---- stations of a frame ------------------------------------------------------------------

    def feed(
        self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False
    ) -> list[Line] | str:
        """Return the lines that a frame completes, or the reason why none."""
        t_ns, key = limited(t_ns), (can_id, is_extended)
        self.frames += 1
        own = next((own for own in self._owners.values() if key in own.messages.ids), None)
        if own is None:
            return self._dropped("FOREIGN", 1)
        record = self._reassembled(own, key, data, t_ns)
        if isinstance(record, Record):
            return self._checked(own, record)
        if record != "PENDING":
            self._dropped(record, 1)
            own.check.frame_dropped(record, t_ns)
        return record

    def _reassembled(
        self, own: _Owner, key: tuple[int, bool], data: bytes, t_ns: int
    ) -> Record | str:
        """Return the record that a frame completes, or why none."""
        reassembly, layout = own.reassembly, own.layout
        data_id = own.messages.secured_ids.get(key)
        if data_id is not None:
            if own.secured is None or self._keys is None:
                return "KEY"
            payload = verified(self._keys, own.secured, data, data_id)
            if isinstance(payload, str):
                return payload
            data = payload
        elif own.secured is not None:
            return "UNAUTHENTICATED"
        elif reassembly is not None and not own.messages.ids[key]:
            return reassembly.add_page(data, t_ns)
        elif not layout.record_bytes <= len(data) <= FRAME_BYTES:
            return "LENGTH"
        if reassembly is not None:
            return reassembly.complete(reassembly.whole(data), t_ns, 1)
        is_secured = data_id is not None
        record = data[: layout.secured_bytes if is_secured else layout.record_bytes]
        return Record(record, t_ns, 1, own.whole(record, t_ns, is_secured=is_secured))

    def _checked(self, own: _Owner, record: Record) -> list[Line] | str:
        """Return the lines of a record, or why none."""
        content, check = record.content, own.check
        if isinstance(content, str):
            check.failed(record.t_ns)
            return self._dropped(content, record.frames)
        if not isinstance(content, Component) or content.place == 0:
            self.short_spacings += check.is_spaced_short(record.t_ns)
        if self._refuses_short_spacings and check.short_row >= SHORT_ROW:
            check.failed(record.t_ns)
            return self._dropped("SPACING", record.frames)
        reason = check.received(content.counter, record.payload, record.t_ns, content.size)
        if reason is not None:
            if reason == "STALE":
                own.mixtures.drop_if_within(content.counter)
            return self._dropped(reason, record.frames)
        if isinstance(content, Component):
            return self._add_component(own, content, record)
        if isinstance(content, WholeRecord):
            return self._add_whole(own, content)
        if isinstance(own.layout, PoseLayout):
            return self._add_pose(pose_of(own.layout, content, record.t_ns), own, record)
        member = Member(slot_of(own.owner), content.counter, content, record.t_ns, record.frames)
        pose = self._epochs.add_line(member, is_break=check.ahead is None)
        return "PENDING" if pose is None else self._rebuilt(pose, member)

    def _add_component(self, own: _Owner, content: Component, record: Record) -> list[Line] | str:
        """Add a new record with a covariance of its own to its line, and that to a scene."""
        if content.size > 1 and own.check.senders.was_reused(record.t_ns):
            own.mixtures.drop("INCOMPLETE")  # its components may be of two senders
            return self._dropped("INCOMPLETE", record.frames)
        received = own.mixtures.add(content, record.frames, record.t_ns)
        if isinstance(received, str):
            return received
        line, frames = received
        if content.size == 1 and line.x_min < line.x_max:
            member = Member(line.slot, content.counter, line, record.t_ns, 0)
            self._epochs.add_line(member, is_break=own.check.ahead is None)
        return [self._delivered(line, frames)]

    def _add_pose(self, pose: Pose, own: _Owner, record: Record) -> list[Line] | str:
        """Add a new pose error; return the lines that waited for it."""
        own.check.delivered(1)
        self.pose_errors += 1
        self.pose_frames += record.frames
        self._pose_is_too_old = math.isinf(pose.age)
        lines: list[Line] = []
        for member in self._epochs.add_pose(pose, own.check.ahead):
            if isinstance(member.content, RawRecord):
                found = self._rebuilt(pose, member)
                lines += [] if isinstance(found, str) else found
        return lines or "PENDING"

    def _add_whole(self, own: _Owner, content: WholeRecord) -> list[Line] | str:
        """Add a new record of a whole scene; return its lines."""
        assert self._whole is not None  # noqa: S101 - such a record has an owner
        own.check.delivered(1)
        self.pose_errors += 1
        self.pose_frames += 1
        content = content.of_slots(self._sizes.slots)
        self._whole.add(content, is_break=own.check.ahead is None)
        found = [scene_line(self._layout, content.pose, one) for one in content.members.values()]
        lines = [one.line for one in found if one is not None]
        self._newest |= {line.slot: (line, own.owner) for line in lines}
        self.lines += len(lines)
        return lines or "PENDING"

    def _rebuilt(self, pose: Pose, member: Member) -> list[Line] | str:
        """Return the line of a conditional record that has joined its pose error."""
        found = scene_line(self._layout, pose, member)
        if found is None:
            return self._dropped("CONTENT", member.frames)
        return [self._delivered(found.line, member.frames)]

    def _delivered(self, line: Line, frames: int) -> Line:
        self._owners[line.slot].check.delivered(len(line.components) or 1)
        self._newest[line.slot] = line, line.slot
        self.lines += 1
        self.line_frames += frames
        return line

    def _dropped(self, reason: str, frames: int) -> str:
        self.counts[reason] += frames
        return reason

    # ---- questions ----------------------------------------------------------------------------

    def expire(self, t_ns: int) -> None:
        """Drop what has timed out."""
        t_ns = limited(t_ns)
        for own in self._owners.values():
            own.expire(t_ns)
        self._epochs.expire(t_ns)

    def elapse(self, now_ns: int) -> None:
        """Check the cycles without a record of all owners up to now; ``checks`` has the results."""
        for own in self._owners.values():
            own.check.elapse(limited(now_ns))

    def latest(self, slot: Slot, now_ns: int, stale_cycles: float = STALE_CYCLES) -> View:
        """Return the newest line of a slot, and whether it may be used now."""
        line, of_line = self._newest_line(slot)
        now_ns, owners = limited(now_ns), [of_line]
        if self._whole is None and self._layout.is_conditional:
            owners.append(POSE)
        checks = [self._owners[owner].check for owner in owners]
        age, is_stale, waited = math.inf, True, 0.0
        if line is not None:
            waited, is_stale = _waited(line.t_ns, now_ns, stale_cycles * checks[0].cycle_ns)
            age = line.age + waited
        states = [_state(check, now_ns, waited) for check in checks]
        state = next((one for one in states if one != "VALID"), "VALID")
        may_be_two = any(check.senders.may_be_two(now_ns) for check in checks)
        left_out = None if self._whole is None else self._whole.left_out_of(slot)
        return View(line, age, is_stale, state, checks[0].status, may_be_two, {}, left_out)

    def _newest_line(self, slot: Slot) -> tuple[Line | None, Owner]:
        """Return the newest line of a slot, and the owner of its record."""
        if self._whole is None or self._sizes.lines:
            return self._newest.get(slot, (None, slot if self._whole is None else SCENE))
        record = self._whole.newest_with(slot)
        if record is None:
            return None, SCENE
        found = scene_line(self._layout, record.pose, record.members[slot])
        return None if found is None else found.line, record.owner

    def latest_scene(self, now_ns: int, stale_cycles: float = STALE_CYCLES) -> View:
        """Return the newest scene that waits for no line, and whether it may be used now."""
        now_ns = limited(now_ns)
        check = self._owners[POSE if self._whole is None else SCENE].check
        content = self._epoch() if self._whole is None else self._whole.content
        if content is None:
            state = check.elapse(now_ns)
            return View(None, math.inf, True, state, check.status, False, {})
        pose, members, owners, left_out = content
        found = [scene_line(self._layout, pose, member) for member in members]
        scene = scene_of(pose, [line for line in found if line is not None], left_out)
        waited, is_stale = _waited(pose.t_ns, now_ns, stale_cycles * check.cycle_ns)
        state, status = _state(check, now_ns, waited), check.status
        checks = {line.slot: self._owners[owners[line.slot]].check for line in scene.lines}
        states = {slot: _state(one, now_ns, waited) for slot, one in checks.items()}
        may_be_two = any(one.senders.may_be_two(now_ns) for one in (check, *checks.values()))
        age = math.inf if self._pose_is_too_old else pose.age + waited
        return View(scene, age, is_stale, state, status, may_be_two, states)

    def _epoch(self) -> SceneContent | None:
        """Return the newest epoch that waits for no line."""
        epoch = self._epochs.latest
        if epoch is None:
            return None
        members = [member for _, member in sorted(epoch.lines.items())]
        return SceneContent(epoch.pose, members, {slot: slot for slot in epoch.lines}, {})


def limited(t_ns: int) -> int:
    """Return a time within +-4e18 ns."""
    return max(-MAX_TIME_NS, min(t_ns, MAX_TIME_NS))


def _waited(t_ns: int, now_ns: int, longest_ns: float) -> tuple[float, bool]:
    """Return the time since a reception [s], infinite if unknown, and whether it is too long."""
    waited_ns = now_ns - t_ns
    if waited_ns < -CLOCK_JITTER_NS:
        return math.inf, True
    return max(waited_ns, 0) / 1e9, waited_ns > longest_ns


def _state(check: SequenceCheck, now_ns: int, waited: float) -> str:
    """Return the state now; if the clock was set back, no cycles have passed."""
    return check.state if math.isinf(waited) else check.elapse(now_ns)
