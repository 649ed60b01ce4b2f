#!/usr/bin/env python3
"""Mutation test of the C core: change one place at a time; core and model must differ.

    c_mutation.py                             a sample of 300 mutants of all of the core
    c_mutation.py --files c/src/sequence.c --sample 0      all of a file; patterns as c/logs/*
    c_mutation.py --tests                     survivors of the streams also meet the tests
    c_mutation.py --minutes 30                as many of a sample as there is time for

A mutant has one change to a comparison, an operator, a number, a condition or a statement (see
c_mutants.py). Only its file is compiled, and the library is built into a copy of the tree: the
checkout is not changed. What does not compile, or gives the same object code, is no mutant.

First the streams of core and model (maplines_can/testing) are recorded: three DBCs that are
shipped, and some random ones. A mutant takes the same inputs. It is killed if an answer differs
from the model's, or it crashes or does not end. With --tests, what survives also meets the tests
that TESTS names for its file.

Tools that mutate C (Mull, universalmutator) are not used: Mull has a package for each version of
LLVM, in no distribution, and runs programs rather than libraries; of universalmutator only the
patterns would be used, as c_mutants.py has them.

tools/mutation_survivors.toml has the reasons for accepted survivors, which still count as such.
The exit status is 1 if less than --least of the mutants are killed.
"""

from __future__ import annotations

import argparse
import math
import multiprocessing
import random
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from fnmatch import fnmatch
from functools import partial
from pathlib import Path

from build_core import FOLDERS, LIBRARY, MACROS, OPTIONS, checksum, compiler
from c_mutants import Mutant, mutants
from c_mutation_streams import DIFFERS, record, replay
from mutation import LEFT_OUT, PRELOAD, ROOT, SLOWER, START_UP, Outcome, reasons, run_task, summary
from mutation_worker import run_files
from reporting import bar, parser_of, report

#: Tests that concern files of the core: those of the first pattern that fits.
TESTS: dict[str, list[str]] = {
    "c/logs/text_logs.c": ["tests/bus/test_candump_logs.py", "tests/bus/test_asc_logs.py"],
    "c/logs/blf_log.c": ["tests/bus/test_blf_logs.py"],
    "c/logs/pcap_log.c": ["tests/bus/test_pcap_logs.py"],
    "c/core/tables.c": ["tests/core"],
    "c/src/names.c": ["tests/core/test_names.py"],
    "c/src/use.c": ["tests/c/test_use.py"],
    "c/src/predict.c": ["tests/c/test_use.py"],
    "c/src/sigma_points.c": ["tests/c/test_use.py"],
    "c/src/secoc.c": ["tests/wire/protection", "tests/c/test_run_vectors.py"],
    "c/src/scene_*": [
        "tests/core",
        "tests/wire/test_prepared_scenes.py",
        "tests/wire/test_scenes_on_wire.py",
    ],
    "c/propagation/*": ["tests/propagation"],
    "c/core/propagate.c": ["tests/propagation"],
    "c/core/values.c": ["tests/values", "tests/propagation/test_transform_line.py"],
    "*": ["tests/core", "tests/wire/reception", "tests/c/test_run_vectors.py"],
}
#: Time limit of the tests of a mutant [s].
TEST_LIMIT = 600
#: Steps of each recording that are taken before all of any.
FIRST = 100
FLAGS = [
    *(option for option in OPTIONS if option not in ("-O3", "-shared", "-fvisibility=hidden")),
    *("-O1", "-Werror=return-type"),
    *MACROS,
    f"-DMAPLINES_DECLARATIONS={checksum()}",
    *(f"-I{place.relative_to(ROOT)}" for place in (ROOT / "c" / "include", *FOLDERS)),
]


