#!/usr/bin/env python3
"""Fuzz the parsers of external input, guided by coverage, and update the corpus.

    fuzz.py decoder --seconds 600   frames into the state of a receiver
    fuzz.py scenes --seconds 600    pose errors and lines that belong to them
    fuzz.py whole-scenes            whole scenes
    fuzz.py logs --seconds 600      log files of all formats
    fuzz.py dbc --seconds 600       the text of a DBC
    fuzz.py TARGET --seconds 0      only replay the corpus

An exception from a target is a defect, and so is a broken invariant (see fuzz_targets.py). The
first input that raises at a place in the code is saved in --work; the fuzzer continues. At the
end the smallest set of inputs with the same coverage of lines and branches is saved in
tests/corpus/TARGET. The tests replay it without the fuzzer.

This needs atheris: pip install atheris (wheels for CPython 3.11 to 3.13 on Linux).
Run it in the environment of the project: python3 tools/run.py python tools/fuzz.py ...

The exit status is 1 if there is a defect.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import logging
import random
import re
import subprocess
import sys
import tempfile
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from types import FrameType
from typing import Any

from reporting import parser_of

CORPUS = Path(__file__).resolve().parents[1] / "tests" / "corpus"
TARGETS = ("decoder", "scenes", "whole-scenes", "logs", "dbc")
#: Modules whose branches guide the fuzzer.
INSTRUMENTED = (
    "maplines_can",
    "can.io",
    "cantools.database",
    "textparser",
    "fuzz_targets",
    "fuzz_scenes",
)
#: Folders whose lines count in the choice of the corpus.
COVERED = ("/maplines_can/", "/can/io/", "/cantools/database/can/")
#: Largest corpus of a target: files, bytes.
MAX_FILES, MAX_BYTES = 190, 290_000
#: Time limit of one input [s].
INPUT_TIMEOUT = 20
#: Time limit of one process [s]: atheris leaks 40 kB with each input of the decoder.
SLICE = 300

Target = Callable[[bytes], Any]


def main() -> int:
    """Run the command and return its exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--seconds", type=int, default=600, help="how long to fuzz [s]")
    parser.add_argument(
        "--work", type=Path, help="folder of all output; by default a new temporary one"
    )
    parser.add_argument(
        "--seed", type=int, default=0, help="seed of the fuzzer; 0: a new one each time"
    )
    parser.add_argument("--keep", action="store_true", help="leave tests/corpus unchanged")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    work = arguments.work or Path(tempfile.mkdtemp(prefix=f"fuzz-{arguments.target}-"))
    logging.disable()  # python-can logs each line it cannot parse
    if arguments.worker:
        return fuzz(arguments.target, arguments.seconds, arguments.seed, work)
    inputs, kept = work / "inputs", CORPUS / arguments.target
    for folder in (inputs, work / "defects", kept):
        folder.mkdir(parents=True, exist_ok=True)
    figures: dict[str, Any] = {"target": arguments.target, "executions": 0}
    if arguments.seconds > 0:
        figures |= run_fuzzer(arguments, work)
    figures |= replay(arguments.target, [inputs, kept], work / "defects")
    if arguments.seconds > 0 and not arguments.keep:
        figures |= minimize(arguments.target, [inputs, kept], kept)
    figures["defects"] = sorted(path.name for path in (work / "defects").glob("*.txt"))
    print(json.dumps(figures, indent=2))
    print(f"inputs and defects: {work}", file=sys.stderr)
    return int(bool(figures["defects"]))


# ---- the fuzzer: a process of its own, because it ends its process itself ------------------


