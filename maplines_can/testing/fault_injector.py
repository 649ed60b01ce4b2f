"""Inject faults into a stream of frames; time and seed are arguments.

Lost and duplicated frames are real on CAN: a queue overflows, and a sender that misses the
last bit of a frame that others received sends it again.  Flipped bits are rare:
each frame has a checksum of its own, and the controller drops a frame that violates it.  They
represent faults behind the controllers, in gateways, drivers and memory, against which the
record has its checksum.
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

from ..wire import Frame
from .faults import DAMAGES, LAST_ID, LENGTHS, FaultKind, Faults, ScriptedFault, id_range

__all__ = ["FaultInjector"]

#: Frames of a flood that are older than this are not made [s].
FLOOD_MAX_AGE = 1.0
#: Most frames of a flood that one call returns, so that the caller is not blocked.
FLOOD_BATCH = 32


class FrameLike(Protocol):
    """Named tuple with the fields of ``wire.Frame``; other fields are kept as they are.

    `FaultyBus` passes the ``can.Message`` of a frame along in this way.
    """

    @property
    def can_id(self) -> int:
        """11 or 29 bits."""

    @property
    def data(self) -> bytes:
        """Payload."""

    @property
    def is_fd(self) -> bool:
        """Whether it is a CAN FD frame."""

    @property
    def is_extended(self) -> bool:
        """Whether the CAN ID has 29 bits."""

    @property
    def _replace(self) -> Callable[..., Self]: ...


F = TypeVar("F", bound=FrameLike)


class FaultInjector(Generic[F]):
    """Injector of the faults of ``Faults`` into a stream of frames, with counters.

    The same frames and times give the same faults for the same seed.  At any time
    ``frames + counts[DUPLICATED] + counts[FLOODED] == passed + counts[LOST] + held``.
    A fault without effect, such as a flipped bit in an empty frame, is not counted.

    Args:
        faults: rates, script and seed.
        stream: name of the stream; streams of different names get different random numbers.
        make_frame: makes the frames of a flood from CAN ID, payload, is_fd and is_extended.

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
        make_frame: Callable[[int, bytes, bool, bool], Any] = Frame,
    ) -> None:
        self._faults, self._make_frame = faults, make_frame
        self._random = Random(f"{faults.seed} {stream}")  # noqa: S311 - not a secret
        rates = accumulate(getattr(faults, kind.value) for kind in DAMAGES)
        self._damages = list(zip(rates, DAMAGES, strict=True))  # cumulative rates
        self._delays = faults.delay > 0 or faults.jitter > 0
        self._last_scripted = max((fault.last for fault in faults.script), default=0)
        # Heaps of (frame number or time [s] of release, sequence number, frame).
        self._reordered: list[tuple[int, int, F]] = []
        self._delayed: list[tuple[float, int, F]] = []
        self._sequence = 0
        self._flood_at: float | None = None
        self._flood_ids = [id_range(ids) for ids in faults.flood_ids]
        self._flood_ends = list(accumulate(map(len, self._flood_ids)))
        self.frames = 0  #: frames taken
        self.passed = 0  #: frames returned, those of a flood included
        self.left_out = 0  #: frames of a flood that were not asked for in time
        self.counts: Counter[FaultKind] = Counter()  #: faults injected so far

    @property
    def held(self) -> int:
        """Number of frames that are held back."""
        return len(self._reordered) + len(self._delayed)

    @property
    def next_due(self) -> float:
        """Time at which `due` returns the next frame [s]; infinite if there is none."""
        flood = math.inf if self._flood_at is None else self._flood_at
        return min(self._delayed[0][0], flood) if self._delayed else flood

    def apply(self, frame: F, now: float = 0.0) -> list[F]:
        """Take a frame; return the frames that are passed on at this moment, in order.

        Args:
            frame: a data frame.
            now: on any monotonic clock [s]; needed for delays and floods only.
        """
        self.frames += 1
        out: list[F] = []
        self._release(now, out)
        scripted = self.frames <= self._last_scripted and self._apply_script(frame, now, out)
        if not scripted and self._random.random() < self._faults.loss:
            self.counts[FaultKind.LOST] += 1
        elif not scripted:
            self._pass_on(frame, now, out)
            if self._random.random() < self._faults.duplicate:
                self.counts[FaultKind.DUPLICATED] += 1
                self._pass_on(frame, now, out)
        while self._reordered and self._reordered[0][0] <= self.frames:
            out.append(heapq.heappop(self._reordered)[2])
        self.passed += len(out)
        return out

    def due(self, now: float) -> list[F]:
        """Return the delayed frames and the frames of the flood that are due by ``now`` [s].

        One call returns at most 32 frames of a flood; more are due while ``next_due <= now``.
        Frames of a flood that were due more than a second ago are left out.
        """
        out: list[F] = []
        self._release(now, out)
        self.passed += len(out)
        return out

    def flush(self) -> list[F]:
        """Return all frames that are held back, at the end of a stream."""
        out = [frame for *_, frame in (*sorted(self._reordered), *sorted(self._delayed))]
        self._reordered.clear()
        self._delayed.clear()
        self.passed += len(out)
        return out

    def as_dict(self) -> dict[str, int]:
        """Return all counters, for JSON."""
        faults = {kind.name.lower(): self.counts[kind] for kind in FaultKind}
        sums = {"frames": self.frames, "passed": self.passed, "held": self.held}
        return {**sums, **faults, "left_out": self.left_out}

    # ---- rates ---------------------------------------------------------------------

    def _pass_on(self, frame: F, now: float, out: list[F]) -> None:
        """Pass one copy on, damaged or not, now or later."""
        faults, draw = self._faults, self._random.random
        number = draw()
        kind = next((kind for rate, kind in self._damages if number < rate), None)
        if kind is not None:
            frame = self._damaged(frame, kind, None)
        if draw() < faults.reorder:
            self._hold(frame, None)
        elif self._delays and draw() < faults.late:
            self._delay(frame, now, None)
        else:
            out.append(frame)

    def _release(self, now: float, out: list[F]) -> None:
        while self._delayed and self._delayed[0][0] <= now:
            out.append(heapq.heappop(self._delayed)[2])
        if self._faults.flood:
            out += self._flood(now)

    def _flood(self, now: float) -> list[F]:
        step = 1 / self._faults.flood
        if self._flood_at is None:  # the flood starts with the first call
            self._flood_at = now + step
        late = now - FLOOD_MAX_AGE - self._flood_at
        if late > 0:
            missed = math.ceil(late / step)
            self.left_out += missed
            self._flood_at += missed * step
        made: list[F] = []
        while self._flood_at <= now and len(made) < FLOOD_BATCH:
            number = int(self._random.random() * self._flood_ends[-1])
            index = bisect_right(self._flood_ends, number)
            can_id = self._flood_ids[index][number - self._flood_ends[index]]
            data = self._random.randbytes(8)
            made.append(self._make_frame(can_id, data, False, can_id > LAST_ID))
            self._flood_at += step
        self.counts[FaultKind.FLOODED] += len(made)
        return made

    # ---- script --------------------------------------------------------------------

    def _apply_script(self, frame: F, now: float, out: list[F]) -> bool:
        """Inject the scripted faults of this frame; return False if there are none."""
        faults = [f for f in self._faults.script if f.first <= self.frames <= f.last]
        kinds = {fault.kind for fault in faults}
        if FaultKind.LOST in kinds:
            self.counts[FaultKind.LOST] += 1
            return True
        for fault in faults:
            if fault.kind in DAMAGES:
                frame = self._damaged(frame, fault.kind, fault.value)
        if FaultKind.DUPLICATED in kinds:
            self.counts[FaultKind.DUPLICATED] += 1
            out.append(frame)
        held = [f for f in faults if f.kind in (FaultKind.REORDERED, FaultKind.DELAYED)]
        if held and held[-1].kind is FaultKind.REORDERED:
            self._hold(frame, held[-1])
        elif held:
            self._delay(frame, now, held[-1])
        elif faults:
            out.append(frame)
        return bool(faults)

    # ---- single faults -------------------------------------------------------------

    def _hold(self, frame: F, fault: ScriptedFault | None) -> None:
        places = fault.value if fault else None
        if places is None:
            places = 1 + int(self._random.random() * self._faults.depth)
        self.counts[FaultKind.REORDERED] += 1
        self._sequence += 1
        heapq.heappush(self._reordered, (self.frames + int(places), self._sequence, frame))

    def _delay(self, frame: F, now: float, fault: ScriptedFault | None) -> None:
        delay = fault.value if fault else None
        if delay is None:
            delay = self._faults.delay + self._faults.jitter * self._random.random()
        self.counts[FaultKind.DELAYED] += 1
        self._sequence += 1
        heapq.heappush(self._delayed, (now + delay, self._sequence, frame))

    def _damaged(self, frame: F, kind: FaultKind, value: float | None) -> F:
        number = None if value is None else int(value)
        if kind is FaultKind.WRONG_ID:
            bit = 1 << int(self._random.random() * (29 if frame.is_extended else 11))
            can_id = frame.can_id ^ bit if number is None else number
            changes: dict[str, Any] = {"can_id": can_id}
            changes["is_extended"] = frame.is_extended or can_id > LAST_ID
        else:
            changes = {"data": self._damaged_data(frame, kind, number)}
        damaged = frame._replace(**changes)
        if damaged == frame:
            return frame
        self.counts[kind] += 1
        return damaged

    def _damaged_data(self, frame: F, kind: FaultKind, number: int | None) -> bytes:
        data = frame.data
        if kind is FaultKind.GARBAGE:
            return self._random.randbytes(len(data))
        if kind is FaultKind.FLIPPED:
            return self._flip_bits(data, number)
        if kind is FaultKind.TRUNCATED:
            return data[: self._choose([n for n in LENGTHS if n < len(data)], number)]
        longest = LENGTHS[-1] if frame.is_fd else 8
        lengths = [n for n in LENGTHS if n <= longest and n != len(data)]
        length = min(self._choose(lengths, number), longest)
        return data[:length].ljust(length, b"\0")

    def _flip_bits(self, data: bytes, bits: int | None) -> bytes:
        if bits is None:
            bits = 1 + int(self._random.random() * self._faults.flip_bits)
        flips: set[int] = set()
        while len(flips) < min(bits, 8 * len(data)):
            flips.add(int(self._random.random() * 8 * len(data)))
        number = int.from_bytes(data, "little")
        for bit in flips:
            number ^= 1 << bit
        return number.to_bytes(len(data), "little")

    def _choose(self, numbers: list[int], given: int | None) -> int:
        if given is not None:
            return given
        return numbers[int(self._random.random() * len(numbers))] if numbers else 0
