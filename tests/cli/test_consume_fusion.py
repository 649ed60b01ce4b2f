"""The command maplines consume fusion."""

import json
from pathlib import Path
from typing import Any

import pytest
from support.drive_files import run

from maplines_can.cli import main
from maplines_can.consumers.integrity import multiplier


def rows(text: str) -> list[Any]:
    return [json.loads(row) for row in text.splitlines()]


def test_a_simulated_car(capsys: pytest.CaptureFixture[str]) -> None:
    """The errors are within the levels; the camera fails after a third of the drive."""
    arguments = ["--simulate", "--seconds", "4", "--json"]
    assert main(["consume", "fusion", *arguments]) == 0
    found = rows(capsys.readouterr().out)
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


def test_a_log_with_the_motion_of_its_truth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, truth = tmp_path / "drive.log", tmp_path / "truth.csv"
    options = ["--seconds", "2.5", "--lines", "2", "--truth", str(truth)]
    options += ["--dbc", "maplines-pose.dbc", "--record", str(log)]
    run(capsys, "--as-fast-as-possible", *options)
    command = ["consume", "fusion", str(log), "--dbc", "maplines-pose.dbc"]
    assert main([*command, "--json", "--motion", str(truth)]) == 0
    found = rows(capsys.readouterr().out)
    assert 2 <= len(found) <= 3
    assert found[-1]["map_age"] < 0.2
    assert found[-1]["centre"][0]["sigma"] < 0.3
    assert main(command) == 0  # the motion is unknown
    assert "level" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("time,speed\n1,2\n", "yaw_rate"),
        ("time,speed,yaw_rate\n1,x,0\n", "could not convert"),
        ("time,speed,yaw_rate\n1,1,0\n1,1,0\n", "increasing time"),
        ("time,speed,yaw_rate\n", "increasing time"),
    ],
)
def test_a_wrong_table_of_the_motion(
    text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "motion.csv"
    table.write_text(text)
    log = tmp_path / "empty.log"
    log.write_text("(1.0) can0 123#00\n")
    arguments = [str(log), "--motion", str(table), "--dbc", "maplines-pose.dbc"]
    assert main(["consume", "fusion", *arguments]) == 1
    assert message in capsys.readouterr().err


def test_nothing_received(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "empty.log"
    log.write_text("(1.0) can0 123#00\n")
    assert main(["consume", "fusion", str(log), "--dbc", "maplines-pose.dbc"]) == 1
    assert "no scene" in capsys.readouterr().err
