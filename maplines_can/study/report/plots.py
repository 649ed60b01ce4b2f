"""Plots of the report: of all codes together, and of one code at a time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, FactorRange, Range1d
from bokeh.models.annotations import BoxAnnotation
from bokeh.plotting import figure
from numpy.typing import NDArray

from ...values.coding_loss import LATERAL_X
from ...values.line import Status, lateral, lateral_jacobian
from ..sweep.summary import Row
from .drawing import (
    BLUE,
    INK,
    VERMILLION,
    Look,
    add_hover,
    clip,
    columns,
    draw_code,
    draw_rule,
    new_plot,
    set_options,
    set_ticks,
    ticks,
)
from .results import MAX_KL, SUMMARY, Tables, number, percent, share, with_error

Array = NDArray[np.float64]

Looks = Mapping[str, Look]

#: Range of the decimal logarithm of the KL; marks outside it are drawn at the edge.
KL_LOW, KL_HIGH = -8, 3
#: Legible on light and on dark pages.
LIMIT = "#808080"
#: The KL that is shown until the reader chooses another one.
FIRST = next(iter(SUMMARY))
#: Place of the text above a mark.
ABOVE: dict[str, Any] = {"angle": math.pi / 2, "x_offset": 5, "y_offset": -8}
#: Largest share of Gaussians without a KL for which a mark is filled.
LEFT_OUT = 0.01
#: Ratios of sigmas that are marked on the axis, and the largest one on it.
RATIOS = (0.5, 0.9, 0.98, 1, 1.02, 1.1, 1.5, 3, 10, 30)
MAX_RATIO = 30.0
#: Name of the only curve if all codes give the same: they share the mean.
ALL_CODES = "all codes"


def kl_plot(tables: Tables, set_: str, looks: Looks) -> figure:
    """Plot the KL against the bits of the covariance: a curve for each code, and the limit.

    The median is shown first, with a whisker to the 99 % quantile. A mark is hollow if its KL
    leaves out Gaussians or is beyond the axis. Each code with an infinite KL has a row of its own
    above the axis, with the shares of matrices that are not positive definite.
    """
    seen = [row[key] for row in tables.summary for key in SUMMARY]
    logs = [math.log10(kl) for kl in seen if 0 < kl < math.inf] or [-2.0]
    low = max(KL_LOW, math.floor(min(logs)))
    high = min(KL_HIGH, max(low + 1, math.ceil(max(logs))))
    endless = {row["code"] for row in tables.summary for key in SUMMARY if _endless(row, key)}
    pixel = (high - low + 0.6) / 330  #: height of a pixel, in decades
    shelves = {
        code: 10.0 ** (high + 0.3 + (14 + 44 * i) * pixel)
        for i, code in enumerate(code for code in looks if code in endless)
    }
    top = 10.0 ** (high + 0.3 + 44 * len(shelves) * pixel)
    words = {key: f"{text} [nat]" for key, text in SUMMARY.items()}
    most = max(row["covariance_bits"] for row in tables.summary)
    plot = new_plot(
        "bits of the covariance",
        words[FIRST],
        400 + 44 * len(shelves),
        y_axis_type="log",
        y_range=Range1d(start=10.0 ** (low - 0.3), end=top),
        x_range=Range1d(start=-0.04 * most - 1, end=1.06 * most + 1),
    )
    set_ticks(plot.yaxis[0], ticks(low, high) | dict.fromkeys(shelves.values(), "∞"))
    set_options(plot.yaxis[0], "kl", {key: {"axis_label": text} for key, text in words.items()})
    _draw_limit(plot, tables, set_, 10.0**low)
    for code, look in looks.items():
        rows = tables.of(set_, code)
        if not rows:
            continue
        edges = 10.0**low, 10.0**high, shelves.get(code, top)
        views = {key: {"data": _kl_view(tables, rows, key, *edges)} for key in SUMMARY}
        source = ColumnDataSource(views[FIRST]["data"])
        set_options(source, "kl", views)
        dots = draw_code(plot, source, code, look)
        if code in endless:  # texts beside other marks would hide one another
            style = ABOVE | {"text_font_size": "10px", "text_color": look.colour}
            shares = plot.text("x", "y", text="mark", source=source, **style)
            shares.tags = [f"code:{code}"]
        add_hover(
            plot,
            dots,
            ("code", "@code, fields finer by @finer bits"),
            ("bits", "@x, a record of @record bits in @frames frames"),
            ("KL", "@text nat"),
            ("above the limit", "@over bits"),
            ("not definite", "@bad"),
            ("out of range", "@out"),
        )
    return plot


def _kl_view(
    tables: Tables, rows: Sequence[Row], key: str, low: float, high: float, endless: float
) -> dict[str, list[Any]]:
    """Return the columns of one code for one KL; a KL that is not finite is at ``endless``."""
    points = []
    for row in rows:
        kl, error = row[key], 2 * row.get(f"{key}_se", math.nan)
        error = error if math.isfinite(error + kl) else 0.0
        far = row["kl_p99"] if key == "kl_p50" and row["kl_p99"] >= kl else kl + error
        lost = row["not_positive_definite"], row["out_of_range"]
        ends = [clip(y, low, 1.6 * high) for y in (max(kl - error, kl / 100), kl, far)]
        if _endless(row, key):
            ends = [endless] * 3
        whole = ends[1] <= high and sum(lost) <= LEFT_OUT
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
                "over": tables.over_text(row),
                "bad": share(lost[0], row["not_positive_definite_se"], row["n"]),
                "out": share(lost[1], row["out_of_range_se"], row["n"]),
                "mark": percent(lost[0]) if lost[0] > 0 and _endless(row, key) else "",
            }
        )
    return columns(points)


def _endless(row: Row, key: str) -> bool:
    """Return whether a KL is infinite, or is not defined since no Gaussian is left."""
    nothing = row["not_positive_definite"] + row["out_of_range"] >= 1
    return math.isinf(row[key]) or (math.isnan(row[key]) and nothing)


def _draw_limit(plot: figure, tables: Tables, set_: str, low: float) -> None:
    """Draw the rate-distortion limit: computed points, their standard error, and the bias."""
    rows = tables.limit_of(set_)
    if len(rows) < 2:
        return
    kl = [low, *(row["kl"] for row in rows), MAX_KL]
    bits = [tables.limit_bits(set_, each) or 0.0 for each in kl]
    bias = max(0.0, *(row["bias_bits"] for row in rows))
    plot.harea(x1=[max(0.0, b - bias) for b in bits], x2=bits, y=kl, alpha=0.25, color=LIMIT)
    plot.line(bits, kl, color=LIMIT, line_width=3)
    points = [
        {
            "x": row["bits"],
            "y": row["kl"],
            "low": row["bits"] - 2 * row["se_bits"],
            "high": row["bits"] + 2 * row["se_bits"],
            "text": f"{with_error(row['bits'], row['se_bits'])} bits, "
            f"too high by about {number(row['bias_bits'], 2)}",
            "kl": number(row["kl"]),
        }
        for row in rows
    ]
    source = ColumnDataSource(columns(points))
    plot.segment("low", "y", "high", "y", source=source, color=LIMIT, line_width=6, alpha=0.4)
    dots = plot.scatter("x", "y", source=source, marker="diamond", size=10, color=LIMIT)
    # To the left of the line, where no code can be.
    style: dict[str, Any] = {"x_offset": -8, "text_align": "right", "text_baseline": "middle"}
    style |= {"text_font_size": "13px", "text_color": LIMIT}
    plot.text([bits[1]], [kl[1]], ["limit"], **style)
    add_hover(plot, dots, ("limit", "@text"), ("KL", "@kl nat"))


def lateral_error_plot(tables: Tables, set_: str, looks: Looks) -> figure:
    """Plot the error of the decoded mean line along x: rms, and a whisker to the largest."""
    kinds = [f"mean_error_{kind}_{x:g}" for kind in ("rms", "max") for x in LATERAL_X]
    shown = [row for name in tables.sets for row in tables.shipped_of(name)]
    seen = [mm for row in shown for kind in kinds if 0 < (mm := 1e3 * row[kind]) < math.inf]
    low, high = max(1e-3, 0.6 * min(seen, default=1.0)), 1.6 * max(seen, default=1.0)
    y_range = Range1d(start=0.8 * low, end=high)
    label = "error of the mean line [mm]"
    plot = new_plot("x, ahead [m]", label, 300, y_axis_type="log", y_range=y_range)
    values = [[row[kind] for row in tables.shipped_of(set_)] for kind in kinds]
    if all(max(each) <= 1.01 * min(each) for each in values):
        looks = {ALL_CODES: Look(BLUE, "circle", "solid")}

    def view(row: Row, x: float) -> dict[str, Any]:
        rms, most = (1e3 * row[f"mean_error_{kind}_{x:g}"] for kind in ("rms", "max"))
        y = clip(rms, low, math.inf)
        text = f"rms {number(rms)} mm, largest {number(most)} mm"
        return {"y": y, "low": y, "high": clip(most, low, math.inf), "text": text}

    return _along_x(plot, tables, set_, looks, view)


def sigma_ratio_plot(tables: Tables, set_: str, looks: Looks) -> figure:
    """Plot decoded over true sigma of l(x) along x: median, whiskers from least to 99 %."""
    shown = [row for name in tables.sets for row in tables.shipped_of(name)]
    seen = [row[f"sigma_ratio_p99_{x:g}"] for row in shown for x in LATERAL_X]
    most = min(MAX_RATIO, max([2.0, *(ratio for ratio in seen if math.isfinite(ratio))]))
    more = _stretched(most) + 1.0  #: place of a larger ratio
    none = _stretched(0) - 1.0  #: place of a ratio that does not exist: a variance is negative
    y_range = Range1d(start=none - 0.5, end=more + 0.6)
    plot = new_plot("x, ahead [m]", "decoded over true sigma of l(x)", 380, y_range=y_range)
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
    """Return the place of a ratio: linear within one percent of 1, logarithmic beyond."""
    return math.asinh((ratio - 1) / 0.01)


def _along_x(
    plot: figure,
    tables: Tables,
    set_: str,
    looks: Looks,
    view: Callable[[Row, float], dict[str, Any]],
) -> figure:
    """Draw a curve over LATERAL_X for each code, slightly shifted so that none hides another."""
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
        source = ColumnDataSource(columns([point | {"path": point["y"]} for point in points]))
        dots = draw_code(plot, source, code, look)
        add_hover(plot, dots, ("code", "@code"), ("x", "@at m"), ("ratio or error", "@text"))
    return plot


def share_plot(
    tables: Tables, set_: str, looks: Looks, quantities: Sequence[tuple[str, str, str]]
) -> figure:
    """Plot two shares for each code, with twice their standard error.

    A mark at 0 is filled if the code guarantees it. Otherwise it is hollow, and its whisker ends
    at 3 / n: the upper end of the 95 % confidence interval if n draws show none.

    Args:
        tables: of the sweep.
        set_: name of the set.
        looks: of the codes.
        quantities: column, words, and the column of the guarantee, or "".
    """
    floor = math.floor(min(math.log10(1 / max(row["n"], 10)) for row in tables.summary))
    zero = 10.0 ** (floor - 0.7)
    plot = new_plot(
        "share of the Gaussians",
        "",
        100 + 30 * max(len(looks), 3),
        x_axis_type="log",
        x_range=Range1d(start=zero / 2, end=1.8),
        y_range=FactorRange(factors=list(looks)[::-1]),
    )
    percents = {10.0**e: f"{10.0 ** (e + 2):g} %" for e in range(floor, 1)}
    set_ticks(plot.xaxis[0], {zero: "0"} | percents)
    draw_rule(plot, zero, "height")
    marks = zip(quantities, (VERMILLION, BLUE), ("square", "circle"), (0.16, -0.16), strict=True)
    for (column, words, guarantee), colour, marker, up in marks:
        points = []
        for row in tables.shipped_of(set_):
            value, error, n = row[column], row[f"{column}_se"], row["n"]
            guaranteed = bool(guarantee and row[guarantee])
            far = value + 2 * error if value > 0 else 0.0 if guaranteed else 3 / n
            note = ", guaranteed to be none" if guaranteed else ""
            points.append(
                {
                    "code": row["code"],
                    "y": (row["code"], up),
                    "x": clip(value, zero, 1.0),
                    "high": clip(far, zero, 1.0),
                    "fill": 1.0 if value > 0 or guaranteed else 0.0,
                    "text": f"{share(value, error, n)} of {n:,}{note}",
                }
            )
        style: dict[str, Any] = {"source": ColumnDataSource(columns(points)), "color": colour}
        style["line_width"] = 2
        plot.segment("x", "y", "high", "y", **style)
        dots = plot.scatter("x", "y", marker=marker, size=10, fill_alpha="fill", **style)
        add_hover(plot, dots, ("code", "@code"), (words, "@text"))
    return plot


# ---- scenes --------------------------------------------------------------------------------------


def scenes_plot(tables: Tables, lines: int) -> figure:
    """Plot divergence over bits of codes of scenes, and the fewest bits for this divergence.

    A code of single lines, whose receiver takes them as independent, is a hollow mark.
    """
    of_lines = [row for row in tables.scenes if row["lines"] == lines]
    rows = [row for row in of_lines if 0 < row["kl_joint_mean"] < math.inf]
    kl = [row["kl_joint_mean"] for row in rows] or [1.0]
    low, high = math.floor(math.log10(min(kl))), math.ceil(math.log10(max(kl)))
    most = max([row["joint_bits"] for row in rows], default=1.0)
    plot = new_plot(
        f"bits of the joint covariance of {lines} lines",
        "KL of a scene [nat]",
        360,
        y_axis_type="log",
        x_range=Range1d(start=0, end=1.35 * most),
        y_range=Range1d(start=10.0**low, end=10.0**high),
    )
    set_ticks(plot.yaxis[0], ticks(low, high))
    points = [
        {
            "x": row["joint_bits"],
            "y": row["kl_joint_mean"],
            "limit": row["limit_bits"],
            "fill": 1.0 if row["has_joint"] else 0.0,
            "code": row["code"],
            "label": f"{row['code']}, {row['frames']:.3g}",
            "bits": f"{row['joint_bits']:.0f}",
            "fewest": number(row["limit_bits"]),
            "kl": number(row["kl_joint_mean"]),
            "frames": f"{row['frames']:.3g}",
            "far": f"{number(row['far_p50'], 4)}, {number(row['far_p99'], 4)}",
            "width": f"{number(row['width_p50'], 4)}, {number(row['width_p99'], 4)}",
        }
        for row in rows
    ]
    source = ColumnDataSource(columns(points))
    if points:
        joint = ColumnDataSource(columns([point for point in points if point["fill"]]))
        if joint.data:
            plot.segment("limit", "y", "x", "y", source=joint, color=LIMIT, line_width=2, alpha=0.6)
            plot.scatter("limit", "y", source=joint, marker="diamond", size=10, color=LIMIT)
        dots = plot.scatter("x", "y", source=source, size=9, color=VERMILLION, fill_alpha="fill")
        labels = plot.text("x", "y", "label", source=source, x_offset=9, text_baseline="middle")
        labels.glyph.update(text_font_size="12px", text_color=INK)
        labels.tags = ["ink"]
        add_hover(
            plot,
            dots,
            ("code", "@code, @frames frames"),
            ("bits", "@bits, the fewest @fewest"),
            ("KL", "@kl nat"),
            ("sigma of y at 80 m, 50 and 99 %", "@far"),
            ("of the width", "@width"),
        )
    return plot


# ---- of one code at a time ----------------------------------------------------------------------

#: Half the width of a drawn band, in standard deviations.
BAND = 3.0
#: True and decoded lines: colour, dash, and opacity of the band.
SIDES = (("true", BLUE, "solid", 0.2), ("decoded", VERMILLION, "dashed", 0.08))
CHANGES = ((-1, VERMILLION, "triangle", "one bit less"), (1, BLUE, "circle", "one bit more"))
ORDINALS = ("the worst", "the second", "the third", "the fourth", "the fifth")


def fields_plot(tables: Tables, set_: str, codes: Sequence[str]) -> figure:
    """Plot the KL of a code with one bit less and one bit more in each of its fields."""
    views = {code: _fields_view(tables, set_, code) for code in codes}
    first = views[codes[0]]
    most = max(len(view["y_range"]["factors"]) for view in views.values())
    plot = new_plot(
        f"{SUMMARY['kl_mean']} [nat]",
        "",
        100 + 27 * max(most, 4),
        x_axis_type="log",
        x_range=Range1d(**first["x_range"]),
        y_range=FactorRange(**first["y_range"]),
    )
    for axis_range, key in ((plot.x_range, "x_range"), (plot.y_range, "y_range")):
        set_options(axis_range, "fields", {code: view[key] for code, view in views.items()})
    rule = draw_rule(plot, first["base"], "height", "dashed")
    set_options(rule, "fields", {code: {"location": v["base"]} for code, v in views.items()})
    for change, colour, marker, words in CHANGES:
        source = ColumnDataSource(first[change])
        set_options(source, "fields", {code: {"data": v[change]} for code, v in views.items()})
        style: dict[str, Any] = {"source": source, "color": colour}
        plot.segment("base", "field", "x", "field", line_width=2, **style)
        plot.segment("low", "field", "high", "field", line_width=6, line_alpha=0.4, **style)
        dots = plot.scatter("x", "field", marker=marker, size=10, fill_alpha="fill", **style)
        add_hover(
            plot,
            dots,
            ("field", "@field"),
            (words, "KL @text nat"),
            ("saturated", "@saturated"),
            ("mean line at 80 m", "@rms mm rms"),
        )
    return plot


def _fields_view(tables: Tables, set_: str, code: str) -> dict[Any, Any]:
    """Return data and axes of one code, the field that costs most at the top.

    A KL that is not finite is at the right edge, with a hollow mark.
    """
    rows = [row for row in tables.fields if (row["set"], row["code"]) == (set_, code)]
    shipped = tables.shipped(set_, code)
    base = math.nan if shipped is None else shipped["kl_mean"]
    seen = [kl for kl in (base, *(row["kl_mean"] for row in rows)) if 0 < kl < math.inf]
    low, high = min(seen, default=1.0), max(seen, default=1.0)
    margin = max(1.07, (high / low) ** 0.08)
    start, end = low / margin, high * margin

    def cost(field: str) -> float:
        less = [row for row in rows if row["field"] == field and row["delta_bits"] < 0]
        return max((clip(row["kl_mean"], start, math.inf) for row in less), default=low)

    view: dict[Any, Any] = {
        "base": clip(base, start, end),
        "x_range": {"start": start, "end": end},
        "y_range": {"factors": sorted(dict.fromkeys(row["field"] for row in rows), key=cost)},
    }
    for change, *_ in CHANGES:
        of_change = [row for row in rows if row["delta_bits"] == change]
        kl = [row["kl_mean"] for row in of_change]
        errors = [_two_errors(row) for row in of_change]
        view[change] = {
            "field": [row["field"] for row in of_change],
            "base": [view["base"]] * len(kl),
            "x": [clip(x, start, end) for x in kl],
            "low": [clip(x - error, start, end) for x, error in zip(kl, errors, strict=True)],
            "high": [clip(x + error, start, end) for x, error in zip(kl, errors, strict=True)],
            "fill": [float(math.isfinite(x)) for x in kl],
            "text": [with_error(row["kl_mean"], row["kl_mean_se"]) for row in of_change],
            "saturated": [percent(row["saturated"]) for row in of_change],
            "rms": [number(1e3 * row["lateral_rms_80"]) for row in of_change],
        }
    return view


def _two_errors(row: Row) -> float:
    """Return twice the standard error of the change, which is paired and therefore small."""
    error = 2 * float(row["kl_change_mean_se"])
    return error if math.isfinite(error) and error < row["kl_mean"] else 0.0


def worst_key(row: Row) -> str:
    """Return the value of the page's control for a row of the worst cases."""
    return f"{row['code']} {row['rank']}"


