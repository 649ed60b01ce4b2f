"""Scenes through the C core and through Python: the same numbers and refusals, bit for bit."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import Any

import c_core
import numpy as np
from scene_streams import MAP_ERROR, OFFSETS, road_scene

from maplines_can import Codec, MapLine, Slot
from maplines_can.values import fixed_order
from maplines_can.values.errors import IllPosedError
from maplines_can.wire import POSE
from maplines_can.wire.covariance.cholesky import CholeskyCode
from maplines_can.wire.covariance.scene_code import SceneCode
from maplines_can.wire.layout.message_layout import Layout
from maplines_can.wire.layout.signals import FINE_SIGNALS
from maplines_can.wire.records.record import CompleteRecord, RawRecord
from maplines_can.wire.records.scene_reader import Member, SceneReader

#: Scenes for one run of the harness.
CHUNK = 500

# ---- records of scenes -------------------------------------------------------------------------


class Wire:
    """Records of a layout with a message of the pose error, and their reader."""

    def __init__(self, codec: Codec) -> None:
        self.codec, self.layout = codec, codec.layout
        assert self.layout.pose is not None
        self.pose = self.layout.pose
        self.code = SceneCode(self.pose, self.layout)
        self.reader = SceneReader(self.layout, self.pose, self.code)
        assert isinstance(codec.covariance, CholeskyCode)
        self.order = codec.covariance.factor.order

    def content(self, owner: Any, payload: bytes, t_ns: int) -> Any:
        """Content of a record, or why there is none."""
        return self.codec.reader.read(payload, owner, t_ns)

    def packed(self, owner: Any, raw: dict[str, int], data_id: int) -> bytes:
        """Record of raw values."""
        return self.codec.reader.formats[owner].packer.pack_one(raw, data_id)

    def random_raw(self, layout: Any, rng: Any) -> dict[str, int]:
        """Raw values of all signals; a third are at an end of their bits, or 0."""
        names = [n for n in layout.signals if not n.startswith(("Page", "TransferId", "Crc"))]
        ends = rng.random() < 0.5
        raw = {}
        for name in names:
            low, high = layout[name].all_raw
            at_end = ends and rng.random() < 0.33
            raw[name] = int(rng.choice([low, high, 0]) if at_end else rng.integers(low, high + 1))
        return raw

    def random_pose(self, rng: Any) -> bytes:
        """A record of any bits, or one of an ordinary pose error and any other bits."""
        raw = self.random_raw(self.pose, rng)
        if rng.random() < 0.8:
            for name, sigma in (("Along", 0.3), ("Across", 0.2), ("Heading", 0.005)):
                octave = np.log2(sigma) + rng.normal(0, 2)
                raw[f"Pivot{name}"] = nearest(self.pose[f"Pivot{name}"], octave)
            raw["Inflation"] = int(rng.integers(0, 4))
        return self.packed(POSE, raw, self.pose.messages.data_id)

    def random_line(self, slot: Slot, rng: Any) -> bytes:
        """A record of any bits, or one of a line that is a function of x and any other bits."""
        layout, raw = self.layout, self.random_raw(self.layout, rng)
        raw["Kind"] = int(rng.integers(0, 8))
        if "Status" in raw:
            raw["Status"] = int(rng.integers(0, 6))
            raw |= {"ComponentIndex": 0, "ComponentCount": 0}
            raw["ComponentWeight"] = nearest(layout["ComponentWeight"], 1.0)
        if raw.get("HasCovariance"):
            raw |= dict.fromkeys(("OwnLateral", "OwnPoints", "OwnShape"), 0)
        elif "HasCovariance" in raw:
            raw |= {name: 0 for name in raw if name in FINE_SIGNALS}
        if rng.random() < 0.9:
            for name, sigma in (("YOff", 4), ("Beta", 0.2), ("C0", 3e-3), ("C1", 3e-5)):
                raw[name] = nearest(layout[name], rng.normal(0, sigma))
            low = rng.uniform(-32, 30)
            raw["XMin"] = nearest(layout["XMin"], low)
            raw["XMax"] = nearest(layout["XMax"], low + rng.uniform(2, 90))
        elif layout["XMin"].physical_one(raw["XMin"]) > layout["XMax"].physical_one(raw["XMax"]):
            raw["XMin"], raw["XMax"] = raw["XMax"], raw["XMin"]
        return self.packed(slot, raw, layout.messages[slot].data_id)


def nearest(signal: Any, physical: float) -> int:
    return int(signal.limited(signal.raw(physical)))


class Given:
    """Records of a scene: of the pose error and of lines, with times."""

    def __init__(self, t_ns: int, pose: bytes, lines: Sequence[tuple[Any, int, bytes]]) -> None:
        self.t_ns, self.pose, self.lines = t_ns, pose, lines

    def bytes_for(self, wire: Wire) -> bytes:
        """The scene as the harness takes it."""
        out = struct.pack("<Bq", 0, self.t_ns) + self.pose + bytes([len(self.lines)])
        for slot, t_ns, record in self.lines:
            out += struct.pack("<Bq", slot, t_ns) + record.ljust(wire.layout.record_bytes, b"\0")
        return out


def random_scenes(wire: Wire, n: int, seed: int) -> Iterator[Given]:
    """Scenes of random records that a receiver accepts, of 0 to 8 lines."""
    rng = np.random.default_rng(seed)
    while n:
        t_ns = int(rng.integers(-(2**62), 2**62))
        known = [*wire.layout.messages]
        slots = [slot for slot in known if rng.random() < rng.random()]
        lines = []
        for slot in slots:
            line_ns, payload = t_ns + int(rng.normal(0, 1e8)), wire.random_line(slot, rng)
            content = wire.content(slot, payload, line_ns)
            if isinstance(content, CompleteRecord):  # one that may be in a scene
                content = content.line if content.line.x_min < content.line.x_max else None
            if isinstance(content, RawRecord | MapLine):
                lines.append((slot, line_ns, payload))
        yield Given(t_ns, wire.random_pose(rng), lines)
        n -= 1


def sent_scenes(wire: Wire, n: int, seed: int, *, full: bool = False) -> Iterator[Given]:
    """Scenes of roads as an encoder sends them, in classic frames."""
    rng = np.random.default_rng(seed)
    encoder = wire.codec.encoder()
    for _ in range(n):
        scene = road_scene(
            [slot for slot in OFFSETS if rng.random() < 0.7],
            radius=float(rng.choice([-1, 1]) * 10 ** rng.uniform(1.8, 4)),
            sigma=np.array([0.3, 0.2, 0.005]) * 2.0 ** rng.normal(0, 1, 3),
            map_error=None if rng.random() < 0.3 else MAP_ERROR,
        )
        frames = encoder.encode_scene(scene, age=float(rng.uniform(0, 0.3)), fd=full)
        t_ns = int(rng.integers(0, 10**18))
        records = {owner: b"".join(frame.data for frame in own) for owner, own in frames.items()}
        pose = records.pop(POSE)[: wire.pose.record_bytes]
        lines = [
            (slot, t_ns + i, record[: wire.layout.record_bytes])
            for i, (slot, record) in enumerate(records.items())
        ]
        yield Given(t_ns, pose, lines)


# ---- what Python makes of them -----------------------------------------------------------------


def expected_bytes(wire: Wire, given: Given) -> bytes:
    """What the harness is to write of a scene."""
    pose = wire.content(POSE, given.pose, given.t_ns)
    members = []
    for slot, t_ns, record in given.lines:
        content = wire.content(slot, record, t_ns)
        members.append(
            Member(content.line if isinstance(content, CompleteRecord) else content, t_ns)
        )
    of_pose = wire.reader.pose(pose, given.t_ns)
    try:
        lines = wire.reader.lines(of_pose, members) if members else []
    except IllPosedError:
        return b"\0"
    scene = wire.reader.scene(of_pose, lines)
    error = scene.map_error
    assert error is not None
    signals = {s.name: np.array([pose.raw[s.name]]) for s in wire.code.pose_code.signals}
    factor = wire.code.pose_code.factors(signals)[0]
    out = struct.pack("<BBIq", 1, len(scene.lines), pose.counter, given.t_ns)
    map_error = error.offset_sigma, error.heading_sigma
    out += doubles(factor, scene.pose_error.correlation_time, map_error, of_pose.age)
    if not scene.lines:
        return out
    raw = [wire.reader._raw(member.content, pose.raw) for member in members]
    decoded = wire.code.decode(wire.code.decode_pose(pose.raw), raw)
    A, F = decoded.spread, decoded.specific_factors
    order = wire.order
    for i, line in enumerate(scene.lines):
        block = scene.cov[4 * i : 4 * i + 4, 4 * i : 4 * i + 4]
        assert np.array_equal(line.gaussian.cov, block)
        of_line = np.zeros((4, 4))
        of_line[order] = fixed_order.cholesky(block[np.ix_(order, order)])
        assert np.isfinite(of_line).all()
        out += struct.pack("<BBBB", line.slot, line.kind, line.status, 1)
        out += struct.pack("<q", given.lines[i][1])
        out += doubles((line.x_min, line.x_max, line.age), line.gaussian.mean, of_line)
        out += doubles(A[4 * i : 4 * i + 4], F[i], scene.fit_ranges[i], scene.quartics[i])
    return out


def doubles(*values: Any) -> bytes:
    return b"".join(np.asarray(value, dtype="<f8").tobytes() for value in values)


def check_scenes(
    wire: Wire, scenes: Sequence[Given], *prefix: str, **compiler: Any
) -> Counter[str]:
    """Compare scenes; return how many were decoded and refused."""
    program = c_core.harness("scene", wire.layout, **compiler)
    out = c_core.run(program, b"".join(given.bytes_for(wire) for given in scenes), *prefix)
    counts: Counter[str] = Counter()
    for i, given in enumerate(scenes):
        expected = expected_bytes(wire, given)
        assert out[: len(expected)] == expected, f"scene {i} of {len(given.lines)} lines"
        out = out[len(expected) :]
        counts["decoded" if expected[0] else "refused"] += 1
        counts["lines"] += len(given.lines) if expected[0] else 0
    assert out == b""
    return counts


def check_random_scenes(
    layout: Layout, n: int, seed: int = 0, *prefix: str, **compiler: Any
) -> Counter[str]:
    """Compare n scenes of random records; return how many were decoded and refused."""
    wire, counts = Wire(Codec(layout)), Counter[str]()
    scenes = random_scenes(wire, n, seed)
    while chunk := [*islice(scenes, CHUNK)]:
        counts += check_scenes(wire, chunk, *prefix, **compiler)
    return counts
