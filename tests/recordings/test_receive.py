"""Blocks of frames on a faulty, hostile bus: the lines, reasons and counters of frame by frame."""

from __future__ import annotations

import random
from typing import Any

import numpy as np
import pytest
from scene_layouts import layout_of
from support.scene_streams import PERIOD_NS, authenticated_codec, road_scene

from maplines_can import MapLine
from maplines_can.recordings.block_reception import COMPLETE, REASONS, LineBlock, LogReceiver
from maplines_can.recordings.blocks import FrameBlock
from maplines_can.testing.hostile_streams import PROFILES, FrameStep, Stream, traffics_of
from maplines_can.wire import POSE, Codec, Decoder, E2EState, Owner, Reason

FRAMES = 150


class Recorder:
    """Frames, and what a decoder says of each."""

    def __init__(self, codec: Codec, **settings: Any) -> None:
        self.decoder, self.layout = codec.decoder(**settings), codec.layout
        self.frames: list[tuple[int, bytes, int, bool]] = []
        self.lines: list[tuple[int, MapLine, Any]] = []
        self.reasons: list[int] = []
        self.scenes: list[Any] = []

    def frame(self, can_id: int, data: bytes, t_ns: int, *, is_extended: bool = False) -> None:
        decoder = self.decoder
        found = decoder.feed(can_id, data, t_ns, is_extended=is_extended)
        number = len(self.frames)
        if not isinstance(found, Reason):
            for line in found:
                owner = line.slot if self.layout.scene is None else self._message(can_id)
                check = decoder.checks[owner]
                about = check.counter, check.ahead or 0, check.status, self._state(owner, t_ns)
                self.lines.append((number, line, about))
        self.reasons.append(REASONS.index(found) if isinstance(found, Reason) else COMPLETE)
        self.frames.append((can_id, data, t_ns, is_extended))
        if self.layout.pose is not None and (scene := decoder.scene()) is not None:
            if self.scenes and self.scenes[-1][1:3] == scene[1:3]:
                self.scenes[-1] = scene
            else:
                self.scenes.append(scene)

    def _message(self, can_id: int) -> Owner:
        return self.layout.message_of_id[can_id, False][0]

    def _state(self, owner: Owner, t_ns: int) -> Any:
        checks = [self.decoder.checks[owner]]
        if POSE in self.decoder.checks and self.decoder.is_conditional:
            checks.append(self.decoder.checks[POSE])
        states = [one.state.name for one in checks]
        return states, all(one.has_one_sender(t_ns) for one in checks)


def block_of(frames: list[tuple[int, bytes, int, bool]], channels: list[int]) -> FrameBlock:
    length = [min(len(data), 64) for _, data, _, _ in frames]
    width = 8 if max(length) <= 8 else 64
    data = b"".join(data[:width].ljust(width, b"\0") for _, data, _, _ in frames)
    return FrameBlock(
        can_id=np.array([one[0] for one in frames], np.uint32),
        is_extended=np.array([one[3] for one in frames]),
        t_ns=np.array([one[2] for one in frames]),
        has_time=np.ones(len(frames), bool),
        channel=np.array(channels, np.uint16),
        length=np.array(length, np.uint8),
        data=np.frombuffer(data, np.uint8).reshape(-1, width),
        channels=("a", "b", "c"),
    )


def in_blocks(
    receiver: LogReceiver, frames: list[Any], channels: list[int], seed: int
) -> list[LineBlock]:
    """Feed frames in blocks of random sizes, to the end."""
    rng, found, begin = random.Random(seed), [], 0  # noqa: S311
    while begin < len(frames):
        end = begin + rng.choice([1, 2, 50, 300])
        found.append(receiver.feed(block_of(frames[begin:end], channels[begin:end])))
        begin = end
    return [*found, receiver.finish()]


def check_line(row: Any, components: Any, number: int, line: MapLine, about: Any) -> None:
    counter, ahead, status, (states, has_one_sender) = about
    assert (row["frame"], row["t_ns"], row["slot"]) == (number, line.t_ns, line.slot)
    assert (row["kind"], row["status"]) == (line.kind, line.status)
    assert (row["x_min"], row["x_max"], row["age"]) == (line.x_min, line.x_max, line.age)
    assert row["mean"].tobytes() == line.gaussian.mean.tobytes()
    assert row["cov"].tobytes() == np.ascontiguousarray(line.gaussian.cov).tobytes()
    assert (row["counter"], row["ahead"], row["e2e_status"]) == (counter, ahead, status)
    state = states[-1] if states[0] == "VALID" else states[0]
    assert row["state"] == E2EState[state]
    assert row["two_senders"] != has_one_sender
    assert row["usable"] == (line.is_usable and state == "VALID" and has_one_sender)
    if line.mixture is None:
        assert (row["components"], len(components)) == (1, 0)
        return
    assert row["components"] == len(components)
    assert components["weight"].tobytes() == line.mixture.weights.tobytes()
    assert components["mean"].tobytes() == line.mixture.means.tobytes()
    assert components["cov"].tobytes() == line.mixture.covs.tobytes()


