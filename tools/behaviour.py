#!/usr/bin/env python3
"""Record the observable behaviour of this checkout, and compare two recordings.

    behaviour.py record DIR     run all commands, the corpora, the wire and the propagation
    behaviour.py record DIR wire command-drive    only the parts whose names begin so
    behaviour.py compare A B    print the parts that differ; the exit status is 1 if any does

Run it in the environment of the project: python3 tools/run.py python tools/behaviour.py ...

A recording is a folder of text files, one for each part. It has outputs, exit statuses and files of
the commands, and payloads, decoded values as hexadecimal floats, reasons and counters of the API.
Two recordings of one checkout on one machine are equal. What depends on the clock is masked.
"""

from __future__ import annotations

import fnmatch
import hashlib
import os
import re
import shlex
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from functools import partial
from itertools import count, zip_longest
from pathlib import Path

import can

ROOT = Path(__file__).resolve().parents[1]
NOW_NS = 1_750_000_000_000_000_000  # what time.time_ns says in a recorded command
FEED, TAP = "feed", "tap"  # virtual channels: one that a log is sent to, one that is recorded

#: Commands by name, in their order: later ones read files of earlier ones.
COMMANDS = """
help: --help
version: --version
scenarios: scenarios
scenarios-json: scenarios --json
map: map
map-json: map --json
map-plot: map --plot town.png
map-csv: map lines.csv
drive: drive --as-fast-as-possible --seconds 20 --record d.log --truth d.csv
drive-json: drive --as-fast-as-possible --seconds 3 --lines 8 --record j.blf --json --seed 3
drive-truth: drive town.xodr --as-fast-as-possible --seconds 2 --truth t.parquet
drive-map-error: drive --as-fast-as-possible --seconds 3 --map-error 0.1 --record m.asc
drive-pose: drive --as-fast-as-possible --seconds 5 --lines 4 --dbc maplines-pose.dbc --record p.log
drive-whole: drive --as-fast-as-possible --seconds 5 --lines 8 --dbc maplines-scene.dbc \
--faults loss=0.1,seed=2 --record w.log
drive-pose-error: drive --as-fast-as-possible --seconds 3 --pose-error --record e.log --json
drive-mixtures: drive --as-fast-as-possible --seconds 3 --components 3 --record x.log --json
drive-auto: drive --as-fast-as-possible --seconds 3 --components auto --sigma 1,1,5 --record a.log
drive-keys: drive --as-fast-as-possible --seconds 3 --key-file key --record k.log
drive-fd: drive --as-fast-as-possible --seconds 3 --fd --rate 50 --record f.log
drive-faults: drive --as-fast-as-possible --seconds 6 --pose-error --faults \
loss=0.1,dup=0.1,reorder=0.1,corrupt=0.05,garbage=0.05,late=0.1,seed=5 --record bad.log
drive-mild: drive --as-fast-as-possible --seconds 8 --pose-error --faults \
loss=0.002,dup=0.01,corrupt=0.002,late=0.02,seed=5 --record mild.log --map-error 0.05
drive-short: drive --as-fast-as-possible --seconds 2 --window -10 30 --max-sigma 0.5 --json
drive-route: drive --as-fast-as-possible --route 1:0:-1..1:0:-1 --sigma 0,0,0 --record r.log
drive-recorded: drive --drive d.csv --as-fast-as-possible --seconds 3 --record rec.log --json
drive-localised: drive --localise --as-fast-as-possible --seconds 10 --lines 2 \
--dbc maplines-pose.dbc --record loc.log --truth loc.csv
decode: decode d.log
decode-csv: decode d.log --csv
decode-blf: decode j.blf
decode-asc: decode m.asc --csv
decode-mixtures: decode x.log
decode-auto: decode a.log --csv
decode-keys: decode k.log --key-file key
decode-no-keys: decode k.log
decode-fd: decode f.log --cycle-ms 20 --transfer-timeout 10
decode-scenes: decode p.log --dbc maplines-pose.dbc --scenes
decode-whole: decode w.log --dbc maplines-scene.dbc --scenes
decode-pose: decode p.log --dbc maplines-pose.dbc --csv
decode-pose-error: decode e.log --scenes
decode-faults: decode bad.log --scenes
decode-pipe: decode -
info: info d.log w.log k.log bad.log
info-json: info --json p.log f.log
diff: diff d.log j.blf --at 0,20
diff-json: diff p.log p.log --dbc maplines-pose.dbc --json
accuracy: accuracy d.csv d.log
accuracy-json: accuracy loc.csv loc.log --dbc maplines-pose.dbc --json
accuracy-plot: accuracy d.csv d.log --plot accuracy.png
fusion: consume fusion loc.log --dbc maplines-pose.dbc --motion loc.csv --every 0.5 --json
fusion-camera: consume fusion p.log --dbc maplines-pose.dbc --speed 10 --camera camera.csv
fusion-simulated: consume fusion --simulate --seconds 6 --seed 2
steer: consume steer p.log --dbc maplines-pose.dbc --every 0.2
steer-json: consume steer mild.log --set-speed 30 --json
check: consume check loc.log --dbc maplines-pose.dbc --simulate --shift 0.5 --motion loc.csv
check-camera: consume check p.log --dbc maplines-pose.dbc --camera camera.csv --speed 10 --json
check-white: consume check mild.log --simulate --noise-time 0 --gaussian-noise --pose-time 0
demo: demo --seconds 0.3
demo-json: demo --seconds 0.3 --scenario street-turn --components 4 --fd --json
demo-pose: demo --seconds 0.3 --dbc maplines-pose.dbc --map-error 0.05 --plot demo.png
demo-keys: demo --seconds 0.3 --key-file key --lines 8
send: send --interface virtual --channel tap --count 4 --standstill
send-mixtures: send --interface virtual --channel tap --count 3 --standstill --components auto
decode-send: decode taps/send.log
decode-send-mixtures: decode taps/send-mixtures.log
send-scenes: send --interface virtual --channel tap --count 4 --standstill --json --lines 6 \
--dbc maplines-pose.dbc --correlation-time 5 --scenario roundabout-12m
decode-send-scenes: decode taps/send-scenes.log --dbc maplines-pose.dbc --scenes
replay: replay d.log --interface virtual --channel tap --as-fast-as-possible --time 0..5 --json
decode-replay: decode taps/replay.log
receive: receive --interface virtual --channel feed --timeout 3
receive-scenes: receive --interface virtual --channel feed --timeout 3 --json --scenes
production: study production --n 100
production-markdown: study production --n 100 --markdown
sweep: study run --out sweep --n 200 --scenes 2 --jobs 1 --code Cholesky --code LogCholesky
sweep-all: study run --out all --n 20 --scenes 1 --jobs 1 --set adversarial --finer 0 --json
report: study report sweep --out report.html
claims: claims --samples 1000
claims-csv: claims --samples 1000 --scenario street-turn-10deg --format csv --seed 3
figures: figures --samples 1000 --out figures
design: design --n 100 --frames 3 --set road --out short.dbc
design-json: design --n 100 --max-kl 1e-2 --set both --keep-mean --out lean.dbc --json
design-scenes: design --scenes --n 10 --out lean-pose.dbc
demo-short: demo --dbc short.dbc --seconds 0.3 --json
drive-short-dbc: drive --as-fast-as-possible --seconds 2 --dbc short.dbc --record s.log
decode-short-dbc: decode s.log --dbc short.dbc
wrong-nothing:
wrong-command: fly
wrong-option: demo --lines 9
wrong-scenario: demo --scenario moon
wrong-file: decode nothing.log
wrong-log: decode lines.csv
wrong-dbc: demo --dbc lines.csv
wrong-exists: drive --as-fast-as-possible --seconds 1 --record d.log
wrong-map: map nothing.xodr
wrong-route: drive --route 1..999999 --as-fast-as-possible --json
wrong-scenes: decode d.log --scenes --dbc maplines-secoc.dbc --csv
wrong-key: decode k.log --key-file camera.csv
wrong-faults: demo --faults loss=2
wrong-set: study run --out wrong --set nothing.npz
wrong-mixtures: drive --as-fast-as-possible --components 3 --pose-error
wrong-camera: consume check p.log --dbc maplines-pose.dbc --camera lines.csv
wrong-steer: consume steer d.log
wrong-loss: consume steer bad.log
"""
#: Commands whose --help is recorded.
HELP = """demo send receive decode info diff replay view map drive consume scenarios design accuracy
claims figures study study:run study:report study:production consume:fusion consume:steer
consume:check""".split()  # noqa: SIM905
#: Standard input and the log on the channel "feed", by command.
STDIN = {"decode-pipe": "d.log"}
FED = {"receive": "a.log", "receive-scenes": "e.log"}
#: What depends on the clock or the load of the machine: in all outputs, and by command.
MASKS = (
    (r'"(cpu|ms_per_cycle|core_share)": [-\d.e]+', r'"\1": CLOCK'),
    (r"(?m)^(CPU +)[\d.]+ ms a cycle, [\d.]+ %", r"\1CLOCK"),
    (r"[0-9a-f]{8}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{4}-[0-9a-f]{12}", "UUID"),
)
LIVE_MASKS = {
    "demo": (
        (r"(?m)^(\d+ lines over .*Hz), [\d.]+ s", r"\1, CLOCK"),
        (r"(?m)^(sent  |received  |lost|bus load|period|CPU|pose errors)(.*)$", r"\1 CLOCK"),
        (r'"seconds": [\d.]+', '"seconds": CLOCK'),
        (r'(?s)"sent": \{.*"components"', '"components"'),
    ),
    "decode-send": ((r'"(t|age)": [-\d.e+]+', r'"\1": CLOCK'),),
    "send": (
        (r"(?m)^late by.*|\d+ periods skipped", "CLOCK"),
        (r'"(lateness": \{[^}]*\}|overruns": \d+)', "CLOCK"),
    ),
    "replay": ((r'"seconds": [\d.]+', '"seconds": CLOCK'),),
    "receive": (
        (r', "e2e": \{[^}]*\}', ""),
        (r'(?m)^\{"t": [\d.]+, "scene".*\n', ""),
        (r"(?s)\A.*?(?=maplines: \d+ lines)", ""),  # changes of states, until the totals
        (r"(?m)^(maplines: .*: ).*(; \d+ ok.*, )\d+( cycles without data)", r"\1CLOCK\2CLOCK\3"),
    ),
}


