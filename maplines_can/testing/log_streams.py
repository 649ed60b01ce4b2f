"""Streams of logs for the parsers of the core: ordinary rows and objects among damaged ones.

A parser takes records up to the first one that is not of its ordinary form. The model has these
forms as regular expressions, and as the structures of BLF. Both parse the same bytes with little
room, and go on behind each record that is left to Python.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import count, islice
from typing import Any, NamedTuple

import numpy as np

from ..core import ffi, lib
from ..core.memory import structure
from .back_to_back import Difference, StreamComparison
from .sender_streams import bits

#: Records of a log, and calls of a parser for one.
RECORDS, CALLS = 24, 40
#: Frames for which there is memory; a call has less, and must not write beyond.
ROOM, UNTOUCHED = 9, 0xA5
MAX_CHANNELS, MAX_NAME, MAX_DISORDER_NS = 256, 64, 10**8
FD_LENGTHS = (*range(9), 12, 16, 20, 24, 32, 48, 64)
#: Steps between two questions whether it is over.
STEPS = 50


class LogStep(NamedTuple):
    """A log to parse."""

    form: str  #: candump, asc (hexadecimal), asc10 (decimal) or blf
    data: bytes
    capacity: int  #: frames of a call
    times: int  #: kind of the stamps: 0 absolute, 1 from the start, 2 differences
    total: int  #: of the stamps before [ns]
    high: int  #: highest stamp before [ns]
    channels: int  #: number of channels that are known, whose names are "c0", "c1" ...
    start_ns: int  #: of a BLF log


# ---- the streams ------------------------------------------------------------------------------


class _Draw:
    """Texts of a record, a few of which are unusual."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self._rare = rng.choice([0.0, 0.01, 0.03])
        self._seconds = self.number(0, self.one(10, 1000, 1_700_000_000))  # of most stamps
        self._is_close = self.one(True, False)

    def one(self, *values: Any) -> Any:
        return values[self._rng.integers(len(values))]

    def usual(self, value: Any, *unusual: Any) -> Any:
        return self.one(*unusual) if self._rng.random() < self._rare else value

    def number(self, low: int, high: int) -> int:
        return int(self._rng.integers(low, high + 1))

    def digits(self, length: int, digits: str) -> str:
        return "".join(self.one(*digits) for _ in range(length))

    def stamp(self) -> str:
        if self._is_close:  # about the greatest disorder
            fraction = self.one("0", "1", "1", "100000000", "100000001", "099999999", "2")
            return f"{self._seconds}.{fraction}"
        seconds = str(self._seconds + self.number(0, 1000))
        great = "8999999999", "9000000000", "9000000001", "9999999999"
        seconds = self.usual(self.usual(seconds, *great), *great, "1", "0")
        seconds = self.usual(seconds, "", "00000000001", "-1", "0000000001")
        length = self.one(1, 3, 6, 6, 6, 9)
        fraction = self.digits(self.usual(length, 0, 10), "0123456789")
        return f"{seconds}{self.usual('.', ',', '')}{fraction}"

    def bytes_of(self, length: int) -> bytes:
        return self._rng.bytes(length)

    def end(self) -> str:
        return self.usual(self.one("\n", "\n", "\r\n"), "\r", "\r\r\n", "\0\n", " \n", "\x7f\n")

    def damaged(self, data: bytes) -> bytes:
        if self._rng.random() >= self._rare:
            return data
        changed = bytearray(data)
        place = self.number(0, len(data) - 1)
        if self._rng.random() < 0.3:
            return bytes(changed[:place])
        changed[place] = self.one(*b" \r\n\0#gG:@/`~\x7f\x80.xX19", self.number(0, 255))
        return bytes(changed)


def _hex(draw: _Draw, data: bytes) -> str:
    return draw.one(str.upper, str.upper, str.lower)(data.hex())


