#!/usr/bin/env python3
"""Measure the C core on a Cortex-M: memory, instructions and stack, in QEMU.

    cortex_m4.py                       maplines.dbc and maplines-pose.dbc, double and float
    cortex_m4.py --dbc my.dbc --float  one of them
    cortex_m4.py --cpu cortex-m7       with an FPU of double precision
    cortex_m4.py --json
    cortex_m4.py --libraries           libraries that lack features: bytes, stack and instructions
    cortex_m4.py --rate 50             load by whole scenes at 50 Hz [instructions a second]
    cortex_m4.py --write               the tables of docs/embedding.md
    cortex_m4.py --check               which numbers are not those of the tables within 10 %

The program of c/examples/cortex_m4 receives frames that Python has encoded, without an operating
system; what it prints of the lines is what the same program prints on this host. It needs
arm-none-eabi-gcc with newlib, and qemu-system-arm. Run it in the environment of the project:
python3 tools/run.py python tools/cortex_m4.py
"""

from __future__ import annotations

import json
import math
import re
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast

from arm import (
    BOARDS,
    CC,
    EXAMPLE,
    FLAGS,
    QEMU,
    START,
    gcc_version,
    is_installed,
    on_board,
    run,
)
from cortex_libraries import DBCS, FUNCTIONS, LIBRARIES, Measured, built, cases_of, measured
from reporting import fill_tables, parser_of, print_table

from maplines_can import Codec, MapError, Scene
from maplines_can.cli.options import layout_from
from maplines_can.generation.c_files import c_files
from maplines_can.simulation import scenario
from maplines_can.simulation.scenario_lines import ScenarioLines, weaving_ego

PAGE = Path(__file__).resolve().parents[1] / "docs" / "embedding.md"
#: Greatest relative difference of a number from that of the page.
GROWTH = 0.1
#: Greatest relative difference of a number that is printed on the board and on this host. It is 0
#: but for double precision without an FPU: GCC's addition of doubles on ARM rounds some differences
#: of 1 and a number of about 2^-33 wrongly.
TOLERANCE = 1e-11
MEASUREMENT = re.compile(r"# (.+): (\d+) instructions, (\d+) bytes of stack, (\d+) calls")


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
    objects = [source.with_suffix(".o") for source in core]
    of_host = [source.with_suffix(".host.o") for source in core]
    for source, made, other in zip(core, objects, of_host, strict=True):
        if not made.exists():  # a second program of the folder has them
            run([CC, *cpu, *flags, "-c", source, "-o", made])
            run(["cc", *flags, "-O1", "-c", source, "-o", other])
    board, host = folder / "board.elf", folder / "host"
    link = [*START, "-Wl,--gc-sections"]
    run([CC, *cpu, *flags, *link, *mains, *objects, "-lm", "-o", board])
    run(["cc", *flags, *mains, *of_host, "-lm", "-o", host])
    return {"board": board, "host": host}


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
        return measure_in(Path(name), target)


def measure_in(folder: Path, target: Target) -> dict[str, Any]:
    """Return what `measure` does, and leave in a folder what is built."""
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


#: Columns of the table of whole libraries.
TARGETS = {
    "Cortex-M4, double": Target(),
    "Cortex-M4, float": Target(single=True),
    "Cortex-M7, double": Target(cpu="cortex-m7"),
    "Cortex-M4, double, `maplines-pose.dbc`": Target(DBCS[1]),
}


def target_table(found: dict[str, dict[str, Any]]) -> str:
    """Return the table of what `measure` has found, by columns."""
    first, *_ = found.values()
    rows: list[tuple[str, Sequence[Any]]] = [
        (f"{what} [byte]", [each["bytes"][what] for each in found.values()])
        for what in first["bytes"]
    ]
    for what in first["instructions"]:
        counts = [
            (each["instructions"].get(what), each["stack"].get(what)) for each in found.values()
        ]
        rows.append((f"{what} [instructions, byte of stack]", [_cell(*each) for each in counts]))
    return _table("-O2", [*found], rows)


def libraries() -> dict[str, Measured]:
    """Return what each library of the tables takes."""
    return {name: measured(*library) for name, library in LIBRARIES.items()}


def library_tables(found: Mapping[str, Measured]) -> dict[str, str]:
    """Return the tables of libraries that lack features: their bytes, and what calls take."""
    first, *_ = found.values()
    sizes = [(name, [*library.sizes.values()]) for name, library in found.items()]
    calls = []
    for name, library in found.items():
        of_kind = (library.calls.get(kind) for kind in FUNCTIONS)
        cells = [_cell(*(call or (None,))) for call in of_kind]
        calls.append((name, cells))
    return {
        "sizes": _table("-Os, [byte]", [*first.sizes], sizes),
        "calls": _table(
            "-Os, [instructions, byte of stack that was written, deepest stack]",
            [*FUNCTIONS],
            calls,
        ),
    }


def _table(unit: str, columns: Sequence[str], rows: Iterable[tuple[str, Sequence[Any]]]) -> str:
    head = f"gcc {gcc_version()} {unit}"
    lines = [f"| {head} | {' | '.join(columns)} |", "|---|" + "---:|" * len(columns)]
    lines += [f"| {name} | {' | '.join(map(_cell, cells))} |" for name, cells in rows]
    return "\n".join(lines)


def _cell(*numbers: object) -> str:
    words = [f"{n:,}".replace(",", " ") if isinstance(n, int) else str(n) for n in numbers]
    return "-" if None in numbers else ", ".join(words)


