"""The programs of docs/embedding.md are compiled and do what the page says."""

import json
import os
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplines_can import Codec, Slot
from maplines_can.cli import main
from maplines_can.logs.log_reader import read_log
from maplines_can.wire import default_dbc_path

PAGE = (Path(__file__).parents[2] / "docs" / "embedding.md").read_text(encoding="utf-8")
SOURCES = re.findall(r"(?ms)^`(\w+\.c)` is:\n\n```c\n(.*?)^```\n", PAGE)
COMPILE = re.findall(r"(?m)^(cc .* maplines\.c .*?)\s*(?:#.*)?$", PAGE)
#: Files of the core, which each program is linked with.
CORE = ("maplines.c", "maplines.h", "maplines_build.h", "maplines_state.h")
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder with the programs of the page as sources."""
    monkeypatch.chdir(tmp_path)
    write_sources(tmp_path)
    return tmp_path


def write_sources(folder: Path) -> None:
    """Write the programs of the page into a folder."""
    for name, text in SOURCES:
        (folder / name).write_text(text, encoding="utf-8")


def build(name: str, more: Sequence[str] = ()) -> None:
    """Compile a program without a warning, and link it as the page says."""
    subprocess.run(["cc", *WARNINGS, *more, "-c", f"{name}.c", "-o", os.devnull], check=True)
    (command,) = (words.split() for words in COMPILE if f" {name}.c " in words)
    flags = [word for word in command if word.startswith(("-s", "-f", "-O"))]
    texts = {file: Path(file).read_text(encoding="utf-8") for file in CORE}
    Path("maplines.o").write_bytes(core((*flags, *more), tuple(texts.items())))
    words = ["maplines.o" if word == "maplines.c" else word for word in command]
    subprocess.run([*words, *more], check=True)


@cache
def core(flags: tuple[str, ...], files: tuple[tuple[str, str], ...]) -> bytes:
    """Return the object file of the core, which is compiled once for each content."""
    with tempfile.TemporaryDirectory() as folder:
        for name, text in files:
            Path(folder, name).write_text(text, encoding="utf-8")
        subprocess.run(["cc", *flags, "-c", "maplines.c"], check=True, cwd=folder)
        return Path(folder, "maplines.o").read_bytes()


@pytest.fixture(scope="module")
def built(tmp_path_factory: Any) -> Path:
    """A folder with the sender and the receiver of the page as programs."""
    folder: Path = tmp_path_factory.mktemp("built")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        write_sources(folder)
        assert main(["generate", "c"]) == 0
        for name, _ in SOURCES:
            build(name.removesuffix(".c"))
    return folder


@pytest.fixture
def sent(built: Path) -> str:
    """What the sender of the page sends."""
    return subprocess.run([built / "sender"], stdout=-1, check=True, text=True).stdout


def test_programs_are_found() -> None:
    """Each has a command that compiles it."""
    assert [name for name, _ in SOURCES] == ["receiver.c", "sender.c", "scene_sender.c"]
    for name, _ in SOURCES:
        assert sum(f" {name} " in command for command in COMPILE) == 1


def check_printed(program: Path, dbc: str, tolerance: float) -> None:
    """Check that a receiver prints of drive.log what Python receives, in cycles of 50 ms."""
    with open("drive.log") as log:
        rows = subprocess.run([program], stdin=log, stdout=-1, check=True, text=True).stdout
    numbers = re.compile(r"-?\d+\.?\d*")
    printed = [[float(word) for word in numbers.findall(row)] for row in rows.splitlines()]

    decoder, next_ns, expected = Codec.from_dbc(default_dbc_path(dbc)).decoder(), 0, list[Any]()
    for frame in read_log("drive.log"):
        decoder.feed(frame.can_id, frame.data, frame.t_ns)
        if frame.t_ns < next_ns:
            continue
        next_ns = frame.t_ns + 50_000_000
        left, lane = decoder.latest(Slot.EGO_LEFT, frame.t_ns), decoder.latest_scene(frame.t_ns)
        if left.usable and left.line:
            assert left.line.is_valid_at(40.0)
            expected.append([40, left.line.y(40.0), left.line.y_sigma(40.0)])
        if lane.usable and lane.scene:
            expected.append([20, *lane.scene.width(20.0)])
    assert len(expected) > 100
    assert np.abs(np.array(printed) - expected).max() < tolerance


@pytest.mark.parametrize("more", [[], ["-DMAPLINES_FLOAT"]], ids=["double", "float"])
def test_the_receiver_prints_what_python_receives(built: Path, folder: Path, more: Any) -> None:
    """Lateral positions and widths with their sigmas."""
    drive = "drive --as-fast-as-possible --seconds 4 --pose-error --record drive.log"
    assert drive in PAGE
    assert main(drive.split()) == 0
    if more:
        assert main(["generate", "c"]) == 0
        build("receiver", more)
    program = (folder if more else built) / "receiver"
    check_printed(program, "maplines.dbc", 0.00053 if more else 0.00051)


def test_the_smallest_receiver_prints_what_python_receives(folder: Path) -> None:
    """Of whole scenes, with the cycle of the page in place of that of the receiver."""
    section = PAGE.split("## The receiver with the least state\n")[1].split("\n## ")[0]
    (cycle,) = re.findall(r"(?ms)^```c\n(.*?)^```\n", section)
    source = folder / "receiver.c"
    text, count = re.subn(r"(?ms)^static void cycle\(.*?^}\n", lambda _: cycle, source.read_text())
    assert count == 1
    source.write_text(text)
    for command in re.findall(r"(?m)^maplines (.*)$", section):
        assert main(command.split()) == 0
    build("receiver")
    check_printed(folder / "receiver", "maplines-scene.dbc", 0.00051)


def received(built: Path, log: str) -> tuple[list[str], list[str]]:
    """What the receiver of the page prints, and what it says is no frame."""
    program = [built / "receiver"]
    done = subprocess.run(program, input=log, capture_output=True, check=True, text=True)
    return done.stdout.splitlines(), done.stderr.splitlines()


def test_the_receiver_says_where_a_line_ends(folder: Path) -> None:
    """As the page says, of a line that ends at 12 m: no value at 40 m."""
    source = folder / "sender.c"
    given = source.read_text()
    assert given.count(".x_max = 80") == 1
    source.write_text(given.replace(".x_max = 80", ".x_max = 12"))
    assert main(["generate", "c"]) == 0
    build("sender")
    build("receiver")
    log = subprocess.run(["./sender"], stdout=-1, check=True, text=True).stdout
    rows, _ = received(folder, log)
    assert len(rows) == 20 - 7
    assert set(rows) == set(re.findall(r"(?m)^(nothing at .*)$", PAGE))


@pytest.mark.parametrize(
    ("row", "is_frame"),
    [
        pytest.param("(0.000001) vcan0 123#", True, id="no-data"),
        pytest.param("(0.000001) vcan0 12345678##1", True, id="fd-without-data"),
        pytest.param(f"(0.000001) vcan0 123##1{'A5' * 64}", True, id="fd"),
        pytest.param("(0.000001) vcan0 123#00 T", True, id="direction"),
        pytest.param("# a comment", False, id="comment"),
        pytest.param("", False, id="empty"),
        pytest.param("(0.000001) vcan0 123#R8", False, id="remote"),
        pytest.param("(0.000001) vcan0 123##", False, id="fd-without-flags"),
        pytest.param("(0.000001) vcan0 123#0 1", False, id="half-a-byte"),
        pytest.param(f"(0.000001) vcan0 123##1{'A5' * 65}", False, id="65-bytes"),
        pytest.param("(9999999999.000000) vcan0 123#00", False, id="time"),
        pytest.param("(-000000001.000000) vcan0 123#00", False, id="negative-time"),
        pytest.param("(0.000001) vcan0 123", False, id="cut"),
    ],
)
def test_rows_that_are_no_frames_are_told_and_skipped(
    built: Any, sent: Any, row: str, is_frame: Any
) -> None:
    """Wherever they are, the frames around them are received."""
    expected, none = received(built, sent)
    assert not none
    frames = sent.splitlines()
    for place in (0, 41, len(frames)):
        log = "\n".join([*frames[:place], row, *frames[place:]])
        rows, told = received(built, log if row else log + "\n")
        assert rows == expected
        assert told == ([] if is_frame else [f"no frame: {row}"])


@pytest.mark.parametrize("fd", [False, True])
def test_the_sender_writes_each_kind_of_frame(folder: Path, capsys: Any, fd: bool) -> None:
    """Extended CAN IDs and CAN FD: as for the DBC of the page, Python reads 20 lines."""
    text = default_dbc_path().read_text(encoding="utf-8")
    for can_id in (0x340, 0x348):
        text = re.sub(rf"\b{can_id}\b", str(0x9ABC0000 | can_id), text)
    (folder / "own.dbc").write_text(text, encoding="utf-8")
    source = folder / "sender.c"
    call = "&line, false, 0, frames"
    assert call in source.read_text()
    source.write_text(source.read_text().replace(call, call.replace("false", str(fd).lower())))
    assert main(["generate", "c", "--dbc", "own.dbc", "--name", "maplines"]) == 0
    build("sender")
    log = subprocess.run(["./sender"], stdout=-1, check=True, text=True).stdout
    (folder / "sent.log").write_text(log)
    assert log.count("1ABC0348##1" if fd else "1ABC0340#") == (20 if fd else 80)
    capsys.readouterr()

    assert main(["decode", "--dbc", "own.dbc", "sent.log"]) == 0

    assert capsys.readouterr().out.count("EGO_LEFT") == 20


def test_python_receives_the_scene(built: Path, capsys: Any) -> None:
    """Two lines whose joint covariance covers that of the program, and is near it."""
    path, program = built / "scenes.log", [built / "scene_sender"]
    with path.open("w") as log:
        done = subprocess.run(program, stdout=log, stderr=-1, check=True, text=True)
    assert done.stderr == "SENT\n"

    assert main(["decode", "--scenes", str(path)]) == 0

    row = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert row["scene"] == ["EGO_LEFT", "EGO_RIGHT"]
    pose_cov = np.diag([0.3, 0.1, 0.005]) ** 2
    J = np.zeros((8, 3))
    J[0::4] = 0.002, -1, 0
    J[1::4] = 0.0005, 0, -1
    own = np.kron(np.eye(2), np.diag([0.03**2, 0, 0, 0]))
    cov, sent = np.array(row["joint"]["cov"]), J @ pose_cov @ J.T + own
    step = np.kron(np.eye(2), np.diag([1e-5, 1e-6, 1e-9, 1e-12]))
    assert np.abs(np.array(row["joint"]["mean"])[[0, 4]] - [1.75, -1.75]).max() < 5e-4
    sigma = np.sqrt(cov.diagonal())
    assert np.linalg.eigvalsh((cov - sent) / np.outer(sigma, sigma))[0] > -1e-9
    assert np.linalg.eigvalsh((1.1 * sent + 100 * step - cov) / np.outer(sigma, sigma))[0] > 0
    width = cov[0, 0] + cov[4, 4] - 2 * cov[0, 4]
    assert 1.0 < width / (2 * 0.03**2) < 1.5
    assert np.diag(np.array(row["pose_error"]["cov"]) / pose_cov.clip(1e-9)).min() >= 1


def test_python_receives_what_the_sender_sends(
    sent: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """20 lines with the mean that was given, to a step, and a covariance that covers."""
    path = tmp_path / "sent.log"
    path.write_text(sent)

    assert main(["decode", str(path)]) == 0

    rows = [json.loads(row) for row in capsys.readouterr().out.splitlines()]
    cov = np.diag([0.01, 1e-4, 1e-8, 1e-12])
    cov[0, 1] = cov[1, 0] = -2e-4
    assert len(rows) == 20
    for k, row in enumerate(rows):
        assert (row["slot"], row["kind"], row["status"]) == ("EGO_LEFT", "SOLID", "FULL")
        assert abs(row["mean"]["y_off"] - (1.75 - 0.01 * k)) < 5e-4
        assert row["age"] == 0.024
        excess = (np.array(row["cov"]) - cov) / np.sqrt(np.outer(cov.diagonal(), cov.diagonal()))
        assert np.linalg.eigvalsh(excess)[0] >= 0
