#!/usr/bin/env python3
"""Coverage-guided fuzzing of what reads other people's bytes; the corpus is kept.

    fuzz.py decoder --seconds 600   frames into a receiver's state
    fuzz.py logs --seconds 600      log files of all formats
    fuzz.py dbc --seconds 600       the text of a DBC
    fuzz.py TARGET --seconds 0      only try the corpus again

What a target raises is a defect, and so is a broken promise (see fuzz_targets.py); each is kept
once in --work, by its place, and the fuzzer goes on. At the end what reaches the same lines and
branches with the fewest bytes is kept in tests/corpus/TARGET, where the ordinary tests try it
again, without the fuzzer.

Needs atheris, of Google: pip install atheris (wheels for CPython 3.11 to 3.13 on Linux).
Run it in the project's environment: python3 tools/run.py python tools/fuzz.py ...

Ends with a nonzero status where there is a defect.
"""

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
from pathlib import Path

from reporting import parser_of

CORPUS = Path(__file__).resolve().parents[1] / "tests" / "corpus"
TARGETS = ("decoder", "logs", "dbc")
#: Modules whose branches guide the fuzzer, and those whose lines decide what is kept.
GUIDES = ("maplines_can", "can.io", "cantools.database", "textparser", "fuzz_targets")
KEPT = ("/maplines_can/", "/can/io/", "/cantools/database/can/")
#: Most that is kept of a target: files, bytes.
MOST_FILES, MOST_BYTES = 190, 290_000
#: Longest that one input may take [s].
PATIENCE = 20
#: Longest that a process fuzzes [s]: atheris itself leaks, 40 kB with each input of the decoder.
SLICE = 300


def main():
    parser = parser_of(__doc__)
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--seconds", type=int, default=600, help="how long to fuzz [s]")
    parser.add_argument("--work", type=Path, help="where all goes; a new folder in /tmp")
    parser.add_argument("--seed", type=int, default=0, help="of the fuzzer; 0: another each time")
    parser.add_argument("--keep", action="store_true", help="leave tests/corpus as it is")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    work = arguments.work or Path(tempfile.mkdtemp(prefix=f"fuzz-{arguments.target}-"))
    logging.disable()  # python-can tells of each odd line
    if arguments.worker:
        return fuzz(arguments.target, arguments.seconds, arguments.seed, work)
    inputs, kept = work / "inputs", CORPUS / arguments.target
    for folder in (inputs, work / "defects", kept):
        folder.mkdir(parents=True, exist_ok=True)
    figures = {"target": arguments.target, "executions": 0}
    if arguments.seconds > 0:
        figures |= fuzzed(arguments, work)
    figures |= tried(arguments.target, [inputs, kept], work / "defects")
    if arguments.seconds > 0 and not arguments.keep:
        figures |= minimized(arguments.target, [inputs, kept], kept)
    figures["defects"] = sorted(path.name for path in (work / "defects").glob("*.txt"))
    print(json.dumps(figures, indent=2))
    print(f"inputs and defects: {work}", file=sys.stderr)
    return int(bool(figures["defects"]))


# ---- the fuzzer: a process of its own, since it ends as it likes --------------------------


def fuzzed(arguments, work):
    """Run the fuzzer, slice by slice; what it says of itself."""
    start = time.monotonic()
    executions, reached = 0, (0, 0, 0)
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
        so_far, *figures = map(int, last[-1]) if last else (0, 0, 0, 0)
        executions += int(done[-1]) if done else so_far
        reached = max(reached, tuple(figures))
        if status and not done:  # it took too long or too much memory
            print(text[-2000:], file=sys.stderr)
            (work / "defects" / f"ended-{number}.txt").write_text(text[-20_000:])
    cov, features, corpus = reached
    return {
        "seconds": round(time.monotonic() - start),
        "executions": executions,
        "branches (cov)": cov,
        "features (ft)": features,
        "inputs": corpus,
    }


