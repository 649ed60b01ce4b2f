"""Recorded drives: interpolation, gaps, columns and units."""

import contextlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from maplines_can.simulation import DriveFileError, RecordedDrive

HEADER = "time,x,y,heading"


def circle(t: NDArray[np.float64], radius: float = 50.0, speed: float = 15.0) -> Any:
    """(n, 3) poses on a circle; the heading is wrapped."""
    angle = speed / radius * t
    heading = (angle + np.pi) % (2 * np.pi) - np.pi
    return np.column_stack([radius * np.sin(angle), radius * (1 - np.cos(angle)), heading])


def recorded(t: Any, pose: Any, **more: Any) -> RecordedDrive:
    return RecordedDrive(t, pose, **more)


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


@pytest.mark.parametrize(("rate", "error"), [(20.0, 2e-5), (10.0, 2e-4), (2.0, 0.02)])
def test_circle_between_the_records(rate: float, error: float) -> None:
    """Pose, speed and yaw rate are those of the circle; the heading is unwrapped."""
    drive = recorded(t := np.arange(0, 30, 1 / rate), circle(t))
    fine = np.linspace(1, drive.end - 1, 1000)  # the first and last parabola are less accurate
    state, true = drive.at(fine), circle(fine)
    assert np.abs(state.pose[:, :2] - true[:, :2]).max() < error
    np.testing.assert_allclose(state.pose[:, 2], 0.3 * fine, atol=error)
    np.testing.assert_allclose(state.speed, 15.0, rtol=10 * error)
    np.testing.assert_allclose(state.yaw_rate, 0.3, rtol=1e-3)
    at_records = drive.at(t)
    np.testing.assert_allclose(at_records.pose[:, :2], circle(t)[:, :2], atol=1e-12)


def test_gaps_are_not_bridged() -> None:
    """Times in a gap have no pose, and records beyond it have no influence."""
    t = np.array([0.0, 0.5, 1.0, 4.0, 4.5, 5.0, 9.0])
    pose = np.column_stack([10 * t, 0 * t, 0 * t])
    pose[3:, 1] = 100.0
    drive = recorded(t, pose, max_gap=0.5)
    np.testing.assert_array_equal(drive.gaps, [[1.0, 4.0], [5.0, 9.0]])
    times = [-0.1, 0.0, 0.9, 1.0, 1.1, 3.9, 4.0, 4.3, 5.0, 5.1, 9.0, 9.1]
    known = [0, 1, 1, 1, 0, 0, 1, 1, 1, 0, 1, 0]
    np.testing.assert_array_equal(drive.covers(times), np.array(known, dtype=bool))
    state = drive.at(drive.times(20.0))
    assert set(state.pose[:, 1].round(9)) == {0.0, 100.0}
    np.testing.assert_allclose(state.pose[:, 0], 10 * state.t, atol=1e-9)
    with pytest.raises(ValueError, match=r"not between records more than 0.5 s apart, got 2\.000"):
        drive.at([0.0, 2.0])
    assert recorded(t, pose, max_gap=5.0).covers(times).sum() == 10


@given(st.integers(0, 10**6), st.integers(2, 30))
def test_it_goes_through_all_records(seed: int, n: int) -> None:
    """Whatever the times, the pose at a record is the recorded one, up to turns of 2 pi."""
    random = np.random.default_rng(seed)
    t = np.cumsum(random.uniform(0.01, 3.0, n))
    pose = random.normal(0, 10, (n, 3))
    found = recorded(t, pose).at(t).pose
    np.testing.assert_allclose(found[:, :2], pose[:, :2], atol=1e-9)
    np.testing.assert_allclose(np.cos(found[:, 2] - pose[:, 2]), 1.0, atol=1e-9)


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("time;x;y;heading\n0;1;2;3\n1;2;2;3\n", id="semicolon"),
        pytest.param("time\tx\ty\theading\n0\t1\t2\t3\n1\t2\t2\t3\n", id="tab"),
        pytest.param('"time","x","y","heading"\r\n0,1,2,3\r\n1,2,2,3\r\n', id="quotes-crlf"),
        pytest.param("\ufefftime,x,y,heading\n0,1,2,3\n1,2,2,3", id="byte-order-mark"),
        pytest.param("# a drive\n\n time , x , y , heading \n0, 1, 2, 3\n\n1,2,2,3\n", id="notes"),
    ],
)
def test_forms_of_a_file(tmp_path: Path, text: str) -> None:
    path = tmp_path / "drive.csv"
    path.write_bytes(text.encode())
    drive = RecordedDrive.from_csv(path)
    np.testing.assert_array_equal(drive.pose, [[1, 2, 3], [2, 2, 3]])
    assert drive.skipped == 0


