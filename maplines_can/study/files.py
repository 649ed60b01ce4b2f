"""A user's own Gaussians, poses and map: read piece by piece, and checked before a study begins.

Gaussians of lines (y_off [m], beta [rad], c0 [1/m], c1 [1/m^2]) and of poses (e_x [m], e_y [m],
e_h [rad]) come in one form, with 4 numbers or with 3:

- ``.npz``: arrays ``mean`` (N, d) and ``cov`` (N, d, d), or (N, d (d + 1) / 2) with the upper
  triangles row by row;
- ``.csv`` and ``.parquet``: columns ``mean_0`` .. and ``cov_00``, ``cov_01`` .., the upper triangle
  at least. A CSV names its columns in the first line.

The lines of a map are a CSV with the columns ``line``, ``x`` and ``y`` [m]: points in their order,
those of a line next to each other.
"""

from __future__ import annotations

import hashlib
import zipfile
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import MissingExtraError, StudyError
from ..gaussian import asymmetric, indefinite, nearest_covariance
from ..polyline import Polyline

__all__ = ["GaussianFile", "arrow", "read_map"]

Array = NDArray[np.float64]

#: Rows read at a time where a file is checked.
BLOCK = 50_000
SUFFIXES = (".npz", ".csv", ".parquet")
#: Rounding to expect of what a user's own program wrote, relative.
ROUNDING = 1e-6


def arrow() -> Any:
    """The package ``pyarrow``, with ``pyarrow.parquet``.

    Raises:
        MissingExtraError: it is not installed.
    """
    try:
        import pyarrow.parquet
    except ImportError as error:
        raise MissingExtraError(
            "Parquet files need pyarrow; pip install 'maplines_can[study]'"
        ) from error
    return pyarrow


@dataclass(frozen=True)
class GaussianFile:
    """A file of Gaussians, checked; see the head of this module for the forms.

    Args:
        path: .npz, .csv or .parquet.
        dimension: 4 of lines, 3 of poses.
        rows: how many.
        sha256: of the bytes.
    """

    path: Path
    dimension: Literal[3, 4]
    rows: int
    sha256: str

    @classmethod
    def opened(cls, path: Path) -> GaussianFile:
        """Read the file once, to check it.

        Raises:
            StudyError: a column is missing, or a row is no Gaussian; which one is told.
        """
        if path.suffix.lower() not in SUFFIXES:
            raise StudyError(f"{path}: a file is one of {', '.join(SUFFIXES)}")
        rows, dimension = 0, 0
        for mean, cov in _blocks(path, BLOCK):
            dimension = mean.shape[1]
            _check(path, rows, mean, cov)
            rows += len(mean)
        if not rows:
            raise StudyError(f"{path}: has no rows")
        return cls(path, 4 if dimension == 4 else 3, rows, _sha256(path))

    def blocks(self, size: int) -> Iterator[tuple[Array, Array]]:
        """(n, d) means and (n, d, d) covariances, up to so many rows at a time.

        What rounding in the file made of singular matrices is made good.
        """
        for mean, cov in _blocks(self.path, size):
            cov = (cov + cov.transpose(0, 2, 1)) / 2
            broken = indefinite(cov)
            cov[broken] = nearest_covariance(cov[broken])
            yield mean, cov


