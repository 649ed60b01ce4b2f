"""Bad input is refused in words, everywhere; the whole table is docs/bad-input.md."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def tool():
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        import bad_input
    finally:
        sys.path.remove(str(ROOT / "tools"))
    return bad_input


def test_functions_refuse_what_is_bad(tool):
    """A ValueError, a TypeError or an error of the package; what a bus sends is answered."""
    pytest.importorskip("cryptography")
    rows = list(tool.functions())

    assert len(rows) > 300
    assert [row for row in rows if row.is_bad] == []


def test_commands_end_in_one_line(tool):
    """Nonzero status, one line, no traceback; one of each way in which a command ends."""
    rows = list(tool.commands(quick=True))

    assert len(rows) == len(tool.QUICK)
    assert [row for row in rows if row.is_bad] == []


@pytest.mark.parametrize(
    ("case", "status"),
    [
        pytest.param("ego.no_such_thing", "refused, in foreign words", id="another-class"),
        pytest.param("1 / 0", "DEFECT: of another kind", id="another-kind"),
        pytest.param("np.array([nan]).astype(int)", "DEFECT: a warning", id="warning"),
        pytest.param("Gaussian([0.0], [[1.0]])", "DEFECT: taken", id="taken"),
        pytest.param("Gaussian([nan], [[1.0]])", "refused", id="refused"),
        pytest.param("int('x')", "refused, in foreign words", id="foreign"),
    ],
)
def test_the_judge_sees_each_kind(tool, case, status):
    """The table is not blind."""
    import numpy as np

    assert status == tool.called("", case, tool.namespace() | {"np": np}, "refused").status


def test_the_page_has_each_case(tool):
    """docs/bad-input.md is of this tool."""
    page = (ROOT / "docs" / "bad-input.md").read_text()
    for cases in (tool.REFUSED, tool.ANSWERED):
        for text in cases.values():
            for case in filter(None, map(str.strip, text.splitlines())):
                assert f"`{case}`".replace("|", "\\|") in page
    assert "Traceback" not in page