def _candump_row(draw: _Draw) -> str:
    length = draw.one(0, 1, 8, 8, 8, 12, 64, draw.usual(64, 65))
    name = draw.one("can0", "can0", "can1", "x", "v" * 64, f"can{draw.number(0, 5)}")
    name = draw.usual(name, "", "v" * 65, "c n", "\xff", "~!", "\x7f", "c1", "c300")
    can_id = draw.digits(3, "0123456789abcdefABCDEF")
    if draw.one(True, False):
        can_id = draw.one("0", "1", "1") + draw.digits(7, "0123456789abcdefABCDEF")
    can_id = draw.usual(can_id, "1FFFFFFF", "20000000", "3400", "34", "034000340", "")
    mark = draw.usual(draw.one("#", "#", "##1", "##f"), "##", "##g", "", " #", "##11")
    data = _hex(draw, draw.bytes_of(length)) + draw.usual("", "1", "g", "@")
    tail = draw.usual(draw.one("", "", " R", " T"), " ", " X", "  R", " RT")
    before = draw.usual("", " ", "(")
    stamp = f"{before}({draw.stamp()}{draw.usual(')', '', ' )')}{draw.usual(' ', '', '  ')}"
    return f"{stamp}{name}{draw.usual(' ', '', '  ')}{can_id}{mark}{data}{tail}{draw.end()}"


def _asc_row(draw: _Draw, radix: int) -> str:
    blank = draw.one(" ", " ", "  ", "   ")
    number = draw.usual(str(draw.one(1, 1, 2, 3, 9, 10, 9999)), "0", "10000", "", "-1", "01", "300")
    if radix == 10:
        can_id = draw.one(str(draw.number(0, 2047)), f"{draw.number(0, 2**29 - 1)}x")
        can_id = draw.usual(can_id, "536870911", "536870912x", "34a", "0000000001", "000000001")
    else:
        can_id = draw.one(f"{draw.number(0, 2047):x}", f"{draw.number(0, 2**29 - 1):X}x")
        can_id = draw.usual(can_id, "1fffffff", "20000000x", "x", "0000000340", "000000340", "34g")
    way = draw.usual(draw.one("Rx", "Tx"), "rx", "R", "Rxx", "TX", "Sx")
    is_fd = radix == 16 and draw.one(True, False, False)
    is_fd = draw.usual(is_fd, True)
    if is_fd:
        dlc = draw.number(0, 15)
        length = draw.usual(FD_LENGTHS[dlc] or 1, 0, FD_LENGTHS[dlc] + 1, 64)
        flags = f"{draw.usual('1', '10', '', '9')}{blank}{draw.usual('0', '1', 'x')}{blank}"
        head = f"CANFD{draw.usual(blank, '')}{number}{blank}{way}{blank}{can_id}{blank}{flags}"
        head += f"{draw.usual(f'{dlc:x}', f'{dlc:X}', '0', 'g', f'0{dlc:x}')}{blank}{length}"
    else:
        length = draw.number(0, 8)
        stated = draw.usual(str(length), "9", "f", "/", ":", str(max(length - 1, 0)))
        head = f"{number}{blank}{can_id}{blank}{way}{blank}{draw.usual('d', 'r', 'D', '')}"
        head += f"{draw.usual(blank, '')}{stated}"
    data = draw.bytes_of(length)
    texts = [str(value) for value in data] if radix == 10 else [f"{value:02x}" for value in data]
    if texts:
        place = draw.number(0, len(texts) - 1)
        texts[place] = draw.usual(
            texts[place], "256", "255", "1", "0001", "fg", "g0", "FF", "", "+1"
        )
    rest = draw.one("", "", f"{blank}Length = 1 BitCount = 2", " ")
    rest = draw.usual(
        rest, "x" * 9, " " + "y" * 4095, " " + "y" * 4096, " \x80", "\x7f", "\t", " ~"
    )
    row = f"{draw.stamp()}{draw.usual(blank, '', chr(9))}{head}"
    row += "".join(f"{blank}{text}" for text in texts)
    return f"{draw.one('', blank)}{row}{rest}{draw.end()}"


#: Kinds of objects of BLF: frames, and others.
_FRAMES, _OTHERS = (1, 86, 100, 101), (2, 4, 10, 31, 73, 74, 104, 0, 3, 102, 2**31)


