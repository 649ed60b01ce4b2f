"""Data and axes of the report's plots."""

import re
from copy import deepcopy
from typing import Any

import numpy as np
import pytest
from bokeh.models import Segment
from support.sweep_tables import USED, write

from maplines_can.study.report.drawing import plot_styles
from maplines_can.study.report.plots import (
    fields_plot,
    kl_plot,
    scenes_plot,
    worst_key,
    worst_plots,
)
from maplines_can.study.report.results import read_tables
from maplines_can.values.line import lateral, lateral_jacobian


def test_an_infinite_kl_is_above_the_axis_with_its_share(folder: Any) -> None:
    """Each width has a mark at the infinity tick; the 99 % quantile has a view of its own."""
    tables = read_tables(folder)
    plot = kl_plot(tables, "paper", plot_styles(tables.codes))
    source = next(
        r.data_source  # type: ignore[attr-defined]
        for r in plot.renderers
        if r.tags == ["code:LinearNearest"]
    )  # its line
    ticks = plot.yaxis[0].major_label_overrides

    assert [ticks[y] for y in source.data["y"]] == ["∞", "∞"]
    assert all(np.isnan(source.data["path"]))
    assert all(re.fullmatch(r"[\d.]+ %", text) for text in source.data["mark"])
    median = source.tags[0]["options"]["kl_p99"]["data"]
    assert len(median["y"]) == 2
    drawn = {tag for r in plot.renderers for tag in r.tags}
    assert drawn == {f"code:{code}" for code in USED}


def test_worst_cases_are_the_lines_and_their_bands(folder: Any) -> None:
    """Bands are 3 sigma of l(x) to first order; crosses mark negative variances."""
    tables = read_tables(folder)
    keys = [worst_key(row) for row in tables.worst if row["set"] == "paper"]
    plot, less = worst_plots(tables, "paper", keys)
    options = plot.renderers[0].data_source.tags[0]["options"]  # type: ignore[attr-defined]
    for row in (row for row in tables.worst if row["set"] == "paper"):
        data = options[worst_key(row)]["data"]
        for side, prefix in (("true", ""), ("decoded", "decoded_")):
            mean = np.array([row[f"{prefix}mean_{i}"] for i in range(4)])
            S = np.array([[row[f"{prefix}cov_{i}{j}"] for j in range(4)] for i in range(4)])
            x = np.asarray(data["x"], dtype=float)
            J = lateral_jacobian(mean, x)
            variance = np.sum((J @ S) * J, axis=1)
            np.testing.assert_allclose(data[side], lateral(mean, x), rtol=1e-5, atol=1e-5)
            half = (data[f"{side}_high"] - data[f"{side}_low"]) / 2
            seen = variance > 0
            np.testing.assert_allclose(half[seen], 3 * np.sqrt(variance[seen]), rtol=1e-3)
            if side == "decoded":
                np.testing.assert_array_equal(np.isfinite(data["lost"]), variance < 0)
    relative = less.renderers[0].data_source.data  # type: ignore[attr-defined]
    np.testing.assert_array_equal(relative["true"], 0)


def test_fields_are_sorted_by_the_cost_of_one_bit_less(folder: Any) -> None:
    """The most expensive field is at the top."""
    plot = fields_plot(read_tables(folder), "paper", ["Cholesky"])

    assert plot.y_range.factors == ["Inflation", "PivotC0", "RatioC0C1"]  # type: ignore[attr-defined]


def test_item_12_the_median_is_shown_first_without_texts_beside_marks(folder: Any) -> None:
    """Texts beside marks hid one another; those above the axis have a row for each code."""
    tables = read_tables(folder)
    plot = kl_plot(tables, "paper", plot_styles(tables.codes))
    assert plot.yaxis[0].axis_label == "KL of the covered target, median [nat]"
    for renderer in plot.renderers:
        if type(renderer.glyph).__name__ == "Text" and renderer.tags:  # type: ignore[attr-defined]
            assert renderer.tags == ["code:LinearNearest"]  # the only one with an infinite KL
    row_of = tables.shipped("paper", "Cholesky")
    assert row_of is not None
    (source,) = (
        r.data_source  # type: ignore[attr-defined]
        for r in plot.renderers
        if r.tags == ["code:Cholesky"] and type(r.glyph).__name__ == "Segment"  # type: ignore[attr-defined]
    )
    at = source.data["finer"].index("+0")
    assert source.data["y"][at] == pytest.approx(row_of["kl_p50"])
    assert source.data["high"][at] == pytest.approx(row_of["kl_p99"])


def test_scenes_are_drawn_with_their_distance_to_the_limit(folder: Any, rows: Any) -> None:
    """A mark for each code, hollow for single lines; none without a divergence."""
    rows = deepcopy(rows)
    for row in rows["scenes"]:
        row["kl_joint_mean"] = 0.02 if row["has_joint"] else 9.0
    tables = read_tables(write(folder.parent / "with-scenes", rows))
    plot: Any = scenes_plot(tables, 4)
    (marks,) = (one for one in plot.renderers if getattr(one.glyph, "fill_alpha", "") == "fill")
    data = marks.data_source.data
    assert data["code"] == [row["code"] for row in rows["scenes"] if row["lines"] == 4]
    assert data["fill"] == [float(code != "Cholesky") for code in data["code"]]
    segments = [one for one in plot.renderers if isinstance(one.glyph, Segment)]
    assert segments[0].data_source.data["limit"] == [29.5] * (len(data["code"]) - 1)
    assert not scenes_plot(read_tables(folder), 4).renderers