def run_fuzzer(arguments: argparse.Namespace, work: Path) -> dict[str, int]:
    """Run the fuzzer, slice by slice, and return its statistics."""
    start = time.monotonic()
    executions, best = 0, (0, 0, 0)
    for number in range(-(-arguments.seconds // SLICE)):
        seconds = min(SLICE, arguments.seconds - number * SLICE)
        seed = arguments.seed + number if arguments.seed else 0
        command = [sys.executable, __file__, arguments.target, "--worker", "--work", str(work)]
        command += ["--seconds", str(seconds), "--seed", str(seed)]
        log = work / f"fuzzer-{number}.log"
        with log.open("w") as file:
            status = subprocess.run(command, stderr=file, check=False).returncode
        text = log.read_text(errors="replace")
        last = re.findall(r"#(\d+)\s+\w+\s+cov: (\d+) ft: (\d+) corp: (\d+)/", text)
        done = re.findall(r"Done (\d+) runs", text)
        so_far, cov, features, inputs = map(int, last[-1]) if last else (0, 0, 0, 0)
        executions += int(done[-1]) if done else so_far
        best = max(best, (cov, features, inputs))
        if status and not done:  # it exceeded a limit of time or memory
            print(text[-2000:], file=sys.stderr)
            (work / "defects" / f"ended-{number}.txt").write_text(text[-20_000:])
    cov, features, inputs = best
    return {
        "seconds": round(time.monotonic() - start),
        "executions": executions,
        "branches (cov)": cov,
        "features (ft)": features,
        "inputs": inputs,
    }


def fuzz(target: str, seconds: int, seed: int, work: Path) -> int:
    """Fuzz a target in this process, which atheris ends."""
    import atheris

    with atheris.instrument_imports(include=list(INSTRUMENTED)):
        import fuzz_inputs
        import fuzz_scenes
    for number, content in enumerate(fuzz_inputs.SEEDS.get(target, tuple)()):
        (work / "inputs" / f"seed-{number}").write_bytes(content)
    attempt = guarded(fuzz_scenes.ALL_TARGETS[target], work / "defects")
    mutate = fuzz_inputs.MUTATORS.get(target)
    most = fuzz_inputs.MOST[target]

    def mutator(data: bytes, max_size: int, seed: int) -> bytes:
        if mutate is None or seed % 3 == 0:
            return bytes(atheris.Mutate(data, max_size))
        return mutate(data, seed)[:max_size]

    options = [f"-max_total_time={seconds}", f"-max_len={most}", f"-timeout={INPUT_TIMEOUT}"]
    options += ["-rss_limit_mb=3000", "-len_control=20", f"-artifact_prefix={work}/defects/"]
    options += [f"-seed={seed}"] if seed else []
    folders = [str(work / "inputs"), str(CORPUS / target)]
    setup = {} if mutate is None else {"custom_mutator": mutator}
    atheris.Setup([sys.argv[0], *options, *folders], attempt, **setup)
    atheris.Fuzz()
    return 0


def guarded(run: Target, defects: Path) -> Callable[[bytes], None]:
    """Return the target with its exceptions saved, once for each place, with the input."""
    seen = set()
    warnings.simplefilter("error")
    warnings.filterwarnings("ignore", category=ResourceWarning)

    def attempt(data: bytes) -> None:
        try:
            run(bytes(data))
        except Exception as error:  # noqa: BLE001 - any exception is a defect
            places = traceback.extract_tb(error.__traceback__)
            frames = [f for f in places if f.filename != __file__ and f.name != "require"]
            ours = [f for f in frames if "maplines_can" in f.filename] or frames
            key = f"{type(error).__name__}-{Path(ours[-1].filename).stem}-{ours[-1].lineno}"
            if key not in seen:
                seen.add(key)
                (defects / f"{key}.bin").write_bytes(data)
                (defects / f"{key}.txt").write_text(traceback.format_exc())
                print(f"\nDEFECT {key}: {error}", file=sys.stderr, flush=True)

    return attempt


# ---- the corpus ---------------------------------------------------------------------------


def contents(folders: Iterable[Path]) -> list[bytes]:
    """Return the distinct inputs, the shortest first."""
    found = {path.read_bytes() for folder in folders for path in folder.iterdir() if path.is_file()}
    return sorted(found, key=lambda content: (len(content), content))


def replay(target: str, folders: Iterable[Path], defects: Path) -> dict[str, float]:
    """Run the target once with each input."""
    import fuzz_scenes

    attempt = guarded(fuzz_scenes.ALL_TARGETS[target], defects)
    start, inputs = time.monotonic(), contents(folders)
    for content in inputs:
        attempt(content)
    return {"inputs replayed": len(inputs), "in [s]": round(time.monotonic() - start, 1)}


def coverage_of(run: Target, content: bytes) -> set[tuple[Any, ...]]:
    """Return the steps between lines in COVERED, with binned counts (1, 2, 4, 8, 16)."""
    steps = Counter[tuple[str, int, int]]()
    wanted: dict[str, bool] = {}

    def enter(frame: FrameType, event: str, argument: Any) -> Any:  # noqa: ARG001
        name = frame.f_code.co_filename
        if name not in wanted:
            wanted[name] = any(folder in name.replace("\\", "/") for folder in COVERED)
        if not wanted[name]:
            return None
        last = [0]

        def line(frame: FrameType, event: str, argument: Any) -> Any:  # noqa: ARG001
            if event == "line":
                steps[name, last[0], frame.f_lineno] += 1
                last[0] = frame.f_lineno
            return line

        return line

    sys.settrace(enter)
    try:
        run(content)
    except Exception:  # noqa: BLE001 - replay has saved it
        return set()
    finally:
        sys.settrace(None)
    return {(*step, min(n.bit_length(), 5)) for step, n in steps.items()}


def minimize(target: str, folders: Iterable[Path], kept: Path) -> dict[str, int]:
    """Replace the corpus by a small set of inputs with the same coverage.

    The choice is greedy: most new steps per byte first.
    """
    import fuzz_scenes

    run = fuzz_scenes.ALL_TARGETS[target]
    inputs = contents(folders)
    run(inputs[-1])  # initialization that happens only once must not count
    steps = {content: coverage_of(run, content) for content in inputs}
    missing: set[tuple[Any, ...]] = set().union(*steps.values())
    number, chosen = len(missing), list[bytes]()
    while missing:
        best = max(steps, key=lambda c: (len(steps[c] & missing) / (40 + len(c)), -len(c), c))
        gain = steps.pop(best) & missing
        total = sum(map(len, chosen)) + len(best)
        if not gain:
            break
        if len(chosen) < MAX_FILES and total <= MAX_BYTES:
            chosen.append(best)
            missing -= gain
    for path in kept.iterdir():
        path.unlink()
    for content in chosen:
        name = hashlib.sha256(content).hexdigest()[:16]
        (kept / name).write_bytes(content)
    return {
        "kept files": len(chosen),
        "kept bytes": sum(map(len, chosen)),
        "steps covered by all inputs": number,
        "steps covered by kept files": number - len(missing),
    }


if __name__ == "__main__":
    random.seed(0)
    sys.exit(main())
