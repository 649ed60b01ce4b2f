"""Range of a refit: as far as a cubic follows the line, whatever the spacing of its points."""

from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from maplines_can import Polyline, Refit, Slot
from maplines_can.propagation import points_in_window
from maplines_can.study.roads import curve, random_scenarios
from maplines_can.values.line import lateral

ORIGIN = np.zeros(3)
WINDOW = (-20.0, 80.0)


def bend(radius: float, spacing: float = 0.5, start: float = 0.0) -> Any:
    """A line that is straight up to ``start`` [m] and then an arc to the left."""
    s = np.arange(-40.0, 120.0 + spacing / 2, spacing)
    curvature = np.where(s >= start, 1 / radius, 0.0)
    return Polyline(curve(1.75, 0.0, curvature, spacing, -40.0))


def s_bend(radius: float) -> Any:
    """Alternating arcs of 30 m."""
    s = np.arange(-40.0, 120.5, 0.5)
    return Polyline(curve(1.75, 0.0, np.sign(np.sin(np.pi * s / 30)) / radius, 0.5, -40.0))


def deviation(polyline: Any, x_range: Any, line: Any = None) -> float:
    """Largest deviation of a cubic from a line, by default of the best one (Chebyshev)."""
    points = points_in_window(polyline, ORIGIN, x_range)
    x_min, x_max = x_range
    x = np.linspace(x_min, x_max, 150)
    y = np.interp(x, *points.T)
    if line is not None:
        return float(np.abs(y - lateral(line, x)).max())
    w = 2 * (x - x_range[0]) / (x_range[1] - x_range[0]) - 1
    V = np.polynomial.chebyshev.chebvander(w, 3)
    ones = np.ones((len(x), 1))
    A = np.block([[V, -ones], [-V, -ones]])
    best = linprog([0, 0, 0, 0, 1], A, np.concatenate([y, -y]), bounds=[(None, None)] * 5)
    assert best.success
    return float(best.fun)


def limit(polyline: Any, x_min: float, x_max: float, max_misfit: float) -> float:
    """Largest end of a range from ``x_min`` in which a cubic holds the misfit, at most x_max."""
    low, high = x_min + 1.0, x_max
    if deviation(polyline, (x_min, high)) <= max_misfit:
        return high
    for _ in range(9):
        middle = (low + high) / 2
        held = deviation(polyline, (x_min, middle)) <= max_misfit
        low, high = (middle, high) if held else (low, middle)
    return low


SHAPES = {
    **{f"arc-{radius}": bend(radius) for radius in (12.0, 25.0, 50.0, 100.0, 200.0)},
    **{f"bend-{radius}": bend(radius, start=20.0) for radius in (8.0, 30.0, 60.0)},
    **{f"s-bend-{radius}": s_bend(radius) for radius in (60.0, 120.0)},
}


@pytest.mark.parametrize("name", SHAPES)
def test_the_cubic_is_nearly_the_best_one(name: str) -> None:
    """The misfit is a mean over some metres: what dense points show is more, and within 1.4 limits.

    No other cubic is closer by more than half at the worst place.
    """
    refit = Refit(SHAPES[name], ORIGIN, WINDOW, max_misfit=0.1)
    found = deviation(SHAPES[name], refit.x_range, refit(ORIGIN))

    assert refit.misfit <= min(0.1, found)
    assert found <= min(0.14, 2 * deviation(SHAPES[name], refit.x_range))


def test_item_2_the_range_is_near_the_chebyshev_limit() -> None:
    """Of the longest range from the same start that any cubic could hold: median and least."""
    shares = []
    for line in (*SHAPES.values(), *(road.lines[Slot.EGO_LEFT] for road in tight_roads(8))):
        x_min, x_max = Refit(line, ORIGIN, WINDOW).x_range
        end = Refit(line, ORIGIN, WINDOW, max_misfit=1e9).x_range[1]
        shares.append((x_max - x_min) / (limit(line, x_min, end, 0.1) - x_min))

    assert len(shares) == 18
    assert np.median(shares) >= 0.85
    assert min(shares) >= 0.6
    assert max(shares) <= 1 + 1e-2  # no range holds more than the limit, to its own accuracy


def tight_roads(n: int) -> Any:
    """Random roads that no cubic follows to their end."""
    roads = []
    for road in random_scenarios(400, seed=3):
        if Refit(road.lines[Slot.EGO_LEFT], ORIGIN, WINDOW, max_misfit=1e9).misfit > 0.15:
            roads.append(road)
        if len(roads) == n:
            return roads
    raise AssertionError(f"only {len(roads)} of {n} tight roads")


def test_a_smaller_misfit_gives_a_shorter_range() -> None:
    """An infinite one gives all of the window, without a cover."""
    line = bend(100.0)
    lengths = [
        np.ptp(Refit(line, ORIGIN, WINDOW, max_misfit=each).x_range) for each in (0.01, 0.1, 1.0)
    ]
    paper = Refit(line, ORIGIN, WINDOW, max_misfit=np.inf)

    assert lengths == sorted(lengths)
    assert lengths[0] < lengths[1] < 100.0
    assert paper.x_range == pytest.approx(WINDOW)
    assert paper.noise_cov is None
