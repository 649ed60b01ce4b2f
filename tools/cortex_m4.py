#!/usr/bin/env python3
"""Measure the C core on a Cortex-M4: memory, instructions and stack, in QEMU.

    cortex_m4.py                       maplines.dbc and maplines-pose.dbc, double and float
    cortex_m4.py --dbc my.dbc --float  one of them
    cortex_m4.py --cpu cortex-m7       with an FPU of double precision
    cortex_m4.py --json
    cortex_m4.py --sizes               bytes of libraries that lack features, linked with -Os
    cortex_m4.py --write               the tables of docs/embedding.md

The program of c/examples/cortex_m4 receives frames that Python has encoded, without an operating
system; what it prints of the lines is what the same program prints on this host. It needs
arm-none-eabi-gcc with newlib, and qemu-system-arm. Run it in the environment of the project:
python3 tools/run.py python tools/cortex_m4.py
"""

from __future__ import annotations

import json
import math
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

from reporting import fill_tables, parser_of, print_table

from maplines_can import Codec, MapError, Scene
from maplines_can.cli.options import layout_from
from maplines_can.generation.c_build import ALL, Features
from maplines_can.generation.c_files import c_files
from maplines_can.simulation import scenario
from maplines_can.simulation.scenario_lines import ScenarioLines, weaving_ego

EXAMPLE = Path(__file__).resolve().parents[1] / "c" / "examples" / "cortex_m4"
PAGE = Path(__file__).resolve().parents[1] / "docs" / "embedding.md"
CC, QEMU = "arm-none-eabi-gcc", "qemu-system-arm"
#: Boards: options of the compiler, machine of QEMU. The second one has an FPU of double precision.
BOARDS = {
    "cortex-m4": (["-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16"], "mps2-an386"),
    "cortex-m7": (["-mcpu=cortex-m7", "-mfpu=fpv5-d16"], "mps2-an500"),
}
#: Greatest relative difference of a number that is printed on the board and on this host. It is 0
#: but for double precision without an FPU: GCC's addition of doubles on ARM rounds some differences
#: of 1 and a number of about 2^-33 wrongly.
TOLERANCE = 1e-11
FLAGS = ["-std=gnu99", "-ffp-contract=off", "-ffunction-sections", "-fdata-sections", "-DNDEBUG"]
DBCS = ("maplines.dbc", "maplines-pose.dbc")
MEASUREMENT = re.compile(r"# (.+): (\d+) instructions, (\d+) bytes of stack, (\d+) calls")


def is_installed() -> bool:
    """Return whether the compiler and the emulator are here."""
    return shutil.which(CC) is not None and shutil.which(QEMU) is not None


def recorded(codec: Codec, cycles: int, lines: int) -> str:
    """Return recorded.h: frames of scenes that a sender sends at 20 Hz, a frame each 250 us."""
    errors = MapError(point_sigma=0.05)
    road = scenario("production")
    source = ScenarioLines(road, lines, correlation_time=10.0, map_error=errors)
    encoder, rows = codec.encoder(), []
    for k in range(cycles):
        scene = cast(Scene, source.seen_from(weaving_ego(road, 0.05 * k)))
        records = encoder.encode_scene(scene)
        frames = [frame for each in records.values() for frame in each]
        for i, frame in enumerate(frames):
            data = ", ".join(map(str, frame.data))
            fields = [frame.can_id, frame.is_extended, frame.is_fd, len(frame.data)]
            numbers = ", ".join(str(int(value)) for value in fields)
            t_ns = k * 50_000_000 + i * 250_000
            rows.append(
                f"    {{{t_ns}, {int(i + 1 == len(frames))}, {{{numbers}, {{{data}}}}}}},\n"
            )
    return (
        "static const struct {\n    int64_t t_ns;\n    bool is_last;\n    maplines_frame_t frame;\n"
        "} recorded[] = {\n" + "".join(rows) + "};\n"
    )


SMALL = Features(sender=False, scenes=False, mixtures=False, secoc=False, slots=4)
#: Libraries whose sizes are measured: what they are for, their DBC and their features.
LIBRARIES = {
    "all": (DBCS[0], ALL),
    "receiver": (DBCS[0], Features(sender=False)),
    "receiver without mixtures and SecOC": (DBCS[0], SMALL._replace(scenes=True, slots=8)),
    "the same, `maplines-pose.dbc`": (DBCS[1], SMALL._replace(scenes=True, slots=8)),
    "receiver of lines, 8 slots": (DBCS[0], SMALL._replace(slots=8)),
    "receiver of lines, 4 slots": (DBCS[0], SMALL),
    "the same, float": (DBCS[0], SMALL._replace(single=True)),
    "sender of lines, 4 slots": (DBCS[0], SMALL._replace(sender=True, receiver=False)),
}


