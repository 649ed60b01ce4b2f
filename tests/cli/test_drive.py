"""The command ``maplines drive``."""

import json
import re
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from answers import one
from can.interfaces import virtual
from support.drive_files import run, table, town
from support.fixtures import Capture, Patch
from support.xodr_files import document, geometry, lane, road, section

from maplines_can import Codec, MapLine, Slot, read_log
from maplines_can.cli import main
from maplines_can.cli.drive import _text
from maplines_can.maps.line_source import Cycle, LineSource
from maplines_can.simulation.simulated_localisation import SimulatedLocalisation
from maplines_can.wire import default_dbc_path

FAST = ["--as-fast-as-possible", "--route", "1:0:-2..1:0:-1", "--seconds", "8"]


def decoded(path: Path) -> list[MapLine]:
    """Return the lines in a log."""
    decoder = Codec.from_dbc().decoder()
    fed = (one(decoder.feed(f.can_id, f.data, f.t_ns)) for f in read_log(path))
    lines = [line for line in fed if isinstance(line, MapLine)]
    assert not any(decoder.counts.values())
    assert decoder.lost == 0
    return lines


@pytest.mark.parametrize("fd", [False, True])
def test_the_log_has_every_line_of_every_cycle(tmp_path: Path, capsys: Capture, fd: bool) -> None:
    """In order, 50 ms from cycle to cycle, with the age that the frames before it take."""
    log = tmp_path / "drive.log"
    result = run(capsys, town(tmp_path), *FAST, "--record", str(log), *["--fd"] * fd)
    assert result["cycles"] == 160
    lines = decoded(log)
    assert len(lines) == result["lines"]
    assert result["frames"] == len(lines) * (1 if fd else 4)
    slots = [line.slot for line in lines]
    assert slots.count(Slot.EGO_LEFT) == slots.count(Slot.EGO_RIGHT) == 160
    times = np.array([line.t_ns for line in lines if line.slot is Slot.EGO_LEFT])
    assert np.diff(times) == pytest.approx(0.05e9, abs=2e3)
    assert max(line.age for line in lines) <= 0.008
    assert result["left_out"] == {}
    assert result["late_cycles"] == result["off_map"] == 0


def test_each_line_of_a_cycle_is_sent_or_counted(tmp_path: Path, capsys: Capture) -> None:
    """Around a corner whose inner line turns within 1 m, which no record of a scene can state."""
    corner = geometry(length=60.0) + geometry(
        '<arc curvature="-0.22"/>', s=60.0, x=60.0, length=7.0
    )
    path = tmp_path / "corner.xodr"
    path.write_text(document(road(section(lane(-1)), plan=corner, length=67.0)))
    result = run(
        capsys, str(path), "--route", "1:0:-1..1:0:-1", "--lines", "2", "--as-fast-as-possible",
        "--dbc", str(default_dbc_path("maplines-pose.dbc")), "--sigma", "0.1,0.1,0.1",
        "--rate", "10",
    )  # fmt: skip
    left_out = result["left_out"]
    assert sum(left_out.get(reason, 0) for reason in ("MEAN", "COVARIANCE", "ACROSS")) > 0
    assert result["lines"] + sum(left_out.values()) == 2 * result["cycles"]


def test_the_seed_decides_the_errors(tmp_path: Path, capsys: Capture) -> None:
    log, data = tmp_path / "drive.log", []
    for seed in "112":
        run(capsys, town(tmp_path), *FAST[:-1], "1", "--record", str(log), "--seed", seed)
        data.append([frame.data for frame in read_log(log)])
    assert data[0] == data[1] != data[2]


def test_a_lane_change_changes_all_slots_at_once(tmp_path: Path, capsys: Capture) -> None:
    """The route leads to the lane on the left; the truth says in which cycle."""
    truth = tmp_path / "truth.csv"
    result = run(
        capsys, town(tmp_path), *FAST[:3], "--truth", str(truth), "--sigma", "0.1,0.05,0.1"
    )
    assert result["lane_changes"] == 1
    assert result["slot_changes"] == 4  # ego left and right, next left and right
    rows = table(truth)
    (k,) = [i for i, row in enumerate(rows) if float(row["lane_changed"])]
    assert {row["stated_lane"] for row in rows[:k]} == {"1:0:-2"}
    assert {row["stated_lane"] for row in rows[k:]} == {"1:0:-1"}
    other = sum(row["lane"] != row["stated_lane"] for row in rows)
    assert other == result["other_lane"] <= 5


