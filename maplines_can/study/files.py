"""Gaussians, poses and maps in a user's own files, checked before a study begins.

Gaussians of lines (y_off [m], beta [rad], c0 [1/m], c1 [1/m^2]) and of poses (e_x [m], e_y [m],
e_h [rad]) have the same form, with d = 4 or d = 3 numbers:

- ``.npz``: arrays ``mean`` (N, d) and ``cov`` (N, d, d), or (N, d (d + 1) / 2) with the upper
  triangles row by row;
- ``.csv`` and ``.parquet``: columns ``mean_0`` .. and ``cov_00``, ``cov_01`` .., at least those of
  the upper triangle. The first line of a CSV names its columns;
- ``.parquet`` that ``maplines decode -o`` wrote, and the logs themselves (`LOG_SUFFIXES`, of the
  DBC of the package that fits them best): the lines that may be used and have a covariance. They
  are rounded already, to the steps of the code that they were sent with.

All are read in blocks.

The lines of a map are a file that ``maps.load`` reads, such as a CSV with the columns ``line``,
``x`` and ``y`` [m]: points in their order, those of a line next to each other.
"""

from __future__ import annotations

import hashlib
import math
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import BinaryIO, Literal, cast

import numpy as np
from numpy.typing import NDArray

from ..maps import load
from ..maps.formats.load import map_path
from ..recordings.data_set import LOG_SUFFIXES
from ..recordings.fitting import best_fit, fits
from ..recordings.line_tables import UPPER_TRIANGLE
from ..recordings.read_lines import line_tables
from ..simulation.parquet_files import parquet_batches
from ..values.errors import MapFileError, StudyError
from ..values.input_files import checked_path, lines_of
from ..values.linalg import asymmetric, indefinite, nearest_covariance
from ..values.line import PARAMETERS, Status
from ..values.polyline import Polyline

Array = NDArray[np.float64]

#: Columns of the covariance in the tables of ``maplines decode``, the upper triangle.
DECODED_COV = tuple(f"cov_{PARAMETERS[i]}_{PARAMETERS[j]}" for i, j in UPPER_TRIANGLE)
#: Rows read at a time when a file is checked.
BLOCK = 50_000
#: Most bytes of an array of an ``.npz`` that is stored by columns.
MAX_COLUMNS = 1 << 25
#: Characters after which a block of a CSV file ends.
MAX_TEXT = 1 << 24
#: Relative rounding to expect of the program that wrote a file.
ROUNDING = 1e-6


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
        checked_path(path, StudyError)
        if path.suffix.lower() not in _READERS:
            raise StudyError(f"{path}: a file is one of {', '.join(_READERS)}")
        rows = dimension = 0
        for mean, cov in _blocks(path, BLOCK):
            dimension = mean.shape[1]
            _check(path, rows, mean, cov)
            rows += len(mean)
        if not rows:
            raise StudyError(
                f"{path}: has no rows; of received lines, those count that may be used and have a "
                "covariance"
            )
        return cls(path, 4 if dimension == 4 else 3, rows, _sha256(path))

    def blocks(self, size: int) -> Iterator[tuple[Array, Array]]:
        """Yield (n, d) means and (n, d, d) covariances, ``size`` rows at a time.

        Covariances that rounding in the file has made slightly indefinite are repaired.
        """
        for mean, cov in _of_size(_blocks(self.path, size), size):
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
    path = map_path(path)
    try:
        road_map = load(checked_path(path, StudyError))
    except (OSError, MapFileError) as error:
        raise StudyError(f"{path}: cannot be read: {error}") from error
    if road_map.skipped and not road_map.lanes:
        raise StudyError(f"{path}: {road_map.skipped[0]}")
    sides = (line for lane in road_map.lanes.values() for line in (lane.left, lane.right))
    lines = {id(line): line for line in (*road_map.polylines.values(), *sides)}
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
    except (OSError, EOFError, UnicodeDecodeError, zipfile.BadZipFile, zlib.error) as error:
        raise StudyError(f"{path}: cannot be read: {error}") from error


def _of_size(blocks: Iterator[tuple[Array, Array]], size: int) -> Iterator[tuple[Array, Array]]:
    """Yield the rows of blocks in blocks of a size, of which the last one may be smaller."""
    means, covs, rows = [], [], 0
    for mean, cov in blocks:
        means.append(mean)
        covs.append(cov)
        rows += len(mean)
        if rows < size:
            continue
        mean, cov = np.concatenate(means), np.concatenate(covs)
        end = rows - rows % size
        for start in range(0, end, size):
            yield mean[start : start + size], cov[start : start + size]
        means, covs, rows = [mean[end:]], [cov[end:]], rows - end
    if rows:
        yield np.concatenate(means), np.concatenate(covs)


