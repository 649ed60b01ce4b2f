"""Inputs and outputs of a co-simulation as CSV tables."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Self

from ..values.errors import FmuError
from ..values.input_files import DELIMITERS, lines_of
from ..values.output_files import writing
from .node import PLAIN_TYPES, Node
from .runner import CoSimulation

TIME = "time"


def split_name(text: str, nodes: Iterable[str]) -> tuple[str, str]:
    """Return node and variable of ``NODE.variable``, where both may contain dots.

    Raises:
        FmuError: there is no such node.

    >>> split_name("node.a.b", ["no", "node"])
    ('node', 'a.b')
    """
    nodes = list(nodes)
    found = [name for name in nodes if text.startswith(f"{name}.")]
    if not found:
        raise FmuError(
            f"{text!r} must be NODE.variable; the nodes are {', '.join(nodes) or 'missing'}"
        )
    node = max(found, key=len)
    return node, text[len(node) + 1 :]


def read_inputs(
    path: str | PathLike[str], nodes: Iterable[str]
) -> list[tuple[float, Mapping[tuple[str, str], str]]]:
    """Return the inputs in a table with the columns time [s] and NODE.variable.

    A row sets its values at its time; an empty cell sets nothing. Cells are separated by commas,
    semicolons or tabs.

    Raises:
        FmuError: the table is malformed.
        OSError: the file cannot be read.
    """
    try:
        with Path(path).open(encoding="utf-8-sig", newline="") as file:
            return _rows(lines_of(file, str(path), FmuError), str(path), list(nodes))
    except (UnicodeDecodeError, csv.Error) as error:
        raise FmuError(f"{path}: is not a CSV file: {error}") from error


def _rows(
    lines: Iterator[str], path: str, nodes: Sequence[str]
) -> list[tuple[float, Mapping[tuple[str, str], str]]]:
    first = next(lines, "")
    delimiter = max(DELIMITERS, key=first.count)
    header = [name.strip() for name in next(csv.reader([first], delimiter=delimiter), [])]
    if header[:1] != [TIME]:
        raise FmuError(f"{path}: the first column must be {TIME!r}, got {header[:1]}")
    variables = [split_name(name, nodes) for name in header[1:]]
    rows: list[tuple[float, Mapping[tuple[str, str], str]]] = []
    reader = csv.reader(lines, delimiter=delimiter)
    for cells in reader:
        if not cells:
            continue
        where = f"{path}, line {reader.line_num + 1}"
        if len(cells) != len(header):
            raise FmuError(f"{where}: has {len(cells)} cells, the header has {len(header)}")
        time = _time(cells[0], where)
        if rows and time < rows[-1][0]:
            raise FmuError(f"{where}: time must not fall, got {time:g} after {rows[-1][0]:g} s")
        values = zip(variables, cells[1:], strict=True)
        rows.append((time, {name: cell for name, cell in values if cell}))
    return rows


class OutputWriter:
    """Table of the plain outputs of all nodes: one row each time, one column each element."""

    def __init__(self, path: str | PathLike[str], simulation: CoSimulation) -> None:
        self._path = Path(path)
        self._file = self._path.open("w", encoding="utf-8", newline="")
        self._writer = csv.writer(self._file, lineterminator="\n")
        self._simulation = simulation
        self._outputs = [(node, *_outputs(node)) for node in simulation.nodes.values()]
        columns = (
            column
            for node, names, sizes in self._outputs
            for name, size in zip(names, sizes, strict=True)
            for column in _columns(node, name, size)
        )
        self._writer.writerow([TIME, *columns])

    def write(self) -> None:
        """Write the outputs at the present time."""
        values = (
            value for node, names, sizes in self._outputs for value in node.get_all(names, sizes)
        )
        row = [self._simulation.now, *values]
        with writing(self._path, FmuError, self._file.close):
            self._writer.writerow(row)

    def close(self) -> None:
        """Close the file."""
        with writing(self._path, FmuError, self._file.close):
            self._file.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


def _outputs(node: Node) -> tuple[list[str], list[int]]:
    """Return the names and the sizes of the plain outputs of a node."""
    found = [
        name
        for name, variable in node.variables.items()
        if variable.causality == "output" and variable.type in PLAIN_TYPES
    ]
    return found, [node.size(node.variables[name]) for name in found]


def _columns(node: Node, name: str, size: int) -> list[str]:
    label = f"{node.name}.{name}"
    if not node.variables[name].dimensions:
        return [label]
    return [f"{label}[{number}]" for number in range(1, size + 1)]


def _time(text: str, where: str) -> float:
    try:
        time = float(text)
    except ValueError:
        time = math.nan
    if not 0 <= time < math.inf:
        raise FmuError(f"{where}: time must be a number from 0 [s], got {text!r}")
    return time