def _blf_object(draw: _Draw) -> bytes:
    kind = draw.one(1, 86, 100, 101, draw.one(*_OTHERS))
    version = draw.usual(draw.one(1, 2), 0, 3, 65535)
    header = 16 + (16 if version == 1 else 24)
    flags = draw.usual(draw.one(0, 0, 1, 1, 2, 0x40, 0x80), 0x0F, 0x12, 0x22, 0x82, 0xFF)
    dlc = draw.usual(draw.number(0, 8), 9, 15, 255)
    can_id = draw.one(0x340, 0x80000340, draw.number(0, 2**32 - 1))
    channel = draw.usual(draw.one(1, 1, 2, 7), 0, 255, 300, 65535)
    there = draw.usual(draw.number(0, 64), 65, 255)
    if kind == 101:
        more = draw.usual(draw.one(0, 0x1000), 0x10, 0x80, 0x40, 0xC0, 0xFFFF)
        stored = draw.one(there, there, draw.number(0, 64), 0)
        behind = draw.one(0, header + 40 + stored, header + 40 + draw.number(0, stored))
        behind = draw.usual(behind, header + 39, header + 41 + stored, 1) & 0xFF
        way = draw.usual(draw.one(0, 1), 2, 3)
        body = struct.pack("<BBBBL4xL18xBB4x", channel & 0xFF, dlc, there, 0, can_id, more, way,
                           behind) + draw.bytes_of(stored)  # fmt: skip
    elif kind == 100:
        body = struct.pack("<HBBL6xB5x", channel, flags, dlc, can_id, there) + draw.bytes_of(64)
        body = draw.usual(body, body[:83], body[:20], body + bytes(4))
    else:
        body = struct.pack("<HBBL", channel, flags, dlc, can_id) + draw.bytes_of(8)
        body = draw.usual(body, body[:15], body[:8], b"", body + bytes(4))
    unit = draw.usual(draw.one(1, 2), 0, 3)
    ticks = draw.usual(draw.number(0, 2**40), 2**48 - 1, 2**48, 2**63, 0, 2**64 - 1)
    head = struct.pack("<L4xQ", unit, ticks).ljust(header - 16, b"\x11")
    size = 16 + len(head) + len(body)
    size = draw.usual(size, 15, 16, 17, size - 1, size + 1, 2**32 - 1, 31, 39)
    start = struct.pack("<4sHHLL", draw.usual(b"LOBJ", b"LOBK"), header, version, size, kind)
    padding = draw.one(b"", b"", bytes(size % 4), bytes(draw.number(0, 7)))
    return draw.usual(padding, bytes(8), b"LLOBLOB"[: draw.number(1, 7)]) + start + head + body


def _log(draw: _Draw, form: str) -> bytes:
    if form == "blf":
        records = [_blf_object(draw) for _ in range(RECORDS)]
    else:
        radix = 10 if form == "asc10" else 16
        rows = (
            _candump_row(draw) if form == "candump" else _asc_row(draw, radix)
            for _ in range(RECORDS)
        )  # fmt: skip
        records = [row.encode("latin-1") for row in rows]
    whole = b"".join(map(draw.damaged, records))
    return whole[: len(whole) - draw.one(0, 0, 0, draw.number(0, 40))]


def logs(seed: int) -> Iterator[LogStep]:
    """Yield the logs of a seed, which are the same ones on any machine."""
    rng = np.random.default_rng(seed)
    for number in count():
        draw = _Draw(rng)
        form = ("candump", "asc", "asc10", "blf")[number % 4]
        yield LogStep(
            form,
            _log(draw, form),
            capacity=draw.one(1, 2, 5, ROOM - 1, ROOM - 1),
            times=draw.number(0, 2),
            total=draw.one(0, 0, 0, 10**18, 2**63 - 10**10, 2**63 - 1),
            high=draw.one(0, 0, 0, 0, draw.number(0, 10**9), draw.number(0, 10**13), 10**18),
            channels=draw.one(0, 0, 0, 0, 0, MAX_CHANNELS - 2, MAX_CHANNELS),
            start_ns=draw.one(0, 1_700_000_000 * 10**9, -(10**18), 2**62),
        )