# ---- commands ----------------------------------------------------------------------------


def commands() -> dict[str, list[str]]:
    """Return the arguments of each command by its name."""
    rows = [row.partition(":") for row in COMMANDS.strip().splitlines()]
    helps = {f"help-{name}": [*name.split(":"), "--help"] for name in HELP}
    return helps | {name: shlex.split(arguments) for name, _, arguments in rows}


def prepare(folder: Path) -> None:
    """Write the files that commands read."""
    (folder / "key").write_text(bytes(range(16)).hex() + "\n")
    (folder / "key").chmod(0o600)
    (folder / "matplotlibrc").write_text("svg.hashsalt: 1\n")
    (folder / "lines.csv").write_text("line,x,y\n" + "".join(f"a,{x},1\n" for x in range(50)))
    rows = ["t,slot,y_off,beta,c0,c1,sigma_y_off,sigma_beta,sigma_c0,sigma_c1"]
    for i in range(100):
        t = NOW_NS / 1e9 + 0.05 * i
        rows += [f"{t!r},EGO_{s},{y},0,0,0,.05,.005,.0005,.00001" for s, y in
                 (("LEFT", 1.6), ("RIGHT", -1.6))]  # fmt: skip
    (folder / "camera.csv").write_text("\n".join(rows) + "\n")
    (folder / "camera.csv").chmod(0o600)


