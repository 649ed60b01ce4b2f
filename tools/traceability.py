#!/usr/bin/env python3
"""Check that docs/assurance.toml traces each goal, fault and requirement to code and tests.

    traceability.py          check the data against the source: nothing is imported or run
    traceability.py --run    also run the traced tests; each must pass, except those that need
                             SocketCAN if the kernel has none (tools/vcan runs them)
    traceability.py --json   print the result as JSON
    traceability.py --write  write the tables of docs/assurance.md

The ID of an item is the letter of its kind and a number: G-1 is a safety goal, A-1 an assumption of
use, F-1 a fault, R-1 a requirement. There is a gap if

- an ID is malformed, defined twice, or used (also on the page) but not defined;
- a cell is missing;
- a goal has no requirement, or a fault none;
- an assumption is mentioned nowhere else in the data;
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
import tomllib
from collections import Counter
from collections.abc import Iterator, Mapping
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from reporting import fill_tables, parser_of

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "docs" / "assurance.toml"
PAGE = ROOT / "docs" / "assurance.md"
#: Kinds of items by the letter of their IDs.
KINDS = {"G": "goals", "A": "assumptions", "F": "faults", "R": "requirements"}
#: Columns of the tables, which are those of the page.
COLUMNS = {
    "goals": ("id", "goal"),
    "assumptions": ("id", "of", "assumption"),
    "faults": (
        "id", "fault", "detected_by", "reaction", "detected_after", "assumes", "requirements",
    ),
    "requirements": ("id", "requirement", "goals", "code", "tests"),
    "e2e": ("autosar", "here", "reason"),
    "secoc": ("autosar", "here", "reason"),
    "insufficiencies": ("insufficiency", "triggering_condition", "effect", "responsible"),
}  # fmt: skip
#: Lists of IDs, and the kinds that these have.
REFERENCES = {
    ("faults", "assumes"): "A",
    ("faults", "requirements"): "R",
    ("requirements", "goals"): "G",
}
MAY_BE_EMPTY = "assumes"
ID = re.compile(r"\b[A-Z]-\d+\b")
#: Outcome of a test that is skipped where the kernel has no SocketCAN.
NEEDS_KERNEL = "to be run in tools/vcan"
#: The tables of the data by name, each a list of rows.
Data = Mapping[str, list[dict[str, Any]]]


def gaps_of(data: Data, page: str = "") -> list[str]:
    """Return the gaps of the data, one sentence each; the page must mention defined IDs only."""
    gaps = [gap for table, rows in data.items() for row in rows for gap in _gaps_of_row(table, row)]
    defined = Counter(row.get("id", "") for table in KINDS.values() for row in data.get(table, ()))
    gaps += [f"{key} is defined {n} times" for key, n in defined.items() if n > 1]
    mentioned = Counter(ID.findall(json.dumps(data)))
    gaps += [
        f"{key} is mentioned but not defined"
        for key in dict.fromkeys([*mentioned, *ID.findall(page)])
        if key not in defined
    ]
    gaps += [
        f"{key} is an assumption that nothing else mentions"
        for key in defined
        if key[:1] == "A" and mentioned[key] == 1
    ]
    kept = {goal for row in data.get("requirements", ()) for goal in row.get("goals", ())}
    gaps += [
        f"{key} is a goal without a requirement"
        for key in defined
        if key[:1] == "G" and key not in kept
    ]
    return gaps + [f"there are no {name}" for name in KINDS.values() if not data.get(name)]


def _gaps_of_row(table: str, row: Mapping[str, Any]) -> Iterator[str]:
    """Yield the gaps in a row of a table."""
    columns = COLUMNS.get(table, ())
    if unknown := row.keys() - {*columns}:
        yield f"there is no column {min(unknown)!r} in the table {table!r}"
        return
    key = row.get("id", table)
    if table in KINDS.values() and not (ID.fullmatch(key) and KINDS.get(key[0]) == table):
        yield f"an ID is a letter of {', '.join(KINDS)}, as of its table, and a number: {key!r}"
        return
    for column in columns:
        if not row.get(column) and column != MAY_BE_EMPTY:
            yield f"{key} has nothing in the column {column!r}"
        if kind := REFERENCES.get((table, column)):
            wrong = [one for one in row.get(column, ()) if not one.startswith(f"{kind}-")]
            yield from (f"{key} must name {KINDS[kind]} as {column}: {one!r}" for one in wrong)
    for column, problem in (("code", code_problem), ("tests", test_problem)):
        yield from (f"{key}: {found}" for n in row.get(column, ()) if (found := problem(n)))


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


def tables_of(data: Data) -> dict[str, str]:
    """Return the tables of the page."""
    tables = {}
    for name, columns in COLUMNS.items():
        head = ["ID" if column == "id" else column.replace("_", " ") for column in columns]
        rows = [[_cell(column, row[column]) for column in columns] for row in data[name]]
        lines = [head, ["---"] * len(head), *rows]
        tables[name] = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    return tables


def _cell(column: str, value: str | list[str]) -> str:
    if isinstance(value, str):
        return value
    mark = "`" if column in ("code", "tests") else ""
    return ", ".join(f"{mark}{one}{mark}" for one in value) or "-"


def page_of(data: Data) -> str:
    """Return the page with its tables as they should be."""
    return fill_tables(PAGE.read_text(encoding="utf-8"), Path(__file__).name, tables_of(data))


def summary(data: Data, page: str = "", *, run: bool = False) -> dict[str, Any]:
    """Return the number of items of each kind, of references and of tests, and the gaps."""
    gaps = gaps_of(data, page)
    requirements = data.get("requirements", ())
    code = {name for row in requirements for name in row.get("code", ())}
    tests = sorted({name for row in requirements for name in row.get("tests", ())})
    counts = {name: len(data.get(name, ())) for name in KINDS.values()}
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
    parser.add_argument("data", nargs="?", type=Path, default=DATA, help="another file of data")
    parser.add_argument("--run", action="store_true", help="run the traced tests")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument("--write", action="store_true", help="write the tables of the page")
    options = parser.parse_args(arguments)
    data = tomllib.loads(options.data.read_text(encoding="utf-8"))
    if options.write:
        PAGE.write_text(page_of(data), encoding="utf-8")
    page = PAGE.read_text(encoding="utf-8") if options.data == DATA else ""
    result = summary(data, page, run=options.run)
    gaps = result["gaps"]
    if options.json:
        print(json.dumps(result, indent=2))
    else:
        counts = ", ".join(f"{n} {name}" for name, n in result.items() if name != "gaps")
        print("\n".join([*gaps, f"{options.data.name}: {counts}, {len(gaps)} gaps"]))
    return 1 if gaps else 0


if __name__ == "__main__":
    sys.exit(main())
