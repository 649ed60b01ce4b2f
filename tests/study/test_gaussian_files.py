"""Files of a user: Gaussians in every form, in chunks, and checked; maps."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.recordings import record
from support.study_helpers import table_of, write_csv

from maplines_can import Codec, Gaussian, MapLine, Slot
from maplines_can.bus import LogWriter
from maplines_can.cli import main
from maplines_can.recordings.read_lines import read_lines
from maplines_can.study import road
from maplines_can.study.design.planner import Planner, Targets
from maplines_can.study.files import GaussianFile, read_map
from maplines_can.study.sets import line_set
from maplines_can.values.errors import MaplinesError
from maplines_can.values.line import PARAMETERS


def triangle(cov: Any) -> Any:
    """Return (N, 10) or (N, 6) upper triangles."""
    return cov[:, *np.triu_indices(cov.shape[1])]


def write_parquet(path: Any, mean: Any, cov: Any) -> None:
    pa = pytest.importorskip("pyarrow")
    parquet = pytest.importorskip("pyarrow.parquet")
    parquet.write_table(pa.table(table_of(mean, cov)), path)


WRITERS = {
    "full.npz": lambda path, mean, cov: np.savez(path, mean=mean, cov=cov),
    "packed.npz": lambda path, mean, cov: np.savez_compressed(path, mean=mean, cov=triangle(cov)),
    "columns.npz": lambda path, mean, cov: np.savez(
        path, mean=np.asfortranarray(mean), cov=np.asfortranarray(cov)
    ),
    "table.csv": write_csv,
    "table.parquet": write_parquet,
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_of_gaussians_comes_in_chunks(name: Any, tmp_path: Path) -> None:
    """Every form gives the same Gaussians, in chunks of the requested size."""
    means, covs = road(25, seed=8)
    WRITERS[name](tmp_path / name, means, covs)
    given_set = line_set(str(tmp_path / name))
    chunks = [chunk() for chunk in given_set.chunks(1, 10, 0)]

    assert given_set.name == name
    assert given_set.sizes(1, 10) == [10, 10, 5] == [len(chunk.mean) for chunk in chunks]
    assert np.array_equal(np.concatenate([chunk.mean for chunk in chunks]), means)
    assert np.array_equal(np.concatenate([chunk.cov for chunk in chunks]), covs)


def edited(change: Any) -> Any:
    means, covs = (array.copy() for array in road(5, seed=8))
    change(means, covs)
    return {"mean": means, "cov": covs}


def indefinite(_means: Any, covs: Any) -> None:
    covs[3, 0, 1] = covs[3, 1, 0] = 2 * np.sqrt(covs[3, 0, 0] * covs[3, 1, 1])


ARRAYS = [
    (edited(lambda m, _: m.__setitem__((3, 1), np.nan)), "row 3 .from 0. has a number that is not"),
    (edited(lambda _, c: c.__setitem__((3, 0, 0), -1)), "row 3 .* negative variance"),
    (edited(lambda _, c: c.__setitem__((3, 0, 1), 2 * c[3, 0, 1])), "row 3 .* not symmetric"),
    (edited(indefinite), "row 3 .* not positive semidefinite"),
    ({"mean": np.zeros((3, 4))}, "there is no cov"),
    ({"mean": np.zeros((3, 5)), "cov": np.zeros((3, 5, 5))}, "shape"),
    ({"mean": np.zeros((3, 4)), "cov": np.zeros((2, 4, 4))}, "shape"),
    ({"mean": np.array([["a"] * 4]), "cov": np.zeros((1, 4, 4))}, "numbers"),
]
COLUMNS = ",".join(table_of(*road(1, seed=0)))
FILES = [
    ("a.txt", "", "a file is one of .npz, .csv, .parquet"),
    ("a.npz", "no archive", "cannot be read"),
    ("a.csv", "mean_0,mean_1\n1,2\n", "there is no mean_2"),
    ("a.csv", "", "there is no mean_0"),
    ("a.csv", b"\xff\xfe", "cannot be read"),
    ("a.parquet", "no table", "cannot be read"),
    ("a.csv", f"{COLUMNS}\n{'1,' * 13}x", "row 0"),
    ("a.csv", f"{COLUMNS}\n{'1,' * 12}1", "names 14 columns, but row 0 has 13"),
    ("a.csv", COLUMNS, "has no rows"),
]
MAPS = [
    ("x,y\n1,2", "there is no line"),
    ("line,x,y\n", "no usable lane or line"),
    ("line,x,y\na,1,2\na,b,2", "line 3"),
    ("line,x,y\na,1,2\na,1", "line 3"),
    ("line,x,y\na,1,2\nb,1,2", "line 'a'"),
    ("line,x,y\na,1,2\na,1,3\nb,1,2\nb,3,2\na,4,4", "two places"),
    ("line,x,y\na,1,2\na,inf,3", "line 'a'"),
]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [*(("a.npz", *row) for row in ARRAYS), *FILES, *(("map.csv", *row) for row in MAPS)],
)
def test_what_cannot_be_used_is_refused(
    name: str, content: Any, message: str, tmp_path: Path
) -> None:
    """The message names the row, the column or the line, before the study begins."""
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    if isinstance(content, dict):
        np.savez(tmp_path / name, **content)
    else:
        (tmp_path / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    read = read_map if name == "map.csv" else GaussianFile.opened
    with pytest.raises(MaplinesError, match=message):
        read(tmp_path / name)


def test_a_log_is_a_set(tmp_path: Path) -> None:
    """Its lines, and those of its table, in chunks of any size."""
    log = record(tmp_path / "drive.log", seconds=4.0)
    table = read_lines(log)
    assert main(["decode", str(log), "-o", str(tmp_path / "drive.parquet")]) == 0
    for path in (log, tmp_path / "drive.parquet"):
        own = line_set(str(path))
        assert own.sizes(0, 50) == [50] * (len(table) // 50) + [len(table) % 50]
        chunks = [chunk() for chunk in own.chunks(0, 50, 0)]
        assert [len(chunk.mean) for chunk in chunks] == own.sizes(0, 50)
        mean = np.concatenate([chunk.mean for chunk in chunks])
        cov = np.concatenate([chunk.cov for chunk in chunks])
        for i, name in enumerate(PARAMETERS):
            assert np.array_equal(mean[:, i], table[name])
            assert np.array_equal(cov[:, 0, i], table[f"cov_y_off_{name}"])


def bare_log(path: Path, count: int) -> Path:
    """Write a log of a route without a covariance, a line that has one, and one that is too old."""
    encoder, cov = Codec.from_dbc().encoder(), np.diag([0.04, 1e-4, 1e-8, 1e-12])
    lines = [
        MapLine.mean_only(Slot.ROUTE, [0.2, 0, 0, 0], x_max=80.0, age=0.02),
        MapLine(Slot.EGO_LEFT, Gaussian([1.75, 0, 0, 0], cov), x_max=80.0, age=0.02),
        MapLine(Slot.EGO_RIGHT, Gaussian([-1.75, 0, 0, 0], cov), x_max=80.0, age=float("inf")),
    ][:count]
    with LogWriter(path, start=100.0) as log:
        for k in range(20):
            for frames in encoder.encode_lines(lines):
                for frame in frames:
                    log.write(frame, 100 + 0.05 * k)
    return path


def test_received_lines_without_a_covariance_are_left_out(tmp_path: Path) -> None:
    """The wide one that a receiver takes instead says nothing of the bits that are needed."""
    log = bare_log(tmp_path / "some.log", 3)
    assert main(["decode", str(log), "-o", str(tmp_path / "some.parquet")]) == 0
    for path in (log, tmp_path / "some.parquet"):
        (chunk,) = (chunk() for chunk in line_set(str(path)).chunks(0, 50, 0))
        assert chunk.mean[:, 0].tolist() == [1.75] * 20
        assert chunk.cov[:, 0, 0].max() < 0.05


def test_a_table_without_a_line_that_counts_is_refused(tmp_path: Path, capsys: Any) -> None:
    """With status 1, by each command."""
    log = bare_log(tmp_path / "none.log", 1)
    assert main(["decode", str(log), "-o", str(tmp_path / "none.parquet")]) == 0
    words = ["--out", str(tmp_path / "x.dbc"), "--frames", "4"]
    for path in (log, tmp_path / "none.parquet"):
        capsys.readouterr()
        assert main(["design", "--set", str(path), *words]) == 1
        assert main(["study", "run", "--set", str(path), "--out", str(tmp_path / "study")]) == 1
        text = f"maplines: error: {path}: has no rows; of received lines, those count that may be "
        assert capsys.readouterr().err.count(text) == 2


def test_ends_of_the_dbc_are_within_the_ranges_of_a_design(tmp_path: Path) -> None:
    """A curvature rate that was sent at its end is decoded with the decimals of a DBC."""
    codec = Codec.from_dbc()
    mean = np.tile([1.75, 0.0, 0.0, -0.04], (300, 1))  # beyond the end: saturated
    mean[:, 0] += np.linspace(-1, 1, 300)
    cov = np.tile(np.diag([0.04, 1e-3, 1e-5, 1e-3]), (300, 1, 1))
    encoder, slot = codec.encoder(), Slot.EGO_LEFT
    with LogWriter(tmp_path / "ends.log", start=100.0) as log:
        for k, payload in enumerate(codec.batch.encode(mean, cov, slot=slot)):
            for frame in encoder.frames(payload, slot):
                log.write(frame, 100 + 0.05 * k)
    assert read_lines(tmp_path / "ends.log")["status"].tolist() == ["SATURATED"] * 300
    ends = -read_lines(tmp_path / "ends.log")["c1"]
    assert ends.max() > 0.03125  # by a few units in the last place
    (chunk,) = (chunk() for chunk in line_set(str(tmp_path / "ends.log")).chunks(0, 300, 0))
    assert Planner({"ends": chunk}, Targets(frames=4)).least_bits > 0
    with pytest.raises(ValueError, match=r"c1 of 1e\+02 % of the lines is beyond 0\.03"):
        Planner({"ends": chunk}, Targets(frames=4, ranges={"c1": 0.03}))
