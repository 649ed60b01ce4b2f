"""Parquet files that come from anywhere, in batches whose size is bounded."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from ..values.errors import missing_extra

#: Most bytes of a column in a row group, unpacked: 8 million numbers. Writers make groups of a
#: million rows or less.
MAX_CHUNK = 1 << 26


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


def parquet_batches(
    path: Path,
    choose: Callable[[list[str]], Sequence[str]],
    size: int,
    error: type[ValueError],
) -> Iterator[dict[str, Any]]:
    """Yield columns of a file by name: arrays of numbers, lists of texts.

    Args:
        path: of the file.
        choose: returns the names of the columns to read, from those of the file.
        size: most rows at a time.
        error: type of the error.

    Raises:
        error: the file cannot be read, or a column is neither of numbers nor of texts, or has too
            large a row group; and what ``choose`` raises.
        MissingExtraError: pyarrow is not installed.
    """
    pa = arrow()
    try:
        schema = pa.parquet.read_schema(path)
        names = [*choose(schema.names)]
        texts = [name for name in names if _is_text(pa, schema.field(name).type)]
        with pa.parquet.ParquetFile(path, read_dictionary=texts, pre_buffer=False) as file:
            _check(pa, file, names, path, error)
            for batch in file.iter_batches(size, columns=names, use_threads=False):
                yield {name: _values(pa, batch.column(name)) for name in names}
    except (OSError, pa.ArrowException, ValueError) as problem:
        if isinstance(problem, error):
            raise
        raise error(f"{path}: cannot be read: {problem}") from problem


def _is_text(pa: Any, kind: Any) -> bool:
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def _check(pa: Any, file: Any, names: Sequence[str], path: Path, error: type[ValueError]) -> None:
    for name in names:
        kind = file.schema_arrow.field(name).type
        if pa.types.is_nested(kind) or pa.types.is_binary(kind) or pa.types.is_large_binary(kind):
            raise error(f"{path}: column {name} must have numbers or texts, not {kind}")
    for index in range(file.metadata.num_row_groups):
        group = file.metadata.row_group(index)
        for column in map(group.column, range(group.num_columns)):
            name, size = column.path_in_schema, column.total_uncompressed_size
            if name in names and size > MAX_CHUNK:
                raise error(
                    f"{path}: column {name} has {size} bytes in a row group, more than "
                    f"{MAX_CHUNK}; write the file with row groups of a million rows or less"
                )


def _values(pa: Any, column: Any) -> Any:
    if not pa.types.is_dictionary(column.type):
        return column.to_numpy(zero_copy_only=False)
    texts = column.dictionary.to_pylist()  # each text once, however often it occurs
    return [None if code is None else texts[code] for code in column.indices.to_pylist()]
