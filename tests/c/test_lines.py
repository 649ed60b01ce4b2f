"""Sender of lines on an ECU, and its receiver in single precision."""

from __future__ import annotations

import struct
from fractions import Fraction
from typing import Any

import numpy as np
import pytest
from scene_layouts import layout_of
from support import c_core
from support.c_layouts import with_messages, with_slots
from support.random_lines import random_lines

from maplines_can import Slot
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


class Lines:
    """Lines to be sent: arrays of n values; mixtures have k components."""

    def __init__(self, means: Any, covs: Any, rng: Any, codec: Codec, *, k: int = 0) -> None:
        self.n, self.k = len(means), k
        self.means, self.covs = np.asarray(means, float), np.asarray(covs, float)
        n, slots = self.n, [int(slot) for slot in codec.layout.messages]
        low = rng.choice([-20.0, -8.0, 0.0, -131.5, 3.3], n)
        self.x_min = low + rng.choice([0.0, 0.04, rng.uniform(-1, 1)], n)
        self.x_max = self.x_min + rng.choice([0.0, 1.5, 30.0, 77.7, 80.0, 500.0], n)
        self.age = rng.choice([0.0, 0.0421, 0.5, 1e9, np.inf], n)
        self.slot, self.kind = rng.choice(slots, n), rng.integers(0, 8, n)
        self.counter = rng.integers(0, 2 ** codec.layout["Counter"].length, n)
        self.status = rng.choice([1, 1, 1, 1, 1, 2, 3, 4, 0, 5], n)
        self.weights = np.ones((n, max(k, 1)))
        if k:
            self.weights = rng.dirichlet(np.full(k, rng.choice([0.3, 2.0])), n) + 1e-4
            self.weights /= self.weights.sum(axis=1, keepdims=True)

    def payloads(self, codec: Codec) -> Any:
        """(n, k or 1, bytes) records of Python."""
        attributes = {
            name: getattr(self, name)
            for name in ("slot", "kind", "x_min", "x_max", "age", "status", "counter")
        }
        if self.k:
            return codec.batch.encode_mixtures(self.weights, self.means, self.covs, **attributes)
        return codec.batch.encode(self.means, self.covs, **attributes)[:, None]

    def cases(self, *, is_fd: bool) -> bytes:
        """Input of the harness."""
        k = max(self.k, 1)
        component = np.dtype([("weight", "<f8"), ("mean", "<f8", 4), ("cov", "<f8", (4, 4))])
        case = np.dtype(
            [("command", "u1"), ("slot", "u1"), ("kind", "u1"), ("status", "u1"), ("fd", "u1"),
             ("counter", "<u4"), ("x_min", "<f8"), ("x_max", "<f8"), ("age", "<f8"),
             ("count", "u1"), ("components", component, k)]
        )  # fmt: skip
        cases = np.zeros(self.n, case)
        for name in ("slot", "kind", "status", "counter", "x_min", "x_max", "age"):
            cases[name] = getattr(self, name)
        cases["command"], cases["fd"], cases["count"] = 1, is_fd, self.k or LINE
        cases["components"]["weight"] = self.weights
        cases["components"]["mean"] = self.means.reshape(self.n, k, 4)
        cases["components"]["cov"] = self.covs.reshape(self.n, k, 4, 4)
        return cases.tobytes()


def check_encode(
    codec: Codec, lines: Lines, *prefix: str, is_fd: bool = False, **compiler: Any
) -> Any:
    """Compare the frames of lines; return how many there were of each status."""
    out = c_core.run(
        c_core.harness("lines", codec.layout, **compiler), lines.cases(is_fd=is_fd), *prefix
    )
    payloads = lines.payloads(codec)
    statuses = codec.batch.decode(
        payloads.reshape(-1, payloads.shape[-1]), np.repeat(lines.slot, payloads.shape[1])
    ).status.reshape(payloads.shape[:2])
    encoder, modulus = codec.encoder(), 2 ** codec.layout["Counter"].length
    place = 0
    for i, records in enumerate(payloads):
        frames = [f for r in records for f in encoder.frames(r, Slot(lines.slot[i]), fd=is_fd)]
        following = (lines.counter[i] + len(records)) % modulus
        expected = [struct.pack("<BB", 0, worst(statuses[i])), bytes([len(frames)])]
        expected.append(struct.pack("<I", following))
        for can_id, data, fd, is_extended in frames:
            expected.append(struct.pack("<IBBB", can_id, is_extended, fd, len(data)) + data)
        wanted = b"".join(expected)
        got = out[place : place + len(wanted)]
        assert got == wanted, (i, lines.means[i], lines.covs[i], lines.status[i], got, wanted)
        place += len(wanted)
    assert place == len(out)
    return np.bincount(statuses.ravel(), minlength=6)


