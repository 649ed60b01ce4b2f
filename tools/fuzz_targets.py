"""Targets of the fuzzer, with the invariants that they check; see fuzz.py.

A target takes any bytes and returns counts of the outcomes. An exception is a defect. The
targets run without the fuzzer too.
"""

from __future__ import annotations

import gzip
import random
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from enum import Enum
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from dbc_witness import straight_scene

from maplines_can.bus import read_log
from maplines_can.model.records import written
from maplines_can.study.code_dbcs import dbc_writer_for
from maplines_can.study.comparison import AnyCodec, codec_for
from maplines_can.values.errors import EncodeError, LayoutError, LogError
from maplines_can.values.line import MapLine, Slot, Status
from maplines_can.wire import Authenticator, Codec, Decoder, Key, Layout, Reason
from maplines_can.wire.layout.packing import Packing
from maplines_can.wire.layout.record_signals import PAGE_BYTES, TRANSFER_ID

MS = 1_000_000
#: DBCs for the decoder: a code that is positive definite by construction, others that are not,
#: the longest record, one without a covariance, and one that requires a MAC.
CODES = ("Cholesky", "LogCholesky", "Float32", "Linear", "MeanOnly", "secoc")
#: Time steps before a frame, selected by two bits of its operation [ns].
STEPS = (MS // 4, 0, 5 * MS, 60 * MS)
FAR_NS = 10**18  # a decoder takes times of up to four times this
SUFFIXES = (".log", ".asc", ".blf", ".csv", ".trc", ".db", ".log.gz", ".asc.gz", ".blf.gz")
_SECRET = bytes(range(16))


class InvariantError(AssertionError):
    """An invariant does not hold."""


def require(holds: Any, message: str) -> None:
    """Raise if an invariant does not hold."""
    if not holds:
        raise InvariantError(message)


class Bytes:
    """Reader of an input; it reads zeros after the end."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    @property
    def left(self) -> int:
        """The number of bytes left."""
        return len(self._data) - self._at

    def take(self, n: int) -> bytes:
        """Return the next n bytes."""
        data = self._data[self._at : self._at + n]
        self._at += n
        return data.ljust(n, b"\0")

    def byte(self) -> int:
        """Return the next byte."""
        return self.take(1)[0]


# ---- frames ------------------------------------------------------------------------------


@cache
def codec_of(name: str) -> tuple[AnyCodec, Packing]:
    """Return the codec of a DBC in CODES, and the packing of its records."""
    if name == "secoc":
        keys = Authenticator(Key(_SECRET), clock=None)
        codec: AnyCodec = Codec.from_dbc(authenticator=keys)
    else:
        codec = codec_for(Layout.from_text(dbc_writer_for(name).dbc(), name))
    return codec, Packing(list(codec.layout.signals.values()), codec.layout.record_bytes)


def valid_record(
    codec: AnyCodec, packing: Packing, content: bytes, slot: Slot, counter: int, **signals: int
) -> bytes:
    """Return a record with any content that passes all checks of the protection."""
    read = packing.unpack(np.frombuffer(content, np.uint8)[None])
    raw = {name: one.item() for name, one in read.items()} | signals | {"Counter": counter}
    raw["Status"] %= len(Status)
    return written(codec.layout, raw, codec.layout.messages[slot].data_id)


class Sender:
    """Sender of records, plain or authenticated."""

    def __init__(self, codec: AnyCodec) -> None:
        self.codec = codec
        self._time = 0
        self._keys = codec.authenticator and Authenticator(Key(_SECRET), clock=self._now)

    def _now(self) -> int:
        self._time += 1000
        return self._time

    def frames(self, record: bytes, slot: Slot, fd: bool) -> list[tuple[int, bytes]]:
        """Return CAN ID and payload of each frame."""
        messages, secured = self.codec.layout.messages[slot], self.codec.layout.secured
        if fd and self._keys and secured and messages.secured_can_id is not None:
            data = self._keys.secure(record, messages.secured_data_id, secured)
            return [(messages.secured_can_id, data)]
        if fd and messages.fd_can_id is not None:
            return [(messages.fd_can_id, record)]
        can_id = messages.can_id or 0
        starts = range(0, len(record), PAGE_BYTES)
        return [(can_id, record[i : i + PAGE_BYTES]) for i in starts]


def decoder(data: bytes) -> Counter[str]:
    """Feed frames of all kinds to a receiver; half of them belong to valid records.

    Invariants: nothing raises. All frames are counted. Each line is finite and positive definite.
    Decoding of one record and of a batch gives the same bits.
    """
    take = Bytes(data)
    codec, packing = codec_of(CODES[take.byte() % len(CODES)])
    state = codec.decoder(timeout_ms=20.0)
    sender = Sender(codec)
    t_ns, fed = 0, list[tuple[int, bytes, bool]]()
    outcomes, counters = Counter[str](), Counter[Slot]()

    def feed(can_id: int, payload: bytes, is_extended: bool = False) -> None:
        answer = state.feed(can_id, payload, t_ns, is_extended=is_extended)
        fed.append((can_id, payload, is_extended))
        check_answer(codec, state, answer, len(fed))
        outcomes[outcome_of(answer)] += 1

    def send(slot: Slot, how: int, components: int, consistent: bool) -> None:
        """Feed the records of one line; the bits of ``how`` say how their frames arrive."""
        first = counters[slot] if how & 1 else take.byte()
        steps = [1] * (components - 1) + [33 - components]
        for index in range(components):
            content = take.take(codec.layout.record_bytes)
            signals = {"ComponentIndex": index, "ComponentCount": components - 1}
            signals = signals | {"ComponentWeight": steps[index] - 1} if consistent else {}
            counter = (first + index) % 256
            record = valid_record(codec, packing, content, slot, counter, **signals)
            if isinstance(codec, Codec):
                check_record(codec, record, slot)
            frames = sender.frames(record, slot, bool(how & 2))
            if how & 4:
                frames = frames[::-1]
            if how & 8:
                frames = frames[: how >> 4] + frames[(how >> 4) + 1 :]
            for frame in frames:
                feed(*frame)
        counters[slot] = (first + components) % 256

    while take.left > 0:
        op = take.byte()
        t_ns += STEPS[op >> 4 & 3]
        what = op & 7
        if what == 0:  # a random frame
            can_id, size = 0x33E + take.byte() % 0x24, take.byte() % 65
            feed(can_id, take.take(size), bool(op & 8))
        elif what in (1, 2, 3):
            send(Slot(take.byte() % 8), take.byte(), 1, consistent=what != 3)
        elif what == 4:
            number = take.byte()
            send(Slot(number % 8), take.byte(), 2 + (number >> 3) % 7, consistent=True)
        elif what == 5:  # a step in time, forward or backward
            t_ns += int.from_bytes(take.take(2), "little", signed=True) * MS << (op >> 6) * 16
            t_ns = max(-FAR_NS, min(t_ns, FAR_NS))
        elif what == 6 and fed:  # an earlier frame, unchanged or with a flipped bit
            can_id, payload, is_extended = fed[-1 - take.byte() % len(fed)]
            if op & 8 and payload:
                bit = int.from_bytes(take.take(2), "little") % (8 * len(payload))
                flipped = bytearray(payload)
                flipped[bit // 8] ^= 1 << bit % 8
                payload = bytes(flipped)
            feed(can_id, payload, is_extended)
        elif what == 7:
            state.expire(t_ns)
            check_counts(state, len(fed))
            for slot in codec.layout.messages:
                view = state.latest(slot, t_ns)
                require(view.line is None or view.age == view.age, f"age is {view.age}")
    state.expire(t_ns + FAR_NS)
    check_counts(state, len(fed))
    require(state.pending == 0, f"{state.pending} frames stay pending")
    return outcomes


def outcome_of(answer: Sequence[MapLine] | Enum) -> str:
    """Return the name of what a decoder answers."""
    return answer.name if isinstance(answer, Enum) else "line"


def check_counts(state: Decoder, frames: int) -> None:
    """Check that every frame is part of a line, dropped with a reason, or pending."""
    taken = state.line_frames + state.pose_frames
    total = taken + sum(state.counts.values()) + state.pending
    require(state.frames == frames == total, f"{frames} frames fed, {total} accounted for")
    require(Reason.PENDING not in state.counts, "pending frames are counted as dropped")
    require(min(state.counts.values(), default=0) >= 0, "a count is negative")


def check_answer(
    codec: AnyCodec, state: Decoder, answer: Sequence[MapLine] | Reason, frames: int
) -> None:
    """Check the answer to a frame, and the counts and the memory after it."""
    check_counts(state, frames)
    most = 2 ** codec.layout[f"{TRANSFER_ID}0"].length * codec.layout.pages + 8 * codec.layout.pages
    require(
        state.pending <= most * len(codec.layout.messages),
        "more frames are pending than the transfer IDs allow",
    )
    for line in () if isinstance(answer, Reason) else answer:
        check_line(line)


def check_line(line: MapLine) -> None:
    """Check that a line and its components are finite and positive definite."""
    components = line.mixture.components if line.mixture else ()
    for gaussian in (line.gaussian, *components):
        require(np.isfinite(gaussian.mean).all(), f"the mean is {gaussian.mean}")
        require(np.isfinite(gaussian.cov).all(), f"the covariance is {gaussian.cov.tolist()}")
        require((gaussian.cov == gaussian.cov.T).all(), "the covariance is not symmetric")
        sigma = np.sqrt(gaussian.cov.diagonal())
        require((sigma > 0).all(), f"the sigmas are {sigma}")
        try:
            np.linalg.cholesky(gaussian.cov / sigma / sigma[:, None])
        except np.linalg.LinAlgError:
            raise InvariantError(
                f"the covariance is not positive definite: {gaussian.cov.tolist()}"
            ) from None
    if line.mixture:
        require(line.mixture.weights.sum() == 1, f"the weights are {line.mixture.weights}")


def check_record(codec: Codec, record: bytes, slot: Slot) -> None:
    """Check that both ways of decoding accept the same records and agree to the last bit."""
    batch = codec.batch.decode(np.frombuffer(record, dtype=np.uint8)[None], slot)
    line = codec.batch.decode_one(record, slot)
    require(batch.accepted[0] == isinstance(line, MapLine), "the two decoders do not agree")
    if isinstance(line, MapLine):
        check_line(line)
        require(np.array_equal(batch.mean[0], line.gaussian.mean), "the two means differ")
        require(np.array_equal(batch.cov[0], line.gaussian.cov), "the two covariances differ")


# ---- logs --------------------------------------------------------------------------------


def logs(data: bytes) -> Counter[str]:
    """Read a log in one of the formats into a decoder; only LogError may end it."""
    suffix = SUFFIXES[data[0] % len(SUFFIXES)] if data else ".log"
    content = gzip.compress(data[1:], 1) if suffix in (".log.gz", ".asc.gz") else data[1:]
    outcomes = Counter[str]()
    state = codec_of("Cholesky")[0].decoder()
    with tempfile.TemporaryDirectory(prefix="maplines-fuzz-") as folder:
        path = Path(folder) / f"log{suffix}"
        path.write_bytes(content)
        try:
            for frame in read_log(path):
                require(0 <= frame.can_id < 2**32, f"the CAN ID is {frame.can_id}")
                require(type(frame.t_ns) is int, f"the time is {frame.t_ns!r}")
                answer = state.feed(
                    frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended
                )
                outcomes["frame" if isinstance(answer, Reason) else "line"] += 1
        except LogError as error:
            require("\n" not in str(error), "the message has more than one line")
            outcomes["LogError"] += 1
    check_counts(state, outcomes["line"] + outcomes["frame"])
    return outcomes


# ---- DBCs --------------------------------------------------------------------------------


def dbc(data: bytes) -> Counter[str]:
    """Load a DBC: it gives a usable layout or raises LayoutError."""
    text = data.decode("cp1252", "replace")
    try:
        codec = codec_for(Layout.from_text(text, "fuzz"))
        encoder = codec.encoder()
    except LayoutError as error:
        require("\n" not in str(error), "the message has more than one line")
        return Counter(LayoutError=1)
    layout, outcomes = codec.layout, Counter(layout=1)
    state = codec.decoder()
    junk = random.Random(len(data)).randbytes(layout.record_bytes)  # noqa: S311
    for slot, messages in layout.messages.items():
        if isinstance(codec, Codec):
            for record in (junk, bytes(layout.record_bytes)):
                require(not isinstance(codec.batch.decode_one(record, slot), Exception), "")
                codec.batch.decode(np.frombuffer(record, np.uint8)[None], slot)
        for fd in (False, True):
            try:
                line = MapLine.with_sigma(slot, [1.75, 0.01, 1e-3, 1e-6], [0.1, 0.01, 1e-4, 1e-6])
                frames = encoder.encode(line, fd=fd)
            except EncodeError:
                outcomes["EncodeError"] += 1
                continue
            answers = [state.feed(f.can_id, f.data, 0, is_extended=f.is_extended) for f in frames]
            outcomes[outcome_of(answers[-1])] += 1
        for can_id in (messages.can_id, messages.fd_can_id, messages.secured_can_id):
            if can_id is not None:
                state.feed(can_id, junk[:PAGE_BYTES], 0)
                state.feed(can_id, junk, 0)
    if layout.scene is not None:
        for fd in (False, True):
            try:
                sent = encoder.encode_scene(straight_scene(layout.slots), fd=fd)
            except EncodeError:
                outcomes["EncodeError"] += 1
                continue
            for f in chain(*sent.values()):
                answer = state.feed(f.can_id, f.data, 0, is_extended=f.is_extended)
                outcomes[outcome_of(answer)] += 1
        for can_id, is_extended in layout.message_of_id:
            state.feed(can_id, junk, 0, is_extended=is_extended)
    check_counts(state, state.frames)
    return outcomes


TARGETS: dict[str, Callable[[bytes], Counter[str]]] = {
    "decoder": decoder,
    "logs": logs,
    "dbc": dbc,
}
