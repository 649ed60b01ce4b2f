"""Sender of the cases of test vectors: records of chosen raw values, as frames.

It does not use the encoder: what a receiver makes of any bits is independent of who chose them.
"""

from __future__ import annotations

import random
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace

from ..core import ffi, lib
from ..values.elementary import log2
from ..values.line import Kind, MapLine, Slot
from ..wire.core_tables import tables_of
from ..wire.frames import Frame, FrameWriter
from ..wire.layout.message_layout import AnyLayout, Layout
from ..wire.layout.packing import Packing
from ..wire.layout.pose_layout import SCENE, SCENE2, Owner, number_of
from ..wire.layout.record_signals import (
    LINE,
    PAGE,
    PAGE_BYTES,
    PARAMETER_SIGNALS,
    SLOT,
    TRANSFER_ID,
    Signal,
    slot_title,
)
from ..wire.layout.scene_layout import NoLine, SceneLayout
from ..wire.protection.key import Key
from ..wire.protection.secoc import Authenticator
from ..wire.reception.check import Reason
from .vectors import Case, VectorKey

#: Key of the cases, which is that of RFC 4493.
KEY = VectorKey(bytes.fromhex("2b7e151628aed2a6abf7158809cf4f3c"))
#: Time of the first frame [ns]; of a key, since 1970.
START_NS = 1_750_000_000_000_000_000
MS = 1_000_000
#: Physical values of an ordinary line; a standard deviation is that of a pivot.
ORDINARY = {"YOff": 1.75, "Beta": 0.02, "C0": 1e-3, "C1": 1e-6, "XMin": -8.0, "XMax": 60.0,
            "Age": 16.0, "OwnLateral": -4.0, "OwnPoints": -5.0, "Kind": 1.0, "Status": 1.0,
            "FitBehind": 2.0, "FitAhead": 4.0, "Quartic": 0.0}  # fmt: skip
SIGMAS = {"YOff": 0.1, "Beta": 0.005, "C0": 2e-4, "C1": 4e-6, "Along": 0.3, "Across": 0.1,
          "Heading": 0.003}  # fmt: skip
LEVELS = {"CorrelationTime": 2.0, "MapOffset": 0.03, "MapHeading": 0.001}
#: Signal of a whole scene by which another one joins it.
JOIN = "SceneCounter"
_OF_PLACE = re.compile(rf"^{LINE}\d+")


