"""Parts of a recording that need the Python API, see behaviour.py: nothing else there uses it.

The inputs are drawn here and not by helpers of the project, so that they stay the same.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from enum import Enum
from itertools import count
from pathlib import Path
from typing import Any

import fuzz_scenes
import fuzz_targets
import numpy as np

import maplines_can as ml
from maplines_can import wire

ROOT = Path(__file__).resolve().parents[1]
NOW_NS = 1_750_000_000_000_000_000
MS = 1_000_000
LINE = ("slot", "kind", "status", "x_min", "x_max", "age", "t_ns", "gaussian", "mixture")
SCENE = ("lines", "cov", "pose_error", "fit_ranges", "left_out", "quartics", "own_covs")
VIEW = ("line", "scene", "age", "stale", "state", "status", "two_senders", "usable")
BATCH = """mean cov verdict status kind x_min x_max age component_index component_count
component_weight counter""".split()  # noqa: SIM905
COUNTERS = "frames lines line_frames pose_errors pose_frames pending lost counts".split()  # noqa: SIM905
#: Attributes that are recorded, by class. A class that is renamed keeps its name in ``LABELS``.
FIELDS = {
    "MapLine": LINE, "Scene": SCENE, "SlotView": VIEW, "SceneView": VIEW,
    "PoseError": ("cov", "correlation_time"), "Gaussian": ("mean", "cov"),
    "GaussianMixture": ("weights", "components"), "Frame": ("can_id", "is_fd", "data"),
}  # fmt: skip
LABELS: dict[str, str] = {}
#: Attributes that have another name than when they were recorded.
RENAMED = {"own_covs": "specific_covs"}


def shown(value: Any) -> str:
    """Return a value as text, with its floats to the last bit."""
    name = type(value).__name__
    if name in FIELDS:
        found = {key: getattr(value, RENAMED.get(key, key), None) for key in FIELDS[name]}
        parts = [f"{key}={shown(one)}" for key, one in found.items() if one is not None]
        return f"{LABELS.get(name, name)}({' '.join(parts)})"
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, bytes | bytearray):
        return value.hex()
    if isinstance(value, np.ndarray):
        if value.size > 100:
            return f"{value.shape} {hashlib.sha256(value.tobytes()).hexdigest()}"
        return shown(value.tolist())
    if isinstance(value, set | frozenset):
        return shown(sorted(value))
    if isinstance(value, Mapping):
        pairs = sorted((shown(key), shown(one)) for key, one in value.items())
        return "{" + " ".join(f"{key}:{one}" for key, one in pairs) + "}"
    if isinstance(value, list | tuple):
        return f"[{' '.join(map(shown, value))}]"
    return value.hex() if isinstance(value, float) else str(value)


def attempt(call: Callable[..., Any], *arguments: Any, **options: Any) -> str:
    """Return what a call gives, or its error."""
    try:
        return shown(call(*arguments, **options))
    except (ml.MaplinesError, ValueError, ArithmeticError) as error:
        return f"{type(error).__name__}: {error}"


# ---- corpora -----------------------------------------------------------------------------


def corpora() -> Iterator[tuple[str, str]]:
    """Yield what the targets of the fuzzer see of each input."""
    logging.disable()  # python-can and cantools warn of many inputs
    for target, run in fuzz_scenes.ALL_TARGETS.items():
        rows: list[str] = []
        last: list[Any] = [None]
        watch(rows, last)
        for path in sorted((ROOT / "tests" / "corpus" / target).iterdir()):
            rows.append(f"== {path.name}")
            last[0] = None
            outcomes = run(path.read_bytes())
            rows += [shown(outcomes), counters(last[0]) if last[0] else ""]
            if target == "dbc":
                text = path.read_bytes().decode("cp1252", "replace")
                rows.append(attempt(wire.Layout.from_text, text, "a DBC").partition(" at 0x")[0])
        yield f"corpus-{target}", "\n".join(rows)


def watch(rows: list[str], last: list[Any]) -> None:
    """Let the targets note lines, answers and scenes, and keep the last decoder."""
    check_line, outcome_of = _ORIGINAL["check_line"], _ORIGINAL["outcome_of"]

    def noted_line(line: Any) -> None:
        rows.append(shown(line))
        check_line(line)

    def noted_outcome(answer: Any) -> Any:
        rows.append(outcome_of(answer))
        return outcome_of(answer)

    for module in (fuzz_targets, fuzz_scenes):
        check = _ORIGINAL[module.__name__]

        def noted_counts(state: Any, frames: int, check: Any = check) -> None:
            last[0] = state
            check(state, frames)

        module.check_line, module.outcome_of = noted_line, noted_outcome  # type: ignore[attr-defined]
        module.check_counts = noted_counts  # type: ignore[attr-defined]
    check_scene = _ORIGINAL["check_scene"]

    def noted_scene(state: Any, t_ns: int) -> Any:
        rows.append(shown(state.latest_scene(t_ns)))
        return check_scene(state, t_ns)

    fuzz_scenes.check_scene = noted_scene


_ORIGINAL: dict[str, Any] = {
    "check_line": fuzz_targets.check_line,
    "outcome_of": fuzz_targets.outcome_of,
    "check_scene": fuzz_scenes.check_scene,
    "fuzz_targets": fuzz_targets.check_counts,
    "fuzz_scenes": fuzz_scenes.check_counts,
}


def counters(decoder: Any) -> str:
    """Return the counters of a decoder, and the states of its senders of lines."""
    checks = {owner: c.stats() for owner, c in decoder.checks.items() if owner != "pose"}
    values = {name: getattr(decoder, name) for name in COUNTERS}
    return f"{shown(values)} {shown({k: tuple(v) for k, v in checks.items() if v.status})}"


# ---- inputs ------------------------------------------------------------------------------


def random_lines(rng: Any, n: int) -> list[Any]:
    """Return lines of all slots and kinds, some beyond the ranges of the DBC, some mixtures."""
    lines = []
    for i in range(n):
        mean = rng.uniform(-1, 1, 4) * [4.0, 0.1, 4e-3, 2e-5] * 10 ** rng.uniform(-1, 1)
        gaussians = []
        for _ in range(1 + (i % 5 == 4) * (1 + i % 4)):
            scale = np.array([0.1, 0.01, 3e-4, 1e-5]) * 10 ** rng.uniform(-2, 1.5)
            root = rng.standard_normal((4, 4)) * scale[:, None]
            gaussians.append(ml.Gaussian(mean + 0.3 * scale, root @ root.T))
        rest = {
            "kind": ml.Kind(int(rng.integers(len(ml.Kind)))),
            "x_min": -float(rng.integers(0, 40)),
            "x_max": float(rng.uniform(0, 140)),
            "age": [0.0, rng.uniform(0, 0.3), np.inf][min(int(rng.integers(5)), 2)],
        }
        slot = ml.Slot(i % len(ml.Slot))
        if len(gaussians) > 1:
            weights = rng.dirichlet(np.full(len(gaussians), 3.0))
            mixture = ml.GaussianMixture(weights, gaussians)
            lines.append(ml.MapLine.of_mixture(slot, mixture, **rest))
        else:
            lines.append(ml.MapLine(slot, gaussians[0], **rest))
    return lines


def random_road(rng: Any, lines: int) -> dict[Any, Any]:
    """Return parallel lines of a road that bends at random; some begin or end on the way."""
    s = np.arange(-60.0, 160.0, rng.uniform(0.5, 6.0))
    knots = rng.normal(0, 10 ** rng.uniform(-3.5, -1.4), 8)
    heading = np.cumsum(np.interp(s, np.linspace(-60, 160, 8), knots)) * (s[1] - s[0])
    heading -= np.interp(0.0, s, heading)
    middle = np.cumsum(np.column_stack([np.cos(heading), np.sin(heading)]), axis=0)
    middle = (middle - middle[np.argmin(np.abs(s))]) * (s[1] - s[0])
    normal = np.column_stack([-np.sin(heading), np.cos(heading)])
    offsets = (1.75, -1.75, 5.25, -5.25, 0.0, 7.0, -7.0, 0.4)
    road = {}
    for slot, offset in list(zip(ml.Slot, offsets, strict=True))[:lines]:
        ends = (rng.uniform(-50, 20), rng.uniform(20, 150)) if rng.random() < 0.2 else (-99, 999)
        ends = (-50, rng.uniform(-45, 10)) if rng.random() < 0.1 else ends  # not ahead of the car
        there = (s > ends[0]) & (s < ends[1])
        road[slot] = ml.Polyline((middle + offset * normal)[there], ml.Kind.SOLID)
    return road


def random_pose(rng: Any) -> Any:
    """Return a Gaussian over the pose near the origin."""
    root = rng.standard_normal((3, 3)) * [0.3, 0.2, 0.01] * 10 ** rng.uniform(-1, 0.4)
    return ml.Gaussian(rng.uniform(-1, 1, 3) * [5, 0.5, 0.03], root.T @ root)


def random_scene(rng: Any, lines: int) -> Any:
    """Return lines of a random road as seen from one pose."""
    error = ml.MapError(point_sigma=0.05, offset_sigma=0.05, heading_sigma=0.001)
    time = [np.inf, 0.7, 8.0][int(rng.integers(3))]
    return ml.map_scene(
        random_road(rng, lines), random_pose(rng), correlation_time=time,
        map_error=[None, error][int(rng.integers(2))],
    )  # fmt: skip


# ---- the wire ----------------------------------------------------------------------------


def codecs() -> dict[str, Any]:
    """Return a codec of each DBC, and one with a key."""
    found = {path.stem: ml.Codec.from_dbc(path) for path in sorted((ROOT / "dbc").glob("*.dbc"))}
    clock = count(NOW_NS, MS)
    keys = ml.Authenticator(ml.Key(bytes(range(16)), key_id=1), clock=lambda: next(clock))
    return found | {"keys": ml.Codec.from_dbc(authenticator=keys)}


def has_lines(codec: Any) -> bool:
    """Return whether the records of a codec are complete, so that it sends lines without scenes."""
    return not codec.layout.is_conditional


def wires() -> Iterator[tuple[str, str]]:
    """Yield the frames of each DBC, and what a receiver makes of them under each fault."""
    for name, codec in codecs().items():
        encoder = codec.encoder()
        for fd in (False, True) if name != "keys" else (True,):
            rng = np.random.default_rng(7)
            cycles: list[list[Any]] = []
            sent: list[str] = []
            steps = [random_scene(rng, 1 + i % 4 + 4 * (i % 7 == 6)) for i in range(60)]
            lines = random_lines(rng, 40) if has_lines(codec) else []
            for source in [
                *(lines[i : i + 4] for i in range(0, len(lines), 4)),
                *steps,
                *steps[:20],
            ]:
                ages = float(rng.uniform(0, 0.2))
                try:
                    frames = encoded(encoder, source, fd, ages)
                except ml.EncodeError as error:
                    sent.append(f"EncodeError: {error}")
                    continue
                cycles.append(frames)
                sent += [shown(frame) for frame in frames]
            kind = f"wire-{name}{'-fd' if fd else ''}"
            yield f"{kind}-sent", "\n".join(sent)
            for fault, change in FAULTS.items():
                yield f"{kind}-{fault}", received(codec, cycles, change, np.random.default_rng(3))
        if has_lines(codec) and name != "keys":
            yield f"wire-{name}-batch", batch(codec)


def encoded(encoder: Any, source: Any, fd: bool, age: float) -> list[Any]:
    """Return the frames of lines, or of a scene."""
    if isinstance(source, Sequence):
        return [frame for one in encoder.encode_lines(source, fd=fd) for frame in one]
    return [frame for own in encoder.encode_scene(source, age=age, fd=fd).values() for frame in own]


def received(codec: Any, cycles: list[list[Any]], change: Any, rng: Any) -> str:
    """Return the answers to frames, the views after each cycle, and the counters."""
    decoder = codec.decoder()
    # Checkouts of before have a monitor for the views.
    monitor = ml.Monitor(decoder) if hasattr(ml, "Monitor") else decoder
    rows, t_ns = list[str](), NOW_NS
    for number, frames in enumerate(cycles):
        start = t_ns = max(t_ns, NOW_NS + number * 50 * MS)
        for can_id, data, pause_ns in change([(f.can_id, bytes(f.data), MS) for f in frames], rng):
            rows += map(shown, answers(monitor, can_id, data, t_ns))
            t_ns += pause_ns
        slots = list(codec.layout.slots)[number % 8 :][:2]
        rows += [shown(monitor.latest(slot, t_ns)) for slot in slots]
        if codec.layout.pose is not None:
            rows += [shown(monitor.latest_scene(t_ns)), shown(monitor.pose_error(t_ns))]
        rows.append(f"cycle {number} at {t_ns - start}: {counters(decoder)}")
    decoder.expire(t_ns + 10**10)
    return "\n".join([*rows, counters(decoder)])


def answers(monitor: Any, can_id: int, data: bytes, t_ns: int) -> list[Any]:
    """Return the reason, or all lines that a frame completes, the one of its slot first."""
    answer = monitor.feed(can_id, data, t_ns)
    return list(answer) if isinstance(answer, list) else [answer, *getattr(monitor, "further", ())]


def lost(frames: list[Any], rng: Any) -> list[Any]:
    """Return the frames without some."""
    return [frame for frame in frames if rng.random() > 0.1]


def reordered(frames: list[Any], rng: Any) -> list[Any]:
    """Return the frames with neighbours exchanged, and some twice."""
    keys = np.arange(len(frames)) + rng.uniform(0, 1.5, len(frames))
    frames = [frames[i] for i in np.argsort(keys, kind="stable")]
    return [frame for frame in frames for _ in range(1 + (rng.random() < 0.1))]


def corrupted(frames: list[Any], rng: Any) -> list[Any]:
    """Return the frames, some of them with a flipped bit, cut short, or of another ID."""
    found = []
    for can_id, data, pause_ns in frames:
        if rng.random() < 0.1 and data:
            bit = int(rng.integers(8 * len(data)))
            flipped = bytearray(data)
            flipped[bit // 8] ^= 1 << bit % 8
            data = bytes(flipped) if rng.random() < 0.8 else data[: bit // 8]
            can_id += int(rng.random() < 0.1)
        found.append((can_id, data, pause_ns))
    return found


def late(frames: list[Any], rng: Any) -> list[Any]:
    """Return the frames with pauses, and no frame at all for some cycles."""
    if rng.random() < 0.2:
        return []
    return [(*frame[:2], int(frame[2] * rng.choice([0, 1, 30, 400], p=[0.1, 0.85, 0.04, 0.01])))
            for frame in frames]  # fmt: skip


def two_senders(frames: list[Any], rng: Any) -> list[Any]:
    """Return the frames of a cycle, and in half of the cycles once more after them."""
    return frames + frames if rng.random() < 0.5 else frames


FAULTS: dict[str, Callable[[list[Any], Any], list[Any]]] = {
    "clean": lambda frames, _: frames,
    "lost": lost,
    "reordered": reordered,
    "corrupted": corrupted,
    "late": late,
    "two-senders": two_senders,
    "all": lambda frames, rng: corrupted(reordered(lost(late(frames, rng), rng), rng), rng),
}


def batch(codec: Any) -> str:
    """Return records of many lines, with covariances of all kinds, and what they decode to."""
    rng = np.random.default_rng(11)
    means = (
        rng.uniform(-1, 1, (300, 4)) * [40, 0.6, 0.15, 0.04] * 10 ** rng.uniform(-3, 0, (300, 1))
    )
    roots = rng.standard_normal((300, 4, 4)) * np.array([[0.1], [0.01], [3e-4], [1e-5]])
    roots = roots * 10 ** rng.uniform(-3, 2, (300, 1, 1))
    covs = roots @ roots.transpose(0, 2, 1)
    covs[::9] -= 2 * np.eye(4) * covs[::9].diagonal(axis1=1, axis2=2)[:, None] * 0.3  # indefinite
    rest = {"x_min": rng.uniform(-40, 0, 300), "x_max": rng.uniform(0, 120, 300), "age": 0.05}
    records = codec.batch.encode(means, covs, kind=np.arange(300) % 4, **rest)
    junk = np.concatenate([records, rng.integers(0, 256, (20, records.shape[1]), dtype=np.uint8)])
    rows = [shown(record.tobytes()) for record in records]
    rows += [
        f"{field}: {[shown(v) for v in getattr(codec.batch.decode(junk), field)]}"
        for field in BATCH
    ]
    one = [codec.batch.decode_one(record.tobytes(), ml.Slot.EGO_LEFT) for record in junk]
    few = codec.batch.encode(means[:20]), codec.batch.encode(means[:20], covs[:20], status=2)
    weights, equal = np.full((9, 3), 1 / 3), np.broadcast_to(np.eye(4) * 1e-4, (9, 3, 4, 4))
    mixed = codec.batch.encode_mixtures(weights, means[:27].reshape(9, 3, 4) / 40, equal)
    return "\n".join(rows + list(map(shown, one)) + [r.tobytes().hex() for r in (*few, mixed)])


# ---- propagation -------------------------------------------------------------------------


def propagations() -> Iterator[tuple[str, str]]:
    """Yield lines, scenes, predictions and mixtures of the example roads and of random ones."""
    roads = {name: (one.lines, one.ego, one.window) for name, one in
             (ml.simulation.SCENARIOS | ml.simulation.STREETS).items()}  # fmt: skip
    rng = np.random.default_rng(5)
    roads |= {f"random-{i}": (random_road(rng, 3), random_pose(rng), (-20, 80)) for i in range(12)}
    error = ml.MapError(point_sigma=0.1, offset_sigma=0.05)
    transforms = (
        ml.Linear(), ml.SigmaPoints(), ml.Quadrature(3), ml.Mixture(3), ml.MonteCarlo(500, 1)
    )  # fmt: skip
    motion = ml.Motion(12.0, 0.1, np.diag([0.04, 1e-4]))
    for name, (lines, ego, window) in roads.items():
        found = ml.map_lines(lines, ego, window=window)
        scene = ml.map_scene(lines, ego, window=window, map_error=error, correlation_time=4.0)
        rows = [*map(shown, found), shown(found.left_out), shown(scene)]
        given = {"lines": lines, "ego": ego, "window": window}
        rows += [attempt(ml.map_lines, **given, components=3)]
        rows += [attempt(ml.map_lines, **given, map_error=error, max_sigma=1)]
        rows += [attempt(ml.map_lines, **given, transform=transform) for transform in transforms]
        for line in found:
            rows += [attempt(ml.predict_to, replace(line, t_ns=0), 300 * MS, motion)]
            rows += [attempt(ml.scene_mixture, scene, line.slot)]
        yield f"propagation-{name}", "\n".join(rows)


PARTS = {"corpus": corpora, "wire": wires, "propagation": propagations}
