#!/usr/bin/env python3
"""Mutation test: change one place of the product at a time; the tests must fail.

    mutation.py                           a sample of 300 mutants of wire/ and bus/
    mutation.py values propagation maps --sample 200                    of other areas
    mutation.py --sample 0                all of wire/ and bus/: about 5000, most of a day
    mutation.py --sources maplines_can/wire/reception --sample 0     all of a folder or a file

A mutant is a copy of the tree with one change to a comparison, an operator, a number, a condition,
a default, a call or an assignment (see mutants.py). It is killed if a test fails or does not end.
The checkout itself is not changed.

The tests are run once to record the lines that each of them covers. A mutant is then tested by
those that cover its lines, the fastest first, until one fails. --budget limits their time, so a
mutant that only slower tests would kill survives. So does one that only the tests of altered DBCs
(test_an_altered_*) would kill: they are left out, since to record them takes most of the time.

The sample has mutants of each file, in proportion to their number; each seed gives another sample.
tools/mutation_survivors.toml has the reasons for accepted survivors. An accepted survivor still
counts as a survivor.

Each area has its sources, and the tests that concern them: those of the same folder, and the
examples of the docstrings.

Recording the lines takes some minutes. Then a killed mutant takes 2 s, and a survivor up
to --budget: about half an hour for 300 mutants on an idle core, twice that on a busy one.

It needs Linux or macOS. Run it in the environment of the project:
python3 tools/run.py python tools/mutation.py

The exit status is 1 if less than --least of the mutants are killed, or if the tests fail on the
unchanged tree.
"""

from __future__ import annotations

import argparse
import ast
import json
import multiprocessing
import os
import random
import shutil
import signal
import sys
import tempfile
import time
import tomllib
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from mutants import Mutant, mutants
from mutation_worker import record_lines, run_tests
from reporting import parser_of, progress, report

ROOT = Path(__file__).resolve().parents[1]
#: Libraries that the processes of the tests share, since importing them takes most of their time.
PRELOAD = [
    *("can", "cantools", "numpy", "numpy.testing"),
    *("scipy.linalg", "scipy.spatial", "scipy.stats", "scipy.optimize", "scipy.integrate"),
]
#: Files that the tests do not need.
LEFT_OUT = shutil.ignore_patterns(
    ".git", ".venv", ".*cache", "__pycache__", ".hypothesis", "build", "dist"
)
#: Time limit of the tests of a mutant: a multiple of their normal time, and a constant [s].
SLOWER, START_UP = 3, 30
#: Reason given in the report for a survivor that is not in the list.
UNLISTED = "NOT LISTED"


class Area(NamedTuple):
    """Files or folders that belong together, and the tests that concern them."""

    sources: list[str]
    tests: list[str]


def _folder(name: str) -> Area:
    """Return a package, with the tests of its folder and the examples of its docstrings."""
    return Area([f"maplines_can/{name}"], [f"tests/{name}", f"maplines_can/{name}"])


#: Packages that are areas of their own.
FOLDERS = ("values", "propagation", "maps", "localisation", "simulation", "consumers")
#: Areas by name. Tests that run commands are left out: they are slow.
AREAS = {
    "core": Area(
        ["maplines_can/wire", "maplines_can/logs", "maplines_can/bus"],
        [
            *("tests/wire", "tests/bus", "tests/test_fuzz_corpus.py"),
            *(f"tests/bad_input/test_bad_{what}.py" for what in ("bus", "values", "wire")),
            *("tests/study/codes", "tests/study/test_guarantee.py"),
            *("maplines_can/wire", "maplines_can/logs", "maplines_can/bus"),
        ],
    ),
    **{name: _folder(name) for name in FOLDERS},
}


class Outcome(NamedTuple):
    """Result of one mutant."""

    file: str
    mutant: Any  #: with function, line, original and mutated
    how: str  #: killed, timeout, survived or not covered

    @property
    def is_killed(self) -> bool:
        """Whether the tests detected the mutant."""
        return self.how in ("killed", "timeout")


class Lines(NamedTuple):
    """Lines that the tests cover, and how long the tests take."""

    tests: Mapping[str, Mapping[int, Sequence[str]]]  #: by file and line
    seconds: Mapping[str, float]  #: by test
    failed: Sequence[str]


