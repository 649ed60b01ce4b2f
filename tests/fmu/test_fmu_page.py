"""docs/fmu.md is followed as it stands, in an empty folder, and names all variables."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from maplines_can.cli import main

fmpy = pytest.importorskip("fmpy", reason="the headers of FMI and the importer come from fmpy")
PAGE = (Path(__file__).parents[2] / "docs" / "fmu.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the commands of the page make."""
    folder = tmp_path_factory.mktemp("page")
    commands = re.findall(r"^maplines (generate fmu [^#]+?) +# ([\w.]+)", PAGE, re.MULTILINE)
    for words, name in commands:
        assert main([*words.split(), "--out", str(folder / name)]) == 0
    return folder


def test_the_program_prints_what_the_page_says(folder: Path) -> None:
    ((name, text),) = re.findall(r"(?ms)^`(\w+\.py)` is:\n\n```python\n(.*?)^```\n", PAGE)
    (printed,) = re.findall(r"(?ms)^```text\n(.*?)^```\n", PAGE)
    (folder / name).write_text(text, encoding="utf-8")
    done = subprocess.run([sys.executable, name], capture_output=True, text=True, cwd=folder)
    assert done.stderr == ""
    assert done.stdout == printed


def test_the_page_names_all_variables(folder: Path) -> None:
    """Those of one slot stand for those of all, and the first elements for the others."""
    prose = re.sub(r"(?ms)^```.*?^```", "", PAGE)
    named = {name.partition("[")[0] for name in re.findall(r"`([^`\n]+)`", prose)}
    for path in folder.glob("*.fmu"):
        for each in fmpy.read_model_description(str(path)).modelVariables:
            name = re.sub(r"^[A-Z_]{4,}\.", "EGO_LEFT.", each.name).partition("[")[0]
            if name != "time" and not name.startswith("dropped."):
                assert name in named, each.name
