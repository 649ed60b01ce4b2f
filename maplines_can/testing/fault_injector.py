"""What a bad bus does to a stream of frames: pure, with time and seed as arguments.

Lost and repeated frames are real on CAN: a queue overruns, and a sender that misses the
last bit of a frame that the others took sends it again.  Flipped bits are not, or hardly:
each frame has a checksum of its own, and a controller drops what breaks it.  They stand
for what happens behind the controllers, in gateways, drivers and memory, which is
what the checksum of the record is for.
"""

from __future__ import annotations

import heapq
import math
from bisect import bisect_right
from collections import Counter
from collections.abc import Callable
from itertools import accumulate
from random import Random
from typing import Any, Generic, Protocol, Self, TypeVar

from ..bus.tx_queue import FrameLike
from ..wire import Frame
from .faults import DAMAGES, LAST_ID, LENGTHS, Action, FaultKind, Faults, range_of

__all__ = ["FaultInjector"]

#: Of a flood that nobody asked for in this time, what is older is left out [s].
FLOOD_KEPT = 1.0
#: Most frames of a flood that come out at once, so that what asks for them stays its own master.
FLOOD_BATCH = 32


class _Frame(FrameLike, Protocol):
    """A frame that is a named tuple, such as ``wire.Frame``; other fields are carried along."""

    @property
    def _replace(self) -> Callable[..., Self]: ...


F = TypeVar("F", bound=_Frame)


