"""Sender of the cases of test vectors: records of chosen raw values, as frames.

It does not use the encoder: what a receiver makes of any bits is independent of who chose them.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence

from ..core import ffi, lib
from ..values.elementary import log2
from ..values.errors import LayoutError
from ..values.line import MapLine, Slot
from ..wire.layout.message_layout import Layout
from ..wire.layout.packing import Packing
from ..wire.layout.pose_layout import POSE, Owner, PoseLayout, number_of
from ..wire.layout.signals import (
    PAGE,
    PAGE_BYTES,
    PARAMETER_SIGNALS,
    TRANSFER_ID,
    Signal,
    slot_title,
)
from ..wire.protection.key import Key
from ..wire.protection.secoc import Authenticator
from ..wire.reasons import Reason
from ..wire.records.frames import Frame, FrameWriter
from ..wire.tables import tables_of
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


class VectorSender:
    """Records of a DBC, each with a counter, and the frames that carry them.

    Args:
        layout: of the DBC.
        slots: number of slots that the receiver has.
    """

    def __init__(self, layout: Layout, slots: int) -> None:
        self.layout = layout
        self.slots = [slot for slot in layout.messages if slot < slots]
        self._tables = tables_of(layout)
        self._writer = FrameWriter(layout, None)

    def key_of(self, owner: Owner | None = None) -> VectorKey | None:
        """Return the key that a receiver needs: none unless all messages are authenticated."""
        messages = self.layout.messages_of[self.slots[0] if owner is None else owner]
        return KEY if messages.can_id is None and messages.fd_can_id is None else None

    def of(self, owner: Owner) -> Layout | PoseLayout:
        """Return the layout of the records of an owner."""
        if owner != POSE:
            return self.layout
        if self.layout.pose is None:
            raise LayoutError(f"{self.layout.source} has no message of the pose error")
        return self.layout.pose

    def ordinary(self, owner: Owner) -> dict[str, int]:
        """Return the raw values of an ordinary record."""
        layout = self.of(owner)
        repeated = (PAGE, TRANSFER_ID, "Crc", "Counter")
        return {
            name: self._ordinary(signal)
            for name, signal in layout.signals.items()
            if not name.startswith(repeated)
        }

    def record(self, owner: Owner, counter: int, raw: Mapping[str, int] | None = None) -> bytes:
        """Return a record, whose other raw values are ordinary ones."""
        layout = self.of(owner)
        values = {**self.ordinary(owner), **(raw or {})}
        length = PAGE_BYTES * (
            layout.pages if values.get("HasCovariance", 1) else layout.short_pages
        )
        signals = [layout[name] for name in values if layout[name].start < 8 * length]
        record = bytearray(Packing(signals, length).pack_one(values))
        number = counter % 2 ** layout["Counter"].length
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
        signals = self.of(owner).signals
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
            low, high = (signals[name] for name in ("XMin", "XMax"))
            if low.physical_one(raw["XMin"]) >= high.physical_one(raw["XMax"]):
                raw |= {"XMin": low.raw_min, "XMax": high.raw_max}
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

    def _ordinary(self, signal: Signal) -> int:
        """Return the raw value of a signal in an ordinary record."""
        name, physical = signal.name, 0.0
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
