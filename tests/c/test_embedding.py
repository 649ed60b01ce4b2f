"""The programs of docs/embedding.md are compiled and do what the page says."""

import json
import os
import re
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from maplines_can import Codec, Slot
from maplines_can.bus.logs import read_log
from maplines_can.cli import main

PAGE = (Path(__file__).parents[2] / "docs" / "embedding.md").read_text(encoding="utf-8")
SOURCES = re.findall(r"(?ms)^`(\w+\.c)` is:\n\n```c\n(.*?)^```\n", PAGE)
COMPILE = re.findall(r"(?m)^(cc .* maplines\.c .*?)\s*(?:#.*)?$", PAGE)
WARNINGS = ["-std=c99", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror"]

pytestmark = pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder with the programs of the page as sources."""
    monkeypatch.chdir(tmp_path)
    for name, text in SOURCES:
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


def build(name: str, more: Sequence[str] = ()) -> None:
    """Compile a program without a warning, and link it as the page says."""
    subprocess.run(["cc", *WARNINGS, *more, "-c", f"{name}.c", "-o", os.devnull], check=True)
    (command,) = (words.split() for words in COMPILE if f" {name}.c " in words)
    subprocess.run([*command, *more], check=True)


def test_programs_are_found() -> None:
    """Each has a command that compiles it."""
    assert [name for name, _ in SOURCES] == ["receiver.c", "sender.c"]
    for name, _ in SOURCES:
        assert sum(f" {name} " in command for command in COMPILE) == 1


@pytest.mark.parametrize("more", [[], ["-DMAPLINES_FLOAT"]], ids=["double", "float"])
def test_the_receiver_prints_what_python_receives(folder: Any, capsys: Any, more: Any) -> None:
    """Lateral positions and widths with their sigmas, in cycles of 50 ms."""
    assert main(["generate", "c"]) == 0
    drive = "drive --as-fast-as-possible --seconds 4 --pose-error --record drive.log"
    assert drive in PAGE
    assert main(drive.split()) == 0
    capsys.readouterr()
    build("receiver", more)
    with (folder / "drive.log").open() as log:
        rows = subprocess.run(["./receiver"], stdin=log, stdout=-1, check=True, text=True).stdout

    decoder, next_ns = Codec.from_dbc().decoder(), 0
    expected: list[Any] = []
    for frame in read_log("drive.log"):
        decoder.feed(frame.can_id, frame.data, frame.t_ns)
        if frame.t_ns < next_ns:
            continue
        next_ns = frame.t_ns + 50_000_000
        left, lane = decoder.latest(Slot.EGO_LEFT, frame.t_ns), decoder.latest_scene(frame.t_ns)
        if left.usable and left.line:
            expected.append([40, left.line.y(40.0), left.line.y_sigma(40.0)])
        if lane.usable and lane.scene:
            expected.append([20, *lane.scene.width(20.0)])
    numbers = re.compile(r"-?\d+\.?\d*")
    printed = [[float(word) for word in numbers.findall(row)] for row in rows.splitlines()]
    assert len(expected) > 100
    assert np.abs(np.array(printed) - expected).max() < 0.00051 + 0.00002 * ("FLOAT" in str(more))


def test_python_receives_what_the_sender_sends(folder: Any, capsys: Any) -> None:
    """20 lines with the mean that was given, to a step, and a covariance that covers."""
    assert main(["generate", "c"]) == 0
    build("sender")
    with (folder / "sent.log").open("w") as log:
        subprocess.run(["./sender"], stdout=log, check=True)
    capsys.readouterr()

    assert main(["decode", "sent.log"]) == 0

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
