"""Plots of one code at a time: where its bits go, and its worst lines."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, Range1d
from bokeh.plotting import figure
from numpy.typing import NDArray

from ...line import Status, lateral, lateral_jacobian
from ..metrics import LATERAL_X
from .parts import BLUE, VERMILLION, blank, decades, draw_rule, log10, set_options, set_ticks, tell
from .tables import SUMMARY, Row, Tables, number, with_error

__all__ = ["BAND", "fields_plot", "worst_key", "worst_plots"]

Array = NDArray[np.float64]

#: Half the width of a drawn band, in standard deviations.
BAND = 3.0
#: True and decoded: colour, dash, and how dense the band is.
SIDES = (("true", BLUE, "solid", 0.2), ("decoded", VERMILLION, "dashed", 0.08))
#: Of one bit less and one more.
CHANGES = ((-1, VERMILLION, "triangle", "one bit less"), (1, BLUE, "circle", "one bit more"))


def fields_plot(tables: Tables, set_: str, codes: Sequence[str]) -> figure:
    """KL of a code with one bit less, as it is, and with one bit more in each of its fields."""
    views = {code: _fields_view(tables, set_, code) for code in codes}
    first = views[codes[0]]
    most = max(len(view["y_range"]["factors"]) for view in views.values())
    plot = blank(f"{SUMMARY['kl_mean']} [nat]", "", 100 + 27 * max(most, 4), **first["y_range"])
    plot.x_range = Range1d(**first["x_range"])
    texts: dict[float, str] = {}
    for view in views.values():
        texts |= view["ticks"]
    ticker = set_ticks(plot.xaxis[0], texts)
    ticker.ticks = list(first["ticks"])
    set_options(ticker, "fields", {code: {"ticks": [*v["ticks"]]} for code, v in views.items()})
    for axis_range, key in ((plot.x_range, "x_range"), (plot.y_range, "y_range")):
        set_options(axis_range, "fields", {code: view[key] for code, view in views.items()})
    rule = draw_rule(plot, first["base"], "height", "dashed")
    set_options(rule, "fields", {code: {"location": v["base"]} for code, v in views.items()})
    for change, colour, marker, words in CHANGES:
        source = ColumnDataSource(first[change])
        set_options(source, "fields", {code: {"data": v[change]} for code, v in views.items()})
        plot.segment("base", "field", "x", "field", source=source, color=colour, line_width=2)
        errors = plot.segment("low", "field", "high", "field", source=source, color=colour)
        errors.glyph.line_width, errors.glyph.line_alpha = 6, 0.4
        dots = plot.scatter("x", "field", source=source, marker=marker, size=10, color=colour)
        tell(
            plot,
            dots,
            ("field", "@field"),
            (words, "KL @text nat"),
            ("saturated", "@saturated"),
            ("mean line at 80 m", "@rms mm rms"),
        )
    return plot


def _fields_view(tables: Tables, set_: str, code: str) -> dict[Any, Any]:
    """What the plot of one code shows: fields from the dearest to the cheapest, and its axis."""
    rows = [row for row in tables.fields if (row["set"], row["code"]) == (set_, code)]
    shipped = tables.shipped(set_, code)
    kl = math.nan if shipped is None else shipped["kl_mean"]
    seen = [value for value in (kl, *(row["kl_mean"] for row in rows)) if 0 < value < math.inf]
    low, high = (math.log10(end(seen)) if seen else 0.0 for end in (min, max))
    margin = max(0.03, 0.08 * (high - low))
    infinite = high + 5 * margin  #: where a KL stands that is not finite
    unbounded = any(math.isinf(value) for value in (kl, *(row["kl_mean"] for row in rows)))

    def place(value: float) -> float:
        return log10(value, low - margin) if math.isfinite(value) else infinite

    def cost(field: str) -> float:
        less = [row for row in rows if row["field"] == field and row["delta_bits"] < 0]
        return max((place(row["kl_mean"]) for row in less), default=low)

    fields = sorted(dict.fromkeys(row["field"] for row in rows), key=cost)
    end = infinite + margin if unbounded else high + margin
    view: dict[Any, Any] = {
        "base": place(kl),
        "x_range": {"start": low - margin, "end": end},
        "y_range": {"factors": fields},
        "ticks": decades(low - margin, high + margin) | ({infinite: "∞"} if unbounded else {}),
    }
    for change, *_ in CHANGES:
        points = [
            {
                "field": row["field"],
                "base": place(kl),
                "x": place(row["kl_mean"]),
                "low": place(row["kl_mean"] - _two_errors(row)),
                "high": place(row["kl_mean"] + _two_errors(row)),
                "text": with_error(row["kl_mean"], row["kl_mean_se"]),
                "saturated": f"{number(100 * row['saturated'])} %",
                "rms": number(1e3 * row["lateral_rms_80"]),
            }
            for row in rows
            if row["delta_bits"] == change
        ]
        keys = ("field", "base", "x", "low", "high", "text", "saturated", "rms")
        view[change] = {key: [point[key] for point in points] for key in keys}
    return view


def _two_errors(row: Row) -> float:
    """Twice the standard error of the change, which the same Gaussians show with little error."""
    name = "kl_change_mean_se" if "kl_change_mean_se" in row else "kl_mean_se"
    error = 2 * float(row[name])
    return error if math.isfinite(error) and error < row["kl_mean"] else 0.0


def worst_plots(tables: Tables, set_: str, keys: Sequence[str]) -> tuple[figure, figure]:
    """The worst lines as the car sees them, and the same less the true mean line."""
    x = np.linspace(0.0, LATERAL_X[-1], 41)
    found = {worst_key(row): row for row in tables.worst if row["set"] == set_}
    cases = {key: _worst_view(found.get(key), x) for key in keys}
    titles = {key: {"text": _title(found.get(key))} for key in keys}
    plots = []
    for which, words in enumerate(("to the left: l(x) [m]", "less the true mean line [m]")):
        plot = blank("x, ahead [m]", words, height=320)
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
            for edge in (low, high):
                plot.line("x", edge, source=source, color=colour, line_dash=dash, line_width=1.5)
            plot.line("x", side, source=source, color=colour, line_dash=dash, line_width=2.5)
        dots = plot.scatter("x", "decoded", source=source, size=6, alpha=0, hover_alpha=1)
        plot.scatter("x", "lost", source=source, marker="x", size=7, line_width=2, color=VERMILLION)
        tell(
            plot,
            dots,
            ("x", "@x{0} m"),
            ("true", "@true{0.0000} m, sigma @true_sigma{0.0000} m"),
            ("decoded", "@decoded{0.0000} m, sigma @decoded_sigma{0.0000} m"),
            mode="vline",
        )
        plots.append(plot)
    return plots[0], plots[1]


def worst_key(row: Row) -> str:
    """How the page's control names a row of the worst cases."""
    return f"{row['code']} {row['rank']}"


