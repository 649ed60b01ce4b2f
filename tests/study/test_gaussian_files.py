"""Files of a user: Gaussians in every form, in chunks, and checked; maps."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_drive import record
from study_helpers import table_of, write_csv

from maplines_can.cli import main
from maplines_can.recordings.read_lines import read_lines
from maplines_can.study import road
from maplines_can.study.files import GaussianFile, read_map
from maplines_can.study.sets import line_set
from maplines_can.values.errors import MaplinesError, StudyError
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


def broken(what: Any) -> Any:
    """Return Gaussians with one error, in row 3."""
    means, covs = (array.copy() for array in road(5, seed=8))
    if what == "nan":
        means[3, 1] = np.nan
    elif what == "negative":
        covs[3, 0, 0] = -1
    elif what == "asymmetric":
        covs[3, 0, 1] *= 2
    elif what == "indefinite":
        covs[3, 0, 1] = covs[3, 1, 0] = 2 * np.sqrt(covs[3, 0, 0] * covs[3, 1, 1])
    return means, covs


@pytest.mark.parametrize(
    ("what", "message"),
    [
        ("nan", "row 3 .from 0. has a number that is not finite"),
        ("negative", "row 3 .* negative variance"),
        ("asymmetric", "row 3 .* not symmetric"),
        ("indefinite", "row 3 .* not positive semidefinite"),
    ],
)
def test_a_row_that_is_not_a_gaussian_is_refused(what: str, message: str, tmp_path: Path) -> None:
    """The message names the row and the error, before the study begins."""
    means, covs = broken(what)
    np.savez(tmp_path / "bad.npz", mean=means, cov=covs)

    with pytest.raises(StudyError, match=message):
        line_set(str(tmp_path / "bad.npz"))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.txt", b"", "a file is one of .npz, .csv, .parquet"),
        ("a.npz", b"no archive", "cannot be read"),
        ("a.csv", b"mean_0,mean_1\n1,2\n", "there is no mean_2"),
        ("a.csv", b"", "there is no mean_0"),
        ("a.csv", b"\xff\xfe", "cannot be read"),
        ("a.parquet", b"no table", "cannot be read"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused(
    name: str, content: bytes, message: str, tmp_path: Path
) -> None:
    """The message says what is wrong with the file."""
    if name.endswith("parquet"):
        pytest.importorskip("pyarrow")
    (tmp_path / name).write_bytes(content)

    with pytest.raises(MaplinesError, match=message):
        line_set(str(tmp_path / name))


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        (["1," * 13 + "x"], "row 0"),
        (["1," * 12 + "1"], "names 14 columns, but row 0 has 13"),
        ([], "has no rows"),
    ],
)
def test_a_csv_with_bad_rows_is_refused(rows: Any, message: str, tmp_path: Path) -> None:
    """A word, a missing number, no rows at all."""
    columns = list(table_of(*road(1, seed=0)))
    (tmp_path / "a.csv").write_text("\n".join([",".join(columns), *rows]))

    with pytest.raises(StudyError, match=message):
        GaussianFile.opened(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"mean": np.zeros((3, 4))}, "there is no cov"),
        ({"mean": np.zeros((3, 5)), "cov": np.zeros((3, 5, 5))}, "shape"),
        ({"mean": np.zeros((3, 4)), "cov": np.zeros((2, 4, 4))}, "shape"),
        ({"mean": np.array([["a"] * 4]), "cov": np.zeros((1, 4, 4))}, "numbers"),
    ],
)
def test_arrays_of_other_shapes_are_refused(arrays: Any, message: str, tmp_path: Path) -> None:
    """The message lists the accepted shapes."""
    np.savez(tmp_path / "a.npz", **arrays)

    with pytest.raises(StudyError, match=message):
        GaussianFile.opened(tmp_path / "a.npz")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y\n1,2", "there is no line"),
        ("line,x,y\n", "no usable lane or line"),
        ("line,x,y\na,1,2\na,b,2", "line 3"),
        ("line,x,y\na,1,2\na,1", "line 3"),
        ("line,x,y\na,1,2\nb,1,2", "line 'a'"),
        ("line,x,y\na,1,2\na,1,3\nb,1,2\nb,3,2\na,4,4", "two places"),
        ("line,x,y\na,1,2\na,inf,3", "line 'a'"),
    ],
)
def test_a_map_that_cannot_be_used_is_refused(text: str, message: str, tmp_path: Path) -> None:
    """The message has the line of the file or the name of the line on the map."""
    (tmp_path / "map.csv").write_text(text)

    with pytest.raises(StudyError, match=message):
        read_map(tmp_path / "map.csv")


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
