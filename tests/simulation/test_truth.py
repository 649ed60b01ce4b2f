"""The truth of a drive: true lines against closed forms, and the file that holds them."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can import Polyline, Slot
from maplines_can.simulation.truth import (
    PLACES,
    Y_PLACES,
    TruthWriter,
    columns,
    read_truth,
    true_lines,
)
from maplines_can.values.errors import DriveFileError
from maplines_can.values.polyline import to_map

SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
pose = st.tuples(st.floats(-1e5, 1e5), st.floats(-1e5, 1e5), st.floats(-3, 3)).map(np.array)


@given(st.floats(-0.004, 0.004), st.floats(-4, 4), pose)
def test_an_arc_is_seen_as_it_is(curvature: float, offset: float, at: Any) -> None:
    """Lateral position, heading and curvature along an arc that passes the car in parallel."""
    s = np.linspace(-60, 130, 800)
    k = curvature if abs(curvature) > 1e-9 else 1e-9
    arc = np.column_stack([np.sin(k * s) / k, offset + 2 * np.sin(k * s / 2) ** 2 / k])
    values = true_lines({Slot.EGO_RIGHT: Polyline(to_map(arc, at))}, SLOTS, at)
    assert np.isnan(values[0]).all()
    y, heading, bend = np.split(values[1], [len(Y_PLACES), len(Y_PLACES) + len(PLACES)])
    x = np.array(Y_PLACES)
    assert y == pytest.approx(offset + (1 - np.sqrt(1 - (k * x) ** 2)) / k, abs=2e-4)
    assert heading == pytest.approx(np.arcsin(k * np.array(PLACES)), abs=2e-4)
    assert bend == pytest.approx(np.full(4, k), abs=3e-5)


def test_a_line_is_stated_as_far_as_it_is() -> None:
    """And its shape where 8 m of it are on either side."""
    line = Polyline([[-5, 2], [52, 2]])
    (values,) = true_lines({Slot.EGO_LEFT: line}, SLOTS[:1], np.zeros(3))
    assert np.isfinite(values).tolist() == [
        *[True] * 6,
        *[False] * 3,
        *[False, True, True, False] * 2,
    ]


def test_a_line_across_is_not_stated() -> None:
    """Nor is one that is not there."""
    across = {Slot.EGO_LEFT: Polyline([[10, -50], [10, 50]])}
    assert np.isnan(true_lines(across, SLOTS, np.zeros(3))).all()
    assert np.isnan(true_lines({}, SLOTS, np.zeros(3))).all()


def rows(n: int) -> list[tuple[list[Any], Any]]:
    rng = np.random.default_rng(1)
    cycles: list[list[Any]] = []
    for i in range(n):
        cycles.append([1.7e9 + i / 20, i / 20, *rng.normal(size=5), 4.5e5, 5.5e6, 0.1])
        cycles[-1] += [1e-4] * 6
        cycles[-1] += ["1:0:-1", "1:0:-1" if i else "", float(i == 3)]
    lines = rng.normal(size=(n, len(SLOTS), 17))
    lines[1:2, 0] = np.nan
    return list(zip(cycles, lines, strict=True))


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize("n", [1, 5, 2300])
def test_the_file_is_read_as_written(tmp_path: Path, suffix: str, n: int) -> None:
    """Also over several blocks; times to a microsecond."""
    if suffix == ".parquet":
        pytest.importorskip("pyarrow")
    path = tmp_path / f"truth{suffix}"
    table = rows(n)
    with TruthWriter(path, SLOTS) as writer:
        for cycle, lines in table:
            writer.write(cycle, lines)
    truth = read_truth(path)
    assert truth.time == pytest.approx([cycle[0] for cycle, _ in table], abs=1e-6)
    assert truth.same_lane.tolist() == [False, *[True] * (n - 1)]
    assert truth.lane_changes == (n > 3)
    assert list(truth.lines) == list(SLOTS)
    for i, slot in enumerate(SLOTS):
        expected = np.array([lines[i] for _, lines in table])
        assert np.allclose(truth.lines[slot], expected, rtol=1e-11, equal_nan=True)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no column"),
        ("a,b\n1,2\n", "has no column time"),
        (",".join(columns(SLOTS)) + "\n", "one row or more"),
        (",".join(columns(SLOTS)) + "\n1,2\n", "line 2 has not"),
        (
            ",".join(columns(SLOTS)) + "\nsoon" + "," * (len(columns(SLOTS)) - 1) + "\n",
            "column time: .*'soon'",
        ),
        (",".join(columns(SLOTS)) + ("\n1" + "," * (len(columns(SLOTS)) - 1)) * 2, "must increase"),
    ],
)
def test_a_wrong_file_is_refused(tmp_path: Path, text: str, words: str) -> None:
    path = tmp_path / "truth.csv"
    path.write_text(text)
    with pytest.raises(DriveFileError, match=f"truth.csv: .*{words}"):
        read_truth(path)


def test_other_formats_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DriveFileError, match=r".csv or .parquet, not '.blf'"):
        read_truth(tmp_path / "truth.blf")
    with pytest.raises(DriveFileError, match="cannot be read"):
        read_truth(tmp_path / "nowhere.csv")
    pytest.importorskip("pyarrow")
    (tmp_path / "junk.parquet").write_bytes(b"junk")
    with pytest.raises(DriveFileError, match=r"junk\.parquet: cannot be read"):
        read_truth(tmp_path / "junk.parquet")
