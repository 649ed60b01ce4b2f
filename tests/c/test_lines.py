"""Sender of lines on an ECU, and its receiver in single precision."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from scene_layouts import layout_of
from support import c_core
from support.c_layouts import with_messages, with_slots
from support.lines import random_lines

from maplines_can import Gaussian, GaussianMixture, Kind, MapLine, Slot, Status
from maplines_can.model.records import written
from maplines_can.study import adversarial
from maplines_can.wire import Codec
from maplines_can.wire.layout.message_layout import Layout

#: What the harness writes of a record.
READ = np.dtype(
    [
        *((name, "u1") for name in ("reason", "kind", "status", "index", "count")),
        ("counter", "<u4"),
        ("mean", "<f8", 4),
        ("factor", "<f8", (4, 4)),
        *((name, "<f8") for name in ("x_min", "x_max", "age", "weight")),
    ]
)
ACCEPTED = 255
#: Number of components for the harness of a line that is no mixture.
LINE = 255

# ---- lines to frames ----------------------------------------------------------------------------


def awkward_lines(n: int, k: int, seed: int) -> Iterator[MapLine]:
    """Lines of k components: covariances of any condition, and means beyond the message, too."""
    rng = np.random.default_rng(seed)
    means, covs = adversarial(n * k, seed)
    means *= rng.choice([1.0, 1.0, 2.0, 1e6], (n * k, 1))
    covs *= rng.choice([1.0, 1.0, 0.0, 1e-9, 1e9], (n * k, 1, 1))
    for i in range(0, n * k, k):
        parts = [Gaussian.trusted(means[j].copy(), covs[j].copy()) for j in range(i, i + k)]
        line = MapLine(Slot.ROUTE, parts[0])
        if k > 1:
            weights = rng.dirichlet(np.full(k, 2.0)) + 1e-4
            line = MapLine.of_mixture(Slot.ROUTE, GaussianMixture(weights / weights.sum(), parts))
        x_min = rng.choice([-20.0, 0.0, -131.5, 3.3])
        yield replace(
            line, slot=Slot(int(rng.integers(8))), kind=Kind(int(rng.integers(8))), x_min=x_min,
            x_max=x_min + rng.choice([0.0, 1.5, 80.0, 500.0]),
            age=rng.choice([0.0, 0.0421, np.inf]),
            status=Status(int(rng.choice([1, 1, 1, 2, 3, 4, 0, 5]))),
        )  # fmt: skip


def case_of(line: MapLine, counter: int, *, is_fd: bool) -> bytes:
    """A line as the harness reads it."""
    weights, parts = (
        ([1.0], [line.gaussian])
        if line.mixture is None
        else (line.mixture.weights, line.mixture.components)
    )
    count = LINE if line.mixture is None else len(parts)
    head = 1, line.slot, line.kind, line.status, is_fd, counter, line.x_min, line.x_max, line.age
    components = (
        struct.pack("<21d", weight, *part.mean, *part.cov.ravel())
        for weight, part in zip(weights, parts, strict=True)
    )
    return struct.pack("<5BI3dB", *head, count) + b"".join(components)


def answer_of(codec: Codec, line: MapLine, counter: int, *, is_fd: bool) -> tuple[bytes, Any]:
    """What the harness writes of it after the status of the line, and the statuses of records."""
    (frames,) = codec.encoder().encode_lines([line], fd=is_fd, counters={line.slot: counter})
    heads = (struct.pack("<I3B", f.can_id, f.is_extended, f.is_fd, len(f.data)) for f in frames)
    rows = b"".join(head + frame.data for head, frame in zip(heads, frames, strict=True))
    records = np.frombuffer(b"".join(frame.data for frame in frames), np.uint8).reshape(-1, 32)
    following = (counter + len(records)) % 256
    found = codec.batch.decode(records, line.slot).status
    return struct.pack("<BI", len(frames), following) + rows, found


@pytest.mark.parametrize(("k", "is_fd"), [(1, False), (1, True), (8, True)])
def test_lines_have_the_frames_of_the_library(k: int, is_fd: bool) -> None:
    """Frames, statuses and counters; every status occurs, but FULL if all components need it."""
    codec, counters = Codec(layout_of("maplines.dbc")), np.random.default_rng(k)
    lines = [(line, int(counters.integers(256))) for line in awkward_lines(400 // k, k, seed=k)]
    cases = (case_of(*one, is_fd=is_fd) for one in lines)
    out = c_core.run(c_core.harness("lines", codec.layout), b"".join(cases))
    met = Counter[int]()
    for one in lines:
        expected, statuses = answer_of(codec, *one, is_fd=is_fd)
        worst = max(map(int, statuses), key=[1, 3, 4, 2, 0, 5].index)
        head, found, out = out[:2], out[2 : 2 + len(expected)], out[2 + len(expected) :]
        assert (head, found) == (bytes([0, worst]), expected), one
        met.update(map(int, statuses))
    assert out == b""
    assert met.keys() >= {*Status} - ({Status.FULL} if k > 1 else set())


@pytest.mark.parametrize(
    ("layout", "is_fd", "refusal"),
    [
        (with_slots(layout_of("maplines.dbc"), Slot.ROUTE), False, 1),
        (with_messages(layout_of("maplines.dbc"), can_id=None), False, 1),
        (with_messages(layout_of("maplines.dbc"), can_id=None), True, 0),
        (with_messages(layout_of("maplines.dbc"), fd_can_id=None), True, 1),
    ],
    ids=["slot", "no-classic", "FD", "no-FD"],
)
def test_a_line_without_a_message(layout: Layout, is_fd: bool, refusal: int) -> None:
    """In the frame format that is wanted."""
    line = MapLine.with_sigma(Slot.EGO_LEFT, np.zeros(4), [0.1, 0.01, 1e-4, 1e-6])
    out = c_core.run(c_core.harness("lines", layout), case_of(line, 0, is_fd=is_fd))
    assert (out[0], out[2] > 0) == (refusal, refusal == 0)


# ---- single precision ---------------------------------------------------------------------------


def random_records(codec: Codec, n: int, rng: Any) -> tuple[Any, Any]:
    """Records of random bits with good checksums, most with values that a sender sends."""
    layout, records = codec.layout, []
    slots = rng.choice([int(slot) for slot in layout.messages], n)
    for slot in slots:
        raw = {
            s.name: int(rng.integers(*s.all_raw, endpoint=True)) for s in layout.signals.values()
        }
        ends = sorted([raw["XMin"], raw["XMax"]])
        raw |= {"Status": raw["Status"] % 6, "ComponentIndex": 0, "XMin": ends[0], "XMax": ends[1]}
        for name, signal in layout.signals.items():  # bits at the ends of the signals
            if name.startswith(("Pivot", "Ratio", "Inflation", "Age")) and rng.random() < 0.1:
                raw[name] = int(rng.choice(signal.all_raw))
        records.append(written(layout, raw, layout.messages[slot].data_id))
    return np.frombuffer(b"".join(records), np.uint8).reshape(n, -1), slots


def exact(matrix: Any) -> list[list[Fraction]]:
    """Return a matrix of floating-point numbers as fractions."""
    return [[Fraction(float(value)) for value in row] for row in matrix]


def squared(factor: Any) -> Any:
    """Return the covariance F F^T of a factor F as an array of fractions."""
    F = exact(factor)
    return np.array([[sum(a * b for a, b in zip(x, y, strict=True)) for y in F] for x in F])


def is_semidefinite(S: Any) -> bool:
    """Whether a matrix of fractions is positive semidefinite, exactly."""
    S = S.copy()
    for k in range(len(S)):
        if S[k, k] < 0 or (S[k, k] == 0 and (S[k, k:] != 0).any()):
            return False
        if S[k, k] > 0:
            S = S - np.outer(S[:, k], S[k]) / S[k, k]
    return True


def read_both(codec: Codec, records: Any, slots: Any) -> list[Any]:
    """What the builds in double and in single precision read."""
    n = len(records)
    head = np.column_stack([np.zeros(n), slots, np.full(n, records.shape[1])]).astype(np.uint8)
    data = np.concatenate([head, records], axis=1).tobytes()
    both = [(), ("-DMAPLINES_FLOAT",)]
    programs = [c_core.harness("lines", codec.layout, flags=("-O2", *flags)) for flags in both]
    return [np.frombuffer(c_core.run(program, data), READ) for program in programs]


def test_a_factor_in_single_precision_covers_what_double_precision_covers() -> None:
    """In exact arithmetic, about the mean that single precision has.

    Of records of random bits: the narrowest pivots with the most extreme ratios and means, too.
    """
    codec = Codec(layout_of("maplines.dbc"))
    double, single = read_both(codec, *random_records(codec, 150, np.random.default_rng(5)))
    assert np.array_equal(single["reason"], double["reason"])
    assert np.array_equal(single["status"], double["status"])
    accepted = double["reason"] == ACCEPTED
    assert accepted.sum() > 100
    for one, wide in zip(single[accepted], double[accepted], strict=True):
        cov, given = squared(one["factor"]), squared(wide["factor"])
        e = np.array(exact([one["mean"]])[0]) - np.array(exact([wide["mean"]])[0])
        # The sender's mean is m, or as far from m as the covariance allows.
        assert is_semidefinite(cov - given - np.outer(e, e))
        d = e * Fraction(0.7) / max(Fraction(distance(wide["factor"], e)), Fraction(1, 10**30))
        assert is_semidefinite(cov - (given - np.outer(d, d)) - np.outer(d + e, d + e))


def test_lines_of_roads_are_hardly_wider_in_single_precision() -> None:
    """The standard deviations grow by a millionth."""
    codec = Codec(layout_of("maplines.dbc"))
    means, covs = random_lines(2000, 1)
    double, single = read_both(codec, codec.batch.encode(means, covs), np.zeros(2000))
    sigma, wider = (np.sqrt((one["factor"] ** 2).sum(axis=2)) for one in (double, single))
    assert (wider > sigma).all()
    assert np.median(wider / sigma) < 1 + 1e-6
    assert (wider / sigma).max() < 1 + 1e-4


def distance(factor: Any, e: Any) -> float:
    """How many standard deviations a difference is."""
    return float(np.linalg.norm(np.linalg.solve(factor, e.astype(float))))
