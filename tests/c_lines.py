"""Complete lines in C against Python: comparisons of any number of records, for tests and evidence.

Each function raises AssertionError at the first bit that differs, and returns what it compared.
"""

from __future__ import annotations

import struct
from fractions import Fraction
from typing import Any

import c_core
import numpy as np
from random_lines import random_lines

from maplines_can import Slot, Status
from maplines_can.study import adversarial
from maplines_can.values import fixed_order
from maplines_can.values.line import VAGUE_SIGMA
from maplines_can.wire import Codec
from maplines_can.wire.layout.message_layout import Layout
from maplines_can.wire.reasons import Reason
from maplines_can.wire.records.packer import VERDICTS, RecordPacker

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
#: Numbers of the reasons in C.
REASONS = {None: ACCEPTED} | {reason: i for i, reason in enumerate(Reason)}


# ---- records to lines --------------------------------------------------------------------------


def random_records(codec: Codec, n: int, rng: Any) -> tuple[Any, Any]:
    """Records of random bits with good checksums, some of them damaged, and their slots."""
    layout = codec.layout
    slots = rng.choice([int(slot) for slot in layout.messages], n)
    raw = {
        name: rng.integers(*signal.all_raw, n, endpoint=True)
        for name, signal in layout.signals.items()
    }
    # Nearly all random statuses, kinds and components are invalid: not so in most records.
    usual = rng.random(n) < 0.8
    raw["Status"] = np.where(usual, raw["Status"] % 6, raw["Status"])
    raw["ComponentIndex"] = np.where(usual, 0, raw["ComponentIndex"])
    # So are ranges: every second is turned round.
    ends = np.sort([raw["XMin"], raw["XMax"]], axis=0)
    raw["XMin"], raw["XMax"] = np.where(usual, ends, [raw["XMin"], raw["XMax"]])
    # Bits at the ends of the signals.
    for name, signal in layout.signals.items():
        if name.startswith(("Pivot", "Ratio", "Inflation", "Age")):
            at_end = rng.random(n) < 0.1
            raw[name][at_end] = rng.choice(signal.all_raw, n)[at_end]
    records = RecordPacker(layout).pack(raw, layout.data_ids(slots, n))
    damaged = np.flatnonzero(rng.random(n) < 0.05)
    records[damaged, rng.integers(0, layout.record_bytes, len(damaged))] ^= 1 << rng.integers(
        0, 8, len(damaged), dtype=np.uint8
    )
    return records, slots


def check_decode(dbc: Any, n: int, seed: int = 0, *prefix: str, **compiler: Any) -> dict[str, int]:
    """Compare n random records; return how many of each verdict there were."""
    codec = Codec(dbc if isinstance(dbc, Layout) else Layout.from_dbc(dbc))
    records, slots = random_records(codec, n, np.random.default_rng(seed))
    head = np.empty((n, 3), np.uint8)
    head[:, 0], head[:, 1], head[:, 2] = 0, slots, records.shape[1]
    program = c_core.harness("lines", codec.layout, **compiler)
    out = c_core.run(program, np.concatenate([head, records], axis=1).tobytes(), *prefix)
    got = np.frombuffer(out, READ)
    batch = codec.batch.decode(records, slots)
    expected = np.zeros(n, READ)
    expected["reason"] = [REASONS[VERDICTS[verdict]] for verdict in batch.verdict]
    fine = batch.accepted
    for name in ("mean", "x_min", "x_max", "age", "kind", "status"):
        expected[name][fine] = getattr(batch, name)[fine]
    for name in ("index", "count", "weight"):
        expected[name][fine] = getattr(batch, f"component_{name}")[fine]
    expected["counter"][fine] = batch.counter[fine]
    raw = codec.batch._reader.formats[Slot(slots[0])].packer.unpack(records, slots)[0]
    factors = codec.covariance.factors(raw)
    vague = np.isin(batch.status, [Status.UNKNOWN, Status.OUT_OF_RANGE])
    order = codec.covariance.factor.order
    diagonal = np.zeros((4, 4))
    for column, state in enumerate(order):
        diagonal[state, column] = VAGUE_SIGMA[state]
    factors[vague] = diagonal
    expected["factor"][fine] = factors[fine]
    different = got != expected
    assert not different.any(), (got[different][0], expected[different][0])
    # The covariance that Python decodes is the square of the factor, to the last bit.
    square = fixed_order.product(got["factor"], got["factor"].mT)
    assert np.array_equal(square[fine], batch.cov[fine])
    return {str(v): int((batch.verdict == i).sum()) for i, v in enumerate(VERDICTS)}


# ---- lines to records --------------------------------------------------------------------------


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


# ---- exact arithmetic --------------------------------------------------------------------------


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
