"""Covariance of a fit: errors of the points, the shape that a cubic misses, what points hide."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from maplines_can import Gaussian, LeftOut, MapError, Polyline, Refit, Slot, map_lines
from maplines_can.model.cubic_ranges import MIN_SIGMA
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
            assert np.sqrt(np.mean(z**2)) <= 1.25
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
    assert rest == pytest.approx(level * shape, abs=1e-7)


# ---- errors of the points ---------------------------------------------------------------------


def sigma_of(refit: Refit, x: Any) -> Any:
    """Standard deviation of the lateral position with an exact pose."""
    J = lateral_jacobian(refit(ORIGIN), x)
    return np.sqrt(np.einsum("ki,ij,kj->k", J, np.asarray(refit.noise_cov), J))


def arc(curvature: float, spacing: float, begin: float = -60.0) -> Any:
    """Points of a line that touches the x axis at the car, as complex numbers."""
    s = np.arange(begin, 160.0, spacing)
    return np.expm1(1j * curvature * s) / (1j * curvature) if curvature else s + 0j


def polyline_of(z: Any) -> Polyline:
    return Polyline(np.column_stack([z.real, z.imag]))


def noise(rng: Any, n: int) -> Any:
    return rng.standard_normal(n) + 1j * rng.standard_normal(n)


def test_the_cubic_is_that_of_weighted_least_squares() -> None:
    """NumPy fits means in 64 cells with the weights of Chebyshev; the points are near each other.

    So chords of the cubic differ from it by less than 1 mm.
    """
    z = arc(1e-3, 1.0)
    z += 0.05 * noise(np.random.default_rng(1), len(z))
    refit = Refit(polyline_of(z), ORIGIN)
    low, high = refit.x_range
    w = ((np.arange(64 * 500) + 0.5) / (32 * 500) - 1).reshape(64, 500)
    x = (low + high) / 2 + (high - low) / 2 * w
    V = np.polynomial.chebyshev.chebvander(w, 3).mean(axis=1)
    root = np.sqrt(np.diff(-np.arccos(np.linspace(-1, 1, 65))))
    means = np.interp(x, z.real, z.imag).mean(axis=1)
    fit = np.linalg.lstsq(root[:, None] * V, root * means, rcond=None)[0]

    witness = np.polynomial.chebyshev.chebval(w[:, 0], fit)
    assert lateral(refit(ORIGIN), x[:, 0]) == pytest.approx(witness, abs=1e-3)


@pytest.mark.parametrize("curvature", [0.0, 1e-3, 5e-3])
@pytest.mark.parametrize(("sigma", "spacing"), [(0.02, 2.0), (0.05, 1.0), (0.05, 5.0), (0.2, 2.0)])
def test_white_noise_is_covered_and_not_by_far(
    curvature: float, sigma: float, spacing: float
) -> None:
    """Of 50 lines: rms of error over sigma, and the lines with any error of more than 3 sigma.

    At 1 % of them, 4 or more have a probability of 0.2 %.
    """
    rng, worst, squares = np.random.default_rng(2), [], []
    for _ in range(50):
        z = arc(curvature, spacing, -60.0 + rng.uniform(0, spacing))
        refit = Refit(polyline_of(z + sigma * noise(rng, len(z))), ORIGIN)
        x = np.linspace(refit.x_range[0], refit.x_range[1], 11)
        true = (1 - np.sqrt(1 - (curvature * x) ** 2)) / curvature if curvature else 0 * x
        error = (lateral(refit(ORIGIN), x) - true) / sigma_of(refit, x)
        worst.append(np.abs(error[1:-1]).max())
        squares.append(np.mean(error**2))

    assert 0.33 <= np.sqrt(np.mean(squares)) <= 1.1
    assert np.sum(np.array(worst) > 3) <= 3


@settings(max_examples=60, deadline=None)
@given(Curvatures, st.sampled_from([1.0, 2.0, 5.0, 10.0, 15.0, 30.0]), st.floats(0, 0.2),
       st.integers(0, 99))  # fmt: skip
def test_a_larger_stated_error_makes_no_line_more_certain(
    curvatures: list[float], spacing: float, sigma: float, seed: int
) -> None:
    """Of the same points, at 0, 20 and 40 m."""
    ends = zip([0.0, *curvatures], [*curvatures, 0.0], strict=True)
    street = Street([StreetPiece(30, 0, 0), *(StreetPiece(30, *pair) for pair in ends)], behind=30)
    z = street.line(np.arange(street.begin, street.end, spacing), 1.75) @ [1, 1j]
    line = polyline_of(z + sigma * noise(np.random.default_rng(seed), len(z)))
    ego, x = Gaussian(ORIGIN, np.diag([1e-8, 1e-8, 1e-10])), np.array([0.0, 20.0, 40.0])
    before = np.zeros(3)
    for stated in (0.0, 0.02, 0.05, 0.1, 0.2):
        for found in map_lines({Slot.EGO_LEFT: line}, ego, map_error=MapError(stated)):
            now = found.y_sigma(x)  # NaN outside of the range
            assert not (now < before * (1 - 1e-6)).any()
            before = np.fmax(now, before)


@pytest.mark.parametrize("sigma", [0.0, 0.05])
def test_a_small_step_of_the_car_moves_the_line_little(sigma: float) -> None:
    """Steps of 1 cm through 5 m of an S of clothoids: a place of the road moves by 0.05 sigma."""
    street = Street(
        [
            StreetPiece(40, 0, 1 / 200),
            StreetPiece(40, 1 / 200, -1 / 200),
            StreetPiece(40, -1 / 200, 0),
            StreetPiece(100),
        ],
        behind=60,
    )
    z = street.line(np.arange(street.begin, street.end, 2.0), 1.75) @ [1, 1j]
    line = polyline_of(z + sigma * noise(np.random.default_rng(6), len(z)))
    y = []
    for at in np.arange(0.0, 5.0, 0.01):
        refit = Refit(line, [at, 0.0, 0.0])
        x = 15.0 - at
        y.append((lateral(refit([at, 0.0, 0.0]), x), sigma_of_from(refit, [at, 0.0, 0.0], x)))
    values, sigmas = np.array(y).T

    assert np.abs(np.diff(values) / sigmas[1:]).max() <= 0.05


def sigma_of_from(refit: Refit, pose: Any, x: float) -> Any:
    J = lateral_jacobian(refit(pose), x)
    return np.sqrt(J @ np.asarray(refit.noise_cov) @ J)


# ---- few points -------------------------------------------------------------------------------


def test_two_points_are_a_straight_line_and_three_far_apart_tell_no_bend() -> None:
    ego = Gaussian(ORIGIN, np.diag([0.01, 0.01, 1e-4]) ** 2)
    straight = Polyline([[-30.0, 1.0], [90.0, 4.0]])
    for radius in (100.0, 1000.0):
        three = polyline_of(arc(1 / radius, 30.0, -30.0)[:3])
        found = map_lines({Slot.EGO_LEFT: straight, Slot.EGO_RIGHT: three}, ego)

        assert found.left_out == {Slot.EGO_RIGHT: LeftOut.FEW_POINTS}
        assert found[0].gaussian.mean == pytest.approx([1.75, np.arctan(0.025), 0, 0], abs=1e-6)
        assert sigma_of(Refit(straight, ORIGIN), np.zeros(1)) <= 0.02
