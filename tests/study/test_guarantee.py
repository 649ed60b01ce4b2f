"""The guarantee of the wire, measured by the study: decoded covariances are never overconfident."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.dbcs import DBC, default_codec, edited

from maplines_can.study import adversarial, evaluate, paper, road
from maplines_can.study.sets import survey
from maplines_can.values.line import VAGUE_SIGMA, Status
from maplines_can.wire import Codec
from maplines_can.wire.layout.packing import Packing

LIMITS = np.array([32.0, 0.5, 0.125, 0.03125])


def check_guarantee(codec: Any, means: Any, covs: Any) -> Any:
    """Check that no covariance is overconfident or indefinite."""
    payloads = codec.batch.encode(means, covs)
    batch = codec.batch.decode(payloads)
    assert batch.accepted.all()
    stated = batch.status != Status.OUT_OF_RANGE
    evaluation = evaluate(means, covs, batch.mean, batch.cov, codec.resolution)
    assert evaluation.positive_definite.all()
    assert not evaluation.overconfident[stated].any()
    return batch, evaluation


def test_a_hundred_thousand_adversarial_covariances(codec: Any) -> None:
    """Sigmas over the whole range, condition to 1e10, singular ones, means at the limits."""
    batch, _ = check_guarantee(codec, *adversarial(100_000, seed=1))
    assert (batch.status == Status.OUT_OF_RANGE).mean() < 0.01
    assert set(np.unique(batch.status)) <= {Status.FULL, Status.SATURATED, Status.OUT_OF_RANGE}


@settings(max_examples=100, deadline=None)
@given(
    st.lists(st.floats(-40, 40), min_size=4, max_size=4),
    st.lists(st.floats(-3, 3), min_size=16, max_size=16),
    st.lists(st.floats(-12, 3), min_size=4, max_size=4),
    st.integers(0, 4),
)
def test_any_covariance_is_covered_or_out_of_range(
    mean: Any, entries: Any, log_sigma: Any, rank: int
) -> None:
    """Any matrix times its transpose, of any rank and scale, with any mean."""
    root = np.array(entries).reshape(4, 4) * 10.0 ** np.array(log_sigma)[:, None]
    root[:, rank:] = 0
    cov = root @ root.T
    check_guarantee(default_codec(), np.array([mean]) * LIMITS / 32, ((cov + cov.T) / 2)[None])


@pytest.mark.parametrize("make", [paper, road, survey])
def test_the_sets_stay_within_the_bounds_of_the_design(codec: Any, make: Any) -> None:
    """KL, saturation, lateral error and sigma ratio, without and with the error of a map."""
    means, covs = make(500, seed=11)
    batch, evaluation = check_guarantee(codec, means, covs)
    assert evaluation.kl_covered.mean() <= 5e-3
    assert np.quantile(evaluation.kl_covered, 0.99) <= 1.2e-2
    assert (batch.status == Status.SATURATED).mean() <= 5e-3
    assert np.abs(evaluation.lateral_error).max() <= 5e-3
    assert np.quantile(evaluation.sigma_ratio, 0.99, axis=0).max() <= 1.06
    assert evaluation.sigma_ratio.min() >= 1


def test_kl_of_the_rounding_agrees_with_the_theory(codec: Any) -> None:
    """Without the inflation: the sum of D^2/24 for ratios and (D ln 2)^2/12 for pivots."""
    rng = np.random.default_rng(4)
    n = 20_000
    root = rng.standard_normal((n, 4, 4)) * [0.5, 0.02, 1e-3, 1e-4] + 0
    covs = np.einsum("nki,nkj->nij", root, root)
    means = np.zeros((n, 4))
    batch = codec.batch.decode(codec.batch.encode(means, covs))
    names = [f.name for f in codec.layout.signals.values()]
    pivots = [codec.layout[name].factor for name in names if name.startswith("Pivot")]
    ratios = [codec.layout[name].factor for name in names if name.startswith("Ratio")]
    theory = sum((p * np.log(2)) ** 2 / 12 for p in pivots) + sum(r**2 / 24 for r in ratios)
    packing = Packing(list(codec.layout.signals.values()), codec.layout.record_bytes)
    raw = packing.unpack(codec.batch.encode(means, covs))
    inflation = 2.0 ** codec.layout["Inflation"].physical(raw["Inflation"])
    plain = batch.cov / inflation[:, None, None]
    keep = batch.status == Status.FULL
    measured = evaluate(means, covs, means, plain, codec.resolution).kl_covered[keep].mean()
    # The standard deviation of the divergence is about its mean: the error is 1/sqrt(n) = 0.7 %.
    assert measured == pytest.approx(theory, rel=0.03)


@pytest.mark.parametrize(
    ("sigma", "correlation", "status"),
    [
        pytest.param([0, 0, 0, 0], 0.0, Status.FULL, id="zero"),
        pytest.param([1e3, 1e-2, 1e-4, 1e-6], 0.0, Status.OUT_OF_RANGE, id="a-kilometre"),
        pytest.param([0.1, 1e-2, 1e-4, 1e-6], 1.5, Status.REPAIRED, id="indefinite"),
        # The ratios of a singular matrix have no end; rounding is no repair.
        pytest.param([0.3, 1e-2, 1e-4, 1e-6], 1 + 1e-15, Status.SATURATED, id="rank-one"),
    ],
)
def test_the_status_of_special_covariances(
    codec: Any, sigma: Any, correlation: float, status: Status
) -> None:
    """A line that is known exactly decodes to the resolution of the mean, not to zero."""
    cov = np.outer(sigma, sigma) * (1.0 if status is Status.SATURATED else np.eye(4))
    cov[0, 1] = cov[1, 0] = correlation * sigma[0] * sigma[1]
    batch, _ = check_guarantee(codec, np.array([[1.75, 0.01, 1e-3, 1e-5]]), cov[None])
    assert batch.status[0] == status


@pytest.mark.parametrize("state", range(4))
@pytest.mark.parametrize("sign", [-1, 1])
def test_a_mean_beyond_its_range_is_covered_or_out_of_range(
    codec: Any, state: Any, sign: int
) -> None:
    """Just beyond the limit the covariance is wider; far beyond it the line is OUT_OF_RANGE."""
    near, far = np.zeros((2, 1, 4))
    near[0, state] = sign * 1.02 * LIMITS[state]
    far[0, state] = sign * 1e6
    cov = np.diag([1e-2, 1e-4, 1e-8, 1e-12])[None]
    batch, _ = check_guarantee(codec, near, cov)
    assert batch.status[0] == Status.SATURATED
    assert np.sqrt(batch.cov[0, state, state]) >= 0.015 * LIMITS[state]
    batch, _ = check_guarantee(codec, far, cov)
    assert batch.status[0] == Status.OUT_OF_RANGE
    assert batch.cov[0].diagonal() == pytest.approx(np.square(VAGUE_SIGMA))


# ---- other DBCs ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("edit", "coarser"),
    [
        pytest.param((r"(YOff[^(]*)\(0.0009765625,0\)(.*)\[-32\|31.9990234375\]",
                      r"\1(0.001953125,0)\2[-64|63.998046875]"), "mean", id="factor-of-y_off"),
        pytest.param((r"(RatioYOffC1[^(]*)\(0.046875,0\)(.*)\[-24\|23.953125\]",
                      r"\1(0.09375,0)\2[-48|47.90625]"), "cov", id="factor-of-a-ratio"),
        pytest.param((r"(Inflation[^:]*: \d+\|)3(@1\+ )\([^)]*\) \[[^]]*\]",
                      r"\g<1>2\2(0.03,0) [0|0.09]"), "cov", id="width-of-the-inflation"),
    ],
)  # fmt: skip
def test_a_changed_dbc_changes_the_code(tmp_path: Path, edit: Any, coarser: str) -> None:
    """With another factor or length in a copy of the DBC, the guarantee still holds."""
    codec, other = Codec.from_dbc(), Codec.from_dbc(edited(tmp_path, edit))
    means, covs = road(500, seed=6)
    first, second = codec.batch.encode(means, covs), other.batch.encode(means, covs)
    assert (first != second).any()
    _, a = check_guarantee(codec, means, covs)
    _, b = check_guarantee(other, means, covs)
    if coarser == "mean":
        assert np.abs(b.lateral_error[:, 0]).mean() > 1.8 * np.abs(a.lateral_error[:, 0]).mean()
    else:
        assert b.kl_covered.mean() > a.kl_covered.mean()


def test_wider_pivots_replace_a_small_inflation(tmp_path: Path) -> None:
    """If the DBC has hardly any inflation, the pivots are lifted instead."""
    starved = (r"(Inflation[^:]*: \d+\|3@1\+ )\([^)]*\) \[[^]]*\]", r"\1(0.001,0) [0|0.007]")
    codec = Codec.from_dbc(edited(tmp_path, starved))
    batch, _ = check_guarantee(codec, *road(500, seed=7))
    assert (batch.status == Status.FULL).mean() > 0.9


def test_the_names_of_the_ratios_order_the_rows(tmp_path: Path) -> None:
    """After renaming Ratio<row><column> and the pivots, the covariance is still covered."""

    def edits() -> Iterator[Any]:
        for name in ("Pivot", "RatioYOff", "RatioBeta"):
            yield f"{name}C1", f"{name}C0"
            yield f"{name}C0", f"{name}C1"
        yield "RatioC0C1", "RatioC1C0"

    text = DBC.read_text()
    table = dict(edits())
    for old in table:
        text = text.replace(f" {old} ", f" @{old} ")
    for old, new in table.items():
        text = text.replace(f" @{old} ", f" {new} ")
    path = tmp_path / "order.dbc"
    path.write_text(text)
    codec = Codec.from_dbc(path)
    assert [("YOff", "Beta", "C0", "C1")[i] for i in codec.covariance.factor.order] == [
        "C0", "C1", "YOff", "Beta",
    ]  # fmt: skip
    check_guarantee(codec, *road(500, seed=8))
