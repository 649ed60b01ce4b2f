"""What a caller must not give: each public function refuses it, asserted or not.

The rows, and what is promised of each, are in ``c/tests/misuse_harness.c``.
"""

import re
import subprocess
from pathlib import Path

import pytest
from scene_layouts import layout_of
from support import c_core
from support.c_core import LIBRARIES

from maplines_can.generation.c_build import Features
from maplines_can.generation.c_files import c_files

TESTS = c_core.C / "tests"
MAIN = TESTS / "misuse_harness.c"
#: Assertions are counted and return; are off; abort.
COUNTED = ("-include", str(TESTS / "count_assertions.h"))
CHECKED = ("-DNDEBUG", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
#: Functions for which there is nothing to give.
WITHOUT_ARGUMENTS = {"default_e2e", "self_test"}


def run(*flags: str, row: str = "") -> subprocess.CompletedProcess[str]:
    """Return what the harness prints, or one row of it."""
    layouts = [layout_of("maplines.dbc"), layout_of("maplines-pose.dbc")]
    program = c_core.program([MAIN], layouts, ["lines", "pose"], flags=flags)
    command = [str(program), *([row] if row else [])]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def check(done: subprocess.CompletedProcess[str]) -> list[list[str]]:
    """Return the rows, all of which are as promised."""
    assert (done.returncode, done.stderr) == (0, "")
    rows = [line.split(" | ") for line in done.stdout.splitlines()]
    assert [row for row in rows if "wrong" in " ".join(row)] == []
    return rows


def test_each_mistake_is_asserted_or_refused() -> None:
    """Each function of the header has its rows: the assertions of those that assert are counted."""
    rows = check(run(*COUNTED))
    header = (c_core.C / "include" / "maplines_build.h").read_text()
    public = set(re.findall(r"^#define maplines_(\w+) MAPLINES_NAME", header, re.MULTILINE))
    assert public - {function for function, *_ in rows} == WITHOUT_ARGUMENTS


def test_each_mistake_is_refused_without_assertions() -> None:
    """The address sanitizer finds nothing, and the results are the same ones."""
    if c_core.OWN_FLAGS or c_core.EMULATOR:
        check(run("-DNDEBUG", "-O1"))
        return
    assert check(run(*CHECKED)) == check(run(*COUNTED))


def rows_of(features: Features, folder: Path) -> list[list[str]]:
    """Return the rows of a library, all of which are as promised, and name all of its functions."""
    layouts = {"lines": layout_of("maplines.dbc")}
    layouts |= {"pose": layout_of("maplines-pose.dbc")} if features.scenes else {}
    for file, text in c_files(layouts, features).items():
        (folder / file).write_text(text)
    sent = run(*COUNTED, row="frames")  # for a receiver without a sender
    (folder / "sent_frames.h").write_text(sent.stdout)
    tables = [f"{name}_dbc.c" for name in layouts]
    command = ["cc", "-std=c99", *c_core.WARNINGS, "-ffp-contract=off", *COUNTED, "-I."]
    subprocess.run([*command, "-c", "maplines.c"], check=True, cwd=folder)
    command += [str(MAIN), "maplines.o", *tables, "-lm", "-o", "program"]
    subprocess.run(command, check=True, cwd=folder)
    done = subprocess.run(["./program"], capture_output=True, text=True, check=False, cwd=folder)
    rows = check(done)
    names = subprocess.check_output(["nm", "--extern-only", "maplines.o"], cwd=folder, text=True)
    public = set(re.findall(r"(?m) T maplines_(\w+)_(?:float|double)_receiver", names))
    assert public - {function for function, *_ in rows} == WITHOUT_ARGUMENTS & public
    return rows


@pytest.mark.parametrize("name", [
    "receiver", "sender", "sender of lines", "no mixtures", "two slots", "small", "small, float",
    "one slot",
])  # fmt: skip
def test_a_library_that_lacks_features_refuses_the_same(name: str, tmp_path: Path) -> None:
    """What it has gives what the whole library gives."""
    if c_core.OWN_FLAGS or c_core.EMULATOR:
        pytest.skip("another compiler or processor is tested")
    _, features = LIBRARIES[name]
    rows, whole = rows_of(features, tmp_path), check(run(*COUNTED))
    assert [row for row in rows if row not in whole] == []
    assert len(rows) > 20


@pytest.mark.parametrize("row", ["1", "5", "20"])
def test_the_default_is_assert(row: str) -> None:
    """It says which condition does not hold, and where."""
    done = run(*c_core.FLAGS, row=row)
    assert done.returncode != 0
    assert "Assertion" in done.stderr
