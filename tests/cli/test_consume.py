"""maplines consume steer and check, on a log of a drive."""

import csv
import json
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import can
import numpy as np
import pytest
from support.drive_files import car_signals, run
from support.fake_bus import message_of
from support.fixtures import Capture

from maplines_can import Codec, Gaussian, MapLine, Polyline, Slot, map_scene
from maplines_can.cli import main
from maplines_can.cli.consume_camera import _of_log, _of_table
from maplines_can.consumers.integrity import multiplier
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
    encoder = Codec.from_dbc(default_dbc_path(DBC)).encoder()
    plain_encoder = Codec.from_dbc().encoder()
    prepared = encoder.prepare_scene(scene)
    noise = np.diag([0.05, 0.003, 2e-4, 2e-6]) ** 2
    with can.Logger(folder / "drive.log") as log, can.Logger(folder / "camera.log") as camera:
        for k in range(20 * SECONDS):
            t = 100.0 + 0.05 * k
            for frames in encoder.encode_scene(prepared, age=0.02).values():
                for i, frame in enumerate(frames):
                    log(message_of(frame, timestamp=t + 0.0005 * i))
            shift = np.array([1.0 if k >= 60 else 0.0, 0, 0, 0])
            for line in scene.lines:
                seen = MapLine(
                    line.slot, Gaussian(line.gaussian.mean + shift, noise), x_max=40.0, age=0.02
                )
                for i, frame in enumerate(plain_encoder.encode(seen)):
                    camera(message_of(frame, timestamp=t + 0.0005 * i))
        log(can.Message(timestamp=t + 2.0, arbitration_id=1, is_extended_id=False))
    return folder / "drive.log"


def rows(capsys: Capture, *options: object) -> tuple[int, list[Any], str]:
    """Status, rows of JSON and standard error of ``maplines consume``."""
    status = main(["consume", *map(str, options), "--dbc", DBC, "--json"])
    out, err = capsys.readouterr()
    return status, [json.loads(line) for line in out.splitlines()], err


def test_steer_drives_until_the_lines_stop(drive: Path, capsys: Capture) -> None:
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


AS_STATED = ("--noise-time", 0, "--gaussian-noise", "--pose-time", 0)


@pytest.mark.parametrize(
    ("shift", "known", "after"),
    [
        pytest.param(0.0, (), None, id="no-fault"),
        pytest.param(1.0, (), 0.2, id="default"),
        pytest.param(1.0, AS_STATED, 0.05, id="white-gaussian-camera"),
    ],
)
def test_check_with_a_simulated_camera(
    drive: Path, capsys: Capture, shift: float, known: tuple[object, ...], after: float | None
) -> None:
    """Noise that may last or have outliers delays the alarm by some images."""
    options = ["--simulate", "--shift", shift, "--shift-at", 3, *known]
    status, found, err = rows(capsys, "check", drive, *options)
    raised = [row["t"] for row in found if row["raised"]]
    assert status == (3 if shift else 0)
    assert raised == ([] if after is None else [pytest.approx(3.0 + after, abs=0.06)])
    assert ("1 alarm;" if shift else "0 alarms;") in err


def test_check_with_the_log_of_a_camera(drive: Path, capsys: Capture) -> None:
    """Its lines jump after 3 s. When the map lines have stopped, nothing is checked."""
    camera = drive.with_name("camera.log")
    status, found, _ = rows(capsys, "check", drive, "--camera", camera)
    assert status == 3
    assert [row["t"] for row in found if row["raised"]] == [pytest.approx(3.2, abs=0.11)]
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
    drive: Path, capsys: Capture, options: list[str], message: str
) -> None:
    camera = drive.with_name("camera.log")
    given = [option.replace("PLAIN", "maplines.dbc") for option in options]
    assert main(["consume", *given, str(camera)]) == 1
    err = capsys.readouterr().err
    assert message in err
    assert "--pose-error" in err


@pytest.fixture(scope="module")
def camera_csv(drive: Path) -> Path:
    """The lines of camera.log, as decode --csv prints them."""
    path = drive.with_name("camera.csv")
    with path.open("w") as out, redirect_stdout(out):
        assert main(["decode", "--csv", str(drive.with_name("camera.log"))]) == 0
    return path


