"""Covariance of what a cubic misses: of the shape of a line, not only of its lateral position."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maplines_can import Gaussian, MapError, Polyline, Refit, Slot, map_lines
from maplines_can.consumers.path import MIN_SIGMA
from maplines_can.simulation.street_shapes import Street, StreetPiece
from maplines_can.values.line import lateral, lateral_jacobian

ORIGIN = np.zeros(3)
Curvatures = st.lists(st.floats(-0.02, 0.02), min_size=3, max_size=5)


def polyline(street: Street) -> Polyline:
    """The left line of a lane, with a point each metre."""
    return Polyline(street.line(np.arange(street.begin, street.end, 1.0), 1.75))


def true_lateral(line: Polyline, x: Any) -> Any:
    """Lateral positions of a line in the frame of the map, up to where it turns back."""
    turned = np.flatnonzero(np.diff(line.points[:, 0]) <= 0)
    return np.interp(x, *line.points[: turned[0] + 1 if len(turned) else None].T)


def second_differences(line: Polyline, refit: Refit, spacing: float) -> Any:
    """Errors of the cubic's second differences, in standard deviations of the noise alone."""
    low, high = refit.x_range
    x = np.arange(low, high - 2 * spacing, 0.5)[:, None] + spacing * np.arange(3)
    weights = np.array([1.0, -2.0, 1.0])
    mean = refit(ORIGIN)
    J = weights @ lateral_jacobian(mean, x)
    sigma = np.sqrt(np.einsum("ki,ij,kj->k", J, np.asarray(refit.noise_cov), J))
    return (true_lateral(line, x) - lateral(mean, x)) @ weights / sigma


@settings(max_examples=40, deadline=None, derandomize=True)
@given(curvatures=Curvatures)
def test_second_differences_of_clothoids_are_within_three_sigma(curvatures: list[float]) -> None:
    """97 % of them by construction within 2.9, at each spacing, without any error of the pose."""
    ends = zip([0.0, *curvatures], [*curvatures, 0.0], strict=True)
    street = Street([StreetPiece(30, 0, 0), *(StreetPiece(30, *pair) for pair in ends)], behind=30)
    line = polyline(street)
    refit = Refit(line, ORIGIN)
    for spacing in (5.0, 10.0, 20.0):
        z = second_differences(line, refit, spacing)
        if len(z):
            # The grid differs from that of the product.
            assert np.sum(np.abs(z) > 3) <= 0.04 * len(z) + 1
            assert np.sqrt(np.mean(z**2)) <= 1.1
    x = np.linspace(refit.x_range[0], refit.x_range[1], 50)
    J = lateral_jacobian(refit(ORIGIN), x)
    sigma = np.sqrt(np.einsum("ki,ij,kj->k", J, np.asarray(refit.noise_cov), J))
    assert np.all(np.abs(true_lateral(line, x) - lateral(refit(ORIGIN), x)) <= 2.3 * sigma)


def test_the_variances_are_those_of_chebyshev_polynomials_of_the_range() -> None:
    """1/5 for T_0, and 1/4, 1 and 2 times a level for the others, which numpy evaluates."""
    street = Street(
        [StreetPiece(60), StreetPiece(30, 0, 0.01), StreetPiece(60, 0.01, 0.01)], behind=30
    )
    refit = Refit(polyline(street), ORIGIN)
    x = np.linspace(refit.x_range[0], refit.x_range[1], 9)
    J = lateral_jacobian(refit(ORIGIN), x)
    cov = J @ np.asarray(refit.noise_cov) @ J.T
    T = np.polynomial.chebyshev.chebvander(np.linspace(-1, 1, 9), 3)
    shape = (T[:, 1:] * [0.25, 1.0, 2.0]) @ T[:, 1:].T
    rest = cov - float(refit.misfit) ** 2 / 5 - MIN_SIGMA**2
    level = np.trace(rest) / np.trace(shape)

    assert level >= 0.1 * float(refit.misfit) ** 2
    assert rest == pytest.approx(level * shape, abs=1e-9)


def test_the_curvature_of_a_straight_road_before_a_bend_is_within_three_sigma() -> None:
    """40 m before a clothoid to a radius of 150 m the road is straight, and its cubic is not."""
    street = Street(
        [StreetPiece(100), StreetPiece(20, 0, 1 / 150), StreetPiece(100, 1 / 150, 1 / 150)],
        behind=60,
    )
    ego = Gaussian(ORIGIN, np.diag([0.3, 0.1, 0.003]) ** 2)
    lines = {Slot.EGO_LEFT: polyline(street)}
    (line,) = map_lines(lines, ego, map_error=MapError(point_sigma=0.05))
    x = np.array([-5.0, 0.0, 5.0])
    weights = np.array([1.0, -2.0, 1.0]) / 25  # mean curvature over 10 m at the car
    J = weights @ lateral_jacobian(line.gaussian.mean, x)

    assert weights @ lateral(line.gaussian.mean, x) < -0.002
    z = weights @ lateral(line.gaussian.mean, x) / np.sqrt(J @ line.gaussian.cov @ J)
    assert abs(z) < 3


@pytest.mark.parametrize("spacing", [0.5, 1.0, 2.0])
def test_stated_errors_of_the_points_are_not_taken_for_the_shape_of_a_line(spacing: float) -> None:
    """Those of a straight line bend it by decimetres over 5 m, and its band hardly grows."""
    x = np.arange(-60.0, 120.0, spacing)
    error, rng = MapError(point_sigma=0.05), np.random.default_rng(1)
    ratios = []
    for _ in range(20):
        points = np.column_stack([x, 1.75 + 0.05 * rng.standard_normal(len(x))])
        refit = Refit(Polyline(points), ORIGIN, map_error=error)
        J = lateral_jacobian(refit(ORIGIN), refit.x_range.mean())
        sigma = np.sqrt(J @ np.asarray(refit.noise_cov) @ J)
        ratios.append(sigma / np.hypot(error.point_sigma, refit.misfit))
    assert np.median(ratios) <= 1.1


def test_errors_that_are_stated_and_not_there_change_little() -> None:
    """The shape of an exact map is covered all the same."""
    street = Street(
        [StreetPiece(100), StreetPiece(20, 0, 1 / 150), StreetPiece(100, 1 / 150, 1 / 150)],
        behind=60,
    )
    line = polyline(street)
    for error in (None, MapError(point_sigma=0.05)):
        refit = Refit(line, ORIGIN, map_error=error)
        for spacing in (5.0, 10.0, 20.0):
            assert np.mean(np.abs(second_differences(line, refit, spacing)) > 3) <= 0.04


def test_the_fit_of_the_paper_has_no_such_covariance() -> None:
    """Without a limit of the misfit, only the error of the map is added."""
    street = Street(
        [StreetPiece(60), StreetPiece(30, 0, 0.01), StreetPiece(60, 0.01, 0.01)], behind=30
    )
    assert Refit(polyline(street), ORIGIN, max_misfit=np.inf).noise_cov is None
