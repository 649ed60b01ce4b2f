"""Recorded drives in any units and any set of columns are the same drive."""

import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maplines_can.simulation import RecordedDrive
from maplines_can.simulation.recorded_errors import covered, linear

#: SI values of three records, and a column name with its unit in SI, for each quantity.
RECORDS = {
    "time": [10.0, 10.5, 11.0],
    "x": [100.0, 105.0, 110.0],
    "y": [-3.0, -2.5, -2.0],
    "heading": [0.1, 0.12, 0.14],
    "speed": [10.0, 11.0, 12.0],
    "yaw_rate": [0.04, 0.05, 0.06],
    "sigma_heading": [0.01, 0.02, 0.03],
}
UNITS = {
    "time": {"": 1.0, "_ms": 1e-3, "_us": 1e-6, "_ns": 1e-9},
    "x": {"": 1.0},
    "y": {"": 1.0},
    "heading": {"": 1.0, "_deg": math.pi / 180},
    "speed": {"": 1.0, "_kmh": 1000 / 3600, "_mph": 1609.344 / 3600},
    "yaw_rate": {"": 1.0, "_deg_s": math.pi / 180},
    "sigma_heading": {"": 1.0, "_deg": math.pi / 180},
}


def written(path: Path, columns: dict[str, Any], delimiter: str = ",") -> Path:
    rows = [delimiter.join(columns)]
    rows += [
        delimiter.join(repr(float(v)) for v in row) for row in zip(*columns.values(), strict=True)
    ]
    path.write_text("\n".join(rows))
    return path


@pytest.mark.parametrize("delimiter", [",", ";", "\t"])
def test_a_drive_is_the_same_in_any_units(tmp_path: Path, delimiter: str) -> None:
    """Each unit of each quantity, with sigmas across and along the car."""
    for suffixes in itertools.zip_longest(*(UNITS[name] for name in RECORDS), fillvalue=""):
        columns: dict[str, Any] = {
            name + suffix: np.array(RECORDS[name]) / UNITS[name][suffix]
            for name, suffix in zip(RECORDS, suffixes, strict=True)
        }
        columns |= {"sigma_along": [0.3, 0.4, 0.5], "sigma_across": [0.1, 0.1, 0.2]}
        drive = RecordedDrive.from_csv(written(tmp_path / "drive.csv", columns, delimiter))
        assert drive.t == pytest.approx(np.array(RECORDS["time"]))
        expected = np.column_stack([RECORDS[name] for name in ("x", "y", "heading")])
        assert drive.pose == pytest.approx(expected)
        assert drive.speed == pytest.approx(np.array(RECORDS["speed"]))
        assert drive.yaw_rate == pytest.approx(np.array(RECORDS["yaw_rate"]))
        assert drive.cov is not None
        for k in range(3):
            c, s = math.cos(RECORDS["heading"][k]), math.sin(RECORDS["heading"][k])
            R = np.array([[c, -s], [s, c]])
            along, across = columns["sigma_along"][k], columns["sigma_across"][k]
            assert drive.cov[k, :2, :2] == pytest.approx(R @ np.diag([along, across]) ** 2 @ R.T)
            assert drive.cov[k, 2, 2] == pytest.approx(RECORDS["sigma_heading"][k] ** 2)
            assert not drive.cov[k, 2, :2].any()


@pytest.mark.parametrize("form", ["sigmas", "entries"])
def test_covariances_in_the_frame_of_the_map(tmp_path: Path, form: str) -> None:
    """By standard deviations, or by all entries, of which each has its place."""
    columns = {name: RECORDS[name] for name in ("time", "x", "y", "heading")}
    A = np.array([[0.3, 0, 0], [0.1, 0.2, 0], [0.01, 0.02, 0.03]])
    P = A @ A.T if form == "entries" else np.diag([0.3, 0.2, 0.03]) ** 2
    if form == "entries":
        for (i, a), (j, b) in itertools.combinations_with_replacement(enumerate("xyh"), 2):
            columns[f"cov_{a}{b}"] = [P[i, j]] * 3
    else:
        columns |= {f"sigma_{n}": [v] * 3 for n, v in (("x", 0.3), ("y", 0.2), ("heading", 0.03))}
    drive = RecordedDrive.from_csv(written(tmp_path / "drive.csv", columns))
    assert drive.cov == pytest.approx(np.tile(P, (3, 1, 1)))
    assert drive.reported(10.2).cov == pytest.approx(P)


@settings(max_examples=60)
@given(st.integers(0, 2**32), st.integers(1, 9), st.integers(0, 2))
def test_linear_interpolation_is_that_of_numpy(seed: int, n: int, trailing: int) -> None:
    """Of each entry, also of matrices."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.1, 1, n))
    values = rng.standard_normal((n, *(2,) * trailing))
    t = np.append(rng.uniform(times[0], times[-1], 7), times)
    got = linear(times, values, t).reshape(len(t), -1)
    for column, of_time in zip(got.T, values.reshape(n, -1).T, strict=True):
        assert column == pytest.approx(np.interp(t, times, of_time))


@settings(max_examples=60)
@given(st.integers(0, 2**32), st.integers(0, 8))
def test_what_is_covered_by_records(seed: int, n: int) -> None:
    """A time at a record, or between two that are close enough, one by one."""
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.choice([0.5, 1.0, 1.5], n))
    t = np.append(rng.uniform(-1, 10, 20), times)
    found = covered(times, t, 1.0)
    for one, is_covered in zip(t, found, strict=True):
        before = [x for x in times if x <= one]
        after = [x for x in times if x >= one]
        expected = bool(before and after) and after[0] - before[-1] <= 1.0
        assert is_covered == expected
