"""The C core as programs for tests: a harness with the sources and the tables of a DBC."""

from __future__ import annotations

import hashlib
import os
import re
import shlex
import shutil
import struct
import subprocess
import tempfile
from collections.abc import Sequence
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from cantools.database.can import Database

from maplines_can import Scene
from maplines_can.generation.c_build import ALL, Features
from maplines_can.generation.c_tables import tables_of
from maplines_can.wire.core_tables import Limits, limits_of
from maplines_can.wire.layout.message_layout import Layout

C = Path(__file__).parents[2] / "c"
#: The sources of the core have none of these warnings.
WARNINGS = ("-Wall", "-Wextra", "-Wconversion", "-Wpedantic", "-Wshadow", "-Werror")
#: A harness takes from the core what it calls, and needs nothing of the rest.
SECTIONS, COLLECT = ("-ffunction-sections",), "-Wl,--gc-sections"
#: Limits that suffice for most DBCs, which so share the object files of the core.
LIMITS = Limits(pages=8, transfer_ids=16, components=8)
#: Folders of headers.
FOLDERS = ("include", "src", "propagation", "tests")
#: Name of the tables in a harness: harness_dbc.h and the constant harness_dbc, of whichever DBC.
NAME = "harness"
#: Another compiler, more arguments for it, and an emulator of its target, for all programs: see
#: ``tools/c_checks.py``.
CC = os.environ.get("MAPLINES_CC", "cc")
FLAGS = ("-O2",)
OWN_FLAGS = tuple(shlex.split(os.environ.get("MAPLINES_CFLAGS", "")))
EMULATOR = tuple(shlex.split(os.environ.get("MAPLINES_EMULATOR", "")))

#: Features of a small receiver.
SMALL = Features(sender=False, scenes=False, mixtures=False, secoc=False, slots=4)
#: DBC and features of each library.
LIBRARIES = {
    "all": ("maplines.dbc", ALL),
    "conditional": ("maplines-pose.dbc", ALL),
    "receiver": ("maplines.dbc", Features(sender=False)),
    "sender": ("maplines.dbc", Features(receiver=False)),
    "sender of lines": ("maplines.dbc", Features(receiver=False, scenes=False, mixtures=False)),
    "no secoc": ("maplines-secoc.dbc", Features(secoc=False)),
    "no mixtures": ("maplines.dbc", Features(sender=False, mixtures=False)),
    "two slots": ("maplines-pose.dbc", Features(sender=False, slots=2)),
    "small": ("maplines.dbc", SMALL),
    "small, float": ("maplines.dbc", SMALL._replace(single=True)),
    "scenes": ("maplines-scene.dbc", ALL),
    "scenes, receiver": ("maplines-scene.dbc", Features(sender=False)),
    "scenes, small": ("maplines-scene.dbc", SMALL._replace(scenes=True)),
    "scenes, float": ("maplines-scene.dbc", Features(sender=False, single=True)),
    "scenes, sender": ("maplines-scene.dbc", Features(receiver=False)),
    "one slot": ("maplines.dbc", SMALL._replace(slots=1)),
}  # fmt: skip


def harness(
    name: str,
    dbc: str | Path | Database | Layout | None = None,
    *,
    cc: str = CC,
    flags: Sequence[str] = FLAGS,
) -> Path:
    """Return the program of ``c/tests/<name>_harness.c`` with the core and the tables of a DBC.

    It is compiled once for each content: also in another process, or a later run. The harness
    includes "harness_dbc.h", which declares the constant ``harness_dbc``, "binary.h" and, if it
    tests what is not public, "internal.h".

    Args:
        name: of the harness.
        dbc: as for ``Layout.from_dbc``, or a layout.
        cc: compiler, such as gcc, clang or aarch64-linux-gnu-gcc.
        flags: more arguments for it, such as -O0 or -DMAPLINES_FLOAT.
    """
    layout = dbc if isinstance(dbc, Layout) else _layout(dbc)
    return program([C / "tests" / f"{name}_harness.c"], [layout], [NAME], cc=cc, flags=flags)


def program(
    mains: Sequence[Path],
    layouts: Sequence[Layout],
    names: Sequence[str],
    *,
    cc: str = CC,
    flags: Sequence[str] = FLAGS,
    main_flags: Sequence[str] = (),
) -> Path:
    """Return the program of some sources, the core, and the tables of DBCs with these names.

    Flags of the sources alone leave the object files of the core as they are for other programs.
    """
    flags = (*flags, *OWN_FLAGS)
    files: dict[str, str] = {}
    for layout, name in zip(layouts, names, strict=True):
        tables = tables_of(layout, name)
        files |= {f"{name}_dbc.h": tables.header, f"{name}_dbc.c": tables.source}
    limits = Limits(*map(max, LIMITS, limits_of(layouts)))
    command = [
        cc, "-std=c99", *WARNINGS, *SECTIONS, *flags,
        *(f"-D{macro}={value}" for macro, value in limits.macros.items()),
        *(f"-I{C / folder}" for folder in FOLDERS),
    ]  # fmt: skip
    core = [_object(command, source) for source in sorted((C / "src").glob("*.c"))]
    digest = _digest([*command, *main_flags], [*mains, *core], EMULATOR, files)
    target = cache_folder() / digest
    if not target.exists():
        with tempfile.TemporaryDirectory(dir=cache_folder()) as folder:
            for file, text in files.items():
                (Path(folder) / file).write_text(text)
            tables_c = [f"{folder}/{name}_dbc.c" for name in names]
            out = Path(folder) / "program"
            everything = [*map(str, mains), *map(str, core), *tables_c]
            subprocess.run(
                [*command, *main_flags, COLLECT, f"-I{folder}", *everything, "-lm", "-o", str(out)],
                check=True,
            )
            if EMULATOR:
                out = _emulated(out, target.with_suffix(".bin"))
            out.replace(target)  # in one step: another process may compile the same
    return target