# ---- both: calls of a parser, and on behind what is left ----------------------------------------


def _answers(step: LogStep, parse: Callable[[bytes], list[Any]]) -> list[Any]:
    """Return the answers of a parser to its calls, each of which begins with the place reached."""
    found, place = list[Any](), 0
    while place < len(step.data) and len(found) < CALLS:
        answer = parse(step.data[place:])
        found.append(answer)
        place += answer[0]
        if answer[1] < step.capacity:  # a record is left: it is skipped
            mark = b"LOBJ" if step.form == "blf" else b"\n"
            after = step.data.find(mark, place + (step.form == "blf"))
            place = len(step.data) if after < 0 else after + (step.form != "blf")
    return found


# ---- the core ---------------------------------------------------------------------------------


def core_answer(step: LogStep) -> list[Any]:
    """Return the answers of the core."""
    arrays: dict[str, Any] = {
        "can_id": np.empty(ROOM, np.uint32),
        "is_extended": np.empty(ROOM, np.uint8),
        "t_ns": np.empty(ROOM, np.int64),
        "channel": np.empty(ROOM, np.uint16),
        "length": np.empty(ROOM, np.uint8),
        "data": np.empty((ROOM, 64), np.uint8),
    }
    log = structure("maplines_log_t", {"capacity": step.capacity, **arrays})
    log.times, log.sum, log.high, log.channels = step.times, step.total, step.high, step.channels
    for i in range(step.channels):
        log.names[i][0 : len(f"c{i}")] = f"c{i}".encode()

    def parse(data: bytes) -> list[Any]:
        for array in arrays.values():
            array.view(np.uint8)[:] = UNTOUCHED
        text = ffi.from_buffer(data)
        if step.form == "blf":
            place = lib.maplines_parse_blf(log, len(data), text, step.start_ns)
        elif step.form == "candump":
            place = lib.maplines_parse_candump(log, len(data), text)
        else:
            place = lib.maplines_parse_asc(log, len(data), text, 10 if step.form == "asc10" else 16)
        n, last = log.frames, log.channels
        beyond = [array[n:].view(np.uint8) for array in arrays.values()]
        return [
            place, n, [array[:n].tolist() for array in arrays.values()],
            all((rest == UNTOUCHED).all() for rest in beyond),
            [*log.skipped] if step.form == "blf" else [log.rows, log.sum, log.high],
            last, [ffi.string(log.names[i]).decode("latin-1") for i in range(last)],
        ]  # fmt: skip

    return _answers(step, parse)


# ---- the model --------------------------------------------------------------------------------

_STAMP = rb"(\d{1,10})\.(\d{1,9})"
_CANDUMP = re.compile(
    rb"\(" + _STAMP + rb"\) ([!-~]{1,64}) ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(?:#[0-9A-Fa-f])?"
    rb"((?:[0-9A-Fa-f]{2}){0,64})(?: [RT])?\r?\n"
)
_CLASSIC = {
    radix: re.compile(
        rb" *" + _STAMP + rb" +(\d{1,4}) +(" + digit + rb"{1,9})(x?) +[RT]x +d +([0-8])(?![^ \r\n])"
    )
    for radix, digit in ((10, rb"[0-9]"), (16, rb"[0-9A-Fa-f]"))
}
_FD = re.compile(
    rb" *" + _STAMP + rb" +CANFD +(\d{1,4}) +[RT]x +([0-9A-Fa-f]{1,9})(x?) +\d +\d +([0-9A-Fa-f]) +"
    rb"(\d{1,2})(?= )"
)
_BYTES = {
    10: re.compile(rb" +(\d{1,3})(?=[ \r\n])"),
    16: re.compile(rb" +([0-9A-Fa-f]{2})(?=[ \r\n])"),
}
#: What else a row says, at most so many characters.
_TAIL = re.compile(rb"(?=[^\n]{0,4096}\n)[ -~]*\r?\n")


