"""BLF logs of other writers: where objects stand, what they are, their times, and damage.

The bytes are put together by hand, after the objects of the C++ library Vector BLF.
"""

import gzip
import struct
import zlib
from datetime import UTC, datetime
from itertools import cycle
from pathlib import Path

import can
import pytest
from support.recordings import frames_of

from maplines_can.bus import LogFrame, read_log
from maplines_can.logs.frame_block import MAX_OBJECT
from maplines_can.logs.log_summary import Skipped
from maplines_can.recordings.blocks import read_blocks
from maplines_can.values.errors import LogError

START = datetime(2026, 3, 4, 5, 6, 7, 8000, UTC)
START_NS = round(START.timestamp() * 1000) * 10**6
CLASSIC, CLASSIC_2, FD, FD_64 = 1, 86, 100, 101


def head_of(file: bytes, size: int = 144, start: datetime | None = START, level: int = 6) -> bytes:
    """The header of a file with this content."""
    date = (0,) * 8
    if start is not None:
        ms = start.microsecond // 1000
        date = (start.year, start.month, 3, start.day, start.hour, start.minute, start.second, ms)
    head = struct.pack(
        "<4sLLBBBBQQLL8H8H",
        *(b"LOGG", size, 4080200, 2, level, 1, 0, size + len(file), 0, 0, 0, *date, *date),
    )
    return head.ljust(size, b"\0") + file


def thing(kind: int, body: bytes, ticks: int = 0, *, flags: int = 2) -> bytes:
    """An object."""
    head = struct.pack("<4sHHLL", b"LOBJ", 32, 1, 32 + len(body), kind)
    return head + struct.pack("<LHHQ", flags, 0, 0, ticks).ljust(16, b"\0") + body


def classic(data: bytes, can_id: int = 0x340, *, flags: int = 0, channel: int = 1) -> bytes:
    return struct.pack("<HBBL8s", channel, flags, len(data), can_id, data)


def fd(data: bytes, can_id: int = 0x340, *, flags: int = 0) -> bytes:
    fields = (1, flags, can.util.len2dlc(len(data)), can_id, 0, 0, 3, len(data), data)
    return struct.pack("<HBBLLBBB5x64s4x", *fields)


def fd_64(data: bytes, can_id: int = 0x340, *, direction: int = 0, flags: int = 0x3000) -> bytes:
    fields = (1, can.util.len2dlc(len(data)), len(data), can_id, flags, direction)
    return struct.pack("<BBBxL4xL18xB5x", *fields) + data


def container(data: bytes, method: int = 2) -> bytes:
    packed = zlib.compress(data) if method == 2 else data
    head = struct.pack("<4sHHLL", b"LOBJ", 16, 1, 32 + len(packed), 10)
    return head + struct.pack("<H6xL4x", method, len(data)) + packed


def aligned(objects: list[bytes], rule: str) -> bytes:
    """The objects with the padding that a writer adds."""
    out = b""
    for each in objects:
        pad = {"4": -len(each) % 4, "8": -len(out + each) % 8, "%4": len(each) % 4, "no": 0}[rule]
        out += each + bytes(pad)
    return out


def read(path: Path) -> tuple[list[LogFrame], dict[Skipped, int], str, str]:
    """The frames, what is skipped, the kind of times and the error; of both ways to read."""
    found = []
    for log in (read_log(path), read_blocks(path)):
        frames, error = list[LogFrame](), ""
        try:
            for one in log:
                frames += [one] if isinstance(one, LogFrame) else frames_of(one)
        except LogError as raised:
            error = str(raised).removeprefix(f"{path}: ")
        found.append((frames, dict(log.summary.skipped), log.summary.times, error))
    assert found[0] == found[1]
    return found[0]


#: Objects of all kinds of frames, and one of an odd number of bytes between them.
KINDS = cycle([(CLASSIC, classic), (FD_64, fd_64), (CLASSIC_2, classic), (FD, fd)])
OBJECTS = [
    (thing(kind, body(bytes([k] * (k % 9))), k * 10**6), bytes([k] * (k % 9)))
    for k, (kind, body) in zip(range(60), KINDS, strict=False)
]
TEXT = thing(65, b"a text of an odd length")


