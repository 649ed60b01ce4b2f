"""The recording of the behaviour and the count of journeys: what they tell apart."""

from itertools import pairwise
from pathlib import Path

import behaviour
import behaviour_api
import journeys
import numpy as np
import pytest
import sizes

import maplines_can as ml


@pytest.mark.parametrize(
    ("texts", "status"),
    [
        pytest.param({"a.txt": "one\ntwo\n", "b.txt": "x"}, 0, id="equal"),
        pytest.param({"a.txt": "one\n2\n", "b.txt": "x"}, 1, id="a-row"),
        pytest.param({"a.txt": "one\ntwo\n"}, 1, id="a-part-lacks"),
        pytest.param({"a.txt": "one\ntwo\n", "b.txt": "x", "c.txt": "y"}, 1, id="a-part-more"),
        pytest.param({"a.txt": "one\ntwo", "b.txt": "x"}, 1, id="the-end-of-a-row"),
    ],
)
def test_a_difference_of_recordings_is_found(
    tmp_path: Path, texts: dict[str, str], status: int
) -> None:
    """In a row, and if a part is in one recording only."""
    first = {"a.txt": "one\ntwo\n", "b.txt": "x"}
    for folder, files in (("A", first), ("B", texts)):
        (tmp_path / folder).mkdir()
        for name, text in files.items():
            (tmp_path / folder / name).write_text(text)
    assert behaviour.main(["compare", str(tmp_path / "A"), str(tmp_path / "B")]) == status


def test_the_last_bit_of_a_value_is_recorded() -> None:
    """Of a variance of a line, and of an entry of an array that is too long to be written."""
    cov, long = np.eye(4), np.ones(200)
    before = behaviour_api.shown(ml.MapLine(ml.Slot.EGO_LEFT, ml.Gaussian(np.zeros(4), cov)))
    cov[2, 2], long[7] = np.nextafter(1, 2), np.nextafter(1, 2)
    assert (
        behaviour_api.shown(ml.MapLine(ml.Slot.EGO_LEFT, ml.Gaussian(np.zeros(4), cov))) != before
    )
    assert behaviour_api.shown(long) != behaviour_api.shown(np.ones(200))


def test_a_journey_is_there_and_back() -> None:
    """A call into another file and the return are stays; a function of numpy is none."""
    found = journeys.steps(lambda: (np.mean([1, 2]), ml.Gaussian([0.0], [[1.0]]).marginal([0])))
    files = [file for file, _ in journeys.stays(found)]
    assert files[0] == files[-1]
    assert all(one != other for one, other in pairwise(files))
    assert len(set(files)) < len(files)
    assert {Path(file).name for file in files} >= {"gaussian.py", "arrays.py"}


def test_sizes_are_those_of_a_reader(tmp_path: Path) -> None:
    """Docstrings, comments and blank lines are no code; an elif is no deeper than its if."""
    (tmp_path / "a.py").write_text(
        'def f(self, a, *, b):\n    """Do.\n\n    More.\n    """\n\n    # why\n    if a:\n'
        "        for _ in b:\n            pass\n    elif b:\n        pass\n"
    )
    (module,) = sizes.modules(tmp_path, ".")
    (function,) = sizes.functions(module)
    assert (module.lines, function.code) == (12, 6)
    assert (function.depth, function.parameters) == (2, 2)