def run_command(name: str, arguments: list[str], folder: Path) -> str:
    """Run a command in a process of its own; return what is to be seen of it."""
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    settings = {"OPENBLAS_NUM_THREADS": "1", "COLUMNS": "100", "SOURCE_DATE_EPOCH": "0"}
    stdin = (folder / STDIN[name]).read_bytes() if name in STDIN else b""
    done = subprocess.run(
        [sys.executable, __file__, "child", name, *arguments],
        cwd=folder, input=stdin, capture_output=True, check=False, env=os.environ | settings,
    )  # fmt: skip
    masks = [*MASKS, *(mask for live, own in LIVE_MASKS.items() if matches(name, [live])
                       for mask in own)]  # fmt: skip
    text = f"$ maplines {shlex.join(arguments)}\nstatus {done.returncode}\n"
    for title, stream in (("stdout", done.stdout), ("stderr", done.stderr)):
        shown = stream.decode().replace(str(folder), "WORK").replace(str(ROOT), "ROOT")
        shown = shown[shown.rfind("\r") + 1 :] if title == "stderr" and "\r" in shown else shown
        for pattern, replacement in masks:
            shown = re.sub(pattern, replacement, shown)
        text += f"---- {title}\n{shown}"
    for path in sorted(folder.rglob("*")):
        if (
            path.is_file()
            and path.parent.name != "taps"
            and before.get(path) != path.stat().st_mtime_ns
        ):
            text += f"---- {path.relative_to(folder)}\n{file_text(path)}\n"
    return text


def file_text(path: Path) -> str:
    """Return the content of a file as text, without times of its making; or its hash."""
    if path.suffix in (".blf", ".asc"):
        return "\n".join(f"{m.timestamp:.4f} {m.arbitration_id:X} {m.data.hex()}"
                         for m in can.LogReader(path))  # fmt: skip
    if path.suffix == ".parquet":
        from pyarrow import parquet

        columns = parquet.read_table(path).to_pydict()
        return "\n".join(f"{name}: {values!r}" for name, values in columns.items())
    if path.suffix == ".png":
        from matplotlib.image import imread

        return hashlib.sha256(imread(path).tobytes()).hexdigest()
    text = path.read_bytes().decode(errors="replace")
    for pattern, replacement in MASKS:
        text = re.sub(pattern, replacement, text)
    is_long = path.suffix in (".svg", ".html")
    return hashlib.sha256(text.encode()).hexdigest() if is_long else text