def inside(objects: list[bytes], rule: str, method: int = 2, size: int = 500) -> list[bytes]:
    """Containers, with objects that begin in one and end in the next."""
    data = aligned(objects, rule)
    return [container(data[k : k + size], method) for k in range(0, len(data), size)]


def mixed(objects: list[bytes], rule: str) -> list[bytes]:
    """Objects beside containers, before and after them."""
    return [*objects[:20], *inside(objects[20:40], rule), *objects[40:]]


LAYOUTS = {
    "containers": inside,
    "not-compressed": lambda objects, rule: inside(objects, rule, 0),
    "one-object-in-many": lambda objects, rule: inside(objects, rule, 2, 7),
    "beside": lambda objects, _: objects,
    "mixed": mixed,
}


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("rule", ["4", "8", "%4", "no"])
@pytest.mark.parametrize("packed", [False, True])
def test_objects_are_read_where_they_stand(
    tmp_path: Path, layout: str, rule: str, packed: bool
) -> None:
    """Inside and outside of containers, with the padding of any writer."""
    path = tmp_path / ("a.blf.gz" if packed else "a.blf")
    outer = LAYOUTS[layout]([each for each, _ in OBJECTS] + [TEXT], rule)
    content = head_of(aligned(outer, rule), {"4": 144, "8": 200, "%4": 72, "no": 145}[rule])
    path.write_bytes(gzip.compress(content) if packed else content)
    frames, skipped, times, error = read(path)

    assert error == ""
    assert [frame.data for frame in frames] == [data for _, data in OBJECTS]
    assert {(frame.can_id, frame.is_extended, frame.channel) for frame in frames} == {
        (0x340, False, "0")
    }
    assert [f.t_ns for f in frames] == [START_NS + k * 10**6 for k in range(len(OBJECTS))]
    assert (skipped, times) == ({Skipped.OTHER: 1}, "absolute")


def test_an_object_that_is_split_around_another(tmp_path: Path) -> None:
    """It begins in a container and ends in the next; an object stands between these."""
    whole, beside = thing(CLASSIC, classic(b"split")), thing(CLASSIC, classic(b"beside"))
    path = tmp_path / "a.blf"
    path.write_bytes(head_of(container(whole[:21]) + beside + container(whole[21:])))
    frames, *_, error = read(path)
    assert ([frame.data for frame in frames], error) == ([b"beside", b"split"], "")


@pytest.mark.parametrize(
    ("kind", "body", "what"),
    [
        pytest.param(CLASSIC, classic(b"ab", flags=0), None, id="rx"),
        pytest.param(CLASSIC, classic(b"ab", flags=1), None, id="tx"),
        pytest.param(CLASSIC, classic(b"ab", flags=2), Skipped.REQUEST, id="request"),
        pytest.param(CLASSIC, classic(b"ab", flags=0x80), Skipped.REMOTE, id="remote"),
        pytest.param(FD_64, fd_64(b"ab", direction=2), Skipped.REQUEST, id="fd-64-request"),
        pytest.param(FD_64, fd_64(b"", flags=0x10), Skipped.REMOTE, id="fd-64-remote"),
        pytest.param(2, bytes(8), Skipped.ERROR, id="error"),
        pytest.param(4, bytes(32), Skipped.STATE, id="statistic"),
        pytest.param(31, bytes(8), Skipped.STATE, id="driver-error"),
        pytest.param(3, bytes(8), Skipped.OTHER, id="overload"),
        pytest.param(11, bytes(40), Skipped.OTHER, id="lin"),
        pytest.param(65, b"", Skipped.OTHER, id="text"),
    ],
)
def test_what_is_no_frame_on_the_bus_is_counted(
    tmp_path: Path, kind: int, body: bytes, what: Skipped | None
) -> None:
    """Three objects of it, between two frames."""
    frame = thing(CLASSIC, classic(b"frame"))
    other = thing(kind, body) * 3
    path = tmp_path / "a.blf"
    path.write_bytes(head_of(container(frame + other + frame)))
    frames, skipped, _, error = read(path)
    assert error == ""
    assert skipped == ({what: 3} if what else {})
    assert len(frames) == (2 if what else 5)
    assert [frames[0].data, frames[-1].data] == [b"frame"] * 2


