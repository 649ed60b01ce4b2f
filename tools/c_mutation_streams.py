"""Processes of c_mutation.py: streams recorded with core and model, and replayed by a mutant.

The answers of the model to a stream are always the same. So each stream is run once by both, and a
mutant takes the recorded inputs alone, which is many times faster.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

#: Seeds of the random DBCs; those from 1000 on are at the limits of the core.
RANDOM_DBCS = (3, 5, 1001)
SEED = 1
MAP_STREAMS = 6
#: Exit status of a mutant with another answer; any other than 0 is an error of the process.
DIFFERS = 3


class _Receiver(NamedTuple):
    """Makes a decoder of the core that takes the steps of a hostile stream."""

    layout: Any
    profile: Any

    def __call__(self) -> Callable[[Any], Any]:
        from maplines_can.testing.back_to_back import CoreSide

        return CoreSide(self.layout, self.profile).take


class _Sender(NamedTuple):
    """Makes an encoder of the core that takes the inputs of a stream of senders."""

    layout: Any
    stream: str

    def __call__(self) -> Callable[[Any], Any]:
        from maplines_can.testing.sender_comparison import STREAMS
        from maplines_can.wire import Codec

        codec = Codec(self.layout)
        return lambda given: STREAMS[self.stream].core(codec, given)


class _Maps:
    """Makes what answers the queries of a stream of maps by the core."""

    def __call__(self) -> Callable[[Any], Any]:
        from maplines_can.testing.map_streams import core_answer

        return core_answer


class _Logs:
    """Makes what parses the logs of a stream by the core."""

    def __call__(self) -> Callable[[Any], Any]:
        from maplines_can.testing.log_streams import core_answer

        return core_answer


class Recording(NamedTuple):
    """Steps of a stream, and a digest of the answers to each."""

    name: str
    make: _Receiver | _Sender | _Maps | _Logs  #: makes what answers a step
    steps: list[Any]
    digests: list[bytes]


def digest(answer: Any) -> bytes:
    """Return a digest of an answer; it is another one if a bit of a number is."""
    from maplines_can.testing.sender_streams import bits

    return hashlib.blake2b(repr(bits(answer)).encode(), digest_size=8).digest()


def record(tree: Path, folder: Path, frames: int, part: int, parts: int) -> None:
    """Write the recordings of all streams to files of their own, and end the process.

    Args:
        tree: has the package, with the core that is not changed.
        folder: of the files.
        frames: of a stream of a receiver; one of a sender has twice as many lines.
        part: number of this process, from 0 on, of those that share the work.
        parts: number of these processes.
    """
    _begin(tree)
    sys.dont_write_bytecode = False  # the processes of mutants need not compile it again
    for number, (recording, by_model) in enumerate(_recordings(frames)):
        if number % parts != part:
            continue
        model = [digest(by_model(step)) for step in recording.steps]
        answers = recording.make()
        digests = [digest(answers(step)) for step in recording.steps]
        if digests != model:
            where = next(i for i, one in enumerate(digests) if one != model[i])
            print(f"{recording.name}, step {where}: core and model differ", flush=True)
            os._exit(1)
        with (folder / f"{number:03}.pickle").open("wb") as file:
            pickle.dump(recording._replace(digests=digests), file)
    os._exit(0)


def _recordings(frames: int) -> Iterator[tuple[Recording, Callable[[Any], Any]]]:
    """Yield recordings without digests, and what answers their steps by the model."""
    import numpy as np
    from random_dbc import random_dbc

    from maplines_can.testing.back_to_back import START_US, ModelSide, Pair, profiles_of
    from maplines_can.testing.hostile_streams import Stream, traffics_of
    from maplines_can.testing.log_streams import logs
    from maplines_can.testing.log_streams import model_answer as parsed_by_model
    from maplines_can.testing.map_streams import model_answer, queries
    from maplines_can.testing.sender_comparison import STREAMS, streams_of
    from maplines_can.wire import SHIPPED, Layout, default_dbc_path

    steps: list[Any] = [*islice(logs(SEED), 2 * frames)]
    yield Recording("logs", _Logs(), steps, []), parsed_by_model
    for seed in range(MAP_STREAMS):
        steps = [*islice(queries(SEED + seed), frames // 4)]
        yield Recording(f"maps, {seed}", _Maps(), steps, []), model_answer
    shipped = [(name, Layout.from_dbc(default_dbc_path(name))) for name in SHIPPED]
    others = [(f"random {one}", Layout.from_text(random_dbc(one))) for one in RANDOM_DBCS]
    for place, (dbc, layout) in enumerate([*shipped, *others]):
        for stream in streams_of(layout):
            inputs = STREAMS[stream].inputs(layout, np.random.default_rng(SEED))
            count = frames // 2 if stream.startswith("scenes") else 2 * frames
            steps = [*islice(inputs, count)]
            name = f"{dbc}, {stream}"
            model = partial(STREAMS[stream].model, layout)
            yield Recording(name, _Sender(layout, stream), steps, []), model
        traffics = traffics_of(layout, SEED)
        for number, profile in enumerate(profiles_of(layout)):
            if place >= len(shipped) and (number - place) % len(RANDOM_DBCS):
                continue  # all of them take some of the profiles each
            sign = Pair(layout, profile).sign if profile.is_signed else None
            stream_of = Stream(traffics, profile, SEED + number, sign, START_US)
            steps = [*islice(stream_of.steps(), frames)]
            yield (
                Recording(f"{dbc}, {profile.name}", _Receiver(layout, profile), steps, []),
                ModelSide(layout, profile).take,
            )


def replay(tree: Path, files: Sequence[Path], first: int, said: Path) -> None:
    """Take the steps of recordings; end the process with ``DIFFERS`` at the first other answer.

    Args:
        tree: has the package, with the core that is tested.
        files: of the recordings.
        first: so many steps of each are taken first, then all.
        said: file for the name of the recording that is taken.
    """
    _begin(tree)
    for steps in (first, None):
        for file in files:
            said.write_text(file.name)
            with file.open("rb") as opened:
                recording: Recording = pickle.load(opened)  # noqa: S301 - written by record
            answers = recording.make()
            for step, expected in islice(
                zip(recording.steps, recording.digests, strict=True), steps
            ):
                if digest(answers(step)) != expected:
                    os._exit(DIFFERS)
    os._exit(0)


def _begin(tree: Path) -> None:
    os.setpgid(0, 0)  # a group of its own, as Runner expects
    os.chdir(tree)
    sys.dont_write_bytecode = True
    sys.path[:0] = [str(tree), str(tree / "tools")]