def changes(now: str, page: str) -> list[str]:
    """Return what a table has that is not on the page, or another number by more than `GROWTH`.

    Args:
        now: a table of some of the rows and columns.
        page: the table on the page.
    """
    known = _cells(page)
    return [
        f"{', '.join(place)}: {cell} now, {known.get(place, 'nothing')} on the page"
        for place, cell in _cells(now).items()
        if not _is_near(_numbers(cell), _numbers(known.get(place, "")))
    ]


def loads(rate: float) -> dict[str, dict[str, int]]:
    """Return what the smallest receiver takes when it copies each scene of a drive.

    Args:
        rate: of the scenes [Hz].

    Returns:
        By the number of lines: instructions of the frames of a scene, of its copy, and of all in a
        second; the greatest ones of 100 scenes.
    """
    found = {}
    road, errors = scenario("production"), MapError(point_sigma=0.05)
    codec = Codec(layout_from(DBCS[2]))
    for lines in (2, 4, 8):
        source = ScenarioLines(road, lines, correlation_time=10.0, map_error=errors)
        encoder, steps, most = codec.encoder(), [], 0
        for k in range(100):
            t_ns = round(k * 1e9 / rate)
            scene = cast(Scene, source.seen_from(weaving_ego(road, k / rate)))
            records = encoder.encode_scene(scene, fd=True)
            frames = [frame for each in records.values() for frame in each]
            steps += [f"F {t_ns} {f.can_id:x} {int(f.is_extended)} {f.data.hex()}" for f in frames]
            steps.append(f"S {t_ns}")
            most = max(most, len(frames))
        with built(*LIBRARIES["receiver, `maplines-scene.dbc`"]) as programs:
            case = programs.greatest.with_suffix(".txt")
            case.write_text("\n".join(steps) + "\n", encoding="utf-8")
            [counts] = cases_of(programs.greatest, case)
        feed = most * counts["feed"][0]
        [copy] = [count for kind, (count, _) in counts.items() if "scene" in kind]
        all_ = {"frames of a scene": feed, "copy of a scene": copy}
        found[f"{lines} lines"] = all_ | {"a second": round(rate * (feed + copy))}
    return found


def table_of_page(name: str) -> str:
    """Return a table of docs/embedding.md."""
    text = PAGE.read_text(encoding="utf-8")
    return text.split(f"<!-- {name}: written by tools/cortex_m4.py -->\n")[1].split("\n<!--")[0]


def is_of_this_compiler(table: str) -> bool:
    """Return whether the numbers of a table are those of the compiler that is here."""
    return table.startswith(f"| gcc {gcc_version()} ")


def _cells(table: str) -> dict[tuple[str, str], str]:
    """Return the cells of a table by the heads of their row and column."""
    head, _, *rows = ([cell.strip() for cell in row.split("|")[1:-1]] for row in table.splitlines())
    return {(row[0], column): cell for row in rows
            for column, cell in zip(head[1:], row[1:], strict=True)}  # fmt: skip


def _numbers(cell: str) -> list[int]:
    return [int(number.replace(" ", "")) for number in re.findall(r"\d[\d ]*", cell)]


def _is_near(some: Sequence[int], others: Sequence[int]) -> bool:
    return len(some) == len(others) and all(
        abs(a - b) <= GROWTH * b for a, b in zip(some, others, strict=True)
    )


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--dbc", action="append", help="DBC of the messages")
    parser.add_argument("--float", action="store_true", help="only single precision")
    parser.add_argument("--double", action="store_true", help="only double precision")
    parser.add_argument("--cpu", choices=list(BOARDS), default="cortex-m4", help="CPU of the board")
    parser.add_argument("--optimize", default="-O2", help="option of the compiler (default: -O2)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--libraries", action="store_true", help="libraries without features")
    parser.add_argument("--rate", type=float, help="load by whole scenes at a rate [Hz]")
    parser.add_argument("--write", action="store_true", help="write the tables of the page")
    parser.add_argument("--check", action="store_true", help="compare the tables of the page")
    options = parser.parse_args()
    if not is_installed():
        sys.exit(f"install {CC} with newlib, and {QEMU}: gcc-arm-none-eabi, qemu-system-arm")
    if options.libraries:
        print("\n\n".join(library_tables(libraries()).values()))
        return 0
    if options.rate:
        print_table(loads(options.rate), 20)
        return 0
    if options.write or options.check:
        found = {name: measure(target) for name, target in TARGETS.items()}
        tables = {"cortex": target_table(found), **library_tables(libraries())}
        if options.write:
            text = PAGE.read_text(encoding="utf-8")
            PAGE.write_text(fill_tables(text, "cortex_m4.py", tables), encoding="utf-8")
            return 0
        differences = [row for name in tables for row in changes(tables[name], table_of_page(name))]
        print("\n".join(differences))
        return bool(differences)
    types = [False] * (not options.float) + [True] * (not options.double)
    result = {
        f"{dbc}, {'float' if single else 'double'}": measure(
            Target(dbc, single, options.cpu, options.optimize)
        )
        for dbc in options.dbc or DBCS[:2]
        for single in types
    }
    if options.json:
        print(json.dumps(result, indent=2))
    else:
        print_table(result, 48)
    return 0 if all(row["largest difference"] <= TOLERANCE for row in result.values()) else 1


if __name__ == "__main__":
    sys.exit(main())
