"""Many logs: each once, resumed where it stopped, with a broken one among them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.recordings import record

from maplines_can.cli import main
from maplines_can.recordings.data_set import MANIFEST, Tables, logs_of, write_data_set
from maplines_can.recordings.fitting import best_fit, fits
from maplines_can.recordings.read_lines import read_lines
from maplines_can.values.errors import LogError
from maplines_can.wire import default_dbc_path

TABLES = Tables(at=(20.0,))


@pytest.fixture
def logs(faulty_log: Path, tmp_path: Path) -> Path:
    """Folder with five logs, one of them damaged and one of them no log at all."""
    folder = tmp_path / "logs"
    (folder / "monday").mkdir(parents=True)
    text = faulty_log.read_text()
    for number in range(3):
        (folder / f"{number}.log").write_text(text[: len(text) * (number + 1) // 4])
    (folder / "monday" / "0.log").write_text(text)
    (folder / "monday" / "broken.log").write_text("garbage\n" * 9)
    (folder / "notes.txt").write_text("no log")
    return folder


def written(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*.csv")}


def test_every_log_is_there_once(logs: Path, tmp_path: Path) -> None:
    out = tmp_path / "set"
    found = logs_of([str(logs), str(logs / "0.log"), str(logs / "*.log")])
    assert len(found) == 5
    results = write_data_set(found, out, ".csv", TABLES)
    assert [result["log"] for result in results] == [*map(str, found)]
    by_name = {result["name"]: result for result in results}
    assert {*by_name} == {"0", "1", "2", "monday__0", "monday__broken"}
    assert "none of 9 records" in by_name["monday__broken"]["error"]
    whole = read_lines(logs / "monday" / "0.log")
    assert by_name["monday__0"]["lines"] == len(whole)
    for name in ("0", "1", "2", "monday__0"):
        rows = (out / "lines" / f"{name}.csv").read_text().splitlines()
        assert len(rows) == by_name[name]["lines"] + 1
    assert not (out / "lines" / "monday__broken.csv").exists()


def test_a_run_goes_on(logs: Path, tmp_path: Path) -> None:
    """After a stop in the middle: the same files, and no log is read again."""
    found, whole, part = logs_of([str(logs)]), tmp_path / "whole", tmp_path / "part"
    write_data_set(found, whole, ".csv", TABLES)

    class StopError(Exception): ...

    def stop(done: int, _total: int, _result: Any) -> None:
        if done == 2:
            raise StopError

    with pytest.raises(StopError):
        write_data_set(found, part, ".csv", TABLES, progress=stop)
    with (part / MANIFEST).open("a") as manifest:
        manifest.write('{"log": "half a ro')  # the process was killed while it wrote
    (part / "lines" / ".2.csv.1.part").write_text("left by a worker that was killed")
    before = {path: path.stat().st_mtime_ns for path in part.rglob("*.csv")}
    results = write_data_set(found, part, ".csv", TABLES)
    assert written(part) == written(whole)
    assert all(path.stat().st_mtime_ns == t for path, t in before.items())
    assert len(results) == 5
    assert not [*part.rglob("*.part")]
    rows = (part / MANIFEST).read_text().splitlines()[1:]
    assert sorted(json.loads(row)["log"] for row in rows) == sorted(map(str, found))


@pytest.mark.parametrize(
    "row", ["5", "{}", "[1]", '{"log": ', '{"a":' * 5000 + "1" + "}" * 5000, '{"log": "x"}']
)
def test_rows_of_a_manifest_that_are_none_are_left_out(
    row: str, logs: Path, tmp_path: Path
) -> None:
    """Of a run that was killed, or of someone else: each log is there once."""
    found, out = logs_of([str(logs / "0.log")]), tmp_path / "set"
    write_data_set(found, out, ".csv", TABLES)
    with (out / MANIFEST).open("a") as manifest:
        manifest.write(f"{row}\n")
    assert [result["name"] for result in write_data_set(found, out, ".csv", TABLES)] == ["0"]
    assert row not in (out / MANIFEST).read_text().splitlines()


@pytest.mark.parametrize("head", ["", "x", "[" * 5000])
def test_a_manifest_of_something_else_is_named(head: str, logs: Path, tmp_path: Path) -> None:
    """It is not replaced."""
    out = tmp_path / "set"
    out.mkdir()
    (out / MANIFEST).write_text(head)
    with pytest.raises(ValueError, match=r"manifest\.jsonl: (is not valid JSON|values must be)"):
        write_data_set(logs_of([str(logs / "0.log")]), out, ".csv", TABLES)
    assert (out / MANIFEST).read_text() == head


def test_a_log_that_has_changed_is_read_again(logs: Path, tmp_path: Path) -> None:
    found, out = logs_of([str(logs)]), tmp_path / "set"
    before = write_data_set(found, out, ".csv", TABLES)
    changed = logs / "0.log"
    changed.write_text((logs / "2.log").read_text())
    after = write_data_set(found, out, ".csv", TABLES)
    again = [a["log"] for a, b in zip(after, before, strict=True) if a != b]
    assert again == [str(changed)]
    with pytest.raises(ValueError, match="tables of other options"):
        write_data_set(found, out, ".csv", Tables(at=(30.0,)))


def test_processes_write_the_same(logs: Path, tmp_path: Path) -> None:
    found = logs_of([str(logs)])
    write_data_set(found, tmp_path / "one", ".csv", TABLES)
    write_data_set(found, tmp_path / "two", ".csv", TABLES, jobs=2)
    assert written(tmp_path / "one") == written(tmp_path / "two")


def test_a_place_without_logs_raises(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="has no log"):
        logs_of([str(tmp_path)])
    with pytest.raises(LogError, match="has no log"):
        logs_of([str(tmp_path / "*.log")])


# ---- the command -----------------------------------------------------------------------------


def test_the_command_writes_a_table(faulty_log: Path, tmp_path: Path, capsys: Any) -> None:
    out = tmp_path / "drive.csv"
    assert main(["decode", str(faulty_log), "--at", "20,40", "-o", str(out)]) == 0
    notes = capsys.readouterr().err
    assert main(["decode", str(faulty_log), "--csv", "--at", "20,40"]) == 0
    printed = capsys.readouterr()
    # The same counters as those of the decoder frame by frame.
    assert [line for line in notes.splitlines() if "written" not in line] == (
        printed.err.splitlines()
    )
    assert len(out.read_text().splitlines()) == len(printed.out.splitlines())
    assert main(["decode", str(faulty_log), "-o", str(out)]) == 1
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["-o", "lines.xls"], "a table has the suffix"),
        (["x.log", "-o", "lines.csv"], "many logs are a data set"),
        (["x.log"], "give -o FOLDER"),
        (["--jobs", "2"], "are for many logs"),
        (["--at", "1,x"], "must be numbers such as"),
        (["--slots", "left"], "is no slot"),
    ],
)
def test_wrong_usage(faulty_log: Path, options: list[str], message: str, capsys: Any) -> None:
    try:
        status = main(["decode", str(faulty_log), *options])
    except SystemExit as end:
        status = int(end.code or 0)
    assert status > 0
    assert message in capsys.readouterr().err


# ---- which DBC -------------------------------------------------------------------------------


def test_the_dbc_that_fits(faulty_log: Path, scene_log: Path, tmp_path: Path, capsys: Any) -> None:
    """By the checksums: not by the CAN IDs, which two DBCs share."""
    assert fits(faulty_log)[0].name == "maplines.dbc"
    assert best_fit(fits(scene_log), scene_log).name == "maplines-pose.dbc"
    assert fits(scene_log)[0].chance < -99
    rng = np.random.default_rng(0)
    path = tmp_path / "random.log"
    rows = (f"({k}.0) can0 {0x340 + k % 8:03X}#{rng.bytes(8).hex()}\n" for k in range(5000))
    path.write_text("".join(rows))
    with pytest.raises(LogError, match="no DBC fits"):
        best_fit(fits(path), path)
    assert main(["decode", str(path), "--dbc", "auto"]) == 1
    assert "no DBC fits" in capsys.readouterr().err
    folder = str(default_dbc_path().parent)
    assert main(["decode", str(scene_log), "--dbc", folder, "--slots", "route"]) == 0
    assert "maplines-pose.dbc" in capsys.readouterr().err


def test_authenticated_frames_need_their_key(tmp_path: Path) -> None:
    """Without it no record of theirs counts."""
    key = tmp_path / "key"
    key.write_text("2b7e151628aed2a6abf7158809cf4f3c")
    key.chmod(0o600)
    log = record(tmp_path / "secured.log", "--key-file", str(key), seconds=2.0)
    with pytest.raises(LogError, match="no DBC fits"):
        best_fit(fits(log), log)
