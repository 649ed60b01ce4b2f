"""docs/cosimulation.md is followed as it stands, in an empty folder."""

import csv
import re
import shlex
from pathlib import Path

import pytest
from support import fmus

from maplines_can.cli import main

pytest.importorskip("fmpy")
pytestmark = fmus.needs_compiler
PAGE = (Path(__file__).parents[2] / "docs" / "cosimulation.md").read_text(encoding="utf-8")


def test_the_commands_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each file that a command reads is made before it; a shorter time is simulated."""
    monkeypatch.chdir(tmp_path)
    (table,) = re.findall(r"(?ms)^`lines.csv` .*?^```text\n(.*?)^```", PAGE)
    Path("lines.csv").write_text(table.replace("\n30,", "\n0.5,"), encoding="utf-8")
    commands = re.findall(r"(?m)^maplines (.*)$", PAGE)
    assert len(commands) == 5
    for command in commands:
        assert main(shlex.split(command.replace("--until 60", "--until 1.0041"))) == 0
    rows = list(csv.DictReader(Path("received.csv").read_text().splitlines()))
    assert float(rows[-1]["time"]) == pytest.approx(1.0041)
    found = [(float(row["time"]), float(row["receiver.EGO_LEFT.y[1]"])) for row in rows]
    assert dict(found)[0.4] == pytest.approx(1.75, abs=0.001)
    assert found[-1][1] == pytest.approx(1.85, abs=0.001)
