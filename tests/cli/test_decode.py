"""The command ``maplines decode``."""

import csv
import json
import math
import re
from pathlib import Path
from typing import Any

import can
import pytest
from support.fake_bus import message_of
from support.fixtures import Capture
from support.lines import scenario_lines

from maplines_can import Codec, MapLine, Slot
from maplines_can.cli import main
from maplines_can.simulation import scenario


@pytest.fixture
def log(tmp_path: Path) -> Any:
    """A candump log of 20 lines on can0 and 5 on can1, a foreign frame and an incomplete line."""
    codec, path = Codec.from_dbc(), tmp_path / "drive.log"
    encoder = codec.encoder()
    lines = scenario_lines(scenario("highway"))
    with can.Logger(path) as writer:
        t = 1000.0
        for k in range(5):
            for line in lines:
                for frame in encoder.encode(line):
                    t += 0.0002
                    writer(message_of(frame, timestamp=t, channel="can0"))
            for frame in encoder.encode(lines[0]):
                writer(message_of(frame, timestamp=t, channel="can1"))
            if k == 2:
                writer(can.Message(t, 0x7AA, is_extended_id=False, data=b"hello", channel="can0"))
                for frame in encoder.encode(lines[1])[:2]:
                    writer(message_of(frame, timestamp=t, channel="can0"))
            t += 0.05
    return path


def test_lines_are_printed_as_json(capsys: Capture, log: Any) -> None:
    """Every line of every channel is printed, then the dropped frames."""
    assert main(["decode", str(log)]) == 0
    out, err = capsys.readouterr()
    rows = [json.loads(row) for row in out.splitlines()]
    assert sum(row["channel"] == "can0" for row in rows) == 20
    assert sum(row["channel"] == "can1" for row in rows) == 5
    times = [row["t"] for row in rows if row["channel"] == "can0"]
    assert times == sorted(times)
    assert "1 foreign" in err
    assert "2 timeout" in err


def test_numbers_of_a_csv_are_the_shortest_that_read_back(capsys: Capture, tmp_path: Path) -> None:
    """Each cell is the number of the JSON row; ranges and ages of scenes are short decimals."""
    log, dbc = str(tmp_path / "drive.log"), ["--dbc", "maplines-pose.dbc"]
    fast = ["--as-fast-as-possible", "--record", log, "--truth", str(tmp_path / "truth.csv")]
    assert main(["drive", *fast, *dbc, "--seconds", "2", "--rate", "20"]) == 0
    capsys.readouterr()
    assert main(["decode", log, *dbc]) == 0
    wanted = [json.loads(row) for row in capsys.readouterr().out.splitlines()]
    assert main(["decode", log, *dbc, "--csv"]) == 0
    rows = list(csv.DictReader(capsys.readouterr().out.splitlines()))

    assert len(rows) == len(wanted) > 100
    for row, line in zip(rows, wanted, strict=True):
        numbers = {name: line[name] for name in ("t", "x_min", "x_max", "age")} | line["mean"]
        assert {name: float(row[name]) for name in numbers} == numbers
        assert all(row[name] == repr(value) for name, value in numbers.items())
        assert re.fullmatch(r"-?\d+\.\d", row["x_min"])
        assert re.fullmatch(r"\d+\.\d", row["x_max"])
        assert len(row["age"]) <= len("0.123456789")


def test_a_line_that_must_not_be_used_has_empty_cells(capsys: Capture, tmp_path: Path) -> None:
    """Out of range, or too old; 1000 m of sigma are no number to compute with."""
    codec, path = Codec.from_dbc(), tmp_path / "a.log"
    encoder = codec.encoder()
    lines = [
        MapLine.mean_only(Slot.EGO_LEFT, [1.75, 0, 0, 0]),
        MapLine.mean_only(Slot.EGO_LEFT, [1e6, 0, 0, 0]),
        MapLine.mean_only(Slot.EGO_LEFT, [1.75, 0, 0, 0], age=math.inf),
    ]
    with can.Logger(path) as writer:
        for t, line in enumerate(lines):
            for frame in encoder.encode(line):
                writer(message_of(frame, timestamp=1000 + 0.05 * t, channel="can0"))
    assert main(["decode", str(path), "--csv"]) == 0
    rows = list(csv.DictReader(capsys.readouterr().out.splitlines()))
    assert [row["status"] for row in rows][1] == "OUT_OF_RANGE"
    values = [name for name in rows[0] if re.match("x_|age|comp|y_off|beta|c0|c1|cov_", name)]
    assert len(values) == 18
    assert all(rows[0][name] for name in values)
    assert not any(row[name] for row in rows[1:] for name in values)


def test_a_damaged_log_is_decoded_as_far_as_possible(capsys: Capture, log: Any) -> None:
    """A truncated record is one error and status 1; the lines before and after it are printed."""
    text = log.read_text().splitlines(keepends=True)
    log.write_text("".join([*text[:40], "(1000.1) can0 34\n", *text[40:]]))
    assert main(["decode", str(log)]) == 1
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 25
    assert "damaged" in err


