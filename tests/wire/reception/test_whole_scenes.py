"""Decoder of whole scenes: any bits, views, rows of a block, and authenticated frames.

``tests/model/test_whole_scenes.py`` has what becomes of each record, beside the model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import chain

import numpy as np
from evidence.exact import is_positive_definite
from scene_layouts import layout_of
from support.scene_streams import new_codec, road_scene

from maplines_can import Codec, Decoder, MapLine, Reason, Slot
from maplines_can.model.whole_scenes import NONE, scene_of_dbc, write_whole
from maplines_can.wire import Frame
from maplines_can.wire.layout.pose_layout import SCENE, SCENE2, SceneOwner

DBC = "maplines-scene.dbc"
LAYOUT = layout_of(DBC)
SCENES = scene_of_dbc(LAYOUT)
CYCLE = 50_000_000
LEFT, RIGHT, NEXT_LEFT, NEXT_RIGHT, CENTRE, EDGE_LEFT, EDGE_RIGHT, ROUTE = Slot
FEW, MANY = (LEFT, RIGHT, NEXT_LEFT, ROUTE), (LEFT, RIGHT, NEXT_LEFT, ROUTE, EDGE_LEFT, EDGE_RIGHT)


def record_of(
    owner: SceneOwner, counter: int, places: Sequence[Mapping[str, int]], **raw: int
) -> bytes:
    """Return a record with these raw values of the pose error, and of the line at each place."""
    shared = {"SceneCounter": counter, **raw, "Counter": counter}
    data_id = SCENES.messages[owner].data_id
    return write_whole(SCENES, shared, places, SCENES.record_bytes, data_id)


def feed(
    decoder: Decoder, owner: SceneOwner, record: bytes, t_ns: int
) -> Sequence[MapLine] | Reason:
    can_id = SCENES.messages[owner].fd_can_id
    assert can_id is not None
    return decoder.feed(can_id, record, t_ns)


def lines_of(found: Sequence[MapLine] | Reason) -> Sequence[MapLine]:
    assert not isinstance(found, Reason)
    return found


def checked(decoder: Decoder) -> Decoder:
    """Return a decoder whose numbers of frames add up."""
    known = decoder.line_frames + decoder.pose_frames + decoder.counts.total() + decoder.pending
    assert decoder.frames == known
    assert (decoder.line_frames, decoder.pending) == (0, 0)
    return decoder


# ---- any bits ---------------------------------------------------------------------------------


def any_line(rng: np.random.Generator, slot: int | None) -> dict[str, int]:
    """Return raw values of a place: all bits of most signals, means of any size."""
    own = {name: signal.length for name, signal in SCENES.line.items() if name != "Slot"}
    raw = {name: int(rng.integers(0, 2**length)) for name, length in own.items()}
    raw["Kind"] = int(rng.integers(0, NONE + 1))
    for name in ("Beta", "C0", "C1"):
        bits = SCENES.line[name].length - 1
        raw[name] = int(2 ** rng.uniform(0, bits)) * int(rng.choice([-1, 1]))
    raw["XMax"] = max(raw["XMax"], raw["XMin"] - 31)
    return raw if slot is None else raw | {"Slot": slot}


def test_any_bits_are_a_positive_definite_joint() -> None:
    """Also those that no sender writes: whatever is not rejected has a joint covariance."""
    rng, decoder, lines = np.random.default_rng(5), new_codec(DBC).decoder(), 0
    pose = [name for name in SCENES.signals if name.startswith(("Pivot", "Ratio", "Map"))]
    for counter in range(400):
        names = [*pose, "Age", "CorrelationTime", "Inflation"]
        raw = {name: int(rng.integers(0, 2 ** SCENES[name].length)) for name in names}
        free = rng.permutation([2, 3, 4, 7]).tolist()
        for owner in (SCENE2, SCENE):
            places = [any_line(rng, slot) for slot in (None, None, free.pop(), free.pop())]
            joint = counter % 8
            record = record_of(owner, counter % 256, places, **raw | {"SceneCounter": joint})
            found = feed(decoder, owner, record, counter * CYCLE)
            for line in found if not isinstance(found, Reason) else ():
                assert np.linalg.eigvalsh(correlations(line.gaussian.cov))[0] > 0
        received = decoder.scene()
        if received is not None and received.t_ns == counter * CYCLE and received.scene.lines:
            assert np.isfinite(received.scene.cov).all()
            np.linalg.cholesky(correlations(received.scene.cov))
            assert counter % 10 or is_positive_definite(received.scene.cov.tolist())  # exactly
            lines += len(received.scene.lines)

    assert lines > 400
    assert checked(decoder).counts.keys() == {Reason.CONTENT}


def correlations(cov: np.ndarray) -> np.ndarray:
    sigma = np.sqrt(cov.diagonal())
    return cov / sigma / sigma[:, None]


# ---- rows -------------------------------------------------------------------------------------


def sent_scenes(codec: Codec, slots: Sequence[Slot], cycles: int) -> list[list[Frame]]:
    """Return the frames of each cycle."""
    encoder = codec.encoder()
    scenes = (road_scene(slots, radius=200 + counter) for counter in range(cycles))
    return [[*chain(*encoder.encode_scene(scene, fd=True).values())] for scene in scenes]


def test_rows_of_a_block_are_what_feed_returns() -> None:
    """Counter, step and state of a row are those of the message that brought the line."""
    codec = new_codec(DBC)
    cycles = sent_scenes(codec, MANY, 12)
    del cycles[5], cycles[8][0]
    frames = [(frame, k * CYCLE) for k, cycle in enumerate(cycles) for frame in cycle]
    one, block = codec.decoder(), codec.decoder()
    expected = []
    for i, (frame, t_ns) in enumerate(frames):
        found = one.feed(frame.can_id, frame.data, t_ns)
        owner = SCENE if frame.can_id == SCENES.messages[SCENE].fd_can_id else SCENE2
        check = one.checks[owner]
        expected += [
            (i, int(line.slot), check.counter, check.ahead or 0, int(check.state))
            for line in lines_of(found)
        ]
    n = len(frames)
    reasons = np.zeros(n, np.uint8)
    rows, _, scenes = block.feed_arrays(
        np.array([frame.can_id for frame, _ in frames], np.uint32), np.zeros(n, bool),
        np.array([t_ns for _, t_ns in frames]), np.full(n, 64, np.uint8),
        np.array([[*frame.data] for frame, _ in frames], np.uint8), np.arange(n), reasons, 2,
    )  # fmt: skip

    names = ("frame", "slot", "counter", "ahead", "state")
    assert [tuple(map(int, row)) for row in zip(*(rows[name] for name in names), strict=True)] == (
        expected
    )
    assert (reasons == 255).all()
    assert [int(row["counter"]) for row in scenes] == [*range(5), *range(6, 12)]
    assert [int(row["count"]) for row in scenes] == [len(MANY)] * 8 + [4] + [len(MANY)] * 2
    assert block.messages(0).keys() == one.messages(0).keys() == {SCENE, SCENE2}
