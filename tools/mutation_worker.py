"""Processes of mutation.py: run tests in a copy of the tree."""

from __future__ import annotations

import json
import os
import random
import sys
from collections import defaultdict
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

#: Options of pytest: a fixed seed, so that a mutant gets the same inputs as the unchanged tree.
OPTIONS = ["-q", "-p", "no:cacheprovider", "-m", "not socketcan"]
#: Option that leaves out the tests of generated DBCs: each runs the lines of reading a DBC dozens
#: of times, so to record them takes most of the time.
WITHOUT_GENERATED = ("-k", "not test_an_altered_")


def run_tests(tree: Path, tests: Sequence[str]) -> None:
    """Run tests in this order until one fails; end the process with pytest's exit status."""
    sys.dont_write_bytecode = True
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    _end(_pytest(tree, sorted({test.partition("::")[0] for test in tests}), _Chosen(tests), "-x"))


def run_files(tree: Path, tests: Sequence[str]) -> None:
    """Run the tests of files and folders until one fails; end the process with their status."""
    sys.dont_write_bytecode = True
    os.environ["PYTHONDONTWRITEBYTECODE"] = "1"
    _end(_pytest(tree, tests, _NoShrinking(), "-x", *WITHOUT_GENERATED))


def record_lines(tree: Path, sources: Sequence[str], tests: Sequence[str], out: Path) -> None:
    """Run tests, write the lines and the time of each, and end the process."""
    sys.dont_write_bytecode = False  # the mutants' processes need not compile what is unchanged
    recorder = _Recorder(tree, sources)
    _pytest(tree, tests, recorder, *WITHOUT_GENERATED)
    out.write_text(json.dumps(recorder.result()))
    _end(0)


def _pytest(tree: Path, arguments: Sequence[str], plugin: object, *options: str) -> int:
    os.setpgid(0, 0)  # a group of its own, with the processes that tests start
    os.chdir(tree)
    sys.path[:0] = [str(tree)]
    os.environ["PYTHONPATH"] = str(tree)
    quiet = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(quiet, stream)
    import pytest

    random.seed(0)
    return int(pytest.main([*OPTIONS, *options, *arguments], plugins=[plugin, _NoShrinking()]))


def _end(status: int) -> None:
    os._exit(status)  # threads that a failed test left behind must not keep it alive


class _NoShrinking:
    """Plugin that makes hypothesis deterministic, and does not shrink failing examples."""

    def pytest_collection(self) -> None:
        try:
            from hypothesis import Phase, settings
        except ImportError:
            return
        phases = (Phase.explicit, Phase.generate)
        settings.register_profile(
            "mutation", deadline=None, phases=phases, derandomize=True, database=None
        )
        settings.load_profile("mutation")  # after conftest.py, before the tests are imported


class _Chosen:
    """Plugin that runs the chosen tests only, in their order."""

    def __init__(self, tests: Sequence[str]) -> None:
        self._order = {test: i for i, test in enumerate(tests)}

    def pytest_collection_modifyitems(self, items: list[Any]) -> None:
        chosen = [item for item in items if item.nodeid in self._order]
        items[:] = sorted(chosen, key=lambda item: self._order[item.nodeid])


class _Recorder:
    """Plugin that records the lines and the time of each test.

    Lines that run during the import of a test file, or in the set-up of one of its tests, count for
    all tests of the file, since they share fixtures.
    """

    def __init__(self, tree: Path, sources: Sequence[str]) -> None:
        import coverage

        self._tree = tree
        self._tests: dict[str, list[str]] = defaultdict(list)  # by file
        self._seconds: dict[str, float] = {}
        self._failed: list[str] = []
        self._file = ""
        include = [f"{tree / source}{'' if source.endswith('.py') else '/*'}" for source in sources]
        self._coverage = coverage.Coverage(data_file=None, config_file=False, include=include)

    def pytest_sessionstart(self) -> None:
        self._coverage.start()

    def pytest_sessionfinish(self) -> None:
        self._coverage.stop()

    def pytest_collectstart(self, collector: Any) -> None:
        self._coverage.switch_context(collector.nodeid.partition("::")[0])

    def pytest_collection_finish(self, session: Any) -> None:
        for item in session.items:
            self._tests[item.nodeid.partition("::")[0]].append(item.nodeid)

    def pytest_runtest_setup(self, item: Any) -> None:
        file = item.nodeid.partition("::")[0]
        self._coverage.switch_context(file)
        if file != self._file:  # each file counts with what the tests of others have cached
            self._file = file
            for cached in _caches(self._tree / "tests"):
                cached.cache_clear()

    def pytest_runtest_call(self, item: Any) -> None:
        self._coverage.switch_context(item.nodeid)

    def pytest_runtest_logreport(self, report: Any) -> None:
        self._seconds[report.nodeid] = self._seconds.get(report.nodeid, 0.0) + report.duration
        if report.failed:
            self._failed.append(report.nodeid)

    def pytest_collectreport(self, report: Any) -> None:
        if report.failed:
            self._failed.append(report.nodeid)

    def result(self) -> dict[str, Any]:
        """Return tests by file and line, seconds by test, and the tests that failed."""
        data, tests = self._coverage.get_data(), {}
        for name in data.measured_files():
            file = Path(name).relative_to(self._tree).as_posix()
            tests[file] = {
                line: sorted(set(self._expanded(contexts)))
                for line, contexts in data.contexts_by_lineno(name).items()
            }
        return {"tests": tests, "seconds": self._seconds, "failed": self._failed}

    def _expanded(self, contexts: Sequence[str]) -> Iterator[str]:
        for context in contexts:
            yield from self._tests.get(context, [context] if "::" in context else [])


def _caches(folder: Path) -> Iterator[Any]:
    """Yield the cached functions of the modules of a folder."""
    for module in list(sys.modules.values()):
        if (getattr(module, "__file__", None) or "").startswith(str(folder)):
            for value in vars(module).values():
                if hasattr(value, "cache_clear"):
                    yield value
