#!/usr/bin/env python3
"""Fuzz the receiver in C with libFuzzer and the sanitizers of clang: frames and times in any order.

    c_fuzz.py --seconds 3600                     the project's DBCs, 20 minutes each
    c_fuzz.py --seconds 3600 --random 60         random DBCs, a minute each
    c_fuzz.py --seconds 60 --corpus DIR          keep what takes new paths, and begin with it
    c_fuzz.py --replay 100000 --seed 1           random inputs without clang, as fast as possible

An input that breaks a promise is written to crash-..., and the exit status is 1. Run it in the
environment of the project: python3 tools/run.py python tools/c_fuzz.py
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from random_dbc import random_dbc
from reporting import parser_of

from maplines_can.wire import default_dbc_path
from maplines_can.wire.layout.message_layout import Layout

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
import c_core  # noqa: E402

TARGET = ROOT / "c" / "tests" / "fuzz_frames.c"
PROJECT = ("maplines.dbc", "maplines-secoc.dbc", "maplines-pose.dbc")
SANITIZERS = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
#: Longest input [byte].
MAX_LENGTH = 4096


def layouts(randoms: int) -> Iterator[tuple[str, Layout]]:
    """Yield the layouts to be fuzzed, by name."""
    if not randoms:
        yield from ((name, Layout.from_dbc(default_dbc_path(name))) for name in PROJECT)
    for seed in range(randoms):
        yield f"random {seed}", Layout.from_text(random_dbc(seed), f"random{seed}.dbc")


def fuzz(name: str, layout: Layout, seconds: int, corpus: Path) -> bool:
    """Fuzz one DBC; return whether nothing was found."""
    flags = (*SANITIZERS, "-fsanitize=fuzzer")
    program = c_core.program([TARGET], [layout], [c_core.NAME], cc="clang", flags=flags)
    command = [str(program), f"-max_total_time={seconds}", f"-max_len={MAX_LENGTH}",
               "-print_final_stats=1", "-verbosity=1", str(corpus)]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    runs = re.search(r"number_of_executed_units: (\d+)", done.stderr)
    covered = re.findall(r"cov: (\d+)", done.stderr)
    numbers = f"{runs[1] if runs else 0} inputs, {covered[-1] if covered else 0} edges"
    found = "FOUND" if done.returncode else "nothing found"
    print(f"{name}: {numbers} in {seconds} s, {found}", flush=True)
    if done.returncode:
        print(done.stderr[-4000:])
    return not done.returncode


def main() -> int:
    """Fuzz; return the exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=int, default=60, help="in all [s] (default: 60)")
    parser.add_argument("--random", type=int, default=0, help="fuzz this many random DBCs instead")
    parser.add_argument(
        "--corpus", type=Path, help="folder of inputs (default: one that is removed)"
    )
    parser.add_argument("--replay", type=int, metavar="N", help="N random inputs of each DBC")
    parser.add_argument("--seed", type=int, default=0, help="of --replay (default: 0)")
    parser.add_argument("--cc", default="cc", help="compiler of --replay (default: cc)")
    options = parser.parse_args()
    chosen = [*layouts(options.random)]
    is_fine = True
    with tempfile.TemporaryDirectory() as folder:
        for name, layout in chosen:
            if options.replay is not None:
                flags = (*SANITIZERS, "-DREPLAY")
                program = c_core.program(
                    [TARGET], [layout], [c_core.NAME], cc=options.cc, flags=flags
                )
                command = [str(program), str(options.replay), str(options.seed)]
                status = subprocess.run(command, check=False).returncode
                print(f"{name}: {options.replay} inputs, status {status}", flush=True)
                is_fine = is_fine and status == 0
            else:
                corpus = options.corpus or Path(folder) / name.replace(" ", "-")
                corpus.mkdir(parents=True, exist_ok=True)
                is_fine &= fuzz(name, layout, options.seconds // len(chosen), corpus)
    return int(not is_fine)


if __name__ == "__main__":
    sys.exit(main())
