#!/usr/bin/env python3
"""Print the branch coverage of each package, from the data file of `pytest --cov`.

    python3 tools/run.py pytest -n 2 --dist loadfile --cov --cov-report=
    python3 tools/run.py python tools/coverage_table.py

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

from reporting import parser_of

COUNTS = ("num_statements", "covered_lines", "num_branches", "covered_branches")
HEADER = ("coverage", "lines", "", "branches", "")


def main(arguments: list[str] | None = None) -> int:
    """Print the table and return the exit status."""
    parser_of(__doc__).parse_args(arguments)
    with tempfile.TemporaryDirectory(prefix="coverage-") as folder:
        path = Path(folder) / "coverage.json"
        command = [sys.executable, "-m", "coverage", "json", "-q", "-o", str(path)]
        if subprocess.run(command, check=False).returncode:
            return 1
        rows = rows_of(json.loads(path.read_text())["files"])
    for package, lines, covered, branches, taken in [HEADER, *rows]:
        print(f"{package:<16}{lines:>8}{covered:>6}{branches:>10}{taken:>6}")
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


def package_of(name: str) -> str:
    """Return the package of a source file: the folder below maplines_can, or the top level."""
    inside = PurePath(name.replace("\\", "/")).parts[1:]
    return inside[0] if len(inside) > 1 else "top level"


def percent(covered: int, total: int) -> str:
    """Return a share for the table."""
    return f"{100 * covered / total:.0f} %" if total else "-"


if __name__ == "__main__":
    sys.exit(main())
