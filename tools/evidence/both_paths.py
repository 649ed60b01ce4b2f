"""The C core back to back with Python alone, through the API of Python, in one process.

The cases and comparisons are those of the tests in tests/native and tests/c, with other numbers of
cases. A case that differs ends the evidence with an error that shows it, so the number of
differences is 0 if there are figures at all. C leaves what is unusual to Python; this is counted,
for there is nothing to compare.

    python tools/evidence both_paths.scenes n=1e3 maps=DIR
"""

from __future__ import annotations

import sys
from collections import Counter
from functools import cache, partial
from itertools import chain
from typing import Any

import numpy as np

from maplines_can import Gaussian, native
from maplines_can.wire import Codec

from . import c_core
from .c_core import CHUNK, PROJECT, SCENES, chunks, codecs
from .harness import evidence
from .roads import maps_of, on_map

#: Of so many lines, one is also sent alone: in Python, that takes a hundred times as long.
SINGLE = 20
#: Frames of one stream.
STREAM = 2000
#: Time between two frames, and between two scenes [ns].
APART_NS, PERIOD_NS = 200_000, 50_000_000


def tests(name: str) -> Any:
    """Return a module of the tests, all of which need the C core."""
    if not native.is_active:
        sys.exit(f"there is only one path to compare: {native.description()}")
    return c_core.load(name)


# ---- lines ------------------------------------------------------------------------------------


