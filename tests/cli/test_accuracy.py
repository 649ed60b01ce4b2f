"""The command ``maplines accuracy``."""

import json
import os
import re
from pathlib import Path
from typing import Any

import pytest
from support.drive_files import run, town
from support.fixtures import Capture, Patch

from maplines_can.cli import main
from maplines_can.cli.accuracy import truth_of
from maplines_can.simulation.truth import truth_paths

FAST = ["--as-fast-as-possible", "--route", "1:0:-1..1:0:-1", "--seconds", "10"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the logs and the truth of a drive without and with errors of the pose."""
    folder = tmp_path_factory.mktemp("drive")
    path = town(folder)
    for name, options in {
        "exact.blf": ["--sigma", "0,0,0"],
        "exact.asc": ["--sigma", "0,0,0", "--fd"],
        "wrong.log": ["--sigma", "0.05,0.05,0.5", "--correlation-time", "1e9", "--seed", "4"],
    }.items():
        truth = folder / f"{name}.csv"
        recorded = ["--record", str(folder / name), "--truth", str(truth)]
        assert main(["drive", path, *FAST, *recorded, *options]) == 0
    return folder


def accuracy(capsys: Any, folder: Path, name: str, *options: str) -> Any:
    files = [str(folder / f"{name}.csv"), str(folder / name)]
    capsys.readouterr()
    assert main(["accuracy", *files, "--json", *options]) == 0
    return json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("name", ["exact.blf", "exact.asc"])
def test_without_pose_errors_the_lines_are_accurate(
    folder: Path, capsys: Capture, name: str
) -> None:
    """Within the misfit of a cubic; all lines are compared."""
    result = accuracy(capsys, folder, name)
    assert result["lines"] == result["received"] == 4 * 200
    assert result["errors"]["lateral"]["0"]["max"] < 0.1
    assert result["errors"]["absolute"]["line"]["max"] < 0.12
    met = {row["source"]: row["met"] for row in result["requirements"]}
    assert met["table 6, lane boundary geometry, 20 cm"] == dict.fromkeys(
        ["0", "20", "40", "80"], True
    )
    assert met["table 3, and.com, 15 cm"] == {"line": True}


def test_a_constant_error_of_the_pose_is_an_error_of_the_lines(
    folder: Path, capsys: Capture
) -> None:
    """It grows with the distance; alignment removes it, and the stated sigmas cover it."""
    result = accuracy(capsys, folder, "wrong.log")
    errors = result["errors"]
    assert errors["heading"]["0"]["rms"] > 0.1
    assert errors["lateral"]["80"]["rms"] > 2 * errors["lateral"]["0"]["rms"]
    assert errors["relative"]["line"]["95 %"] < 0.12 < errors["absolute"]["line"]["95 %"]
    assert max(result["beyond 3 sigma"].values()) < 0.05


@pytest.mark.parametrize("has_pyarrow", [True, False])
def test_the_truth_is_found_beside_the_log(
    tmp_path: Path, capsys: Capture, monkeypatch: Patch, has_pyarrow: bool
) -> None:
    """In the format in which the drive wrote it: CSV without pyarrow."""
    if has_pyarrow:
        pytest.importorskip("pyarrow")
    else:
        monkeypatch.setattr("maplines_can.cli.drive.find_spec", lambda _: None)
    monkeypatch.chdir(tmp_path)
    result = run(capsys, town(tmp_path), *FAST[:-1], "1", "--record", "drive.blf")
    assert result["truth"] == f"drive.truth.{'parquet' if has_pyarrow else 'csv'}"
    assert main(["accuracy", "drive.blf", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["lines"] > 0


def test_the_newer_truth_beside_a_log_counts(tmp_path: Path) -> None:
    """A drive writes its log and its truth together; the other file is of an earlier drive."""
    log = tmp_path / "drive.log"
    for order in (truth_paths(str(log)), truth_paths(str(log))[::-1]):
        for age, path in enumerate(order):
            path.touch()
            os.utime(path, (2e9 - age, 2e9 - age))
        assert truth_of(str(log)) == order[0]
        assert truth_of(f"{log}.gz") == order[0]


def test_a_log_without_truth_beside_it_is_one_line(folder: Path, capsys: Capture) -> None:
    """It names both files that it looked for."""
    assert main(["accuracy", str(folder / "exact.blf")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(
        r"exact.blf: there is no truth.*exact.truth.parquet nor .*exact.truth.csv", line
    )


@pytest.mark.parametrize(
    ("log", "words"),
    [
        ("exact.blf", r"The sender is right: .* 0\.\d+ times"),
        ("wrong.log", r"The sender is right, but its sigma is large: "),
    ],
)
def test_the_text_and_the_picture(folder: Path, capsys: Capture, log: str, words: str) -> None:
    """First whether the sender is right; what lines miss depends on the accuracy that it states."""
    pytest.importorskip("matplotlib")
    picture = folder / f"{log}.png"
    files = [str(folder / f"{log}.csv"), str(folder / log), "--plot", str(picture)]
    assert main(["accuracy", *files, "--force"]) == 0
    out = capsys.readouterr().out
    assert re.match(words, out.splitlines()[0])
    assert "FAIL" not in out
    assert "without the pose error, the lateral errors are" in out
    assert re.search(r"lateral \[cm\] +rms", out)
    assert "table 6, heading, 0.05 deg" in out
    assert f"picture: {picture}" in out
    assert picture.read_bytes().startswith(b"\x89PNG")
    found = accuracy(capsys, folder, "exact.blf")["map"]
    assert found["verdict"] in ("RIGHT", "TOO_LARGE")
    assert found["error"] <= found["sigma"]


@pytest.mark.parametrize(
    ("words", "error"),
    [
        pytest.param("{d}/nowhere.csv {d}/exact.blf", "nowhere.csv", id="no truth"),
        pytest.param("{d}/exact.blf.csv {d}/nowhere.blf", "nowhere.blf", id="no log"),
        pytest.param("{d}/exact.blf {d}/exact.blf", r"exact.blf: .*\.csv or", id="log as truth"),
        pytest.param("{d}/exact.blf.csv {d}/map.xodr", "map.xodr.*unknown", id="map as log"),
        pytest.param(
            "{d}/exact.blf.csv {d}/empty.log",
            "empty.log: no record of maplines.dbc is whole in 1 frame ",
            id="no lines",
        ),
        pytest.param("{d}/exact.blf.csv {d}/bare.log", "no time stamps", id="no times"),
        pytest.param("{d}/exact.blf.csv {d}/later.log", "of the same drive", id="other drive"),
        pytest.param("{d}/exact.blf.csv {d}/exact.blf --plot a.gif", r"--plot.*\.png", id="plot"),
    ],
)
def test_a_mistake_is_one_line(folder: Path, capsys: Capture, words: str, error: str) -> None:
    (folder / "empty.log").write_text("(1700000000.0) can0 100#00\n")
    rows = [row.split() for row in (folder / "wrong.log").read_text().splitlines()]
    bare = [(data.split("#")[0], data.split("#")[1]) for _, _, data, *_ in rows[:400]]
    text = "".join(f" can0 {i} [8] {bytes.fromhex(d).hex(' ')}\n" for i, d in bare)
    (folder / "bare.log").write_text(text.upper().replace("CAN0", "can0"))
    later = [f"({float(t[1:-1]) + 1e5:.6f}) {' '.join(rest)}\n" for t, *rest in rows[:400]]
    (folder / "later.log").write_text("".join(later))
    capsys.readouterr()
    assert main(["accuracy", *words.format(d=folder).split()]) == 1
    errors = [line for line in capsys.readouterr().err.splitlines() if "error:" in line]
    assert re.search(error, errors[-1])
