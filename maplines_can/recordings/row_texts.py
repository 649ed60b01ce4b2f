"""Rows of tables and of received lines as text: CSV and JSON lines, a block at a time.

A number is the text of ``repr``, the shortest that reads back as the same double, which takes most
of the time of a row. So each different number of a block gets its text once: a covariance has its
entries twice, and what a message states in few bits repeats.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Iterable, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import ffi, lib
from ..values.line import PARAMETERS, Kind, Slot, Status, are_within
from ..wire import E2EState
from .block_reception import LineBlock
from .line_tables import UPPER_TRIANGLE, Table

Array = NDArray[Any]
Texts = Sequence[str]

_TRUTHS = ("false", "true")
_STATES = dict(zip(map(int, E2EState), (one.name for one in E2EState), strict=True))


def number_texts(values: Array, nothing: str) -> list[str]:
    """Return floats as the shortest texts that read back, in the order of ``ravel``.

    >>> number_texts(np.array([0.1, 1e-7, -0.0, np.nan]), "null")
    ['0.1', '1e-07', '-0.0', 'null']
    """
    bits = np.ascontiguousarray(values, float).ravel().view(np.int64)
    each, places = np.unique(bits, return_inverse=True)
    numbers = each.view(float)
    texts = np.array([*map(repr, numbers.tolist())], object)
    texts[~np.isfinite(numbers)] = nothing
    return texts[places].tolist()


def csv_rows(table: Table) -> str:
    """Return the rows of a table as CSV; what is not finite is an empty cell."""
    columns = _columns(table, "", [csv_cell(text) for text in _texts(table)])
    return _lines(",".join(["%s"] * len(columns)), columns)


def json_rows(table: Table) -> str:
    """Return the rows of a table as JSON lines; what is not finite is null."""
    columns = _columns(table, "null", [json.dumps(text) for text in _texts(table)])
    names = (json.dumps(name).replace("%", "%%") for name in table.columns)
    return _lines("{" + ", ".join(f"{name}: %s" for name in names) + "}", columns)


def csv_cell(text: str) -> str:
    """Return a cell of CSV, in quotes if need be.

    >>> csv_cell("vcan0"), csv_cell("a,b"), csv_cell("")
    ('vcan0', '"a,b"', '')
    """
    out = io.StringIO()
    csv.writer(out, lineterminator="").writerow([text, ""])
    return out.getvalue()[:-1]


def _texts(table: Table) -> list[str]:
    """Return the texts of all categories of a table, one after the other."""
    return [text for texts in table.categories.values() for text in (*texts, "")]


def _columns(table: Table, nothing: str, texts: list[str]) -> list[Texts]:
    """Return the columns as texts; those of the categories are given as by `_texts`."""
    places, begin = {}, 0
    for name, of_name in table.categories.items():
        places[name], begin = begin, begin + len(of_name) + 1
    columns: list[Texts] = []
    for name, column in table.columns.items():
        if name in places:
            end = places[name] + len(table.categories[name]) + 1
            columns.append(_picked(texts[places[name] : end], column))
        elif column.dtype.kind == "f":
            columns.append(number_texts(column, nothing))
        elif column.dtype.kind == "b":
            columns.append(_picked(_TRUTHS, column.astype(np.uint8)))
        else:
            columns.append([*map(str, column.tolist())])
    return columns


def _picked(texts: Texts, places: Array) -> list[str]:
    return [texts[place] for place in places.tolist()]


def _lines(form: str, columns: Iterable[Texts]) -> str:
    return "".join(map((form + "\n").__mod__, zip(*columns, strict=True)))


# ---- received lines, as ``line_dict`` of ``cli/output.py`` has them ---------------------------


class LineTexts:
    """Texts of a block of received lines.

    Args:
        block: of lines.
        slots: lines of these only; by default all.
        at: distances ahead of the car [m].
    """

    def __init__(
        self, block: LineBlock, slots: Sequence[Slot] | None = None, at: Sequence[float] = ()
    ) -> None:
        self._block, self._at = block, at
        self._keep = np.arange(len(block))
        if slots is not None:
            self._keep = np.flatnonzero(np.isin(block.lines["slot"], np.array([*slots], np.uint8)))
        self._rows = rows = np.ascontiguousarray(block.lines[self._keep])
        self._has_values = (rows["status"] != Status.OUT_OF_RANGE) & np.isfinite(rows["age"])

    def __len__(self) -> int:
        return len(self._rows)

    def json(self) -> str:
        """Return the lines as JSON, one a row."""
        matrix = ", ".join(f"[{', '.join(['%s'] * 4)}]" for _ in range(4))
        mean = ", ".join(f'"{name}": %s' for name in PARAMETERS)
        form = (
            '"t": %s, "slot": "%s", "kind": "%s", "status": "%s", "usable": %s, "state": "%s", '
            '"two_senders": %s, "x_min": %s, "x_max": %s, "age": %s, "components": %s, '
            f'"mean": {{{mean}}}, "cov": [{matrix}], "mixture": %s, "channel": %s}}'
        )
        head, channel = self._head("null"), self._channels(json.dumps)
        entries = [(i, j) for i in range(4) for j in range(4)]
        columns = [*head, *self._numbers("null", entries), self._mixtures(), channel]
        if not self._at:
            return _lines("{" + form, columns)
        here = [self._positions(x) for x in self._at]
        names = [f'{{"x": {float(x)!r}, "y": %s, "sigma": %s}}' for x in self._at]
        at = [
            ", ".join(name % one for name, one in zip(names, each, strict=True) if one[0])
            for each in zip(*here, strict=True)
        ]
        return _lines('{"at": [%s], ' + form, [at, *columns])

    def csv(self) -> str:
        """Return the lines as rows of CSV; one without values has empty cells for them."""
        t, *head = self._head("")
        columns: list[Texts] = [t, self._channels(csv_cell), *head]
        has_values = self._has_values.tolist()
        for column in self._numbers("", UPPER_TRIANGLE):
            cells = zip(column, has_values, strict=True)
            columns += [[text if known else "" for text, known in cells]]
        for x in self._at:
            columns.extend([*zip(*self._positions(x), strict=True)] if len(self) else [[], []])
        return _lines(",".join(["%s"] * len(columns)), columns)

    def _head(self, nothing: str) -> list[Texts]:
        """Return the columns from the time to the two senders."""
        rows, has_time = self._rows, self._block.has_time[self._keep]
        kinds = [("slot", Slot), ("kind", Kind), ("status", Status)]
        slot, kind, status = (
            _picked([one.name for one in kind], rows[name]) for name, kind in kinds
        )
        usable, two = (
            _picked(_TRUTHS, rows[name].astype(np.uint8)) for name in ("usable", "two_senders")
        )
        t = number_texts(np.where(has_time, rows["t_ns"] / 1e9, np.nan), nothing)
        state = [_STATES[one] for one in rows["state"].tolist()]
        return [t, slot, kind, status, usable, state, two]

    def _numbers(self, nothing: str, entries: Sequence[tuple[int, int]]) -> list[Texts]:
        """Return the columns from the range to these entries of the covariance."""
        rows = self._rows
        floats = [rows["x_min"], rows["x_max"], rows["age"], *rows["mean"].T]
        floats += [rows["cov"][:, i, j] for i, j in entries]
        n, texts = len(rows), number_texts(np.array(floats), nothing)
        columns: list[Texts] = [texts[k * n : (k + 1) * n] for k in range(len(floats))]
        components = np.maximum(rows["components"], 1).tolist()
        return [*columns[:3], [*map(str, components)], *columns[3:]]

    def _channels(self, text: Any) -> list[str]:
        texts = [text(name) for name in self._block.channels]
        return _picked(texts, self._block.channel[self._keep])

    def _mixtures(self) -> list[str]:
        """Return the mixtures as JSON, null of a line that is none."""
        texts = ["null"] * len(self._block)
        of_line = self._block.components
        begins = np.flatnonzero(np.diff(of_line["line"], prepend=-1)).tolist()
        for begin, end in pairwise([*begins, len(of_line)]):
            part = of_line[begin:end]
            mixture = {"weights": part["weight"].tolist(), "means": part["mean"].tolist()}
            texts[part["line"][0]] = json.dumps(mixture | {"covs": part["cov"].tolist()})
        return _picked(texts, self._keep)

    def _positions(self, x: float) -> list[tuple[str, str]]:
        """Return the lateral positions at x and their sigmas, empty texts where there are none."""
        rows = self._rows
        is_in = are_within(rows["x_min"], rows["x_max"], x) & self._has_values
        is_in &= (rows["x_min"] <= x) & (x <= rows["x_max"])
        covs = np.ascontiguousarray(rows["cov"])
        cov: Any = ffi.from_buffer("double[]", covs)
        found = [("", "")] * len(rows)
        for k in np.flatnonzero(is_in).tolist():
            mean = rows["mean"][k].tolist()
            y = lib.maplines_line_y(*mean, x)
            found[k] = repr(y), repr(lib.maplines_line_sigma(mean[1], cov + 16 * k, x))
        return found