def test_the_number_of_channels_is_limited(capsys: Capture, tmp_path: Path) -> None:
    """A log with arbitrary channel names does not fill the memory; what is skipped is reported."""
    path = tmp_path / "names.log"
    path.write_text("".join(f"({k}.0) v{k % 300} 340#0011223344556677\n" for k in range(600)))
    assert main(["decode", str(path)]) == 1
    first, second, last = capsys.readouterr().err.splitlines()
    assert first == (
        f"maplines: error: {path}: not read: 88 frames of channels beyond the first 256; "
        "split the log by channel"
    )
    assert "0 lines from 512 frames" in second
    assert "no record of maplines.dbc is whole in 600 frames" in last


@pytest.mark.parametrize(
    ("text", "notes", "status"),
    [
        ("", ["0 lines from 0 frames", "has no frame, read as .trc"], 1),
        (";$FILEVERSION=1.1\n;$STARTTIME=1\n;--\n", ["0 lines", "has no frame"], 1),
        ("1) 2\n1) 0.5 0340 1 11\n", ["1 of 2 records", "1 frame", "1 error", "no record of"], 1),
    ],
)
def test_a_trc_log_is_reported_in_our_words(
    tmp_path: Path, capfd: Capture, text: str, notes: Any, status: int
) -> None:
    """Messages that python-can prints about a .trc file do not reach the user."""
    path = tmp_path / "a.trc"
    path.write_text(text)
    assert main(["decode", str(path)]) == status
    rows = capfd.readouterr().err.splitlines()
    assert all(note in row for note, row in zip(notes, rows, strict=True)), rows


def drive(path: Any, *, cycle: Any, channels: Any = ("can0",), cut: Any = (), n: int = 20) -> Any:
    """Write a candump log of one slot, a line in each cycle [s], without the lines in ``cut``."""
    (line,) = scenario_lines(scenario("highway"), 1)
    encoders = {channel: Codec.from_dbc().encoder() for channel in channels}
    with can.Logger(path) as writer:
        for k in range(n):
            for channel, encoder in encoders.items():
                frames = encoder.encode(line)
                for frame in frames if (channel, k) not in cut else []:
                    writer(message_of(frame, timestamp=1000 + k * cycle, channel=channel))
    return str(path)


def test_the_state_of_each_slot_is_printed(slot_notes: Any, tmp_path: Path) -> None:
    """Missing lines are counted as lost; slots without any line are not printed."""
    path = drive(tmp_path / "cut.log", cycle=0.05, cut={("can0", 8), ("can0", 13)})
    assert main(["decode", path]) == 0
    (note,) = slot_notes()
    assert note == (
        "maplines: ego left: VALID; 18 ok, 2 lost, 0 repeated, 0 wrong sequence, 0 errors, "
        "2 cycles without data"
    )


def test_the_channel_of_a_slot_is_printed(slot_notes: Any, tmp_path: Path) -> None:
    """If there are several channels; the end of the log is the same time for all of them."""
    cut = {("can1", k) for k in range(10, 20)}
    path = drive(tmp_path / "two.log", cycle=0.05, channels=("can0", "can1"), cut=cut)
    assert main(["decode", path, "--csv"]) == 0
    first, second = slot_notes()
    assert first.startswith("maplines: can0 ego left: VALID; 20 ok, 0 lost")
    assert second.startswith("maplines: can1 ego left: no data any more, INVALID; 10 ok, 0 lost")
    assert second.endswith("9 cycles without data")


def test_the_cycle_time_decides_how_many_cycles_are_missing(
    slot_notes: Any, tmp_path: Path
) -> None:
    """A log of 2 Hz is complete with --cycle-ms 500, and incomplete for the 20 Hz of the DBC."""
    path = drive(tmp_path / "slow.log", cycle=0.5)
    assert main(["decode", path, "--cycle-ms", "500"]) == 0
    (with_cycle,) = slot_notes()
    assert main(["decode", path]) == 0
    (without,) = slot_notes()
    assert with_cycle.startswith("maplines: ego left: VALID; 20 ok, 0 lost")
    assert with_cycle.endswith(" 0 cycles without data")
    assert not without.startswith("maplines: ego left: VALID")
    assert without.endswith(f" {19 * 9} cycles without data")


def test_the_time_out_of_a_transfer_is_an_option(capsys: Capture, tmp_path: Path) -> None:
    """60 ms between two frames are not too long; with an option, they are."""
    path = tmp_path / "held-up.log"
    frames = Codec.from_dbc().encoder().encode(MapLine.mean_only(Slot.EGO_LEFT, [1.75, 0, 0, 0]))
    with can.Logger(path) as writer:
        for t, frame in zip((1.0, 1.0002, 1.0602, 1.0604), frames, strict=True):
            writer(message_of(frame, timestamp=t, channel="can0"))
    assert main(["decode", str(path)]) == 0
    assert "1 line from 4 frames" in capsys.readouterr().err
    assert main(["decode", str(path), "--transfer-timeout", "25"]) == 0
    out, err = capsys.readouterr()
    assert (out, "0 lines from 4 frames" in err) == ("", True)
