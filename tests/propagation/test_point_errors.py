"""The errors that the points of a line show."""

import numpy as np
import pytest

from maplines_can.model.stretches import Path, shown_error
from maplines_can.propagation.paths import point_errors
from maplines_can.values.polyline import Polyline


def noisy(spacing: float, sigma: float, count: int = 4000) -> Polyline:
    """An arc of 500 m with independent errors of its points in both directions."""
    angle = np.arange(count) * spacing / 500
    points = 500 * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    return Polyline(points + np.random.default_rng(5).normal(0, sigma, points.shape))


@pytest.mark.parametrize("spacing", [2.0, 5.0, 10.0])
@pytest.mark.parametrize("sigma", [0.02, 0.1])
def test_independent_errors_are_found(spacing: float, sigma: float) -> None:
    """4000 squared fourth differences are as uncertain as 1500 independent squares."""
    shown = point_errors(noisy(spacing, sigma))[2:-2]

    assert np.sqrt(np.mean(shown**2)) == pytest.approx(sigma, rel=4 / np.sqrt(2 * 1500))


def test_the_model_has_the_same_errors() -> None:
    line = noisy(3.0, 0.05, count=40)
    x, y = line.points.T.tolist()
    path = Path(x, y, line.distance.tolist())

    expected = [shown_error(path, i) for i in range(2, 38)]
    assert point_errors(line)[2:-2] ** 2 == pytest.approx(expected, rel=1e-12)


def test_points_at_one_place_show_none() -> None:
    """Their difference cannot be divided by their distance."""
    found = point_errors(Polyline([[0, 0], [1, 0], [1, 0], [1, 0], [2, 0], [3, 0]]))

    assert found[2:-2].tolist() == [0.0, 0.0]