class _Frame(NamedTuple):
    """Data frame of a record."""

    can_id: int
    is_extended: bool
    channel: str
    data: bytes
    stamp: int  #: [ns]


@dataclass
class _Model:
    """What a parser knows, and its rules."""

    step: LogStep
    total: int = 0
    high: int = 0
    names: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.total, self.high = self.step.total, self.step.high
        self.names = [f"c{i}" for i in range(self.step.channels)]

    def parse(self, data: bytes) -> list[Any]:
        """Return the answer to a call."""
        frames = list[tuple[_Frame, int, int]]()  # with channel and time
        skipped, place, rows = [0] * 5, 0, 0
        end = len(data) if self.step.form == "blf" else data.rfind(b"\n") + 1
        while place < end and len(frames) < self.step.capacity:
            found = _RECORDS[self.step.form](data, place)
            if found is None:
                break
            after, frame = found
            if isinstance(frame, int):
                skipped[frame] += 1
            else:
                timed = self._timed(frame)
                if timed is None:
                    break
                frames.append(timed)
                rows += 1
            place = after
        columns = [
            [frame.can_id for frame, _, _ in frames],
            [int(frame.is_extended) for frame, _, _ in frames],
            [t_ns for _, _, t_ns in frames],
            [channel for _, channel, _ in frames],
            [len(frame.data) for frame, _, _ in frames],
            [[*frame.data.ljust(64, b"\0")] for frame, _, _ in frames],
        ]
        other = skipped if self.step.form == "blf" else [rows, self.total, self.high]
        return [place, len(frames), columns, True, other, len(self.names), [*self.names]]

    def _timed(self, frame: _Frame) -> tuple[_Frame, int, int] | None:
        """Return a frame with channel and time; None if there is no room, or it may begin again."""
        if frame.channel not in self.names:
            if len(self.names) == MAX_CHANNELS:
                return None
            self.names.append(frame.channel)
        channel, t_ns = self.names.index(frame.channel), frame.stamp
        if self.step.form == "blf":
            return frame, channel, self.step.start_ns + t_ns
        if self.step.times == 1:
            if self.high - t_ns > MAX_DISORDER_NS:
                return None
            self.high = max(self.high, t_ns)
        elif self.step.times == 2:
            if self.total + t_ns >= 2**63:
                return None
            self.total = t_ns = self.total + t_ns
        return frame, channel, t_ns


def model_answer(step: LogStep) -> list[Any]:
    """Return the answers of the model."""
    return _answers(step, _Model(step).parse)


#: The place after a record, and its frame, or what else it is; None if it is left to Python.
_Record = tuple[int, _Frame | int] | None


def _stamp_ns(row: re.Match[bytes]) -> int | None:
    seconds = int(row[1])
    return seconds * 10**9 + int(row[2].ljust(9, b"0")) if seconds <= 9 * 10**9 else None


def _candump(data: bytes, place: int) -> _Record:
    row = _CANDUMP.match(data, place)
    if row is None or (stamp := _stamp_ns(row)) is None or int(row[4], 16) >= 2**29:
        return None
    payload = bytes.fromhex(row[5].decode())
    return row.end(), _Frame(int(row[4], 16), len(row[4]) == 8, row[3].decode(), payload, stamp)


def _asc(radix: int) -> Callable[[bytes, int], _Record]:
    def found(data: bytes, place: int) -> _Record:
        row = _CLASSIC[radix].match(data, place)
        length = int(row[6]) if row else 0
        if row is None and radix == 16 and (row := _FD.match(data, place)):
            length = int(row[7])
            if length == 0 or length != FD_LENGTHS[int(row[6], 16)]:
                return None
        if row is None or (stamp := _stamp_ns(row)) is None:
            return None
        number, can_id, at, values = int(row[3]), int(row[4], radix), row.end(), list[int]()
        for _ in range(length):
            value = _BYTES[radix].match(data, at)
            if value is None or int(value[1], radix) > 255:
                return None
            values.append(int(value[1], radix))
            at = value.end()
        tail = _TAIL.match(data, at)
        if number == 0 or can_id >= 2**29 or tail is None:
            return None
        frame = _Frame(can_id, row[5] == b"x", str(number - 1), bytes(values), stamp)
        return tail.end(), frame

    return found


