"""Log files that the project writes, read by its own reader and by python-can."""

from datetime import datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from maplines_can import read_log
from maplines_can.bus import LogWriter
from maplines_can.values.errors import LogError, MissingExtraError
from maplines_can.wire import Frame

START = 1_700_000_000.0
FRAMES = [
    Frame(0x340, bytes(range(8))),
    Frame(0x12345, b"\1\2\3", is_extended=True),
    Frame(0x348, bytes(32), is_fd=True),
]


def write(path: Path, frames: list[Frame]) -> None:
    with LogWriter(path, START) as log:
        for i, frame in enumerate(frames):
            log.write(frame, START + 1.5 + i / 8)
        assert log.frames == len(frames)


@pytest.mark.parametrize("suffix", [".log", ".asc", ".blf", ".mf4", ".LOG"])
def test_the_frames_are_read_as_written(tmp_path: Path, suffix: str) -> None:
    """By both readers, as sent ones; the stamps of .asc count from the start of the log."""
    if suffix == ".mf4":
        pytest.importorskip("asammdf")
    path = tmp_path / f"drive{suffix}"
    write(path, FRAMES)
    read = list(read_log(path))
    expected = [(f.can_id, f.data, f.is_extended) for f in FRAMES]
    assert [(f.can_id, f.data, f.is_extended) for f in read] == expected
    start = 0 if suffix == ".asc" else round(START * 1e9)
    stamps = np.array([f.t_ns - start for f in read]) / 1e9
    assert stamps == pytest.approx([1.5, 1.625, 1.75], abs=1e-5)
    if suffix not in (".LOG", ".mf4"):
        messages = list(can.LogReader(path))
        assert [bytes(m.data) for m in messages] == [f.data for f in FRAMES]
        assert [m.is_fd for m in messages] == [f.is_fd for f in FRAMES]
    if suffix == ".asc":
        assert [message.is_rx for message in messages] == [False] * 3
        assert [message.bitrate_switch for message in messages] == [False, False, True]


def test_other_formats_are_refused_before_the_file_is_touched(tmp_path: Path) -> None:
    path = tmp_path / "drive.txt"
    with pytest.raises(LogError, match=r"'.txt'; use .log, .asc, .blf, .mf4"):
        LogWriter(path, START)
    assert not path.exists()


def test_a_file_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"no/drive.log: cannot be written: No such"):
        LogWriter(tmp_path / "no" / "drive.log", START)


