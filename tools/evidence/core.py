"""The core back to back with the model of ``maplines_can.model``, on every DBC.

Each step is compared to the last bit. The first difference ends the evidence with an error that
shows it, so the number of differences is 0 if there are figures at all.

    python tools/evidence core.frames n=1e6 random=10
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from maplines_can.testing import back_to_back, hostile_streams, map_streams, sender_comparison
from maplines_can.wire import SHIPPED, Codec, Layout, default_dbc_path

from .harness import bar, evidence

#: Steps of a sender that are compared between two updates of the progress.
STEPS = 20


def layouts(randoms: int) -> Iterator[tuple[str, Layout]]:
    """Yield the layouts of the shipped DBCs by name, and those of some random DBCs."""
    for dbc in SHIPPED:
        yield dbc, Layout.from_dbc(default_dbc_path(dbc))
    tools = str(Path(__file__).parents[1])
    if tools not in sys.path:
        sys.path.insert(0, tools)
    from random_dbc import random_dbc

    for seed in range(randoms):
        yield f"random {seed}", Layout.from_text(random_dbc(seed), f"random{seed}.dbc")


@evidence(n=2000, random=1)
def frames(n: int = 1_000_000, random: int = 0, seed: int = 1) -> dict[str, Any]:
    """Compare receivers, n frames or more on each DBC: hostile buses, clocks, two senders, keys."""
    return {name: _received(name, layout, n, seed) for name, layout in layouts(random)}


def _received(name: str, layout: Layout, n: int, seed: int) -> dict[str, int]:
    profiles, traffics = back_to_back.profiles_of(layout), hostile_streams.traffics_of(layout, seed)
    frames = records = streams = 0
    with bar(n, name) as shown:
        while frames < n:
            profile = profiles[streams % len(profiles)]
            if streams and streams % len(profiles) == 0:
                traffics = hostile_streams.traffics_of(layout, seed + streams)
            size = min(back_to_back.FRAMES, n)
            found = back_to_back.compare(traffics, profile, size, seed + streams)
            if found.difference is not None:
                sys.exit(str(found.difference))
            frames, records, streams = frames + found.frames, records + found.records, streams + 1
            shown.update(found.frames)
    return {"frames": frames, "records": records, "streams": streams, "different": 0}


@evidence(n=40, random=1)
def senders(n: int = 100_000, random: int = 0, seed: int = 1) -> dict[str, Any]:
    """Compare senders: n lines, mixtures and records on each DBC, and a tenth as many scenes."""
    rows: dict[str, Any] = {}
    for name, layout in layouts(random):
        rows[name] = {"different": 0}
        most = max(stream.steps for stream in sender_comparison.STREAMS.values())
        for kind in sender_comparison.streams_of(layout):
            stream, title, done = sender_comparison.STREAMS[kind], f"{name}, {kind}", 0
            count = max(1, round(n * max(stream.steps / most, 0.1)))
            codec, inputs = Codec(layout), stream.inputs(layout, np.random.default_rng(seed))
            with bar(count, title) as shown:
                while done < count:
                    size = min(STEPS, count - done)
                    steps = codec, stream, inputs, done, size
                    found = sender_comparison.compare_steps(title, *steps)
                    if found.difference is not None:
                        sys.exit(str(found.difference))
                    done += size
                    shown.update(size)
            rows[name][kind] = done
    return rows


@evidence(n=20)
def maps(n: int = 30_000, seed: int = 1) -> dict[str, int]:
    """Compare the propagation: n queries of lines, scenes and refits of random maps."""
    turns = iter(range(max(1, n // map_streams.STEPS) - 1))
    with bar(n, "maps") as shown:

        def is_over() -> bool:
            shown.update(map_streams.STEPS)
            return next(turns, None) is None

        found = map_streams.compare_maps(seed, is_over)
    if found.difference is not None:
        sys.exit(str(found.difference))
    return {"queries": found.equal, "different": 0}
