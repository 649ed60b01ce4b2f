"""Complete lines in C, back to back with Python: the same payloads and numbers, bit for bit."""

from __future__ import annotations

import struct
from fractions import Fraction
from pathlib import Path
from typing import Any

import c_core
import numpy as np
import pytest
from c_layouts import with_messages, with_slots
from c_lines import (
    ACCEPTED,
    LINE,
    READ,
    REASONS,
    Lines,
    awkward_lines,
    check_decode,
    check_encode,
    exact,
    is_semidefinite,
    random_records,
    squared,
)
from dbcs import edited
from random_dbc import LIMIT_SEED, random_dbc
from random_lines import random_lines
from scene_layouts import layout_of

from maplines_can import Gaussian, Slot, Status
from maplines_can.cli import main
from maplines_can.values import fixed_order
from maplines_can.values.mixture import GaussianMixture, moments
from maplines_can.wire import Codec
from maplines_can.wire.covariance.nearest_line import nearest_line
from maplines_can.wire.layout.message_layout import Layout
from maplines_can.wire.layout.pose_layout import POSE, PoseLayout
from maplines_can.wire.layout.record_layout import RecordLayout
from maplines_can.wire.protection.e2e import record_crc
from maplines_can.wire.reasons import Reason
from maplines_can.wire.reception.mixtures import ROUNDING

COMPLETE = ("maplines.dbc", "maplines-secoc.dbc")

# ---- records to lines --------------------------------------------------------------------------


@pytest.mark.parametrize("dbc", COMPLETE)
def test_records_are_read_as_in_python(dbc: str) -> None:
    """Any bits, with good checksums and with bad ones: the same verdicts and the same bits."""
    counts = check_decode(layout_of(dbc), 5000)
    assert all(number > 10 for number in counts.values()), counts


@pytest.mark.parametrize("seed", [0, 2, LIMIT_SEED])
def test_records_of_a_random_dbc_are_read_as_in_python(seed: int) -> None:
    """With other widths, orders of rows, byte orders and places of the signals."""
    check_decode(Layout.from_text(random_dbc(seed)), 1000)


@pytest.mark.parametrize("flags", [("-O0",), ("-O3", *c_core.NATIVE)])
def test_the_bits_do_not_depend_on_the_optimisation(flags: tuple[str, ...]) -> None:
    layout = layout_of("maplines.dbc")
    check_decode(layout, 1000, flags=flags)
    codec = Codec(layout)
    check_encode(codec, awkward_lines(codec, 300, seed=9), flags=flags)


def with_crc(record: bytearray, layout: RecordLayout, data_id: int) -> bytearray:
    """Return a record with the page numbers and transfer IDs that it has, and its checksum."""
    crc = record_crc(np.frombuffer(bytes(record), np.uint8)[None], data_id, layout.crc_offset)[0]
    record[layout.crc_offset : layout.crc_offset + 2] = int(crc).to_bytes(2, "little")
    return record