def fuzz(target, seconds, seed, work):
    import atheris

    with atheris.instrument_imports(include=list(GUIDES)):
        import fuzz_targets
    for number, content in enumerate(fuzz_targets.SEEDS[target]()):
        (work / "inputs" / f"seed-{number}").write_bytes(content)
    attempt = guarded(fuzz_targets.TARGETS[target], work / "defects")
    mutate = fuzz_targets.MUTATORS.get(target)
    most = fuzz_targets.MOST[target]

    def mutator(data, max_size, seed):
        if mutate is None or seed % 3 == 0:
            return atheris.Mutate(data, max_size)
        return mutate(data, seed)[:max_size]

    options = [f"-max_total_time={seconds}", f"-max_len={most}", f"-timeout={PATIENCE}"]
    options += ["-rss_limit_mb=3000", "-len_control=20", f"-artifact_prefix={work}/defects/"]
    options += [f"-seed={seed}"] if seed else []
    folders = [str(work / "inputs"), str(CORPUS / target)]
    setup = {} if mutate is None else {"custom_mutator": mutator}
    atheris.Setup([sys.argv[0], *options, *folders], attempt, **setup)
    atheris.Fuzz()
    return 0


def guarded(run, defects):
    """The target; what it raises is kept once for each place, with the input."""
    seen = set()
    warnings.simplefilter("error")
    warnings.filterwarnings("ignore", category=ResourceWarning)

    def attempt(data):
        try:
            run(bytes(data))
        except Exception as error:  # noqa: BLE001 - whatever it is
            places = traceback.extract_tb(error.__traceback__)
            frames = [f for f in places if f.filename != __file__ and f.name != "must"]
            ours = [f for f in frames if "maplines_can" in f.filename] or frames
            key = f"{type(error).__name__}-{Path(ours[-1].filename).stem}-{ours[-1].lineno}"
            if key not in seen:
                seen.add(key)
                (defects / f"{key}.bin").write_bytes(data)
                (defects / f"{key}.txt").write_text(traceback.format_exc())
                print(f"\nDEFECT {key}: {error}", file=sys.stderr, flush=True)

    return attempt


# ---- the corpus ---------------------------------------------------------------------------


def contents(folders):
    """Different inputs, the shortest first."""
    found = {path.read_bytes() for folder in folders for path in folder.iterdir() if path.is_file()}
    return sorted(found, key=lambda content: (len(content), content))


def tried(target, folders, defects):
    """Try all inputs once more."""
    import fuzz_targets

    attempt = guarded(fuzz_targets.TARGETS[target], defects)
    start, inputs = time.monotonic(), contents(folders)
    for content in inputs:
        attempt(content)
    return {"corpus tried again": len(inputs), "in [s]": round(time.monotonic() - start, 1)}


def reached(run, content):
    """Steps from line to line through the modules in KEPT, and how often (1, 2, 4, 8, 16)."""
    steps, wanted = Counter(), {}

    def enter(frame, event, argument):  # noqa: ARG001
        name = frame.f_code.co_filename
        if name not in wanted:
            wanted[name] = any(part in name.replace("\\", "/") for part in KEPT)
        if not wanted[name]:
            return None
        last = [0]

        def line(frame, event, argument):  # noqa: ARG001
            if event == "line":
                steps[name, last[0], frame.f_lineno] += 1
                last[0] = frame.f_lineno
            return line

        return line

    sys.settrace(enter)
    try:
        run(content)
    except Exception:  # noqa: BLE001 - told by then
        return set()
    finally:
        sys.settrace(None)
    return {(*step, min(n.bit_length(), 5)) for step, n in steps.items()}


def minimized(target, folders, kept):
    """Keep the shortest inputs that together reach all; those that reach most first."""
    import fuzz_targets

    run = fuzz_targets.TARGETS[target]
    inputs = contents(folders)
    run(inputs[-1])  # what happens only once happens now
    steps = {content: reached(run, content) for content in inputs}
    wanted, chosen = set().union(*steps.values()), []
    number, missing = len(wanted), set(wanted)
    while missing:
        best = max(steps, key=lambda c: (len(steps[c] & missing) / (40 + len(c)), -len(c), c))
        gain = steps.pop(best) & missing
        total = sum(map(len, chosen)) + len(best)
        if not gain:
            break
        if len(chosen) < MOST_FILES and total <= MOST_BYTES:
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
        "steps reached by all": number,
        "by what is kept": number - len(missing),
    }


if __name__ == "__main__":
    random.seed(0)
    sys.exit(main())