def read_map(path: Path) -> tuple[tuple[Polyline, ...], str]:
    """The lines of a map and the file's SHA-256.

    Raises:
        StudyError: the file is no such map.
    """
    names: list[str] = []
    points: list[list[tuple[float, float]]] = []
    try:
        with path.open(encoding="utf-8") as file:
            columns = [name.strip() for name in file.readline().split(",")]
            missing = {"line", "x", "y"} - set(columns)
            if missing:
                raise StudyError(
                    f"{path}: a map has the columns line, x and y; "
                    f"there is no {', '.join(sorted(missing))}"
                )
            places = [columns.index(name) for name in ("line", "x", "y")]
            for number, text in enumerate(file, 2):
                if not text.strip():
                    continue
                values = text.split(",")
                try:
                    name, x, y = (values[place].strip() for place in places)
                    point = float(x), float(y)
                except (ValueError, IndexError):
                    raise StudyError(
                        f"{path}: line {number}: {text.strip()!r} is no point of a map"
                    ) from None
                if not names or name != names[-1]:
                    if name in names:
                        raise StudyError(
                            f"{path}: line {number}: {name!r} has points at two places; put "
                            "the points of a line next to each other"
                        )
                    names.append(name)
                    points.append([])
                points[-1].append(point)
    except (OSError, UnicodeDecodeError) as error:
        raise StudyError(f"{path}: cannot be read: {error}") from error
    if not names:
        raise StudyError(f"{path}: has no points")
    lines = []
    for name, of_line in zip(names, points, strict=True):
        try:
            lines.append(Polyline(np.array(of_line)))
        except ValueError as error:
            raise StudyError(f"{path}: line {name!r}: {error}") from None
    return tuple(lines), _sha256(path)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _check(path: Path, first: int, mean: Array, cov: Array) -> None:
    """Refuse what is no Gaussian.

    Args:
        path: of the file.
        first: number of the first row.
        mean: (n, d).
        cov: (n, d, d).
    """
    variances = np.einsum("nii->ni", cov)

    def refuse(bad: NDArray[np.bool_], what: str) -> None:
        if bad.any():
            i = int(bad.argmax())
            raise StudyError(
                f"{path}: row {first + i} (from 0) {what}: mean {mean[i].tolist()}, "
                f"covariance {cov[i].tolist()}"
            )

    finite = np.isfinite(mean).all(axis=1) & np.isfinite(cov).all(axis=(1, 2))
    refuse(np.asarray(~finite), "has a number that is not finite")
    refuse(np.asarray((variances < 0).any(axis=1)), "has a negative variance")
    refuse(asymmetric(cov, ROUNDING), "has a covariance that is not symmetric")
    refuse(indefinite(cov, ROUNDING), "has a covariance that is not positive semidefinite")


def _blocks(path: Path, size: int) -> Iterator[tuple[Array, Array]]:
    readers = {".npz": _npz_blocks, ".csv": _csv_blocks, ".parquet": _parquet_blocks}
    try:
        yield from readers[path.suffix.lower()](path, size)
    except (OSError, EOFError, UnicodeDecodeError, zipfile.BadZipFile) as error:
        raise StudyError(f"{path}: cannot be read: {error}") from error


