"""What the threads of BLAS cost the calls of a cycle, with idle and with busy cores.

Two processes make the same calls: in one of them OPENBLAS_NUM_THREADS is 1, in the other it is not
set, so that OpenBLAS has a thread for each core. They take turns of 0.1 s, once with the cores as
they are and once with a busy process for each core. Each pair of turns gives the ratios of wall
time and of the CPU time of all threads; the figures are medians.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from .harness import evidence, progress

#: Length of a turn, and longest time for which a busy process runs, should it not be ended [s].
SECONDS, MAX_LOAD = 0.1, 3600
#: For comparison: the encoder of scenes does without it.
COMPARISON = "for comparison: np.linalg.eigh of 32x32"
#: The program of a process that makes the calls that its input names, and prints their times.
SERVE = f"""
import json, sys, time
import numpy as np
from cycle_calls import calls
matrix = np.cov(np.random.default_rng(0).standard_normal((32, 64)))
found = {{{COMPARISON!r}: lambda: np.linalg.eigh(matrix)}} | calls()
print(json.dumps([*found]), flush=True)
for line in sys.stdin:
    name, repeats = json.loads(line)
    wall, cpu = time.perf_counter(), time.process_time()
    for _ in range(repeats):
        found[name]()
    times = time.perf_counter() - wall, time.process_time() - cpu
    print(json.dumps([one / repeats for one in times]), flush=True)
"""


class Server:
    """A process that makes calls, with a number of threads of BLAS; None for as many as it takes.

    Raises:
        RuntimeError: the process has ended.
    """

    def __init__(self, threads: int | None) -> None:
        environment = {key: text for key, text in os.environ.items() if "NUM_THREADS" not in key}
        environment["PYTHONPATH"] = str(Path(__file__).parents[1])
        environment |= {} if threads is None else {"OPENBLAS_NUM_THREADS": str(threads)}
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self._process = subprocess.Popen([sys.executable, "-c", SERVE], env=environment, **pipes)
        self.names: list[str] = self._answer()

    def _answer(self) -> Any:
        line = self._process.stdout.readline() if self._process.stdout else ""
        if not line:
            raise RuntimeError("the process that makes the calls has ended")
        return json.loads(line)

    def times(self, name: str, repeats: int) -> list[float]:
        """Return wall and CPU time of a call that is repeated [s]."""
        print(json.dumps([name, repeats]), file=self._process.stdin, flush=True)
        found: list[float] = self._answer()
        return found

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


@evidence(in_real_time=True)
def threads(rounds: int = 9, calls: tuple[str, ...] = ("",)) -> dict[str, Any]:
    """Compare the times of calls with as many threads as BLAS takes and with one.

    Args:
        rounds: pairs of turns.
        calls: parts of their names.
    """
    unlimited, one = Server(None), Server(1)
    try:
        names = [x for x in one.names if x == COMPARISON or any(text in x for text in calls)]
        return {name: ratios_of(unlimited, one, name, rounds) for name in progress(names, "calls")}
    finally:
        unlimited.close()
        one.close()


def ratios_of(unlimited: Server, one: Server, name: str, rounds: int) -> dict[str, float]:
    """Return the times of a call with one thread and busy cores, and the ratios to them."""
    idle, _ = measured(unlimited, one, name, rounds)
    with busy(os.cpu_count() or 1):
        loaded, times = measured(unlimited, one, name, rounds)
    return {
        "wall [ms]": 1000 * times[0],
        "CPU [ms]": 1000 * times[1],
        "wall, ratio": idle[0],
        "CPU, ratio": idle[1],
        "wall, ratio with busy cores": loaded[0],
        "CPU, ratio with busy cores": loaded[1],
    }


def measured(
    unlimited: Server, one: Server, name: str, rounds: int
) -> tuple[list[float], list[float]]:
    """Return the median ratios of wall and CPU time, and those times with one thread [s]."""
    repeats = max(1, round(SECONDS / min(server.times(name, 3)[0] for server in (unlimited, one))))
    pairs = [(unlimited.times(name, repeats), one.times(name, repeats)) for _ in range(rounds)]
    ratios = [[more / less for more, less in zip(*pair, strict=True)] for pair in pairs]
    return (
        [statistics.median(column) for column in zip(*ratios, strict=True)],
        [statistics.median(column) for column in zip(*(less for _, less in pairs), strict=True)],
    )


@contextmanager
def busy(processes: int) -> Iterator[None]:
    """Keep some cores busy."""
    text = f"import time\nend = time.monotonic() + {MAX_LOAD}\nwhile time.monotonic() < end: 0"
    running = [subprocess.Popen([sys.executable, "-c", text]) for _ in range(processes)]
    try:
        yield
    finally:
        for one in running:
            one.kill()
            one.wait()
