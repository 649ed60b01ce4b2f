"""The recording of the behaviour and the count of journeys: what they tell apart."""

from pathlib import Path

import behaviour
import behaviour_api
import numpy as np
import pytest

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
