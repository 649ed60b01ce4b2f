"""Scenes in C, back to back with Python: the same numbers and refusals, bit for bit."""

from __future__ import annotations

import re
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import c_core
import numpy as np
import pytest
from random_dbc import random_dbc
from scene_streams import ALL, COMPLETE, CONDITIONAL, MAP_ERROR, OFFSETS, new_codec, road_scene

from maplines_can import Codec, MapLine, Slot
from maplines_can.values import fixed_order
from maplines_can.values.cubics import _STEEPEST, fit_points, is_function, points_of, refitted
from maplines_can.values.errors import IllPosedError
from maplines_can.values.linalg import block_diagonal, square_root
from maplines_can.values.line import lateral_jacobian
from maplines_can.values.seen_lines import END_WEIGHT, NODES, POINTS, SeenLines, bases, valid_ranges
from maplines_can.wire import POSE, Layout
from maplines_can.wire.covariance import specific_levels
from maplines_can.wire.covariance.cholesky import CholeskyCode
from maplines_can.wire.covariance.scene_code import SceneCode
from maplines_can.wire.covariance.specific_levels import SpecificLevels
from maplines_can.wire.layout.signals import FINE_SIGNALS
from maplines_can.wire.records.record import CompleteRecord, RawRecord
from maplines_can.wire.records.scene_reader import Member, SceneReader

SOURCES = Path(__file__).parents[2] / "c" / "src"


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
    try:
        scene = wire.reader.scene(pose, given.t_ns, members)
    except IllPosedError:
        return b"\0"
    error = scene.map_error
    assert error is not None
    signals = {s.name: np.array([pose.raw[s.name]]) for s in wire.code.pose_code.signals}
    factor = wire.code.pose_code.factors(signals)[0]
    age = wire.reader.age(pose)
    out = struct.pack("<BBIq", 1, len(scene.lines), pose.counter, given.t_ns)
    times = (scene.pose_error.correlation_time, error.offset_sigma, error.heading_sigma, age)
    out += doubles(factor, times)
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


@pytest.fixture(scope="module", params=ALL)
def wire(request: Any) -> Wire:
    return Wire(new_codec(request.param))


def test_scenes_of_roads_are_the_same(wire: Wire) -> None:
    assert check_scenes(wire, [*sent_scenes(wire, 12, 1)])["refused"] == 0


def test_scenes_with_all_entries_are_the_same() -> None:
    wire = Wire(new_codec(CONDITIONAL))
    assert check_scenes(wire, [*sent_scenes(wire, 12, 2, full=True)])["refused"] == 0


def test_scenes_of_any_bits_are_the_same(wire: Wire) -> None:
    """And so are the refusals: of lines that are no function of x, and of empty ranges."""
    counts = check_scenes(wire, [*random_scenes(wire, 300, 3)])
    assert counts["decoded"] > 50
    assert counts["refused"] > 50


@pytest.mark.parametrize("seed", range(6))
def test_scenes_of_random_dbcs_are_the_same(seed: int) -> None:
    """Whose orders of rows, factors, ranges and places differ."""
    wire = Wire(Codec(Layout.from_text(random_dbc(seed), "random.dbc")))
    assert check_scenes(wire, [*random_scenes(wire, 60, seed)])["decoded"] > 0


# ---- single precision --------------------------------------------------------------------------

