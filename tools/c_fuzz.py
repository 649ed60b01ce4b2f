#!/usr/bin/env python3
"""Fuzz the C core with libFuzzer and the sanitizers of clang.

    c_fuzz.py --seconds 3600                     both targets, the project's DBCs, 10 minutes each
    c_fuzz.py --target encoder                   a sender of any numbers, and its receiver
    c_fuzz.py --target frames                    a receiver of frames and times in any order
    c_fuzz.py --dbc maplines.dbc --dbc random7   only these DBCs, one of them random
    c_fuzz.py --seconds 3600 --random 60         random DBCs, half a minute for each target
    c_fuzz.py --seconds 60 --corpus DIR          keep what takes new paths, and begin with it
    c_fuzz.py --replay 100000 --seed 1           random inputs without clang, as fast as possible

From random1000 on, DBCs are at the limits of the core. MAPLINES_CFLAGS=-DMAPLINES_FLOAT fuzzes a
receiver in single precision (--target frames).

An input that breaks a promise is written to crash-..., and the exit status is 1. Run it in the
environment of the project: python3 tools/run.py python tools/c_fuzz.py
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from random_dbc import random_dbc
from reporting import parser_of

from maplines_can.wire import default_dbc_path
from maplines_can.wire.layout.message_layout import Layout

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))
from support import c_core  # noqa: E402

TARGETS = ("frames", "encoder")
PROJECT = ("maplines.dbc", "maplines-secoc.dbc", "maplines-pose.dbc", "maplines-scene.dbc")
SANITIZERS = ("-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all")
#: With clang also conversions of numbers out of range, which gcc does not check with the others.
CLANG = ("-DFUZZER", "-fsanitize=fuzzer,float-cast-overflow")
#: Longest input [byte].
MAX_LENGTH = 4096


def layout_of(name: str) -> Layout:
    """Return the layout of a DBC of the project, of a random one, or of a file."""
    if found := re.fullmatch(r"random(\d+)", name):
        return Layout.from_text(random_dbc(int(found[1])), f"{name}.dbc")
    return Layout.from_dbc(default_dbc_path(name) if name in PROJECT else Path(name))


def program(target: str, layout: Layout, cc: str, flags: Sequence[str]) -> Path:
    """Return the program of a target with a DBC."""
    main = ROOT / "c" / "tests" / f"fuzz_{target}.c"
    return c_core.program([main], [layout], [c_core.NAME], cc=cc, flags=(*SANITIZERS, *flags))


def fuzz(target: str, name: str, layout: Layout, seconds: int, corpus: Path) -> bool:
    """Fuzz a target with one DBC; return whether nothing was found."""
    command = [str(program(target, layout, "clang", CLANG)), f"-max_total_time={seconds}",
               f"-max_len={MAX_LENGTH}", "-print_final_stats=1", "-verbosity=1",
               str(corpus)]  # fmt: skip
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    runs = re.search(r"number_of_executed_units: (\d+)", done.stderr)
    covered = re.findall(r"cov: (\d+)", done.stderr)
    numbers = f"{runs[1] if runs else 0} inputs, {covered[-1] if covered else 0} edges"
    found = "FOUND" if done.returncode else "nothing found"
    print(f"{target}, {name}: {numbers} in {seconds} s, {found}", flush=True)
    if done.returncode:
        lines = [line for line in done.stderr.splitlines() if not line.startswith(("#", "INFO"))]
        print("\n".join(lines)[:4000])
    return not done.returncode


def replay(target: str, name: str, layout: Layout, count: int, seed: int, cc: str) -> bool:
    """Draw inputs at random; return whether nothing was found."""
    command = [str(program(target, layout, cc, [])), str(count), str(seed)]
    status = subprocess.run(command, check=False).returncode
    print(f"{target}, {name}: {count} inputs, status {status}", flush=True)
    return status == 0


def main() -> int:
    """Fuzz; return the exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("--seconds", type=int, default=60, help="in all [s] (default: 60)")
    parser.add_argument("--target", action="append", choices=TARGETS, help="(default: both)")
    parser.add_argument(
        "--dbc", action="append", metavar="NAME", help="DBC: of the project, a file, or as random3"
    )
    parser.add_argument("--random", type=int, default=0, help="fuzz this many random DBCs")
    parser.add_argument(
        "--corpus", type=Path, help="folder of inputs (default: one that is removed)"
    )
    parser.add_argument("--replay", type=int, metavar="N", help="N random inputs of each DBC")
    parser.add_argument("--seed", type=int, default=0, help="of --replay (default: 0)")
    parser.add_argument("--cc", default="cc", help="compiler of --replay (default: cc)")
    options = parser.parse_args()
    randoms = [f"random{seed}" for seed in range(options.random)]
    names = [*(options.dbc or ([] if randoms else PROJECT)), *randoms]
    runs = [
        (target, name, layout_of(name)) for name in names for target in options.target or TARGETS
    ]
    is_fine = True
    with tempfile.TemporaryDirectory() as folder:
        for target, name, layout in runs:
            if options.replay is not None:
                is_fine &= replay(target, name, layout, options.replay, options.seed, options.cc)
                continue
            corpus = (options.corpus or Path(folder)) / f"{target}-{Path(name).stem}"
            corpus.mkdir(parents=True, exist_ok=True)
            is_fine &= fuzz(target, name, layout, options.seconds // len(runs), corpus)
    return int(not is_fine)


if __name__ == "__main__":
    sys.exit(main())
