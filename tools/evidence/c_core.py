"""The C core back to back with Python: the same bits, on any compiler and processor.

The cases and comparisons are those of the tests in tests/c, with other numbers of cases. A case
that differs ends the evidence with an error that shows it, so the number of differences is 0 if
there are figures at all. With `emulator`, the program is of another processor:

    python tools/evidence c_core n=1e4 cc=s390x-linux-gnu-gcc emulator="qemu-s390x -L /usr/..."
"""

from __future__ import annotations

import importlib
import shlex
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from maplines_can.wire import Codec, default_dbc_path
from maplines_can.wire.layout.message_layout import Layout

from .harness import bar, evidence
from .roads import maps_of, on_map

TESTS = Path(__file__).parents[2] / "tests"
#: Cases that are compared at once.
CHUNK, SCENES = 20_000, 200
#: Frames of one stream.
STREAM = 20_000
PROJECT = ("maplines.dbc", "maplines-secoc.dbc", "maplines-pose.dbc")


def tests(name: str) -> Any:
    """Return a module of the tests."""
    for folder in (str(TESTS), str(TESTS / "c"), str(TESTS.parent / "tools")):
        if folder not in sys.path:
            sys.path.insert(0, folder)
    return importlib.import_module(name)


def codecs(dbcs: tuple[str, ...], randoms: int) -> Iterator[tuple[str, Codec]]:
    """Yield the codecs of DBCs by name, and those of some random DBCs."""
    for dbc in dbcs:
        path = default_dbc_path(dbc) if dbc in PROJECT else Path(dbc)
        yield dbc, Codec(Layout.from_dbc(path))
    random_dbc = tests("random_dbc").random_dbc
    for seed in range(randoms):
        yield f"random {seed}", Codec(Layout.from_text(random_dbc(seed), f"random{seed}.dbc"))


def chunks(n: int, what: str) -> Iterator[tuple[int, int]]:
    """Yield seeds and numbers of cases, n in all, with a progress bar."""
    with bar(n, what) as shown:
        for seed, first in enumerate(range(0, n, CHUNK)):
            size = min(CHUNK, n - first)
            yield seed, size
            shown.update(size)


@evidence(n=400, random=2)
def lines(
    n: int = 1_000_000,
    random: int = 0,
    dbcs: tuple[str, ...] = PROJECT[:2],
    cc: str = "cc",
    flags: str = "-O2",
    emulator: str = "",
) -> dict[str, Any]:
    """Compare complete lines, n each way on each DBC: records of any bits, and awkward lines."""
    of_lines, prefix = tests("c_lines"), shlex.split(emulator)
    compiler = {"cc": cc, "flags": tuple(shlex.split(flags))}
    rows: dict[str, Any] = {}
    for name, codec in codecs(dbcs, random):
        if codec.layout.is_conditional:
            continue
        verdicts, statuses = Counter[str](), Counter[int]()
        for seed, size in chunks(n, name):
            verdicts += Counter(
                of_lines.check_decode(codec.layout, size, seed, *prefix, **compiler)
            )
            awkward = of_lines.awkward_lines(codec, size, seed)
            sent = of_lines.check_encode(codec, awkward, *prefix, is_fd=seed % 2 == 1, **compiler)
            statuses += Counter(dict(enumerate(sent.tolist())))
        rows[name] = {
            "decoded": verdicts["None"],
            "refused": sum(verdicts.values()) - verdicts["None"],
            "encoded": sum(statuses.values()),
            "out of range": statuses[5],
            "different": 0,
        }
    return rows


@evidence(n=60, random=2)
def scenes(
    n: int = 100_000,
    random: int = 0,
    dbcs: tuple[str, ...] = PROJECT,
    cc: str = "cc",
    flags: str = "-O2",
    emulator: str = "",
) -> dict[str, Any]:
    """Compare decoded scenes, n on each DBC: records of any bits, and one in 20 of a road."""
    of_scenes, prefix = tests("c_scenes"), shlex.split(emulator)
    compiler = {"cc": cc, "flags": tuple(shlex.split(flags))}
    rows: dict[str, Any] = {}
    for name, codec in codecs(dbcs, random):
        wire, counts = of_scenes.Wire(codec), Counter[str]()
        for seed, size in chunks(n, name):
            given = [*of_scenes.random_scenes(wire, size - size // 20, seed)]
            if not name.startswith("random"):
                given += of_scenes.sent_scenes(wire, size // 20, seed)
            counts += of_scenes.check_scenes(wire, given, *prefix, **compiler)
        rows[name] = {**counts, "different": 0}
    return rows


@evidence(n=20, random=1)
def encoded_scenes(
    n: int = 10_000,
    random: int = 0,
    dbcs: tuple[str, ...] = PROJECT,
    maps: tuple[str, ...] = (),
    cc: str = "cc",
    flags: str = "-O2",
    emulator: str = "",
) -> dict[str, Any]:
    """Compare encoded scenes, n on each DBC, of random roads, of random Gaussians, and of maps.

    Args:
        n: number of scenes of each DBC.
        random: number of random DBCs.
        dbcs: DBCs of the project, and files.
        maps: folders and files of maps.
        cc: compiler.
        flags: of the compiler.
        emulator: command that runs the program.
    """
    draws = [on_map(found) for found in maps_of(maps).values()]
    of_scenes, prefix = tests("test_scene_encode"), shlex.split(emulator)
    compiler = {"cc": cc, "flags": tuple(shlex.split(flags))}
    rows: dict[str, Any] = {}
    for name, codec in codecs(dbcs, random):
        counts = Counter[str]()
        for first in range(0, n, SCENES):
            numbers = range(first, min(first + SCENES, n), 3 if draws else 2)
            given = [*of_scenes.on_roads(numbers), *of_scenes.gaussians(numbers)]
            if draws:
                given += of_scenes.on_maps(draws, numbers)
            for sent in of_scenes.check(codec.layout, given, first, *prefix, **compiler):
                counts["scenes"] += 1
                counts["frames"] += len(sent.frames)
                counts["lines in scenes"] += sent.left_out.count(0)
                counts["lines left out"] += len(sent.left_out) - sent.left_out.count(0)
        rows[name] = {**counts, "different": 0}
    return rows


@evidence(n=2000, random=1)
def reception(
    n: int = 10_000_000,
    random: int = 0,
    dbcs: tuple[str, ...] = PROJECT,
    cc: str = "cc",
    flags: str = "-O2",
    emulator: str = "",
) -> dict[str, Any]:
    """Compare receivers, n frames or more on each DBC: faults, hostile bytes, clocks, two senders.

    Every answer, line, view, state and count is the same, or the evidence ends with an error.
    """
    streams, prefix = tests("c_streams"), shlex.split(emulator)
    compiler = {"cc": cc, "flags": tuple(shlex.split(flags))}
    rows: dict[str, Any] = {}
    for name, codec in codecs(dbcs, random):
        traffic, met = streams.Traffic(codec.layout), Counter[str]()
        each = min(STREAM, max(1, n // streams.profiles_for(codec.layout)))
        frames = seed = 0
        with bar(n, name) as shown:
            while frames < n:
                given, own = streams.check_streams(traffic, each, seed, *prefix, **compiler)
                frames, seed, met = frames + given, seed + 1, met + own
                shown.update(given)
        rows[name] = {"frames": frames, "lines": met["line"], "mixtures": met["mixture"],
                      "scenes": met["scene"], "views usable": met["usable"],
                      "different": 0}  # fmt: skip
    return rows
