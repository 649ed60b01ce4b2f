"""Plots of one code at a time: the effect of a bit in each field, and its worst lines."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, FactorRange, Range1d
from bokeh.plotting import figure
from numpy.typing import NDArray

from ...values.line import Status, lateral, lateral_jacobian
from ..metrics import LATERAL_X
from .drawing import BLUE, VERMILLION, add_hover, clip, draw_rule, new_plot, set_options
from .tables import SUMMARY, Row, Tables, number, percent, with_error

Array = NDArray[np.float64]

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
    name = "kl_change_mean_se" if "kl_change_mean_se" in row else "kl_mean_se"
    error = 2 * float(row[name])
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
