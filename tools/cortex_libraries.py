"""Libraries that lack features, on a Cortex-M4: bytes, greatest stack and counts of instructions.

They are compiled with -Os for a CPU without an FPU, and linked with newlib-nano. Counts are the
greatest ones of the cases in greatest/, which greatest_found.py has searched: no bounds.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from arm import CC, EXAMPLE, FLAGS, START, on_board, run
from call_graph import CallGraph

from maplines_can.cli.options import layout_from
from maplines_can.generation.c_build import ALL, Features
from maplines_can.generation.c_files import c_files

CASES = Path(__file__).resolve().parent / "greatest"
OPTIONS = ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=soft", *FLAGS, "-Os"]
DBCS = ("maplines.dbc", "maplines-pose.dbc", "maplines-scene.dbc")
SMALL = Features(sender=False, scenes=False, mixtures=False, secoc=False, slots=4)
#: Libraries that are measured: what they are for, their DBC and their features.
LIBRARIES = {
    "all": (DBCS[0], ALL),
    "all, `maplines-pose.dbc`": (DBCS[1], ALL),
    "receiver": (DBCS[0], Features(sender=False)),
    "receiver without mixtures and SecOC": (DBCS[0], SMALL._replace(scenes=True, slots=8)),
    "the same, `maplines-pose.dbc`": (DBCS[1], SMALL._replace(scenes=True, slots=8)),
    "receiver of lines, 8 slots": (DBCS[0], SMALL._replace(slots=8)),
    "receiver of lines, 4 slots": (DBCS[0], SMALL),
    "the same, float": (DBCS[0], SMALL._replace(single=True)),
    "sender of lines, 4 slots": (DBCS[0], SMALL._replace(sender=True, receiver=False)),
    "receiver, `maplines-scene.dbc`": (DBCS[2], SMALL._replace(scenes=True, slots=8)),
    "the same, with SecOC": (DBCS[2], SMALL._replace(scenes=True, slots=8, secoc=True)),
}
#: Public function of each kind of call, in the order of the table.
FUNCTIONS = {
    "feed": "maplines_feed",
    "latest line": "maplines_latest",
    "latest scene of up to 4 lines": "maplines_latest_scene",
    "latest scene of up to 8 lines": "maplines_latest_scene",
    "encode a line": "maplines_encode_line",
}
#: What a library for whole scenes only has in their place.
COPIES = {
    "maplines_latest": "maplines_copy_line",
    "maplines_latest_scene": "maplines_copy_scene",
}


class Call(NamedTuple):
    """Greatest numbers of a kind of call."""

    instructions: int
    written: int  #: stack in these cases, by paint [byte]
    stack: int  #: deepest one by the graph of calls [byte]


class Measured(NamedTuple):
    """What a library takes."""

    sizes: dict[str, int]  #: [byte]
    calls: dict[str, Call]


class Programs(NamedTuple):
    """What is built of a library."""

    source: Path
    smallest: Path  #: the node of smallest.c
    greatest: Path  #: greatest.c, with all functions of the library


@contextmanager
def built(dbc: str, features: Features) -> Iterator[Programs]:
    """Build a library, and the programs for its measurements, in a folder that is removed."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in c_files({"maplines": layout_from(dbc)}, features).items():
            (folder / file).write_text(text, encoding="utf-8")
        sources = [folder / "maplines.c", folder / "maplines_dbc.c", EXAMPLE / "smallest.c"]
        objects = [folder / f"{source.stem}.o" for source in sources]
        for source, made in zip(sources, objects, strict=True):
            graph = ["-fcallgraph-info=su"] if source.stem == "maplines" else []
            run([CC, *OPTIONS, *graph, f"-I{folder}", "-c", source, "-o", made])
        smallest, greatest = folder / "smallest.elf", folder / "greatest.elf"
        link = ["-nostartfiles", "--specs=nano.specs", "-Wl,--gc-sections,--entry=main"]
        listing = f"-Wl,-Map={smallest.with_suffix('.map')}"
        run([CC, *OPTIONS, *link, listing, *objects, "-lm", "-o", smallest])
        main = ["--specs=nano.specs", *START, f"-I{folder}", EXAMPLE / "greatest.c"]
        run([CC, *OPTIONS, *main, *objects[:2], "-lm", "-o", greatest])
        yield Programs(sources[0], smallest, greatest)


def measured(dbc: str, features: Features) -> Measured:
    """Return the bytes of a library, and the greatest numbers of its calls."""
    with built(dbc, features) as programs:
        graph = CallGraph(programs.source, programs.greatest)
        cases = cases_of(programs.greatest, CASES / f"{Path(dbc).stem}.txt")
        calls, is_whole = {}, layout_from(dbc).scene is not None
        for kind, function in FUNCTIONS.items():
            counts = [case[kind] for case in cases if kind in case]
            if counts:
                instructions, written = (max(numbers) for numbers in zip(*counts, strict=True))
                function = COPIES.get(function, function) if is_whole else function
                calls[kind] = Call(instructions, written, graph.deepest(function).stack)
        return Measured(_sizes_of(programs.smallest), calls)


def cases_of(program: Path, cases: Path) -> list[dict[str, tuple[int, int]]]:
    """Return the greatest instructions and stack of each kind of call in each case of a file."""
    found: list[dict[str, tuple[int, int]]] = []
    for row in on_board(program, "cortex-m4", cases).splitlines():
        case, instructions, stack, kind = row.split(" ", 3)
        found += [{} for _ in range(int(case) + 1 - len(found))]
        found[-1][kind] = int(instructions), int(stack)
    return found


def _sizes_of(smallest: Path) -> dict[str, int]:
    """Return the bytes of a node that is linked.

    Returns:
        Code and constants that are read only: those of the library with its tables and the node,
        and those of the compiler and the C library; variables with and without values that they
        begin with; the state of a receiver or of a sender, which is one of these.
    """
    kept = smallest.with_suffix(".map").read_text().partition("Linker script and memory map")[2]
    own = rf"^ \.(?:text|rodata)\S*\s+0x\w+\s+(0x\w+) {smallest.parent}/\w+\.o$"
    library = sum(int(size, 16) for size in re.findall(own, kept, re.MULTILINE))
    text, data, bss = run(["arm-none-eabi-size", smallest]).splitlines()[1].split()[:3]
    symbols = run(["arm-none-eabi-nm", "-S", smallest])
    state = re.findall(r"^\w+ (\w+) \w (?:decoder|encoder)$", symbols, re.MULTILINE)
    return {
        "library and tables": library,
        "compiler and C library": int(text) - library,
        "data": int(data),
        "bss": int(bss),
        "state": sum(int(size, 16) for size in state),
    }
