"""The numbers of the report as tables of text."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from ..metrics import LATERAL_X
from .tables import SUMMARY, Row, Tables, number, percent, share, with_error

__all__ = [
    "NumberTable",
    "along_table",
    "fields_table",
    "kl_table",
    "limit_table",
    "share_table",
    "worst_table",
]


class NumberTable(NamedTuple):
    """A table of text cells with its title."""

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]


def kl_table(tables: Tables, set_: str) -> NumberTable:
    """Return all codes at all widths."""
    heads = ["code", "finer by", "bits of the covariance", "of the record", "classic frames"]
    heads += [*SUMMARY.values(), "bits above the limit", "not definite", "Gaussians per second"]
    names = ("covariance_bits", "record_bits", "classic_frames")
    rows = [
        [
            *(code, f"{row['finer_bits']:+d}", *(f"{row[name]}" for name in names)),
            *(with_error(row[key], row.get(f"{key}_se", math.nan)) for key in SUMMARY),
            tables.over_text(row),
            share(row["not_positive_definite"], row["not_positive_definite_se"], row["n"]),
            number(row["gaussians_per_second"]),
        ]
        for code in tables.codes
        for row in tables.of(set_, code)
    ]
    return NumberTable("The numbers", heads, rows)


def limit_table(tables: Tables, set_: str) -> NumberTable:
    """Return the rate-distortion limit of a set."""
    rows = [
        [
            "mean and covariance" if row["part"] == "all" else row["part"],
            number(row["kl"]),
            with_error(row["bits"], row["se_bits"]),
            number(row["bias_bits"]),
            number(row["entropy_bits"]),
            str(row.get("caveat") or "").replace("nan", ""),
        ]
        for row in tables.limit
        if row["set"] == set_
    ]
    heads = ["limit of", "KL", "bits", "too high by about", "entropy [bit]", "caveat"]
    return NumberTable("The limit", heads, rows)


def along_table(tables: Tables, set_: str) -> NumberTable:
    """Return mean errors and sigma ratios along x."""
    figures = (
        ("mean_error", ("rms", "max"), 1e3, 3, "error at {:g} m, rms / largest [mm]"),
        (
            "sigma_ratio",
            ("min", "p50", "p99"),
            1,
            4,
            "sigma ratio at {:g} m, least / median / 99 %",
        ),
    )
    heads = ["code", *(head.format(x) for *_, head in figures for x in LATERAL_X)]
    rows = [
        [
            row["code"],
            *(
                " / ".join(number(factor * row[f"{name}_{kind}_{x:g}"], digits) for kind in kinds)
                for name, kinds, factor, digits, _ in figures
                for x in LATERAL_X
            ),
        ]
        for row in tables.shipped_of(set_)
    ]
    return NumberTable("The numbers", heads, rows)


def share_table(
    tables: Tables, set_: str, quantities: Sequence[tuple[str, str, str]]
) -> NumberTable:
    """Return shares of Gaussians; ``quantities`` as in ``plots.share_plot``."""
    guarantees = [(words, column) for _, words, column in quantities if column]
    heads = ["code", "of", *(words for _, words, _ in quantities)]
    heads += [f"guaranteed never {words}" for words, _ in guarantees]
    rows = [
        [
            row["code"],
            f"{row['n']:,}",
            *(share(row[column], row[f"{column}_se"], row["n"]) for column, _, _ in quantities),
            *("yes" if row[column] else "no" for _, column in guarantees),
        ]
        for row in tables.shipped_of(set_)
    ]
    return NumberTable("The numbers", heads, rows)


def fields_table(tables: Tables, set_: str) -> NumberTable:
    """Return the effect of one bit in each field."""
    heads = ["code", "field", "bits", "bits of the covariance", SUMMARY["kl_mean"], "saturated"]
    rows = [
        [
            *(row["code"], row["field"], f"{row['delta_bits']:+d}", f"{row['covariance_bits']}"),
            with_error(row["kl_mean"], row["kl_mean_se"]),
            percent(row["saturated"]),
            number(1e3 * row["lateral_rms_80"]),
        ]
        for row in tables.fields
        if row["set"] == set_
    ]
    return NumberTable("The numbers", [*heads, "error at 80 m, rms [mm]"], rows)


def worst_table(tables: Tables, set_: str) -> NumberTable:
    """Return the lines with the largest KL."""

    def mean(row: Row, side: str) -> str:
        return ", ".join(number(row[f"{side}mean_{i}"], 4) for i in range(4))

    of = "mean (y_off [m], beta [rad], c0 [1/m], c1 [1/m^2])"
    rows = [
        [
            *(row["code"], f"{row['rank']}", number(row["kl"]), str(row["status"])),
            *(mean(row, side) for side in ("", "decoded_")),
        ]
        for row in tables.worst
        if row["set"] == set_
    ]
    heads = ["code", "rank", "KL", "status", f"true {of}", f"decoded {of}"]
    return NumberTable("The numbers", heads, rows)