def check(blocks: list[LineBlock], expected: Recorder, *, scenes: bool) -> None:
    """Compare all of one channel."""
    reasons = [one for block in blocks for one in block.reasons.tolist()]
    assert reasons == expected.reasons
    rows = [
        (row, block.components[block.components["line"] == k])
        for block in blocks
        for k, row in enumerate(block.lines)
    ]
    assert len(rows) == len(expected.lines)
    for (row, components), one in zip(rows, expected.lines, strict=True):
        check_line(row, components, *one)
    found = [row for block in blocks for row in block.scenes]
    assert len(found) == scenes * len(expected.scenes)
    for row, received in zip(found, expected.scenes, strict=False):
        scene, n = received.scene, len(received.scene.lines)
        assert (row["counter"], row["t_ns"], row["age"]) == received[1:]
        assert row["slots"][: row["count"]].tolist() == [line.slot for line in scene.lines]
        assert row["mean"][:n].tobytes() == scene.means.tobytes()
        assert row["cov"][: 4 * n, : 4 * n].tobytes() == np.asarray(scene.cov).tobytes()


def numbers_of(decoder: Decoder) -> Any:
    stats = {owner: check.stats() for owner, check in decoder.checks.items()}
    names = ["frames", "lines", "line_frames", "pose_errors", "pose_frames", "lost", "pending"]
    return [getattr(decoder, name) for name in names], decoder.counts, stats


@pytest.mark.parametrize("dbc", ["maplines.dbc", "maplines-pose.dbc", "maplines-scene.dbc"])
def test_streams_are_received_as_frame_by_frame(dbc: str) -> None:
    """Clean traffic, faults, hostile bytes, clock faults, two senders, restarts, duplicates."""
    codec = Codec(layout_of(dbc))
    for seed, profile in enumerate(PROFILES):
        expected, frames = recorded(codec, dbc, profile, seed)
        settings = {k: v for k, v in profile.settings.items() if k in ("cycle_ms", "timeout_ms")}
        receiver = LogReceiver(codec, scenes=True, **settings)
        blocks = in_blocks(receiver, frames, [0] * len(frames), seed)
        check(blocks, expected, scenes=True)
        assert numbers_of(receiver.decoders["a"]) == numbers_of(expected.decoder), profile.name