def main() -> int:
    """Run the command and return its exit status."""
    arguments = _arguments()
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="mutation-") as folder:
        tree = Path(folder) / "tree"
        shutil.copytree(arguments.root, tree, ignore=LEFT_OUT, symlinks=True)
        run = Runner(tree)
        lines = run.lines(arguments.sources, arguments.tests)
        if lines.failed:
            print(f"mutation.py: the unchanged tree fails: {lines.failed[:5]}", file=sys.stderr)
            return 1
        chosen = sample(tree, arguments.sources, arguments.sample, arguments.seed)
        choose = TestChoice(tree, lines, arguments.budget)
        outcomes = [
            Outcome(file, mutant, run.outcome(file, mutant, choose(file, mutant), lines.seconds))
            for file, mutant in progress(chosen, "mutants", len(chosen))
        ]
    result = summary(outcomes, reasons(arguments.survivors), arguments.least)
    result["seed"], result["minutes"] = arguments.seed, (time.monotonic() - started) / 60
    return report(result, arguments.json, 44)


def _arguments() -> argparse.Namespace:
    parser = parser_of(__doc__)
    parser.add_argument(
        "areas",
        nargs="*",
        metavar="AREA",
        help=f"{', '.join(AREAS)} (default: core, which is wire/ and bus/)",
    )
    parser.add_argument(
        "--sources", nargs="+", help="files or folders to change (default: those of the areas)"
    )
    parser.add_argument("--tests", nargs="+", help="files or folders (default: those of the areas)")
    parser.add_argument(
        "--sample", type=int, default=300, help="number of mutants; 0: all (default: 300)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the sample (default: 0)")
    parser.add_argument(
        "--least", type=float, default=0.92, help="share that must be killed (default: 0.92)"
    )
    parser.add_argument(
        "--budget",
        type=float,
        default=60,
        metavar="S",
        help="time of a mutant's tests [s] (default: 60)",
    )
    parser.add_argument(
        "--survivors",
        type=Path,
        default=ROOT / "tools" / "mutation_survivors.toml",
        help="accepted survivors (default: tools/mutation_survivors.toml)",
    )
    parser.add_argument("--root", type=Path, default=ROOT, help="tree to test (default: this one)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    for name in arguments.areas:
        if name not in AREAS:
            parser.error(f"there is no area {name}; there are {', '.join(AREAS)}")
    areas = [AREAS[name] for name in arguments.areas or ["core"]]
    # Each once: code of scenes is also in wire/.
    arguments.sources = arguments.sources or [*dict.fromkeys(s for a in areas for s in a.sources)]
    arguments.tests = arguments.tests or [*dict.fromkeys(t for a in areas for t in a.tests)]
    for name in [*arguments.sources, *arguments.tests]:
        if not (arguments.root / name).exists():
            parser.error(f"there is no {name} in {arguments.root}")
    return arguments


# ---- the sample ---------------------------------------------------------------------------


def sample(tree: Path, sources: Iterable[str], size: int, seed: int) -> list[tuple[str, Mutant]]:
    """Return about ``size`` mutants, from each file in proportion to its number; 0: all."""
    every = {file: mutants((tree / file).read_bytes()) for file in python_files(tree, sources)}
    total = sum(map(len, every.values()))
    chosen = []
    for file, found in every.items():
        n = len(found) if size == 0 else min(len(found), max(1, round(size * len(found) / total)))
        picked = random.Random(f"{seed} {file}").sample(found, n)  # noqa: S311 - no secret
        chosen += [(file, mutant) for mutant in sorted(picked, key=lambda m: (m.start, m.mutated))]
    return chosen


def python_files(tree: Path, sources: Iterable[str]) -> list[str]:
    """Return the Python files of files and folders, relative to the tree."""
    paths = {
        path
        for source in sources
        for path in ([tree / source] if source.endswith(".py") else (tree / source).rglob("*.py"))
    }
    return sorted(path.relative_to(tree).as_posix() for path in paths)


class TestChoice:
    """Choice of the tests of a mutant: those that cover its lines, the fastest first."""

    __test__ = False  # not a test, in spite of its name

    def __init__(self, tree: Path, lines: Lines, budget: float) -> None:
        self._lines, self._budget = lines, budget
        self._mentions: dict[str, list[tuple[str, int]]] = defaultdict(list)
        self._derived: dict[str, set[str]] = defaultdict(set)  # constants that a constant is in
        for file in lines.tests:
            module = ast.parse((tree / file).read_bytes())
            for node in ast.walk(module):
                match node:
                    case ast.Name(name) | ast.Attribute(_, name):
                        self._mentions[name].append((file, node.lineno))
            for statement in module.body:
                if isinstance(statement, ast.Assign | ast.AnnAssign):
                    names = {n.id for n in ast.walk(statement) if isinstance(n, ast.Name)}
                    for name in names:
                        self._derived[name] |= names

    def __call__(self, file: str, mutant: Mutant) -> list[str]:
        """Return the tests, at most of ``budget`` seconds in total."""
        places = [(file, line) for line in mutant.lines]
        names, more = set(mutant.names), set(mutant.names)
        while more := {other for name in more for other in self._derived[name]} - names:
            names |= more
        places += [place for name in sorted(names) for place in self._mentions[name]]
        covering = {t for file, line in places for t in self._lines.tests[file].get(line, ())}
        tests, total = list[str](), 0.0
        for test in sorted(covering, key=lambda test: (self._lines.seconds[test], test)):
            total += self._lines.seconds[test]
            if tests and total > self._budget:
                break
            tests.append(test)
        return tests


# ---- running the tests ----------------------------------------------------------------------


class Runner:
    """Runner of tests in processes of their own, on a copy of the tree."""

    def __init__(self, tree: Path) -> None:
        self._tree = tree
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(PRELOAD)

    def lines(self, sources: Sequence[str], tests: Sequence[str]) -> Lines:
        """Run all tests on the unchanged tree, and record the lines that each covers."""
        out = self._tree.parent / "lines.json"
        self._run(partial(record_lines, self._tree, list(sources), list(tests), out), None)
        found = json.loads(out.read_text())
        by_line = {
            file: {int(line): tests for line, tests in lines.items()}
            for file, lines in found["tests"].items()
        }
        every = {file: by_line.get(file, {}) for file in python_files(self._tree, sources)}
        return Lines(every, found["seconds"], found["failed"])

    def outcome(
        self, file: str, mutant: Mutant, tests: Sequence[str], seconds: Mapping[str, float]
    ) -> str:
        """Return the result of a mutant: killed, timeout, survived or not covered."""
        if not tests:
            return "not covered"
        path = self._tree / file
        source, times = path.read_bytes(), path.stat()
        limit = START_UP + SLOWER * sum(seconds[test] for test in tests)
        try:
            path.write_bytes(mutant.apply(source))
            # Python compares time and size with those of the compiled file; both may be equal.
            os.utime(path, ns=(0, 1 + mutant.start))
            status = self._run(partial(run_tests, self._tree, list(tests)), limit)
        finally:
            path.write_bytes(source)
            os.utime(path, ns=(times.st_atime_ns, times.st_mtime_ns))
        return "timeout" if status is None else "killed" if status else "survived"

    def _run(self, task: Callable[[], None], limit: float | None) -> int | None:
        return run_task(self._context, task, limit)


def run_task(context: Any, task: Callable[[], None], limit: float | None = None) -> int | None:
    """Run a task in a process; return its exit status, None if it exceeds the limit [s]."""
    process = context.Process(target=task)
    process.start()
    process.join(limit)
    status = process.exitcode
    if process.pid:
        with suppress(ProcessLookupError):  # the task leads a group of processes
            os.killpg(process.pid, signal.SIGKILL)
    process.join()
    return status


# ---- the result -----------------------------------------------------------------------------


def reasons(path: Path) -> dict[tuple[str, str, str, str], str]:
    """Return the reason of each accepted survivor, by file, function and change."""
    if not path.exists():
        return {}
    entries = tomllib.loads(path.read_text(encoding="utf-8"))["survivor"]
    keys = ("file", "function", "original", "mutated")
    return {tuple(entry[key] for key in keys): entry["reason"] for entry in entries}


def summary(
    outcomes: Sequence[Outcome],
    accepted: Mapping[tuple[str, str, str, str], str],
    least: float,
) -> dict[str, Any]:
    """Return counts, scores by package, and the survivors with their reasons."""
    how = Counter(outcome.how for outcome in outcomes)
    packages: dict[str, list[bool]] = defaultdict(list)
    survivors: dict[str, str] = {}
    unlisted = 0
    for outcome in outcomes:
        file, mutant = outcome.file, outcome.mutant
        packages[str(Path(file).parent)].append(outcome.is_killed)
        if not outcome.is_killed:
            key = (file, mutant.function, mutant.original, mutant.mutated)
            reason = accepted.get(key, UNLISTED)
            unlisted += reason == UNLISTED
            place = f"{file}:{mutant.line} {mutant.function}: {mutant.original} -> {mutant.mutated}"
            survivors[place] = f"\n        {outcome.how}; {reason}"
    killed = sum(outcome.is_killed for outcome in outcomes)
    score = killed / len(outcomes) if outcomes else 1.0
    return {
        "mutants": len(outcomes),
        "killed": killed,
        "of these by the time limit": how["timeout"],
        "survived": len(outcomes) - killed,
        "of these not listed": unlisted,
        "score": score,
        "score by package": {
            name: f"{sum(found)} of {len(found)}" for name, found in sorted(packages.items())
        },
        "survivors": survivors,
        "met": score >= least,
    }


if __name__ == "__main__":
    sys.exit(main())
