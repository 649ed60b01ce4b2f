"""The cubic line: its values, its uncertainty, and its transformation to another pose."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.polynomial import Polynomial
from support.strategies import covariances, mild_lines, motions

from maplines_can.core import ffi, lib
from maplines_can.model.lines import y_beyond
from maplines_can.model.matrices import Vector, matrix
from maplines_can.values.errors import IllPosedError
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import (
    RANGE_TOLERANCE,
    VAGUE_SIGMA,
    Kind,
    MapLine,
    Slot,
    Status,
    lateral,
    lateral_jacobian,
    transform_line,
)
from maplines_can.values.polyline import to_ego

X = np.linspace(-20, 80, 21)
WINDOW = (0.0, 80.0)


def polynomial(line: Any) -> Any:
    """numpy's polynomial of a line (Map Line Interface, eq. 1)."""
    y_off, beta, c0, c1 = line
    return Polynomial([y_off, np.tan(beta), c0 / 2, c1 / 6])


def line_of(polynomial: Any) -> Any:
    """The line of numpy's polynomial: its derivatives at 0."""
    y_off, slope, c0, c1 = (polynomial.deriv(k)(0.0) for k in range(4))
    return np.array([y_off, np.arctan(slope), c0, c1])


def map_line(**rest: Any) -> Any:
    return MapLine(Slot.EGO_LEFT, Gaussian(np.zeros(4), np.eye(4)), **rest)


@given(mild_lines())
def test_lateral_is_the_cubic(line: Any) -> None:
    """numpy's polynomial has the same values."""
    assert np.allclose(lateral(line, X), polynomial(line)(X), rtol=1e-13, atol=1e-13)


@given(mild_lines(), st.integers(0, 3))
def test_the_jacobian_is_the_derivative_of_lateral(line: Any, i: int) -> None:
    """l(line + h) - l(line - h) is 2 h J for each parameter."""
    h = np.zeros(4)
    h[i] = 1e-4
    difference = lateral(line + h, X) - lateral(line - h, X)

    assert np.allclose(difference / 2e-4, lateral_jacobian(line, X)[:, i], rtol=1e-7, atol=1e-9)


@given(mild_lines(), covariances(), st.floats(-200, 200) | st.integers(-200, 200))
def test_one_x_is_as_one_of_many(mean: Any, cov: Any, x: float) -> None:
    """One number is computed without arrays; the result is of the same class as that of NumPy."""
    line = MapLine(Slot.EGO_LEFT, Gaussian(mean, cov), x_min=-200.0, x_max=200.0)
    J = lateral_jacobian(mean, x)
    rounding = 1e-14 * (np.abs(J) @ np.abs(cov) @ np.abs(J))

    assert np.isclose(line.y(x), line.y([x])[0], rtol=1e-15, atol=1e-14)
    assert abs(line.y_sigma(x) ** 2 - line.y_sigma([x])[0] ** 2) <= rounding
    for value in (line.y(x), line.y_sigma(x), lateral(mean, x)):
        assert isinstance(value, np.float64)


@given(st.tuples(*[st.floats(-1, 1, width=16)] * 3), st.floats(1, 80))
def test_y_sigma_is_zero_at_a_fixed_point(root: Any, x: float) -> None:
    """A line that rotates about one of its points: rounding gives no negative variance there."""
    u = np.array([0.0, *root * np.array([0.1, 1e-3, 1e-5])])
    u[0] = -lateral_jacobian(np.zeros(4), x) @ u
    line = MapLine(Slot.EGO_LEFT, Gaussian(np.zeros(4), np.outer(u, u)), x_min=-20.0)

    assert line.y_sigma(x) <= 1e-6
    assert np.allclose(line.y_sigma(X), np.abs(lateral_jacobian(np.zeros(4), X) @ u), atol=1e-6)


RANGES = st.tuples(st.floats(-100, 100), st.floats(0, 100)).map(lambda r: (r[0], r[0] + r[1]))


@given(mild_lines(), covariances(), RANGES, st.floats(-300, 300))
def test_a_line_says_nothing_outside_of_its_range(mean: Any, cov: Any, ends: Any, x: float) -> None:
    """In it, values are those of the cubic, bit for bit; both ends are in it."""
    gaussian, places = Gaussian(mean, cov), np.array([x, *ends])
    line = MapLine(Slot.EGO_LEFT, gaussian, x_min=ends[0], x_max=ends[1])
    whole = MapLine(Slot.EGO_LEFT, gaussian, x_min=-400.0, x_max=400.0)
    is_in = ends[0] - RANGE_TOLERANCE <= x <= ends[1] + RANGE_TOLERANCE

    assert line.is_valid_at(places).tolist() == [is_in, True, True]
    for name in ("y", "y_sigma"):
        of_line, of_whole = getattr(line, name), getattr(whole, name)
        expected = np.where([is_in, True, True], of_whole(places), np.nan)
        assert np.array_equal(of_line(places), expected, equal_nan=True)
        for one, inside in zip(places.tolist(), (is_in, True, True), strict=True):
            assert np.array_equal(of_line(one), of_whole(one) if inside else np.nan, equal_nan=True)


