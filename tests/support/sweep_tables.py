"""Tables as a small sweep writes them, for tests of the report."""

import math
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from maplines_can.study import LATERAL_X, evaluate, paper
from maplines_can.study.code_dbcs import covariance_signals
from maplines_can.study.codes import CODES
from maplines_can.study.comparison import transmit
from maplines_can.study.sweep.plan import Plan, codec_of
from maplines_can.study.sweep.summary import SCHEMAS
from maplines_can.values.line import Status

USED = ["Cholesky", "LinearNearest", "MeanOnly"]
#: A set may be a user's file, and a file may be called anything.
SETS = ["paper", '</script><img src=x onerror="boom()"> & \'"drive.csv']
N = 400
SCENE_CODES = ("Cholesky", "PoseConditional")


def rows_of(set_: Any, code: Any, finer_bits: Any, mean: Any, cov: Any) -> Any:
    """Return a code's row of the summary and its worst cases; infinities are kept."""
    codec = codec_of(Plan(code, finer_bits))
    batch = transmit(codec, mean, cov)
    verdict = evaluate(mean, cov, batch.mean, batch.cov, codec.resolution)
    kl, bits = verdict.kl_covered, sum(s.bits for s in covariance_signals(code, finer_bits))
    row = {"set": set_, "code": code, "finer_bits": finer_bits, "n": len(mean), "seed": 0}
    row |= {"covariance_bits": bits, "record_bits": 8 * codec.layout.record_bytes}
    row |= {"classic_frames": codec.layout.pages, "seconds": 0.1, "gaussians_per_second": 4e3}
    row["definite_guarantee"] = CODES[code].positive_definite
    row["covering_guarantee"] = CODES[code].covering
    for name, which in (
        ("not_positive_definite", ~verdict.positive_definite),
        ("overconfident", verdict.overconfident),
        ("saturated", batch.status == Status.SATURATED),
        ("out_of_range", batch.status == Status.OUT_OF_RANGE),
    ):
        row |= {name: float(np.mean(which)), f"{name}_se": float(np.std(which) / math.sqrt(N))}
    se = float(kl.std() / math.sqrt(N)) if np.isfinite(kl).all() else None
    row |= {"kl_mean": float(kl.mean()), "kl_mean_se": se, "kl_p50": float(np.median(kl))}
    row |= {"kl_p99": float(np.quantile(kl, 0.99, method="nearest")), "kl_max": float(kl.max())}
    row |= {"kl_untouched_mean": float(verdict.kl.mean()), "kl_untouched_mean_se": None}
    row |= {"kl_before_inflation_mean": None, "kl_theory": None}
    for i, x in enumerate(LATERAL_X):
        error, ratio = np.abs(verdict.lateral_error[:, i]), verdict.sigma_ratio[:, i]
        row[f"mean_error_rms_{x:g}"] = float(np.sqrt((error**2).mean()))
        row[f"mean_error_max_{x:g}"] = float(error.max())
        for name, share in (("min", 0.0), ("p50", 0.5), ("p99", 0.99)):
            row[f"sigma_ratio_{name}_{x:g}"] = float(np.quantile(ratio[np.isfinite(ratio)], share))
    worst = []
    for rank, i in enumerate(np.argsort(-kl)[:2], 1):
        case = {"set": set_, "code": code, "rank": rank, "kl": float(kl[i])}
        case["status"] = Status(int(batch.status[i])).name
        for side, m, S in (("", mean[i], cov[i]), ("decoded_", batch.mean[i], batch.cov[i])):
            case |= {f"{side}mean_{a}": m[a] for a in range(4)}
            case |= {f"{side}cov_{a}{b}": S[a, b] for a in range(4) for b in range(4)}
        worst.append(case)
    return row, worst


def scenes_row(lines: int, code: str) -> Any:
    """Return a code's row of the table of scenes."""
    row = {"lines": lines, "code": code, "scenes": 40, "has_joint": code != "Cholesky"}
    row |= {"frames": 4.0 * lines, "mean_bits": 77.0 * lines, "joint_bits": 105.0 * lines}
    row |= {"limit_bits": 29.5, "over_bits": 105.0 * lines - 29.5, "all_entries": 0.25}
    row |= {
        "left_out": 0.0,
        "not_positive_definite": 0.0,
        "overconfident": float(code == "Cholesky"),
    }
    row |= {"kl_line_mean": 0.0019, "kl_line_p99": 0.0038, "kl_joint_mean": math.nan}
    ratios = ("far_p50", "far_p99", "width_p50", "width_p99", "centre_p50", "centre_p99")
    return row | dict.fromkeys(ratios, 1.02)


def sweep_rows() -> Any:
    """Return the tables of a sweep of three codes over two sets."""
    made = {
        "summary": list[Any](),
        "fields": list[Any](),
        "worst": list[Any](),
        "limit": list[Any](),
        "scenes": [scenes_row(lines, code) for lines in (4, 8) for code in SCENE_CODES],
    }
    for seed, set_ in enumerate(SETS):
        mean, cov = paper(N, seed)
        for code in USED:
            for finer_bits in (0, 1) if code != "MeanOnly" else (0,):
                row, worst = rows_of(set_, code, finer_bits, mean, cov)
                made["summary"].append(row)
                made["worst"] += worst if finer_bits == 0 else []
        for field, cost in (("PivotC0", 1.3), ("RatioC0C1", 2.5), ("Inflation", 1.1)):
            for delta, kl in ((-1, 0.003 * cost), (1, 0.003 / cost)):
                field_row = {"set": set_, "code": "Cholesky", "field": field, "delta_bits": delta}
                field_row |= {"covariance_bits": 105 + delta, "kl_mean": kl, "kl_mean_se": 1e-5}
                made["fields"].append(field_row | {"saturated": 0.0, "lateral_rms_80": 6e-4})
        for part, n, bits in (("all", 14, 62.0), ("covariance", 10, 34.0)):
            for decades, kl in enumerate((1e-2, 1e-3, 1e-4)):
                point = {"set": set_, "part": part, "kl": kl, "entropy_bits": 20.0, "se_bits": 0.5}
                rise = decades * n / 2 * math.log2(10)
                made["limit"].append(point | {"bias_bits": 2.0, "bits": bits + rise})
    return made


def write(folder: Any, rows: Any, **changes: Any) -> Any:
    folder.mkdir(exist_ok=True)
    for name, of_table in (rows | changes).items():
        whole = [dict.fromkeys(SCHEMAS[name]) | row for row in of_table]
        pq.write_table(pa.Table.from_pylist(whole), folder / f"{name}.parquet")
    return folder