def worst(statuses: Any) -> int:
    """The status of a mixture."""
    return int(max(map(int, statuses), key=[1, 3, 4, 2, 0, 5].index))


def awkward_lines(codec: Codec, n: int, seed: int) -> Lines:
    """Motorways, awkward covariances, means beyond the message, indefinite, tiny and huge ones."""
    rng = np.random.default_rng(seed)
    means, covs = random_lines(n, seed)
    strange_means, strange_covs = adversarial(n, seed)
    kind = rng.integers(0, 8, n)
    means = np.where((kind >= 2)[:, None], strange_means, means)
    covs = np.where((kind >= 2)[:, None, None], strange_covs, covs)
    means[kind == 3] *= rng.choice([0.5, 2.0, 10.0, 1e6, 1e200], ((kind == 3).sum(), 1))
    half = rng.standard_normal((n, 4, 4)) * np.sqrt(np.einsum("nii->ni", covs))[:, :, None]
    indefinite = (half + half.mT) / 2
    indefinite[:, range(4), range(4)] = np.abs(np.einsum("nii->ni", indefinite))
    covs = np.where((kind == 4)[:, None, None], indefinite, covs)
    covs[kind == 5] *= rng.choice([0.0, 1e-300, 1e-9, 1e9, 1e250], ((kind == 5).sum(), 1, 1))
    variance = rng.random((n, 4)) < 0.3
    covs[kind == 6] *= ~(variance[:, :, None] & variance[:, None, :])[kind == 6]
    return Lines(means, covs.clip(-1e307, 1e307), rng, codec)


@pytest.mark.parametrize(("is_fd", "flags"), [(False, ("-O2",)), (True, ("-O0",))])
def test_lines_have_the_frames_of_the_library(is_fd: bool, flags: tuple[str, ...]) -> None:
    """Frames, statuses and counters; every status occurs."""
    codec = Codec(layout_of("maplines.dbc"))
    lines = awkward_lines(codec, 600, seed=is_fd)
    statuses = check_encode(codec, lines, is_fd=is_fd, flags=flags)
    assert (statuses > 10).all(), statuses


@pytest.mark.parametrize("k", [1, 8])
def test_mixtures_have_the_frames_of_the_library(k: int) -> None:
    """Weights between the steps; means of the components some sigmas apart, some out of range."""
    codec = Codec(layout_of("maplines.dbc"))
    lines = awkward_lines(codec, 200 * k, seed=k)
    means = lines.means.reshape(200, k, 4)
    apart = np.array([0.05, 0.5, 1.0, 0.0]).repeat(50)[:, None, None]
    means = means[:, :1] + (means - means[:, :1]) * apart
    covs = lines.covs.reshape(200, k, 4, 4)
    check_encode(codec, Lines(means, covs, np.random.default_rng(k), codec, k=k), is_fd=k == 8)


COV = np.diag([1e-2, 1e-4, 1e-8, 1e-12])


@pytest.mark.parametrize(
    ("layout", "slot", "is_fd", "refusal"),
    [
        (with_slots(layout_of("maplines.dbc"), Slot.ROUTE), 0, False, 1),
        (with_messages(layout_of("maplines.dbc"), can_id=None), 0, False, 1),
        (with_messages(layout_of("maplines.dbc"), can_id=None), 0, True, 0),
        (with_messages(layout_of("maplines.dbc"), fd_can_id=None), 0, True, 1),
    ],
    ids=["slot", "no-classic", "FD", "no-FD"],
)
def test_a_line_without_a_message(layout: Layout, slot: int, is_fd: bool, refusal: int) -> None:
    """In the frame format that is wanted."""
    lines = Lines(np.zeros((1, 4)), COV[None], np.random.default_rng(0), Codec(layout))
    lines.slot, lines.status = np.array([slot]), np.array([1])
    out = c_core.run(c_core.harness("lines", layout), lines.cases(is_fd=is_fd))
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