class FaultInjector(Generic[F]):
    """Does to a stream of frames what `Faults` say, frame by frame, and counts it.

    The same frames and times from the same seed suffer the same. At any time
    ``frames + counts[DUPLICATED] + counts[FLOODED] == passed + counts[LOST] + held``.
    A fault that changes nothing, such as a flipped bit in an empty frame, is not counted.

    Args:
        faults: rates, script and seed.
        stream: a name; streams of different names suffer differently from one seed.
        frame: makes the frames of a flood from CAN ID, payload, is_fd and is_extended.

    >>> injector = FaultInjector(Faults.parse("reorder=0.3,depth=2,seed=1"))
    >>> out = [f.can_id for i in range(9) for f in injector.apply(Frame(i, b"data"))]
    >>> out, injector.held, injector.counts[FaultKind.REORDERED]
    ([0, 1, 3, 4, 2, 5, 6, 7, 8], 0, 1)
    """

    def __init__(
        self,
        faults: Faults,
        *,
        stream: str = "",
        frame: Callable[[int, bytes, bool, bool], Any] = Frame,
    ) -> None:
        self._faults, self._make = faults, frame
        self._random = Random(f"{faults.seed} {stream}")  # noqa: S311 - not a secret
        rates = accumulate(getattr(faults, what.value) for what in DAMAGES)
        self._damages = list(zip(rates, DAMAGES, strict=True))
        self._damage = self._damages[-1][0]
        self._delays = faults.delay > 0 or faults.jitter > 0
        self._last_scripted = max((action.last for action in faults.script), default=0)
        self._behind: list[tuple[int, int, F]] = []  # heaps: until which frame, number of the entry
        self._late: list[tuple[float, int, F]] = []  # until when [s]
        self._entries = 0
        self._flood_at: float | None = None
        self._flood_ids = [range_of(ids) for ids in faults.flood_ids]
        self._flood_ends = list(accumulate(map(len, self._flood_ids)))
        self.frames = 0  #: given
        self.passed = 0  #: handed out, those of a flood included
        self.left_out = 0  #: frames of a flood that nobody asked for in time
        self.counts: Counter[FaultKind] = Counter()  #: what was done

    @property
    def held(self) -> int:
        """Frames that are held back."""
        return len(self._behind) + len(self._late)

    @property
    def next_due(self) -> float:
        """When `due` has something to hand out [s]; infinite if never."""
        flood = math.inf if self._flood_at is None else self._flood_at
        return min(self._late[0][0], flood) if self._late else flood

    def apply(self, frame: F, now: float = 0.0) -> list[F]:
        """Take a frame; returns what comes out at this moment, in order.

        Args:
            frame: a data frame.
            now: on any clock that goes on [s]; of use for delays and floods only.
        """
        self.frames += 1
        out: list[F] = []
        self._release(now, out)
        scripted = self.frames <= self._last_scripted and self._scripted(frame, now, out)
        if not scripted and self._random.random() < self._faults.loss:
            self.counts[FaultKind.LOST] += 1
        elif not scripted:
            self._let(frame, now, out)
            if self._random.random() < self._faults.duplicate:
                self.counts[FaultKind.DUPLICATED] += 1
                self._let(frame, now, out)
        while self._behind and self._behind[0][0] <= self.frames:
            out.append(heapq.heappop(self._behind)[2])
        self.passed += len(out)
        return out

    def due(self, now: float) -> list[F]:
        """What comes out by ``now`` [s] though no frame came: delayed ones and the flood.

        Of a flood 32 frames come at most; more are there while ``next_due <= now``.  What
        was due more than a second ago is left out.
        """
        out: list[F] = []
        self._release(now, out)
        self.passed += len(out)
        return out

    def flush(self) -> list[F]:
        """All that is held back, at the end of a stream."""
        out = [frame for *_, frame in (*sorted(self._behind), *sorted(self._late))]
        self._behind.clear()
        self._late.clear()
        self.passed += len(out)
        return out

    def as_dict(self) -> dict[str, int]:
        """All counters, for machines: what went in and out, and what was done."""
        done = {what.name.lower(): self.counts[what] for what in FaultKind}
        sums = {"frames": self.frames, "passed": self.passed, "held": self.held}
        return {**sums, **done, "left_out": self.left_out}

    # ---- rates ---------------------------------------------------------------------

    def _let(self, frame: F, now: float, out: list[F]) -> None:
        """Let one copy go on: damaged or not, now or later."""
        faults, draw = self._faults, self._random.random
        fate = draw()
        if fate < self._damage:
            what = next(what for rate, what in self._damages if fate < rate)
            frame = self._damaged(frame, what, None)
        if draw() < faults.reorder:
            self._hold(frame, None)
        elif self._delays and draw() < faults.late:
            self._delay(frame, now, None)
        else:
            out.append(frame)

    def _release(self, now: float, out: list[F]) -> None:
        while self._late and self._late[0][0] <= now:
            out.append(heapq.heappop(self._late)[2])
        if self._faults.flood:
            out += self._flood(now)

    def _flood(self, now: float) -> list[F]:
        step = 1 / self._faults.flood
        if self._flood_at is None:  # the first call starts the clock
            self._flood_at = now + step
        late = now - FLOOD_KEPT - self._flood_at
        if late > 0:
            missed = math.ceil(late / step)
            self.left_out += missed
            self._flood_at += missed * step
        made: list[F] = []
        while self._flood_at <= now and len(made) < FLOOD_BATCH:
            number = int(self._random.random() * self._flood_ends[-1])
            part = bisect_right(self._flood_ends, number)
            can_id = self._flood_ids[part][number - self._flood_ends[part]]
            made.append(self._make(can_id, self._random.randbytes(8), False, can_id > LAST_ID))
            self._flood_at += step
        self.counts[FaultKind.FLOODED] += len(made)
        return made

    # ---- script --------------------------------------------------------------------

    def _scripted(self, frame: F, now: float, out: list[F]) -> bool:
        """Do what the script says of this frame; False if it says nothing."""
        actions = [a for a in self._faults.script if a.first <= self.frames <= a.last]
        whats = {action.what for action in actions}
        if FaultKind.LOST in whats:
            self.counts[FaultKind.LOST] += 1
            return True
        for action in actions:
            if action.what in DAMAGES:
                frame = self._damaged(frame, action.what, action.value)
        if FaultKind.DUPLICATED in whats:
            self.counts[FaultKind.DUPLICATED] += 1
            out.append(frame)
        held = [a for a in actions if a.what in (FaultKind.REORDERED, FaultKind.DELAYED)]
        if held and held[-1].what is FaultKind.REORDERED:
            self._hold(frame, held[-1])
        elif held:
            self._delay(frame, now, held[-1])
        elif actions:
            out.append(frame)
        return bool(actions)

    # ---- what is done --------------------------------------------------------------

    def _hold(self, frame: F, action: Action | None) -> None:
        places = action.value if action else None
        if places is None:
            places = 1 + int(self._random.random() * self._faults.depth)
        self.counts[FaultKind.REORDERED] += 1
        self._entries += 1
        heapq.heappush(self._behind, (self.frames + int(places), self._entries, frame))

    def _delay(self, frame: F, now: float, action: Action | None) -> None:
        delay = action.value if action else None
        if delay is None:
            delay = self._faults.delay + self._faults.jitter * self._random.random()
        self.counts[FaultKind.DELAYED] += 1
        self._entries += 1
        heapq.heappush(self._late, (now + delay, self._entries, frame))

    def _damaged(self, frame: F, what: FaultKind, value: float | None) -> F:
        number = None if value is None else int(value)
        if what is FaultKind.WRONG_ID:
            bit = 1 << int(self._random.random() * (29 if frame.is_extended else 11))
            can_id = frame.can_id ^ bit if number is None else number
            changes: dict[str, Any] = {"can_id": can_id}
            changes["is_extended"] = frame.is_extended or can_id > LAST_ID
        else:
            changes = {"data": self._damaged_data(frame, what, number)}
        damaged = frame._replace(**changes)
        if damaged == frame:
            return frame
        self.counts[what] += 1
        return damaged

    def _damaged_data(self, frame: F, what: FaultKind, number: int | None) -> bytes:
        data = frame.data
        if what is FaultKind.GARBAGE:
            return self._random.randbytes(len(data))
        if what is FaultKind.FLIPPED:
            return self._flipped(data, number)
        if what is FaultKind.TRUNCATED:
            number = self._one_of([n for n in LENGTHS if n < len(data)], number)
            return data[:number]
        most = LENGTHS[-1] if frame.is_fd else 8
        number = self._one_of([n for n in LENGTHS if n <= most and n != len(data)], number)
        return data[: min(number, most)].ljust(min(number, most), b"\0")

    def _flipped(self, data: bytes, bits: int | None) -> bytes:
        if bits is None:
            bits = 1 + int(self._random.random() * self._faults.flip_bits)
        flips: set[int] = set()
        while len(flips) < min(bits, 8 * len(data)):
            flips.add(int(self._random.random() * 8 * len(data)))
        number = int.from_bytes(data, "little")
        for bit in flips:
            number ^= 1 << bit
        return number.to_bytes(len(data), "little")

    def _one_of(self, numbers: list[int], given: int | None) -> int:
        if given is not None:
            return given
        return numbers[int(self._random.random() * len(numbers))] if numbers else 0