def worst_groups(tables: Tables) -> dict[str, dict[str, str]]:
    """Return the names of the worst cases of each code by their key."""
    groups: dict[str, dict[str, str]] = {code: {} for code in tables.codes}
    for row in sorted(tables.worst, key=lambda row: row["rank"]):
        of_code = groups.setdefault(row["code"], {})
        place = len(of_code)
        words = ORDINALS[place] if place < len(ORDINALS) else f"number {place + 1}"
        of_code.setdefault(worst_key(row), f"{row['code']}, {words}")
    return {code: of_code for code, of_code in groups.items() if of_code}


def worst_plots(tables: Tables, set_: str, keys: Sequence[str]) -> tuple[figure, figure]:
    """Plot the worst lines in the car's frame, and relative to the true mean line."""
    x = np.linspace(0.0, LATERAL_X[-1], 41)
    found = {worst_key(row): row for row in tables.worst if row["set"] == set_}
    cases = {key: _worst_view(found.get(key), x) for key in keys}
    titles = {key: {"text": _title(found.get(key))} for key in keys}
    plots = []
    for which, words in enumerate(("to the left: l(x) [m]", "minus the true mean line [m]")):
        plot = new_plot("x, ahead [m]", words, 320)
        views = {key: {"data": case[which]} for key, case in cases.items()}
        source = ColumnDataSource(views[keys[0]]["data"])
        set_options(source, "worst", views)
        if not which:
            title: Any = plot.title
            title.text, title.text_font_style = titles[keys[0]]["text"], "normal"
            set_options(title, "worst", titles)
        for side, colour, dash, fill in SIDES:
            low, high = f"{side}_low", f"{side}_high"
            plot.varea("x", low, high, source=source, fill_color=colour, fill_alpha=fill)
            for edge, width in ((low, 1.5), (high, 1.5), (side, 2.5)):
                plot.line("x", edge, source=source, color=colour, line_dash=dash, line_width=width)
        dots = plot.scatter("x", "decoded", source=source, size=6, alpha=0, hover_alpha=1)
        plot.scatter("x", "lost", source=source, marker="x", size=7, line_width=2, color=VERMILLION)
        add_hover(
            plot,
            dots,
            ("x", "@x{0} m"),
            ("true", "@true{0.0000} m, sigma @true_sigma{0.0000} m"),
            ("decoded", "@decoded{0.0000} m, sigma @decoded_sigma{0.0000} m"),
            mode="vline",
        )
        plots.append(plot)
    return plots[0], plots[1]