def _npz_blocks(path: Path, size: int) -> Iterator[tuple[Array, Array]]:
    with zipfile.ZipFile(path) as archive, ExitStack() as stack:
        arrays = {}
        for name in ("mean", "cov"):
            if f"{name}.npy" not in archive.namelist():
                raise StudyError(f"{path}: holds the arrays mean and cov; there is no {name}")
            member = archive.getinfo(f"{name}.npy")
            if member.compress_type not in {zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED}:
                raise StudyError(f"{path}: {name} is compressed in a way that numpy does not use")
            stream = cast(BinaryIO, stack.enter_context(archive.open(member)))
            arrays[name] = ArrayStream(stream, f"{path}: {name}")
        mean, cov = arrays["mean"], arrays["cov"]
        n, d = mean.shape if len(mean.shape) == 2 else (0, 0)
        if d not in (3, 4) or cov.shape not in ((n, d, d), (n, d * (d + 1) // 2)):
            raise StudyError(
                f"{path}: mean must have shape (N, 4) of lines or (N, 3) of poses, and cov "
                f"(N, d, d) or the upper triangles (N, d (d + 1) / 2); got {mean.shape} and "
                f"{cov.shape}"
            )
        for start in range(0, n, size):
            rows = min(size, n - start)
            yield mean.read(rows), _squares(cov.read(rows), d)


class ArrayStream:
    """An array of numbers in the format of numpy, from which rows are read one after the other.

    Args:
        stream: of a file ``.npy``.
        name: for messages.

    Raises:
        StudyError: it has another format or no numbers, or it is large and stored by columns.
    """

    def __init__(self, stream: BinaryIO, name: str) -> None:
        self._stream, self._name = stream, name
        try:
            if np.lib.format.read_magic(stream) != (1, 0):  # the others are for names of fields
                raise StudyError(f"{name}: needs an array of numbers")
            self.shape, is_columns, self._dtype = np.lib.format.read_array_header_1_0(stream)
        except ValueError as error:
            if isinstance(error, StudyError):
                raise
            raise StudyError(f"{name}: cannot be read: {error}") from error
        if self._dtype.kind not in "fiu":
            raise StudyError(f"{name}: needs an array of numbers, got {self._dtype}")
        if is_columns and len(self.shape) > 1:
            self._stream = BytesIO(self._by_rows())

    def _by_rows(self) -> bytes:
        """Return the data of an array that is stored column by column."""
        size = math.prod(self.shape) * self._dtype.itemsize
        if size > MAX_COLUMNS:
            raise StudyError(
                f"{self._name}: is stored by columns, which are read at once, with {size} bytes, "
                f"more than {MAX_COLUMNS}; save numpy.ascontiguousarray of it"
            )
        return np.frombuffer(self._data(size), self._dtype).reshape(self.shape[::-1]).T.tobytes()

    def read(self, rows: int) -> Array:
        """Return the next rows.

        Raises:
            StudyError: the file ends before.
        """
        shape = (rows, *self.shape[1:])
        data = self._data(math.prod(shape) * self._dtype.itemsize)
        return np.frombuffer(data, self._dtype).reshape(shape).astype(float)

    def _data(self, size: int) -> bytes:
        data = self._stream.read(size)
        if len(data) < size:
            raise StudyError(f"{self._name}: ends before its {self.shape[0]} rows")
        return data


def _csv_blocks(path: Path, size: int) -> Iterator[tuple[Array, Array]]:
    with path.open(encoding="utf-8-sig") as file:
        lines = lines_of(file, str(path), StudyError)
        columns = [name.strip() for name in next(lines, "").split(",")]
        d, names = _columns(path, columns)
        places = [columns.index(name) for name in names]
        first = 0
        while rows := _next_rows(lines, size):
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


def _next_rows(lines: Iterator[str], size: int) -> list[str]:
    """Return the next lines, at most ``size`` of them and about ``MAX_TEXT`` characters."""
    rows, length = [], 0
    for line in islice(lines, size):
        rows.append(line)
        length += len(line)
        if length > MAX_TEXT:
            break
    return rows


def _parquet_blocks(path: Path, size: int) -> Iterator[tuple[Array, Array]]:
    def choose(columns: list[str]) -> list[str]:
        names = _columns(path, columns)[1]
        return [*names, "status"] if names[0] == PARAMETERS[0] and "status" in columns else names

    for batch in parquet_batches(path, choose, size, StudyError):
        status = batch.pop("status", None)
        d = 3 if "mean_0" in batch and "mean_3" not in batch else 4
        values = np.stack([np.asarray(column, dtype=float) for column in batch.values()], axis=-1)
        if PARAMETERS[0] in batch:
            known = np.isfinite(values[:, 0])  # a line that must not be used has no values
            if status is not None:
                known &= np.array([one != Status.UNKNOWN.name for one in status], bool)
            values = values[known]
        if len(values):
            yield values[:, :d], _squares(values[:, d:], d)


def _log_blocks(path: Path, size: int) -> Iterator[tuple[Array, Array]]:
    codec = best_fit(fits(path), path).codec
    for table in line_tables(path, dbc=codec):
        mean = np.stack([table.columns[name] for name in PARAMETERS], axis=-1)
        upper = np.stack([table.columns[name] for name in DECODED_COV], axis=-1)
        known = np.isfinite(mean[:, 0]) & (table.columns["status"] != Status.UNKNOWN)
        mean, cov = mean[known], _squares(upper[known], 4)
        for start in range(0, len(mean), size):
            yield mean[start : start + size], cov[start : start + size]


_READERS = {".npz": _npz_blocks, ".csv": _csv_blocks, ".parquet": _parquet_blocks}
_READERS |= dict.fromkeys(LOG_SUFFIXES, _log_blocks)


def _columns(path: Path, columns: Sequence[str]) -> tuple[int, list[str]]:
    """Return d, and the columns of a table that hold means and covariances.

    Raises:
        StudyError: a column is missing.
    """
    decoded = [*PARAMETERS, *DECODED_COV]
    if set(decoded) <= set(columns):
        return 4, decoded
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
