"""Commands refuse bad input with a nonzero status and one line that names it."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import IO

import numpy as np
import pytest
from support.expressions import cases

from maplines_can import Codec, MapLine, Slot
from maplines_can.cli import main
from maplines_can.generation.dbc.record_spec import DEFAULT


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a bad file of each kind."""
    folder = tmp_path_factory.mktemp("files")
    junk = np.random.default_rng(1).bytes(500)
    for name, content in texts().items():
        (folder / name).write_text(content)
        (folder / name).chmod(0o600)
    (folder / "open.key").chmod(0o644)
    for suffix in [
        "dbc",
        "log",
        "asc",
        "blf",
        "csv",
        "trc",
        "db",
        "mf4",
        "log.gz",
        "npz",
        "parquet",
    ]:
        (folder / f"binary.{suffix}").write_bytes(junk)
    for name in ("folder.log", "tables"):
        (folder / name).mkdir()
    (folder / "tables" / "summary.parquet").write_bytes(junk)
    wrong = np.broadcast_to(np.eye(4), (5, 4, 4)).copy()
    np.savez(folder / "shapes.npz", mean=np.zeros((5, 3)), cov=wrong)
    wrong[:, 0, 1] = 0.5
    np.savez(folder / "asymmetric.npz", mean=np.zeros((5, 4)), cov=wrong)
    return folder


def texts() -> dict[str, str]:
    """Return the text files by name; some are good, for a command that is bad otherwise."""
    frames = Codec.from_dbc().encoder().encode(MapLine.mean_only(Slot.EGO_LEFT, [1.75, 0, 0, 0]))
    text = DEFAULT.dbc()
    return {
        "a-file": "a file\n",
        "good.dbc": text,
        "empty.dbc": "",
        "missing-signal.dbc": re.sub(r"(?m)^ SG_ YOff .*\n", "", text),
        "overlap.dbc": text.replace("Counter m0 : 16|8@1", "Counter m0 : 8|8@1"),
        "classic-only.dbc": re.sub(r'(?m)^BA_ "MapLineSlot" BO_ 84[0-7] .*\n', "", text),
        "short.key": "00ff\n",
        "open.key": bytes(range(16)).hex(),
        "good.key": bytes(range(16)).hex(),
        "good.log": "".join(f"(1000.0) can0 {f.can_id:X}#{f.data.hex()}\n" for f in frames),
        "half-range.faults": "loss 1-\n",
        "huge.faults": f"wrong_id 1 0x{'f' * 400}\n",
        "torn.log": "(1000.0) can0 340#00000000000000\n(1000.1) can0 34\n",
        "empty.csv": "",
        "header.csv": "mean_0,mean_1,mean_2,mean_3\n",
        "words.csv": gaussians(4, "wide"),
        "nan.csv": gaussians(4, "nan"),
        "columns.csv": "a,b\n1,2\n",
        "indefinite.csv": gaussians(4, "2", variance="1"),
        "poses.csv": gaussians(3, "0.0"),
        "one-point.csv": "line,x,y\n0,1,2\n",
        "map.csv": "line,x,y\n" + "".join(f"0,{x},2\n" for x in range(-20, 100, 5)),
    }


def gaussians(n: int, covariance: str, variance: str = "1e-4") -> str:
    """Return a table of 200 Gaussians of n variables; the first two have this covariance."""
    pairs = [(i, j) for i in range(n) for j in range(i, n)]
    head = [f"mean_{i}" for i in range(n)] + [f"cov_{i}{j}" for i, j in pairs]
    entries = [variance if i == j else "0" for i, j in pairs]
    entries[1] = covariance
    return "\n".join([",".join(head), *[",".join(["0"] * n + entries)] * 200]) + "\n"


def arguments(command: str, folder: Path) -> list[str]:
    """Return the words of a command; {d} is the folder, {f} a file where a folder should be."""
    return command.format(d=folder, f=folder / "a-file").split()


