"""The run of a study: it resumes, refuses other studies, and takes files and poses."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.study_helpers import small, tables, write_csv

from maplines_can.study import road
from maplines_can.study.sets import DrawnSet, MapView, line_set
from maplines_can.study.sweep.run import run_study
from maplines_can.study.sweep.summary import summary_text
from maplines_can.values.errors import StudyError


def test_a_finished_study_is_not_run_again(undisturbed: Any, tmp_path: Path) -> None:
    """Only its tables are written again, the same to the last byte."""
    out = tmp_path / "out"
    run_study(small(), out, jobs=1)
    before = {path.name: path.read_bytes() for path in out.glob("*.parquet")}
    seen = []
    run_study(small(), out, jobs=1, progress=lambda *progress: seen.append(progress))

    assert seen == [(400, 400)]
    assert before == {path.name: path.read_bytes() for path in out.glob("*.parquet")}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"n": 0}, "n must be 1 or more"),
        ({"codes": ("Morse",)}, "there is no code 'Morse'"),
        ({"codes": ("Cholesky", "Cholesky")}, "different"),
        ({"finer_bits": (-9,)}, "Cholesky with -9 bits"),
        ({"codes": ("Float32",), "finer_bits": (1,)}, "add 0"),
        ({"sets": [DrawnSet("road"), DrawnSet("road")]}, "different names"),
        ({"sets": []}, "one or more"),
    ],
)
def test_an_invalid_study_is_refused(changes: Any, message: str) -> None:
    """The constructor raises."""
    with pytest.raises(StudyError, match=message):
        small(**changes)


def test_another_study_in_the_same_directory_is_refused(tmp_path: Path) -> None:
    """The message says what differs."""
    pytest.importorskip("pyarrow")
    out = tmp_path / "out"
    run_study(small(n=50), out, jobs=1)
    for changes, message in (
        ({"n": 50, "seed": 4}, "there seed is 3, and now 4"),
        ({"n": 51}, "there n is 50"),
        ({"n": 50, "codes": ("Cholesky",)}, "there codes is"),
        ({"n": 50, "sets": [DrawnSet("paper")]}, "there sets is"),
    ):
        with pytest.raises(StudyError, match=message):
            run_study(small(**changes), out, jobs=1)
    path = out / "chunks" / "0-000000.json.gz"
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(StudyError, match=r"0-000000.json.gz: cannot be read .* delete it"):
        run_study(small(n=50), out, jobs=1)


def test_a_directory_of_other_files_is_refused(tmp_path: Path) -> None:
    """A study does not write among files that are not its own."""
    pytest.importorskip("pyarrow")
    (tmp_path / "thesis.tex").touch()

    with pytest.raises(StudyError, match="holds other things"):
        run_study(small(), tmp_path, jobs=1)


def test_poses_that_see_nothing_make_an_empty_study(drive: Any) -> None:
    """It has tables and text, without figures."""
    pytest.importorskip("pyarrow")
    write_csv(drive / "lost.csv", np.array([[-900.0, 0, 0]]), np.eye(3)[None] / 100)
    given_set = line_set(str(drive / "lost.csv"), MapView(drive / "map.csv"))
    study = small(sets=[given_set], codes=("Cholesky",), fields_n=1, limit_n=1)
    result = tables(run_study(study, drive / "out", jobs=1))

    assert result["summary"][0]["n"] == 0
    assert result["summary"][0]["kl_mean"] is None
    assert "lost.csv: 0 Gaussians" in summary_text(result["summary"], result["terms"])


def test_a_file_and_poses_in_one_study(drive: Any) -> None:
    """They are taken whole, whatever n is."""
    pytest.importorskip("pyarrow")
    means, covs = road(25, seed=8)
    np.savez(drive / "mine.npz", mean=means, cov=covs)
    sets = [
        line_set(str(drive / "mine.npz")),
        line_set(str(drive / "drive.csv"), MapView(drive / "map.csv")),
    ]
    study = small(sets=sets, codes=("Cholesky",), n=1, chunk_size=10)
    summary = tables(run_study(study, drive / "out", jobs=2))["summary"]

    assert [(row["set"], row["n"]) for row in summary] == [("mine.npz", 25), ("drive.csv", 6)]
    np.savez(drive / "mine.npz", mean=means[::-1], cov=covs[::-1])
    changed = small(
        sets=[line_set(str(drive / "mine.npz")), sets[1]], codes=("Cholesky",), n=1, chunk_size=10
    )
    with pytest.raises(StudyError, match="there sets is"):
        run_study(changed, drive / "out", jobs=1)