@pytest.mark.parametrize("dbc", ["maplines.dbc", "maplines-pose.dbc"])
def test_records_of_any_length_are_checked_as_in_python(dbc: str) -> None:
    """Of lines and of the pose error, damaged or with values that no sender sends."""
    layout = layout_of(dbc)
    codec = Codec(layout)
    rng = np.random.default_rng(7)
    cases, reasons = b"", []
    for owner in (Slot.EGO_LEFT, Slot.ROUTE, POSE) * 250:
        form = codec.reader.formats[owner]
        own: Layout | PoseLayout | None = layout if owner != POSE else layout.pose
        if own is None or (not layout.is_conditional and owner == POSE):
            continue  # the harness would read it as a line
        raw = {
            name: int(rng.integers(*signal.all_raw, endpoint=True))
            for name, signal in own.signals.items()
        }
        if rng.random() < 0.5:  # a form that a sender may have sent
            raw |= dict.fromkeys([name for name in raw if name.startswith("Own")], 0)
            if "OwnShape" in raw and rng.random() < 0.3:
                raw["OwnShape"] = 1  # levels beside a covariance, if there is one
            raw |= {name: abs(raw[name]) // 2 for name in ("XMin",) if name in raw}
        record = bytearray(form.packer.pack_one(raw, form.data_ids[owner]))
        change = rng.random()
        if change < 0.2:
            record = record[: rng.integers(0, len(record) + 1)]
        elif change < 0.3:
            record += bytes(int(rng.integers(1, 80)))
        elif change < 0.5:
            record[rng.integers(len(record))] ^= 1 << rng.integers(8)
        elif change < 0.6 and own.short_pages < own.pages:  # a form that its content denies
            pages = int(rng.choice([own.short_pages, own.pages]))
            record = with_crc(
                record[: 8 * pages].ljust(8 * pages, b"\0"), own, form.data_ids[owner]
            )
        number = 8 if owner == POSE else int(owner)
        cases += bytes([0, number, len(record)]) + record
        content = codec.reader.read(bytes(record), owner, 0)
        reasons.append(REASONS[content if isinstance(content, Reason) else None])
    out = c_core.run(c_core.harness("lines", layout), cases)
    got = [*out] if layout.is_conditional else [*np.frombuffer(out, READ)["reason"]]
    assert got == reasons
    expected = {Reason.LENGTH, Reason.MIXED, Reason.CRC, Reason.CONTENT, None}
    assert set(reasons) == {REASONS[reason] for reason in expected}


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
    double, single = read_both(codec, *random_records(codec, 400, np.random.default_rng(5)))
    assert np.array_equal(single["reason"], double["reason"])
    assert np.array_equal(single["status"], double["status"])
    accepted = double["reason"] == ACCEPTED
    assert accepted.sum() > 300
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


def test_the_gaussian_of_a_mixture_is_that_of_python() -> None:
    """Its mean, and the factor of its covariance with the rows in the order of the DBC."""
    codec = Codec(layout_of("maplines.dbc"))
    rng = np.random.default_rng(11)
    order = codec.covariance.factor.order
    raw = {
        name: rng.integers(*s.all_raw, 80, endpoint=True)
        for name, s in codec.layout.signals.items()
    }
    factors = codec.covariance.factors(raw)
    means = rng.normal(size=(80, 4)) * [1.0, 0.05, 1e-3, 1e-5]
    factors[75:] = np.eye(4)
    factors[75:, order[1:], order[0]] = 1e8  # so correlated that rounding makes them indefinite
    data, expected, indefinite = b"", [], 0
    for k in (1, 2, 5, 8, 8, -2, -3):
        chosen = rng.choice(75, k, replace=False) if k > 0 else np.arange(80 + k, 80)
        k = abs(k)
        weights = rng.dirichlet(np.ones(k))
        data += bytes([3, k])
        for weight, i in zip(weights, chosen, strict=True):
            data += np.concatenate([[weight], means[i], factors[i].ravel()]).tobytes()
        covs = fixed_order.product(factors[chosen], factors[chosen].mT)
        mean, cov = moments(weights, means[chosen], covs)
        factor, ordered = np.zeros((4, 4)), cov[np.ix_(order, order)]
        if not fixed_order.is_definite(ordered[None])[0]:
            ordered += ROUNDING * np.diag(ordered.diagonal())
            indefinite += 1
        factor[order] = fixed_order.cholesky(ordered)
        expected += [*mean, *factor.ravel()]
        if k > 1:
            components = [Gaussian(m, S) for m, S in zip(means[chosen], covs, strict=True)]
            overall = GaussianMixture(weights, components).overall
            assert np.array_equal(overall.cov, cov)
            assert np.array_equal(overall.mean, mean)
    out = c_core.run(c_core.harness("lines", codec.layout), data)
    assert np.frombuffer(out).tolist() == expected
    assert indefinite == 2


# ---- lines to records --------------------------------------------------------------------------


@pytest.mark.parametrize("dbc", COMPLETE)
@pytest.mark.parametrize("is_fd", [False, True])
def test_lines_are_encoded_as_in_python(dbc: str, is_fd: bool) -> None:
    """Frames, statuses and counters; every status occurs."""
    codec = Codec(layout_of(dbc))
    statuses = check_encode(codec, awkward_lines(codec, 3000, seed=is_fd), is_fd=is_fd)
    assert (statuses > 30).all(), statuses


@pytest.mark.parametrize("k", [1, 2, 3, 8])
def test_mixtures_are_encoded_as_in_python(k: int) -> None:
    """Weights between the steps; means of the components some sigmas apart, some out of range."""
    codec = Codec(layout_of("maplines.dbc"))
    lines = awkward_lines(codec, 400 * k, seed=k)
    means = lines.means.reshape(400, k, 4)
    means = (
        means[:, :1]
        + (means - means[:, :1]) * np.array([0.05, 0.5, 1.0, 0.0]).repeat(100)[:, None, None]
    )
    covs = lines.covs.reshape(400, k, 4, 4)
    check_encode(codec, Lines(means, covs, np.random.default_rng(k), codec, k=k), is_fd=k == 3)


def test_nearest_lines_are_the_same() -> None:
    """Of lines beyond the message in ranges of any place and length, some of them absurd."""
    codec = Codec(layout_of("maplines.dbc"))
    rng = np.random.default_rng(3)
    n = 300
    means = (
        rng.uniform(-1, 1, (n, 4))
        * [80, 1.5, 0.5, 0.1]
        * rng.choice([0.1, 1, 1e9], (n, 1), p=[0.5, 0.4, 0.1])
    )
    first = rng.uniform(-60, 60, n) * rng.choice([1, 1e5, 1e160], n, p=[0.9, 0.05, 0.05])
    last = first + rng.uniform(0.5, 100, n)
    cases = np.zeros(n, np.dtype([("command", "u1"), ("numbers", "<f8", 7)]))
    cases["command"] = 2
    least = np.ones(n)
    first[-20:], last[-20:], least[-20:] = 0.0, 0.0, 0.0  # only the offset matters at a point
    cases["numbers"] = np.column_stack([means, first, last, least])
    out = c_core.run(c_core.harness("lines"), cases.tobytes())
    got = np.frombuffer(out, np.dtype([("found", "u1"), ("numbers", "<f8", 6)]))
    signals = [codec.layout[name] for name in ("YOff", "Beta", "C0", "C1")]
    found = 0
    for i in range(n):
        with np.errstate(all="ignore"):
            near = nearest_line(
                signals, means[i], np.array([first[i], last[i]]), least[i], codec.covariance.reach
            )
        assert got["found"][i] == (near is not None)
        if near is not None:
            assert got["numbers"][i].tolist() == [*near.mean, *near.x_range]
            found += 1
    assert 50 < found < 250


def test_ends_of_a_range_hardly_beyond_a_step() -> None:
    """Rounding inwards allows for the error of a division, but no range is ever too wide."""
    codec = Codec(layout_of("maplines.dbc"))
    n = 200
    lines = Lines(np.zeros((n, 4)), np.tile(COV, (n, 1, 1)), np.random.default_rng(6), codec)
    beyond = np.random.default_rng(7).choice([0.0, 1e-12, 1e-10, -1e-10, 3e-9, -3e-9], (2, n))
    lines.x_min, lines.x_max = 4.0 * np.arange(n) % 24 - 16 + beyond[0], 40.0 + beyond[1]
    lines.status[:] = Status.FULL
    check_encode(codec, lines)
    sent = codec.batch.decode(lines.payloads(codec)[:, 0], lines.slot)
    assert (sent.x_min >= lines.x_min).all()
    assert (sent.x_max <= lines.x_max).all()


def test_lines_of_random_dbcs_are_encoded_as_in_python() -> None:
    """Widths and steps of any size: coarse inflations are searched far, and encoded again."""
    for seed in (0, 3):
        codec = Codec(Layout.from_text(random_dbc(seed)))
        check_encode(codec, awkward_lines(codec, 400, seed), is_fd=seed % 2 == 1)


def test_lines_of_a_designed_dbc_are_sent_and_read_as_in_python(tmp_path: Path) -> None:
    dbc = tmp_path / "designed.dbc"
    assert main(["design", "--frames", "3", "--set", "road", "--n", "100", "--out", str(dbc)]) == 0
    codec = Codec.from_dbc(dbc)
    check_decode(codec.layout, 2000)
    check_encode(codec, awkward_lines(codec, 500, seed=4))


@pytest.mark.parametrize("inflation", ["1@1+ (0.001,0)", "3@1+ (0.0003,0)", "3@1+ (0.02,-0.05)"])
def test_an_inflation_that_is_too_small_is_made_up_for(tmp_path: Path, inflation: str) -> None:
    """By encoding again, for a target that is scaled by what was missing."""
    pattern = r"(SG_ Inflation(?: m\d)? : \d+\|)3@1\+ \(0.0124,0\)( )\[[^]]*\]"
    codec = Codec.from_dbc(edited(tmp_path, (pattern, rf"\g<1>{inflation}\2[0|0]")))
    lines = awkward_lines(codec, 1000, seed=1)
    check_encode(codec, lines)
    scales = codec.batch.decode(lines.payloads(codec)[:, 0], lines.slot)
    assert (scales.status == Status.FULL).sum() > 100


GOOD: dict[str, Any] = {
    "slot": 0,
    "kind": 1,
    "status": 1,
    "x_min": -8.0,
    "x_max": 64.0,
    "age": 0.04,
}
COV = np.diag([1e-2, 1e-4, 1e-8, 1e-12])
RNG = np.random.default_rng(0)
NAN, INF = float("nan"), float("inf")


def entry(i: int, j: int, value: float) -> Any:
    cov = COV.copy()
    cov[i, j] = value
    return cov


@pytest.mark.parametrize(
    ("refusal", "changes"),
    [
        pytest.param(0, {}, id="sent"),
        pytest.param(1, {"slot": 9}, id="no-slot"),
        pytest.param(1, {"slot": 8}, id="pose"),
        pytest.param(3, {"mean": [NAN, 0, 0, 0]}, id="mean-nan"),
        pytest.param(3, {"mean": [0, 0, -INF, 0]}, id="mean-infinite"),
        pytest.param(4, {"cov": entry(1, 1, NAN)}, id="cov-nan"),
        pytest.param(4, {"cov": entry(3, 0, 2e307)}, id="cov-huge"),
        pytest.param(5, {"cov": entry(2, 2, -1e-300)}, id="negative"),
        pytest.param(6, {"cov": entry(0, 1, 1e-3 * 2e-9)}, id="asymmetric"),
        pytest.param(0, {"cov": entry(0, 1, 1e-3 * 9e-10)}, id="nearly-symmetric"),
        pytest.param(7, {"x_min": NAN}, id="range-nan"),
        pytest.param(7, {"x_max": INF}, id="range-infinite"),
        pytest.param(7, {"x_min": 64.1}, id="range-reversed"),
        pytest.param(0, {"x_min": 64.0}, id="range-empty"),
        pytest.param(8, {"age": -1e-9}, id="age-negative"),
        pytest.param(8, {"age": NAN}, id="age-nan"),
        pytest.param(0, {"age": INF}, id="age-infinite"),
        pytest.param(9, {"kind": 8}, id="kind"),
        pytest.param(10, {"status": 6}, id="status"),
        pytest.param(0, {"status": 0, "cov": entry(1, 1, NAN)}, id="cov-not-read"),
        pytest.param(11, {"weights": [0.5, 0.6]}, id="weights-sum"),
        pytest.param(11, {"weights": [1.5, -0.5]}, id="weight-negative"),
        pytest.param(11, {"weights": [NAN, 0.5]}, id="weight-nan"),
        pytest.param(0, {"weights": [0.5, 0.5]}, id="mixture"),
        pytest.param(11, {"weights": [2.0, -1.0]}, id="weight-2"),
        pytest.param(12, {"weights": [1 / 9] * 9}, id="components"),
        pytest.param(12, {"weights": []}, id="no-components"),
        pytest.param(1, {"weights": [0.5, 0.5], "slot": 8}, id="mixture-of-no-slot"),
        pytest.param(4, {"weights": [0.5, 0.5], "cov": entry(1, 1, INF)}, id="component"),
    ],
)
def test_a_mistake_of_the_caller_has_its_name(refusal: int, changes: dict[str, Any]) -> None:
    """Nothing is sent, and the counter does not advance."""
    given: dict[str, Any] = GOOD | {"mean": np.zeros(4), "cov": COV, "weights": None} | changes
    head = struct.pack(
        "<BBBBBI3d", 1, given["slot"], given["kind"], given["status"], 0, 255,
        given["x_min"], given["x_max"], given["age"],
    )  # fmt: skip
    weights = [1.0] if given["weights"] is None else given["weights"]
    data = head + bytes([LINE if given["weights"] is None else len(weights)])
    for weight in weights:
        data += np.concatenate([[weight], given["mean"], np.ravel(given["cov"])]).tobytes()
    out = c_core.run(c_core.harness("lines"), data)
    number, _, frames, counter = struct.unpack_from("<BBBI", out)
    assert number == refusal
    k = len(weights)
    assert frames == (0 if refusal else 4 * k)
    assert counter == (255 if refusal else (255 + k) % 256)
    assert len(out) == 7 + frames * (7 + 8)


@pytest.mark.parametrize("k", [0, 2])
@pytest.mark.parametrize(
    ("layout", "slot", "is_fd", "refusal"),
    [
        pytest.param(layout_of("maplines.dbc"), Slot.ROUTE, True, 0, id="sent"),
        pytest.param(with_slots(layout_of("maplines.dbc"), Slot.ROUTE), 0, False, 1, id="slot"),
        pytest.param(
            with_messages(layout_of("maplines.dbc"), can_id=None), 0, False, 1, id="no-classic"
        ),
        pytest.param(with_messages(layout_of("maplines.dbc"), can_id=None), 0, True, 0, id="FD"),
        pytest.param(
            with_messages(layout_of("maplines.dbc"), fd_can_id=None), 0, True, 1, id="no-FD"
        ),
        pytest.param(
            with_messages(layout_of("maplines.dbc"), fd_can_id=None), 0, False, 0, id="classic"
        ),
    ],
)
def test_a_line_without_a_message(
    layout: Layout, slot: int, is_fd: bool, refusal: int, k: int
) -> None:
    """In the frame format that is wanted."""
    means, covs = np.zeros((1, max(k, 1), 4)), np.tile(COV, (1, max(k, 1), 1, 1))
    lines = Lines(means if k else means[0], covs if k else covs[0], RNG, Codec(layout), k=k)
    lines.slot, lines.status = np.array([slot]), np.array([1])
    out = c_core.run(c_core.harness("lines", layout), lines.cases(is_fd=is_fd))
    assert (out[0], out[2] > 0) == (refusal, refusal == 0)


def test_a_line_of_a_conditional_dbc_is_sent_as_a_scene() -> None:
    """A DBC whose records have no covariance of their own."""
    codec = Codec(layout_of("maplines.dbc"))
    case = Lines(np.zeros((1, 4)), COV[None], np.random.default_rng(0), codec).cases(is_fd=False)
    out = c_core.run(c_core.harness("lines", layout_of("maplines-pose.dbc")), case)
    assert out[0] == 2
    assert out[2] == 0
