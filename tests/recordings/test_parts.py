"""A part of a log, by time and by channel: the rows of the whole log, which is not read further."""

from __future__ import annotations

import csv
import io
import json
import math
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplines_can import Codec, Slot
from maplines_can.bus import read_log
from maplines_can.cli import main
from maplines_can.logs.log_part import AFTER, Window, of_channel, time_of
from maplines_can.recordings.line_tables import LineTable, joined
from maplines_can.recordings.plots import recorded
from maplines_can.recordings.read_lines import line_tables, read_lines
from maplines_can.values.errors import LogError
from maplines_can.wire import default_dbc_path

INF = math.inf
POSE_DBC = default_dbc_path("maplines-pose.dbc")
#: Times of a window [s], from the first line on.
TIMES = [(2.0, 5.0), (-INF, 1.5), (9.0, INF), (0.0, 0.0001), (3.3333, 3.4)]


def check_part(part: LineTable, whole: LineTable, low: float, high: float) -> None:
    """Check that a part has the rows of the whole in a time of the clock."""
    for name, table in part.parts.items():
        rows = whole.parts[name].where(
            (whole.parts[name]["t"] >= low) & (whole.parts[name]["t"] <= high)
        )
        assert len(table) == len(rows)
        for column in rows.columns:
            np.testing.assert_array_equal(table.columns[column], rows.columns[column], column)


@pytest.mark.parametrize("is_absolute", [False, True])
@pytest.mark.parametrize("time", TIMES)
def test_a_window_has_the_rows_of_the_whole_log(
    faulty_log: Path, scene_log: Path, time: tuple[float, float], is_absolute: bool
) -> None:
    """Lines, scenes and dropped frames, in blocks of any length."""
    for log, options in ((faulty_log, {}), (scene_log, {"dbc": POSE_DBC, "scenes": True})):
        whole = read_lines(log, at=[20.0], **options)  # type: ignore[arg-type]
        begin = whole["t"][0]
        low, high = (t + begin for t in time)
        window = (low, high) if is_absolute else time
        for block_frames in (50, 1 << 16):
            tables = [
                *line_tables(
                    log,
                    at=[20.0],
                    time=window,
                    block_frames=block_frames,
                    **options,  # type: ignore[arg-type]
                )
            ]
            check_part(joined(tables), whole, low, high)


def test_a_window_of_slots_begins_with_their_first_line(faulty_log: Path) -> None:
    """As in a plot, which has the same rows."""
    table = read_lines(faulty_log, slots=[Slot.EGO_RIGHT], time=(1.0, 2.0))
    whole = read_lines(faulty_log, slots=[Slot.EGO_RIGHT])
    begin = whole["t"][0]
    check_part(table, whole, begin + 1.0, begin + 2.0)
    codec = Codec.from_dbc()
    drawn, _ = recorded(faulty_log, codec, [], slots=[Slot.EGO_RIGHT], time=(1.0, 2.0))
    (line,) = drawn.lines.values()
    np.testing.assert_allclose(line["t"], table["t"] - begin)


def test_the_log_is_not_read_after_the_window(faulty_log: Path, tmp_path: Path) -> None:
    """Damage further on is not met; the frames just after it are, so that lines are whole."""
    rows = faulty_log.read_text().splitlines(keepends=True)
    start = float(rows[0][1:].partition(")")[0])
    kept = [row for row in rows if float(row[1:].partition(")")[0]) <= start + 5 + AFTER]
    path = tmp_path / "damaged.log"
    path.write_text("".join(kept) + "garbage\n" * 5 + "".join(rows[len(kept) :]))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        table = read_lines(path, time=(1.0, 3.0))
    whole = read_lines(faulty_log)
    check_part(table, whole, *(t + whole["t"][0] for t in (1.0, 3.0)))
    assert len(table) > 50
    with pytest.warns(UserWarning, match="records are damaged"):
        read_lines(path)


@pytest.fixture
def two(faulty_log: Path, tmp_path: Path) -> Path:
    """Two channels: the log, and the same 30 ms later."""
    rows = []
    for row in faulty_log.read_text().splitlines():
        stamp, _, rest = row[1:].partition(") ")
        _, _, frame = rest.partition(" ")
        rows += [(float(stamp), f"a {frame}"), (float(stamp) + 0.03, f"b {frame}")]
    path = tmp_path / "two.log"
    path.write_text("".join(f"({t:.6f}) {rest}\n" for t, rest in sorted(rows)))
    return path


