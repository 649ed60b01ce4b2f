"""Accuracy of received lines: errors that are put in are the errors that come out."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can import MapLine, Polyline, Slot, Status
from maplines_can.cli.accuracy import as_text
from maplines_can.simulation.accuracy import (
    REQUIREMENTS,
    Accuracy,
    AccuracyRequirement,
    accuracy_of,
)
from maplines_can.simulation.truth import PLACES, Truth, true_lines
from maplines_can.values.errors import DriveFileError

START, PERIOD, N = 1.7e9, 0.05, 200
SLOT = Slot.EGO_LEFT
#: True line: y = 2 + x^2 / 800, of curvature 1/400 at the car.
TRUE = np.array([2.0, 0.0, 1 / 400, 0.0])


def truth_of(curvature: float = TRUE[2], n: int = N) -> Truth:
    x = np.linspace(-30, 120, 1501)
    line = {SLOT: Polyline(np.column_stack([x, TRUE[0] + curvature * x**2 / 2]))}
    values = true_lines(line, [SLOT], np.zeros(3))
    time = np.array([START + PERIOD * i for i in range(n)])
    lines = {SLOT: np.tile(values, (n, 1))}
    poses = np.zeros((n, 3)), np.zeros((n, 3, 3))
    return Truth(time, np.full(n, True), 0, np.full(n, 10.0), lines, *poses)


def lines_of(errors: Any, n: int = N, sigma: Any = (0.1, 1e-3, 1e-4, 1e-6), **rest: Any) -> Any:
    """Lines with these errors of the parameters, received 10 ms after their pose."""
    mean = TRUE + np.asarray(errors)
    rest = {"x_min": -10.0, "x_max": 80.0} | rest
    return [
        replace(
            MapLine.with_sigma(SLOT, mean, sigma, age=0.016, **rest),
            t_ns=round(1e9 * (START + PERIOD * i + 0.010)),
        )
        for i in range(n)
    ]


@given(st.floats(-0.5, 0.5), st.floats(-0.01, 0.01), st.floats(-1e-3, 1e-3))
def test_errors_come_out_as_they_were_put_in(shift: float, turn: float, bend: float) -> None:
    """Lateral, heading and curvature error at each place, and their largest value."""
    accuracy = accuracy_of(truth_of(), lines_of([shift, turn, bend, 0], n=3))
    x = np.array(PLACES, dtype=float)
    lateral = shift + np.tan(turn) * x + bend * x**2 / 2
    slope, true_slope = np.tan(turn) + (TRUE[2] + bend) * x, TRUE[2] * x
    heading = np.degrees(np.arctan(slope) - np.arctan(true_slope))
    curvature = (TRUE[2] + bend) / np.hypot(1, slope) ** 3 * np.hypot(1, true_slope) ** 3 / TRUE[2]
    assert accuracy.lines == 3
    assert accuracy.errors["lateral"][1] == pytest.approx(lateral, abs=1e-4)
    assert accuracy.errors["heading"][1] == pytest.approx(heading, abs=0.01)
    assert accuracy.errors["curvature"][1] == pytest.approx(100 * (curvature - 1), abs=1.0)
    every = np.arange(0, 81, 10)
    largest = np.abs(shift + np.tan(turn) * every + bend * every**2 / 2).max()
    assert accuracy.errors["absolute"][1, 0] == pytest.approx(largest, abs=1e-4)


@given(st.floats(-2, 2), st.floats(-0.02, 0.02))
def test_alignment_removes_a_shift_and_a_rotation(shift: float, turn: float) -> None:
    """Not a bend: its rest is that of a least-squares line, as numpy fits it."""
    accuracy = accuracy_of(truth_of(), lines_of([shift, turn, 0, 0], n=1))
    assert accuracy.errors["relative"][0, 0] == pytest.approx(0.0, abs=1e-4)
    bent = accuracy_of(truth_of(), lines_of([shift, turn, 5e-4, 0], n=1))
    x = np.arange(0, 81, 10)
    rest = np.polyval(np.polyfit(x, 5e-4 * x**2 / 2, 1), x) - 5e-4 * x**2 / 2
    assert bent.errors["relative"][0, 0] == pytest.approx(np.abs(rest).max(), abs=1e-4)


def test_only_the_range_of_a_line_is_compared() -> None:
    """Two lateral positions are too few to align."""
    accuracy = accuracy_of(truth_of(), lines_of([0.3, 0, 0, 0], x_min=5.0, x_max=25.0))
    assert np.isfinite(accuracy.errors["lateral"][0]).tolist() == [False, True, False, False]
    assert accuracy.figures("absolute", 0)["n"] == N
    assert accuracy.figures("relative", 0)["n"] == 0
    assert accuracy.figures("lateral", 0) == {"n": 0}


def test_a_straight_line_has_no_relative_error_of_its_curvature() -> None:
    accuracy = accuracy_of(truth_of(curvature=1e-5), lines_of([0, 0, 1e-5 - TRUE[2], 0]))
    assert accuracy.figures("curvature", 0) == {"n": 0}
    assert accuracy.figures("heading", 0)["n"] == N


def test_each_line_is_compared_with_its_cycle() -> None:
    """The true line moves by 1 m each cycle, and so do the lines; also with relative times."""
    truth = truth_of()
    moved = truth.lines[SLOT].copy()
    moved[:, :9] += np.arange(N)[:, None]
    truth = truth._replace(lines={SLOT: moved})
    lines = [lines_of([i, 0, 0, 0])[i] for i in range(0, N, 7)]
    relative = [replace(x, t_ns=x.t_ns - round(1e9 * START)) for x in lines]
    for given_lines in (lines, relative):
        assert accuracy_of(truth, given_lines).figures("lateral", 1)["max"] < 1e-3


def test_lines_that_are_not_compared_are_counted() -> None:
    """Too old, of another lane, of a slot or a time that the truth does not have."""
    truth = truth_of()._replace(same_lane=np.arange(N) >= 5)
    lines = lines_of([0, 0, 0, 0])
    lines += [replace(x, age=np.inf) for x in lines[:3]]
    lines += [replace(x, slot=Slot.NEXT_LEFT) for x in lines[10:12]]
    lines += [replace(lines[0], t_ns=lines[0].t_ns + 10**12)]
    lines += [replace(lines[20], status=Status.SATURATED)]
    accuracy = accuracy_of(truth, lines)
    assert accuracy.received == N + 3 + 2 + 1 + 1
    counts = (accuracy.without_values, accuracy.other_lane, accuracy.unknown, accuracy.saturated)
    assert counts == (3, 5, 3, 1)
    assert accuracy.lines == N - 5 + 1


def test_lines_of_another_drive_and_no_lines() -> None:
    lines = [replace(x, t_ns=x.t_ns + 10**14) for x in lines_of([0, 0, 0, 0])]
    with pytest.raises(DriveFileError, match="the truth and the log of the same drive"):
        accuracy_of(truth_of(), lines)
    accuracy = accuracy_of(truth_of(), [])
    assert (accuracy.received, accuracy.lines) == (0, 0)
    assert "0 lines received" in as_text(accuracy)


def mixed(share: float) -> Accuracy:
    """Lines of which a share is 30 cm off, the others are exact."""
    wrong = round(share * N)
    return accuracy_of(truth_of(), lines_of([0.3, 0, 0, 0])[:wrong] + lines_of([0] * 4)[wrong:])


@pytest.mark.parametrize(("share", "met"), [(0.0, True), (0.04, True), (0.06, False), (1.0, False)])
def test_a_requirement_is_met_by_95_percent(share: float, met: bool) -> None:
    """At every place; the shift is aligned."""
    accuracy = mixed(share)
    assert accuracy.met(AccuracyRequirement("lateral", 0.2, "")) == dict.fromkeys(
        map(str, PLACES), met
    )
    assert accuracy.met(AccuracyRequirement("absolute", 0.2, "")) == {"line": met}
    assert accuracy.met(AccuracyRequirement("relative", 0.2, "")) == {"line": True}


def test_the_text_and_the_figures_agree() -> None:
    """Each requirement has a row with its verdicts."""
    accuracy = mixed(1.0)
    text, result = as_text(accuracy), accuracy.as_dict()
    assert text.count("missed") == 4 * 2 + 2  # lateral 10 and 20 cm; absolute 10 and 15 cm
    assert all(requirement.source in text for requirement in REQUIREMENTS)
    assert result["errors"]["lateral"]["0"]["rms"] == pytest.approx(0.3)
    assert result["errors"]["absolute"]["line"]["max"] == pytest.approx(0.3, abs=1e-4)
    assert result["beyond 3 sigma"]["0"] == 0.0
    missed = dict.fromkeys(map(str, PLACES), False)
    assert [row["met"] for row in result["requirements"]][:2] == [missed] * 2
    lines = lines_of([0.3, 0, 0, 0], sigma=(0.05, 1e-6, 1e-8, 1e-10))
    assert accuracy_of(truth_of(), lines).as_dict()["beyond 3 sigma"]["40"] == 1.0
