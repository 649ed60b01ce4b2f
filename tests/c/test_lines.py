"""Lines as an ECU in single precision receives them."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
from scene_layouts import layout_of
from support import c_core
from support.lines import random_lines

from maplines_can.model.records import written
from maplines_can.wire import Codec

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
    head = np.column_stack([slots, np.full(n, records.shape[1])]).astype(np.uint8)
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