def _title(row: Row | None) -> str:
    if row is None:
        return "no such case in this set"
    status = Status(row["status"]).name if isinstance(row["status"], int) else str(row["status"])
    return f"{row['code']}: KL {number(row['kl'])} nat, {status.replace('_', ' ')}"


def _worst_view(row: Row | None, x: Array) -> tuple[dict[str, Array], dict[str, Array]]:
    """Return the columns of both plots: the line itself, and relative to the true mean line."""
    row = row or {}
    views: tuple[dict[str, Array], dict[str, Array]] = {"x": x}, {"x": x}
    true = np.full(len(x), math.nan)
    for side, prefix in (("true", ""), ("decoded", "decoded_")):
        mean = np.array([row.get(f"{prefix}mean_{i}", math.nan) for i in range(4)])
        cov = np.array(
            [[row.get(f"{prefix}cov_{i}{j}", math.nan) for j in range(4)] for i in range(4)]
        )
        J = lateral_jacobian(mean, x)
        variance = np.einsum("xi,ij,xj->x", J, cov, J)
        line, sigma = lateral(mean, x), np.sqrt(np.where(variance >= 0, variance, np.nan))
        true = line if side == "true" else true
        for view, y in zip(views, (line, line - true), strict=True):
            band = {f"{side}_low": y - BAND * sigma, f"{side}_high": y + BAND * sigma}
            view |= {side: y, f"{side}_sigma": sigma} | band
            view["lost"] = np.where(np.isnan(sigma), y, np.nan)  # of the decoded line at last
    return _singles(views[0]), _singles(views[1])


def _singles(view: Mapping[str, Array]) -> dict[str, Any]:
    return {key: values.astype(np.float32) for key, values in view.items()}