def main() -> int:
    """Run the command and return its exit status."""
    arguments = _arguments()
    started = time.monotonic()
    with tempfile.TemporaryDirectory(prefix="c-mutation-") as name:
        folder = Path(name)
        core = Core(folder / "core", arguments.recordings or folder / "recordings")
        if not core.recordings and not core.record(arguments.frames, arguments.jobs):
            return 1
        started_replay = time.monotonic()
        if core.replay(core.tree, core.recordings, folder / "said") != 0:
            print("c_mutation.py: the core that is not changed differs", file=sys.stderr)
            return 1
        recorded = time.monotonic()
        core.limit = START_UP + SLOWER * (recorded - started_replay)
        until = recorded + 60 * arguments.minutes
        wanted = [file for file in core.files if any(fnmatch(file, p) for p in arguments.files)]
        every = [(file, m) for file in wanted for m in mutants((ROOT / file).read_text())]
        random.Random(arguments.seed).shuffle(every)  # noqa: S311 - no secret
        run = Run(core, every, arguments.sample or len(every), until, is_tested=arguments.tests)
        outcomes = run.outcomes(folder, arguments.jobs)
    result = summary(outcomes, reasons(arguments.survivors), arguments.least)
    result |= {
        "killed by": dict(run.killed_by.most_common()),
        "no mutants": dict(run.left_out),
        "seed": arguments.seed,
        "minutes to record": (recorded - started) / 60,
        "minutes": (time.monotonic() - started) / 60,
    }
    return report(result, arguments.json, 44)


