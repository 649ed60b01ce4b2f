"""Names of the tables of the truth beside the log of a drive."""

from __future__ import annotations

from pathlib import Path

from ..values.errors import DriveFileError


def truth_paths(log: str) -> tuple[Path, Path]:
    """Return where the truth beside a log is as Parquet, or else, without pyarrow, as CSV.

    >>> [path.name for path in truth_paths("drive.log.gz")]
    ['drive.truth.parquet', 'drive.truth.csv']
    """
    path = Path(log)
    if path.suffix.lower() == ".gz":
        path = path.with_suffix("")
    return path.with_suffix(".truth.parquet"), path.with_suffix(".truth.csv")


def truth_of(log: str) -> Path:
    """Return the truth beside a log; the newer one if there are two.

    Raises:
        DriveFileError: there is none.
    """
    paths = truth_paths(log)
    found = [path for path in paths if path.is_file()]
    if not found:
        names = " nor ".join(str(path) for path in paths)
        raise DriveFileError(
            f"{log}: there is no truth beside it, neither {names}; give it as "
            "'maplines accuracy TRUTH LOG'"
        )
    return max(found, key=lambda path: path.stat().st_mtime_ns)
