"""Whole scenes in exact arithmetic: what is received covers what was sent, any bits are definite.

Joints are of random lines of random roads, with pose errors that may be singular, and with lines
and covariances that no map has. Payloads are random bits with a right checksum: those of the mean
beyond any line, so half of them are rejected.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import numpy as np

from maplines_can import Codec, Reason
from maplines_can.model.whole_scenes import NONE, scene_of_dbc, write_whole
from maplines_can.testing.sender_streams import random_scene
from maplines_can.wire import default_dbc_path
from maplines_can.wire.layout.pose_layout import SCENE
from maplines_can.wire.layout.scene_layout import SceneLayout

from .exact import covers, is_positive_definite
from .harness import evidence, progress

CYCLE_NS = 50_000_000


@evidence(n=20, payloads=50)
def whole_scene_bits(n: int = 100_000, payloads: int = 100_000, seed: int = 0) -> dict[str, Any]:
    """Send random joints, and receive random payloads.

    Args:
        n: number of joints.
        payloads: number of payloads that are not rejected.
        seed: of both.
    """
    codec = Codec.from_dbc(default_dbc_path("maplines-scene.dbc"))
    return {
        "joints": dict(_joints(codec, n, seed)),
        "payloads": dict(_payloads(codec, payloads, seed)),
    }


def _joints(codec: Codec, n: int, seed: int) -> Counter[str]:
    counts = Counter[str]({"indefinite": 0, "overconfident": 0})
    for number in progress(range(n), "joints", n):
        decoder = codec.decoder()
        try:
            sent = random_scene(np.random.default_rng([seed, number]), codec.layout)
            frames = codec.encoder().encode_scene(sent, fd=True)
        except ValueError:  # values that no scene has, or none that can be sent
            counts["refused"] += 1
            continue
        for frame in (frame for own in frames.values() for frame in own):
            decoder.feed(frame.can_id, frame.data, 0)
        received = decoder.scene()
        if received is None or not received.scene.lines:
            counts["without lines"] += 1
            continue
        found = received.scene
        truth = sent.subset([line.slot for line in found.lines])
        counts["checked"] += 1
        counts["lines"] += len(found.lines)
        counts["indefinite"] += not is_positive_definite(found.cov.tolist())
        covered = covers(found.cov, found.means.ravel(), truth.cov, truth.means.ravel())
        counts["overconfident"] += not covered
    return counts


def _payloads(codec: Codec, n: int, seed: int) -> Counter[str]:
    layout = scene_of_dbc(codec.layout)
    message, rng = layout.messages[SCENE], np.random.default_rng(seed)
    counts, done = Counter[str]({"indefinite": 0}), 0
    bar = iter(progress(range(n), "payloads", n))
    while done < n:
        decoder = codec.decoder()
        record = write_whole(
            layout, _shared(layout, rng), _lines(layout, rng), layout.record_bytes, message.data_id
        )
        found = decoder.feed(message.fd_can_id or 0, record, CYCLE_NS)
        if isinstance(found, Reason):
            counts[found.name] += 1
            continue
        received = decoder.scene()
        if received is None or not received.scene.lines:
            raise ValueError("lines were delivered, but there is no scene")
        counts["checked"] += 1
        counts["lines"] += len(found)
        counts["indefinite"] += not is_positive_definite(received.scene.cov.tolist())
        done += 1
        next(bar)
    return counts


def _shared(layout: SceneLayout, rng: np.random.Generator) -> dict[str, int]:
    """Return random raw values of the pose error."""
    lines = {name for name in layout.signals if name.endswith(tuple(layout.line))}
    raw = {
        name: int(rng.integers(signal.raw_min, signal.raw_max + 1))
        for name, signal in layout.signals.items()
        if name not in lines and name != "Crc"
    }
    return raw | {"SceneCounter": raw["Counter"] % 2 ** layout["SceneCounter"].length}


def _lines(layout: SceneLayout, rng: np.random.Generator) -> list[dict[str, int]]:
    """Return random raw values of the line at each place, of slots that differ."""
    lines = []
    for slot in [None, None, *rng.permutation(np.arange(2, 8))[: layout.places - 2].tolist()]:
        raw = {
            name: int(rng.integers(signal.raw_min, signal.raw_max + 1))
            for name, signal in layout.line.items()
        }
        raw["Kind"] %= NONE + 1
        raw["XMax"] = max(raw["XMax"], raw["XMin"] - 31)
        for name in ("Beta", "C0", "C1"):  # any bits are rarely a function of x
            raw[name] = int(raw[name] * 2 ** rng.uniform(-layout.line[name].length, 0))
        lines.append(raw if slot is None else raw | {"Slot": slot})
    return lines