def _arguments() -> argparse.Namespace:
    parser = parser_of(__doc__)
    parser.add_argument(
        "--files",
        nargs="+",
        default=["c/*"],
        metavar="PATTERN",
        help="files that are changed (default: all of the library)",
    )
    parser.add_argument(
        "--sample", type=int, default=300, help="number of mutants; 0: all (default: 300)"
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of the sample (default: 0)")
    parser.add_argument("--jobs", type=int, default=1, help="processes at a time (default: 1)")
    parser.add_argument(
        "--minutes",
        type=float,
        default=math.inf,
        help="time after which no further mutant begins; the sample is then smaller",
    )
    parser.add_argument("--tests", action="store_true", help="survivors also meet the tests")
    parser.add_argument(
        "--frames", type=int, default=500, help="steps of a stream of a receiver (default: 500)"
    )
    parser.add_argument(
        "--recordings",
        type=Path,
        metavar="FOLDER",
        help="keep the recordings in it; those that are in it are used",
    )
    parser.add_argument(
        "--least", type=float, default=0.92, help="share that must be killed (default: 0.92)"
    )
    parser.add_argument(
        "--survivors",
        type=Path,
        default=ROOT / "tools" / "mutation_survivors.toml",
        help="accepted survivors (default: tools/mutation_survivors.toml)",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")
    return parser.parse_args()


def compiled(tree: Path, file: str, out: Path) -> bool:
    """Compile a file of a tree; return whether the compiler takes it."""
    command = [*compiler(), *FLAGS, "-w", "-c", file, "-o", str(out)]
    return subprocess.run(command, cwd=tree, capture_output=True, check=False).returncode == 0


def linked(tree: Path, objects: list[Path]) -> bool:
    """Build the library of a tree from object files."""
    made = tree / "maplines_can" / LIBRARY
    command = [*compiler(), "-shared", *map(str, objects), "-o", str(made), "-lm"]
    return subprocess.run(command, cwd=tree, capture_output=True, check=False).returncode == 0


class Core:
    """The core that is not changed: its object files, and the recordings of its streams."""

    def __init__(self, folder: Path, recordings: Path) -> None:
        self.tree, self._recordings = folder / "tree", recordings
        self.limit: float | None = None  #: time limit of a replay [s]
        self._recordings.mkdir(parents=True, exist_ok=True)
        shutil.copytree(ROOT, self.tree, ignore=LEFT_OUT, symlinks=True)
        self.files = [
            path.relative_to(ROOT).as_posix() for place in FOLDERS for path in place.glob("*.c")
        ]
        self.files.sort()
        self.objects = {file: folder / f"{Path(file).stem}.o" for file in self.files}
        for file, out in self.objects.items():
            if not compiled(self.tree, file, out):
                sys.exit(f"c_mutation.py: {file} does not compile")
        if not linked(self.tree, [*self.objects.values()]):
            sys.exit("c_mutation.py: the library cannot be linked")
        self.context = multiprocessing.get_context("forkserver")
        self.context.set_forkserver_preload([*PRELOAD, "cryptography.hazmat.primitives.cmac"])

    def record(self, frames: int, jobs: int) -> bool:
        """Record the streams in some processes; return whether core and model agree."""
        task, own = partial(record, self.tree, self._recordings, frames, parts=jobs), range(jobs)
        with ThreadPoolExecutor(jobs) as pool:
            tasks = [partial(task, part=part) for part in own]
            statuses = [*pool.map(partial(run_task, self.context), tasks)]
        if any(statuses):  # they are not all of them
            for file in self.recordings:
                file.unlink()
        return not any(statuses)

    def replay(self, tree: Path, files: Sequence[Path], said: Path) -> int | None:
        """Replay recordings in a tree; return the exit status, None if it does not end."""
        return run_task(self.context, partial(replay, tree, files, FIRST, said), self.limit)

    @property
    def recordings(self) -> list[Path]:
        """Files of the recordings."""
        return sorted(self._recordings.iterdir())


class Run:
    """Mutants in the order of their sample, each of which is compiled and tested."""

    def __init__(
        self,
        core: Core,
        every: list[tuple[str, Mutant]],
        size: int,
        until: float,
        *,
        is_tested: bool,
    ) -> None:
        self._core, self._size, self._until, self._is_tested = core, size, until, is_tested
        self._next = iter(enumerate(every))
        self._found: dict[int, Outcome] = {}
        self._lock = threading.Lock()
        self._kills: dict[str, Counter[str]] = defaultdict(Counter)  # recordings, by file
        self.killed_by = Counter[str]()
        self.left_out = Counter[str]()
        self._bar = bar(size, "mutants")

    def outcomes(self, folder: Path, jobs: int) -> list[Outcome]:
        """Return the outcomes of the sample, in its order."""
        threads = [
            threading.Thread(target=self._work, args=(folder / f"job{i}",)) for i in range(jobs)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return [self._found[i] for i in sorted(self._found)[: self._size]]

    def _work(self, folder: Path) -> None:
        tree = folder / "tree"
        shutil.copytree(self._core.tree, tree, symlinks=True)
        while True:
            with self._lock:
                number, (file, mutant) = next(self._next, (0, ("", None)))
                is_over = len(self._found) >= self._size or time.monotonic() >= self._until
                if mutant is None or is_over:
                    return
            source = (tree / file).read_text()
            try:
                (tree / file).write_text(mutant.apply(source))
                how = self._outcome(folder, tree, file)
            finally:
                (tree / file).write_text(source)
            with self._lock:
                if how in ("no compilation", "same object code"):
                    self.left_out[how] += 1
                else:
                    self._found[number] = Outcome(file, mutant, how)
                    self._bar.update()
                    if how == "survived":
                        place = f"{file}:{mutant.line}"
                        self._bar.write(
                            f"{place} {mutant.original} -> {mutant.mutated}", file=sys.stderr
                        )

    def _outcome(self, folder: Path, tree: Path, file: str) -> str:
        out = folder / "mutant.o"
        if not compiled(tree, file, out):
            return "no compilation"
        own = self._core.objects[file]
        if out.read_bytes() == own.read_bytes():
            return "same object code"
        if not linked(
            tree, [out, *(other for other in self._core.objects.values() if other != own)]
        ):
            return "no compilation"
        said, kills = folder / "said", self._kills[file]
        said.write_text("")
        total = sum(self._kills.values(), Counter[str]())
        files = sorted(self._core.recordings, key=lambda p: (-kills[p.name], -total[p.name], p))
        status = self._core.replay(tree, files, said)
        if status != 0:
            kills[said.read_text()] += 1
            return self._killed("streams", status)
        if not self._is_tested:
            return "survived"
        tests = next(tests for pattern, tests in TESTS.items() if fnmatch(file, pattern))
        status = run_task(self._core.context, partial(run_files, tree, tests), TEST_LIMIT)
        if status == 0:
            return "survived"
        return self._killed(" ".join(tests), DIFFERS if status == 1 else status)

    def _killed(self, by: str, status: int | None) -> str:
        ends = {None: "time limit", DIFFERS: "other answers"}
        how = ends.get(status, "crash" if status is not None and status < 0 else "error")
        self.killed_by[f"{by}, {how}"] += 1
        return "timeout" if status is None else "killed"


if __name__ == "__main__":
    sys.exit(main())