def test_data_of_fd_frames_that_are_not_all_there(tmp_path: Path) -> None:
    """The others are zero, as for python-can; they end where other fields begin, if there are."""
    cut, extended = fd_64(bytes(range(1, 13))), bytearray(fd_64(bytes(range(1, 13))))
    extended[35] = 32 + 40 + 8
    path = tmp_path / "a.blf"
    path.write_bytes(head_of(container(thing(FD_64, cut[:-4]) + thing(FD_64, bytes(extended)))))
    frames, *_ = read(path)
    assert [frame.data for frame in frames] == [bytes([*range(1, 9), 0, 0, 0, 0])] * 2
    assert [bytes(message.data) for message in can.BLFReader(path)] == [f.data for f in frames]


@pytest.mark.parametrize(
    ("start", "times", "start_ns"),
    [
        (START, "absolute", START_NS),
        (None, "zero", 0),
        (datetime(1969, 1, 1, tzinfo=UTC), "absolute", -365 * 86400 * 10**9),
    ],
)
@pytest.mark.parametrize(
    ("flags", "ticks", "t_ns"),
    [(2, 123_456_789_123_457, 123_456_789_123_457), (1, 29, 290_000), (0, 7, 7)],
)
def test_times_are_exact(
    tmp_path: Path,
    start: datetime | None,
    times: str,
    start_ns: int,
    flags: int,
    ticks: int,
    t_ns: int,
) -> None:
    """To the nanosecond, in ticks of 1 ns or 10 us from the date of the header."""
    path = tmp_path / "a.blf"
    path.write_bytes(head_of(thing(CLASSIC, classic(b""), ticks, flags=flags), start=start))
    (frame,), _, found, _ = read(path)
    assert (frame.t_ns, found) == (start_ns + t_ns, times)


@pytest.mark.parametrize("level", [0, 6])
def test_containers_that_say_they_are_compressed(tmp_path: Path, level: int) -> None:
    """vblf says so in each, and in the header of the file that none is."""
    path = tmp_path / "a.blf"
    data = thing(CLASSIC, classic(b"ab")) * 20
    said = b"".join(
        bytearray(container(data[k : k + 300], 0)[:16])
        + b"\2"
        + container(data[k : k + 300], 0)[17:]
        for k in range(0, len(data), 300)
    )
    path.write_bytes(head_of(said, level=level))
    frames, *_, error = read(path)
    if level == 0:
        assert (len(frames), error) == (20, "")
    else:
        assert frames == []
        assert "not a valid .blf file (error: Error -3 while decompressing data" in error


FRAME = thing(CLASSIC, classic(b"frame"))