def test_rows_without_a_value_are_skipped_and_counted(tmp_path: Path) -> None:
    """Empty, NaN and infinite; but not if the column is not used."""
    rows = ["0,0,0,0,", "1,nan,0,0,a", "2,,0,0,", "3,3,0,inf,", "NaN,3,0,0,", "5,5,0,0,nan"]
    path = written(tmp_path / "drive.csv", f"{HEADER},note\n" + "\n".join(rows))
    drive = RecordedDrive.from_csv(path)
    np.testing.assert_array_equal(drive.t, [0, 5])
    assert drive.skipped == 4


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the header has no column time"),
        ("x,y,heading\n1,2,3\n", "the header has no column time or time_ms"),
        ("0,1,2,3\n1,1,2,3\n", r"no column time .*\(unknown columns: 0, 1, 2, 3\)"),
        ("time,lat,lon,heading\n0,1,2,3\n", r"x, y; or lat_deg, lon_deg \(unknown columns: lat, l"),
        ("time,x,heading\n0,1,2\n", "must have the columns x, y; or"),
        ("time,x,y\n0,1,2\n", "must have the columns heading or heading_deg; or bearing"),
        ("time,x,y,lat_deg,lon_deg,heading\n0,1,2,3,4,5\n", "too many of the columns lat, lon, x"),
        ("time,x,y,heading,heading_deg\n0,1,2,3,4\n", "two columns for heading"),
        ("time,x,y,heading,x\n0,1,2,3,4\n", "two columns for x"),
        (
            "time,x,y,heading,sigma_x\n0,1,2,3,4\n",
            "must have the columns sigma_x, sigma_y, sigma_h",
        ),
        ("time,x,y,bearing_deg\n0,1,2,3\n", "bearing from true north needs lat_deg and lon_deg"),
        (f"{HEADER}\n", "no record that can be used"),
        (f"{HEADER}\n0,1,nan,0\n", r"no record that can be used \(1 skipped"),
        (f"{HEADER}\n0,1,2,3\n1,x,2,3\n", "line 3: column x: 'x' is not a number; correct it"),
        (f"{HEADER}\n0,1,2,3\n1,2,3\n", "line 3: has 3 values, but the header has 4 columns"),
        (f"{HEADER}\n0,1,2,3\n\n0,1,2,3\n", "line 4: the time must be later .*; sort"),
        (f"{HEADER}\n1,1,2,3\n,,,\n0,1,2,3\n", "line 4: the time must be later"),
        (f"{HEADER}\n1.6e18,1,2,3\n", r"line 2: a value is beyond 1e\+10"),
        (f"{HEADER},sigma_x,sigma_y,sigma_heading\n0,1,2,3,-1,1,1\n", "line 2: the sigmas must be"),
        (
            f"{HEADER},cov_xx,cov_xy,cov_yy,cov_xh,cov_yh,cov_hh\n0,1,2,3,1,0,1,0,0,1\n"
            "1,1,2,3,1,2,1,0,0,1\n",
            "line 3: .*the covariance positive semidefinite",
        ),
    ],
)
def test_bad_files(tmp_path: Path, text: str, message: str) -> None:
    """The message has the file, the line and the cure."""
    path = written(tmp_path / "drive.csv", text)
    with pytest.raises(DriveFileError, match=message) as caught:
        RecordedDrive.from_csv(path)
    assert str(caught.value).startswith(str(path))


