"""Core and model on the streams of random lines and scenes: records, frames, refusals, settings."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Any

import numpy as np

from ..wire import Codec, Layout
from .back_to_back import Difference, StreamComparison
from .ecu_streams import ECU_STREAMS
from .sender_streams import PACKAGE_STREAMS, SenderStream, bits

#: All streams by name, and those of lines with a covariance of their own, and of scenes.
STREAMS = PACKAGE_STREAMS | ECU_STREAMS
_OF_LINES = ("lines", "mixtures", "records", "lines of an ECU", "mixtures of an ECU")
_OF_SCENES = ("scenes", "scenes of an ECU")
#: Those of whole scenes, whose senders remember the places of lines.
_OF_CYCLES = ("sequences",)
#: What is counted.
_WHAT = "records of senders"


def streams_of(layout: Layout) -> list[str]:
    """Return the names of the streams that a DBC can have."""
    of_lines = () if layout.is_conditional else _OF_LINES  # they have a covariance of their own
    of_scenes = () if layout.pose is None else _OF_SCENES
    of_cycles = () if layout.scene is None else _OF_CYCLES
    return [name for name in STREAMS if name in (*of_lines, *of_scenes, *of_cycles, "settings")]


def compare_senders(
    layouts: Sequence[Layout], seed: int, is_over: Callable[[], bool]
) -> StreamComparison:
    """Compare core and model on the streams of DBCs, in turn, until it is over.

    Args:
        layouts: of the DBCs.
        seed: of all streams, which are the same ones on any machine.
        is_over: asked after a turn of each stream.
    """
    streams = [
        (codec, name, STREAMS[name].inputs(codec.layout, np.random.default_rng(seed)))
        for codec in map(Codec, layouts)
        for name in streams_of(codec.layout)
    ]
    done = turn = 0
    while True:
        for codec, name, inputs in streams:
            count = STREAMS[name].steps
            title = f"{codec.layout.source}, {name}, seed {seed}"
            found = compare_steps(title, codec, STREAMS[name], inputs, turn * count, count)
            done += found.equal
            if found.difference is not None or is_over():
                return StreamComparison(done, _WHAT, found.difference)
        turn += 1


def compare_steps(
    title: str, codec: Codec, stream: SenderStream, inputs: Iterator[Any], first: int, count: int
) -> StreamComparison:
    """Compare some steps of a stream, numbered from ``first`` on, up to the first difference."""
    for done, given in enumerate(islice(inputs, count)):
        core, model = bits(stream.core(codec, given)), bits(stream.model(codec.layout, given))
        if core != model:
            shown = str(given), "the answer", str(core), str(model)
            return StreamComparison(done, _WHAT, Difference(title, first + done, *shown))
    return StreamComparison(count, _WHAT)