def test_mf4_without_its_package_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The other formats need none."""
    monkeypatch.setattr("maplines_can.logs.log_writer.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"writing \.mf4 needs asammdf"):
        LogWriter(tmp_path / "drive.mf4", START)
    write(tmp_path / "drive.log", FRAMES)


#: Times from the start [us], the last of which are no multiples of a power of two.
STAMPS_US = [0, 10_000, 290_000, 1_234_567, 5_000_001, 3_600_000_003]


@pytest.mark.parametrize("start", [0.0, 5.0, 946_684_800.0, 1_700_000_000.123456])
def test_all_formats_have_the_same_times(tmp_path: Path, start: float) -> None:
    """Exact ones; those of ASC count from the start, and so do the ticks of BLF and MF4."""
    found = {}
    for suffix in (".log", ".asc", ".blf", *([".mf4"] if find_spec("asammdf") else [])):
        path = tmp_path / f"drive{suffix}"
        with LogWriter(path, start) as log:
            for us in STAMPS_US:
                log.write(FRAMES[us % 3], start + us / 1e6)
        begin = 0 if suffix == ".asc" else round(start * 1e6) * 1000
        found[suffix] = [frame.t_ns - begin for frame in read_log(path)]
    assert found == {key: [us * 1000 for us in STAMPS_US] for key in found}


@pytest.mark.parametrize("suffix", [".blf", ".mf4"])
def test_nanoseconds_from_0_are_kept(tmp_path: Path, suffix: str) -> None:
    """Those of virtual time."""
    if suffix == ".mf4":
        pytest.importorskip("asammdf")
    path = tmp_path / f"drive{suffix}"
    with LogWriter(path, 0.0) as log:
        for t_ns in (1, 10_000_001, 290_000_123):
            log.write(FRAMES[0], t_ns / 1e9)
    assert [frame.t_ns for frame in read_log(path)] == [1, 10_000_001, 290_000_123]


def test_an_mf4_log_begins_at_its_start(tmp_path: Path) -> None:
    """Not today; its master times count from there."""
    asammdf = pytest.importorskip("asammdf")
    path = tmp_path / "drive.mf4"
    write(path, FRAMES)
    with asammdf.MDF(path) as mdf:
        assert mdf.header.start_time.timestamp() == START
        assert mdf.get_master(0).tolist() == [1.5, 1.625, 1.75]


def test_the_dates_of_an_asc_log_are_those_of_its_start(tmp_path: Path) -> None:
    """In both places, with three digits of milliseconds."""
    path = tmp_path / "drive.asc"
    with LogWriter(path, START + 0.007) as log:
        log.write(FRAMES[0], START + 1)
    rows = path.read_text().splitlines()
    dates = [row for row in rows if row.startswith(("date", "Begin"))]
    local = datetime.fromtimestamp(START)
    words = f"{local:%a %b %d %H:%M:%S}.007 {local:%Y}"
    assert dates == [f"date {words}", f"Begin Triggerblock {words}"]


def test_a_frame_before_the_start_of_a_blf_log(tmp_path: Path) -> None:
    """It has the stamp of the start: the format has no earlier ones."""
    path = tmp_path / "drive.blf"
    with LogWriter(path, START) as log:
        log.write(FRAMES[0], START - 1)
    assert [frame.t_ns for frame in read_log(path)] == [round(START * 1e9)]


def test_many_frames_in_containers(tmp_path: Path) -> None:
    """Some frames begin in a container and end in the next one."""
    path = tmp_path / "drive.blf"
    sent = [Frame(0x340, k.to_bytes(8, "big")) for k in range(9000)]
    write(path, sent)
    assert path.read_bytes().count(b"LOBJ") > 3
    assert [frame.data for frame in read_log(path)] == [frame.data for frame in sent]
    assert [bytes(message.data) for message in can.BLFReader(path)] == [f.data for f in sent]


@pytest.mark.parametrize(
    ("frame", "flags", "row"),
    [
        (Frame(0x4, bytes(8)), {"is_error_frame": True}, "20000004#0000000000000000"),
        (Frame(0x1C4, b"\1\2"), {"is_error_frame": True}, "200001C4#0102"),
        (Frame(0x123, b""), {"is_remote_frame": True}, "123#R T"),
        (Frame(0x12345, b"", is_extended=True), {"is_remote_frame": True}, "00012345#R T"),
        (Frame(0x123, b""), {"is_remote_frame": True, "dlc": 4}, "123#R4 T"),
    ],
    ids=["bus-error-class", "several-classes", "remote", "remote-extended", "remote-of-4-bytes"],
)
def test_candump_logs_have_what_candump_writes(
    tmp_path: Path, frame: Frame, flags: dict[str, Any], row: str
) -> None:
    """The class of an error frame, and the length that a remote frame asks for."""
    path = tmp_path / "drive.log"
    with LogWriter(path, 0.0) as log:
        log.write(frame, 1.5, **flags)
        log.write(FRAMES[0], 2.0)
    assert path.read_text().splitlines()[0] == f"(1.500000) vcan0 {row}"
    assert [found.data for found in read_log(path)] == [FRAMES[0].data]


def test_close_may_be_called_again(tmp_path: Path) -> None:
    """The file is complete after the first call, and remains as it is."""
    log = LogWriter(tmp_path / "drive.blf", START)
    log.write(FRAMES[0], START)
    log.close()
    content = log.path.read_bytes()
    assert [frame.data for frame in read_log(log.path)] == [FRAMES[0].data]
    log.close()
    assert log.path.read_bytes() == content
