"""The sections of the report: how to read each plot, its controls, and its numbers as text."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from bokeh.plotting import figure

from ..metrics import LATERAL_X
from .cases import BAND, fields_plot, worst_key, worst_plots
from .parts import looks
from .plots import kl_plot, lateral_error_plot, share_plot, sigma_ratio_plot
from .tables import SUMMARY, Row, Tables, number, share, with_error
from .text import marks_key, select, sides_key, table

__all__ = ["Section", "sections"]

#: Pairs of shares: column, words, and the column that says whether it is guaranteed to be none.
NOT_DEFINITE = (
    ("not_positive_definite", "not positive definite", "definite_guarantee"),
    ("overconfident", "overconfident", "covering_guarantee"),
)
SATURATION = (("saturated", "saturated", ""), ("out_of_range", "out of range", ""))
ORDINALS = ("the worst", "the second", "the third", "the fourth", "the fifth")


@dataclass(frozen=True)
class Section:
    """A part of the page."""

    name: str
    heading: str
    reading: str  #: how to read it
    controls: str  #: HTML: what the marks mean, and what can be chosen
    of_set: Callable[[str], tuple[list[figure], str]] | None  #: plots and tables; None: no data


def sections(tables: Tables) -> list[Section]:
    """All sections, in the order of the page."""
    look = looks(tables.codes)
    return [
        Section(
            "kl",
            "KL against bits",
            "Down and to the left is better: less is lost with fewer bits. Each mark is a width of "
            "the fields, its whisker two standard errors. The heavy line is the rate-distortion "
            "limit of the set; its shade is where the limit may truly be, as its estimate tends "
            "to be too high. A hollow mark leaves out more than 1 % of the Gaussians, which have "
            "no KL: they are not definite (the share stands beside the code as it is) or out of "
            "range. On the edge of the plot a mark lies beyond it; one at ∞ has nothing left.",
            select("kl", "Show", {"": list(SUMMARY.items())}),
            lambda set_: ([kl_plot(tables, set_, look)], _kl_table(tables, set_)),
        ),
        Section(
            "along",
            "Error and sigma along the road",
            "First the error of the decoded mean line: marks are its rms, whiskers end at the "
            "largest. Then the decoded over the true standard deviation of l(x): marks are the "
            "median, whiskers go from the least to 99 %. In the tinted half the decoded band is "
            "too narrow. A hollow mark is larger than the axis; “none” is where no "
            "decoded covariance has a sigma. All at the widths of the codes' DBCs.",
            "",
            lambda set_: (
                [lateral_error_plot(tables, set_, look), sigma_ratio_plot(tables, set_, look)],
                _along_table(tables, set_),
            ),
        ),
        Section(
            "definite",
            "Not definite, overconfident",
            "Both must be 0: a matrix that is not positive definite is no covariance, and an "
            "overconfident one claims to know more than it does. A full mark at 0 is guaranteed "
            "by the code's construction; a hollow one was only not seen, and its true share may "
            "reach to the end of the whisker.",
            marks_key("not positive definite", "overconfident"),
            lambda set_: (
                [share_plot(tables, set_, look, NOT_DEFINITE)],
                _share_table(tables, set_, NOT_DEFINITE),
            ),
        ),
        _fields_section(tables),
        Section(
            "saturation",
            "Saturation",
            "How often a value met the end of its range, so that the line went out wider than "
            "need be or was cut, and how often it did not fit the message at all.",
            marks_key("saturated", "out of range"),
            lambda set_: (
                [share_plot(tables, set_, look, SATURATION)],
                _share_table(tables, set_, SATURATION),
            ),
        ),
        _worst_section(tables),
    ]


def _fields_section(tables: Tables) -> Section:
    codes = [code for code in tables.codes if any(row["code"] == code for row in tables.fields)]
    return Section(
        "fields",
        "Where the bits go",
        "Each field of a code with one bit less and with one bit more; the dashed line is the code "
        "as it is, the thick bars are two standard errors. A field that stretches far to the right "
        "needs its bits; one that does not could give one away. More bits of the mean may cost: "
        "what is to be covered holds the mean's own steps, and is thinner without them.",
        marks_key("one bit less", "one bit more", "triangle")
        + select("fields", "Code", {"": [(code, code) for code in codes]}),
        (lambda set_: ([fields_plot(tables, set_, codes)], _fields_table(tables, set_)))
        if codes
        else None,
    )


def _worst_section(tables: Tables) -> Section:
    cases: dict[str, dict[str, str]] = {code: {} for code in tables.codes}
    for row in sorted(tables.worst, key=lambda row: row["rank"]):
        of_code = cases.setdefault(row["code"], {})
        place = len(of_code)
        words = ORDINALS[place] if place < len(ORDINALS) else f"number {place + 1}"
        of_code.setdefault(worst_key(row), f"{row['code']}, {words}")
    keys = [key for of_code in cases.values() for key in of_code]

    def of_set(set_: str) -> tuple[list[figure], str]:
        return [*worst_plots(tables, set_, keys)], _worst_table(tables, set_)

    return Section(
        "worst",
        "Worst cases",
        f"The lines with the largest KL as the car sees them, with bands of ± {BAND:g} sigma of "
        "l(x) to first order; then the same less the true mean line. Crosses: the decoded "
        "variance is negative there, and there is no band.",
        sides_key()
        + select(
            "worst", "Case", {code: list(named.items()) for code, named in cases.items() if named}
        ),
        of_set if keys else None,
    )


# ---- the numbers ------------------------------------------------------------------


def _kl_table(tables: Tables, set_: str) -> str:
    rows = [
        [
            code,
            f"{row['finer_bits']:+d}",
            f"{row['covariance_bits']}",
            f"{row['record_bits']}",
            f"{row['classic_frames']}",
            *(with_error(row[key], row.get(f"{key}_se", math.nan)) for key in SUMMARY),
            tables.over_text(row),
            share(row["not_positive_definite"], row["not_positive_definite_se"], row["n"]),
            number(row["gaussians_per_second"]),
        ]
        for code in tables.codes
        for row in tables.of(set_, code)
    ]
    heads = ["code", "finer by", "bits of the covariance", "of the record", "classic frames"]
    heads += [*SUMMARY.values(), "bits over the limit", "not definite", "Gaussians per second"]
    limit = [
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
    of = ["limit of", "KL", "bits", "too high by about", "entropy [bit]", "caveat"]
    return table(heads, rows) + table(of, limit, "The limit")


def _along_table(tables: Tables, set_: str) -> str:
    def texts(row: Row, name: str, kinds: Sequence[str], factor: float, digits: int) -> list[str]:
        return [
            " / ".join(number(factor * row[f"{name}_{kind}_{x:g}"], digits) for kind in kinds)
            for x in LATERAL_X
        ]

    rows = [
        [
            row["code"],
            *texts(row, "mean_error", ("rms", "max"), 1e3, 3),
            *texts(row, "sigma_ratio", ("min", "p50", "p99"), 1, 4),
        ]
        for row in tables.shipped_of(set_)
    ]
    errors = [f"error at {x:g} m, rms / largest [mm]" for x in LATERAL_X]
    ratios = [f"sigma ratio at {x:g} m, least / median / 99 %" for x in LATERAL_X]
    return table(["code", *errors, *ratios], rows)


def _share_table(tables: Tables, set_: str, quantities: Sequence[tuple[str, str, str]]) -> str:
    promises = [(words, promise) for _, words, promise in quantities if promise]
    rows = [
        [
            row["code"],
            f"{row['n']:,}",
            *(share(row[column], row[f"{column}_se"], row["n"]) for column, _, _ in quantities),
            *("yes" if row[promise] else "no" for _, promise in promises),
        ]
        for row in tables.shipped_of(set_)
    ]
    heads = ["code", "of", *(words for _, words, _ in quantities)]
    return table([*heads, *(f"guaranteed never {words}" for words, _ in promises)], rows)


def _fields_table(tables: Tables, set_: str) -> str:
    rows = [
        [
            row["code"],
            row["field"],
            f"{row['delta_bits']:+d}",
            f"{row['covariance_bits']}",
            with_error(row["kl_mean"], row["kl_mean_se"]),
            f"{number(100 * row['saturated'])} %",
            number(1e3 * row["lateral_rms_80"]),
        ]
        for row in tables.fields
        if row["set"] == set_
    ]
    heads = ["code", "field", "bits", "bits of the covariance", SUMMARY["kl_mean"], "saturated"]
    return table([*heads, "error at 80 m, rms [mm]"], rows)


def _worst_table(tables: Tables, set_: str) -> str:
    def mean(row: Row, side: str) -> str:
        return ", ".join(number(row[f"{side}mean_{i}"], 4) for i in range(4))

    rows = [
        [
            row["code"],
            f"{row['rank']}",
            number(row["kl"]),
            str(row["status"]),
            mean(row, ""),
            mean(row, "decoded_"),
        ]
        for row in tables.worst
        if row["set"] == set_
    ]
    of = "mean (y_off [m], beta [rad], c0 [1/m], c1 [1/m^2])"
    return table(["code", "rank", "KL", "status", f"true {of}", f"decoded {of}"], rows)
