"""The maplines command, as a user and as a machine sees it."""

import csv
import json
import re
import subprocess
import sys
import uuid
from pathlib import Path

import can
import pytest

from maplines_can import Codec, Link, Slot, Transmitter, scenario
from maplines_can.cli import main
from maplines_can.cli.sending import scene_lines
from maplines_can.scenarios import SCENARIOS

ROOT = Path(__file__).parents[1]


@pytest.fixture
def channel():
    return f"test-{uuid.uuid4()}"


@pytest.fixture
def log(tmp_path):
    """A candump log of 20 lines on can0 and 5 on can1, with a foreign frame and a torn burst."""
    codec, path = Codec.from_dbc(), tmp_path / "drive.log"
    lines = scene_lines(scenario("highway"))
    with can.Logger(path) as writer:
        t = 1000.0
        for k in range(5):
            for line in lines:
                for frame in codec.encode(line):
                    t += 0.0002
                    writer(message(frame, t, "can0"))
            for frame in codec.encode(lines[0]):
                writer(message(frame, t, "can1"))
            if k == 2:
                writer(can.Message(t, 0x7AA, is_extended_id=False, data=b"hello", channel="can0"))
                for frame in codec.encode(lines[1])[:2]:
                    writer(message(frame, t, "can0"))
            t += 0.05
    return path


def message(frame, t, channel):
    return can.Message(
        t, frame.can_id, is_extended_id=False, is_fd=frame.is_fd, data=frame.data, channel=channel
    )


