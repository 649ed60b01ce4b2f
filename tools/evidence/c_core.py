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
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from maplines_can import native
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
    """Return a module of the tests, all of which compare the C core with Python alone."""
    if native.is_active:
        sys.exit(f"the C core is not compared with itself: set {native.VARIABLE}=0")
    return load(name)


def load(name: str) -> Any:
    """Return a module of the tests."""
    for folder in (TESTS, TESTS / "c", TESTS / "native", TESTS.parent / "tools"):
        if str(folder) not in sys.path:
            sys.path.insert(0, str(folder))
    return importlib.import_module(name)


def codecs(dbcs: tuple[str, ...], randoms: int) -> Iterator[tuple[str, Codec]]:
    """Yield the codecs of DBCs by name, and those of some random DBCs."""
    for dbc in dbcs:
        path = default_dbc_path(dbc) if dbc in PROJECT else Path(dbc)
        yield dbc, Codec(Layout.from_dbc(path))
    random_dbc = load("random_dbc").random_dbc
    for seed in range(randoms):
        yield f"random {seed}", Codec(Layout.from_text(random_dbc(seed), f"random{seed}.dbc"))


@dataclass
class Chunk:
    """Cases of one DBC that are compared at once."""

    name: str  #: of the DBC
    codec: Codec
    number: int
    size: int  #: cases; a comparison may set another number
    counts: Counter[str]  #: of all chunks of the DBC: its figures


def chunks(
    n: int, size: int, dbcs: Iterable[tuple[str, Codec]], rows: dict[str, Any]
) -> Iterator[Chunk]:
    """Yield chunks of n cases of each DBC, and add a row with what they count for each."""
    for name, codec in dbcs:
        chunk, done = Chunk(name, codec, 0, 0, Counter()), 0
        with bar(n, name) as shown:
            while done < n:
                chunk.size = min(size, n - done)
                yield chunk
                chunk.number += 1
                done += chunk.size
                shown.update(chunk.size)
        rows[name] = {**chunk.counts, "different": 0}


def checked(function: Callable[..., Any], cc: str, flags: str, emulator: str) -> Any:
    """Return a comparison of the tests with a compiler and an emulator."""
    prefix, compiler = shlex.split(emulator), {"cc": cc, "flags": tuple(shlex.split(flags))}
    return lambda *given, **options: function(*given, *prefix, **options, **compiler)


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
    of_lines = tests("c_lines")
    check_decode = checked(of_lines.check_decode, cc, flags, emulator)
    check_encode = checked(of_lines.check_encode, cc, flags, emulator)
    complete = (one for one in codecs(dbcs, random) if not one[1].layout.is_conditional)
    rows: dict[str, Any] = {}
    for chunk in chunks(n, CHUNK, complete, rows):
        codec, seed, counts = chunk.codec, chunk.number, chunk.counts
        verdicts = check_decode(codec.layout, chunk.size, seed)
        counts["decoded"] += verdicts["None"]
        counts["refused"] += sum(verdicts.values()) - verdicts["None"]
        awkward = of_lines.awkward_lines(codec, chunk.size, seed)
        statuses = check_encode(codec, awkward, is_fd=seed % 2 == 1).tolist()
        counts["encoded"] += sum(statuses)
        counts["out of range"] += statuses[5]
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
    of_scenes = tests("c_scenes")
    check_scenes = checked(of_scenes.check_scenes, cc, flags, emulator)
    rows: dict[str, Any] = {}
    for chunk in chunks(n, CHUNK, codecs(dbcs, random), rows):
        wire, on_roads = of_scenes.Wire(chunk.codec), chunk.size // 20
        given = [*of_scenes.random_scenes(wire, chunk.size - on_roads, chunk.number)]
        if not chunk.name.startswith("random"):
            given += of_scenes.sent_scenes(wire, on_roads, chunk.number)
        chunk.counts.update(check_scenes(wire, given))
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
    of_scenes = tests("test_scene_encode")
    check = checked(of_scenes.check, cc, flags, emulator)
    rows: dict[str, Any] = {}
    for chunk in chunks(n, SCENES, codecs(dbcs, random), rows):
        first = chunk.number * SCENES
        numbers = range(first, first + chunk.size, 3 if draws else 2)
        given = [*of_scenes.on_roads(numbers), *of_scenes.gaussians(numbers)]
        if draws:
            given += of_scenes.on_maps(draws, numbers)
        for sent in check(chunk.codec.layout, given, first):
            chunk.counts["scenes"] += 1
            chunk.counts["frames"] += len(sent.frames)
            chunk.counts["lines in scenes"] += sent.left_out.count(0)
            chunk.counts["lines left out"] += len(sent.left_out) - sent.left_out.count(0)
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
    streams = tests("c_streams")
    check_streams = checked(streams.check_streams, cc, flags, emulator)
    traffic_of = cache(streams.Traffic)
    names = {"lines": "line", "mixtures": "mixture", "scenes": "scene", "views usable": "usable"}
    rows: dict[str, Any] = {}
    for chunk in chunks(n, STREAM, codecs(dbcs, random), rows):
        layout = chunk.codec.layout
        each = min(STREAM, max(1, n // streams.profiles_for(layout)))
        chunk.size, met = check_streams(traffic_of(layout), each, chunk.number)
        chunk.counts["frames"] += chunk.size
        for name, answer in names.items():
            chunk.counts[name] += met[answer]
    return rows