HEAD = np.dtype([("found", "u1"), ("count", "u1"), ("rest", "V12"), ("pose", "<f8", 13)])
LINE = np.dtype(
    [
        ("numbers", "u1", 4),
        ("t_ns", "<i8"),
        ("range_and_age", "<f8", 3),
        ("mean", "<f8", 4),
        ("factor", "<f8", (4, 4)),
        ("spread", "<f8", (4, 7)),
        ("specific", "<f8", (4, 4)),
        ("fit", "<f8", 3),
    ]
)


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_single_precision_covers(dbc: str) -> None:
    """The joint covariance, about the rounded means, exceeds that in double precision.

    But by little: standard deviations of lateral positions are at most 0.1 % larger.
    """
    wire = Wire(new_codec(dbc))
    scenes = [*sent_scenes(wire, 12, 7)]
    flags = (*c_core.FLAGS, "-DMAPLINES_FLOAT")
    data = b"".join(given.bytes_for(wire) for given in scenes)
    in_double = c_core.run(c_core.harness("scene", wire.layout), data)
    in_float = c_core.run(c_core.harness("scene", wire.layout, flags=flags), data)
    while in_double:
        count = np.frombuffer(in_double, HEAD, 1)["count"][0]
        size = HEAD.itemsize + int(count) * LINE.itemsize
        exact, rounded = (
            np.frombuffer(out[HEAD.itemsize : size], LINE) for out in (in_double, in_float)
        )
        in_double, in_float = in_double[size:], in_float[size:]
        if not count:
            continue
        A, A_float = (lines["spread"].reshape(-1, 7) for lines in (exact, rounded))
        e = (rounded["mean"] - exact["mean"]).ravel()
        whitening = block_diagonal(np.linalg.inv(exact["specific"]))
        A, A_float, e = whitening @ A, whitening @ A_float, whitening @ e
        F_float = whitening @ block_diagonal(rounded["specific"])
        lacking = A @ A.T + np.eye(len(A)) + np.outer(e, e) - A_float @ A_float.T
        assert np.linalg.eigvalsh(lacking - F_float @ F_float.T)[-1] <= 1e-9 * np.abs(A).max() ** 2
        for lines, other in zip(exact, rounded, strict=True):
            x_min, x_max, _ = lines["fit"]
            J = lateral_jacobian(lines["mean"], np.linspace(x_min, x_max, 5))
            before = J @ np.hstack([lines["spread"], lines["specific"]])
            after = J @ np.hstack([other["spread"], other["specific"]])
            growth = np.linalg.norm(after, axis=1) / np.linalg.norm(before, axis=1)
            assert growth.max() < 1.001
            own = np.linalg.norm(J @ other["factor"], axis=1) / np.linalg.norm(before, axis=1)
            assert (own >= 1 - 1e-9).all()
            assert own.max() < 1.001
    assert in_float == b""


# ---- functions of one line ---------------------------------------------------------------------

RNG = np.random.default_rng(5)


def random_curve(rng: Any) -> tuple[Any, Any, float]:
    """Mean, fit range and quartic of a line; some are nearly across the car, or far from it."""
    mean = rng.normal(0, 1, 4) * [4, 0.3, 5e-3, 5e-5] * 10.0 ** rng.uniform(-2, 0.7)
    low = rng.uniform(-40, 40)
    return mean, np.array([low, low + rng.uniform(0.5, 100)]), rng.normal(0, 0.1)


def random_pose_cov(rng: Any) -> Any:
    """Covariance of a pose error: regular, singular or huge."""
    root = rng.normal(0, 1, (3, 3)) * [[0.3], [0.2], [0.005]] * 10.0 ** rng.uniform(-3, 2)
    root[:, rng.integers(0, 4) :] = 0.0
    return fixed_order.product(root, root.T)


def test_functions_of_a_line_are_the_same() -> None:
    cases, expected = b"", []
    for _ in range(300):
        mean, fit_range, quartic = random_curve(RNG)
        P, pose = random_pose_cov(RNG), RNG.normal(0, 1, 3) * [2, 2, 0.3]
        root = RNG.normal(0, 1, (4, 4)) * [[0.1], [1e-3], [1e-5], [1e-7]]
        cov, heading_sigma = fixed_order.product(root, root.T), abs(RNG.normal(0, 0.01))
        cases += b"\1" + doubles(mean, fit_range, quartic, P, pose, cov, heading_sigma)
        expected.append(of_a_line(mean, fit_range, quartic, P, pose, cov, heading_sigma))
    out = c_core.run(c_core.harness("scene", new_codec(CONDITIONAL).layout), cases)
    for i, one in enumerate(expected):
        for j, part in enumerate(one):
            assert out[: len(part)] == part, (i, j, np.frombuffer(part[len(part) % 8 :]))
            out = out[len(part) :]
    assert out == b""