@pytest.mark.parametrize(
    ("content", "frames", "words"),
    [
        pytest.param(FRAME * 2 + FRAME[:-1], 2, "truncated after 2 good records, 1 b", id="object"),
        pytest.param(FRAME * 2 + FRAME[:7], 2, "truncated after 2 good records, 9 b", id="head"),
        pytest.param(
            container(FRAME * 2) + container(FRAME * 9, 0)[:-1], 10, "after 10 good records, 1 b",
            id="container",
        ),
        pytest.param(
            container(FRAME * 2 + FRAME[:-1]), 2, "2 good records (BLFParseError: the last object",
            id="last-object",
        ),
        pytest.param(container(FRAME * 2 + bytes(7)), 2, "", id="padding"),
        pytest.param(FRAME * 2 + bytes(7), 2, "", id="padding-of-the-file"),
        pytest.param(FRAME * 2 + bytes(8), 2, "an object does not begin with LOBJ", id="zeros"),
        pytest.param(
            container(FRAME + bytes(12) + FRAME), 1, "an object does not begin with LOBJ",
            id="zeros-inside",
        ),
        pytest.param(FRAME * 2 + FRAME[:8] + bytes(8), 2, "an object has 0 bytes", id="no-size"),
        pytest.param(
            container(FRAME + thing(CLASSIC, classic(b"abc")[:10]) + FRAME), 1,
            "a frame is shorter than its own fields", id="short-frame",
        ),
        pytest.param(
            container(FRAME + thing(FD, fd(b"abc")[:22]) + FRAME), 1, "a frame is shorter than",
            id="short-fd-frame",
        ),
        pytest.param(
            container(FRAME + thing(FD_64, fd_64(b"")[:39]) + FRAME), 1, "a frame is shorter than",
            id="short-fd-64-frame",
        ),
        pytest.param(
            container(FRAME + FRAME.replace(b"\x20\0\1\0", b"\x20\0\3\0") + FRAME), 1,
            "the version 3 of the header of a frame is unknown", id="version",
        ),
        *(
            pytest.param(
                container(FRAME * 2 + FRAME[:8] + struct.pack("<L", size) + FRAME[12:]), 2,
                "damaged after 2 good records (BLFParseError: an object is shorter",
                id=f"object-of-{size}-bytes",  # for which python-can would never end
            )
            for size in (0, 1, 15)
        ),
        pytest.param(container(container(FRAME)), 0, "a container is in another one", id="nested"),
        pytest.param(container(FRAME, 3), 0, "the compression method 3 of a", id="method"),
        pytest.param(
            b"LOBJ\x10\0\1\0\x18\0\0\0\x0a\0\0\0" + bytes(8), 0, "a container is shorter than its",
            id="short-container",
        ),
        pytest.param(
            thing(CLASSIC, classic(b""), 2**63), 0, "the time stamp is beyond 64 bits", id="time"
        ),
    ],
)  # fmt: skip
def test_damage(tmp_path: Path, content: bytes, frames: int, words: str) -> None:
    """What is before it is read; the header knows no size, as after a crash of the writer."""
    path = tmp_path / "a.blf"
    head = bytearray(head_of(b""))
    path.write_bytes(bytes(head) + content)
    found, *_, error = read(path)
    assert [frame.data for frame in found] == [b"frame"] * frames
    assert (words in error) if words else error == ""


def test_a_container_that_is_missing_is_noticed(tmp_path: Path) -> None:
    """By the size of the file that its header states, also in a compressed one."""
    content = head_of(container(FRAME * 2) + container(FRAME * 3))
    cut = content[: content.rindex(b"LOBJ")]
    for path, data in ((tmp_path / "a.blf", cut), (tmp_path / "a.blf.gz", gzip.compress(cut))):
        path.write_bytes(data)
        frames, *_, error = read(path)
        missing = len(content) - len(cut)
        assert len(frames) == 2
        assert error == f"truncated after 2 good records, {missing} bytes are missing"


def test_objects_of_the_least_and_of_the_greatest_size(tmp_path: Path) -> None:
    """A head alone, and as much as a reader holds; also as the last of their container."""
    least = struct.pack("<4sHHLL", b"LOBJ", 16, 1, 16, 65)
    greatest = thing(65, bytes(MAX_OBJECT - 32))
    content = [FRAME, least, container(FRAME + least), container(greatest), container(FRAME)]
    path = tmp_path / "a.blf"
    path.write_bytes(head_of(b"".join(content)))
    frames, skipped, _, error = read(path)
    assert (len(frames), skipped, error) == (3, {Skipped.OTHER: 3}, "")


@pytest.mark.parametrize("year", [2200, 1600])
def test_a_date_that_no_recording_has(tmp_path: Path, year: int) -> None:
    path = tmp_path / "a.blf"
    path.write_bytes(head_of(container(FRAME), start=START.replace(year=year)))
    frames, *_, error = read(path)
    assert frames == []
    assert f"its recording begins in the year {year}" in error
