#!/usr/bin/env python3
"""Measure what the threads of BLAS cost the calls of a cycle, with idle and with busy cores.

    python tools/bench_threads.py              all calls of cycle_calls.py, about five minutes
    python tools/bench_threads.py encode map_  those whose names have one of these texts
    python tools/bench_threads.py --strict     exit with 1 if a ratio is 1.3 or more

Method. Two processes make the same calls: in one of them OPENBLAS_NUM_THREADS is 1, in the other
it is not set, so that OpenBLAS has a thread for each core. They take turns of 0.1 s, once with the
cores as they are and once with a busy process for each core. A turn gives wall time and CPU time
of all threads of its process; each pair of turns gives their ratios, and the table shows the
medians. Times are those of a call with one thread and busy cores.

The first row is for comparison: eigenvalues of a 32x32 matrix by NumPy, which the encoder of
scenes does without.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, NamedTuple

#: Ratio that the calls of a cycle must not reach.
TARGET = 1.3
#: Pairs of turns, and length of a turn [s].
ROUNDS, SECONDS = 9, 0.1
#: Longest time for which a busy process runs, should it not be ended [s].
MAX_LOAD = 3600
COMPARISON = "np.linalg.eigh of 32x32"
COLUMNS = "{:<52} {:>8} {:>8}   {:>6} {:>6}   {:>6} {:>6}"


class Times(NamedTuple):
    """Times of one call."""

    wall: float  #: [s]
    cpu: float  #: of all threads [s]


# -- the process that makes the calls ---------------------------------------------


def serve() -> None:
    """Make the calls that standard input asks for, and print their times."""
    import numpy as np
    from cycle_calls import calls

    matrix = np.cov(np.random.default_rng(0).standard_normal((32, 64)))
    found: dict[str, Any] = {COMPARISON: lambda: np.linalg.eigh(matrix)} | calls()
    print(json.dumps([*found]), flush=True)
    for line in sys.stdin:
        name, repeats = json.loads(line)
        call = found[name]
        wall, cpu = time.perf_counter(), time.process_time()
        for _ in range(repeats):
            call()
        times = (time.perf_counter() - wall) / repeats, (time.process_time() - cpu) / repeats
        print(json.dumps(times), flush=True)


class Server:
    """A process that makes calls.

    Args:
        threads: of BLAS; None for as many as it takes.
    """

    def __init__(self, threads: int | None) -> None:
        environment = {key: text for key, text in os.environ.items() if "NUM_THREADS" not in key}
        if threads is not None:
            environment["OPENBLAS_NUM_THREADS"] = str(threads)
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--serve"],
            env=environment,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.names: list[str] = self._answer()

    def _answer(self) -> Any:
        stdout = self._process.stdout
        line = stdout.readline() if stdout is not None else ""
        if not line:
            sys.exit("bench_threads.py: the process that makes the calls has ended")
        return json.loads(line)

    def times(self, name: str, repeats: int) -> Times:
        """Return the times of a call that is repeated."""
        if self._process.stdin is not None:
            print(json.dumps([name, repeats]), file=self._process.stdin, flush=True)
        return Times(*self._answer())

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


# -- measurement and output -------------------------------------------------------


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


class Measured(NamedTuple):
    """Times of a call with one thread, and ratios of those without a limit to them."""

    one: Times
    ratio: Times


def measured(unlimited: Server, one: Server, name: str, rounds: int) -> Measured:
    """Return the medians over pairs of turns."""
    repeats = max(1, round(SECONDS / min(one.times(name, 3).wall, unlimited.times(name, 3).wall)))
    pairs = [(unlimited.times(name, repeats), one.times(name, repeats)) for _ in range(rounds)]
    ratios = [[more / less for more, less in zip(*pair, strict=True)] for pair in pairs]
    return Measured(
        Times(*map(statistics.median, zip(*(least for _, least in pairs), strict=True))),
        Times(*map(statistics.median, zip(*ratios, strict=True))),
    )


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("texts", nargs="*", metavar="TEXT", help="in the names of calls [all]")
    parser.add_argument("--rounds", type=int, default=ROUNDS, help="pairs of turns [%(default)s]")
    parser.add_argument(
        "--strict", action="store_true", help=f"fail at a ratio of {TARGET} or more"
    )
    parser.add_argument("--serve", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args(argv)
    if options.serve:
        serve()
        return 0
    cores = os.cpu_count() or 1
    with ExitStack() as stack:
        unlimited, one = Server(None), Server(1)
        for server in (unlimited, one):
            stack.callback(server.close)
        names = [
            name
            for name in one.names
            if name == COMPARISON or not options.texts or any(t in name for t in options.texts)
        ]
        print(
            f"{cores} cores; load {os.getloadavg()[0]:.1f} before; {options.rounds} pairs of turns"
        )
        print("Ratios: without OPENBLAS_NUM_THREADS to with 1; as they are, and with busy cores\n")
        print(COLUMNS.format("", "wall", "CPU", "wall", "CPU", "wall", "CPU"), flush=True)
        missed = 0
        for name in names:
            idle = measured(unlimited, one, name, options.rounds)
            with busy(cores):
                loaded = measured(unlimited, one, name, options.rounds)
            ms = [f"{1e3 * value:.2f} ms" for value in loaded.one]
            ratios = [f"{value:.2f}" for value in (*idle.ratio, *loaded.ratio)]
            print(COLUMNS.format(name, *ms, *ratios), flush=True)
            missed += name != COMPARISON and max(loaded.ratio) >= TARGET
    print(f"\n{missed} of {len(names) - 1} calls at {TARGET} or more with busy cores")
    return int(options.strict and missed > 0)


if __name__ == "__main__":
    sys.exit(main())
