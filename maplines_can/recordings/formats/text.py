"""CSV and JSON Lines: a file for each table."""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from ..table import LineTable, Table
from .writer import About, FilesWriter, PathOf


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
            out = csv.writer(self._open[name], lineterminator="\n")
            if is_new:
                out.writerow(part.columns)
            out.writerows(_rows(part, "", str.lower))

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
            names = [*part.columns]
            self._open[name].writelines(
                json.dumps(dict(zip(names, row, strict=True))) + "\n" for row in _rows(part, None)
            )


def _rows(table: Table, nothing: Any, truth: Any = None) -> Iterator[tuple[Any, ...]]:
    """Return the rows; ``nothing`` stands for what is not finite, ``truth`` converts the bools."""
    columns = []
    for name in table.columns:
        values = table[name]
        column = values.tolist()
        if values.dtype.kind == "f":
            column = [one if math.isfinite(one) else nothing for one in column]
        elif values.dtype.kind == "b" and truth is not None:
            column = [truth(str(one)) for one in column]
        columns.append(column)
    return zip(*columns, strict=True)