@given(RANGES)
def test_the_ends_of_a_range_are_those_of_the_core(ends: tuple[float, float]) -> None:
    """The tolerance has a place in Python and one in C: to the last bit, they agree on the ends."""
    line = MapLine.mean_only(Slot.EGO_LEFT, np.zeros(4), x_min=ends[0], x_max=ends[1])
    of_core = ffi.new("maplines_line_t *", {"x_min": ends[0], "x_max": ends[1]})
    for end, beyond in ((ends[0] - RANGE_TOLERANCE, -np.inf), (ends[1] + RANGE_TOLERANCE, np.inf)):
        for x in (end, float(np.nextafter(end, beyond))):
            expected = x == end
            assert line.is_valid_at(x) == expected
            assert lib.maplines_is_valid_at(of_core, x) == expected


@pytest.mark.parametrize("x", [np.nan, np.inf, -np.inf, 12.002, -0.002])
def test_nothing_is_said_of_what_is_no_place(x: float) -> None:
    """Alone, and among others."""
    line = map_line(x_max=12.0)

    assert not line.is_valid_at(x)
    assert np.isnan([line.y(x), line.y_sigma(x)]).all()
    assert np.isnan(line.y([[6.0], [x]])).ravel().tolist() == [False, True]
    assert np.isnan(line.y_extrapolated(x)).all() == (not np.isfinite(x))