def test_a_channel_has_its_own_lines(two: Path, tmp_path: Path) -> None:
    """Those of a log of this channel only; a window counts from its first one."""
    one = tmp_path / "one.log"
    rows = two.read_text().splitlines(keepends=True)
    one.write_text("".join(row for row in rows if ") b " in row))
    for time in ((-INF, INF), (2.0, 3.0)):
        part, whole = read_lines(two, channel="b", time=time), read_lines(one, time=time)
        assert set(part["channel"]) == {"b"}
        for column in whole.columns:
            if column != "channel":
                np.testing.assert_array_equal(part.columns[column], whole.columns[column])
    assert [*of_channel(read_log(two), "b", two)] == [*read_log(one)]
    drawn, _ = recorded(two, Codec.from_dbc(), [], channel="b")
    assert not any(name.startswith(("a ", "b ")) for name in drawn.lines)


@pytest.mark.parametrize("channel", ["c", ""])
def test_a_channel_that_is_not_there_is_an_error(two: Path, channel: str) -> None:
    words = f"has no frame of channel '{channel}'; there are 'a', 'b'"
    for read in (
        lambda: read_lines(two, channel=channel),
        lambda: list(of_channel(read_log(two), channel, two)),
        lambda: recorded(two, Codec.from_dbc(), [], channel=channel),
    ):
        with pytest.raises(LogError, match=words):
            read()


def test_a_log_without_times_has_no_windows(tmp_path: Path, faulty_log: Path) -> None:
    path = tmp_path / "bare.log"
    rows = faulty_log.read_text().splitlines()[:200]
    bare = []
    for row in rows:
        _, channel, frame = row.split()[:3]
        can_id, _, data = frame.partition("#")
        spaced = " ".join(data[k : k + 2] for k in range(0, len(data), 2))
        bare.append(f"  {channel}  {can_id}   [{len(data) // 2}]  {spaced}\n")
    path.write_text("".join(bare))
    with pytest.warns(UserWarning, match="has no time stamps, so that no time can be chosen"):
        read_lines(path, time=(0, 1))


@pytest.mark.parametrize("time", [(1.0, 1.0), (2.0, 1.0), (math.nan, 1.0), (0.0, math.nan)])
def test_a_window_that_is_none_is_refused(faulty_log: Path, time: Any) -> None:
    with pytest.raises(ValueError, match="time must be"):
        read_lines(faulty_log, time=time)


@pytest.mark.parametrize("text", ["", "5", "5..4", "a..b", "1..x", "..nan"])
def test_texts_that_are_no_time(text: str) -> None:
    with pytest.raises(ValueError, match=r"must be FROM\.\.TO in seconds"):
        time_of(text)


def test_before_the_first_line_a_window_is_open_or_closed() -> None:
    assert Window((-INF, 5.0)).has(0.0)
    assert not Window((0.0, 5.0)).has(0.0)
    assert not Window((0.0, 5.0)).is_over(10**18)
    assert Window((1.7e9, 1.8e9)).is_over(round(1.9e18))


def printed(capsys: pytest.CaptureFixture[str], *words: str, status: int = 0) -> str:
    assert main([*words]) == status
    return capsys.readouterr().out