def error_line(stderr: str) -> str:
    """Return the one line that says what is wrong; without an error, the last line."""
    lines = [line for line in stderr.splitlines() if line]
    errors = [line for line in lines if re.search(r"\berror:", line)]
    assert len(errors) <= 1, stderr
    assert not re.search("Traceback|Exception ignored|Warning", stderr), stderr
    return (errors or lines)[-1]


@pytest.mark.parametrize(
    ("command", "status", "words"),
    cases(
        # maplines
        ("", 2, "COMMAND"),
        ("fly", 2, "'fly'"),
        ("--rate", 2, "COMMAND"),
        # maplines demo
        ("demo --scenario moon", 2, "--scenario.*'moon'"),
        ("demo --rate nan", 2, "--rate.*'nan'"),
        ("demo --lines 0", 2, "--lines.*'0'"),
        ("demo --components 9", 2, "--components.*'9'"),
        ("demo --max-load 2", 2, "--max-load.*'2'"),
        ("demo --map-error -1", 2, "--map-error.*'-1'"),
        ("demo --seconds 0", 2, "--seconds.*'0'"),
        ("demo --components auto --bitrate 1", 1, "0.001 kbit/s"),
        ("demo --max-load 0.001", 1, "0.1 %"),
        ("demo --dbc {d}/nowhere.dbc", 1, "nowhere.dbc"),
        ("demo --dbc /dev/zero", 1, "/dev/zero"),
        ("demo --dbc {d}/empty.dbc", 1, "empty.dbc"),
        ("demo --dbc {d}/binary.dbc", 1, "binary.dbc"),
        ("demo --dbc {d}/missing-signal.dbc", 1, "missing-signal.dbc.*YOff"),
        ("demo --dbc {d}/overlap.dbc", 1, "overlap.dbc.*Counter"),
        ("demo --interface socketcan --channel nocan9", 1, "nocan9"),
        ("demo --seconds 0.1 --plot {f}/a.png", 1, "a-file/a.png"),
        ("demo --seconds 0.1 --plot /dev/full", 1, "/dev/full"),
        ("demo --seconds 0.1 --plot a.xyz", 1, "a.xyz"),
        ("demo --faults loss=2", 2, "--faults.*loss.*2"),
        ("demo --faults script={d}/nowhere", 2, "--faults.*nowhere"),
        ("demo --faults script={d}/binary.dbc", 2, "--faults.*binary.dbc"),
        ("demo --faults script=/dev/zero", 2, "--faults.*/dev/zero"),
        ("demo --faults script={d}/half-range.faults", 2, "--faults.*half-range.faults.*'1-'"),
        ("demo --faults script={d}/huge.faults", 2, "--faults.*huge.faults.*wrong_id"),
        ("demo --faults flood=1,flood_ids=0-0x20000000", 2, "--faults.*flood_ids.*0x0-0x20000000"),
        ("demo --key-file {d}/nowhere", 1, "/nowhere"),
        ("demo --key-file {d}/short.key", 1, "short.key.*4 characters"),
        ("demo --key-file {d}/open.key", 1, "open.key.*0644"),
        ("demo --key-file 999:{d}/good.key", 1, "key_id.*999"),
        ("demo --key-env NO_SUCH_VARIABLE", 1, "NO_SUCH_VARIABLE"),
        ("demo --key-file {d}/good.key --dbc {d}/good.dbc", 1, "good.dbc"),
        # maplines send
        ("send --count 0", 2, "--count.*'0'"),
        ("send --interface virtual --fd --dbc {d}/classic-only.dbc --count 1",
         1, "classic-only.dbc"),
        ("send --interface virtual --components auto --max-load 0.001", 1, "0.1 %"),
        ("send --interface virtual --faults flood=-1", 2, "--faults.*flood.*-1"),
        # maplines receive
        ("receive --timeout 0", 2, "--timeout.*'0'"),
        ("receive --count -1", 2, "--count.*'-1'"),
        ("receive --cycle-ms 0", 2, "--cycle-ms.*'0'"),
        ("receive --interface virtual --count 1 --timeout 0.1", 1, "nothing received: no frame"),
        # maplines decode
        ("decode", 2, "LOG"),
        ("decode {d}/nowhere.log", 1, "nowhere.log"),
        ("decode {d}", 1, "is not a file"),
        ("decode {d}/good.dbc", 1, "good.dbc"),
        ("decode {d}/binary.log", 1, "binary.log"),
        ("decode {d}/binary.blf", 1, "binary.blf"),
        ("decode {d}/binary.db", 1, "binary.db"),
        ("decode {d}/binary.mf4", 1, "binary.mf4"),
        ("decode {d}/binary.log.gz", 1, "binary.log.gz"),
        ("decode {d}/folder.log", 1, "folder.log"),
        ("decode {d}/torn.log", 1, "torn.log"),
        # maplines figures
        ("figures", 2, "--out"),
        ("figures --out {d}/f --samples 1", 2, "--samples.*'1'"),
        ("figures --out {f}/figures --samples 1000", 1, "a-file/figures"),
        # maplines truth
        ("claims --scenario moon", 2, "--scenario.*'moon'"),
        ("claims --samples 10", 2, "--samples.*'10'"),
        ("claims --format pdf", 2, "--format.*'pdf'"),
        # maplines scenarios
        ("scenarios --csv", 2, "--csv"),
        ("scenarios extra", 2, "extra"),
        # maplines study run
        ("study", 2, "COMMAND"),
        ("study run", 2, "--out"),
        ("study run --out {d}/s --n 0", 2, "--n.*'0'"),
        ("study run --out {d}/s --code Zip", 2, "--code.*'Zip'"),
        ("study run --out {d}/s --finer 99", 2, "--finer.*'99'"),
        ("study run --out {d}/s --finer -8 --n 100 --set road --code Cholesky", 1, "Cholesky.*-8"),
        ("study run --out {d}/s --set nowhere", 1, "nowhere"),
        ("study run --out {d}/s --set {d}/binary.npz", 1, "binary.npz"),
        ("study run --out {d}/s --set {d}/binary.parquet", 1, "binary.parquet"),
        ("study run --out {d}/s --set {d}/empty.csv", 1, "empty.csv.*mean_0"),
        ("study run --out {d}/s --set {d}/header.csv", 1, "header.csv.*cov_00"),
        ("study run --out {d}/s --set {d}/nan.csv", 1, "nan.csv.*row 0"),
        ("study run --out {d}/s --set {d}/words.csv", 1, "words.csv.*row 0.*'wide'"),
        ("study run --out {d}/s --set {d}/columns.csv", 1, "columns.csv.*mean_0"),
        ("study run --out {d}/s --set {d}/indefinite.csv --n 100 --code Cholesky --jobs 1",
         1, "indefinite.csv.*row 0"),
        ("study run --out {d}/s --set {d}/asymmetric.npz", 1, "asymmetric.npz.*row 0.*symmetric"),
        ("study run --out {d}/s --set {d}/shapes.npz", 1, "shapes.npz.*shape"),
        ("study run --out {d}/s --set {d}/poses.csv", 1, "poses.csv.*--map"),
        ("study run --out {d}/s --set {d}/poses.csv --map {d}/nowhere.csv", 1, "nowhere.csv"),
        ("study run --out {d}/s --set {d}/poses.csv --map {d}/header.csv",
         1, "header.csv.*line, x"),
        ("study run --out {d}/s --set {d}/poses.csv --map {d}/one-point.csv", 1, "one-point.csv"),
        ("study run --out {d}/s --set {d}/poses.csv --map {d}/empty.csv", 1, "empty.csv is empty"),
        ("study run --out {d}/s --set {d}/poses.csv --map {d}/map.csv --window 80 -20",
         1, "window.*80"),
        ("study run --out {d}/s --set {d}/poses.csv --map {d}/map.csv --window nan 80",
         1, "window.*nan"),
        ("study run --out {f}", 1, "a-file"),
        ("study run --out {d} --set road --n 100", 1, "name a new directory"),
        ("study run --out {d}/s --scheduler nowhere --set road --n 100", 1, "nowhere"),
        # maplines study report
        ("study report", 2, "DIR.*--out"),
        ("study report {d}/nowhere --out {d}/r.html", 1, "/nowhere"),
        ("study report {d} --out {d}/r.html", 1, "summary.parquet"),
        ("study report {f} --out {d}/r.html", 1, "a-file"),
        ("study report {d}/tables --out {d}/r.html", 1, "tables/summary.parquet"),
        # maplines study production
        ("study production --n 1", 2, "--n.*'1'"),
        ("study production --csv --json", 2, "--json.*--csv"),
        # maplines design
        ("design", 1, "--frames.*--max-kl"),
        ("design --frames 1 --n 100 --set road --out {d}/x.dbc", 1, "frames.*90"),
        ("design --frames 999", 2, "--frames.*'999'"),
        ("design --max-kl nan", 2, "--max-kl.*'nan'"),
        ("design --frames 3 --max-kl 1e-300 --n 100 --set road", 1, "--max-kl.*1e-300"),
        ("design --frames 4 --set nowhere", 1, "nowhere"),
        ("design --frames 4 --set {d}/poses.csv", 1, "poses.csv"),
        ("design --frames 4 --range y_off=-1 --n 100 --out {d}/x.dbc", 1, "y_off=-1"),
        ("design --frames 4 --range width=3", 2, "--range.*'width=3'"),
        ("design --frames 4 --sigma y_off=0 --n 100 --out {d}/x.dbc", 1, "y_off=0"),
        ("design --frames 4 --max-lateral nan --n 100 --out {d}/x.dbc", 2, "--max-lateral.*'nan'"),
        ("design --frames 4 --max-saturated 2 --n 100 --out {d}/x.dbc", 2, "--max-saturated.*'2'"),
        ("design --frames 4 --out design.txt", 1, "design.txt"),
        ("design --frames 4 --n 100 --set road --out {f}/x.dbc", 1, "a-file/x.dbc"),
    ),
)  # fmt: skip
def test_a_command_refuses_bad_input(
    command: str,
    status: int,
    words: str,
    folder: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The exit status is 2 for wrong usage and 1 for any other error."""
    monkeypatch.chdir(folder)
    try:
        ended = main(arguments(command, folder))
    except SystemExit as wrong_usage:
        ended = int(wrong_usage.code or 0)

    pattern = words.replace("/", r"[/\\]+")
    assert status == ended
    assert re.search(pattern, error_line(capsys.readouterr().err))


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize(
    "command",
    ["send --interface virtual --count 1 --rate 1000", "decode {d}/good.log", "scenarios --json"],
)
def test_a_full_disk_is_an_error(command: str, folder: Path) -> None:
    """Output that cannot be written is an error, in the process of the command itself."""
    with Path("/dev/full").open("w") as out:
        assert "No space" in error_line(run(command, folder, out, status=1))


@pytest.mark.parametrize(
    ("command", "status"),
    [
        pytest.param("fly", 2, id="usage"),
        pytest.param("decode {d}/torn.log", 1, id="log"),
    ],
)
def test_a_process_ends_with_one_line(command: str, status: int, folder: Path) -> None:
    """The process of a command ends with the status of `main` and without a traceback."""
    assert "error:" in error_line(run(command, folder, subprocess.DEVNULL, status))


def run(command: str, folder: Path, stdout: int | IO[str], status: int) -> str:
    """Run a command in a process, check its exit status, and return what it wrote to stderr."""
    ended = subprocess.run(
        [sys.executable, "-m", "maplines_can.cli", *arguments(command, folder)],
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=subprocess.PIPE,
        text=True,
        cwd=folder,
        env={**os.environ, "MPLBACKEND": "agg", "PYTHONWARNINGS": "default"},
        timeout=60,
        check=False,
    )
    assert status == ended.returncode, ended.stderr
    return ended.stderr