def test_it_sends_on_a_bus_and_logs_what_it_sends(
    tmp_path: Path, capsys: Capture, channel: str
) -> None:
    """A listener on the bus gets the frames of the log; a busy machine may skip some cycles."""
    log = tmp_path / "drive.log"
    with can.Bus(interface="virtual", channel=channel) as bus:
        result = run(
            capsys,
            *(town(tmp_path), "--route", "1:0:-1..1:0:-1", "--seconds", "0.5", "--rate", "40"),
            *("--interface", "virtual", "--channel", channel, "--record", str(log)),
        )
        received = []
        while message := bus.recv(0):
            received.append(bytes(message.data))
    assert result["cycles"] + result["late_cycles"] == 20
    assert [frame.data for frame in read_log(log)] == received
    assert result["frames"] == len(received) > 0
    assert Path(result["truth"]).exists()
    assert channel not in virtual.channels


def test_a_recorded_drive(tmp_path: Path, capsys: Capture) -> None:
    """With covariances it is sent as it is; with --sigma errors are added."""
    drive = tmp_path / "car.csv"
    rows = [f"{t / 10},{t},-1.75,0,0.2,0.1,0.01" for t in range(100)]
    drive.write_text("\n".join(["time,x,y,heading,sigma_x,sigma_y,sigma_heading", *rows]))
    errors = []
    for sigma in ([], ["--sigma", "0.3,0.1,0.2"]):
        truth = tmp_path / "truth.csv"
        fast = ["--drive", str(drive), "--as-fast-as-possible", "--truth", str(truth)]
        result = run(capsys, town(tmp_path), *fast, *sigma)
        assert result["cycles"] == 199
        errors.append(max(abs(float(r["stated_y"]) + 1.75) for r in table(truth)))
        assert float(table(truth)[5]["stated_cov_yy"]) == pytest.approx(0.01)
    assert errors[0] < 1e-9 < 0.02 < errors[1]


def test_lines_are_split_where_they_need_it(tmp_path: Path, capsys: Capture) -> None:
    """On a straight road one Gaussian fits; with 10 deg of heading error before a bend none does.

    The limit of the load is kept.
    """
    log = tmp_path / "drive.log"
    auto = ["--components", "auto", "--record", str(log), "--as-fast-as-possible", "--seconds"]
    result = run(capsys, town(tmp_path), *auto, "1", "--route", "1:0:-1..1:0:-1")
    assert result["bus_load"] < 0.1
    assert all(line.mixture is None for line in decoded(log))
    drive = tmp_path / "bend.csv"
    rows = [f"{t / 10},{150 + t},-1.75,0" for t in range(20)]
    drive.write_text("\n".join(["time,x,y,heading", *rows]))
    options = ["--drive", str(drive), "--sigma", "0.3,0.1,10", "--max-load", "0.2"]
    result = run(capsys, town(tmp_path), *auto, "1", *options)
    assert any(line.mixture is not None for line in decoded(log))
    assert result["bus_load"] <= 0.2


@pytest.mark.parametrize("live", [False, True])
def test_faults_disturb_the_frames_in_the_log(
    tmp_path: Path, capsys: Capture, channel: str, live: bool
) -> None:
    """The log has the frames on the bus: without those lost, with those doubled and flooded."""
    log = tmp_path / "drive.log"
    how = ["--channel", channel, "--seconds", "0.5"] if live else ["--as-fast-as-possible"]
    faults = "loss=0.2,dup=0.1,late=0.1,delay=0.01,flood=100,flood_ids=0x700,seed=3"
    options = ["--route", "1:0:-1..1:0:-1", "--seconds", "4", *how, "--faults", faults]
    result = run(capsys, town(tmp_path), *options, "--record", str(log))
    done, frames = result["faults"], list(read_log(log))
    assert done["frames"] == result["frames"]
    assert done["lost"] > 0 < done["duplicated"]
    assert (
        len(frames)
        == done["passed"]
        == done["frames"] + done["duplicated"] + done["flooded"] - done["lost"]
    )
    assert sum(frame.can_id == 0x700 for frame in frames) == done["flooded"] > 0
    times = [frame.t_ns for frame in frames]
    assert times == sorted(times)


def test_ctrl_c_ends_a_drive(tmp_path: Path, capsys: Capture, monkeypatch: Patch) -> None:
    """In the eleventh cycle, without and with a bus: the log is whole, and the counters say it."""

    class Interrupted(LineSource):
        cycles = 0

        def cycle(self, t: float, true_pose: Any) -> Cycle:
            self.cycles += 1
            if self.cycles > 10:
                raise KeyboardInterrupt
            return super().cycle(t, true_pose)

    monkeypatch.setattr("maplines_can.cli.drive.LineSource", Interrupted)
    log, truth = tmp_path / "drive.log", tmp_path / "truth.csv"
    for options in (["--as-fast-as-possible"], []):
        more = [*options, "--record", str(log), "--truth", str(truth)]
        assert main(["drive", town(tmp_path), *more, "--json", "--force"]) == 0
        captured = capsys.readouterr()
        result = json.loads(captured.out)
        assert result["stopped"] is True
        assert result["cycles"] == 10
        assert "stopped by Ctrl-C after 0." in captured.err
        assert "Traceback" not in captured.err
        assert len(decoded(log)) == result["lines"]
        assert len(table(truth)) == 10