def recorded(codec: Codec, dbc: str, profile: Any, seed: int) -> tuple[Recorder, list[Any]]:
    """Return a stream of a profile, and what frame by frame says of it."""
    settings = {k: v for k, v in profile.settings.items() if k in ("cycle_ms", "timeout_ms")}
    recorder = Recorder(codec, **settings)
    for step in Stream(traffics_of(layout_of(dbc), seed), profile, seed).steps():
        if isinstance(step, FrameStep):
            t_ns = max(-(2**62), min(step.t_ns, 2**62))
            recorder.frame(step.can_id, step.data[:64], t_ns, is_extended=step.is_extended)
        if len(recorder.frames) == (FRAMES if codec.layout.scene is None else FRAMES // 4):
            break  # a frame of a whole scene has as much as four
    recorder.decoder.expire(recorder.frames[-1][2] + 10**18)
    return recorder, recorder.frames


@pytest.mark.parametrize("dbc", ["maplines-secoc.dbc", "maplines-scene.dbc"])
def test_authenticated_streams_are_received_as_frame_by_frame(dbc: str) -> None:
    """Forged and replayed frames, among others and in blocks of any size."""
    rng, codec = random.Random(4), authenticated_codec(dbc)  # noqa: S311
    encoder, expected = codec.encoder(), Recorder(codec)
    for cycle in range(60):
        for own in encoder.encode_scene(road_scene(), fd=True).values():
            for can_id, data, _, is_extended in own:
                forged = bytes([data[0], data[1] ^ 1, *data[2:]])
                for one in rng.choice([[data], [data], [data, data], [forged, data], [data[:20]]]):
                    expected.frame(can_id, one, cycle * PERIOD_NS, is_extended=is_extended)
    frames = expected.frames
    expected.decoder.expire(frames[-1][2] + 10**18)
    receiver = LogReceiver(codec, scenes=True)
    blocks = in_blocks(receiver, frames, [0] * len(frames), 2)
    check(blocks, expected, scenes=True)
    assert numbers_of(receiver.decoders["a"]) == numbers_of(expected.decoder)
    assert expected.decoder.lines > 50
    assert {Reason.MAC, Reason.REPLAY, Reason.LENGTH} <= expected.decoder.counts.keys()


def test_channels_have_decoders_of_their_own() -> None:
    """Three channels in one log: each one's lines are those of the channel alone, in file order."""
    codec, dbc = Codec(layout_of("maplines.dbc")), "maplines.dbc"
    parts = [recorded(codec, dbc, PROFILES[n], n) for n in range(3)]
    rng = random.Random(0)  # noqa: S311
    channels = [n for n, (_, frames) in enumerate(parts) for _ in frames]
    rng.shuffle(channels)
    rest = [iter(frames) for _, frames in parts]
    frames = [next(rest[channel]) for channel in channels]
    receiver = LogReceiver(codec)
    blocks = in_blocks(receiver, frames, channels, 0)
    order = np.concatenate([block.lines["frame"] for block in blocks])
    assert (np.diff(order) >= 0).all()
    place = {n: np.flatnonzero(np.array(channels) == n) for n in range(3)}
    for n, (expected, _) in enumerate(parts):
        rows = [
            (row, block.components[block.components["line"] == k])
            for block in blocks
            for k, row in enumerate(block.lines)
            if block.channel[k] == n
        ]
        assert len(rows) == len(expected.lines)
        for (row, components), (number, line, about) in zip(rows, expected.lines, strict=True):
            check_line(row, components, place[n][number], line, about)
        assert numbers_of(receiver.decoders["abc"[n]])[:2] == numbers_of(expected.decoder)[:2]
    reasons = np.concatenate([block.reasons for block in blocks])
    for n, (expected, _) in enumerate(parts):
        assert reasons[place[n]].tolist() == expected.reasons


def test_frames_beyond_256_channels_are_counted() -> None:
    receiver = LogReceiver(Codec(layout_of("maplines.dbc")))
    block = block_of([(0x340, bytes(8), k, False) for k in range(300)], [0] * 300)
    names = tuple(f"can{k}" for k in range(300))
    many = FrameBlock(
        **{**vars(block), "channel": np.arange(300, dtype=np.uint16), "channels": names}
    )
    receiver.feed(many)
    assert (len(receiver.decoders), receiver.beyond, receiver.frames) == (256, 44, 300)


def test_the_decoder_goes_on_after_a_block() -> None:
    """The newest line and the counters are those of a decoder that was fed frame by frame."""
    codec, dbc = Codec(layout_of("maplines-pose.dbc")), "maplines-pose.dbc"
    expected, frames = recorded(codec, dbc, PROFILES[0], 0)
    receiver = LogReceiver(codec)
    receiver.feed(block_of(frames, [0] * len(frames)))
    for slot in expected.decoder.slots(frames[-1][2]):
        ours, theirs = (
            one.latest(slot, frames[-1][2]).line
            for one in (receiver.decoders["a"], expected.decoder)
        )
        assert (ours is None) == (theirs is None)
        if ours is not None and theirs is not None:
            assert ours.gaussian.cov.tobytes() == theirs.gaussian.cov.tobytes()
            assert ours.t_ns == theirs.t_ns


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({4: np.zeros((3, 65), np.uint8)}, "up to 64"),
        ({5: np.array([0, 3])}, "places"),
        ({5: np.array([-1, 2])}, "places"),
        ({3: np.full(3, 9, np.uint8)}, "length must be 8 at most"),
        ({2: np.zeros(2, np.int64)}, r"t_ns must be \(3,\)"),
    ],
)
def test_wrong_arrays_raise(change: dict[int, Any], message: str) -> None:
    decoder: Any = Codec(layout_of("maplines.dbc")).decoder()
    arrays = [np.zeros(3, kind) for kind in ("u4", "?", "i8", "u1")]
    arguments = [*arrays, np.zeros((3, 8), np.uint8), np.arange(3), np.zeros(3, np.uint8), 0]
    for place, value in change.items():
        arguments[place] = value
    with pytest.raises(ValueError, match=message):
        decoder.feed_arrays(*arguments)
