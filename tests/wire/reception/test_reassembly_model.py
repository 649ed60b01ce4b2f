"""Reassembly against a simple model: a sender, a bus with faults, and the rules of delivery.

The model knows which frames reached the receiver, and when. A line may be delivered only if it was
sent, bit for bit, and all its frames were received within the time-out; not twice and not out of
order, as long as the counters can tell and the slot is not silent, or old lines alone are received
for more than a cycle. A line on an undisturbed bus is delivered.
"""

from typing import Any, NamedTuple

import numpy as np
from answers import one
from dbcs import default_codec
from hypothesis import note, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import MapLine, Slot
from maplines_can.values.mixture import GaussianMixture
from maplines_can.wire import Reason

MS = 1_000_000
TIMEOUT = 25 * MS
FRAME = MS // 4
#: Records are numbered modulo 256: of two that are less than 128 apart the newer is known.
TOLD_APART = 127
#: So many records may be lost at once, however short the time.
MAX_DELTA = 16
#: After so long without news an old line passes for news; and after so long of nothing but such.
SILENCE, TAKEN_OVER = 500 * MS, 75 * MS
SLOTS = st.sampled_from([Slot.EGO_LEFT, Slot.ROUTE])
PLACES = st.integers(0, 2**16)


class OnAir(NamedTuple):
    """A frame on its way: of which line; None where it is damaged."""

    frame: Any
    line: int | None


class Sent(NamedTuple):
    """What the model knows of a line."""

    slot: Slot
    bits: bytes  #: as it decodes alone
    frames: list[Any]
    records: range  #: numbers of its records among those of its slot


def bits_of(line: Any) -> Any:
    """All of a line that was decoded but for its time."""
    parts = line.mixture.components if line.mixture else ()
    gaussians = [g for part in (line.gaussian, *parts) for g in (part.mean, part.cov)]
    weights = [line.mixture.weights] if line.mixture else []
    header = (line.slot, line.kind, line.x_min, line.x_max, line.age, line.status)
    return repr(header).encode() + b"".join(a.tobytes() for a in (*gaussians, *weights))