def _object(command: Sequence[str], source: Path) -> Path:
    """Return the object file of a source, which is compiled once for each content."""
    folder = cache_folder() / "objects"
    folder.mkdir(exist_ok=True)
    target = folder / f"{_digest(command, [source])}.o"
    if not target.exists():
        with tempfile.TemporaryDirectory(dir=folder) as place:
            out = Path(place) / "object.o"
            subprocess.run([*command, "-c", str(source), "-o", str(out)], check=True)
            out.replace(target)
    return target


def _digest(command: Sequence[str], paths: Sequence[Path], *more: object) -> str:
    """Return a name for what a command makes of files and of all headers."""
    headers = sorted(path for folder in FOLDERS for path in (C / folder).glob("*.h"))
    digest = hashlib.sha256(repr((command, [path.name for path in paths], more)).encode())
    for path in (*paths, *headers):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:32]


def _emulated(program: Path, target: Path) -> Path:
    """Move a program to another place; return a script that runs it there by the emulator."""
    program.replace(target)
    script = program.with_name("script")
    script.write_text(f'#!/bin/sh\nexec {shlex.join([*EMULATOR, str(target)])} "$@"\n')
    script.chmod(0o755)
    return script


def run(program: Path, data: bytes, *prefix: str) -> bytes:
    """Return the output of a program; ``prefix`` is an emulator and its arguments."""
    return subprocess.run([*prefix, str(program)], input=data, stdout=-1, check=True).stdout


def scene_input(scene: Scene, age: float = 0.0) -> bytes:
    """Return a scene as c/tests/scene_input.h reads it, with the age of all records [s]."""
    error, specific = scene.map_error, scene.specific_covs
    parts = [struct.pack("<B", len(scene.lines))]
    for line, fit_range, quartic in zip(scene.lines, scene.fit_ranges, scene.quartics, strict=True):
        values = (line.x_min, line.x_max, age, *line.gaussian.mean, *fit_range, quartic)
        parts.append(struct.pack("<3B10d", line.slot, line.kind, line.status, *values))
    parts.append(struct.pack("<B", specific is not None))
    arrays = (() if specific is None else specific, scene.cov, scene.pose_error.cov)
    parts += [np.asarray(array, dtype="<f8").tobytes() for array in arrays]
    of_map = (error.offset_sigma, error.heading_sigma) if error else (0.0, 0.0)
    parts.append(struct.pack("<4d", age, scene.pose_error.correlation_time, *of_map))
    return b"".join(parts)


#: What the core takes from the mathematical library: functions that IEEE 754 defines to the last
#: bit, or that only move bits. Those of C99 for the exponent are exact, but for subnormal numbers,
#: which ldexp rounds once.
EXACT = {"sqrt", "sqrtf", "fabs", "floor", "ceil", "rint", "ldexp", "frexp", "copysign"}


def library_functions(*files: Path) -> set[str]:
    """Return what object files, or a shared library, take from the mathematical library."""
    library = subprocess.check_output(["cc", "-print-file-name=libm.so.6"], text=True).strip()
    if not (shutil.which("nm") and Path(library).is_absolute()):
        pytest.skip("there is no nm, or no libm.so.6")
    return _symbols("-u", *files) & _symbols("--defined-only", library)


def _symbols(*arguments: str | Path) -> set[str]:
    """Return names that nm lists, without the versions of the C library."""
    is_shared = ".so" in str(arguments[-1])
    command = ["nm", *(["-D"] if is_shared else []), *map(str, arguments)]
    lines = subprocess.check_output(command, text=True).splitlines()
    return {re.sub("@.*", "", line.split()[-1]) for line in lines if line}


@cache
def cache_folder() -> Path:
    """Return the folder of the programs, which is this user's own."""
    user = os.getuid() if hasattr(os, "getuid") else "user"
    folder = Path(tempfile.gettempdir()) / f"maplines-c-{user}"
    folder.mkdir(mode=0o700, exist_ok=True)
    assert not hasattr(os, "getuid") or folder.stat().st_uid == os.getuid(), folder
    return folder


@cache
def _layout(dbc: str | Path | Database | None) -> Layout:
    return Layout.from_dbc(dbc)
