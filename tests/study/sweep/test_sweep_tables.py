"""The tables of a study: what they hold, and how they read."""

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.study_helpers import small, tables

from maplines_can.study import evaluate, road
from maplines_can.study.comparison import transmit
from maplines_can.study.sets import drawn_chunk, line_set
from maplines_can.study.sweep.plan import Plan, codec_of, theory
from maplines_can.study.sweep.run import run_study
from maplines_can.study.sweep.summary import SCHEMAS, summary_text


def test_the_summary_is_that_of_all_chunks_at_once(undisturbed: Any) -> None:
    """Compared with all chunks sent through the codec and evaluated together."""
    chunks = [drawn_chunk("road", 3, i, 50) for i in range(8)]
    means, covs = (np.concatenate(arrays) for arrays in zip(*chunks, strict=True))
    codec = codec_of(Plan("Cholesky"))
    batch = transmit(codec, means, covs)
    evaluation = evaluate(means, covs, batch.mean, batch.cov, codec.resolution)
    row = undisturbed["summary"][0]

    assert (row["set"], row["code"], row["finer_bits"], row["n"]) == ("road", "Cholesky", 0, 400)
    assert row["kl_mean"] == pytest.approx(evaluation.kl_covered.mean(), rel=1e-12)
    assert row["kl_max"] == evaluation.kl_covered.max()
    assert row["kl_p50"] == pytest.approx(np.median(evaluation.kl_covered), rel=0.02)
    assert row["sigma_ratio_p99_80"] == pytest.approx(
        np.quantile(evaluation.sigma_ratio[:, 3], 0.99), rel=0.005
    )
    assert row["not_positive_definite"] == row["overconfident"] == row["out_of_range"] == 0
    assert (row["covariance_bits"], row["record_bits"], row["classic_frames"]) == (105, 256, 4)
    assert row["kl_theory"] == pytest.approx(sum(theory(codec).values()))


def test_the_worst_cases_are_the_worst(undisturbed: Any) -> None:
    """There are five of each code, in order, with their means and covariances."""
    worst = [row for row in undisturbed["worst"] if row["code"] == "Cholesky"]
    kl = [row["kl"] for row in worst]

    assert [row["rank"] for row in worst] == [1, 2, 3, 4, 5]
    assert kl == sorted(kl, reverse=True)
    assert kl[0] == undisturbed["summary"][0]["kl_max"]
    cov = np.array([worst[0][f"cov_{i}{j}"] for i in range(4) for j in range(4)]).reshape(4, 4)
    decoded = np.array(
        [worst[0][f"decoded_cov_{i}{j}"] for i in range(4) for j in range(4)]
    ).reshape(4, 4)
    assert np.linalg.eigvalsh(decoded - cov)[0] > -1e-15
    assert worst[0]["status"] == "FULL"


def test_tables_have_the_columns_of_their_schemas(undisturbed: Any) -> None:
    """Tables may be empty; theory has D^2 / 24 for a ratio, (D ln 2)^2 / 12 for a pivot."""
    for name, rows in undisturbed.items():
        for row in rows:
            assert row.keys() | {"seconds", "gaussians_per_second"} >= SCHEMAS[name].keys()
    assert undisturbed["limit"] == undisturbed["fields"] == []
    assert "Cholesky" in summary_text(undisturbed["summary"], undisturbed["terms"])
    terms = theory(codec_of(Plan("Cholesky")))
    assert len(terms) == 10
    assert terms["RatioC0C1"] == pytest.approx((1 / 32) ** 2 / 24)
    assert terms["PivotYOff"] == pytest.approx((0.034 * math.log(2)) ** 2 / 12)
    assert theory(codec_of(Plan("Sigmas"))) == {}


def test_clipped_means_have_figures_of_their_own(tmp_path: Path) -> None:
    """Their error is not rounding; the covariance covers it."""
    pytest.importorskip("pyarrow")
    means, covs = road(50, seed=8)
    means[7, 0] = 33.0
    np.savez(tmp_path / "mine.npz", mean=means, cov=covs)
    study = small(sets=[line_set(str(tmp_path / "mine.npz"))], codes=("Cholesky",))
    row = tables(run_study(study, tmp_path / "out", jobs=1))["summary"][0]

    assert row["clipped"] == row["saturated"] == 0.02
    assert row["clipped_error_max_80"] == pytest.approx(1, abs=0.01)
    assert row["mean_error_max_80"] < 0.005
    assert row["overconfident"] == 0


def test_fields_terms_and_limits(tmp_path: Path) -> None:
    """A bit more lowers the divergence; theory holds; too few samples give no limit."""
    pytest.importorskip("pyarrow")
    means, covs = road(1700, seed=8)  # a drawn set would be drawn for each part of the study
    np.savez(tmp_path / "mine.npz", mean=means, cov=covs)
    study = small(
        sets=[line_set(str(tmp_path / "mine.npz"))], codes=("Cholesky",), finer_bits=(0, 2),
        n=1700, chunk_size=850, fields_n=400, limit_n=1700,
    )  # fmt: skip
    result = tables(run_study(study, tmp_path / "out", jobs=1))
    fields = {(row["field"], row["delta_bits"]): row for row in result["fields"]}
    limits = {(row["part"], row["kl"]): row for row in result["limit"]}
    fine = result["summary"][1]

    assert len(fields) == 2 * (4 + 11)
    more, less = fields["RatioC0C1", 1], fields["RatioC0C1", -1]
    assert more["kl_change_mean"] < -5 * more["kl_change_mean_se"] < 0
    assert less["kl_change_mean"] > 5 * less["kl_change_mean_se"] > 0
    # 400 errors determine their rms to 4 %; the step of C1 hardly counts at 80 m.
    assert fields["C0", 1]["lateral_rms_80"] < 0.7 * fields["C0", -1]["lateral_rms_80"]
    assert fine["finer_bits"] == 2
    error = 4 * fine["kl_before_inflation_mean_se"] / fine["kl_theory"]
    assert fine["kl_before_inflation_mean"] / fine["kl_theory"] == pytest.approx(1, abs=error)
    assert {row["field"] for row in result["terms"]} == theory(codec_of(Plan("Cholesky"))).keys()
    assert limits["covariance", 1e-4]["bits"] > limits["covariance", 1e-3]["bits"] > 20
    assert limits["all", 1e-3]["bits"] is None
    assert "draw more" in limits["all", 1e-3]["caveat"]
