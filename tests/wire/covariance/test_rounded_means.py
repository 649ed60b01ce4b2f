"""Rounding of means, given what the lines have of their own."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scene_layouts import layout_of

from maplines_can.values.seen_lines import bases
from maplines_can.wire.covariance.rounding import refined, rounded_means, rounding_factor, split
from maplines_can.wire.covariance.scene_code import RESOLUTION
from maplines_can.wire.layout.signals import FINE_SIGNALS, PARAMETER_SIGNALS

SIGNALS = [layout_of("maplines-pose.dbc")[name] for name in PARAMETER_SIGNALS]
FINE = [layout_of("maplines-pose.dbc")[name] for name in FINE_SIGNALS]
LINES = 200


def errors_of(own_in_metres: Any) -> Any:
    """Return the (L, 4) errors of random lines, in coefficients of T_0 .. T_3."""
    rng = np.random.default_rng(3)
    means = rng.uniform(-1, 1, (LINES, 4)) * [5, 0.2, 2e-3, 1e-5]
    J = bases(means, np.tile([-20.0, 80.0], (LINES, 1)))
    own = J @ np.broadcast_to(own_in_metres, J.shape) @ J.swapaxes(1, 2)
    raw, fits = rounded_means(SIGNALS, means, rounding_factor(own, J, RESOLUTION))
    assert fits.all()
    decoded = np.column_stack([signal.physical(raw[signal.name]) for signal in SIGNALS])
    return np.linalg.solve(J, (decoded - means)[..., None])[..., 0]


def test_the_error_is_the_smallest_where_a_line_has_the_least_of_its_own() -> None:
    """A step of C0 alone changes T_0 + T_2 here; T_0 - T_2 is free of it."""
    thin = np.array([1.0, 0, -1.0, 0]) / np.sqrt(2)
    own = 0.05**2 * (np.eye(4) - np.outer(thin, thin))
    error, other = errors_of(own) @ thin, errors_of(0.0) @ thin
    assert np.square(error).mean() < 0.8 * np.square(other).mean()


@pytest.mark.parametrize("own", [0.0, 1e-30, 1e100])
def test_no_covariance_makes_the_lateral_position_less_exact_than_a_centimetre(own: float) -> None:
    coefficients = errors_of(np.diag([own, 0.0, 0.0, 0.0]))
    x = np.linspace(-1, 1, 101)
    lateral = np.polynomial.chebyshev.chebval(x, coefficients.T)
    assert np.abs(lateral).max() < 0.01


@pytest.mark.parametrize("factor", [1.0, -1.0], ids=["positive", "negative"])
@pytest.mark.parametrize("first", [0, -4, 3])
@pytest.mark.parametrize("place", range(4))
def test_a_refined_signal_is_the_sum_of_both(place: int, first: int, factor: float) -> None:
    """Its raw values are all pairs of theirs, each once, in steps of the finer one."""
    signal = replace(SIGNALS[place], factor=factor * SIGNALS[place].factor, raw_min=-3, raw_max=5)
    n = FINE[place].raw_max - FINE[place].raw_min + 1
    fine = replace(FINE[place], raw_min=first, raw_max=first + n - 1, offset=0.25)
    both = refined(signal, fine)
    raw = np.arange(both.raw_min, both.raw_max + 1)
    coarse, rest = split(raw, signal, fine)
    assert len({*zip(coarse.tolist(), rest.tolist(), strict=True)}) == len(raw) == 9 * n
    for part, values in ((signal, coarse), (fine, rest)):
        assert part.raw_min <= values.min()
        assert values.max() <= part.raw_max
    error = signal.physical(coarse) + fine.physical(rest) - both.physical(raw)
    assert np.abs(error).max() <= 1e-6 * fine.factor