def test_decode_prints_and_writes_the_same_part(
    two: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As JSON, as CSV, and as a table, of one channel and of some slots."""
    part = ["--time", "2..4", "--channel", "b", "--slots", "ego-left"]
    table = read_lines(two, channel="b", slots=[Slot.EGO_LEFT], time=(2.0, 4.0))
    rows = [json.loads(row) for row in printed(capsys, "decode", str(two), *part).splitlines()]
    assert [row["t"] for row in rows] == table["t"].tolist()
    text = printed(capsys, "decode", str(two), "--csv", *part)
    assert [float(row["t"]) for row in csv.DictReader(io.StringIO(text))] == table["t"].tolist()
    out = tmp_path / "part.csv"
    printed(capsys, "decode", str(two), "-o", str(out), *part)
    with out.open() as file:
        assert [float(row["t"]) for row in csv.DictReader(file)] == table["t"].tolist()
    folder = tmp_path / "set"
    printed(capsys, "decode", str(two), "-o", str(folder), "--format", "csv", "--jobs", "1", *part)
    with (folder / "lines" / "two.csv").open() as file:
        assert [float(row["t"]) for row in csv.DictReader(file)] == table["t"].tolist()
    head = json.loads((folder / "manifest.jsonl").read_text().splitlines()[0], parse_constant=int)
    assert (head["tables"]["time"], head["tables"]["channel"]) == ([2.0, 4.0], "b")


def test_decode_prints_the_scenes_of_a_window(
    scene_log: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["decode", str(scene_log), "--dbc", str(POSE_DBC), "--scenes"]
    whole = [json.loads(row) for row in printed(capsys, *words).splitlines()]
    part = [json.loads(row) for row in printed(capsys, *words, "--time", "2..3").splitlines()]
    of_scenes = [row for row in whole if "scene" in row]
    begin = next(row["t"] for row in whole if "scene" not in row)
    wanted = [row for row in of_scenes if begin + 2 <= row["t"] <= begin + 3]
    assert [row for row in part if "scene" in row] == wanted
    assert wanted


@pytest.mark.parametrize(
    "words", [["decode"], ["decode", "-o", "OUT.csv"], ["plot", "-o", "OUT.svg"]]
)
def test_commands_name_the_channels(
    two: Path, tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    words = [word.replace("OUT", str(tmp_path / "out")) for word in words]
    assert main([words[0], str(two), *words[1:], "--channel", "c"]) == 1
    assert "has no frame of channel 'c'; there are 'a', 'b'" in capsys.readouterr().err


@pytest.mark.parametrize(
    "words", [["decode"], ["decode", "-o", "OUT.csv"], ["plot", "-o", "OUT.svg"]]
)
def test_a_time_before_the_log_is_an_error(
    two: Path, tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    words = [word.replace("OUT", str(tmp_path / "out")) for word in words]
    assert main([words[0], str(two), *words[1:], "--time", "1.5e9..1.6e9"]) == 1
    assert "begins after the time 1.6e+09 s" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["decode"], ["decode", "-o", "OUT.csv"]])
def test_a_time_after_the_log_is_said(
    two: Path, tmp_path: Path, words: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    words = [word.replace("OUT", str(tmp_path / "out")) for word in words]
    part = ["--time", "50..", "--slots", "ego-left"]
    assert main([words[0], str(two), *words[1:], *part]) == 0
    assert "lines, none of --slots ego-left and in --time" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["decode", "plot", "accuracy", "replay"])
def test_a_time_that_is_none_ends_a_command(
    faulty_log: Path, command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="2"):
        main([command, str(faulty_log), "--time", "5..4"])
    assert "--time: must be FROM..TO in seconds" in capsys.readouterr().err


def test_accuracy_of_a_part(
    faulty_log: Path, two: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of some slots in a time: fewer lines than of all."""
    truth = str(faulty_log.with_name("truth.csv"))
    whole = json.loads(printed(capsys, "accuracy", truth, str(faulty_log), "--json"))
    options = ["--time", "2..4", "--slots", "ego-left,ego-right", "--channel", "a"]
    part = json.loads(printed(capsys, "accuracy", truth, str(two), "--json", *options))
    table = read_lines(two, channel="a", slots=[Slot.EGO_LEFT, Slot.EGO_RIGHT], time=(2.0, 4.0))
    assert part["received"] == len(table) < whole["received"]
    assert main(["accuracy", truth, str(two), "--time", "50.."]) == 1
    assert "none of its lines is in the part that was chosen" in capsys.readouterr().err


def test_consume_of_a_part(scene_log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The cycles in the time, counted from the begin of the log."""
    words = [
        "consume",
        "steer",
        str(scene_log),
        "--dbc",
        str(POSE_DBC),
        "--json",
        "--every",
        "0.05",
    ]
    whole = [json.loads(row) for row in printed(capsys, *words).splitlines()]
    part = [json.loads(row) for row in printed(capsys, *words, "--time", "2..4").splitlines()]
    times = [row["t"] for row in part if "t" in row]
    assert 30 < len(times) < 50
    assert set(times) < {row["t"] for row in whole if "t" in row}
    assert main(["consume", "steer", "--dbc", str(POSE_DBC), "--time", "2..4"]) != 0
    assert "--time is a part of LOG" in capsys.readouterr().err
