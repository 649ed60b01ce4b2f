"""Gaussians, poses and maps in a user's own files, checked before a study begins.

Gaussians of lines (y_off [m], beta [rad], c0 [1/m], c1 [1/m^2]) and of poses (e_x [m], e_y [m],
e_h [rad]) have the same form, with d = 4 or d = 3 numbers:

- ``.npz``: arrays ``mean`` (N, d) and ``cov`` (N, d, d), or (N, d (d + 1) / 2) with the upper
  triangles row by row;
- ``.csv`` and ``.parquet``: columns ``mean_0`` .. and ``cov_00``, ``cov_01`` .., at least those of
  the upper triangle. The first line of a CSV names its columns.

Tables are read in blocks, the arrays of an ``.npz`` as a whole.

The lines of a map are a file that ``maps.load`` reads, such as a CSV with the columns ``line``,
``x`` and ``y`` [m]: points in their order, those of a line next to each other.
"""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import MapFileError, StudyError, missing_extra
from ..gaussian import asymmetric, indefinite, nearest_covariance
from ..maps import load
from ..polyline import Polyline

Array = NDArray[np.float64]

#: Rows read at a time when a file is checked.
BLOCK = 50_000
#: Relative rounding to expect of the program that wrote a file.
ROUNDING = 1e-6


