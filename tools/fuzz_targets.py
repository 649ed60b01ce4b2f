"""What the fuzzer feeds, and what must hold: see fuzz.py. Runs without the fuzzer too.

A target takes bytes and returns what became of them; whatever it raises is a defect. Each has
seeds and, where plain bytes would hardly get past the first check, a mutator of its own.
"""

import contextlib
import gzip
import random
import re
import sqlite3
import tempfile
import warnings
from collections import Counter
from functools import cache
from pathlib import Path

import can
import numpy as np

from maplines_can.bus import read_log
from maplines_can.errors import EncodeError, LayoutError, LogError
from maplines_can.line import MapLine, Slot, Status
from maplines_can.study.codes import CODES as STUDY_CODES
from maplines_can.study.dbc.record_spec import DEFAULT, dbc_writer_for
from maplines_can.wire import Authenticator, Codec, Key, Layout, Monitor, Reason
from maplines_can.wire.message.layout import BURST, PAGE, PAGE_BYTES
from maplines_can.wire.message.packing import Packing
from maplines_can.wire.protection.e2e import CRC_BYTES, record_crc_one

MS = 1_000_000
#: DBCs that the decoder is fuzzed with: a code that is definite by itself, others that are not,
#: the longest record, one without a covariance, and one that asks for a MAC.
CODES = ("Cholesky", "LogCholesky", "Float32", "Linear", "MeanOnly", "secoc")
#: Steps of time before a frame, by two bits of its operation [ns].
STEPS = (MS // 4, 0, 5 * MS, 60 * MS)
SUFFIXES = (".log", ".asc", ".blf", ".csv", ".trc", ".db", ".log.gz", ".asc.gz", ".blf.gz")
_SECRET = bytes(range(16))


class BrokenError(AssertionError):
    """A promise is broken."""


def must(holds, what):
    if not holds:
        raise BrokenError(what)


class Bytes:
    """Numbers and bytes of an input, zeros after its end."""

    def __init__(self, data):
        self._data, self._at = data, 0

    @property
    def left(self):
        """Bytes that are left."""
        return len(self._data) - self._at

    def take(self, n):
        """The next bytes."""
        part = self._data[self._at : self._at + n]
        self._at += n
        return part.ljust(n, b"\0")

    def byte(self):
        """The next byte."""
        return self.take(1)[0]


# ---- frames ------------------------------------------------------------------------------


@cache
def codec_of(name):
    """A codec, and how its records are packed."""
    if name == "secoc":
        keys = Authenticator(Key(_SECRET), clock=None)
        codec = Codec.from_dbc(authenticator=keys)
    else:
        codec = Codec(Layout.from_text(dbc_writer_for(name).dbc(), name), codes=STUDY_CODES)
    return codec, Packing(list(codec.layout.signals.values()), codec.layout.record_bytes)


def repaired(codec, packing, content, slot, counter, **fields):
    """A record that a receiver takes, with any content."""
    layout = codec.layout
    raw = packing.unpack_one(content) | fields | {"Counter": counter}
    for page in range(layout.pages):
        raw |= {f"{PAGE}{page}": page, f"{BURST}{page}": counter}
    raw["Status"] %= len(Status)
    record = packing.pack_one(raw)
    crc = record_crc_one(record, layout.channels[slot].data_id, layout.crc_offset)
    head, tail = record[: layout.crc_offset], record[layout.crc_offset + CRC_BYTES :]
    return head + crc.to_bytes(CRC_BYTES, "little") + tail


class Sender:
    """Frames of records, plain or authenticated."""

    def __init__(self, codec):
        self.codec = codec
        self._time = 0
        self._keys = codec.authenticator and Authenticator(Key(_SECRET), clock=self._now)

    def _now(self):
        self._time += 1000
        return self._time

    def frames(self, record, slot, fd):
        """(ID, payload) of each frame."""
        channel = self.codec.layout.channels[slot]
        if self._keys and fd:
            form = self.codec.layout.secured
            secured = self._keys.secure(record, channel.secured_data_id, form)
            return [(channel.secured_can_id, secured)]
        if fd and channel.fd_can_id is not None:
            return [(channel.fd_can_id, record)]
        starts = range(0, len(record), PAGE_BYTES)
        return [(channel.can_id, record[i : i + PAGE_BYTES]) for i in starts]


def decoder(data):
    """Frames of all kinds, half of them parts of records that hold, into a receiver's state.

    Nothing raises; all frames are accounted for; what is delivered is finite and definite; one by
    one and many at once decode to the same bits.
    """
    take = Bytes(data)
    codec, packing = codec_of(CODES[take.byte() % len(CODES)])
    state = codec.decoder(timeout_ms=20.0)
    monitor, sender = Monitor(state), Sender(codec)
    t_ns, fed, told = 0, [], Counter()
    counters = Counter()

    def feed(can_id, payload, is_extended=False):
        answer = monitor.feed(can_id, payload, t_ns, is_extended=is_extended)
        fed.append((can_id, payload, is_extended))
        check_answer(codec, state, answer, len(fed))
        told["line" if isinstance(answer, MapLine) else answer.name] += 1

    def send(slot, how, parts, kept):
        """Records of one line, with what happens to their frames."""
        first = counters[slot] if how & 1 else take.byte()
        steps = [1] * (parts - 1) + [33 - parts]
        for index in range(parts):
            content = take.take(codec.layout.record_bytes)
            fields = {"ComponentIndex": index, "ComponentCount": parts - 1}
            fields = fields | {"ComponentWeight": steps[index] - 1} if kept else {}
            counter = (first + index) % 256
            record = repaired(codec, packing, content, slot, counter, **fields)
            check_record(codec, record, slot)
            frames = sender.frames(record, slot, bool(how & 2))
            if how & 4:
                frames = frames[::-1]
            if how & 8:
                frames = frames[: how >> 4] + frames[(how >> 4) + 1 :]
            for frame in frames:
                feed(*frame)
        counters[slot] = (first + parts) % 256

    while take.left > 0:
        op = take.byte()
        t_ns += STEPS[op >> 4 & 3]
        what = op & 7
        if what == 0:  # any frame
            can_id, size = 0x33E + take.byte() % 0x24, take.byte() % 65
            feed(can_id, take.take(size), bool(op & 8))
        elif what in (1, 2, 3):
            send(Slot(take.byte() % 8), take.byte(), 1, kept=what != 3)
        elif what == 4:
            number = take.byte()
            send(Slot(number % 8), take.byte(), 2 + (number >> 3) % 7, kept=True)
        elif what == 5:  # time goes on, or back
            t_ns += int.from_bytes(take.take(2), "little", signed=True) * MS << (op >> 6) * 16
        elif what == 6 and fed:  # an old frame again, as it was or with a flipped bit
            can_id, payload, is_extended = fed[-1 - take.byte() % len(fed)]
            if op & 8 and payload:
                bit = int.from_bytes(take.take(2), "little") % (8 * len(payload))
                flipped = bytearray(payload)
                flipped[bit // 8] ^= 1 << bit % 8
                payload = bytes(flipped)
            feed(can_id, payload, is_extended)
        elif what == 7:
            state.expire(t_ns)
            check_accounts(state, len(fed))
            for slot in state.checks:
                view = monitor.latest(slot, t_ns)
                must(view.line is None or view.age == view.age, f"age is {view.age}")
    state.expire(t_ns + 10**18)
    check_accounts(state, len(fed))
    must(state.pending == 0, f"{state.pending} frames wait for ever")
    return told


def check_accounts(state, frames):
    """Every frame is part of a line, dropped with a reason, or pending."""
    total = state.line_frames + sum(state.counts.values()) + state.pending
    must(state.frames == frames == total, f"{frames} frames fed, {total} accounted for")
    must(Reason.PENDING not in state.counts, "frames that wait are counted as dropped")
    must(min(state.counts.values(), default=0) >= 0, "a count is negative")


def check_answer(codec, state, answer, frames):
    check_accounts(state, frames)
    most = 2 ** codec.layout[f"{BURST}0"].length * codec.layout.pages + 8 * codec.layout.pages
    must(state.pending <= most * len(codec.layout.channels), "more frames wait than may")
    if isinstance(answer, MapLine):
        check_line(answer)
    else:
        must(isinstance(answer, Reason), f"the answer is {answer!r}")


def check_line(line):
    parts = line.mixture.components if line.mixture else ()
    for gaussian in (line.gaussian, *parts):
        must(np.isfinite(gaussian.mean).all(), f"the mean is {gaussian.mean}")
        must(np.isfinite(gaussian.cov).all(), f"the covariance is {gaussian.cov.tolist()}")
        must((gaussian.cov == gaussian.cov.T).all(), "the covariance is not symmetric")
        sigma = np.sqrt(gaussian.cov.diagonal())
        must((sigma > 0).all(), f"the sigmas are {sigma}")
        try:
            np.linalg.cholesky(gaussian.cov / sigma / sigma[:, None])
        except np.linalg.LinAlgError:
            raise BrokenError(f"the covariance is not definite: {gaussian.cov.tolist()}") from None
    if line.mixture:
        must(line.mixture.weights.sum() == 1, f"the weights are {line.mixture.weights}")


def check_record(codec, record, slot):
    """One record: both ways of decoding agree to the last bit, and about what is accepted."""
    batch = codec.decode_batch(np.frombuffer(record, dtype=np.uint8)[None], slot)
    line = codec.decode_one(record, slot)
    must(batch.accepted[0] == isinstance(line, MapLine), "the two decoders do not agree")
    if isinstance(line, MapLine):
        check_line(line)
        must(np.array_equal(batch.mean[0], line.gaussian.mean), "the two means differ")
        if codec.covariance.positive_definite:
            must(np.array_equal(batch.cov[0], line.gaussian.cov), "the two covariances differ")


def decoder_seeds():
    rng = random.Random(1)  # noqa: S311 - not a secret
    for code, name in enumerate(CODES):
        size = codec_of(name)[0].layout.record_bytes
        start = bytes([code])
        yield start + bytes([0, 2, 8]) + rng.randbytes(8)
        record = bytes([1, 0, 1]) + rng.randbytes(size)
        yield start + record * 2
        yield start + bytes([1, 1, 3]) + rng.randbytes(size) + bytes([6, 0, 14, 0, 9, 0])
        yield start + bytes([4, 0, 3]) + rng.randbytes(2 * size) + bytes([53, 60, 0, 7])
        yield start + bytes([1, 2, 0x2D]) + rng.randbytes(size) + record


# ---- logs --------------------------------------------------------------------------------


def logs(data):
    """A file in one of the formats: frames that a decoder takes, and LogError at the end or not."""
    suffix = SUFFIXES[data[0] % len(SUFFIXES)] if data else ".log"
    content = gzip.compress(data[1:], 1) if suffix in (".log.gz", ".asc.gz") else data[1:]
    told = Counter()
    state = codec_of("Cholesky")[0].decoder()
    with tempfile.TemporaryDirectory(prefix="maplines-fuzz-") as folder:
        path = Path(folder) / f"log{suffix}"
        path.write_bytes(content)
        try:
            for frame in read_log(path):
                must(0 <= frame.can_id < 2**32, f"the CAN ID is {frame.can_id}")
                must(type(frame.t_ns) is int, f"the time is {frame.t_ns!r}")
                answer = state.feed(
                    frame.can_id, frame.data, frame.t_ns, is_extended=frame.is_extended
                )
                told["line" if isinstance(answer, MapLine) else "frame"] += 1
        except LogError as error:
            must("\n" not in str(error), "the message has more than one line")
            told["LogError"] += 1
    check_accounts(state, told["line"] + told["frame"])
    return told


def logs_seeds():
    codec = codec_of("Cholesky")[0]
    record = repaired(*codec_of("Cholesky"), bytes(32), Slot.EGO_LEFT, 0)
    with tempfile.TemporaryDirectory(prefix="maplines-fuzz-") as folder:
        for number, suffix in enumerate(SUFFIXES):
            if suffix.endswith(".gz"):
                continue
            path = Path(folder) / f"log{suffix}"
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                with can.Logger(path) as writer:
                    t = 1000.0
                    for frame in codec.frames(np.frombuffer(record, np.uint8), Slot.EGO_LEFT):
                        t += 0.001
                        writer(
                            can.Message(
                                timestamp=t,
                                arbitration_id=frame.can_id,
                                is_extended_id=False,
                                data=frame.data,
                                channel=0,
                            )
                        )
                    writer(can.Message(t, 0x123, is_extended_id=True, is_remote_frame=True, dlc=4))
                    writer(can.Message(t, is_error_frame=True, data=bytes(8), channel=0))
            if suffix == ".db":
                with contextlib.closing(sqlite3.connect(path)) as file:
                    file.executescript("PRAGMA page_size = 512; VACUUM")
            content = path.read_bytes().replace(str(path).encode(), path.name.encode())
            yield bytes([number]) + content
            if f"{suffix}.gz" in SUFFIXES:
                content = gzip.compress(content, mtime=0) if suffix == ".blf" else content
                yield bytes([SUFFIXES.index(f"{suffix}.gz")]) + content
    fd = "(1000.0) can0 348##0" + record.hex().upper() + "\n"
    yield bytes([0]) + fd.encode()
    old_trc = b";$FILEVERSION=1.1\n;$STARTTIME=37704.5364870833\n"
    yield bytes([4]) + old_trc + b" 1)  1059.9  Rx  0340  8  00 00 00 00 00 00 00 00\n"
    for version in (b"2.0", b"2.1", b"1.3"):
        yield bytes([4]) + old_trc.replace(b"1.1", version)


#: What a token of a log is replaced by.
LOG_TOKENS = (
    *("0", "1", "8", "9", "64", "65", "-1", "0.0", "1e9", "1e308", "1e999", "nan", "inf", "-inf"),
    *("340", "348", "340x", "1FFFFFFF", "FFFFFFFF", "FFFFFFFFF", "340#", "348##0", "#R", "#R8"),
    *("20000080#0000000000000000", "d", "r", "Rx", "Tx", "RxRd", "ErrorFrame", "CANFD", "CAN"),
    *("base hex timestamps absolute", "base dec", "Begin Triggerblock", "End TriggerBlock"),
    *("Begin Triggerblock Mon Feb 30 25:61:61.1 2020", "date Sat Sep 30 15:06:13.191 2017"),
    *(";$FILEVERSION=1.0", ";$FILEVERSION=2.1", ";$STARTTIME=1e999", ";$STARTTIME=0", "ST", "FD"),
    *(";$COLUMNS=N,O,T,I,d,L,D", ";$COLUMNS=N,O,T,B,I,d,R,L,D", "DT", "ER", "RR", "EC", "HW"),
    *("timestamp,arbitration_id,extended,remote,error,dlc,data", "====", "AAAAAAAAAAA=", "can0"),
    *("Statistic:", "// ", "\x1a", "\0", "\r", "\xa0", "\xb2"),
)


# ---- DBCs --------------------------------------------------------------------------------

#: What a token of a DBC is replaced by.
TOKENS = (
    *("0", "1", "2", "3", "4", "7", "8", "15", "16", "31", "32", "62", "63", "64", "65", "255"),
    *("-1", "1e9", "1e308", "1e999", "-1e308", "1e-320", "nan", "0.5", "65536", "4294967295"),
    *("2147483648", "2147484480", "18446744073709551616", "m", "M", "m0", "m1", "m9", "m0M"),
    *("@0+", "@0-", "@1+", "@1-", '""', '"x"', "Page", "Page0", "Page1", "Burst0", "Burst1", "Crc"),
    *("Counter", "YOff", "Beta", "C0", "C1", "Status", "Kind", "XMin", "XMax", "Age", "Mac"),
    *("ComponentIndex", "ComponentCount", "ComponentWeight", "KeyId", "Freshness", "EgoLeft"),
    *("MapLineSlot", "E2EDataId", "SecOCDataId", "GenMsgCycleTime", "VFrameFormat"),
    *("CovarianceCode", '"MeanOnly"', '"Sigmas"', '"Cholesky"', '"Float32Triangle"', "INT"),
    *("FLOAT", "STRING", "ENUM", "HEX", "BO_", "SG_", "BA_", "BA_DEF_", "BA_DEF_DEF_", "VAL_"),
    *("SIG_VALTYPE_", "SG_MUL_VAL_", "CM_", "EV_", "\0", "\xe9"),
)


def dbc(data):
    """The text of a DBC: a layout, or LayoutError; and a layout that is taken can be used."""
    text = data.decode("cp1252", "replace")
    try:
        codec = Codec(Layout.from_text(text, "fuzz"), codes=STUDY_CODES)
    except LayoutError as error:
        must("\n" not in str(error), "the message has more than one line")
        return Counter(LayoutError=1)
    layout, told = codec.layout, Counter(layout=1)
    state = codec.decoder()
    junk = random.Random(len(data)).randbytes(layout.record_bytes)  # noqa: S311
    for slot, channel in layout.channels.items():
        for record in (junk, bytes(layout.record_bytes)):
            must(not isinstance(codec.decode_one(record, slot), Exception), "")
            codec.decode_batch(np.frombuffer(record, np.uint8)[None], slot)
        for fd in (False, True):
            try:
                line = MapLine.with_sigma(slot, [1.75, 0.01, 1e-3, 1e-6], [0.1, 0.01, 1e-4, 1e-6])
                frames = codec.encode(line, fd=fd)
            except EncodeError:
                told["EncodeError"] += 1
                continue
            answers = [state.feed(f.can_id, f.data, 0, is_extended=f.is_extended) for f in frames]
            told["line" if isinstance(answers[-1], MapLine) else answers[-1].name] += 1
        for can_id in (channel.can_id, channel.fd_can_id, channel.secured_can_id):
            if can_id is not None:
                state.feed(can_id, junk[:PAGE_BYTES], 0)
                state.feed(can_id, junk, 0)
    check_accounts(state, state.frames)
    return told


def short_dbc(code, secured=False):
    """The DBC of one slot, without what it only tells people."""
    contract = dbc_writer_for(code)
    settings = {"pages": contract.pages, "covariance_code": code, "slots": (Slot.EGO_LEFT,)}
    if secured:
        settings["first_secured_can_id"] = 0x350
    text = type(DEFAULT)(**settings).dbc()
    text = re.sub(r"^(CM_|VAL_) .*?;\n", "", text, flags=re.MULTILINE | re.DOTALL)
    text = re.sub(r"NS_ :.*?BS_:", "BS_:", text, flags=re.DOTALL)
    return re.sub(r"\n\n+", "\n", text).replace("  ", " ")


def dbc_seeds():
    for code in ("MeanOnly", "Sigmas", "Cholesky", "Float32"):
        yield short_dbc(code).encode("cp1252")
    only_classic = short_dbc("MeanOnly")
    yield re.sub(r"BO_ 840.*?(?=BO_TX|BA_DEF)", "", only_classic, flags=re.DOTALL).encode()
    yield re.sub(r"@1([+-])", r"@0\1", only_classic).encode()
    yield short_dbc("MeanOnly", secured=True).encode()


def dbc_mutated(data, seed):
    """Another DBC."""
    return mutated(data.decode("cp1252", "replace"), TOKENS, seed).encode("cp1252", "replace")


def logs_mutated(data, seed):
    """Another log, of the same format or another."""
    text = data[1:].decode("latin-1")
    if seed % 16 == 0 or not data:
        return bytes([seed // 16 % len(SUFFIXES)]) + data[1:]
    return data[:1] + mutated(text, LOG_TOKENS, seed).encode("latin-1")


def mutated(text, words, seed):
    """Another text: tokens and lines replaced, doubled, exchanged, left out."""
    rng = random.Random(seed)  # noqa: S311
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        if rng.random() < 0.3:
            lines = text.split("\n")
            i, j = (rng.randrange(len(lines)) for _ in range(2))
            what = rng.randrange(4)
            if what == 0:
                del lines[i]
            elif what == 1:
                lines.insert(j, lines[i])
            elif what == 2:
                lines[i], lines[j] = lines[j], lines[i]
            else:
                del lines[min(i, j) : max(i, j)]
            text = "\n".join(lines)
            continue
        tokens = re.split(r'("[^"]*"|[A-Za-z_]\w*|@[01][+-]|-?[\d.]+(?:e-?\d+)?)', text)
        odd = range(1, len(tokens), 2)
        if odd:
            new = rng.choice(words) if rng.random() < 0.7 else tokens[rng.choice(odd)]
            tokens[rng.choice(odd)] = new
        text = "".join(tokens)
    return text


TARGETS = {"decoder": decoder, "logs": logs, "dbc": dbc}
SEEDS = {"decoder": decoder_seeds, "logs": logs_seeds, "dbc": dbc_seeds}
MUTATORS = {"dbc": dbc_mutated, "logs": logs_mutated}
#: Longest input [bytes].
MOST = {"decoder": 1024, "logs": 6144, "dbc": 8192}
