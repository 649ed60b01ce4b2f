"""maplines consume steer and check, on a log of a drive."""

import json
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest

from maplines_can import Codec, Gaussian, MapLine, Polyline, Slot, map_scene
from maplines_can.cli import main
from maplines_can.wire import default_dbc_path

DBC = "maplines-pose.dbc"
SECONDS = 6


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Log of a straight lane; the lines stop after 6 s. Beside it, camera.log has its lines."""
    folder = tmp_path_factory.mktemp("drive")
    x = np.linspace(-50, 120, 35)
    lines = {
        slot: Polyline(np.column_stack([x, y + 0 * x]))
        for slot, y in ((Slot.EGO_LEFT, 1.75), (Slot.EGO_RIGHT, -1.75))
    }
    ego = Gaussian(np.zeros(3), np.diag([0.1, 0.1, 0.003]) ** 2)
    scene = map_scene(lines, ego, correlation_time=5.0)
    codec, plain = Codec.from_dbc(default_dbc_path(DBC)), Codec.from_dbc()
    prepared = codec.prepare_scene(scene)
    noise = np.diag([0.05, 0.003, 2e-4, 2e-6]) ** 2
    with can.Logger(folder / "drive.log") as log, can.Logger(folder / "camera.log") as camera:
        for k in range(20 * SECONDS):
            t = 100.0 + 0.05 * k
            for frames in codec.encode_scene(prepared, age=0.02).values():
                for i, frame in enumerate(frames):
                    log(_message(t + 0.0005 * i, frame))
            shift = np.array([1.0 if k >= 60 else 0.0, 0, 0, 0])
            for line in scene.lines:
                seen = MapLine(
                    line.slot, Gaussian(line.gaussian.mean + shift, noise), x_max=40.0, age=0.02
                )
                for i, frame in enumerate(plain.encode(seen)):
                    camera(_message(t + 0.0005 * i, frame))
        log(can.Message(timestamp=t + 2.0, arbitration_id=1, is_extended_id=False))
    return folder / "drive.log"


def _message(t: float, frame: Any) -> can.Message:
    return can.Message(
        timestamp=t, arbitration_id=frame.can_id, is_extended_id=False, data=frame.data
    )


def rows(capsys: pytest.CaptureFixture[str], *options: object) -> tuple[int, list[Any], str]:
    """Status, rows of JSON and standard error of ``maplines consume``."""
    status = main(["consume", *map(str, options), "--dbc", DBC, "--json"])
    out, err = capsys.readouterr()
    return status, [json.loads(line) for line in out.splitlines()], err


def test_steer_drives_until_the_lines_stop(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    status, found, _ = rows(capsys, "steer", drive, "--set-speed", 10)
    assert status == 0
    states = [row["state"] for row in found]
    assert states[0] == "HANDOVER"  # nothing has come yet
    driving = [row for row in found if row["state"] == "DRIVING"]
    assert len(driving) >= SECONDS - 1
    assert driving[-1]["speed"] == 10.0
    assert driving[-1]["offset"] == pytest.approx(0.0, abs=0.05)
    assert driving[-1]["sigma"] == pytest.approx(0.1, rel=0.2)
    assert driving[-1]["reach"] > 50
    assert (found[-1]["state"], found[-1]["reason"]) == ("HANDOVER", "NO_LINES")
    assert found[-1]["speed"] < 10.0


def test_steer_prints_each_period_as_text(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    options = ["--dbc", DBC, "--every", "0.05", "--seconds", "2"]
    assert main(["consume", "steer", str(drive), *options]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 40
    assert "no usable line of the ego lane" in lines[0]
    assert "DRIVING" in lines[-1]
    assert "offset" in lines[-1]


@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_check_with_a_simulated_camera(
    drive: Path, capsys: pytest.CaptureFixture[str], shift: float
) -> None:
    options = ["--simulate", "--shift", shift, "--shift-at", 3]
    status, found, err = rows(capsys, "check", drive, *options)
    raised = [row["t"] for row in found if row["raised"]]
    assert status == (3 if shift else 0)
    assert raised == ([pytest.approx(3.0, abs=0.11)] if shift else [])
    assert f"{len(raised)} alarms" in err


def test_check_with_the_log_of_a_camera(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Its lines jump after 3 s. When the map lines have stopped, nothing is checked."""
    camera = drive.with_name("camera.log")
    status, found, _ = rows(capsys, "check", drive, "--camera", camera)
    assert status == 3
    assert [row["t"] for row in found if row["raised"]] == [pytest.approx(3.05, abs=0.11)]
    assert found[-1]["outcome"] == "UNCHECKED"
    assert {"EGO_LEFT", "EGO_RIGHT"} == set(found[3]["lines"])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        pytest.param(["steer", "--dbc", "PLAIN"], "no usable scene", id="steer-without-scenes"),
        pytest.param(
            ["check", "--dbc", "PLAIN", "--simulate"], "nothing was compared", id="check-without"
        ),
    ],
)
def test_lines_without_a_pose_error_are_an_error(
    drive: Path, capsys: pytest.CaptureFixture[str], options: list[str], message: str
) -> None:
    camera = drive.with_name("camera.log")
    given = [option.replace("PLAIN", "maplines.dbc") for option in options]
    assert main(["consume", *given, str(camera)]) == 1
    err = capsys.readouterr().err
    assert message in err
    assert "--pose-error" in err


def test_a_camera_needs_a_log(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["consume", "check", "--camera", str(drive), "--dbc", DBC]) == 1
    assert "--camera needs LOG" in capsys.readouterr().err


def test_the_dbc_of_a_simulated_camera_is_an_error(
    drive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    options = ["--simulate", "--camera-dbc", DBC, str(drive)]
    assert main(["consume", "check", *options]) == 1
    assert "--camera-dbc is that of --camera" in capsys.readouterr().err