def _title(row: Row | None) -> str:
    if row is None:
        return "no such case in this set"
    return f"{row['code']}: KL {number(row['kl'])} nat, {_status(row['status'])}"


def _status(status: object) -> str:
    """A status in words, whether it is stored as a name or as a number."""
    return (Status(status).name if isinstance(status, int) else str(status)).replace("_", " ")


def _worst_view(row: Row | None, x: Array) -> tuple[dict[str, Array], dict[str, Array]]:
    """Columns for the line itself, and for what is left of it less the true mean line."""
    lines, sigmas = {}, {}
    for side, prefix in (("true", ""), ("decoded", "decoded_")):
        none = dict.fromkeys([f"{prefix}mean_{i}" for i in range(4)], math.nan)
        mean = np.array([(row or none)[f"{prefix}mean_{i}"] for i in range(4)])
        cov = np.array(
            [[(row or {}).get(f"{prefix}cov_{i}{j}", math.nan) for j in range(4)] for i in range(4)]
        )
        J = lateral_jacobian(mean, x)
        variance = np.einsum("xi,ij,xj->x", J, cov, J)
        lines[side] = lateral(mean, x)
        sigmas[side] = np.sqrt(np.where(variance >= 0, variance, np.nan))
    return (
        _band_columns(x, lines, sigmas),
        _band_columns(x, {side: y - lines["true"] for side, y in lines.items()}, sigmas),
    )


def _band_columns(
    x: Array, lines: Mapping[str, Array], sigmas: Mapping[str, Array]
) -> dict[str, Array]:
    columns = {"x": x}
    for side, y in lines.items():
        columns |= {side: y, f"{side}_sigma": sigmas[side]}
        columns |= {f"{side}_low": y - BAND * sigmas[side], f"{side}_high": y + BAND * sigmas[side]}
    columns["lost"] = np.where(np.isnan(sigmas["decoded"]), lines["decoded"], np.nan)
    return {key: np.asarray(value, dtype=np.float32) for key, value in columns.items()}
