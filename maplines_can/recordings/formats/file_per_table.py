"""Parquet, CSV and JSON Lines: a file for each table."""

from __future__ import annotations

from pathlib import Path
from typing import IO, Any

from ...values.errors import missing_extra
from ..line_tables import LineTable
from ..row_texts import csv_cell, csv_rows, json_rows
from .table_writer import About, FilesWriter, PathOf


class CsvWriter(FilesWriter):
    """Writer of CSV. A number is the shortest decimal that reads back; nan is an empty cell.

    Args:
        path_of: paths of the files.
        _about: source of the tables, which CSV has no place for.
    """

    def __init__(self, path_of: PathOf, _about: About) -> None:
        super().__init__(path_of)
        self._open: dict[str, IO[str]] = {}

    def write(self, table: LineTable) -> None:
        """Write the rows of a block."""
        for name, part in table.parts.items():
            is_new = name not in self._open
            if is_new:
                self._open[name] = self._files.temporary(name).open("w", newline="")
            if is_new:
                self._open[name].write(",".join(map(csv_cell, part.columns)) + "\n")
            self._open[name].write(csv_rows(part))

    def close(self) -> list[Path]:
        """Complete the files and return their paths."""
        self._release()
        return self._files.close()

    def _release(self) -> None:
        for file in self._open.values():
            file.close()


class JsonLinesWriter(CsvWriter):
    """Writer of JSON Lines, an object a row; nan is null.

    Args:
        path_of: paths of the files.
        _about: source of the tables, which the rows do not repeat.
    """

    def write(self, table: LineTable) -> None:
        """Write the rows of a block."""
        for name, part in table.parts.items():
            if name not in self._open:
                self._open[name] = self._files.temporary(name).open("w")
            self._open[name].write(json_rows(part))


class ParquetWriter(FilesWriter):
    """Writer of Parquet, a row group a block of frames.

    A field has the metadata ``unit``, and the schema has those of ``About`` with the prefix
    ``maplines.``.

    Args:
        path_of: paths of the files.
        about: source of the tables.

    Raises:
        MissingExtraError: pyarrow is not installed.
    """

    def __init__(self, path_of: PathOf, about: About) -> None:
        try:
            import pyarrow.parquet as pq
        except ImportError as error:
            raise missing_extra("a Parquet file needs pyarrow", "tables") from error
        super().__init__(path_of)
        self._pq, self._about = pq, about
        self._writers: dict[str, Any] = {}

    def write(self, table: LineTable) -> None:
        """Write the rows of a block."""
        for name, part in table.parts.items():
            rows = part.to_arrow()
            if name not in self._writers:
                about = {f"maplines.{key}": text for key, text in self._about.texts.items()}
                schema = rows.schema.with_metadata(about)
                path = self._files.temporary(name)
                self._writers[name] = self._pq.ParquetWriter(path, schema, compression="zstd")
            if len(part):
                self._writers[name].write_table(rows.replace_schema_metadata(None))

    def close(self) -> list[Path]:
        """Complete the files and return their paths."""
        self._release()
        return self._files.close()

    def _release(self) -> None:
        for writer in self._writers.values():
            writer.close()