def of_a_line(
    mean: Any, fit_range: Any, quartic: float, P: Any, pose: Any, cov: Any, heading_sigma: float
) -> list[bytes]:
    """Output of the harness for a line."""
    fit = fit_points(POINTS, END_WEIGHT)
    window = (np.array(fit_range[0]), np.array(fit_range[1]))
    points = points_of(mean, window, np.array(quartic), fit, 0)
    with np.errstate(invalid="ignore", over="ignore"):
        moved = refitted(*points, pose, fit.weights)
    out = [bytes([bool(is_function(*points))]), doubles(moved)]
    root = np.sqrt(3) * square_root(P).T
    sigma_points = np.vstack([np.zeros(3), root, -root])
    J = bases(mean[None], fit_range[None])
    ends = valid_ranges(mean[None], fit_range[None], P, cov[None], heading_sigma)
    out += [doubles(J), doubles(sigma_points), doubles(ends)]
    try:
        seen = SeenLines(mean[None], fit_range[None], np.array([quartic]))
    except IllPosedError:
        return out + [b"\0"] * 3
    for values in (
        lambda: seen(pose[None])[0, 0],
        lambda: seen.jacobian()[0],
        lambda: seen.spread_factor(P),
    ):
        try:
            out += [b"\1" + doubles(values())]
        except IllPosedError:
            out += [b"\0"]
    return out


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_levels_are_the_same(dbc: str) -> None:
    """For every raw value of the shape, and some of the others."""
    code = Wire(new_codec(dbc)).code
    levels: SpecificLevels = code.levels
    cases, expected = b"", b""
    for shape in range(levels.shape.raw_max + 1):
        mean, fit_range, _ = random_curve(RNG)
        lateral, points = (
            int(RNG.integers(0, s.raw_max + 1)) * int(RNG.integers(0, 2))
            for s in (levels.lateral, levels.points)
        )
        cases += b"\2" + doubles(mean, fit_range) + struct.pack("<3q", lateral, points, shape)
        names = (s.name for s in levels.signals)
        raw = {n: np.array([v]) for n, v in zip(names, (lateral, points, shape), strict=True)}
        expected += doubles(levels.decode(raw, mean[None], fit_range[None]))
    assert c_core.run(c_core.harness("scene", new_codec(dbc).layout), cases) == expected


@pytest.mark.parametrize("n", [1, 2, 3, 4])
def test_square_roots_are_the_same(n: int) -> None:
    """Of regular and of singular matrices, with and without zero rows."""
    cases, expected = b"", b""
    for _ in range(200):
        root = RNG.normal(0, 1, (n, n)) * 10.0 ** RNG.uniform(-3, 3, (n, 1))
        root[:, RNG.integers(0, n + 1) :] = 0.0
        root[RNG.integers(0, 2 * n, 1) % (2 * n) == np.arange(n)] = 0.0
        S = fixed_order.product(root, root.T)
        cases += b"\3" + bytes([n]) + doubles(S)
        expected += doubles(square_root(S))
    out = c_core.run(c_core.harness("scene", new_codec(CONDITIONAL).layout), cases)
    got, wanted = np.frombuffer(out), np.frombuffer(expected)
    assert np.array_equal(got, wanted)


# ---- constants ---------------------------------------------------------------------------------


def test_the_constants_are_those_of_python() -> None:
    text = (SOURCES / "cubics.c").read_text() + (SOURCES / "levels.c").read_text()

    def table(name: str) -> list[float]:
        found = re.search(rf"\b{name}\[[^=]*= \{{(.*?)\}};", text, re.DOTALL)
        assert found is not None, name
        return [*map(float.fromhex, found[1].replace("\n", " ").strip(" ,").split(","))]

    fit = fit_points(POINTS, END_WEIGHT)
    assert table("cubic_nodes") == fit.nodes.tolist()
    assert table("cubic_quartic") == fit.quartic.tolist()
    assert table("nodes") == NODES.tolist()
    assert table("fit_matrix") == specific_levels._FIT.ravel().tolist()
    assert table("ratios") == specific_levels.RATIOS.tolist()
    for name, value in (
        ("MAPLINES_STEEPEST", _STEEPEST),
        ("MAPLINES_GOLDEN_RATIO", specific_levels.GOLDEN_RATIO),
        ("MAPLINES_HALF_PI", np.pi / 2),
    ):
        found = re.search(rf"#define {name} +(\S+)", text)
        assert found is not None, name
        assert float.fromhex(found[1]) == value