@evidence(n=400, random=2)
def lines(
    n: int = 1_000_000, random: int = 0, dbcs: tuple[str, ...] = PROJECT[:2]
) -> dict[str, Any]:
    """Compare complete lines, n each way on each DBC, as a batch and one in 20 alone.

    Records of any bits, and awkward lines: the same bytes, doubles, verdicts and errors.
    """
    of_lines = tests("c_lines")
    complete = (one for one in codecs(dbcs, random) if not one[1].layout.is_conditional)
    of_batch = tests("test_native_batch").outcome

    def form(found: Any) -> Any:
        return of_batch(lambda: found)

    codec_pairs = tests("both_codecs")
    compare, pair_of = codec_pairs.compare, cache(codec_pairs.both)
    rows: dict[str, Any] = {}
    for chunk in chunks(n, CHUNK, complete, rows):
        codec, pair, size, counts = chunk.codec, pair_of(chunk.codec), chunk.size, chunk.counts
        records = of_lines.random_records(codec, size, np.random.default_rng(chunk.number))
        batch = compare(lambda one: one.batch.decode(*records), pair, form)  # noqa: B023
        counts["decoded"] += int(batch.accepted.sum())
        counts["refused"] += int((~batch.accepted).sum())
        awkward = of_lines.awkward_lines(codec, size, chunk.number)
        counts["encoded"] += len(compare(awkward.payloads, pair, form))
        counts.update(_singles(pair, max(1, size // SINGLE), chunk.number))
    return rows


def _singles(pair: tuple[Codec, Codec], n: int, seed: int) -> Counter[str]:
    """Compare lines that are sent and received one by one, their Gaussians and their bands."""
    senders, content = tests("both_senders"), tests("test_native_decoder").content
    compare = tests("both_codecs").compare
    encoders, receivers = tests("both_codecs").endpoints(pair)
    calls, met, t_ns = senders.Calls(encoders[0]), Counter[str](), 0
    for line in tests("test_native_encoder").lines_of(pair[0], n, seed):
        of = line.gaussian
        for value in (lambda _: Gaussian(of.mean, of.cov), lambda _: line.y_sigma(30.0)):  # noqa: B023
            compare(value, pair, content)
        sent = compare(lambda one: one.encode(line, fd=seed % 2 == 1), encoders, senders.plain)  # noqa: B023
        for frame in sent if isinstance(sent, list) else ():
            t_ns += APART_NS
            given = partial(_feed, frame, t_ns)
            met["received alone"] += isinstance(compare(given, receivers, content), list)
    met.update({"sent alone": calls.sent + calls.left, "left to Python": calls.left})
    return met


def _feed(frame: Any, t_ns: int, decoder: Any) -> Any:
    return decoder.feed(frame.can_id, frame.data, t_ns, is_extended=frame.is_extended)


# ---- frames -----------------------------------------------------------------------------------


@evidence(n=2000, random=1)
def frames(n: int = 1_000_000, random: int = 0, dbcs: tuple[str, ...] = PROJECT) -> dict[str, Any]:
    """Compare decoders, n frames or more on each DBC: faults, hostile bytes, clocks, two senders.

    Every answer, line, view, state and count is the same, or the evidence ends with an error.
    """
    of_decoder, streams = tests("test_native_decoder"), tests("c_streams")
    traffic_of = cache(streams.Traffic)
    names = {"lines": "line", "mixtures": "mixture", "scenes": "scene", "views usable": "usable"}
    rows: dict[str, Any] = {}
    for chunk in chunks(n, STREAM, codecs(dbcs, random), rows):
        profile = streams.PROFILES[chunk.number % len(streams.PROFILES)]
        met = of_decoder.run(traffic_of(chunk.codec.layout), profile, chunk.number, chunk.size)
        chunk.counts["frames"] += chunk.size
        for name, answer in names.items():
            chunk.counts[name] += met[answer]
    return rows


# ---- scenes -----------------------------------------------------------------------------------


@evidence(n=20, random=1)
def scenes(
    n: int = 10_000,
    random: int = 0,
    dbcs: tuple[str, ...] = PROJECT,
    maps: tuple[str, ...] = (),
) -> dict[str, Any]:
    """Compare scenes, n on each DBC, of random roads, of random Gaussians, and of maps.

    They are prepared, written and decoded: the same payloads, and the same joint covariance.
    """
    draws = [on_map(found) for found in maps_of(maps).values()]
    of_scenes, senders = tests("test_scene_encode"), tests("both_senders")
    check_prepared = tests("test_native_scenes").check_prepared
    content = tests("test_native_decoder").content
    codec_pairs = tests("both_codecs")
    compare, pair_of = codec_pairs.compare, cache(codec_pairs.both)
    rows: dict[str, Any] = {}
    for chunk in chunks(n, SCENES, codecs(dbcs, random), rows):
        encoders, decoders = codec_pairs.endpoints(pair_of(chunk.codec))
        calls, t_ns, counts = senders.Calls(encoders[0]), 0, chunk.counts
        first = chunk.number * SCENES
        numbers = range(first, first + chunk.size, 3 if draws else 2)
        given = [*of_scenes.on_roads(numbers), *of_scenes.gaussians(numbers)]
        if draws:
            given += of_scenes.on_maps(draws, numbers)
        known = chunk.codec.layout.messages
        for i, every in enumerate(given):
            scene = every.subset([slot for slot in every.index if slot in known])
            is_fd, age = bool(i % 2), of_scenes.AGES[i % 4]
            sent = compare(
                lambda one: one.encode_scene(scene, fd=is_fd, age=age),  # noqa: B023
                encoders,
                senders.plain,
            )
            counts["scenes"] += 1
            if not isinstance(sent, dict):
                counts["refused"] += 1
                continue
            prepared = encoders[0].prepare_scene(scene, fd=is_fd)
            with codec_pairs.python_alone():
                check_prepared(prepared, encoders[1].prepare_scene(scene, fd=is_fd))
            counts["lines left out"] += len(prepared.encoded.left_out)
            for frame in chain(*sent.values()):
                t_ns += APART_NS
                counts["frames"] += 1
                compare(partial(_feed, frame, t_ns), decoders, content)
            received = compare(lambda one: one.scene(), decoders, content)
            counts["decoded"] += received is not None
            t_ns += PERIOD_NS
        counts["left to Python"] += calls.left
    return rows
