"""Plots of all codes at once: KL against bits, errors along the road, shares."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from bokeh.models import ColumnDataSource, Range1d
from bokeh.models.annotations import BoxAnnotation
from bokeh.plotting import figure

from ..metrics import LATERAL_X
from .parts import (
    BLUE,
    VERMILLION,
    Look,
    blank,
    decades,
    draw_code,
    draw_rule,
    log10,
    set_options,
    set_ticks,
    tell,
)
from .tables import LARGEST_KL, SUMMARY, Row, Tables, number, share, with_error

__all__ = ["kl_plot", "lateral_error_plot", "share_plot", "sigma_ratio_plot"]

Looks = Mapping[str, Look]

#: What of the decimal logarithm of the KL is drawn; beyond it marks stand at the edge.
KL_LOW, KL_HIGH = -8.0, 3.0
#: Legible on light and on dark pages.
LIMIT = "#808080"
#: Where the text of a mark stands: above, below, to the right.
ASIDE: tuple[dict[str, Any], ...] = (
    {"angle": math.pi / 2, "x_offset": 5, "y_offset": -8},
    {"angle": math.pi / 2, "x_offset": 5, "y_offset": 8, "text_align": "right"},
    {"x_offset": 8, "text_baseline": "middle"},
)
#: Share of the Gaussians without a KL up to which a mark is full.
LEFT_OUT = 0.01
#: Ratios of sigmas that are marked on the axis, and the largest that has a place on it.
RATIOS = (0.5, 0.9, 0.98, 1, 1.02, 1.1, 1.5, 3, 10, 30)
LARGEST_RATIO = 30.0
#: Name of the one curve of codes that all give the same: the mean travels alike in all of them.
ALL_CODES = "all codes alike"


def kl_plot(tables: Tables, set_: str, looks: Looks) -> figure:
    """KL against the bits of the covariance: a curve for each code, and the limit.

    Hollow is a mark whose KL leaves out Gaussians, or is beyond the axis; beside the code as it is
    stands the share of the matrices that are not definite. Above the axis each code that gives
    infinities has a row of its own.
    """
    seen = [row[key] for row in tables.summary for key in SUMMARY]
    logs = [math.log10(kl) for kl in seen if math.isfinite(kl) and kl > 0] or [-2.0]
    low = max(KL_LOW, math.floor(min(logs)))
    high = min(KL_HIGH, max(low + 1, math.ceil(max(logs))))
    endless = {row["code"] for row in tables.summary for key in SUMMARY if _endless(row, key)}
    pixel = (high - low + 0.6) / 330  #: one of the screen, in decades
    shelves = {
        code: high + 0.3 + (14 + 44 * i) * pixel
        for i, code in enumerate(code for code in looks if code in endless)
    }
    top = high + 0.3 + 44 * len(shelves) * pixel
    words = {key: f"{text} [nat]" for key, text in SUMMARY.items()}
    plot = blank("bits of the covariance", words["kl_mean"], 400 + 44 * len(shelves))
    plot.y_range = Range1d(start=low - 0.3, end=top)
    set_ticks(plot.yaxis[0], decades(low, high) | dict.fromkeys(shelves.values(), "∞"))
    set_options(plot.yaxis[0], "kl", {key: {"axis_label": text} for key, text in words.items()})
    most = max(row["covariance_bits"] for row in tables.summary)
    plot.x_range = Range1d(start=-0.04 * most - 1, end=1.06 * most + 1)
    _draw_limit(plot, tables, set_, low)
    bad = {row["code"] for row in tables.summary if row["not_positive_definite"] > 0}
    beside = sorted(looks, key=lambda code: code not in bad)  # first those that have texts
    for code, look in looks.items():
        rows = tables.of(set_, code)
        if not rows:
            continue
        edges = low, high, shelves.get(code, top)
        views = {key: {"data": _kl_view(tables, rows, key, *edges)} for key in SUMMARY}
        source = ColumnDataSource(views["kl_mean"]["data"])
        set_options(source, "kl", views)
        dots = draw_code(plot, source, code, look)
        shares = plot.text(
            "x",
            "y",
            text="mark",
            source=source,
            text_font_size="10px",
            text_color=look.colour,
            **ASIDE[0 if code in endless else beside.index(code) % len(ASIDE)],
        )
        shares.tags = [f"code:{code}"]
        tell(
            plot,
            dots,
            ("code", "@code, fields finer by @finer bits"),
            ("bits", "@x, a record of @record bits in @frames frames"),
            ("KL", "@text nat"),
            ("over the limit", "@over bits"),
            ("not definite", "@bad"),
            ("out of range", "@out"),
        )
    return plot


def _kl_view(
    tables: Tables, rows: Sequence[Row], key: str, low: float, high: float, endless: float
) -> dict[str, list[Any]]:
    """Columns of one code for one quantity; what is not finite stands at ``endless``."""

    def place(kl: float) -> float:
        return min(high + 0.2, log10(kl, low))

    points = []
    shipped = tables.shipped(rows[0]["set"], rows[0]["code"])
    for row in rows:
        kl, error = row[key], 2 * row.get(f"{key}_se", math.nan)
        error = error if math.isfinite(error + kl) else 0.0
        lost = row["not_positive_definite"], row["out_of_range"]
        ends = place(max(kl - error, kl / 100)), place(kl), place(kl + error)
        if _endless(row, key):
            ends = (endless,) * 3
        whole = low <= ends[1] <= high and sum(lost) <= LEFT_OUT
        told = lost[0] > 0 and (row is shipped or _endless(row, key))
        points.append(
            {
                "x": row["covariance_bits"],
                "path": math.nan if _endless(row, key) else ends[1],
                **dict(zip(("low", "y", "high"), ends, strict=True)),
                "fill": 1.0 if whole else 0.0,
                "code": row["code"],
                "finer": f"{row['finer_bits']:+d}",
                "record": row["record_bits"],
                "frames": row["classic_frames"],
                "text": with_error(kl, error / 2),
                "over": tables.over_text(row) if key == "kl_mean" else "-",
                "bad": share(lost[0], row["not_positive_definite_se"], row["n"]),
                "out": share(lost[1], row["out_of_range_se"], row["n"]),
                "mark": f"{number(100 * lost[0])} %" if told else "",
            }
        )
    return {key: [point[key] for point in points] for key in points[0]}


def _endless(row: Row, key: str) -> bool:
    """A KL that is infinite, or is that of no Gaussian at all, since none is definite."""
    nothing = row["not_positive_definite"] + row["out_of_range"] >= 1
    return math.isinf(row[key]) or (math.isnan(row[key]) and nothing)


def _draw_limit(plot: figure, tables: Tables, set_: str, low: float) -> None:
    """The rate-distortion limit, dots where it was computed with their sampling error, its bias."""
    rows = tables.limit_of(set_)
    if len(rows) < 2:
        return
    ends = [10.0**low, *(row["kl"] for row in rows), LARGEST_KL]
    bits = [tables.limit_bits(set_, kl) or 0.0 for kl in ends]
    y = [math.log10(kl) for kl in ends]
    bias = max(0.0, *(row["bias_bits"] for row in rows))
    plot.harea(x1=[max(0.0, b - bias) for b in bits], x2=bits, y=y, alpha=0.25, color=LIMIT)
    plot.line(bits, y, color=LIMIT, line_width=3)
    source = ColumnDataSource(
        {
            "x": [row["bits"] for row in rows],
            "y": [math.log10(row["kl"]) for row in rows],
            "low": [row["bits"] - 2 * row["se_bits"] for row in rows],
            "high": [row["bits"] + 2 * row["se_bits"] for row in rows],
            "text": [
                f"{with_error(row['bits'], row['se_bits'])} bits, "
                f"too high by about {number(row['bias_bits'], 2)}"
                for row in rows
            ],
            "kl": [number(row["kl"]) for row in rows],
        }
    )
    plot.segment("low", "y", "high", "y", source=source, color=LIMIT, line_width=6, alpha=0.4)
    dots = plot.scatter("x", "y", source=source, marker="diamond", size=10, color=LIMIT)
    # Above the middle of its line, where no code can be.
    plot.text(
        [bits[1]],
        [math.log10(ends[1])],
        ["limit"],
        x_offset=-8,
        text_align="right",
        text_baseline="middle",
        text_font_size="13px",
        text_color=LIMIT,
    )
    tell(plot, dots, ("limit", "@text"), ("KL", "@kl nat"))


def lateral_error_plot(tables: Tables, set_: str, looks: Looks) -> figure:
    """Error of the decoded mean line along x: rms, and a whisker to the largest."""
    rows = [tables.shipped(name, code) or {} for name in tables.sets for code in looks]
    kinds = [f"mean_error_{kind}_{x:g}" for kind in ("rms", "max") for x in LATERAL_X]
    seen = [1e3 * row[kind] for row in rows if row for kind in kinds]
    logs = [math.log10(mm) for mm in seen if math.isfinite(mm) and mm > 0] or [0.0]
    low, high = max(-3.0, min(logs) - 0.2), max(logs) + 0.2
    plot = blank("x, ahead [m]", "error of the mean line [mm]", 300)
    plot.y_range = Range1d(start=low - 0.1, end=high)
    set_ticks(plot.yaxis[0], decades(low - 0.1, high))
    if all(_alike([row[kind] for row in rows if row and row["set"] == set_]) for kind in kinds):
        looks = {ALL_CODES: Look(BLUE, "circle", "solid")}

    def view(row: Row, x: float) -> dict[str, Any]:
        rms, most = (1e3 * row[f"mean_error_{kind}_{x:g}"] for kind in ("rms", "max"))
        return {
            "y": log10(rms, low),
            "low": log10(rms, low),
            "high": log10(most, low),
            "text": f"rms {number(rms)} mm, largest {number(most)} mm",
        }

    return _along_x(plot, tables, set_, looks, view)


def _alike(values: Sequence[float]) -> bool:
    """Whether they differ by less than one percent."""
    return max(values) <= 1.01 * min(values)


def sigma_ratio_plot(tables: Tables, set_: str, looks: Looks) -> figure:
    """Decoded over true sigma of l(x) along x: median, whiskers from least to 99 %."""
    rows = [tables.shipped(name, code) or {} for name in tables.sets for code in looks]
    seen = [row[f"sigma_ratio_p99_{x:g}"] for row in rows if row for x in LATERAL_X]
    most = min(LARGEST_RATIO, max([2.0, *(ratio for ratio in seen if math.isfinite(ratio))]))
    more = _stretched(most) + 1.0  #: where a ratio stands that is larger
    none = _stretched(0) - 1.0  #: where a ratio stands that is no number: a negative variance
    plot = blank("x, ahead [m]", "decoded over true sigma of l(x)")
    plot.y_range = Range1d(start=none - 0.5, end=more + 0.6)
    marks = {_stretched(ratio): f"{ratio:g}" for ratio in RATIOS if ratio <= most}
    set_ticks(plot.yaxis[0], {none: "none", more: "more"} | marks)
    plot.add_layout(BoxAnnotation(top=0, fill_color=VERMILLION, fill_alpha=0.09, line_color=None))
    draw_rule(plot, 0, "width")

    def view(row: Row, x: float) -> dict[str, Any]:
        ratios = [row[f"sigma_ratio_{kind}_{x:g}"] for kind in ("min", "p50", "p99")]
        places = [
            none if math.isnan(ratio) else more if ratio > most else _stretched(ratio)
            for ratio in ratios
        ]
        text = "least {}, median {}, 99 % {}".format(*(number(ratio, 4) for ratio in ratios))
        fill = 0.0 if places[1] in (none, more) else 1.0
        return dict(zip(("low", "y", "high"), places, strict=True)) | {"text": text, "fill": fill}

    return _along_x(plot, tables, set_, looks, view)


def _stretched(ratio: float) -> float:
    """Place of a ratio: straight within one percent of 1, logarithmic beyond, on both sides."""
    return math.asinh((ratio - 1) / 0.01)


def _along_x(
    plot: figure,
    tables: Tables,
    set_: str,
    looks: Looks,
    view: Callable[[Row, float], dict[str, Any]],
) -> figure:
    """A curve over LATERAL_X for each code, side by side where one would hide another."""
    plot.x_range = Range1d(start=LATERAL_X[0] - 8, end=LATERAL_X[-1] + 8)
    set_ticks(plot.xaxis[0], {x: f"{x:g}" for x in LATERAL_X})
    for i, (code, look) in enumerate(looks.items()):
        row = tables.shipped(set_, tables.codes[0] if code == ALL_CODES else code)
        if row is None:
            continue
        aside = (i - (len(looks) - 1) / 2) * 10 / len(looks)
        points = [
            {"x": x + aside, "at": f"{x:g}", "code": code, "fill": 1.0} | view(row, x)
            for x in LATERAL_X
        ]
        source = ColumnDataSource({key: [point[key] for point in points] for key in points[0]})
        dots = draw_code(plot, source, code, look)
        tell(plot, dots, ("code", "@code"), ("x", "@at m"), ("there", "@text"))
    return plot


def share_plot(
    tables: Tables, set_: str, looks: Looks, quantities: Sequence[tuple[str, str, str]]
) -> figure:
    """Two shares for each code, with twice their standard error.

    A mark at 0 is full where the code guarantees it. Elsewhere it is hollow, and its whisker
    ends at 3 / n: the largest share of which n draws show none in 5 % of the cases.

    Args:
        tables: of the sweep.
        set_: which set.
        looks: of the codes.
        quantities: column, words, and the column that says whether it is guaranteed, or "".
    """
    rows = {code: row for code in looks if (row := tables.shipped(set_, code))}
    floor = math.floor(min(math.log10(1 / max(row["n"], 10)) for row in tables.summary))
    zero = floor - 0.7
    height = 100 + 30 * max(len(looks), 3)
    plot = blank("share of the Gaussians", "", height, list(looks)[::-1])
    plot.x_range = Range1d(start=zero - 0.3, end=0.25)
    percents = {float(e): f"{10.0 ** (e + 2):g} %" for e in range(floor, 1)}
    set_ticks(plot.xaxis[0], {zero: "0"} | percents)
    draw_rule(plot, zero, "height")
    marks = zip(quantities, (VERMILLION, BLUE), ("square", "circle"), (0.16, -0.16), strict=True)
    for (column, words, guarantee), colour, marker, up in marks:
        points = []
        for code, row in rows.items():
            value, error, n = row[column], row[f"{column}_se"], row["n"]
            promised = bool(guarantee and row[guarantee])
            far = value + 2 * error if value > 0 else 0.0 if promised else 3 / n
            points.append(
                {
                    "code": code,
                    "y": (code, up),
                    "x": log10(value, zero),
                    "high": min(0.0, log10(far, zero)),
                    "fill": 1.0 if value > 0 or promised else 0.0,
                    "text": f"{share(value, error, n)} of {n:,}"
                    + (", guaranteed to be none" if promised else ""),
                }
            )
        source = ColumnDataSource({key: [point[key] for point in points] for key in points[0]})
        plot.segment("x", "y", "high", "y", source=source, color=colour, line_width=2)
        dots = plot.scatter(
            "x",
            "y",
            source=source,
            marker=marker,
            size=10,
            color=colour,
            fill_alpha="fill",
            line_width=2,
        )
        tell(plot, dots, ("code", "@code"), (words, "@text"))
    return plot