@given(mild_lines(), covariances(), RANGES, st.sampled_from([-1, 1]))
def test_what_is_extrapolated_is_less_certain_with_the_distance(
    mean: Any, cov: Any, ends: Any, side: int
) -> None:
    """It is that of the line in the range, goes on without a jump, and is that of the model."""
    gaussian, end = Gaussian(mean, cov), ends[(side + 1) // 2]
    line = MapLine(Slot.EGO_LEFT, gaussian, x_min=ends[0], x_max=ends[1])
    inside, d = np.linspace(ends[0], ends[1], 5), np.array([1e-6, 1e-3, 0.1, 1.0, 10.0, 100.0])
    known, beyond = line.y_extrapolated(inside), line.y_extrapolated(end + side * d)
    at_end = line.y_extrapolated(end)

    assert np.array_equal(known.value, line.y(inside))
    assert np.array_equal(known.sigma, line.y_sigma(inside))
    assert (np.diff(beyond.sigma) > 0).all()
    size = np.abs(lateral_jacobian(mean, end)) @ [1, 0.1, 0.1, 0.01]
    assert abs(beyond.value[0] - at_end.value) <= 1e-4 * size
    s = np.array([gaussian.sigma @ np.abs(lateral_jacobian(mean, abs(end) + 1.0))])
    assert abs(beyond.sigma[0] - at_end.sigma) <= 1e-4 * (1 + s)
    for k, x in enumerate((end + side * d).tolist()):
        value, sigma = y_beyond(Vector(gaussian.mean.tolist()), matrix(gaussian.cov), end, x)
        assert beyond.value[k] == pytest.approx(value, rel=1e-9, abs=1e-9)
        assert beyond.sigma[k] == pytest.approx(sigma, rel=1e-5, abs=1e-6 * (1 + s[0]))


def test_the_extrapolated_sigma_of_a_straight_line() -> None:
    """s_y + s_m d + (s_k + 1 / 15 m) d^2 / 2, of independent parameters, from both ends."""
    sigma = [0.1, 0.01, 1e-3, 1e-5]
    line = MapLine.with_sigma(Slot.EGO_LEFT, [1.75, 0, 0, 0], sigma, x_min=-10.0, x_max=10.0)
    s_y = np.linalg.norm([0.1, 0.1, 0.05, 1e-5 * 1000 / 6])
    s_m = np.linalg.norm([0.01, 0.01, 5e-4])
    s_k = np.linalg.norm([1e-3, 1e-4])
    expected = s_y + s_m * 20 + (s_k + 1 / 15) * 200

    for x in (-30.0, 30.0):
        value, found = line.y_extrapolated(x)
        assert (value, found) == pytest.approx((1.75, expected))


@given(mild_lines(), motions())
def test_points_are_fitted_by_least_squares(line: Any, motion: Any) -> None:
    """numpy's polynomial fit at the extrema of a Chebyshev polynomial is the same line."""
    x = 40 + 40 * np.cos(np.pi * np.arange(16) / 15)
    u, v = to_ego(np.column_stack([x, lateral(line, x)]), motion).T
    roots_of_weights = np.sqrt([0.62, *[1.0] * 14, 0.62])
    fitted = line_of(Polynomial.fit(u, v, 3, w=roots_of_weights).convert())

    assert np.allclose(
        lateral(transform_line(line, motion, WINDOW), X), lateral(fitted, X), atol=1e-8
    )


@pytest.mark.parametrize("degrees", [81, 90, -90, 99])
def test_a_line_nearly_perpendicular_to_the_x_axis_raises(degrees: int) -> None:
    """No cubic y(x) describes it."""
    with pytest.raises(IllPosedError, match="perpendicular to the x axis, after the displacement"):
        transform_line([1.0, 0, 0, 0], [0, 0, np.radians(degrees)], WINDOW)


@pytest.mark.parametrize("degrees", [79, 180, -101])
def test_an_oblique_or_reversed_line_is_transformed(degrees: int) -> None:
    """A straight line within 80 deg of the axis stays straight, also seen backwards."""
    y_off, beta, c0, c1 = transform_line([0.0, 0, 0, 0], [0, 0, np.radians(degrees)], WINDOW)

    assert abs(y_off) < 1e-9
    assert np.isclose(np.tan(beta), -np.tan(np.radians(degrees)), atol=1e-9)
    assert max(abs(c0), abs(c1)) < 1e-9


def test_mean_only_has_vague_sigmas() -> None:
    """Its standard deviations are VAGUE_SIGMA and its status is UNKNOWN."""
    line = MapLine.mean_only(Slot.EGO_LEFT, [1.75, 0, 0, 0], kind=Kind.DASHED, age=0.05)

    assert (line.status, line.kind, line.age) == (Status.UNKNOWN, Kind.DASHED, 0.05)
    assert np.array_equal(line.gaussian.sigma, VAGUE_SIGMA)
    assert (line.y_sigma([0, 40]) >= 1000).all()


HUGE = 10**400


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: MapLine.mean_only(0, [HUGE, 0, 0, 0]), "mean must be numbers .* about 1e400"),  # type: ignore[arg-type]
        (lambda: MapLine.mean_only(0, np.array([1j, 0, 0, 0])), "mean must be real"),  # type: ignore[arg-type]
        (lambda: MapLine.with_sigma(0, np.zeros(4), [-HUGE] * 4), "sigma must .* about -1e400"),  # type: ignore[arg-type]
        (lambda: MapLine.with_sigma(0, np.zeros(4), [1e200] * 4), r"finite \(up to 3.2e\+153\)"),  # type: ignore[arg-type]
        (
            lambda: MapLine.mean_only(0, np.zeros(4), x_max=HUGE),  # type: ignore[arg-type]
            "x_max and age must be numbers .* about 1e400",
        ),
        (lambda: MapLine.mean_only(0, np.zeros(4), age=HUGE), "age .* integer of about 1e400"),  # type: ignore[arg-type]
        (lambda: lateral(np.zeros(4), HUGE), "x must be numbers .* about 1e400"),
        (lambda: lateral(np.zeros(3), 1.0), r"parameters must have shape \(..., 4\), got \(3,\)"),
        (lambda: lateral_jacobian(1.0, 1.0), r"parameters must have shape \(..., 4\), got \(\)"),
        (
            lambda: transform_line(3.0, np.zeros(3), (0, 80)),
            r"parameters must have shape \(..., 4\)",
        ),
        (lambda: transform_line(np.zeros(4), [HUGE, 0, 0], (0, 80)), "displacement must be num"),
        (
            lambda: transform_line(np.zeros(4), np.zeros(3), (0, HUGE)),
            "window must be numbers .* 1e400",
        ),
        (lambda: transform_line(np.zeros(4), np.zeros(3), (0, 5e-324)), "no cubic"),
        (lambda: transform_line([1e308] * 4, [1e308] * 3, (-1e308, 1e308)), "no cubic"),
        (lambda: transform_line(np.zeros(4), [np.inf, 0, 0], (0, 80)), "no cubic"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_numbers_beyond_the_floats_raise(make: Any, words: str) -> None:
    """The message is short, names the argument, and no warning is issued."""
    with pytest.raises(ValueError, match=words) as error:
        make()
    assert len(str(error.value)) < 200
