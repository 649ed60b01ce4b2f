#!/usr/bin/env python3
"""Count how far a reader must go to follow a call through the package: calls, files and stays.

    journeys.py            the journeys, and the modules that a name of the package loads
    journeys.py --json     the same as JSON
    journeys.py --trace "a line to its frames"      each stay of a journey: file and functions

Run it in the environment of the project: python3 tools/run.py python tools/journeys.py

    calls   of functions of the package, also of those without a name, such as comprehensions
    files   of these functions
    stays   a stay is what is run in one file until a call or a return leads to another file

The second call of a journey counts, so that imports and caches do not.
"""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

from reporting import parser_of

import maplines_can as ml

PACKAGE = Path(ml.__file__).parent
#: Files and stays that a journey should take at most.
GOALS = {
    "last frame to line": (12, 40),
    "a line to its frames": (8, 90),
    "encode_scene, 2 lines": (14, 500),
    "map_lines, 1 line": (8, 50),
}
#: Names of the package whose modules are listed.
LOADED = ("Codec", "map_lines")
MS = 1_000_000


class Step(NamedTuple):
    """A call of a function, or a return to it."""

    file: str  #: below the package
    function: str
    is_call: bool


def steps(call: Callable[[], Any]) -> list[Step]:
    """Return the calls within the package, and the returns to its functions."""
    found: list[Step] = []
    open_calls: list[Step] = []

    def note(frame: FrameType, event: str, _: Any) -> None:
        path = Path(frame.f_code.co_filename)
        if event not in ("call", "return") or not path.is_relative_to(PACKAGE):
            return
        if event == "call":
            name = str(path.relative_to(PACKAGE))
            open_calls.append(Step(name, frame.f_code.co_qualname, True))
            found.append(open_calls[-1])
        else:
            open_calls.pop()
            found.extend(one._replace(is_call=False) for one in open_calls[-1:])

    sys.setprofile(note)
    try:
        call()
    finally:
        sys.setprofile(None)
    return found


def stays(path: list[Step]) -> Iterator[tuple[str, list[str]]]:
    """Yield the file of each stay, and the functions that are called in it."""
    for file, group in groupby(path, lambda step: step.file):
        yield file, [step.function for step in group if step.is_call]


def journeys() -> dict[str, list[Step]]:
    """Return the steps of each journey."""
    roads = ml.simulation.scenario("production")
    first, second = ml.Slot.EGO_LEFT, ml.Slot.EGO_RIGHT
    lines, ego, codec = {first: roads.lines[first]}, roads.ego, ml.Codec.from_dbc()
    scene = ml.map_scene(lines | {second: roads.lines[second]}, ego, window=roads.window)
    (line,) = ml.map_lines(lines, ego)
    encoder = codec.encoder()
    encoder.encode_scene(scene)
    return {
        "last frame to line": last_frame(codec, line),
        "a line to its frames": steps(lambda: encoder.encode(line)),
        "encode_scene, 2 lines": steps(lambda: encoder.encode_scene(scene)),
        "map_lines, 1 line": steps(lambda: ml.map_lines(lines, ego)),
    }


def last_frame(codec: ml.Codec, line: ml.MapLine) -> list[Step]:
    """Return the steps from the last frame of a line to this line, once the slot is VALID."""
    encoder, decoder, found = codec.encoder(), codec.decoder(), list[Step]()
    for cycle in range(12):
        *frames, last = encoder.encode(line)
        for frame in frames:
            decoder.feed(frame.can_id, frame.data, 50 * MS * cycle)
        found = steps(lambda: decoder.feed(last.can_id, last.data, 50 * MS * cycle))  # noqa: B023
    return found


def loaded(name: str) -> dict[str, int]:
    """Return the modules that the use of a name of the package loads, with their lines."""
    program = (
        f"import sys, maplines_can; maplines_can.{name}\n"
        "print(*(m.__file__ for n, m in sorted(sys.modules.items())"
        " if n.split('.')[0] == 'maplines_can'), sep='\\n')"
    )
    done = subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
    paths = [Path(row) for row in done.stdout.decode().splitlines()]
    return {str(path.relative_to(PACKAGE)): len(path.read_text().splitlines()) for path in paths}


def main() -> int:
    """Print the table."""
    parser = parser_of(__doc__)
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--trace", choices=GOALS, help="print each stay of this journey")
    arguments = parser.parse_args()
    paths = journeys()
    if arguments.trace:
        for file, functions in stays(paths[arguments.trace]):
            print(f"{file:<40}{' '.join(functions)}")
        return 0
    counts = {
        name: {
            "calls": sum(step.is_call for step in path),
            "files": len({step.file for step in path}),
            "stays": len(list(stays(path))),
            "goal": dict(zip(("files", "stays"), GOALS[name], strict=True)),
        }
        for name, path in paths.items()
    }
    modules = {name: loaded(name) for name in LOADED}
    if arguments.json:
        print(json.dumps({"journeys": counts, "modules": modules}, indent=2))
        return 0
    print(f"{'journey':<24}{'calls':>7}{'files':>7}{'stays':>7}   goal: files, stays")
    for name, row in counts.items():
        goal = ", ".join(map(str, GOALS[name]))
        print(f"{name:<24}{row['calls']:>7}{row['files']:>7}{row['stays']:>7}   {goal}")
    for name, files in modules.items():
        print(f"\n{name} loads {len(files)} modules with {sum(files.values())} lines:")
        for file, n in files.items():
            print(f"{n:>7}  {file}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