def test_files_that_are_no_text(tmp_path: Path) -> None:
    (tmp_path / "drive.csv").write_bytes(b"\x00\xff\xfe\x80")
    for name in ("drive.csv", "none.csv", "."):
        with pytest.raises(DriveFileError, match=r"is not a CSV file|cannot be read"):
            RecordedDrive.from_csv(tmp_path / name)


@given(st.binary(max_size=200))
def test_any_bytes_are_read_or_refused(tmp_path_factory: Any, data: bytes) -> None:
    """Nothing else than DriveFileError comes from a file."""
    path = tmp_path_factory.mktemp("drive") / "drive.csv"
    path.write_bytes(b"time,x,y,heading\n" + data)
    with contextlib.suppress(DriveFileError):
        assert len(RecordedDrive.from_csv(path).t) > 0


def test_signals_of_different_times() -> None:
    """Others are interpolated at the times of the position; the heading without its step."""
    t, late = np.arange(0, 10, 0.1), np.arange(0.03, 9.5, 0.02)
    signals = {
        "x": (t, circle(t)[:, 0]),
        "y": (t + 0.001, circle(t + 0.001)[:, 1]),
        "heading_deg": (late, np.degrees(circle(late, speed=30.0)[:, 2])),
        "speed_kmh": (late, 36 + 0 * late),
    }
    drive = RecordedDrive.from_signals(signals)
    np.testing.assert_allclose(drive.t, t[(t >= 0.03) & (t <= late[-1])])
    assert drive.skipped == len(t) - len(drive.t)
    np.testing.assert_allclose(drive.pose[:, 1], circle(drive.t)[:, 1], atol=0.02)
    np.testing.assert_allclose(drive.pose[:, 2], 0.6 * drive.t, atol=1e-9)
    assert drive.speed == pytest.approx(10.0)


def test_signals_with_gaps_and_bad_values() -> None:
    """A gap of one signal is not bridged; repeated, earlier and non-finite values are skipped."""
    t = np.array([0.0, 1.0, 1.0, 0.5, 0.8, 2.0, 3.0, 4.0, 5.0, 6.0])
    x = np.array([0.0, 1.0, 7.0, 7.0, 7.0, 2.0, np.nan, 4.0, 5.0, 6.0])
    heading = ([0.0, 1.0, 2.0, 6.0], [0.0, 0.0, 0.0, 0.0])
    drive = RecordedDrive.from_signals({"x": (t, x), "y": (t, 0 * t), "heading": heading})
    np.testing.assert_array_equal(drive.pose[:, 0], [0, 1, 2, 6])
    assert drive.skipped == 6


@pytest.mark.parametrize(
    ("signals", "text"),
    [
        ({"x": ([0], [0]), "y": ([0], [0])}, "heading or heading_deg"),
        ({"x": ([0], [np.nan]), "y": ([0], [0]), "heading": ([0], [0])}, "x has no value"),
        ({"x": ([], []), "y": ([0], [0]), "heading": ([0], [0])}, "x has no value"),
        ({"x": ([0], [0]), "y": ([9], [0]), "heading": ([0], [0])}, "no record that can be used"),
    ],
)
def test_bad_signals(signals: Any, text: str) -> None:
    with pytest.raises(DriveFileError, match=text):
        RecordedDrive.from_signals(signals)


def test_a_drive_of_one_record_or_without_covariances() -> None:
    """It is known at its time; what is not recorded cannot be reported."""
    drive = recorded([3.0], [[1, 2, 0.5]], cov=[np.diag([1, 2, 3])])
    np.testing.assert_array_equal(drive.times(10.0), [3.0])
    np.testing.assert_array_equal(drive.at(3.0).pose, [1, 2, 0.5])
    assert drive.reported(3.0).cov.diagonal().tolist() == [1, 2, 3]
    with pytest.raises(ValueError, match="no covariances"):
        recorded([0, 1], [[0, 0, 0], [4, 0, 0]]).reported(0.0)
