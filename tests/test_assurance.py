"""docs/assurance.toml has no gap, and tools/traceability.py finds every kind of gap."""

import json
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import pytest
import traceability as tool

TRACED = "wire/protection/test_e2e.py::test_published_example_of_a_zero_record"
#: Data without a gap; each case below breaks one thing in it.
TEXT = f"""
[[goals]]
id = "G-1"
goal = "No wrong line."

[[assumptions]]
id = "A-1"
of = "bus"
assumption = "It is a bus."

[[faults]]
id = "F-1"
fault = "corruption"
detected_by = "checksum"
reaction = "dropped"
detected_after = "at once"
assumes = ["A-1"]
requirements = ["R-1"]

[[requirements]]
id = "R-1"
requirement = "A checksum."
goals = ["G-1"]
code = ["wire.reception.check:Reason.CRC"]
tests = ["{TRACED}"]
"""
DATA = tomllib.loads(TEXT)

GAPS = [
    pytest.param('id = "R-1"', 'id = "R1"', "an ID is a letter of G, A, F, R", id="malformed-id"),
    pytest.param('id = "F-1"', 'id = "A-2"', "an ID is a letter of G, A, F, R", id="other-table"),
    pytest.param("[[faults]]", "[[assumptions]]\nid = 'A-1'\n[[faults]]", "2 times", id="twice"),
    pytest.param('["R-1"]', '["R-1", "R-2"]', "R-2 is mentioned but", id="undefined"),
    pytest.param('["R-1"]', "[]", "F-1 has nothing in the column 'req", id="fault-alone"),
    pytest.param('["G-1"]', "[]", "R-1 has nothing in the column 'goals'", id="no-goal"),
    pytest.param(
        'line."', 'line."\n[[goals]]\nid = "G-2"', "G-2 is a goal without", id="goal-alone"
    ),
    pytest.param(
        '"wire.reception.check:Reason.CRC"', "", "nothing in the column 'code'", id="no-code"
    ),
    pytest.param(f'"{TRACED}"', "", "nothing in the column 'tests'", id="no-test"),
    pytest.param("code = [", "source = [", "no column 'source'", id="no-column"),
    pytest.param(
        "reception.check:", "reception.checks:", "no module 'wire.reception.checks'", id="no-module"
    ),
    pytest.param("Reason.CRC", "Reason.CRC32", "does not define 'Reason.CRC32'", id="no-member"),
    pytest.param("Reason.CRC", "Enum", "does not define 'Enum'", id="imported-only"),
    pytest.param("protection/test_e2e", "test_e2e", "no file tests/wire/test_e2e.py", id="no-file"),
    pytest.param("zero_record", "one_record", "has no test 'test_pub", id="renamed-test"),
    pytest.param(TRACED, "conftest.py::links", "has no test 'links'", id="a-fixture"),
    pytest.param("[[goals]]", "[[aims]]", "there are no goals", id="no-table"),
]


def shipped() -> Any:
    return tomllib.loads(tool.DATA.read_text(encoding="utf-8"))


def test_the_shipped_data_have_no_gap() -> None:
    result = tool.summary(shipped(), tool.PAGE.read_text(encoding="utf-8"))
    assert result["gaps"] == []
    assert result["requirements"] >= 25
    assert min(result["goals"], result["assumptions"], result["faults"]) > 0


def test_the_page_has_the_tables_of_the_data() -> None:
    assert tool.PAGE.read_text(encoding="utf-8") == tool.page_of(shipped())


def test_the_data_of_the_cases_have_no_gap() -> None:
    assert tool.summary(DATA) == {
        "goals": 1,
        "assumptions": 1,
        "faults": 1,
        "requirements": 1,
        "code references": 1,
        "tests": 1,
        "gaps": [],
    }


@pytest.mark.parametrize(("before", "after", "gap"), GAPS)
def test_a_gap_is_found(before: str, after: str, gap: str) -> None:
    text = TEXT.replace(before, after, 1)
    assert text != TEXT
    found = tool.gaps_of(tomllib.loads(text))
    assert any(gap in one for one in found), found


def test_an_id_of_the_page_that_is_not_defined_is_a_gap() -> None:
    assert tool.gaps_of(DATA, "as A-1 and A-9 say") == ["A-9 is mentioned but not defined"]


def test_run_tells_failed_skipped_and_missing_from_passed(tmp_path: Path) -> None:
    """In another process: a run of pytest within a run shares its state."""
    write_tests(
        tmp_path,
        "import pytest\n"
        "def test_good(): pass\n"
        "@pytest.mark.parametrize('n', [1, 2, 3])\n"
        "def test_bad(n): assert n != 2\n"
        "def test_left_out(): pytest.skip('not here')\n"
        "@pytest.mark.socketcan\ndef test_kernel(): pytest.skip('no vcan0')\n"
        "@pytest.fixture\ndef broken(): raise ValueError\n"
        "def test_no_setup(broken): pass\n",
    )
    marker = "[tool.pytest.ini_options]\nmarkers = ['socketcan']\n"
    (tmp_path / "pyproject.toml").write_text(marker)
    names = ["test_good", "test_bad", "test_left_out", "test_kernel", "test_no_setup"]
    code = (
        "import json, pathlib, sys, traceability as tool\n"
        f"tool.ROOT = pathlib.Path({str(tmp_path)!r})\n"
        f"found = tool.outcomes_of(['test_some.py::' + name for name in {names}])\n"
        "pathlib.Path(sys.argv[1]).write_text(json.dumps(found))\n"
    )
    answer = tmp_path / "answer.json"
    command = [sys.executable, "-c", code, str(answer)]
    subprocess.run(command, cwd=tool.ROOT / "tools", check=True, capture_output=True)
    outcomes = json.loads(answer.read_text())
    assert list(outcomes) == [f"tests/test_some.py::{name}" for name in names]
    assert list(outcomes.values()) == [
        "passed",
        "failed",
        "skipped",
        "to be run in tools/vcan",
        "failed",
    ]


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A summary, the gaps, and the status."""
    good, bad = tmp_path / "good.toml", tmp_path / "bad.toml"
    good.write_text(TEXT)
    bad.write_text(TEXT.replace("zero_record", "one_record"))
    assert tool.main([str(good)]) == 0
    assert capsys.readouterr().out == (
        "good.toml: 1 goals, 1 assumptions, 1 faults, 1 requirements, 1 code references, 1 tests, "
        "0 gaps\n"
    )
    assert tool.main([str(bad)]) == 1
    assert "bad.toml: 1 goals" in (out := capsys.readouterr().out)
    assert "R-1: tests/wire/protection/test_e2e.py has no test" in out
    assert tool.main([str(bad), "--json"]) == 1
    assert len(json.loads(capsys.readouterr().out)["gaps"]) == 1


def write_tests(folder: Path, text: str) -> None:
    (folder / "tests").mkdir()
    (folder / "tests" / "test_some.py").write_text(text)
