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
from typing import Any, Generic, NamedTuple, Protocol, Self, TypeVar

from ..wire import Frame
from .faults import Faults, id_range
from .scripted_fault import DAMAGES, LAST_ID, LENGTHS, FaultKind, ScriptedFault

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


class _Rates(NamedTuple):
    """Faults that are active at the same time."""

    faults: Faults
    damages: list[tuple[float, FaultKind]]  #: cumulative rates

    @classmethod
    def of(cls, faults: Faults) -> _Rates:
        rates = accumulate(getattr(faults, kind.value) for kind in DAMAGES)
        return cls(faults, list(zip(rates, DAMAGES, strict=True)))


class FaultInjector(Generic[F]):
    """Injector of the faults of ``Faults`` into a stream of frames, with counters.

    The same frames and times give the same faults for the same seed.  At any time
    ``frames + counts[DUPLICATED] + counts[FLOODED] == passed + counts[LOST] + held``.
    A fault without effect, such as a flipped bit in an empty frame, is not counted.

    The intervals of the faults, and a flood, begin with the first call of `apply` or `due`, or of
    `start`. The faults may be changed at any time; see `faults`.

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
        self._stream, self._make_frame = stream, make_frame
        # Heaps of (frame number or time [s] of release, sequence number, frame).
        self._reordered: list[tuple[int, int, F]] = []
        self._delayed: list[tuple[float, int, F]] = []
        self._sequence = 0
        self.frames = 0  #: frames taken
        self.passed = 0  #: frames returned, those of a flood included
        self.left_out = 0  #: frames of a flood that were not asked for in time
        self.counts: Counter[FaultKind] = Counter()  #: faults injected so far
        self.faults = faults

    @property
    def faults(self) -> Faults:
        """The faults that are injected.

        If they are set, the new ones begin: their seed, their intervals, and the frames that their
        script counts. Frames that are held back remain so, and the counters go on.
        """
        return self._faults

    @faults.setter
    def faults(self, faults: Faults) -> None:
        self._faults = faults
        self._random = Random(f"{faults.seed} {self._stream}")  # noqa: S311 - not a secret
        self._changes = faults.changes
        self._rates = [_Rates.of(faults.at(time)) for time in self._changes]
        self._script_start = self.frames
        self._last_scripted = max((fault.last for fault in faults.script), default=0)
        self._flood_ids = [id_range(ids) for ids in faults.flood_ids]
        self._flood_ends = list(accumulate(map(len, self._flood_ids)))
        self._flood_times: list[tuple[float, float]] = []
        self._flood_at = math.inf
        self._start: float | None = None

    def start(self, now: float) -> None:
        """Begin the intervals of the faults and the flood at this time [s]."""
        self._start = now
        if self._faults.flood:
            self._flood_times = [(now + a, now + b) for a, b in self._faults.intervals("flood")]
            self._flood_at = self._next_flood(now)

    @property
    def held(self) -> int:
        """Number of frames that are held back."""
        return len(self._reordered) + len(self._delayed)

    @property
    def next_due(self) -> float:
        """Time at which `due` returns the next frame [s]; infinite if there is none."""
        return min(self._delayed[0][0], self._flood_at) if self._delayed else self._flood_at

    def apply(self, frame: F, now: float = 0.0) -> list[F]:
        """Take a frame; return the frames that are passed on at this moment, in order.

        Args:
            frame: a data frame.
            now: on any monotonic clock [s]; needed for delays, floods and intervals only.
        """
        self.frames += 1
        out: list[F] = []
        self._release(now, out)
        rates = self._rates_at(now)
        if self._apply_script(frame, now, out):
            pass
        elif self._random.random() < rates.faults.loss:
            self.counts[FaultKind.LOST] += 1
        else:
            self._pass_on(frame, now, rates, out)
            if self._random.random() < rates.faults.duplicate:
                self.counts[FaultKind.DUPLICATED] += 1
                self._pass_on(frame, now, rates, out)
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

    def _rates_at(self, now: float) -> _Rates:
        """Return the rates at a time [s]; the first ones for one before the start."""
        elapsed = now - (now if self._start is None else self._start)
        return self._rates[max(0, bisect_right(self._changes, elapsed) - 1)]

    def _pass_on(self, frame: F, now: float, rates: _Rates, out: list[F]) -> None:
        """Pass one copy on, damaged or not, now or later."""
        faults, draw = rates.faults, self._random.random
        number = draw()
        kind = next((kind for rate, kind in rates.damages if number < rate), None)
        if kind is not None:
            frame = self._damaged(frame, kind, None)
        if draw() < faults.reorder:
            self._hold(frame, None)
        elif (faults.delay > 0 or faults.jitter > 0) and draw() < faults.late:
            self._delay(frame, now, faults, None)
        else:
            out.append(frame)

    def _release(self, now: float, out: list[F]) -> None:
        if self._start is None:
            self.start(now)
        while self._delayed and self._delayed[0][0] <= now:
            out.append(heapq.heappop(self._delayed)[2])
        if self._flood_at <= now:
            out += self._flood(now)

    def _next_flood(self, time: float) -> float:
        """Return the time of the first frame of the flood that is not before a time [s]."""
        step = 1 / self._faults.flood
        for begin, end in self._flood_times:
            if (first := max(time, begin + step)) < end:
                return first
        return math.inf

    def _flood(self, now: float) -> list[F]:
        step = 1 / self._faults.flood
        while self._flood_at < now - FLOOD_MAX_AGE:
            end = next(end for _, end in self._flood_times if self._flood_at < end)
            missed = math.ceil((min(now - FLOOD_MAX_AGE, end) - self._flood_at) / step)
            self.left_out += missed
            self._flood_at = self._next_flood(self._flood_at + missed * step)
        made: list[F] = []
        while self._flood_at <= now and len(made) < FLOOD_BATCH:
            number = int(self._random.random() * self._flood_ends[-1])
            index = bisect_right(self._flood_ends, number)
            can_id = self._flood_ids[index][number - self._flood_ends[index]]
            data = self._random.randbytes(8)
            made.append(self._make_frame(can_id, data, False, can_id > LAST_ID))
            self._flood_at = self._next_flood(self._flood_at + step)
        self.counts[FaultKind.FLOODED] += len(made)
        return made

    # ---- script --------------------------------------------------------------------

    def _apply_script(self, frame: F, now: float, out: list[F]) -> bool:
        """Inject the scripted faults of this frame; return False if there are none."""
        number = self.frames - self._script_start
        if number > self._last_scripted:
            return False
        faults = [f for f in self._faults.script if f.first <= number <= f.last]
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
            self._delay(frame, now, self._faults, held[-1].value)
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

    def _delay(self, frame: F, now: float, faults: Faults, delay: float | None) -> None:
        if delay is None:
            delay = faults.delay + faults.jitter * self._random.random()
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
