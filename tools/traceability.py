#!/usr/bin/env python3
"""Check that docs/assurance.md traces each goal, fault and requirement to code and tests.

    traceability.py          check the page against the source: nothing is imported or run
    traceability.py --run    also run the traced tests; each must pass, except those that need
                             SocketCAN if the kernel has none (tools/vcan runs them)
    traceability.py --json   print the result as JSON

Each row of a table whose first column is called ID is one item. Its ID is a letter and a number:
G-1 is a safety goal, A-1 an assumption of use, F-1 a fault, R-1 a requirement. There is a gap if

- an ID is malformed, defined twice, or used but not defined, or a cell is missing or empty;
- a goal has no requirement, or a fault none;
- an assumption is mentioned nowhere else on the page;
- a requirement has no goal, no code or no test;
- a module, symbol or test does not exist, or a test is skipped.

Code is `module:symbol`, relative to maplines_can, or `c/src/file.c:function`, of the core;
a test is `file::test`, relative to tests.

Run it in the environment of the project: python3 tools/run.py python tools/traceability.py

The exit status is 1 if there is a gap, or if a test does not pass.
"""

from __future__ import annotations

import ast
import json
import re
import sys
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from reporting import parser_of

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "assurance.md"
KINDS = {"G": "goals", "A": "assumptions", "F": "faults", "R": "requirements"}
#: Columns that a table of each kind must have.
COLUMNS = {
    "G": {"goal"},
    "A": {"assumption"},
    "F": {"fault", "requirements"},
    "R": {"requirement", "goals", "code", "tests"},
}
ID = re.compile(r"\b[A-Z]-\d+\b")
#: Outcome of a test that is skipped where the kernel has no SocketCAN.
NEEDS_KERNEL = "to be run in tools/vcan"


class Item(NamedTuple):
    """One row of a table of the page."""

    id: str
    cells: dict[str, str]  #: by column
    line: int  #: of the page, from 1

    def ids(self, column: str) -> list[str]:
        """Return the IDs in a column."""
        return ID.findall(self.cells.get(column, ""))

    def names(self, column: str) -> list[str]:
        """Return the names in backticks in a column."""
        return re.findall(r"`([^`]*)`", self.cells.get(column, ""))


def items_of(page: str) -> Iterator[Item]:
    """Yield the items of all tables whose first column is called ID."""
    columns: list[str] | None = None
    for number, text in enumerate(page.splitlines(), start=1):
        if not text.startswith("|"):
            columns = None
            continue
        cells = [cell.strip() for cell in text.strip().strip("|").split("|")]
        if columns is None:
            columns = cells if cells[0] == "ID" else []
        elif columns and set(cells[0]) != {"-"}:
            yield Item(cells[0], dict(zip(columns, cells, strict=False)), number)


def gaps_of(page: str) -> list[str]:
    """Return the gaps of a page, one sentence each."""
    items = list(items_of(page))
    gaps = [gap for item in items for gap in _gaps_of_item(item)]
    defined = Counter(item.id for item in items)
    gaps += [f"{key} is defined {n} times" for key, n in defined.items() if n > 1]
    mentioned = Counter(ID.findall(page))
    gaps += [f"{key} is mentioned but not defined" for key in mentioned if key not in defined]
    gaps += [
        f"{item.id} is an assumption that nothing else on the page mentions"
        for item in items
        if item.id[:1] == "A" and mentioned[item.id] == 1
    ]
    with_requirement = {goal for item in items if item.id[:1] == "R" for goal in item.ids("goals")}
    gaps += [
        f"{item.id} is a goal without a requirement"
        for item in items
        if item.id[:1] == "G" and item.id not in with_requirement
    ]
    present = {item.id[:1] for item in items}
    return gaps + [f"there are no {name}" for kind, name in KINDS.items() if kind not in present]


def _gaps_of_item(item: Item) -> Iterator[str]:
    """Yield the gaps in the row of an item."""
    kind = item.id[:1]
    if not ID.fullmatch(item.id) or kind not in KINDS:
        yield f"line {item.line}: an ID is a letter of {', '.join(KINDS)} and a number: {item.id!r}"
        return
    for column in sorted(COLUMNS[kind] | item.cells.keys()):
        if not item.cells.get(column):
            yield f"{item.id} has nothing in the column {column!r}"
    if kind == "F":
        yield from _gaps_of_ids(item, "requirements", "R")
    if kind == "R":
        yield from _gaps_of_ids(item, "goals", "G")
        for column, problem in (("code", code_problem), ("tests", test_problem)):
            yield from _gaps_of_names(item, column)
            yield from (f"{item.id}: {found}" for n in item.names(column) if (found := problem(n)))


def _gaps_of_ids(item: Item, column: str, kind: str) -> Iterator[str]:
    wrong = [key for key in item.ids(column) if key[0] != kind]
    if wrong or (item.cells.get(column) and not item.ids(column)):
        yield f"{item.id} must name {KINDS[kind]} in the column {column!r}: {item.cells[column]!r}"


def _gaps_of_names(item: Item, column: str) -> Iterator[str]:
    rest = re.sub(r"`[^`]+`|[,\s]", "", item.cells.get(column, ""))
    if rest:
        yield f"{item.id} has text that is no name in backticks in the column {column!r}: {rest!r}"


