"""Rounding of production messages: formulas compared with cantools and with counting."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import cantools
import numpy as np
import pytest

from maplines_can.cli import main
from maplines_can.study import Gaussians
from maplines_can.study.production_messages import (
    DISTANCES,
    PRODUCTION,
    as_csv,
    as_markdown,
    as_records,
    as_text,
    default_message,
    measured,
    production_table,
    rms,
    worst,
)
from maplines_can.values.line import PARAMETERS, lateral
from maplines_can.wire import Layout

MOBILEYE, TESLA, FORD, GM_EGO, HONDA = (PRODUCTION[i] for i in (0, 1, 3, 6, 8))
ALL = [
    pytest.param(message, id=message.name.replace(" ", "-"))
    for message in (*PRODUCTION, default_message())
]
X = np.array(DISTANCES)


@pytest.fixture(scope="module")
def rows() -> Any:
    return production_table()


def of(rows: Any, message: Any) -> Any:
    return next(row for row in rows if row.message.name == message.name)


def lines_within(message: Any, n: Any, seed: int = 0) -> Any:
    """Return lines of small heading that fill the ranges of a message."""
    rng = np.random.default_rng(seed)
    ends = [field.physical_range if field else (-1e-4, 1e-4) for field in message.signals]
    low, high = np.array(ends).T
    values = rng.uniform(low, high, size=(n, 4))
    values[:, 1] *= 1e-2 / high[1]  # the formulas hold for a line along the car's axis
    sides = rng.choice([-1.0, 1.0], size=(n, 4))
    return message.read(values, sides)


# -- formulas ---------------------------------------------------------------------


@pytest.mark.parametrize("message", ALL)
def test_the_formulas_match_simulated_rounding(message: Any) -> None:
    """The rms is within five sampling errors, no error beyond the worst; nothing rounds twice."""
    n = 50_000
    lines = lines_within(message, n)
    once, clipped = message.rounded(lines)
    read = np.where([signal is None for signal in message.signals], lines, once)
    error = lateral(read[:, None, :], X) - lateral(lines[:, None, :], X)
    fits = ~clipped.any(axis=1)

    assert fits.mean() > 0.99
    # The kurtosis of a sum of uniform errors is at most 3; tan(beta)^2 adds 1e-4.
    tolerance = 5 * np.sqrt(2 / (4 * n)) + 2e-4
    assert np.sqrt((error[fits] ** 2).mean(axis=0)) == pytest.approx(rms(message, X), rel=tolerance)
    assert (np.abs(error[fits]).max(axis=0) <= worst(message, X) * (1 + 2e-4)).all()
    np.testing.assert_allclose(message.read(message.sent(lines), lines), lines, rtol=1e-12)
    np.testing.assert_allclose(message.rounded(once)[0], once, rtol=1e-9, atol=1e-12)


# -- independent decoders ------------------------------------------------------------

#: Signals of y_off, beta, c0 and c1, typed from the published widths and factors.
SIGNALS = {
    "tesla": (
        "8@1+ (0.035,-3.5) [-3.5|3.5]",
        "8@1+ (0.0016,-0.2) [-0.2|0.2]",
        "8@1+ (2E-05,-0.0025) [-0.0025|0.0025]",
        "8@1+ (2.4E-07,-3E-05) [-3E-05|3E-05]",
    ),
    "ford": (
        "10@1+ (0.01,-5.12) [-5.12|5.11]",
        "11@1+ (0.0005,-0.5) [-0.5|0.5235]",
        "11@1+ (2E-05,-0.02) [-0.02|0.02094]",
        "13@1+ (2.5E-07,-0.001024) [-0.001024|0.00102375]",
    ),
    "mobileye": (
        "16@1- (0.00390625,0) [-128|127]",
        "16@1+ (0.0009765625,-31.9990234375) [-0.357|0.357]",
        "16@1+ (9.765625E-07,-0.0319990234375) [-0.02|0.02]",
        "16@1+ (3.725290298461914E-09,-0.00012206658720970154) [-0.00012|0.00012]",
    ),
}


@pytest.mark.parametrize(
    ("name", "message"), [("tesla", TESLA), ("ford", FORD), ("mobileye", MOBILEYE)]
)
def test_cantools_rounds_to_the_same_lines(name: str, message: Any) -> None:
    """Encoding and decoding with a DBC of the published figures gives the same lines."""
    rows = [
        f' SG_ {s} : {16 * i}|{rest} "" E'
        for i, (s, rest) in enumerate(zip("ABCD", SIGNALS[name], strict=True))
    ]
    text = "\n".join(['VERSION ""', "BU_: E", "BO_ 1 Line: 8 E", *rows, ""])
    dbc = cantools.database.load_string(text, "dbc").messages[0]  # type: ignore[union-attr]
    for line in lines_within(message, 300):
        y_off, beta, c0, c1 = line
        sent = (y_off, beta, c0, c1) if name == "ford" else (y_off, np.tan(beta), c0 / 2, c1 / 6)
        a, b, c, d = dbc.decode(  # type: ignore[union-attr]
            dbc.encode(dict(zip("ABCD", sent, strict=True)), strict=False)
        ).values()
        expected = (a, b, c, d) if name == "ford" else (a, np.arctan(b), 2 * c, 6 * d)  # type: ignore[arg-type, operator]

        assert message.rounded(line)[0] == pytest.approx(expected, rel=1e-9, abs=1e-15)


# -- this project's own message -----------------------------------------------------


def test_the_default_is_the_dbc() -> None:
    """Widths, factors and the bits of the covariance come from the layout, also an edited one."""
    layout = Layout.from_dbc()
    c1 = replace(layout["C1"], length=16, factor=2**-20, raw_min=-(2**15), raw_max=2**15 - 1)
    coarse = dict(layout.signals) | {"C1": c1}

    message = default_message(layout)
    changed = default_message(replace(layout, signals=coarse))

    assert message.signals == tuple(layout[name] for name in ("YOff", "Beta", "C0", "C1"))
    assert message.uncertainty == "covariance, 105 b"  # dbc/README.md, the table of the codes
    assert changed.bits == message.bits - layout["C1"].length + 16
    assert worst(changed, 80.0) > worst(message, 80.0) + 0.03


# -- counting ---------------------------------------------------------------------


def test_clipped_lines_are_counted_and_left_out() -> None:
    """One line is too far aside, one too curved, one both, and one fits."""
    mean = np.array(
        [[10, 0, 0, 0], [1, 0, 0.02, 0], [-10, 0, -0.02, 0], [1.01, 0, 0, 0]], dtype=float
    )
    lines = Gaussians(mean, np.tile(np.diag([0.1, 0.01, 1e-4, 1e-6]) ** 2, (4, 1, 1)))
    row = measured(TESLA, lines, lines)
    read, _ = TESLA.rounded(mean)

    assert row.clipped == (2, 0, 2, 0)
    assert (row.lines, row.fit, row.evaluated) == (4, 1, (1, 1, 1))
    assert read[0, 0] == pytest.approx(3.5)
    # 1.01 m is nearest to 129 steps of 0.035 m above -3.5 m; the rest rounds to zero.
    assert row.measured_rms == pytest.approx([1.015 - 1.01] * 3, abs=1e-9)
    assert row.rounding_kl[0] == pytest.approx((0.005 / 0.1) ** 2 / 2, rel=1e-6)


def test_a_line_counts_only_as_far_as_it_stays_within_45_deg() -> None:
    """A radius of 30 m reaches 20 m within 45 deg, and not 50 m; without lines there are dashes."""
    mean = np.array([[1.0, 0.0, 1 / 30, 0.0]])
    lines = Gaussians(mean, np.diag([0.1, 0.01, 1e-4, 1e-6])[None] ** 2)
    row = measured(default_message(), lines, lines)

    assert row.evaluated == (1, 0, 0)
    assert np.isnan(row.measured_rms[1:]).all()
    nothing = measured(TESLA, Gaussians(30 * mean, lines.cov), lines)
    assert nothing.fit == 0
    assert "- / - / -" in as_markdown([nothing])
    assert as_records([nothing])[0]["measured_rms_at_80m_m"] is None


# -- the table --------------------------------------------------------------------


def test_the_table_on_the_set(rows: Any) -> None:
    """The measured rms agrees with the formula, but for sampling and slanted lines."""
    for row in rows:
        fewest = min(row.evaluated)
        tolerance = 5 * np.sqrt(2 / (4 * fewest)) + 0.05

        assert row.measured_rms == pytest.approx(row.rms, rel=tolerance), row.message.name
    assert len(rows) == len(PRODUCTION) + 1
    assert rows[-1].fit == rows[-1].lines
    assert of(rows, HONDA).truncated_rms[2] > 10 * of(rows, HONDA).measured_rms[2]
    assert all(row.truncated_rms is None for row in rows if None not in row.message.signals)


def test_too_few_lines_raise() -> None:
    with pytest.raises(ValueError, match="100 lines or more"):
        production_table(99)


def test_writers_agree(rows: Any) -> None:
    """CSV, JSON and both kinds of text have the same rows."""
    table = list(csv.DictReader(io.StringIO(as_csv(rows))))
    records = as_records(rows)

    assert [row["message"] for row in table] == [r.message.name for r in rows]
    assert float(table[1]["worst_at_50m_m"]) == pytest.approx(0.0975)
    assert records[-1]["c1_factor"] == Layout.from_dbc()["C1"].factor
    assert {f"{state}_bits" for state in PARAMETERS} <= set(records[0])
    for text in (as_text(rows), as_markdown(rows)):
        assert all(text.count(f"{r.message.maker} {r.message.name}") >= 4 for r in rows)


@pytest.mark.parametrize("form", ["--json", "--markdown", "--csv", None])
def test_the_command(form: str | None, capsys: pytest.CaptureFixture[str]) -> None:
    """The command prints one format."""
    assert main(["study", "production", "--n", "100", *([form] if form else [])]) == 0
    out = capsys.readouterr().out
    if form == "--json":
        assert len(json.loads(out)) == len(PRODUCTION) + 1
    assert ("| --- |" in out) == (form == "--markdown")


def test_the_page_has_the_tables_of_the_command(rows: Any) -> None:
    """docs/bits.md has those of the signals and of the errors of their steps."""
    page = (Path(__file__).parents[2] / "docs" / "bits.md").read_text(encoding="utf-8")
    signals, _, steps, _ = as_markdown(rows).split("\n\n")

    assert signals.strip() in page
    assert steps.strip() in page