def child(name: str, arguments: list[str]) -> int:
    """Run a command in this process, with a fixed date; feed and record its virtual buses."""
    from maplines_can.cli import main

    ticks = count()
    time.time_ns = lambda: NOW_NS
    time.perf_counter = lambda: 1e-3 * next(ticks)
    taps = [can.Bus(interface="virtual", channel=TAP)] if TAP in arguments else []
    if name in FED:
        threading.Thread(target=feed, args=(FED[name],), daemon=True).start()
    sys.argv[0] = "maplines"
    try:
        return main(arguments)
    finally:
        for tap in taps:
            write_tap(tap, Path("taps") / f"{name}.log")


def write_tap(tap: can.BusABC, path: Path) -> None:
    """Write the frames that a channel has received as a log; ages are in it, so it is not shown."""
    path.parent.mkdir(exist_ok=True)
    frames = [f"{m.arbitration_id:X}#{m.data.hex()}" for m in iter(partial(tap.recv, 0), None)]
    rows = [f"({NOW_NS // 10**9}.{i:03}000) can0 {frame}\n" for i, frame in enumerate(frames)]
    path.write_text("".join(rows))
    tap.shutdown()


def feed(log: str) -> None:
    """Send the frames of a log to the channel, as soon as somebody listens."""
    from can.interfaces import virtual

    with can.Bus(interface="virtual", channel=FEED, preserve_timestamps=True) as bus:
        while len(virtual.channels[FEED]) < 2:
            time.sleep(0.01)
        for message in can.LogReader(log):
            bus.send(message)
            time.sleep(0.002)  # the receiver keeps a limited number of lines
        time.sleep(30)


# ---- recordings --------------------------------------------------------------------------


def parts(patterns: list[str]) -> Iterator[tuple[str, str]]:
    """Yield the parts of a recording, name and text; commands need those before them."""
    every = [(f"command-{name}", name, arguments) for name, arguments in commands().items()]
    last = max((i for i, row in enumerate(every) if matches(row[0], patterns)), default=-1)
    with tempfile.TemporaryDirectory(prefix="behaviour-") as place:
        folder = Path(place).resolve()
        prepare(folder)
        for part, name, arguments in every[: last + 1]:
            yield part, run_command(name, arguments, folder)
    os.environ["OPENBLAS_NUM_THREADS"] = "1"  # before numpy is imported
    import behaviour_api

    for name, of_api in behaviour_api.PARTS.items():
        if matches(name, [one.partition("-")[0] for one in patterns]):
            yield from of_api()


def matches(name: str, patterns: list[str]) -> bool:
    """Return whether the name of a part begins with one of the patterns; without any, it does."""
    return not patterns or any(fnmatch.fnmatch(name, f"{one}*") for one in patterns)


def record(folder: Path, patterns: list[str]) -> int:
    """Write the parts of a recording."""
    folder.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()
    for name, text in parts(patterns):
        if not matches(name, patterns):
            continue
        (folder / f"{name}.txt").write_text(text)
        print(f"{time.monotonic() - start:6.1f} s  {name}", file=sys.stderr)
    return 0


def compare(a: Path, b: Path, patterns: list[str]) -> int:
    """Print the parts that differ, with the first rows that do; return 1 if there is one."""
    names = sorted({path.name for folder in (a, b) for path in folder.glob("*.txt")})
    names = [name for name in names if matches(name, patterns)]
    differing = 0
    for name in names:
        texts = [
            (folder / name).read_text() if (folder / name).exists() else "" for folder in (a, b)
        ]
        if texts[0] == texts[1]:
            continue
        differing += 1
        if not all(texts):
            print(f"{name}: only in {a if texts[0] else b}")
            continue
        columns = [text.splitlines() for text in texts]
        rows = zip_longest(columns[0], columns[1], fillvalue="(no row)")
        different = [(i, *pair) for i, pair in enumerate(rows, 1) if pair[0] != pair[1]]
        print(f"{name}: {len(different)} rows differ")
        for i, left, right in different[:3]:
            at = next((k for k in range(len(left)) if left[: k + 1] != right[: k + 1]), len(left))
            part = slice(max(at - 40, 0), at + 110)
            print(f"  {i:5} A {left[part]}\n        B {right[part]}")
    print(f"{differing} of {len(names)} parts differ")
    return 1 if differing else 0


def main(arguments: list[str]) -> int:
    """Run a subcommand."""
    if len(arguments) >= 2 and arguments[0] == "child":
        return child(arguments[1], arguments[2:])
    if len(arguments) >= 2 and arguments[0] == "record":
        return record(Path(arguments[1]), arguments[2:])
    if len(arguments) >= 3 and arguments[0] == "compare":
        return compare(Path(arguments[1]), Path(arguments[2]), arguments[3:])
    print(__doc__)
    return 2


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