def code_problem(name: str) -> str | None:
    """Return what is wrong with ``module:symbol``; None if the symbol is defined there."""
    module, _, symbol = name.partition(":")
    if module.endswith(".c"):
        path = ROOT / module
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        # A definition begins a line, and the body follows its arguments.
        is_defined = re.search(rf"^\w[\w *]*\b{re.escape(symbol)}\([^;{{]*\)\s*\{{", text, re.M)
        return None if is_defined else f"{module} does not define {symbol!r}"
    base = ROOT.joinpath("maplines_can", *module.split("."))
    path = base / "__init__.py" if base.is_dir() else base.with_suffix(".py")
    if not path.is_file():
        return f"there is no module {module!r}"
    if not isinstance(_defined(path, symbol), ast.AST):
        return f"{module} does not define {symbol!r}"
    return None


def test_problem(name: str) -> str | None:
    """Return what is wrong with ``file::test``; None if the test exists and is not skipped."""
    file, _, symbol = name.partition("::")
    path = ROOT / "tests" / file
    if not path.is_file():
        return f"there is no file tests/{file}"
    found = _defined(path, symbol.replace("::", "."))
    if not isinstance(found, ast.FunctionDef) or not found.name.startswith("test_"):
        return f"tests/{file} has no test {symbol!r}"
    if any("mark.skip" in ast.unparse(decorator) for decorator in found.decorator_list):
        return f"the test {name} is skipped"
    return None


@cache
def _tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def _defined(path: Path, symbol: str) -> ast.AST | None:
    """Return the node that defines a symbol in a file: ``name``, or ``Class.name``."""
    node: ast.AST = _tree(path)
    for part in symbol.split("."):
        body = node.body if isinstance(node, ast.Module | ast.ClassDef) else []
        found = next((child for child in body if part in _names(child)), None)
        if found is None:
            return None
        node = found
    return node


def _names(node: ast.AST) -> set[str]:
    """Return the names that a statement defines."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return {node.name}
    targets: list[ast.expr] = []
    if isinstance(node, ast.Assign):
        targets = node.targets
    elif isinstance(node, ast.AnnAssign):
        targets = [node.target]
    return {n.id for target in targets for n in ast.walk(target) if isinstance(n, ast.Name)}


class _Outcomes:
    """Plugin of pytest that keeps the worst outcome of each test function."""

    def __init__(self) -> None:
        self.worst: dict[str, str] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Record the outcome of a phase; set-up and teardown count only if they do not pass."""
        if report.when == "call" or report.outcome != "passed":
            outcome: str = report.outcome
            if report.skipped and "socketcan" in report.keywords:
                outcome = NEEDS_KERNEL
            name = report.nodeid.partition("[")[0]
            order = ["passed", NEEDS_KERNEL, "skipped", "failed"]
            self.worst[name] = max(self.worst.get(name, "passed"), outcome, key=order.index)


def outcomes_of(tests: list[str]) -> dict[str, str]:
    """Run tests, and return the worst outcome of each."""
    outcomes = _Outcomes()
    names = [f"tests/{test}" for test in tests]
    arguments = [
        "--rootdir",
        str(ROOT),
        "-c",
        str(ROOT / "pyproject.toml"),
        "-p",
        "no:cacheprovider",
    ]
    pytest.main([*arguments, *(str(ROOT / name) for name in names)], plugins=[outcomes])
    return {name: outcomes.worst.get(name, "not run") for name in names}


def summary(page: str, *, run: bool = False) -> dict[str, Any]:
    """Return the number of items of each kind, of references and of tests, and the gaps."""
    items, gaps = list(items_of(page)), gaps_of(page)
    code = {name for item in items for name in item.names("code")}
    tests = sorted({name for item in items for name in item.names("tests")})
    counts = {name: sum(item.id[:1] == kind for item in items) for kind, name in KINDS.items()}
    counts |= {"code references": len(code), "tests": len(tests)}
    if run and not gaps:
        outcomes = outcomes_of(tests)
        for outcome in ("passed", NEEDS_KERNEL):
            counts[outcome] = sum(result == outcome for result in outcomes.values())
        bad = {name: result for name, result in outcomes.items() if result not in counts}
        gaps = [f"{name}: {result}" for name, result in bad.items()]
    return counts | {"gaps": gaps}


def main(arguments: list[str] | None = None) -> int:
    """Print the summary and the gaps, and return the exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("page", nargs="?", type=Path, default=PAGE, help="another page")
    parser.add_argument("--run", action="store_true", help="run the traced tests")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    options = parser.parse_args(arguments)
    result = summary(options.page.read_text(encoding="utf-8"), run=options.run)
    gaps = result["gaps"]
    if options.json:
        print(json.dumps(result, indent=2))
    else:
        counts = ", ".join(f"{n} {name}" for name, n in result.items() if name != "gaps")
        print("\n".join([*gaps, f"{options.page.name}: {counts}, {len(gaps)} gaps"]))
    return 1 if gaps else 0


if __name__ == "__main__":
    sys.exit(main())