class Target(NamedTuple):
    """What a program is built for."""

    dbc: str = DBCS[0]
    single: bool = False  #: compute with float
    cpu: str = "cortex-m4"
    optimize: str = "-O2"


def build(folder: Path, target: Target, mains: Sequence[Path], name: str) -> dict[str, Path]:
    """Build a program for the board and for this host; return both by these names.

    Args:
        folder: of the files that are made, and of headers that the program includes.
        target: DBC, numbers and CPU.
        mains: sources of the program.
        name: of the tables of the DBC.
    """
    for file, text in c_files({name: layout_from(target.dbc)}).items():
        (folder / file).write_text(text, encoding="utf-8")
    # Test vectors are exact in double precision, but not with the subroutines of a CPU without it.
    single = ["-DMAPLINES_FLOAT"] if target.single else ["-DTOLERANCE=1e-9"]
    flags = [*FLAGS, target.optimize, *single, f"-I{folder}"]
    core = [folder / f"{part}.c" for part in ("maplines", f"{name}_dbc")]
    cpu = [*BOARDS[target.cpu][0], "-mthumb", "-mfloat-abi=hard"]
    for source in core:
        run([CC, *cpu, *flags, "-c", source, "-o", source.with_suffix(".o")])
    objects = [source.with_suffix(".o") for source in core]
    board, host = folder / "board.elf", folder / "host"
    start = ["-nostartfiles", "--specs=rdimon.specs", f"-T{EXAMPLE / 'link.ld'}",
             "-Wl,--gc-sections,--no-warn-rwx-segments", EXAMPLE / "startup.c"]  # fmt: skip
    run([CC, *cpu, *flags, *start, *mains, *objects, "-lm", "-o", board])
    run(["cc", *flags, *mains, *core, "-lm", "-o", host])
    return {"board": board, "host": host}


def on_board(program: Path, cpu: str, *arguments: object) -> str:
    """Return what a program prints on the board; one instruction takes 1 ns there."""
    words = ",".join(f"arg={word}" for word in (program.name, *arguments))
    semihosting = ["-semihosting-config", f"enable=on,target=native,{words}"]
    machine = ["-M", BOARDS[cpu][1], "-nographic", "-monitor", "none", "-serial", "null"]
    return run([QEMU, *machine, "-icount", "shift=0", *semihosting, "-kernel", program])


def run(command: Sequence[object]) -> str:
    """Return the output of a command.

    Raises:
        SystemExit: it failed.
    """
    words = [str(word) for word in command]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{' '.join(words)} ended with {done.returncode}:\n{done.stderr}")
    return done.stdout


def sizes(folder: Path) -> dict[str, int]:
    """Return the bytes of code, of its constants and of the tables of a DBC."""
    code = run(["arm-none-eabi-size", "-A", str(folder / "maplines.o")])
    tables = run(["arm-none-eabi-size", "-A", str(folder / "maplines_dbc.o")])

    def total(text: str, prefix: str) -> int:
        return sum(int(size) for size in re.findall(rf"^\.{prefix}\S*\s+(\d+)", text, re.MULTILINE))

    return {
        "code": total(code, "text"),
        "constants": total(code, "rodata"),
        "tables of the DBC": total(tables, "rodata"),
        "static data": total(code, "(?:data|bss)") + total(tables, "(?:data|bss)"),
    }


def measure(target: Target) -> dict[str, Any]:
    """Return sizes, and instructions and stack of each call."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        frames = recorded(Codec(layout_from(target.dbc)), cycles=20, lines=4)
        (folder / "recorded.h").write_text(frames, encoding="utf-8")
        programs = build(folder, target, [EXAMPLE / "main.c"], "maplines")
        output = on_board(programs["board"], target.cpu)
        found: dict[str, Any] = {"bytes": sizes(folder)}
        for what, bytes_ in re.findall(r"# (\w[\w ]*): (\d+) bytes\n", output):
            found["bytes"][what] = int(bytes_)
        for kind, column in (("instructions", 1), ("stack", 2)):
            found[kind] = {row[0]: int(row[column]) for row in MEASUREMENT.findall(output)}
        found["largest difference"] = difference(output, run([programs["host"]]))
        return found


def linked_size(dbc: str, features: Features) -> dict[str, int]:
    """Return the bytes of a node that is linked for a Cortex-M4 with -Os, without an FPU.

    Returns:
        Code and constants that are read only: those of the library with its tables, and those of
        the compiler and the C library; the state of a receiver or of a sender.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, text in c_files({"maplines": layout_from(dbc)}, features).items():
            (folder / file).write_text(text, encoding="utf-8")
        cpu = ["-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=soft"]
        flags = [*FLAGS, "-Os", f"-I{folder}"]
        sources = [EXAMPLE / "smallest.c", folder / "maplines.c", folder / "maplines_dbc.c"]
        objects = [folder / f"{source.stem}.o" for source in sources]
        for source, made in zip(sources, objects, strict=True):
            run([CC, *cpu, *flags, "-c", source, "-o", made])
        listing, board = folder / "board.map", folder / "board.elf"
        link = ["-nostartfiles", "--specs=nano.specs", "-Wl,--gc-sections,--entry=main"]
        run([CC, *cpu, *link, f"-Wl,-Map={listing}", *objects, "-lm", "-o", board])
        kept = listing.read_text().partition("Linker script and memory map")[2]
        own = rf"^ \.(?:text|rodata)\S*\s+0x\w+\s+(0x\w+) {folder}/\w+\.o$"
        library = sum(int(size, 16) for size in re.findall(own, kept, re.MULTILINE))
        words = run(["arm-none-eabi-size", board]).splitlines()[1].split()
        symbols = run(["arm-none-eabi-nm", "-S", board])
        state = re.findall(r"^\w+ (\w+) \w (?:decoder|encoder)$", symbols, re.MULTILINE)
        return {
            "library and tables": library,
            "compiler and C library": int(words[0]) - library,
            "state": sum(int(size, 16) for size in state),
        }


