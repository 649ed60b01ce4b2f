"""Decoder of received frames: frames in, map lines and scenes out, everything else counted."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...core import Lock, ffi, lib
from ...core.memory import pointer
from ...values.line import LEFT_OUT, MapLine, Slot
from ..layout.message_layout import Layout
from ..layout.pose_layout import OWNERS, POSE, Owner, number_of
from ..protection.secoc import DATA_ID_BYTES, FRESHNESS_BYTES, MAX_FRESHNESS, Verifier
from .check import MAX_TIME_NS, STATES, STATUSES, Check, Reason, SlotStats, limited_ns
from .rows import (
    COMPONENT_BYTES,
    COMPONENT_ROW,
    LINE_BYTES,
    LINE_ROW,
    SCENE_ROW,
    line_of,
    scene_of,
)
from .views import STALE_CYCLES, ReceivedScene, SceneView, SlotView, check_stale_cycles

#: Message of the error of a question about scenes if there are none.
NO_POSE = (
    "the DBC has no message of the pose error (MapLinePose), so there are no scenes; "
    "take maplines.dbc, maplines-pose.dbc or maplines-scene.dbc"
)
_REASONS = tuple(Reason)
#: Answer of the core to a frame whose MAC it needs: MAPLINES_ASKS_MAC.
_ASKS_MAC = len(_REASONS)
_MAX_WINDOW_US = 1 << 62
_FOREIGN, _FOREIGN_NUMBER = Reason.FOREIGN, _REASONS.index(Reason.FOREIGN)
#: Times that need no limit.
_MIN_NS, _MAX_NS = -MAX_TIME_NS, MAX_TIME_NS
#: Lines that a frame completes at most, and components of a mixture.
_MAX_LINES, _MAX_COMPONENTS = len(Slot), 64
#: Rows of lines, components and scenes for which a call of the core has memory.
_LINES, _COMPONENTS, _SCENES = 4096, 2048, 256

_ROWS = ("maplines_line_row_t", "maplines_component_row_t", "maplines_scene_row_t")

Rows = NDArray[np.void]


class ReceivedFrame(NamedTuple):
    """A frame of the bus, as arguments of ``Decoder.feed``."""

    can_id: int
    data: bytes
    t_ns: int  #: time of reception [ns]
    is_extended: bool = False  #: the ID has 29 bits


class Decoder:
    """Decoder of the frames of a bus: the state of a receiver, and views of it.

    Every record passes the same stations, whether it is of a slot, of the pose error or a whole
    scene. Each may drop it, with a counted reason::

        frame          with a key: MAC and freshness, before all others
          |            records of lines: all pages of one transfer, or none; time-outs
        record         length, page numbers, transfer IDs, CRC; values that no sender sends
          |            counter: duplicate, late or new; E2E status and state
        new record     a line of all its components, or none
          |            lines of one pose error; records that wait for theirs
          |            whole scenes: two records of one pose error
        lines, scene   may they be used: E2E state, age, second sender

    The stations are those of the core; ``maplines_can.model`` has one file for each, to be read.
    ``Codec.decoder`` makes a decoder. At any time
    ``frames == line_frames + pose_frames + sum(counts.values()) + pending``.

    Each record is checked by its counter according to AUTOSAR E2E, and ``checks`` gives the state
    of each owner. Of good records, only duplicates and late ones are dropped. What to do with a
    line whose slot is not VALID is the consumer's decision; `latest` tells it. A step
    of more than ``max_delta_counter`` is a sequence break, but the record is new: how far a new one
    may be ahead follows from the time that has passed, see the table of ``model/sequence.py``.

    With a verifier the MAC is checked first, and a frame that is not authentic changes nothing:
    no line, no transfer, no check.

    Time is an argument. `latest` and `latest_scene` return the newest line of a slot and the newest
    scene at any time; a ``Receiver`` does the same on a bus. Several threads may use a decoder: one
    call waits for another.

    >>> from maplines_can import Codec, Slot, MapLine
    >>> codec = Codec.from_dbc()
    >>> decoder = codec.decoder()
    >>> line = MapLine.mean_only(Slot.ROUTE, [1.75, 0, 0, 0], age=0.02)
    >>> for frame in codec.encoder().encode(line):
    ...     _ = decoder.feed(frame.can_id, frame.data, t_ns=0)
    >>> view = decoder.latest(Slot.ROUTE, now_ns=60_000_000)
    >>> view.state.name, round(view.age, 3), view.stale
    ('INIT', 0.084, False)
    >>> decoder.latest(Slot.ROUTE, now_ns=160_000_000).stale
    True

    Args:
        layout: of the records and their messages.
        tables: of the same DBC, from ``tables_of``.
        verifiers: of the owners whose frames are authenticated.
        settings: from ``decoder_settings``.
    """

    def __init__(
        self,
        layout: Layout,
        tables: Any,
        verifiers: Mapping[Owner, Verifier],
        settings: Any,
    ) -> None:
        #: CAN IDs of all messages, for filters.
        self.can_ids = layout.can_ids
        #: Keys and last freshness values, by owner; empty without authentication.
        self.verifiers = verifiers
        #: Whether lines are conditional on the pose error.
        self.is_conditional = layout.is_conditional
        self._slots, self._has_scenes = [*layout.slots], layout.pose is not None
        #: CAN IDs as the core takes them: bit 31 says that one has 29 bits.
        self._routes: dict[tuple[int, bool], int] = {}
        self._secured: dict[tuple[int, bool], _SecuredRoute] = {}
        self._tables, self._c = tables, ffi.new("maplines_receiver_t *")
        window_us, has_clock = 0, False
        for verifier in verifiers.values():
            window_us = min(verifier.authenticator.window, _MAX_WINDOW_US)
            has_clock = verifier.authenticator.has_clock
        problem = lib.maplines_receiver_start(self._c, tables, settings, window_us, has_clock)
        if problem != ffi.NULL:
            raise ValueError(ffi.string(problem).decode())
        for key, (owner, _) in layout.message_of_id.items():
            own = verifiers.get(owner)
            data_id = layout.messages_of[owner].secured_ids.get(key)
            if own is None or data_id is None:
                self._routes[key] = key[0] | key[1] << 31
                continue
            size = DATA_ID_BYTES + own.layout.authentic_bytes + FRESHNESS_BYTES
            asked = [ffi.buffer(one, size) for one in self._c.secoc.data]
            self._secured[key] = _SecuredRoute(number_of(owner), data_id, own, asked)
        self._decoder, self._settings = ffi.addressof(self._c, "decoder"), self._c.decoder.settings
        self._view = ffi.new("maplines_view_t *")
        self._scene_view = ffi.new("maplines_scene_view_t *")
        self._freshness_us = self._c.decoder.freshness_us
        #: Held around each call of the core, and until its result is read.
        self._lock = Lock()
        #: Checks of the records of each owner of the DBC: a slot, "pose", "scene" or "scene2".
        self.checks: Mapping[Owner, Check] = {
            owner: Check(self._c, number_of(owner), self._lock) for owner in layout.messages_of
        }
        self._feed = lib.maplines_receiver_feed
        self._feed_mac = lib.maplines_receiver_feed_secured
        self._give_mac = lib.maplines_receiver_give_mac
        self._line_bytes = ffi.buffer(self._c.lines)
        self._component_bytes = ffi.buffer(self._c.components)
        self._foreign = 0  # frames of no message, which the core does not get
        self._newest: dict[Slot, MapLine] = {}
        self._received: ReceivedScene | None = None

    def __reduce__(self) -> str:
        raise TypeError(
            "a Decoder cannot be pickled or copied, since it holds the state of a receiver; pickle "
            "the Codec, and make another with its decoder()"
        )

    @property
    def counts(self) -> Counter[Reason]:
        """Dropped frames by reason."""
        with self._lock:
            numbers = ffi.unpack(self._c.decoder.statistics.counts, len(_REASONS))
            numbers[_FOREIGN_NUMBER] += self._foreign
        counts = zip(_REASONS, numbers, strict=True)
        return Counter({reason: count for reason, count in counts if count})

    @property
    def frames(self) -> int:
        """Frames received."""
        return int(self._c.decoder.statistics.frames) + self._foreign

    @property
    def lines(self) -> int:
        """Lines delivered."""
        return int(self._c.decoder.statistics.lines)

    @property
    def line_frames(self) -> int:
        """Frames of the lines delivered."""
        return int(self._c.decoder.statistics.line_frames)

    @property
    def pose_errors(self) -> int:
        """Pose errors received."""
        return int(self._c.decoder.statistics.pose_errors)

    @property
    def left_out(self) -> int:
        """Lines of which records of whole scenes say why they are left out."""
        return int(self._c.left_out)

    @property
    def pose_frames(self) -> int:
        """Frames of the pose errors received."""
        return int(self._c.decoder.statistics.pose_frames)

    @property
    def lost(self) -> int:
        """Records of lines or whole scenes missing between those received, by their counters."""
        return self._counted("lost")

    @property
    def short_spacings(self) -> int:
        """Positive times between two lines of a slot, or two pose errors, below 1 % of the cycle.

        If there are almost as many as lines, times are in us or ms instead of ns; a few are of a
        gateway that held frames back.
        """
        return int(self._c.decoder.statistics.short_spacings)

    @property
    def pending(self) -> int:
        """Frames of transfers, mixtures and scenes that are not complete yet."""
        return self._counted("pending")

    def feed(
        self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False
    ) -> Sequence[MapLine] | Reason:
        """Decode a frame; return the lines that it completes, or the reason why none.

        Args:
            can_id: its CAN ID.
            data: its payload.
            t_ns: time of reception, on any clock that runs steadily [ns]. Times are limited to
                +-4e18 ns.
            is_extended: the ID has 29 bits.

        Returns:
            One line, or several if a pose error completes those that waited for it, or those of a
            whole scene; or the reason why there is none (PENDING: not yet). No frame raises.

        Raises:
            ValueError: ``t_ns`` is not a whole number.
        """
        known, secured = self._routes.get((can_id, is_extended)), None
        if known is None and (secured := self._secured.get((can_id, is_extended))) is None:
            with self._lock:
                self._foreign += 1
            return _FOREIGN
        if type(data) is not bytes:
            data = _payload(data)
        if type(t_ns) is not int or not _MIN_NS <= t_ns <= _MAX_NS:
            t_ns = limited_ns(t_ns, "t_ns")
        now_us = None if secured is None else secured.authenticator.now(t_ns)
        with self._lock:
            if secured is None:
                found = self._feed(self._c, known, t_ns, data, len(data))
            else:
                found = self._verified(secured, now_us, data, t_ns)
            return _REASONS[found] if found >= 0 else self._completed(-found)

    def feed_all(self, frames: Iterable[ReceivedFrame]) -> list[Sequence[MapLine] | Reason]:
        """Decode frames, the first one first; return what ``feed`` does of each."""
        return [
            self.feed(can_id, data, t_ns, is_extended=is_extended)
            for can_id, data, t_ns, is_extended in frames
        ]

    def _verified(self, route: _SecuredRoute, now_us: int | None, data: bytes, t_ns: int) -> int:
        """Return the answer of the core to a frame, whose MACs it gets.

        The last freshness value is that of the verifier.
        """
        c, owner, authenticator = self._c, route.owner, route.authenticator
        last = route.last_accepted.get(route.data_id, authenticator.not_before)
        now_us = now_us or 0
        if not -MAX_FRESHNESS <= now_us <= MAX_FRESHNESS:
            now_us = MAX_FRESHNESS if now_us > 0 else -MAX_FRESHNESS
        found = self._feed_mac(c, owner, t_ns, data, len(data), now_us, last)
        if found == _ASKS_MAC:
            key = authenticator.key(data[route.key_at])
            for asked in route.asked:
                found = self._give_mac(c, ffi.NULL if key is None else key.mac(asked))
                if found != _ASKS_MAC:
                    break
            accepted = self._freshness_us[owner]
            if accepted != last:
                route.last_accepted[route.data_id] = accepted
        return int(found)

    def _completed(self, count: int) -> list[MapLine]:
        """Return the lines of the rows, which are the newest of their slots."""
        rows = self._line_bytes[: count * LINE_BYTES]
        lines = []
        for begin in range(0, len(rows), LINE_BYTES):
            line = line_of(rows, begin, self._components)
            self._newest[line.slot] = line
            lines.append(line)
        return lines

    def _components(self) -> bytes:
        """Return the rows of components of the line that was completed last."""
        return self._component_bytes[: self._c.rows.component_count * COMPONENT_BYTES]

    def feed_arrays(
        self,
        can_id: NDArray[np.uint32],
        is_extended: NDArray[np.bool_],
        t_ns: NDArray[np.int64],
        length: NDArray[np.uint8],
        data: NDArray[np.uint8],
        places: NDArray[np.int64],
        reasons: NDArray[np.uint8],
        scenes: int,
    ) -> tuple[Rows, Rows, Rows]:
        """Decode frames of a block.

        Args:
            can_id: (n,) of all frames of the block.
            is_extended: (n,) their IDs have 29 bits.
            t_ns: (n,) times of reception [ns].
            length: (n,) of their payloads [byte].
            data: (n, up to 64) bytes, of which each frame has ``length``.
            places: of the frames of this decoder.
            reasons: (n,) is written to at these places: places in ``Reason``, or 255 of a frame
                that has completed lines.
            scenes: 0 for none, 1 for those that another has followed, 2 for the last one, too.

        Returns:
            Rows of lines, components of mixtures, and scenes.

        Raises:
            ValueError: a place or a length is beyond the arrays, or an array is not in C order.
            TypeError: an array is of another type.
        """
        n, width = data.shape
        rows: dict[str, NDArray[Any]] = {
            "can_id": can_id, "is_extended": is_extended, "t_ns": t_ns, "length": length,
        }  # fmt: skip
        for name, array in (*rows.items(), ("reasons", reasons)):
            if array.shape != (n,):
                raise ValueError(f"{name} must be ({n},) as the rows of data, got {array.shape}")
        if width > 64:
            raise ValueError(f"data must be (n, up to 64) bytes, got {data.shape}")
        if len(places) and not (places.min() >= 0 and places.max() < n):
            raise ValueError(f"places must be those of {n} frames, got up to {places.max()}")
        if (length[places] > width).any():
            raise ValueError(f"length must be {width} at most as data has, got {length.max()}")
        given = [len(places), n, width, *map(pointer, (places, *rows.values(), data))]
        given.append(pointer(reasons, written=True))
        block, place = ffi.new("maplines_block_t *", given), 0
        found: list[list[Rows]] = []
        with self._lock:
            while place < len(places) or not found:
                room, arrays = _new_rows(len(places) - place)
                place = self._feed_block(block, place, room, scenes > 0)
                counts = room.line_count, room.component_count, room.scene_count
                part = [one[:count] for one, count in zip(arrays, counts, strict=True)]
                self._renew(room, part[0], part[1])
                part[1]["line"] += sum(len(lines) for lines, *_ in found)
                found.append(part)
            shown = self._c.shown
            if scenes == 2 and shown.frame >= 0:
                last = np.frombuffer(ffi.buffer(ffi.addressof(shown))[:], SCENE_ROW)
                found.append([part[0][:0], part[1][:0], last])
                shown.frame = -1
            if len(found) > 1:
                part = [np.concatenate(each) for each in zip(*found, strict=True)]
        return part[0], part[1], part[2]

    def _feed_block(self, block: Any, place: int, rows: Any, has_scenes: bool) -> int:
        """Feed frames of a block from a place on, as long as there is room; return the next one."""
        feed_block, secoc = lib.maplines_receiver_feed_block, self._c.secoc
        place = feed_block(self._c, block, place, rows, has_scenes)
        while rows.is_waiting:
            i = block.places[place]
            route = self._secured[block.can_ids[i], bool(block.are_extended[i])]
            data = ffi.buffer(block.data + i * block.width, min(block.lengths[i], block.width))[:]
            now_us = route.authenticator.now(block.times_ns[i])
            secoc.rows, secoc.place, secoc.has_scenes = rows, i, has_scenes
            try:
                answer = self._verified(route, now_us, data, block.times_ns[i])
            finally:
                secoc.rows = ffi.NULL
            block.reasons[i] = answer & 0xFF
            place = feed_block(self._c, block, place + 1, rows, has_scenes)
        return int(place)

    def _renew(self, rows: Any, lines: Rows, components: Rows) -> None:
        """Make the newest line of each slot of these rows, as ``feed`` does."""
        for slot, count in zip(Slot, rows.newest, strict=True):
            if count:
                row, own = lines[count - 1].tobytes(), components
                if len(own):
                    own = own[slice(*np.searchsorted(own["line"], (count - 1, count)))]
                self._newest[slot] = line_of(row, 0, own.tobytes)

    def expire(self, t_ns: int) -> None:
        """Drop the transfers, mixtures and waiting lines that have timed out at ``t_ns`` [ns]."""
        t_ns = limited_ns(t_ns, "t_ns")
        with self._lock:
            lib.maplines_expire(self._decoder, t_ns)

    def latest(self, slot: Slot, now_ns: int, *, stale_cycles: float = STALE_CYCLES) -> SlotView:
        """Return the newest line of a slot with its state.

        A line that is late by 240 to 255 records looks newer and is returned as such (see
        ``model/sequence.py``). These are 12 s of single lines, or 1.5 s of lines of 8 components.

        Args:
            slot: which line.
            now_ns: current time on the clock of the frames' time stamps [ns]. If it is before the
                reception of the line by more than ``CLOCK_JITTER_NS``, this clock was set back: the
                line is stale, and its age is infinite.
            stale_cycles: number of cycle times without a newer line after which a line is
                stale; see ``Codec.decoder`` for the cycle time.

        Raises:
            ValueError: the DBC has no such slot, ``now_ns`` is not a whole number, or
                ``stale_cycles`` is less than 0 or NaN.
        """
        self._check_slot(slot)
        check_stale_cycles(stale_cycles)
        slot, now_ns = Slot(slot), limited_ns(now_ns, "now_ns")
        with self._lock:
            view = self._view
            self._settings.stale_cycles = stale_cycles
            lib.maplines_latest(self._decoder, slot, now_ns, view)
            return SlotView(
                slot,
                self._newest.get(slot),
                view.age,
                view.is_stale,
                STATES[view.state],
                STATUSES[view.status],
                view.two_senders,
                LEFT_OUT[view.left_out],
            )

    def latest_scene(self, now_ns: int, *, stale_cycles: float = STALE_CYCLES) -> SceneView:
        """Return the newest scene: lines of one pose, with their joint covariance.

        The lines of a cycle arrive one after the other, in all of the cycle. The scene before
        remains the newest one until lines of all slots of the last two scenes have come, or the
        next pose error. A line that was lost is not in the scene. If the newest pose error is too
        old, the age is infinite.

        A whole scene is the newest at once, with the lines of Scene2 that came with its pose error.

        Args:
            now_ns: as in ``latest``.
            stale_cycles: number of cycle times since its pose error after which a scene is stale.

        Raises:
            ValueError: the DBC has no message of the pose error; or as ``latest``.
        """
        if not self._has_scenes:
            raise ValueError(NO_POSE)
        check_stale_cycles(stale_cycles)
        now_ns = limited_ns(now_ns, "now_ns")
        with self._lock:
            received, view = self._newest_scene(), self._scene_view
            self._settings.stale_cycles = stale_cycles
            lib.maplines_latest_scene(self._decoder, now_ns, view)
            known = STATES[view.state], STATUSES[view.status]
            if received is None:
                return SceneView(None, view.age, view.is_stale, *known)
            lines, states = received.scene.lines, view.slot_states
            of_slots = {line.slot: STATES[states[i]] for i, line in enumerate(lines)}
            senders = view.two_senders
            return SceneView(
                received.scene, view.age, view.is_stale, *known, received, of_slots, senders
            )

    def scene(self) -> ReceivedScene | None:
        """Return the newest scene, see `latest_scene`; None before the first."""
        with self._lock:
            return self._newest_scene()

    def _newest_scene(self) -> ReceivedScene | None:
        if lib.maplines_receiver_scene(self._c, self._received is not None):
            seen = self._c.seen
            rows = ffi.buffer(seen.lines)[: seen.scene.count * LINE_BYTES]
            lines = [line_of(rows, begin) for begin in range(0, len(rows), LINE_BYTES)]
            for i, line in enumerate(lines):
                if seen.are_newest[i]:
                    lines[i] = self._newest.get(line.slot, line)
            self._received = scene_of(seen, tuple(lines))
        return self._received

    def slots(self, now_ns: int) -> dict[Slot, SlotStats]:
        """Return the E2E statistics of each slot on which anything was received.

        A slot that has come in a whole scene has those of the message that brought its line.
        """
        owners = {slot: self._owner_of(slot) for slot in self._slots}
        stats = {slot: self._stats(own, now_ns) for slot, own in owners.items() if own is not None}
        return {slot: known for slot, known in stats.items() if known is not None}

    def _owner_of(self, slot: Slot) -> Owner | None:
        """Return the owner of the records that bring the line of a slot; None: none has."""
        if slot in self.checks:
            return slot
        return OWNERS[self._c.decoder.brought_by[slot]] if slot in self._newest else None

    def messages(self, now_ns: int) -> dict[Owner, SlotStats]:
        """Return the E2E statistics of each owner of records that were received.

        Owners are slots and the pose error, or the messages of whole scenes: each of these has one
        counter and one state for all of its lines.
        """
        stats = {owner: self._stats(owner, now_ns) for owner in self.checks}
        return {owner: known for owner, known in stats.items() if known is not None}

    def pose_error(self, now_ns: int) -> SlotStats | None:
        """Return the E2E statistics of the pose error; None if none was received."""
        return self._stats(POSE, now_ns) if POSE in self.checks else None

    def _check_slot(self, slot: Slot) -> None:
        if slot not in self._slots:
            names = ", ".join(known.name for known in self._slots)
            raise ValueError(f"slot must be one of the DBC's, {names}, got {slot!r}")

    def _stats(self, owner: Owner, now_ns: int) -> SlotStats | None:
        check = self.checks[owner]
        check.elapse(limited_ns(now_ns, "now_ns"))
        return None if check.status is None else check.stats()

    def _counted(self, name: str) -> int:
        with self._lock:
            numbers = ffi.new("maplines_statistics_t *")
            lib.maplines_statistics(self._decoder, numbers)
            return int(getattr(numbers, name))


class _SecuredRoute:
    """What belongs to an authenticated message.

    Args:
        owner: in C.
        data_id: SecOC data ID.
        verifier: with the keys, the clock and the last freshness values.
        asked: buffers of the bytes whose MACs the core asks for, one after the other.
    """

    def __init__(self, owner: int, data_id: int, verifier: Verifier, asked: list[Any]) -> None:
        self.owner, self.data_id, self.asked = owner, data_id, asked
        self.authenticator, self.last_accepted = verifier.authenticator, verifier.last_accepted
        self.key_at = verifier.layout.authentic_bytes - 1


def _payload(data: Any) -> bytes:
    """Return a payload of another type; a number has none, though bytes() takes one."""
    len(data)
    return bytes(data)


def _new_rows(frames: int) -> tuple[Any, tuple[Rows, Rows, Rows]]:
    """Return a ``maplines_rows_t *``, for so many frames if they are not too many, and its arrays.

    The structure does not keep the arrays alive.
    """
    arrays = (
        np.empty(min(frames, _LINES) + _MAX_LINES, LINE_ROW),
        np.empty(min(frames, _COMPONENTS) + _MAX_COMPONENTS, COMPONENT_ROW),
        np.empty(min(frames, _SCENES) + 1, SCENE_ROW),
    )
    memory = [ffi.from_buffer(f"{name}[]", a) for name, a in zip(_ROWS, arrays, strict=True)]
    return ffi.new("maplines_rows_t *", [*memory, *map(len, memory)]), arrays