def arrow() -> Any:
    """Return the package ``pyarrow``, with ``pyarrow.parquet``.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise missing_extra("Parquet files need pyarrow", "study") from error
    return pyarrow


@dataclass(frozen=True)
class GaussianFile:
    """A file of Gaussians that has been checked; see the head of this module for the forms."""

    path: Path
    dimension: Literal[3, 4]  #: 4 for lines, 3 for poses
    rows: int
    sha256: str

    @classmethod
    def opened(cls, path: Path) -> GaussianFile:
        """Read the file once and check it.

        Raises:
            StudyError: the file cannot be read, a column is missing, or a row is not a Gaussian.
        """
        if path.suffix.lower() not in _READERS:
            raise StudyError(f"{path}: a file is one of {', '.join(_READERS)}")
        rows = dimension = 0
        for mean, cov in _blocks(path, BLOCK):
            dimension = mean.shape[1]
            _check(path, rows, mean, cov)
            rows += len(mean)
        if not rows:
            raise StudyError(f"{path}: has no rows")
        return cls(path, 4 if dimension == 4 else 3, rows, _sha256(path))

    def blocks(self, size: int) -> Iterator[tuple[Array, Array]]:
        """Yield (n, d) means and (n, d, d) covariances, at most ``size`` rows at a time.

        Covariances that rounding in the file has made slightly indefinite are repaired.
        """
        for mean, cov in _blocks(self.path, size):
            cov = (cov + cov.transpose(0, 2, 1)) / 2
            broken = indefinite(cov)
            cov[broken] = nearest_covariance(cov[broken])
            yield mean, cov


def read_map(path: Path) -> tuple[tuple[Polyline, ...], str]:
    """Return the lines of a map and the SHA-256 of its file.

    They are the boundaries of the lanes, or the lines of a file without lanes.

    Raises:
        StudyError: the file is not a map, or a line of a file without lanes cannot be used.
    """
    try:
        found = load(path)
    except (OSError, MapFileError) as error:
        raise StudyError(f"{path}: cannot be read: {error}") from error
    if found.skipped and not found.lanes:
        raise StudyError(f"{path}: {found.skipped[0]}")
    sides = (line for lane in found.lanes.values() for line in (lane.left, lane.right))
    lines = {id(line): line for line in (*found.polylines.values(), *sides)}
    return tuple(lines.values()), _sha256(path)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _check(path: Path, first: int, mean: Array, cov: Array) -> None:
    """Raise ``StudyError`` for rows, numbered from ``first``, that are not Gaussians."""

    def refuse(bad: NDArray[np.bool_], what: str) -> None:
        if bad.any():
            i = int(bad.argmax())
            raise StudyError(
                f"{path}: row {first + i} (from 0) {what}: mean {mean[i].tolist()}, "
                f"covariance {cov[i].tolist()}"
            )

    finite = np.isfinite(mean).all(axis=1) & np.isfinite(cov).all(axis=(1, 2))
    refuse(np.asarray(~finite), "has a number that is not finite")
    refuse((np.einsum("nii->ni", cov) < 0).any(axis=1), "has a negative variance")
    refuse(asymmetric(cov, ROUNDING), "has a covariance that is not symmetric")
    refuse(indefinite(cov, ROUNDING), "has a covariance that is not positive semidefinite")


def _blocks(path: Path, size: int) -> Iterator[tuple[Array, Array]]:
    try:
        yield from _READERS[path.suffix.lower()](path, size)
    except (OSError, EOFError, UnicodeDecodeError, zipfile.BadZipFile) as error:
        raise StudyError(f"{path}: cannot be read: {error}") from error


def _npz_blocks(path: Path, size: int) -> Iterator[tuple[Array, Array]]:
    with zipfile.ZipFile(path), np.load(path) as archive:  # np.load takes other files too
        if missing := {"mean", "cov"} - set(archive.files):
            raise StudyError(
                f"{path}: holds the arrays mean and cov; there is no {', '.join(sorted(missing))}"
            )
        try:
            mean, cov = archive["mean"], archive["cov"]
        except ValueError as error:
            raise StudyError(f"{path}: cannot be read: {error}") from error
    for array in (mean, cov):
        if array.dtype.kind not in "fiu":
            raise StudyError(f"{path}: needs arrays of numbers, got {array.dtype}")
    n, d = mean.shape if mean.ndim == 2 else (0, 0)
    if d not in (3, 4) or cov.shape not in ((n, d, d), (n, d * (d + 1) // 2)):
        raise StudyError(
            f"{path}: mean must have shape (N, 4) of lines or (N, 3) of poses, and cov (N, d, d) "
            f"or the upper triangles (N, d (d + 1) / 2); got {mean.shape} and {cov.shape}"
        )
    for start in range(0, n, size):
        rows = slice(start, start + size)
        yield mean[rows].astype(float), _squares(cov[rows].astype(float), d)


def _csv_blocks(path: Path, size: int) -> Iterator[tuple[Array, Array]]:
    with path.open(encoding="utf-8-sig") as file:
        columns = [name.strip() for name in file.readline().split(",")]
        d, names = _columns(path, columns)
        places = [columns.index(name) for name in names]
        first = 0
        while rows := list(islice(file, size)):
            try:
                table = np.loadtxt(rows, delimiter=",", ndmin=2, comments=None)
            except ValueError as error:
                raise StudyError(
                    f"{path}: counted from row {first} (from 0): {str(error).split(';')[0]}"
                ) from None
            if table.shape[1] != len(columns):
                raise StudyError(
                    f"{path}: the first line names {len(columns)} columns, but row {first} has "
                    f"{table.shape[1]}"
                )
            values = table[:, places]
            yield values[:, :d], _squares(values[:, d:], d)
            first += len(rows)


def _parquet_blocks(path: Path, size: int) -> Iterator[tuple[Array, Array]]:
    pa = arrow()
    try:
        with pa.parquet.ParquetFile(path) as file:
            d, names = _columns(path, file.schema_arrow.names)
            for batch in file.iter_batches(batch_size=size, columns=names):
                columns = (batch.column(name).to_numpy(zero_copy_only=False) for name in names)
                values = np.stack([column.astype(float) for column in columns], axis=-1)
                yield values[:, :d], _squares(values[:, d:], d)
    except (pa.ArrowException, ValueError) as error:
        if isinstance(error, StudyError):
            raise
        raise StudyError(f"{path}: cannot be read: {error}") from error


_READERS = {".npz": _npz_blocks, ".csv": _csv_blocks, ".parquet": _parquet_blocks}


def _columns(path: Path, columns: Sequence[str]) -> tuple[int, list[str]]:
    """Return d, and the columns of a table that hold means and covariances.

    Raises:
        StudyError: a column is missing.
    """
    d = 4 if "mean_3" in columns else 3
    means = [f"mean_{i}" for i in range(d)]
    square = [f"cov_{i}{j}" for i in range(d) for j in range(d)]
    upper = [f"cov_{i}{j}" for i in range(d) for j in range(i, d)]
    if missing := [name for name in (*means, *upper) if name not in columns]:
        raise StudyError(
            f"{path}: a table has the columns mean_0 .. mean_{d - 1} and cov_00, cov_01 .. "
            f"cov_{d - 1}{d - 1}; there is no {', '.join(missing)}"
        )
    return d, [*means, *(square if set(square) <= set(columns) else upper)]


def _squares(cov: Array, d: int) -> Array:
    """Return (n, d, d) matrices, given them, their rows, or their upper triangles."""
    if cov.shape[1:] in ((d, d), (d * d,)):
        return cov.reshape(-1, d, d)
    full = np.empty((len(cov), d, d))
    i, j = np.triu_indices(d)
    full[:, i, j] = full[:, j, i] = cov
    return full