def size_table() -> str:
    """Return the table of the sizes of libraries."""
    found = {name: linked_size(*library) for name, library in LIBRARIES.items()}
    columns = [*found["all"]]
    rows = ["| [byte] | " + " | ".join(columns) + " |", "|---|" + "---:|" * len(columns)]
    return "\n".join([*rows, *(_row(name, [*sizes.values()]) for name, sizes in found.items())])


def difference(board: str, host: str) -> float:
    """Return the greatest relative difference of numbers that a program prints on both.

    It is infinite if there are not as many, or none.
    """
    some, others = (
        [float(w) for row in text.splitlines() if row[0] != "#" for w in row.split() if w[-1] < "A"]
        for text in (board, host)
    )
    if len(some) != len(others) or not some:
        return math.inf
    pairs = zip(some, others, strict=True)
    return max(abs(a - b) / max(abs(a), abs(b), 1e-300) for a, b in pairs)


def table() -> str:
    """Return the table of docs/embedding.md."""
    columns = {
        "Cortex-M4, double": Target(),
        "Cortex-M4, float": Target(single=True),
        "Cortex-M7, double": Target(cpu="cortex-m7"),
        "Cortex-M4, double, `maplines-pose.dbc`": Target(DBCS[1]),
    }
    found = [measure(target) for target in columns.values()]
    rows = ["| | " + " | ".join(columns) + " |", "|---|" + "---:|" * len(columns)]
    rows += [_row(f"{w} [byte]", [each["bytes"][w] for each in found]) for w in found[0]["bytes"]]
    for what in found[0]["instructions"]:
        cells = []
        for each in found:
            n, stack = each["instructions"].get(what), each["stack"].get(what)
            cells.append("-" if n is None else f"{_thousands(n)}, {_thousands(stack)}")
        rows.append(_row(f"{what} [instructions, byte of stack]", cells))
    return "\n".join(rows)


def _row(head: str, cells: Sequence[object]) -> str:
    words = [_thousands(cell) if isinstance(cell, int) else str(cell) for cell in cells]
    return f"| {head} | {' | '.join(words)} |"


def _thousands(number: int) -> str:
    return f"{number:,}".replace(",", " ")


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--dbc", action="append", help="DBC of the messages")
    parser.add_argument("--float", action="store_true", help="only single precision")
    parser.add_argument("--double", action="store_true", help="only double precision")
    parser.add_argument("--cpu", choices=list(BOARDS), default="cortex-m4", help="CPU of the board")
    parser.add_argument("--optimize", default="-O2", help="option of the compiler (default: -O2)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--sizes", action="store_true", help="bytes of libraries without features")
    parser.add_argument("--write", action="store_true", help="write the tables of the page")
    options = parser.parse_args()
    if not is_installed():
        sys.exit(f"install {CC} with newlib, and {QEMU}: gcc-arm-none-eabi, qemu-system-arm")
    if options.write:
        text = PAGE.read_text(encoding="utf-8")
        tables = {"cortex": table(), "sizes": size_table()}
        PAGE.write_text(fill_tables(text, "cortex_m4.py", tables), encoding="utf-8")
        return 0
    if options.sizes:
        print(size_table())
        return 0
    types = [False] * (not options.float) + [True] * (not options.double)
    result = {
        f"{dbc}, {'float' if single else 'double'}": measure(
            Target(dbc, single, options.cpu, options.optimize)
        )
        for dbc in options.dbc or DBCS
        for single in types
    }
    if options.json:
        print(json.dumps(result, indent=2))
    else:
        print_table(result, 48)
    return 0 if all(row["largest difference"] <= TOLERANCE for row in result.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
