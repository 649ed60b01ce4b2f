"""Cubics through points: the least squares are those of NumPy, and no row depends on the others."""

import numpy as np
import pytest

from maplines_can.values.cubics import Poses, cubic_fit, fit_points, points_of, refitted

RNG = np.random.default_rng(4)


@pytest.mark.parametrize("points", [4, 5, 16, 33])
@pytest.mark.parametrize("end_weight", [1.0, 0.62])
def test_the_fit_is_the_least_squares(points: int, end_weight: float) -> None:
    """On uneven points too, to 1e-13 of the values."""
    fit = fit_points(points, end_weight)
    w = fit.nodes + 0.1 * (1 - fit.nodes**2) * RNG.uniform(-1, 1, points)
    v = RNG.standard_normal(points)
    root = np.sqrt(fit.weights)
    expected = np.linalg.lstsq(root[:, None] * np.vander(w, 4, increasing=True), root * v)[0]
    got = cubic_fit(w, v, fit.weights)
    assert np.allclose(got.coefficients, expected, rtol=0, atol=1e-12)
    assert np.allclose(got.rest, v - np.polyval(expected[::-1], w), rtol=0, atol=1e-12)


def test_what_a_cubic_leaves_of_a_quartic_is_orthogonal_to_cubics() -> None:
    fit = fit_points(16, 0.62)
    moments = (fit.weights * fit.quartic) @ np.vander(fit.nodes, 4)
    assert np.abs(moments).max() < 1e-13
    assert np.abs(fit.quartic).max() == pytest.approx(1.0, abs=0.3)


def test_a_line_does_not_depend_on_the_others() -> None:
    """Not to the last bit, whatever the shape of the batch."""
    fit = fit_points(16, 0.62)
    lines = RNG.standard_normal((5, 4)) * [3, 0.1, 3e-3, 3e-5]
    ends = np.array([[-20.0, 80.0], [-5, 40], [3, 90], [-60, 0], [-20, 81]])
    poses = RNG.standard_normal((7, 3)) * [1, 1, 0.2]
    quartics = RNG.standard_normal(5)
    x, y = points_of(lines, (ends[:, 0], ends[:, 1]), quartics, fit, 1)
    together = refitted(x[:, None], y[:, None], Poses.of(poses[:, None]), fit.weights)
    for i, pose in enumerate(poses):
        for j in range(5):
            window = np.array(ends[j, 0]), np.array(ends[j, 1])
            points = points_of(lines[j], window, quartics[j], fit, 0)
            alone = refitted(*points, Poses.of(pose), fit.weights)
            assert np.array_equal(together[i, j], alone)