@pytest.mark.parametrize("fd", [False, True])
def test_demo_for_machines(capsys, fd):
    """All lines come back, none lost, with figures for each."""
    arguments = ["demo", "--seconds", "0.3", "--rate", "50", "--json", *(["--fd"] if fd else [])]
    assert main([*arguments, "--scenario", "production", "--lines", "8"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert (result["lines_lost"], result["frames_lost"]) == (0, 0)
    lines = result["sent"]["lines"]
    assert lines == result["received"]["lines"] > 0
    assert lines + result["sent"]["overruns"] == 15 * 8  # a busy machine may skip periods
    assert result["sent"]["frames"] == lines * (1 if fd else 4)
    assert [line["slot"] for line in result["lines"]] == [slot.name for slot in Slot]
    for line in result["lines"]:
        assert line["kl_covered"] < 0.02
        assert abs(line["lateral_error_80m"]) < 0.005
        assert 1 <= line["sigma_80m"] / line["true_sigma_80m"] < 1.06


def test_demo_for_people(capsys, tmp_path):
    """The table names each line, and the picture is drawn."""
    pytest.importorskip("matplotlib")
    picture = tmp_path / "demo.png"
    assert main(["demo", "--seconds", "0.2", "--map-error", "0.1", "--plot", str(picture)]) == 0
    text = capsys.readouterr().out
    for words in ("ego left", "next right", "KL", "at 80 m", "bus load  8.6 % at 500 kbit/s"):
        assert words in text
    assert re.search(r"lost +0 lines, 0 frames", text)
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", SCENARIOS)
def test_demo_of_each_scenario(capsys, name):
    """Every scene goes over the bus and back."""
    assert main(["demo", "--seconds", "0.1", "--scenario", name, "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["lines_lost"] == 0


def test_a_mixture_goes_over_the_bus_and_back(capsys, channel):
    """Three parts a line are three bursts, and one line at the other end."""
    assert main(["demo", "--seconds", "0.2", "--components", "3", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["sent"]["frames"] == 3 * 4 * result["sent"]["lines"]
    assert result["lines_lost"] == result["frames_lost"] == 0
    with (
        Link(interface="virtual", channel=channel) as link,
        Transmitter(link, Codec.from_dbc(), period=0.05) as transmitter,
    ):
        transmitter.publish(scene_lines(scenario("street-turn"), 2, components=3))
        bus = ["--interface", "virtual", "--channel", channel]
        assert main(["receive", *bus, "--count", "2", "--json"]) == 0
    row = json.loads(capsys.readouterr().out.splitlines()[0])
    assert row["components"] == 3
    assert sum(row["mixture"]["weights"]) == 1


def test_a_sender_chooses_its_parts(capsys):
    """One for a good pose; in a turn as many as the bend asks for, or as the bound allows."""

    def demo(name, *more):
        command = ["demo", "--components", "auto", "--seconds", "0.1", "--rate", "50", "--json"]
        assert main([*command, "--scenario", name, *more]) == 0
        result = json.loads(capsys.readouterr().out)
        return result["bus_load"], result["parts"]

    assert [line["parts"] for line in demo("production")[1]] == [1] * 4
    load, lines = demo("street-turn-10deg", "--max-load", "0.5")
    assert load == pytest.approx(sum(line["parts"] for line in lines) * 4 * 135 * 50 / 500_000)
    assert 0.5 - 4 * 135 * 50 / 500_000 < load <= 0.5
    for line in demo("street-turn-10deg", "--fd")[1]:
        assert line["remaining_nonlinearity"] <= 0.3 < line["nonlinearity"]


def test_the_choice_is_printed(capsys, channel):
    """By the demo under each line, by a sender before it starts, and in its counters."""
    turn = ["--components", "auto", "--scenario", "street-turn-10deg", "--lines", "2", "--fd"]
    assert main(["demo", "--seconds", "0.1", *turn]) == 0
    send = ["send", "--interface", "virtual", "--channel", channel, "--rate", "50", "--count", "2"]
    assert main([*send, *turn]) == 0
    out, err = capsys.readouterr()
    for text in (out, err):
        assert "5 parts, nonlinearity 0.87, 0.26 within them" in text
    assert main([*send, *turn, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert [line["parts"] for line in result["parts"]] == [4, 5]
    assert result["frames"] / result["lines"] > 4


def test_figures_are_drawn_where_they_are_asked_for(capsys, tmp_path):
    """Every figure in both formats; how they look is tests/test_figures.py's."""
    pytest.importorskip("matplotlib")
    assert main(["figures", "--out", str(tmp_path), "--samples", "1000", "--json"]) == 0
    paths = json.loads(capsys.readouterr().out)
    assert {Path(path).suffix for path in paths} == {".png", ".svg"}
    assert all(Path(path).stat().st_size for path in paths)


def test_truth_as_a_table_for_machines(capsys):
    """One scene, few samples: a row for each representation, before and after the wire."""
    arguments = ["truth", "--scenario", "production", "--samples", "20000", "--format", "csv"]
    assert main(arguments) == 0
    rows = list(csv.DictReader(capsys.readouterr().out.splitlines()))
    assert {row["wire"] for row in rows} == {"before", "after"}
    assert len(rows) >= 2 * 6


def test_bus_load_is_that_of_the_frames(capsys):
    """Four lines of four frames of at most 135 bits at 20 Hz and 500 kbit/s: 8.64 %."""
    main(["demo", "--seconds", "0.1", "--json"])
    load = json.loads(capsys.readouterr().out)["bus_load"]
    assert load == pytest.approx(4 * 4 * 135 * 20 / 500_000)


def test_receive_prints_lines_until_the_count(capsys, channel):
    """JSON lines on standard output, the counters on standard error."""
    with (
        Link(interface="virtual", channel=channel) as link,
        Transmitter(link, Codec.from_dbc(), period=0.02) as transmitter,
    ):
        for line in scene_lines(scenario("highway")):
            transmitter.publish(line)
        bus = ["--interface", "virtual", "--channel", channel]
        assert main(["receive", *bus, "--count", "8", "--json"]) == 0
        assert main(["receive", *bus, "--count", "2"]) == 0
    out, err = capsys.readouterr()
    rows = [json.loads(row) for row in out.splitlines()[:8]]
    assert {row["slot"] for row in rows} == {"EGO_LEFT", "EGO_RIGHT", "NEXT_LEFT", "NEXT_RIGHT"}
    assert rows[0]["status"] == "FULL"
    assert "y_off" in out.splitlines()[8]
    assert "0 lines lost" in err


def test_receive_ends_when_nothing_comes(capsys, channel):
    """A silent bus is a nonzero status where lines were asked for."""
    bus = ["--interface", "virtual", "--channel", channel]
    assert main(["receive", *bus, "--count", "1", "--timeout", "0.05"]) == 1
    assert "nothing received for 0.05 s" in capsys.readouterr().err


def test_send_ends_after_the_count(capsys, channel):
    """Each line so many times, then the counters."""
    bus = ["--interface", "virtual", "--channel", channel, "--rate", "200"]
    assert main(["send", *bus, "--count", "5", "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["lines"] + result["overruns"] == 20  # a busy machine may skip periods
    assert result["frames"] == 4 * result["lines"] > 0
    assert result["down"] == result["full"] == 0


def test_decode_streams_json_lines(capsys, log):
    """Every line of every channel, then what was dropped."""
    assert main(["decode", str(log)]) == 0
    out, err = capsys.readouterr()
    rows = [json.loads(row) for row in out.splitlines()]
    assert sum(row["channel"] == "can0" for row in rows) == 20
    assert sum(row["channel"] == "can1" for row in rows) == 5
    times = [row["t"] for row in rows if row["channel"] == "can0"]
    assert times == sorted(times)
    assert "1 foreign" in err
    assert "2 timeout" in err


def test_decode_writes_csv(capsys, log):
    """One header, one row a line, the covariance's upper triangle."""
    assert main(["decode", str(log), "--csv"]) == 0
    rows = list(csv.DictReader(capsys.readouterr().out.splitlines()))
    assert len(rows) == 25
    assert float(rows[0]["y_off"]) == pytest.approx(1.757, abs=2**-9 / 2 + 1e-3)
    assert float(rows[0]["cov_y_off_y_off"]) > 0.25
    assert len([name for name in rows[0] if name.startswith("cov_")]) == 10


def test_decode_keeps_what_is_good_of_a_damaged_log(capsys, log):
    """A torn record is one clear line and a nonzero status; the lines before and after stay."""
    text = log.read_text().splitlines(keepends=True)
    log.write_text("".join([*text[:40], "(1000.1) can0 34\n", *text[40:]]))
    assert main(["decode", str(log)]) == 1
    out, err = capsys.readouterr()
    assert len(out.splitlines()) == 25
    assert "damaged" in err


def test_decode_reads_so_many_channels_and_tells_of_the_rest(capsys, tmp_path):
    """Names that are no channels must not fill the memory, and nothing goes silently."""
    path = tmp_path / "names.log"
    path.write_text("".join(f"({k}.0) v{k % 300} 340#0011223344556677\n" for k in range(600)))
    assert main(["decode", str(path)]) == 1
    first, second = capsys.readouterr().err.splitlines()
    assert first == (
        f"maplines: error: {path}: 88 frames are of channels beyond the first 256, and are not "
        "read; split the log by channel"
    )
    assert "0 lines from 512 frames" in second


@pytest.mark.parametrize(
    ("text", "notes", "status"),
    [
        pytest.param("", ["0 lines from 0 frames"], 0, id="empty"),
        pytest.param(";$FILEVERSION=1.1\n;$STARTTIME=1\n;--\n", ["0 lines from 0"], 0, id="head"),
        pytest.param(
            "1) 2\n1) 0.5 0340 1 11\n", ["1 of 2 records", "1 frames", "1 errors"], 1, id="short"
        ),
    ],
)
def test_decode_of_a_trc_speaks_for_itself(tmp_path, text, notes, status):
    """What python-can says of it in its own words is not seen."""
    path = tmp_path / "a.trc"
    path.write_text(text)
    done = subprocess.run(
        [sys.executable, "-m", "maplines_can.cli", "decode", str(path)],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    told = done.stderr.splitlines()
    assert all(note in line for note, line in zip(notes, told, strict=True)), told
    assert done.returncode == status


def drive(path, *, cycle, channels=("can0",), cut=(), n=20):
    """A candump log of one slot, a line each cycle [s]; the frames of some lines are cut out."""
    (line,) = scene_lines(scenario("highway"), 1)
    codecs = {channel: Codec.from_dbc() for channel in channels}
    with can.Logger(path) as writer:
        for k in range(n):
            for channel, codec in codecs.items():
                frames = codec.encode(line)
                for frame in frames if (channel, k) not in cut else []:
                    writer(message(frame, 1000 + k * cycle, channel))
    return str(path)


def slot_notes(capsys):
    """What was said of slots at the end, on standard error."""
    notes = capsys.readouterr().err.splitlines()
    ends = [k for k, note in enumerate(notes) if "lost by their counters" in note]
    return notes[ends[-1] + 1 :]


def test_decode_says_what_each_slot_was_worth(capsys, tmp_path):
    """Lines that were cut out are lost and missed; slots on which nothing came are left out."""
    path = drive(tmp_path / "cut.log", cycle=0.05, cut={("can0", 8), ("can0", 13)})
    assert main(["decode", path]) == 0
    (note,) = slot_notes(capsys)
    assert note == (
        "maplines: ego left: VALID; 18 ok, 2 lost, 0 repeated, 0 wrong sequence, 0 errors, "
        "2 cycles without data"
    )


def test_decode_names_the_channels_of_the_slots(capsys, tmp_path):
    """Where there are several; now is when the log ends, for all of them."""
    cut = {("can1", k) for k in range(10, 20)}
    path = drive(tmp_path / "two.log", cycle=0.05, channels=("can0", "can1"), cut=cut)
    assert main(["decode", path, "--csv"]) == 0
    first, second = slot_notes(capsys)
    assert first.startswith("maplines: can0 ego left: VALID; 20 ok, 0 lost")
    assert second.startswith("maplines: can1 ego left: INVALID; 10 ok, 0 lost")
    assert second.endswith("9 cycles without data")


def test_decode_is_told_how_often_lines_come(capsys, tmp_path):
    """A log of 2 Hz: nothing is missing from it but by the DBC's 20 Hz."""
    path = drive(tmp_path / "slow.log", cycle=0.5)
    assert main(["decode", path, "--cycle-ms", "500"]) == 0
    (told,) = slot_notes(capsys)
    assert main(["decode", path]) == 0
    (untold,) = slot_notes(capsys)
    assert told.startswith("maplines: ego left: VALID; 20 ok, 0 lost")
    assert told.endswith(" 0 cycles without data")
    assert not untold.startswith("maplines: ego left: VALID")
    assert untold.endswith(f" {19 * 9} cycles without data")


def test_receive_is_told_how_often_lines_come(capsys, channel):
    """The slot of a slow sender is VALID for who knows of it, and for nobody else."""
    bus = ["--interface", "virtual", "--channel", channel]
    with (
        Link(interface="virtual", channel=channel) as link,
        Transmitter(link, Codec.from_dbc(), period=0.2) as transmitter,
    ):
        transmitter.publish(scene_lines(scenario("highway"), 1))
        assert main(["receive", *bus, "--count", "8", "--cycle-ms", "200"]) == 0
        (told,) = slot_notes(capsys)
        assert main(["receive", *bus, "--count", "4"]) == 0
        (untold,) = slot_notes(capsys)
    assert told.startswith("maplines: ego left: VALID; 8 ok, 0 lost")
    assert not untold.startswith("maplines: ego left: VALID")


def test_scenarios_lists_them(capsys):
    """Names and a sentence each; JSON for machines."""
    assert main(["scenarios"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in SCENARIOS)
    assert main(["scenarios", "--json"]) == 0
    assert [row["name"] for row in json.loads(capsys.readouterr().out)] == list(SCENARIOS)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        pytest.param(["decode", "nowhere.log"], "no such file", id="no-log"),
        pytest.param(["decode", "pyproject.toml"], "format '.toml' is unknown", id="format"),
        pytest.param(["demo", "--dbc", "nowhere.dbc"], "nowhere.dbc", id="no-dbc"),
        pytest.param(["demo", "--seconds", "0.1", "--plot", "/nowhere/a.png"], "/nowhere/a.png",
                     id="no-folder"),
        pytest.param(["demo", "--seconds", "0.1", "--plot", "a.xyz"], "xyz", id="no-such-format"),
        pytest.param(["send", "--interface", "socketcan", "--channel", "nocan9"], "nocan9",
                     id="no-interface"),
        pytest.param(["receive", "--interface", "warp"], "warp", id="no-such-driver"),
        pytest.param(["demo", "--components", "auto", "--max-load", "0.08"],
                     "4 lines in 4 parts take 8.64 % of the bus", id="too-little-bus"),
    ],
)  # fmt: skip
def test_errors_are_one_clear_line(capsys, arguments, words):
    """Nonzero status, one line on standard error that names the thing, no traceback."""
    assert main(arguments) == 1
    err = capsys.readouterr().err
    assert words in err
    assert "Traceback" not in err
    assert len([row for row in err.splitlines() if "error" in row]) == 1


@pytest.mark.parametrize(
    "arguments",
    [
        ["demo", "--scenario", "moon"],
        ["demo", "--rate", "0"],
        ["demo", "--lines", "9"],
        ["demo", "--components", "9"],
        ["demo", "--max-load", "0"],
        ["send", "--components", "all"],
        ["send", "--count", "-1"],
        ["receive", "--cycle-ms", "0.5"],
        ["decode", "--cycle-ms", "nan", "drive.log"],
        ["fly"],
        [],
    ],
)
def test_wrong_usage_is_status_2(capsys, arguments):
    """argparse says what is allowed."""
    with pytest.raises(SystemExit) as end:
        main(arguments)
    assert end.value.code == 2
    assert "usage: maplines" in capsys.readouterr().err


@pytest.mark.parametrize(
    "job", ["demo", "send", "receive", "decode", "figures", "truth", "scenarios"]
)
def test_help_teaches(capsys, job):
    """Each job says what it does and gives an example."""
    with pytest.raises(SystemExit) as end:
        main([job, "--help"])
    assert end.value.code == 0
    assert f"example: maplines {job}" in capsys.readouterr().out


def test_every_job_is_in_the_readme():
    """README shows each job of the command at least once."""
    readme = (ROOT / "README.md").read_text()
    for job in ("demo", "send", "receive", "decode", "figures", "truth", "scenarios"):
        assert f"maplines {job}" in readme


def test_a_reader_that_has_enough_ends_the_command(log):
    """maplines decode LOG | head -1: no traceback."""
    command = f"{sys.executable} -m maplines_can.cli decode {log} | head -1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert done.stdout.startswith("{")
    assert "Traceback" not in done.stderr


def test_interrupt_ends_cleanly(channel):
    """SIGINT to a sender: the counters, status 0, no traceback."""
    script = (
        "import os, signal, threading, time\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"  # ignored in the background
        "from maplines_can.cli import main\n"
        "from maplines_can.bus import Link\n"
        "threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()\n"
        "bus = ['--interface', 'virtual', '--channel', 'x']\n"
        "raise SystemExit(main(['send', *bus, '--rate', '100']))"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=False, timeout=30
    )
    assert done.returncode == 0, done.stderr
    assert "sent" in done.stdout
    assert "Traceback" not in done.stderr