def _npz_blocks(path: Path, size: int) -> Iterator[tuple[Array, Array]]:
    """Rows of the two arrays, without ever holding all of them."""
    with ExitStack() as stack:
        archive = stack.enter_context(zipfile.ZipFile(path))
        missing = {"mean.npy", "cov.npy"} - set(archive.namelist())
        if missing:
            raise StudyError(
                f"{path}: needs the arrays mean and cov; there is no "
                f"{', '.join(sorted(name.removesuffix('.npy') for name in missing))}"
            )
        mean_rows, cov_rows = (
            _NpyRows(path, stack.enter_context(archive.open(f"{name}.npy")))
            for name in ("mean", "cov")
        )
        n, d = mean_rows.shape if len(mean_rows.shape) == 2 else (0, 0)
        if d not in (3, 4) or cov_rows.shape not in ((n, d, d), (n, d * (d + 1) // 2)):
            raise StudyError(
                f"{path}: mean must have shape (N, 4) of lines or (N, 3) of poses, and cov "
                f"(N, d, d) or the upper triangles (N, d (d + 1) / 2); got {mean_rows.shape} and "
                f"{cov_rows.shape}"
            )
        for start in range(0, n, size):
            count = min(size, n - start)
            mean, cov = mean_rows.take(count), cov_rows.take(count)
            yield mean, cov if cov.ndim == 3 else _full(cov, d)


class _NpyRows:
    """The rows of an array in a file, in their order.

    An array that is stored by columns is read as a whole.
    """

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        form = np.lib.format
        try:
            major, _ = form.read_magic(file)
            read_header = form.read_array_header_1_0 if major == 1 else form.read_array_header_2_0
            self.shape, by_columns, self._type = read_header(file)
        except ValueError as error:
            raise StudyError(f"{path}: is no archive of numpy arrays: {error}") from error
        if self._type.kind not in "fiu":
            raise StudyError(f"{path}: needs arrays of numbers, got {self._type}")
        self._file = file
        self._whole = self._read(self.shape[::-1]).T if by_columns else None
        self._next = 0

    def take(self, count: int) -> Array:
        """(count, ...) the next rows."""
        self._next += count
        if self._whole is not None:
            return self._whole[self._next - count : self._next]
        return self._read((count, *self.shape[1:]))

    def _read(self, shape: tuple[int, ...]) -> Array:
        size = int(np.prod(shape)) * self._type.itemsize
        data = self._file.read(size)
        if len(data) < size:
            raise EOFError("it ends in the middle of an array")
        return np.frombuffer(data, dtype=self._type).reshape(shape).astype(float)


def _csv_blocks(path: Path, size: int) -> Iterator[tuple[Array, Array]]:
    with path.open(encoding="utf-8-sig") as file:
        columns = [name.strip() for name in file.readline().split(",")]
        form = _Columns(path, columns)
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
            yield form.split(dict(zip(columns, table.T, strict=True)))
            first += len(rows)


def _parquet_blocks(path: Path, size: int) -> Iterator[tuple[Array, Array]]:
    pa = arrow()
    try:
        with pa.parquet.ParquetFile(path) as file:
            form = _Columns(path, list(file.schema_arrow.names))
            for batch in file.iter_batches(batch_size=size, columns=form.names):
                yield form.split(
                    {
                        name: batch.column(name).to_numpy(zero_copy_only=False).astype(float)
                        for name in form.names
                    }
                )
    except (pa.ArrowException, ValueError) as error:
        if isinstance(error, StudyError):
            raise
        raise StudyError(f"{path}: cannot be read: {error}") from error


class _Columns:
    """Which columns of a table hold means and covariances.

    Raises:
        StudyError: one is missing.
    """

    def __init__(self, path: Path, columns: list[str]) -> None:
        d = 4 if "mean_3" in columns else 3
        pairs = [(i, j) for i in range(d) for j in range(i, d)]
        self.means = [f"mean_{i}" for i in range(d)]
        self.upper = [f"cov_{i}{j}" for i, j in pairs]
        lower = [f"cov_{j}{i}" for i, j in pairs if i != j]
        missing = [name for name in (*self.means, *self.upper) if name not in columns]
        if missing:
            raise StudyError(
                f"{path}: a table has the columns mean_0 .. mean_{d - 1} and cov_00, cov_01 .. "
                f"cov_{d - 1}{d - 1}; there is no {', '.join(missing)}"
            )
        self.whole = all(name in columns for name in lower)
        every = [f"cov_{i}{j}" for i in range(d) for j in range(d)]
        self.names = [*self.means, *(every if self.whole else self.upper)]
        self._covs = every if self.whole else self.upper

    def split(self, table: dict[str, Array]) -> tuple[Array, Array]:
        """(n, d) means and (n, d, d) covariances of a table."""
        d = len(self.means)
        mean = np.stack([table[name] for name in self.means], axis=-1)
        cov = np.stack([table[name] for name in self._covs], axis=-1)
        return mean, cov.reshape(-1, d, d) if self.whole else _full(cov, d)


def _full(upper: Array, d: int) -> Array:
    """(n, d, d) matrices of their upper triangles, row by row."""
    cov = np.empty((len(upper), d, d))
    i, j = np.triu_indices(d)
    cov[:, i, j] = cov[:, j, i] = upper
    return cov
