"""Streams of random lines for the senders of core and model, and of records for their readers.

Each step gives both the same input, much of which exceeds the message, is singular, or is no
covariance. The records must be equal, and what is read of records to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from ..model import writer
from ..model.e2e import checksum
from ..model.places import Places
from ..model.records import complete, intact, written
from ..model.scene_sender import SceneDraft, SceneSender, SentScene
from ..propagation import map_scene
from ..values.errors import EncodeError, MaplinesError
from ..values.gaussian import Gaussian
from ..values.line import Kind, LeftOut, Slot
from ..values.polyline import Polyline
from ..values.scene import MapError, Scene
from ..wire import Codec, Frame, Layout, Owner

#: Range of the parameters of a random line.
SIZES = (32.0, 0.5, 0.125, 0.03125)
_VERDICTS = (None, "MIXED", "CRC", "CONTENT")
_FIELDS = (
    "mean", "cov", "kind", "status", "x_min", "x_max", "age", "component_index", "component_count",
    "component_weight", "counter",
)  # fmt: skip


class SenderStream(NamedTuple):
    """Inputs without end, and the answers of core and model to one."""

    inputs: Callable[[Layout, np.random.Generator], Iterator[Any]]
    core: Callable[[Codec, Any], Any]
    model: Callable[[Layout, Any], Any]
    steps: int  #: in a turn


def bits(value: Any) -> Any:
    """Return an answer in a form that is equal only if all bits are."""
    if isinstance(value, float | np.floating):
        return float(value).hex()
    if isinstance(value, np.ndarray):
        return bits(value.tolist())
    if isinstance(value, dict):
        return {str(key): bits(value[key]) for key in sorted(value, key=str)}
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
    if rng.random() < 0.05:  # covariances of a zero variance, or many times what variances admit
        i, j = rng.permutation(4)[:2]
        cov[i, i] *= rng.choice([0.0, 1.0])
        cov[i, j] = cov[j, i] = np.sqrt(s[i] * s[j]) * 10.0 ** rng.uniform(-25, 12)
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


def _lines(layout: Layout, rng: np.random.Generator) -> Iterator[Any]:
    """Yield lines, each with a counter."""
    while True:
        yield random_draft(rng, layout), _counter(rng, layout)


def _line_by_core(codec: Codec, given: Any) -> Any:
    line, counter = given
    component: dict[str, Any] = {
        "component_index": [line.index],
        "component_count": [line.count],
        "component_weight": [line.weight],
    }
    core = codec.batch.encode([line.mean], [line.cov], **_attributes(line, counter), **component)
    return core[0].tobytes()


def _line_by_model(layout: Layout, given: Any) -> Any:
    return writer.write(layout, *given)


def _mixtures(layout: Layout, rng: np.random.Generator) -> Iterator[Any]:
    """Yield mixtures: a line with a counter, and the weights, means and covariances."""
    most = int(layout["ComponentCount"].physical_range[1])
    for line, counter in _lines(layout, rng):
        k = int(rng.integers(1, most + 1))
        weights = np.maximum(rng.dirichlet(np.full(k, _choice(rng, 0.1, 1, 10))), 1e-6)
        weights /= weights.sum()
        cov = np.array(line.cov)
        sigma = np.sqrt(np.abs(np.diag(cov))) * _choice(rng, 0.1, 1, 5)
        means = line.mean + rng.normal(size=(k, 4)) * sigma
        covs = np.array([cov * rng.uniform(0.1, 2) for _ in range(k)])
        yield line, counter, weights.tolist(), means.tolist(), covs.tolist()


def _mixture_by_core(codec: Codec, given: Any) -> Any:
    line, counter, *mixture = given
    core = codec.batch.encode_mixtures(*([part] for part in mixture), **_attributes(line, counter))
    return [record.tobytes() for record in core[0]]


def _mixture_by_model(layout: Layout, given: Any) -> Any:
    line, counter, weights, means, covs = given
    return writer.write_mixture(layout, line, weights, means, covs, counter)


def _records(layout: Layout, rng: np.random.Generator) -> Iterator[Any]:
    """Yield complete records with their slots, many of random values or damaged."""
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
        yield slot, _damaged(record, layout.crc_offset, data_id, rng)


def _record_by_core(codec: Codec, given: Any) -> Any:
    slot, record = given
    batch = codec.batch.decode(np.frombuffer(record, np.uint8)[None], slot=[slot])
    verdict = _VERDICTS[int(batch.verdict[0])]
    return verdict or [getattr(batch, name)[0] for name in _FIELDS]


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


def _record_by_model(layout: Layout, given: Any) -> Any:
    slot, record = given
    raw = intact(layout, record, layout.messages[slot].data_id)
    found = raw if isinstance(raw, str) else complete(layout, slot, raw, 0)
    if isinstance(found, str):
        return found
    line = found.line
    return [
        line.mean, line.cov, line.kind, line.status, line.x_min, line.x_max, line.age, found.place,
        found.size, found.weight, found.counter,
    ]  # fmt: skip


def random_scene(rng: np.random.Generator, layout: Layout) -> Scene:
    """Return a scene of lines of a map; its pose error may be singular."""
    slots, most = [*layout.slots], 4 if layout.scene is None else _choice(rng, 4, 4, 8)
    x = np.arange(-60.0, 160.0, float(_choice(rng, 2, 5, 10, 20)))
    bend, twist = rng.uniform(-3e-3, 3e-3), rng.uniform(-2e-5, 2e-5)
    roads = {}
    for k, slot in enumerate(rng.permutation(slots)[: rng.integers(1, most + 1)]):
        y = _choice(rng, 3.5, 3.5, 12.0) * k - 5 + rng.uniform(-1, 1) + bend * x**2 + twist * x**3
        roads[Slot(int(slot))] = Polyline(np.column_stack([x, y]))
    B = rng.normal(size=(3, 3)) * 10.0 ** rng.uniform([-2, -2, -4], [0, 0, -1.5])[:, None]
    B[:, : rng.choice([0, 0, 0, 1, 2, 3])] = 0
    B[rng.choice(3) :] *= _choice(rng, 1, 1, 1, 0)
    error = MapError(
        point_sigma=float(_choice(rng, 0.0, 0.03, 0.1)),
        offset_sigma=float(_choice(rng, 0.0, 0.05, 0.5)),
        heading_sigma=float(_choice(rng, 0.0, 1e-3)),
    )
    window = _choice(rng, (-20.0, 80.0), (-8.0, 60.0), (-30.0, 130.0), (0.0, 15.0))
    found = map_scene(
        roads,
        Gaussian(np.zeros(3), B @ B.T),
        map_error=_choice(rng, None, error, error),
        window=window,
        correlation_time=float(_choice(rng, math.inf, 10.0 ** rng.uniform(-3, 4))),
    )
    return _altered(rng, found) if rng.random() < 0.3 and found.lines else found


def _altered(rng: np.random.Generator, scene: Scene) -> Scene:
    """Return a scene with a line, or with its range or covariance, that no map has."""
    i, n = int(rng.integers(len(scene.lines))), 4 * len(scene.lines)
    scale, means = np.ones(n), [line.gaussian.mean for line in scene.lines]
    ranges, specific = scene.fit_ranges + 0.0, scene.specific_covs
    pose = scene.pose_error
    match rng.integers(5):
        case 0:
            scale[4 * i : 4 * i + 4] = 10.0 ** rng.uniform(0, _choice(rng, 2, 5, 60))
        case 1:
            means[i] = means[i] * 10.0 ** rng.uniform(0, _choice(rng, 1, 2, 60))
        case 2:
            ranges[i] += rng.uniform(-200, 200, 2)
        case 3:
            pose = replace(pose, cov=pose.cov * 10.0 ** rng.uniform(0, 20))
        case _:
            specific = None
    cov = scene.cov * np.outer(scale, scale)
    if specific is not None:
        specific = specific * scale.reshape(-1, 4, 1) * scale.reshape(-1, 1, 4)
    blocks = (cov[k : k + 4, k : k + 4] for k in range(0, n, 4))
    lines = tuple(
        replace(line, gaussian=Gaussian(mean, block))
        for line, mean, block in zip(scene.lines, means, blocks, strict=True)
    )
    return replace(
        scene, lines=lines, cov=cov, fit_ranges=ranges, specific_covs=specific, pose_error=pose
    )


def _scenes(layout: Layout, rng: np.random.Generator) -> Iterator[Any]:
    """Yield scenes with their counters, ages, and whether they are sent as CAN FD."""
    has_fd = all(own.fd_can_id is not None for own in layout.messages_of.values())
    owners = [*layout.messages_of]
    while True:
        try:
            scene = random_scene(rng, layout)
        except (MaplinesError, ValueError):  # a line is no function of x, or a range is empty
            continue
        counters = {owner: int(rng.integers(256)) for owner in owners}
        ages = {owner: float(_choice(rng, rng.uniform(0, 0.1), math.inf)) for owner in owners}
        is_fd = layout.scene is not None or bool(rng.random() < 0.3)
        yield scene, counters, ages, is_fd and has_fd


def _scene_by_core(codec: Codec, given: Any) -> Any:
    scene, counters, ages, fd = given
    encoder = codec.encoder()
    try:
        prepared = encoder.prepare_scene(scene, fd=fd)
        frames = encoder.encode_scene(prepared, age=ages, fd=fd, counters=counters)
    except EncodeError:
        return None
    if codec.layout.scene is None:
        return _sent(frames), _names(prepared.left_out)
    return _sent(frames), _names(encoder.left_out(prepared, fd=fd))


def _sent(frames: Mapping[Owner, Sequence[Frame]]) -> list[Any]:
    """Return the payloads of each owner in the order of sending."""
    return [(str(o), b"".join(bytes(one.data) for one in of)) for o, of in frames.items()]


def _names(left_out: Mapping[Slot, LeftOut]) -> dict[str, str]:
    return {slot.name: why.name for slot, why in left_out.items()}


@cache
def _scene_sender(layout: Layout) -> SceneSender:
    assert layout.pose is not None  # noqa: S101 - else it has no scenes
    return SceneSender(layout, layout.pose)


def _scene_by_model(layout: Layout, given: Any) -> Any:
    """Return the records, those of CAN FD with their padding, and why lines have none."""
    scene, counters, ages, fd = given
    found = _scene_sender(layout).send(scene_draft(scene), counters, ages, full=fd)
    return None if found is None else _sent_by_model(layout, scene, found, fd=fd)


def _sent_by_model(layout: Layout, scene: Scene, found: SentScene, *, fd: bool) -> Any:
    sent = [
        (str(owner), record.ljust(layout.messages_of[owner].fd_length if fd else 0, b"\0"))
        for owner, record in found.records.items()
    ]
    without = found.left_out if layout.is_conditional else {}
    return sent, _names(scene.left_out) | {slot.name: why for slot, why in without.items()}


def _sequences(layout: Layout, rng: np.random.Generator) -> Iterator[Any]:
    """Yield scenes of consecutive cycles, so lines come and go, with their age."""
    scenes = (scene for scene, *_ in _scenes(layout, rng))
    while True:
        yield [next(scenes) for _ in range(3)], float(rng.uniform(0, 0.1))


def _sequence_by_core(codec: Codec, given: Any) -> Any:
    (scenes, age), encoder, answers = given, codec.encoder(), list[Any]()
    for scene in scenes:
        try:
            frames = encoder.encode_scene(scene, age=age, fd=True)
        except EncodeError:
            answers.append(None)
        else:
            answers.append((_sent(frames), _names(encoder.left_out(scene, fd=True))))
    return answers


def _sequence_by_model(layout: Layout, given: Any) -> Any:
    (scenes, age), answers, last = given, list[Any](), Places()
    counters = dict.fromkeys(layout.messages_of, 0)
    for scene in scenes:
        ages = dict.fromkeys(counters, age)
        found = _scene_sender(layout).send(scene_draft(scene), counters, ages, last=last)
        answers.append(None if found is None else _sent_by_model(layout, scene, found, fd=True))
        if found is not None:
            counters = {owner: n + (owner in found.records) for owner, n in counters.items()}
            last = found.places
    return answers


def scene_draft(scene: Scene) -> SceneDraft:
    """Return a scene for the sender of the model."""
    known, specific = scene.map_error or MapError(), scene.specific_covs
    drafts = [
        writer.Draft(
            line.slot, line.gaussian.mean.tolist(), line.gaussian.cov.tolist(), int(line.kind),
            int(line.status), float(line.x_min), float(line.x_max),
        )
        for line in scene.lines
    ]  # fmt: skip
    return SceneDraft(
        drafts, scene.cov.tolist(), scene.pose_error.cov.tolist(),
        float(scene.pose_error.correlation_time), float(known.offset_sigma or 0.0),
        float(known.heading_sigma or 0.0), [tuple(ends) for ends in scene.fit_ranges.tolist()],
        scene.quartics.tolist(), None if specific is None else specific.tolist(),
    )  # fmt: skip


#: Streams of the package, by name.
PACKAGE_STREAMS = {
    "lines": SenderStream(_lines, _line_by_core, _line_by_model, 200),
    "mixtures": SenderStream(_mixtures, _mixture_by_core, _mixture_by_model, 200),
    "records": SenderStream(_records, _record_by_core, _record_by_model, 200),
    "scenes": SenderStream(_scenes, _scene_by_core, _scene_by_model, 10),
    "sequences": SenderStream(_sequences, _sequence_by_core, _sequence_by_model, 3),
}
