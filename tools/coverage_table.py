#!/usr/bin/env python3
"""Print the branch coverage of each package, from the data file of `pytest --cov`.

    python3 tools/run.py pytest -n 2 --dist loadfile --cov --cov-report=
    python3 tools/run.py python tools/coverage_table.py
    python3 tools/run.py python tools/coverage_table.py --write   also write docs/assurance.md

The exit status is 1 if there is no data.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from pathlib import Path, PurePath
from typing import Any

from reporting import fill_tables, parser_of

COUNTS = ("num_statements", "covered_lines", "num_branches", "covered_branches")
HEADER = ("coverage", "lines", "", "branches", "")
PAGE = Path(__file__).parents[1] / "docs" / "assurance.md"


def main(arguments: list[str] | None = None) -> int:
    """Print the table and return the exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("--write", action="store_true", help="write the table of docs/assurance.md")
    options = parser.parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="coverage-") as folder:
        path = Path(folder) / "coverage.json"
        command = [sys.executable, "-m", "coverage", "json", "-q", "-o", str(path)]
        if subprocess.run(command, check=False).returncode:
            return 1
        rows = rows_of(json.loads(path.read_text())["files"])
    for package, lines, covered, branches, taken in [HEADER, *rows]:
        print(f"{package:<16}{lines:>8}{covered:>6}{branches:>10}{taken:>6}")
    if options.write:
        page = PAGE.read_text(encoding="utf-8")
        filled = fill_tables(page, Path(__file__).name, {"coverage": markdown(rows)})
        PAGE.write_text(filled, encoding="utf-8")
    return 0


def rows_of(files: dict[str, Any]) -> list[tuple[str, ...]]:
    """Return package, lines, share of them, branches and share of them; the total is last."""
    packages: dict[str, Counter[str]] = defaultdict(Counter)
    for name, data in files.items():
        counts = {key: data["summary"][key] for key in COUNTS}
        for package in (package_of(name), "total"):
            packages[package].update(counts)
    rows: list[tuple[str, ...]] = []
    for package, counts in sorted(packages.items(), key=lambda item: (item[0] == "total", item[0])):
        lines, covered, branches, taken = (counts[key] for key in COUNTS)
        rows.append(
            (package, str(lines), percent(covered, lines), str(branches), percent(taken, branches))
        )
    return rows


def markdown(rows: list[tuple[str, ...]]) -> str:
    """Return the rows as a table for a page."""
    lines = ["| package | lines | executed | branches | taken |", "|---|---:|---:|---:|---:|"]
    return "\n".join([*lines, *(f"| {' | '.join(row)} |" for row in rows)])


def package_of(name: str) -> str:
    """Return the package of a source file: the folder below maplines_can, or the top level."""
    inside = PurePath(name.replace("\\", "/")).parts[1:]
    return inside[0] if len(inside) > 1 else "top level"


def percent(covered: int, total: int) -> str:
    """Return a share for the table."""
    return f"{100 * covered / total:.0f} %" if total else "-"


if __name__ == "__main__":
    sys.exit(main())