@pytest.mark.parametrize("kind", ["csv", "sigmas", "parquet"])
def test_the_lines_of_a_table_are_those_of_the_log(
    camera_csv: Path, tmp_path: Path, kind: str
) -> None:
    """As decode --csv writes it, with standard deviations, and as Parquet."""
    path = camera_csv
    with path.open() as file:
        rows = [*csv.DictReader(file)]
    names = ["y_off", "beta", "c0", "c1"]
    table: dict[str, list[Any]] = {
        name: [float(row[name]) for row in rows] for name in ["t", "x_min", "x_max", "age", *names]
    }
    table |= {f"sigma_{n}": [float(row[f"cov_{n}_{n}"]) ** 0.5 for row in rows] for n in names}
    table["slot"] = [row["slot"] for row in rows]
    if kind == "parquet":
        pa = pytest.importorskip("pyarrow")
        path = tmp_path / "camera.parquet"
        pytest.importorskip("pyarrow.parquet").write_table(pa.table(table), path)
    elif kind == "sigmas":
        path = tmp_path / "camera.csv"
        lines = zip(*table.values(), strict=True)
        path.write_text("\n".join(",".join(map(str, row)) for row in [[*table], *lines]))
    found = [*_of_table(str(path))]
    expected = [*_of_log(str(camera_csv.with_name("camera.log")), Codec.from_dbc())]
    assert len(found) == len(expected) == 2 * 20 * SECONDS
    for one, other in zip(found, expected, strict=True):
        assert (one.slot, one.x_min, one.x_max) == (other.slot, other.x_min, other.x_max)
        assert one.t_ns == pytest.approx(other.t_ns, abs=1000)
        assert one.age == other.age
        assert one.gaussian.mean == pytest.approx(other.gaussian.mean)
        assert one.gaussian.sigma == pytest.approx(other.gaussian.sigma)
        if kind == "csv":
            assert one.gaussian.cov == pytest.approx(other.gaussian.cov)


@pytest.mark.parametrize("consumer", ["fusion", "check"])
def test_the_motion_of_the_signals_in_the_log(
    drive: Path, tmp_path: Path, consumer: str, capsys: Capture
) -> None:
    """The result is that of the same motion in a table."""
    (tmp_path / "motion.csv").write_text("time,speed,yaw_rate\n99,10,0.0\n110,10,0.0\n")
    log = tmp_path / "both.log"
    esp = (3600).to_bytes(2, "little") + bytes(2)
    car = [f"({99 + k}.0) can0 001#{esp.hex()}" for k in range(12)]
    frames = [line for line in drive.read_text().splitlines() if " 001#" not in line]
    log.write_text(
        "\n".join(sorted([*frames, *car], key=lambda row: float(row[1 : row.index(")")]))) + "\n"
    )
    signals = car_signals(tmp_path)
    simulate = ["--simulate"] if consumer == "check" else []
    _, by_signals, err = rows(capsys, consumer, log, *simulate, *signals, "--seconds", 3)
    assert "error" not in err
    motion = ["--motion", tmp_path / "motion.csv"]
    _, by_table, _ = rows(capsys, consumer, log, *simulate, *motion, "--seconds", 3)
    assert by_signals == by_table


def rows_in(text: str) -> list[Any]:
    return [json.loads(row) for row in text.splitlines()]


def test_a_simulated_car(capsys: Capture) -> None:
    """The errors are within the levels; the camera fails after a third of the drive."""
    arguments = ["--simulate", "--seconds", "4", "--json"]
    assert main(["consume", "fusion", *arguments]) == 0
    found = rows_in(capsys.readouterr().out)
    assert len(found) == 4
    assert found[1]["camera"] == ["EGO_LEFT", "EGO_RIGHT"]
    assert found[2]["camera"] == []
    for row in found[1:]:
        for at in row["centre"]:
            assert abs(at["error"]) < at["protection_level"]["1e-05"]
            # For any correlation time of the fused error, of which the pose error is a part only.
            levels = {f"{risk:g}": at["sigma"] * multiplier(risk) for risk in (1e-5, 1e-7)}
            assert at["protection_level"] == pytest.approx(levels)
            assert at["width"] == pytest.approx(3.3, abs=0.3)


def test_a_log_with_the_motion_of_its_truth(tmp_path: Path, capsys: Capture) -> None:
    log, truth = tmp_path / "drive.log", tmp_path / "truth.csv"
    options = ["--seconds", "2.5", "--lines", "2", "--truth", str(truth)]
    options += ["--dbc", "maplines-pose.dbc", "--record", str(log)]
    run(capsys, "--as-fast-as-possible", *options)
    command = ["consume", "fusion", str(log), "--dbc", "maplines-pose.dbc"]
    assert main([*command, "--json", "--motion", str(truth)]) == 0
    found = rows_in(capsys.readouterr().out)
    assert 2 <= len(found) <= 3
    assert found[-1]["map_age"] < 0.2
    assert found[-1]["centre"][0]["sigma"] < 0.3
    assert main(command) == 0  # the motion is unknown
    assert "level" in capsys.readouterr().out