def test_a_drive_elsewhere_is_told(tmp_path: Path, capsys: Capture) -> None:
    """In another projection, so that no position is on the map."""
    drive = tmp_path / "car.csv"
    drive.write_text("time,x,y,heading\n0,477000,5529000,0\n1,477010,5529000,0\n")
    err = run(capsys, town(tmp_path), "--drive", str(drive), status=1)
    assert re.search(r"error: .*car.csv: no position is on the map.*another projection", err)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        pytest.param([], (-4, 80), id="default"),
        pytest.param(["--window", "0", "120"], (0, 120), id="longer"),
    ],
)
def test_the_window_is_that_of_the_lines(
    tmp_path: Path, capsys: Capture, options: list[str], expected: Any
) -> None:
    """On a straight road, up to the steps of the message and the margin for the pose error."""
    log = tmp_path / "a.log"
    run(capsys, town(tmp_path), *FAST, *options, "--record", str(log))
    last = decoded(log)[-1]
    assert 0 <= last.x_min - expected[0] <= 8
    assert 0 <= expected[1] - last.x_max <= 8


@pytest.mark.parametrize("options", [[], ["town.xodr"]])
def test_the_town_is_driven_through_as_a_whole(
    capsys: Capture, monkeypatch: Patch, tmp_path: Path, options: list[str]
) -> None:
    """On the tour of the package, with its name or without; where it stays on its lane."""
    monkeypatch.chdir(tmp_path)
    fast = [*options, "--as-fast-as-possible", "--seconds", "1", "--truth", "truth.csv"]
    assert main(["drive", *fast]) == 0
    assert "town.xodr from lane 15:0:-1 to 442:0:-1" in capsys.readouterr().err


def test_the_text_tells_losses() -> None:
    """Of a result with all counters."""
    names = ["cycles", "lines", "frames", "lane_changes", "slot_changes", "off_map", "other_lane"]
    names += ["late_cycles", "down", "full", "overruns", "km", "seconds", "rate", "bus_load"]
    names += ["no_pose", "ms_per_cycle", "core_share"]
    numbers: dict[str, Any] = dict.fromkeys(names, 3)
    text = _text(numbers | {"left_out": {"ACROSS": 7}, "record": "a.blf", "truth": "a.csv"})
    assert "3 lines given up with a full queue" in text
    assert "7 times, the line is across" in text
    assert "in 3 cycles the car was on another lane" in text
    assert "3 left out, because this machine was late" in text
    assert json.dumps("a.blf")[1:-1] in text


def test_the_pose_of_a_localisation_is_sent(tmp_path: Path, capsys: Capture) -> None:
    """With its correlation time; the measurements are counted."""
    log = tmp_path / "drive.log"
    options = ["--localise", "--dbc", "maplines-pose.dbc", "--record", str(log)]
    result = run(capsys, town(tmp_path), *FAST[:-1], "4", *options)
    assert result["measurements"]["odometry"]["USED"] > 150
    assert result["measurements"]["line"]["USED"] > 25
    assert result["pose_errors"] == 80
    truth = ["--truth", str(tmp_path / "truth.csv")]
    scan = ["drive", FAST[0], "--seconds", "1", "--localise", "--scan", *truth]
    assert main(scan) == 0
    assert re.search(r"\nodometry +\d+ used\npose +\d+ used\n", capsys.readouterr().out)


@pytest.mark.parametrize("dbc", ["maplines.dbc", "maplines-scene.dbc"])
def test_without_a_pose_no_line_is_sent(
    tmp_path: Path, capsys: Capture, monkeypatch: Patch, dbc: str
) -> None:
    """It is counted and said; neither lines nor pose errors are sent, and then they are again."""
    poses = SimulatedLocalisation.pose
    lost = (0.5, 1.0)

    def pose(self: SimulatedLocalisation, t: float, true: Any = None) -> Any:
        return None if lost[0] <= t < lost[1] else poses(self, t, true)

    monkeypatch.setattr(SimulatedLocalisation, "pose", pose)
    log = tmp_path / "drive.log"
    options = ["--localise", "--dbc", dbc, "--record", str(log)]
    options += ["--truth", str(tmp_path / "truth.csv")]
    assert main(["drive", town(tmp_path), *FAST[:-1], "1.5", *options]) == 0
    assert "the car did not know its pose, and no line was sent" in capsys.readouterr().out
    stamps = np.array([float(line.split(")")[0][1:]) for line in log.read_text().splitlines()])
    gaps = np.diff(stamps)
    assert 0.3 < gaps.max() < 0.7
    rows = (tmp_path / "truth.csv").read_text().splitlines()
    empty = [row for row in rows[1:] if ",,,,,,,,," in row]
    assert len(empty) >= 9