class VectorSender:
    """Records of a DBC, each with a counter, and the frames that carry them.

    Args:
        layout: of the DBC.
        slots: number of slots that the receiver has.
    """

    def __init__(self, layout: Layout, slots: int) -> None:
        self.layout = layout
        self.slots = [slot for slot in layout.slots if slot < slots]
        #: Owner of the records with the first line.
        self.first: Owner = SCENE if layout.scene else self.slots[0]
        self._tables = tables_of(layout)
        self._writer = FrameWriter(layout, None)
        self._signals = {owner: _signals_of(self.of(owner)) for owner in layout.messages_of}

    def key_of(self, owner: Owner | None = None) -> VectorKey | None:
        """Return the key that a receiver needs: none unless all messages are authenticated."""
        return KEY if self._is_secured(self.first if owner is None else owner) else None

    def of(self, owner: Owner) -> AnyLayout:
        """Return the layout of the records of an owner."""
        return self.layout.record_of(owner)

    def signals(self, owner: Owner) -> Mapping[str, Signal]:
        """Return the signals of a record; those of lines of a whole scene begin with Line1, ..."""
        return self._signals[owner]

    def ordinary(self, owner: Owner) -> dict[str, int]:
        """Return the raw values of an ordinary record."""
        repeated = (PAGE, TRANSFER_ID, "Crc", "Counter")
        raw = {
            name: self._ordinary(signal)
            for name, signal in self.signals(owner).items()
            if not name.startswith(repeated)
        }
        for place, slot in enumerate(self.fixed(owner)):
            raw |= self.line_at(place, slot, None if slot in self.slots else NoLine.NONE)
        return raw

    def fixed(self, owner: Owner) -> tuple[Slot | None, ...]:
        """Return the slots of the places of a record; None if it names them."""
        scene = self.layout.scene
        return () if scene is None or owner not in (SCENE, SCENE2) else scene.fixed[owner]

    def line_at(
        self, place: int, slot: Slot | None, kind: Kind | NoLine | None = None
    ) -> dict[str, int]:
        """Return the raw values of a line of a whole scene: an ordinary one, or that there is none.

        Args:
            place: in the record, from 0.
            slot: of the line.
            kind: another one than that of an ordinary line.
        """
        start = f"{LINE}{place + 1}"
        own = {n: s for n, s in self.signals(self.first).items() if n.startswith(start)}
        raw = dict.fromkeys(own, 0)
        if not isinstance(kind, NoLine):
            raw = {name: self._ordinary(signal) for name, signal in own.items()}
            side = own[f"{start}YOff"]
            raw[side.name] = int(side.limited(side.raw(1.75 - 3.5 * place)))
        if kind is not None:
            raw[f"{start}Kind"] = kind
        if f"{start}{SLOT}" in raw:
            raw[f"{start}{SLOT}"] = 0 if slot is None or kind is NoLine.NONE else slot
        return raw

    def record(
        self,
        owner: Owner,
        counter: int,
        raw: Mapping[str, int] | None = None,
        *,
        is_secured: bool | None = None,
    ) -> bytes:
        """Return a record, whose other raw values are ordinary ones.

        Args:
            owner: of the record.
            counter: of the record; in whole scenes also that which they state.
            raw: values that are not ordinary.
            is_secured: for an authenticated message; by default if there is no other one.
        """
        layout, signals = self.of(owner), self.signals(owner)
        values = {**self.ordinary(owner), **(raw or {})}
        if isinstance(layout, SceneLayout):
            is_secured = self._is_secured(owner) if is_secured is None else is_secured
            length, places = layout.record_bytes, layout.places
            if is_secured:
                length, places = layout.secured_bytes, layout.secured_places
            missing = tuple(f"{LINE}{i + 1}" for i in range(places, layout.places))
            values = {n: value for n, value in values.items() if not n.startswith(missing)}
            values.setdefault(JOIN, 0)
            if JOIN not in (raw or {}):
                values[JOIN] = counter % 2 ** signals[JOIN].length
        else:
            length = PAGE_BYTES * (
                layout.pages if values.get("HasCovariance", 1) else layout.short_pages
            )
        packed = [signals[name] for name in values if signals[name].start < 8 * length]
        pages = -(-length // PAGE_BYTES)
        record = bytearray(Packing(packed, PAGE_BYTES * pages).pack_one(values)[:length])
        number = counter % 2 ** signals["Counter"].length
        lib.maplines_seal_record(
            self._tables, number_of(owner), length, number, ffi.from_buffer("uint8_t[]", record)
        )
        return bytes(record)

    def random_raw(
        self, owner: Owner, rng: random.Random, *, is_ordinary: bool = False
    ) -> dict[str, int]:
        """Return raw values of random bits, of which no receiver refuses the line.

        With an ordinary mean, the line is a function of x in its range, which a scene requires.
        """
        signals = self.signals(owner)
        raw = {
            name: rng.randint(*signals[name].all_raw)
            for name in self.ordinary(owner)
            if not name.startswith("Component")
        }
        if "Status" in raw:
            raw["Status"] %= 6
        if is_ordinary:
            ordinary = self.ordinary(owner)
            raw |= {name: ordinary[name] + raw[name] % 64 for name in PARAMETER_SIGNALS}
        if raw.get("HasCovariance"):
            raw |= {name: 0 for name in raw if name.startswith("Own")}
        if "XMin" in raw:
            raw |= self._with_range(owner, raw, "")
        return raw

    def random_scene(self, owner: Owner, rng: random.Random) -> dict[str, int]:
        """Return raw values of random bits for a whole scene, of which no receiver refuses it."""
        signals = self.signals(owner)
        raw = {name: rng.randint(*signals[name].all_raw) for name in self.ordinary(owner)}
        del raw[JOIN]
        fixed = self.fixed(owner)
        free = [slot for slot in rng.sample(self.slots, len(self.slots)) if slot not in fixed]
        for place, wanted in enumerate(fixed):
            start = f"{LINE}{place + 1}"
            slot = wanted if wanted is not None else free.pop() if free else None
            kind = rng.choice([*Kind, *Kind, *NoLine])
            if slot is None or slot not in self.slots:
                kind = NoLine.NONE
            ordinary = self.line_at(place, slot, kind)
            if isinstance(kind, NoLine):
                raw |= ordinary
                continue
            kept = (f"{start}Kind", f"{start}{SLOT}")
            raw |= {name: ordinary[name] for name in kept if name in raw}
            means = [f"{start}{name}" for name in PARAMETER_SIGNALS]
            raw |= {name: ordinary[name] + raw[name] % 64 for name in means}
            raw |= self._with_range(owner, raw, start)
        return raw

    def frames(
        self, owner: Owner, record: bytes, t_ns: int, *, fd: bool | None = None
    ) -> list[Frame]:
        """Return the frames of a record; by default classic ones if there are such messages."""
        messages = self.layout.messages_of[owner]
        if fd is None:
            fd = messages.can_id is None
        if fd and messages.fd_can_id is None:
            return self.secured_frames(owner, record, t_ns)
        return self._writer.write(record, owner, fd)

    def secured_frames(self, owner: Owner, record: bytes, t_ns: int) -> list[Frame]:
        """Return the authenticated frame of a record, with the freshness value of a time [ns]."""
        authenticator = Authenticator(  # a new one, whose freshness value is that time
            Key(KEY.secret, KEY.key_id), clock=lambda: t_ns, window_ns=KEY.window_ns
        )
        return FrameWriter(self.layout, authenticator).write(record, owner, True)

    def send(
        self,
        case: Case,
        owner: Owner,
        counter: int,
        t_ns: int,
        raw: Mapping[str, int] | None = None,
        *,
        fd: bool | None = None,
    ) -> list[Sequence[MapLine] | Reason]:
        """Send a record to the receiver of a case, its frames 0.2 ms apart; return the answers."""
        frames = self.frames(owner, self.record(owner, counter, raw), t_ns, fd=fd)
        return [
            case.frame(one.can_id, one.data, t_ns + i * MS // 5, is_extended=one.is_extended)
            for i, one in enumerate(frames)
        ]

    def _is_secured(self, owner: Owner) -> bool:
        """Return whether all messages of an owner are authenticated."""
        messages = self.layout.messages_of[owner]
        return messages.can_id is None and messages.fd_can_id is None

    def _with_range(self, owner: Owner, raw: Mapping[str, int], start: str) -> dict[str, int]:
        """Return the range of a line of this start of names, or the longest one if it is empty."""
        names = [f"{start}XMin", f"{start}XMax"]
        low, high = (self.signals(owner)[name] for name in names)
        given = [raw[name] for name in names]
        is_empty = low.physical_one(given[0]) >= high.physical_one(given[1])
        return dict(zip(names, [low.raw_min, high.raw_max] if is_empty else given, strict=True))

    def _ordinary(self, signal: Signal) -> int:
        """Return the raw value of a signal in an ordinary record."""
        name, physical = _OF_PLACE.sub("", signal.name), 0.0
        for title in map(slot_title, Slot):
            name = name.removeprefix(title) if name != title else name
        if name in ORDINARY:
            physical = ORDINARY[name]
        elif name == "ComponentWeight":
            return signal.raw_max
        elif name.startswith("Component") or name in ("Counter", "HasCovariance"):
            return 0
        elif name == "OwnShape":
            return (signal.raw_min + signal.raw_max) // 2
        elif name in LEVELS or name.startswith("Pivot"):
            sigma = LEVELS.get(name) or SIGMAS[name.removeprefix("Pivot")]
            physical = float(log2([sigma])[0])
        raw = round((physical - signal.offset) / signal.factor)
        return min(max(raw, signal.raw_min), signal.raw_max)


def _signals_of(layout: AnyLayout) -> dict[str, Signal]:
    """Return the signals of a record; those of lines of a whole scene begin with Line1, ..."""
    if not isinstance(layout, SceneLayout):
        return {**layout.signals}
    fixed = layout.fixed[SCENE]
    lines = {
        f"{LINE}{place + 1}{name}": signal
        for place, slot in enumerate(fixed)
        for name, signal in layout.at(place).items()
        if name != SLOT or slot is None
    }
    starts = {signal.start for signal in lines.values()}
    shared = {name: s for name, s in layout.signals.items() if s.start not in starts}
    return shared | {name: replace(s, name=name, prefix="") for name, s in lines.items()}
