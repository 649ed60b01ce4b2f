"""docs/testing.md: its examples run as they stand, and the controller that it warns of fails."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

pytest_plugins = ["pytester"]

PAGE = (Path(__file__).parents[2] / "docs/testing.md").read_text(encoding="utf-8")
FILES = dict(re.findall(r"```py\n# (\w+\.py)\n(.*?)```", PAGE, re.DOTALL))
TEST = FILES["test_controller.py"]
#: Changes of the controller of the page that make it wrong.
WRONG = {
    "right": ("", ""),
    "stale lines": ("return view.line if view.usable else None", "return view.line"),
    "overconfident": (
        "return view.line if view.usable else None",
        "if not view.usable:\n            return None\n"
        "        from maplines_can import Gaussian, MapLine\n"
        "        own = view.line.gaussian\n"
        "        return MapLine(Slot.EGO_LEFT, Gaussian(own.mean, own.cov * 0.8**2))",
    ),
    "independent": (
        "return view.line if view.usable else None",
        "if not view.usable:\n            return None\n"
        "        from maplines_can import Gaussian, MapLine\n"
        "        self.last = [*getattr(self, 'last', [])[-3:], view.line.gaussian]\n"
        "        n = len(self.last)\n"
        "        mean = sum(g.mean for g in self.last) / n\n"
        "        cov = sum(g.cov for g in self.last) / n**2\n"
        "        return MapLine(Slot.EGO_LEFT, Gaussian(mean, cov))",
    ),
}


def test_the_test_has_15_lines() -> None:
    assert len([line for line in TEST.splitlines() if line.strip()]) <= 15


@pytest.mark.parametrize("controller", WRONG)
def test_the_test_of_the_page_finds_wrong_controllers(
    pytester: pytest.Pytester, controller: str
) -> None:
    """In an empty folder; with the seed of the page, so the result is the same each time."""
    for name, text in FILES.items():
        (pytester.path / name).write_text(text, encoding="utf-8")
    path = pytester.path / "controller.py"
    text = path.read_text(encoding="utf-8")
    assert WRONG[controller][0] in text
    path.write_text(text.replace(*WRONG[controller], 1), encoding="utf-8")

    result = pytester.runpytest_inprocess("-p", "no:cacheprovider")

    result.assert_outcomes(**{"passed" if controller == "right" else "failed": 1})
    if controller != "right":
        result.stdout.fnmatch_lines(["*AssertionError: the estimates are overconfident: *"])
    if controller == "stale lines":
        result.stdout.fnmatch_lines(["*look at: what happened in sample 480: most of the errors*"])


def test_the_keywords_of_robot_framework(tmp_path: Path) -> None:
    """The suite of the page passes."""
    pytest.importorskip("robot")
    (suite,) = re.findall(r"```robotframework\n(.*?)```", PAGE, re.DOTALL)
    (tmp_path / "lines.robot").write_text(suite, encoding="utf-8")

    command = [sys.executable, "-m", "robot", "--output", "NONE", "lines.robot"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    assert done.returncode == 0, done.stdout
    assert "1 test, 1 passed, 0 failed" in done.stdout
    assert "shut down" not in done.stdout + done.stderr


SUITE = """\
*** Settings ***
Library    maplines_can.testing.robot.MaplinesLibrary

*** Test Cases ***
Times
    Publish Line    EGO_LEFT    1.75    0    0    0
    Run For    50 ms
    Run For    0.05
    Line Should Be Received    ego left    within=1 second
    No Line Should Be Stale    during=20ms
Wrong slot
    Publish Line    EGO_MIDDLE    1.75    0    0    0
No keyword
    No Operation
"""


def test_robot_framework_has_its_times_and_the_names_of_slots(tmp_path: Path) -> None:
    """A wrong slot is named with the right ones; no bus is left open, and none opened in vain."""
    pytest.importorskip("robot")
    (tmp_path / "lines.robot").write_text(SUITE, encoding="utf-8")

    command = [sys.executable, "-m", "robot", "--output", "NONE", "lines.robot"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)

    assert done.returncode == 1, done.stdout
    assert "3 tests, 2 passed, 1 failed" in done.stdout
    assert "'EGO_MIDDLE'. Available: 'CENTRE" in done.stdout
    assert "shut down" not in done.stdout + done.stderr