#: Kinds of what is no frame, by their numbers.
_REQUEST, _REMOTE, _ERROR, _STATE, _OTHER = range(5)
_NO_FRAMES = {2: _ERROR, 73: _ERROR, 104: _ERROR, 4: _STATE, 31: _STATE, 74: _STATE}


def _blf(data: bytes, place: int) -> _Record:
    begin = data.find(b"LOBJ", place, place + 11)
    if begin < 0 or len(data) - begin < 16:
        return None
    _, _, version, size, kind = struct.unpack_from("<4sHHLL", data, begin)
    if not 16 <= size <= len(data) - begin or kind == 10:
        return None
    end = begin + size
    if kind not in _FRAMES:
        return end, _NO_FRAMES.get(kind, _OTHER)
    header = {1: 32, 2: 40}.get(version, size + 1)
    whole = data[begin:end]
    try:
        found = _BLF_FRAMES[kind](whole[header:], header)
    except struct.error:
        return None
    if found is None or isinstance(found, int):
        return None if found is None else (end, found)
    unit, ticks = struct.unpack_from("<L4xQ", whole, 16)
    if found.channel == "-1" or ticks >= 2**48:
        return None
    return end, found._replace(stamp=ticks * (10_000 if unit == 1 else 1))


def _frame(channel: int, can_id: int, data: bytes) -> _Frame:
    return _Frame(can_id % 2**29, can_id >= 2**31, str(channel - 1), data, 0)


def _blf_classic(body: bytes, _: int) -> _Frame | int | None:
    channel, flags, dlc, can_id, data = struct.unpack_from("<HBBL8s", body)
    if flags % 16 == 2:
        return _REQUEST
    return _REMOTE if flags & 0x80 else _frame(channel, can_id, data[: min(dlc, 8)])


def _blf_fd(body: bytes, _: int) -> _Frame | int | None:
    channel, flags, _, can_id, length, data = struct.unpack_from("<HBBL6xB5x64s", body)
    if length > 64:
        return None
    if flags % 16 == 2:
        return _REQUEST
    return _REMOTE if flags & 0x80 else _frame(channel, can_id, data[:length])


def _blf_fd_64(body: bytes, header: int) -> _Frame | int | None:
    channel, length, can_id, flags, way, behind = struct.unpack_from("<BxBxL4xL18xBB4x", body)
    end = behind - header if behind else len(body)
    if length > 64 or not 40 <= end <= len(body):
        return None
    if way == 2 or flags & 0xC0 == 0x80:
        return _REQUEST
    return (
        _REMOTE
        if flags & 0x10
        else _frame(channel, can_id, body[40:end][:length].ljust(length, b"\0"))
    )


_BLF_FRAMES = {1: _blf_classic, 86: _blf_classic, 100: _blf_fd, 101: _blf_fd_64}
_RECORDS: dict[str, Callable[[bytes, int], _Record]] = {
    "candump": _candump, "asc": _asc(16), "asc10": _asc(10), "blf": _blf,
}  # fmt: skip


# ---- the comparison ---------------------------------------------------------------------------


def compare_logs(seed: int, is_over: Callable[[], bool]) -> StreamComparison:
    """Compare core and model until it is over.

    Args:
        seed: of the logs.
        is_over: asked after every fifty logs.
    """
    done, stream = 0, logs(seed)
    while True:
        for step in islice(stream, STEPS):
            core, model = bits(core_answer(step)), bits(model_answer(step))
            if core != model:
                shown = str(step), "the answer", str(core), str(model)
                return StreamComparison(
                    done, "damaged logs", Difference(f"logs, seed {seed}", done, *shown)
                )
            done += 1
        if is_over():
            return StreamComparison(done, "damaged logs")
