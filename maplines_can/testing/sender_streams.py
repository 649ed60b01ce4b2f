"""Streams of random lines for the senders of core and model, and of records for their readers.

Each step gives both the same input, much of which exceeds the message, is singular, or is no
covariance. The records must be equal, and what is read of records to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from ..model import writer
from ..model.e2e import checksum
from ..model.records import complete, intact, written
from ..model.scene_sender import SceneDraft, SceneSender
from ..propagation import map_scene
from ..values.errors import EncodeError, MaplinesError
from ..values.gaussian import Gaussian
from ..values.line import Kind, Slot
from ..values.map_error import MapError
from ..values.polyline import Polyline
from ..values.scene import Scene
from ..wire import POSE, Codec, Layout, Owner
from .back_to_back import Difference

#: Range of the parameters of a random line.
SIZES = (32.0, 0.5, 0.125, 0.03125)
_VERDICTS = (None, "MIXED", "CRC", "CONTENT")
_FIELDS = (
    "mean", "cov", "kind", "status", "x_min", "x_max", "age", "component_index", "component_count",
    "component_weight", "counter",
)  # fmt: skip


class SenderStep(NamedTuple):
    """One input, and both answers to it."""

    input: Any
    core: Any
    model: Any


class SenderComparison(NamedTuple):
    """Result of the comparison of streams."""

    records: int  #: that were equal
    difference: Difference | None  #: the first one, which ended it

    def __str__(self) -> str:
        """Return the result as text."""
        if self.difference is not None:
            return f"core and model differ: {self.difference}"
        return f"bit-identical on {self.records} records of senders"


def bits(value: Any) -> Any:
    """Return an answer in a form that is equal only if all bits are."""
    if isinstance(value, float | np.floating):
        return float(value).hex()
    if isinstance(value, np.ndarray):
        return bits(value.tolist())
    if isinstance(value, dict):
        return {str(key): bits(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [bits(item) for item in value]
    return int(value) if isinstance(value, int | np.integer) else value


def _choice(rng: np.random.Generator, *values: Any) -> Any:
    return values[rng.integers(len(values))]


def random_cov(rng: np.random.Generator) -> Any:
    """Return a covariance of any size and condition, singular, zero, or a matrix that is none."""
    B = rng.normal(size=(4, 4)) * 10.0 ** rng.uniform(-1, 1, (4, 1))
    B[:, : rng.choice([0, 0, 0, 1, 2, 3])] = 0
    s = 10.0 ** rng.uniform([-4, -5, -7, -9], [1, -0.5, -1.5, -3]) * _choice(rng, 1, 1, 1, 1e3)
    cov = B @ B.T * np.outer(s, s)
    if rng.random() < 0.15:
        i, j = rng.integers(0, 4, 2)
        cov[i, j] = cov[j, i] = cov[i, j] * rng.uniform(-3, 3)
        np.fill_diagonal(cov, np.abs(np.diag(cov)))
    return (cov + cov.T) / 2 * _choice(rng, 1, 1, 1, 1, 0, 10.0 ** rng.uniform(-20, 20))


def random_draft(rng: np.random.Generator, layout: Layout) -> writer.Draft:
    """Return a line, some of whose values exceed the message."""
    mean = rng.uniform(-1, 1, 4) * SIZES * _choice(rng, 0.3, 0.3, 1, 3)
    mean *= _choice(rng, [1, 1, 1, 1], [1, 1, 1e-2, 1e-4], [1, 1, 1, 1e-3])
    if rng.random() < 0.01:
        mean *= 10.0 ** rng.uniform(0, 100)
    x_min = float(_choice(rng, rng.uniform(-20, 8), rng.uniform(-60, 60), -8.0))
    most = int(layout["ComponentCount"].physical_range[1])
    count = int(_choice(rng, 1, 1, 1, rng.integers(1, most + 1)))
    return writer.Draft(
        slot=Slot(_choice(rng, *layout.messages)),
        mean=mean.tolist(),
        cov=random_cov(rng).tolist(),
        kind=int(rng.integers(len(Kind))),
        status=int(rng.choice([1, 1, 1, 1, 0, 2, 3, 4, 5])),
        x_min=x_min,
        x_max=x_min + float(_choice(rng, rng.uniform(0, 130), rng.uniform(0, 130), 0.0, 4.0)),
        age=float(_choice(rng, rng.uniform(0, 0.3), 0.0, 0.008, 5.0, math.inf)),
        index=int(rng.integers(count)),
        count=count,
        weight=float(rng.uniform(1e-3, 1)) if count > 1 else 1.0,
    )


def _attributes(line: writer.Draft, counter: int) -> dict[str, Any]:
    names = ("slot", "kind", "status", "x_min", "x_max", "age")
    return {name: [getattr(line, name)] for name in names} | {"counter": [counter]}


def _counter(rng: np.random.Generator, layout: Layout) -> int:
    return int(rng.integers(2 ** layout["Counter"].length))


def lines(codec: Codec, rng: np.random.Generator) -> Iterator[SenderStep]:
    """Yield lines as complete records."""
    while True:
        line, counter = random_draft(rng, codec.layout), _counter(rng, codec.layout)
        component: dict[str, Any] = {
            "component_index": [line.index],
            "component_count": [line.count],
            "component_weight": [line.weight],
        }
        core = codec.batch.encode(
            [line.mean], [line.cov], **_attributes(line, counter), **component
        )
        yield SenderStep(line, core[0].tobytes(), writer.write(codec.layout, line, counter))


def mixtures(codec: Codec, rng: np.random.Generator) -> Iterator[SenderStep]:
    """Yield mixtures as complete records: their weights, and what covers them."""
    layout = codec.layout
    most = int(layout["ComponentCount"].physical_range[1])
    while True:
        line, counter = random_draft(rng, layout), _counter(rng, layout)
        k = int(rng.integers(1, most + 1))
        weights = np.maximum(rng.dirichlet(np.full(k, _choice(rng, 0.1, 1, 10))), 1e-6)
        weights /= weights.sum()
        cov = np.array(line.cov)
        sigma = np.sqrt(np.abs(np.diag(cov))) * _choice(rng, 0.1, 1, 5)
        means = line.mean + rng.normal(size=(k, 4)) * sigma
        covs = np.array([cov * rng.uniform(0.1, 2) for _ in range(k)])
        core = codec.batch.encode_mixtures(
            [weights], [means], [covs], **_attributes(line, counter)
        )[0]
        model = writer.write_mixture(
            layout, line, weights.tolist(), means.tolist(), covs.tolist(), counter
        )
        yield SenderStep((line, weights, means, covs), [record.tobytes() for record in core], model)


def records(codec: Codec, rng: np.random.Generator) -> Iterator[SenderStep]:
    """Yield what complete records say, many of them of random values or damaged."""
    layout = codec.layout
    while True:
        slot = Slot(_choice(rng, *layout.messages))
        data_id = layout.messages[slot].data_id
        if rng.random() < 0.5:
            raw = {
                signal.name: int(rng.integers(signal.all_raw[0], signal.all_raw[1] + 1))
                for signal in layout.signals.values()
            }
            record = written(layout, raw, data_id)
        else:
            record = writer.write(layout, random_draft(rng, layout), _counter(rng, layout))
        record = _damaged(record, layout.crc_offset, data_id, rng)
        batch = codec.batch.decode(np.frombuffer(record, np.uint8)[None], slot=[slot])
        core: Any = _VERDICTS[int(batch.verdict[0])]
        if core is None:
            core = [getattr(batch, name)[0] for name in _FIELDS]
        yield SenderStep(record.hex(), core, _read(layout, record, slot, data_id))


def _damaged(record: bytes, crc_byte: int, data_id: int, rng: np.random.Generator) -> bytes:
    """Return a record with some other bits, of which some have a good checksum."""
    changed = bytearray(record)
    for _ in range(rng.integers(0, 4)):
        bit = int(rng.integers(8 * len(changed)))
        changed[bit // 8] ^= 1 << bit % 8
    if rng.random() < 0.5:
        crc = checksum(bytes(changed), crc_byte, data_id)
        changed[crc_byte : crc_byte + 2] = crc.to_bytes(2, "little")
    return bytes(changed)


def _read(layout: Layout, record: bytes, slot: Slot, data_id: int) -> Any:
    raw = intact(layout, record, data_id)
    found = raw if isinstance(raw, str) else complete(layout, slot, raw, 0)
    if isinstance(found, str):
        return found
    line = found.line
    return [
        line.mean, line.cov, line.kind, line.status, line.x_min, line.x_max, line.age, found.place,
        found.size, found.weight, found.counter,
    ]  # fmt: skip


def random_scene(rng: np.random.Generator, slots: Sequence[Slot]) -> Scene:
    """Return a scene of lines of a map, some of which exceed the message."""
    x = np.arange(-60.0, 160.0, float(_choice(rng, 2, 5, 10, 20)))
    bend, twist = rng.uniform(-3e-3, 3e-3), rng.uniform(-2e-5, 2e-5)
    chosen = rng.permutation([*slots])[: rng.integers(1, 5)]
    roads = {
        Slot(int(slot)): Polyline(
            np.column_stack(
                [
                    x,
                    _choice(rng, 3.5, 3.5, 12.0) * k
                    - 5
                    + rng.uniform(-1, 1)
                    + bend * x**2
                    + twist * x**3,
                ]
            )
        )
        for k, slot in enumerate(chosen)
    }
    B = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform([-2, -2, -4], [0, 0, -1.5])[:, None]
    pose = Gaussian(np.zeros(3), B @ B.T)
    error = MapError(
        point_sigma=float(_choice(rng, 0.0, 0.03, 0.1)),
        offset_sigma=float(_choice(rng, 0.0, 0.05, 0.5)),
        heading_sigma=float(_choice(rng, 0.0, 1e-3)),
    )
    window = _choice(rng, (-20.0, 80.0), (-8.0, 60.0), (-30.0, 130.0), (0.0, 15.0))
    return map_scene(roads, pose, map_error=_choice(rng, None, error, error), window=window)


def scenes(codec: Codec, rng: np.random.Generator) -> Iterator[SenderStep]:
    """Yield scenes as the record of the pose error and the records of lines."""
    layout, pose = codec.layout, codec.layout.pose
    if pose is None:
        return
    sender = SceneSender(layout, pose)
    while True:
        try:
            scene = random_scene(rng, [*layout.messages])
        except MaplinesError:  # a line is no function of x
            continue
        owners: list[Owner] = [POSE, *layout.messages]
        counters = {owner: int(rng.integers(256)) for owner in owners}
        ages = {owner: float(rng.uniform(0, 0.1)) for owner in owners}
        fd = bool(rng.random() < 0.3)
        try:
            frames = codec.encoder().encode_scene(scene, age=ages, fd=fd, counters=counters)
        except EncodeError:
            core = None
        else:
            core = {str(o): b"".join(bytes(f.data) for f in of) for o, of in frames.items()}
        found = sender.send(_scene_draft(scene), counters, ages, full=fd)
        model = None if found is None else found.records
        yield SenderStep(scene, core, _padded(model, core or {}))


def _padded(
    records_of: dict[Owner, bytes] | None, core: dict[str, bytes]
) -> dict[str, bytes] | None:
    """Return records with the padding of CAN FD."""
    if records_of is None:
        return None
    lengths = {owner: len(sent) for owner, sent in core.items()}
    return {
        str(owner): record.ljust(lengths.get(str(owner), 0), b"\0")
        for owner, record in records_of.items()
    }


def _scene_draft(scene: Scene) -> SceneDraft:
    known = scene.map_error or MapError()
    drafts = [
        writer.Draft(
            line.slot, line.gaussian.mean.tolist(), line.gaussian.cov.tolist(), int(line.kind),
            int(line.status), float(line.x_min), float(line.x_max),
        )
        for line in scene.lines
    ]  # fmt: skip
    specific = scene.specific_covs
    return SceneDraft(
        drafts, scene.cov.tolist(), scene.pose_error.cov.tolist(),
        float(scene.pose_error.correlation_time), float(known.offset_sigma or 0.0),
        float(known.heading_sigma or 0.0), [tuple(ends) for ends in scene.fit_ranges.tolist()],
        scene.quartics.tolist(), None if specific is None else specific.tolist(),
    )  # fmt: skip


#: Streams, and their steps in a turn.
STREAMS = {lines: 200, mixtures: 200, records: 200, scenes: 10}
#: Those that records of lines without a covariance of their own have.
CONDITIONAL = (scenes,)


def compare_senders(
    layouts: Sequence[Layout], seed: int, is_over: Callable[[], bool]
) -> SenderComparison:
    """Compare core and model on the streams of DBCs, in turn, until it is over.

    Args:
        layouts: of the DBCs.
        seed: of all streams, which are the same ones on any machine.
        is_over: asked after a turn of each stream.
    """
    streams = [
        (f"{layout.source}, {stream.__name__}, seed {seed}",
         stream(Codec(layout), np.random.default_rng(seed)), STREAMS[stream])
        for layout in layouts
        for stream in streams_of(layout)
    ]  # fmt: skip
    done = turn = 0
    while True:
        for name, steps, count in streams:
            found = compare_steps(name, steps, turn * count, count)
            done += found.records
            if found.difference is not None:
                return SenderComparison(done, found.difference)
            if is_over():
                return SenderComparison(done, None)
        turn += 1


def streams_of(layout: Layout) -> list[Callable[..., Iterator[SenderStep]]]:
    """Return the streams that a DBC can have."""
    if layout.is_conditional:
        return [*CONDITIONAL]
    return [stream for stream in STREAMS if stream is not scenes or layout.pose is not None]


def compare_steps(
    name: str, steps: Iterator[SenderStep], first: int, count: int
) -> SenderComparison:
    """Compare some steps of a stream, numbered from ``first`` on, up to the first difference."""
    for done, step in enumerate(islice(steps, count)):
        core, model = bits(step.core), bits(step.model)
        if core != model:
            shown = str(step.input), "the answer", str(core), str(model)
            return SenderComparison(done, Difference(name, first + done, *shown))
    return SenderComparison(count, None)