class Bus(RuleBasedStateMachine):
    """The rules; ``feed`` is where the model checks."""

    def __init__(self) -> None:
        super().__init__()
        self.codec = default_codec()
        self.decoder = self.codec.decoder(timeout_ms=TIMEOUT / MS)
        self.now = self.last = 10**12  # and the greatest time of a frame
        self.air: list[Any] = []
        self.sent: list[Any] = []
        self.first = 0  # first line since the last restart
        self.records = dict.fromkeys(Slot, 0)  # of each slot so far
        self.counter = dict.fromkeys(Slot, 0)  # of the next record
        self.epoch = dict.fromkeys(Slot, 0)
        self.restarting = set[Slot]()  # restarted, and nothing heard since
        self.restarted = dict.fromkeys(Slot, 0)  # when the first frame after it came
        self.received_up_to = dict.fromkeys(Slot, 0)  # record after the last delivered line
        self.heard: dict[Any, Any] = {}  # frames as they came, and when
        self.newest = dict.fromkeys(Slot, 0)  # record of which a frame came
        self.delivered = {slot: list[Any]() for slot in Slot}  # (line, time of its first frame)
        self.since = {
            slot: dict[Any, Any]() for slot in Slot
        }  # lines heard since the last delivered, and when
        self.fed = 0

    # -- the sender ----------------------------------------------------------------

    def send_line(self, slot: Any, parts: Any, fd: Any) -> Any:
        number = len(self.sent)
        mean = np.array([number / 1024 - 16, 0.01, 1e-3, 1e-5])
        cov = np.diag([0.1, 0.01, 1e-3, 1e-4]) ** 2
        shifts = np.arange(parts) * np.array([[0.1], [0], [0], [0]])
        gaussians = tuple(Gaussian(mean + shift, cov) for shift in shifts.T)
        mixture = GaussianMixture(np.full(parts, 1 / parts), gaussians)
        weights, means, covs = mixture.weights[None], mixture.means[None], mixture.covs[None]
        first = self.counter[slot]
        payloads = self.codec.batch.encode_mixtures(weights, means, covs, slot=slot, counter=first)[
            0
        ]
        frames = [
            f for payload in payloads for f in self.codec.encoder().frames(payload, slot, fd=fd)
        ]
        alone = self.codec.decoder()
        *_, line = (one(alone.feed(f.can_id, f.data, 0)) for f in frames)
        records = range(self.records[slot], self.records[slot] + parts)
        self.sent.append(Sent(slot, bits_of(line), frames, records))
        self.records[slot] += parts
        self.counter[slot] = (first + parts) % 256
        return [OnAir(frame, number) for frame in frames]

    @rule(slot=SLOTS, fd=st.booleans())
    def send(self, slot: Any, fd: Any) -> None:
        self.air += self.send_line(slot, 1, fd)

    @rule(slot=SLOTS, parts=st.sampled_from([2, 4, 8]), fd=st.booleans())
    def send_mixture(self, slot: Any, parts: Any, fd: Any) -> None:
        self.air += self.send_line(slot, parts, fd)

    @rule(slot=SLOTS, counter=st.sampled_from([0, 0, 1, 5, 16, 128, 255]))
    def restart_the_sender(self, slot: Any, counter: Any) -> None:
        self.counter[slot] = counter
        self.now += 26 * MS  # no process starts sooner
        self.epoch[slot] += 1
        self.restarting.add(slot)
        self.delivered[slot].clear()  # its numbers have lost their order
        self.air, self.first = [], len(self.sent)

    # -- the bus -------------------------------------------------------------------

    @precondition(lambda self: self.air)
    @rule(place=PLACES)
    def lose(self, place: Any) -> None:
        del self.air[place % len(self.air)]

    @precondition(lambda self: self.air)
    @rule(place=PLACES, to=PLACES)
    def duplicate(self, place: Any, to: Any) -> None:
        self.air.insert(to % (len(self.air) + 1), self.air[place % len(self.air)])

    @precondition(lambda self: self.air)
    @rule(place=PLACES, to=PLACES)
    def reorder(self, place: Any, to: Any) -> None:
        self.air.insert(to % len(self.air), self.air.pop(place % len(self.air)))

    @precondition(lambda self: self.air)
    @rule(place=PLACES, bit=PLACES)
    def corrupt(self, place: Any, bit: Any) -> None:
        place %= len(self.air)
        frame = self.air[place].frame
        data = bytearray(frame.data)
        if data:
            data[bit // 8 % len(data)] ^= 1 << bit % 8
        self.air[place] = OnAir(frame._replace(data=bytes(data)), None)

    @precondition(lambda self: self.air)
    @rule(place=PLACES, left=st.integers(0, 7))
    def cut_short(self, place: Any, left: Any) -> None:
        place %= len(self.air)
        frame = self.air[place].frame
        self.air[place] = OnAir(frame._replace(data=frame.data[:left]), None)

    @precondition(lambda self: self.air)
    @rule(place=PLACES, can_id=st.integers(0x33F, 0x351))
    def change_the_id(self, place: Any, can_id: Any) -> None:
        place %= len(self.air)
        frame = self.air[place].frame
        if can_id != frame.can_id:
            self.air[place] = OnAir(frame._replace(can_id=can_id), None)

    @rule(ms=st.sampled_from([0.1, 1, 5, 24, 26, 100, 10**6]))
    def wait(self, ms: Any) -> None:
        self.now += int(ms * MS)

    @rule(ms=st.sampled_from([1, 30, 3_600_000]))
    def set_the_clock_back(self, ms: Any) -> None:
        self.now -= ms * MS
        for delivered in self.delivered.values():  # what was in the window is so no more
            delivered.clear()

    @rule()
    def expire(self) -> None:
        self.decoder.expire(self.now)

    # -- the receiver, and the checks -------------------------------------------------

    @precondition(lambda self: self.air)
    @rule(n=st.integers(1, 40))
    def receive(self, n: Any) -> None:
        for on_air in self.air[:n]:
            self.feed(on_air)
        del self.air[:n]

    @precondition(lambda self: self.sent[self.first :])
    @rule(back=st.integers(1, 10), late=st.sampled_from([0, 0, 26]))
    def a_line_comes_again(self, back: Any, late: Any) -> None:
        """All of its frames, held up by a gateway."""
        number = max(self.first, len(self.sent) - back)
        sent = self.sent[number]
        self.now += late * MS
        for frame in sent.frames:
            self.feed(OnAir(frame, number))

    @rule(slot=SLOTS, parts=st.sampled_from([1, 1, 1, 3]), fd=st.booleans())
    def a_line_on_a_calm_bus_is_delivered(self, slot: Any, parts: Any, fd: Any) -> None:
        self.receive(len(self.air))
        self.now = max(self.now, self.last) + 26 * MS  # also if the clock was set back by a little
        answers = [self.feed(on_air) for on_air in self.send_line(slot, parts, fd)]
        restarted = self.epoch[slot] > 0  # its counters look like those of old lines
        late = Reason.DUPLICATE in answers or Reason.STALE in answers
        # More records were lost than the time since the last line explains.
        ahead = self.sent[-1].records.start - self.received_up_to[slot]
        reused = Reason.INCOMPLETE in answers and self.now - self.restarted[slot] < 2 * SILENCE
        assert (
            isinstance(answers[-1], MapLine)
            or (late and (restarted or ahead >= MAX_DELTA))
            or reused  # as by a second sender: no mixture
        ), answers
        if isinstance(answers[-1], MapLine):
            self.epoch[slot] = 0

    def feed(self, on_air: Any) -> Any:
        self.now += FRAME
        self.last = max(self.last, self.now)
        frame = on_air.frame
        if on_air.line is not None:
            sent = self.sent[on_air.line]
            self.since[sent.slot].setdefault(on_air.line, self.now)
            if self.newest[sent.slot] - 1 - sent.records.start > TOLD_APART:
                self.delivered[sent.slot].clear()  # so old that it passes for new
            self.newest[sent.slot] = max(self.newest[sent.slot], sent.records.stop)
            if sent.slot in self.restarting:  # on the receiver's clock, which may be set back
                self.restarting.remove(sent.slot)
                self.restarted[sent.slot] = self.now
        self.heard.setdefault(frame, []).append(self.now)
        answer = one(self.decoder.feed(frame.can_id, frame.data, self.now))
        self.fed += 1
        if isinstance(answer, MapLine):
            self.evaluate(answer)
        self.check_accounts()
        return answer

    def evaluate(self, line: Any) -> None:
        same = [i for i, sent in enumerate(self.sent) if sent.bits == bits_of(line)]
        assert len(same) == 1, "a line that was not sent"
        (number,) = same
        sent = self.sent[number]
        note(f"line {number} delivered")
        self.received_up_to[line.slot] = sent.records.stop
        parts = len(sent.records)
        for part in range(parts):  # all frames of a record within the time-out, unharmed
            size = len(sent.frames) // parts
            frames = sent.frames[part * size : (part + 1) * size]
            times = [self.heard.get(frame, []) for frame in frames]
            starts = [line.t_ns] if parts == 1 else [t for of_frame in times for t in of_frame]
            assert any(
                all(any(abs(t - start) <= TIMEOUT for t in of_frame) for of_frame in times)
                for start in starts
            ), f"line {number} was not heard as a whole in time"
        before, heard = self.delivered[line.slot], self.since[line.slot]
        if before:
            last, t_ns = before[-1]
            # The time at which this line may begin: a mixture is late if its last part is.
            newest = line.t_ns if parts == 1 else self.now
            begun = min((t for n, t in heard.items() if n not in (number, last)), default=self.now)
            silent = abs(newest - t_ns) > SILENCE
            apart = self.sent[last].records.stop - 1 - sent.records.start
            is_again = number in [n for n, _ in before]
            is_back = is_again or 0 < apart <= TOLD_APART
            if not silent and abs(self.now - begun) < TAKEN_OVER:
                assert not is_again, "delivered twice"
                assert not is_back, "a line older than the one before it"
            assert last != number or set(heard) != {number}, "the last one again"
            if is_back:
                before.clear()  # from here on it is another sequence
        before.append((number, line.t_ns))
        heard.clear()

    @invariant()
    def check_accounts(self) -> None:
        """Every frame is part of a line, dropped with a reason, or pending."""
        decoder = self.decoder
        total = decoder.line_frames + sum(decoder.counts.values()) + decoder.pending
        assert decoder.frames == self.fed == total
        assert Reason.PENDING not in decoder.counts
        assert min(decoder.counts.values(), default=0) >= 0
        assert decoder.pending <= len(Slot) * (16 * 4 + 8 * 4)


TestBus = Bus.TestCase
TestBus.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
