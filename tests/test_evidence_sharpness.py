"""The evidence of sharp lines: its true lines, its points, and what it finds."""

from typing import Any

import numpy as np
import pytest
from evidence.harness import bounds_of, missed
from evidence.sampled_lines import LANE, ROADS, Row, TrueLine, of_map, on_road, thinned
from evidence.sharpness import Errors, add_beyond, falls
from hypothesis import given, settings
from hypothesis import strategies as st

from maplines_can import Gaussian, MapLine, Slot

STRAIGHT = TrueLine(-50.0, 100.0, lambda s: np.column_stack([s, 0 * s]), lambda x: 0 * x)


@pytest.mark.parametrize(("radius", "offset"), [(200.0, 1.75), (1000.0, -1.75)])
def test_an_arc_is_a_circle(radius: float, offset: float) -> None:
    """At each x, and at each point of the map."""
    line = on_road(f"arc of {radius:g} m", np.random.default_rng(0))[LANE[offset < 0]]
    x = np.linspace(-40, 80, 301)
    own = radius - offset
    assert line.y(x) == pytest.approx(radius - np.sqrt(own**2 - x**2), abs=1e-9)
    points = Row(5.0).points(line, np.random.default_rng(1)).points
    assert np.hypot(points[:, 0], points[:, 1] - radius) == pytest.approx(own, abs=1e-9)


@pytest.mark.parametrize("name", ROADS)
def test_the_points_of_a_road_are_on_its_line(name: str) -> None:
    for number in range(5):
        rng = np.random.default_rng(number)
        for line in on_road(name, rng).values():
            x, y = Row(2.0).points(line, rng).points.T
            assert line.y(x) == pytest.approx(y, abs=1e-7)
            assert np.isfinite(line.y(np.array([-20.0, 80.0]))).all()


def test_a_line_of_a_map_ends_where_it_turns_back() -> None:
    """It is seen from a car at (10, 5) that heads along y."""
    points = np.array([[9.0, -60.0], [9.0, 35.0], [30.0, 45.0], [30.0, 0.0]])
    line = of_map(points, np.array([10.0, 5.0, np.pi / 2]))
    found = line.y(np.array([-65.5, -10.0, 0.0, 30.0, 35.0, 39.0, 41.0]))
    assert found == pytest.approx([np.nan, 1.0, 1.0, 1.0, -9.5, -17.9, np.nan], nan_ok=True)
    assert line.places(np.zeros(1)) == pytest.approx(np.array([[0.0, 1.0]]))


@given(st.integers(0, 2**32 - 1), st.sampled_from([0.01, 0.05, 0.5]))
@settings(max_examples=30)
def test_points_that_are_left_out_are_within_the_tolerance(seed: int, tolerance: float) -> None:
    """Of the polyline of the others; its ends stay."""
    rng = np.random.default_rng(seed)
    points = np.column_stack([np.arange(80.0), rng.standard_normal(80).cumsum() * 0.1])
    left = thinned(points, tolerance)
    assert left[[0, -1]].tolist() == points[[0, -1]].tolist()
    assert {*map(tuple, left.tolist())} <= {*map(tuple, points.tolist())}
    step = np.diff(left, axis=0)
    own = left[:, 0].searchsorted(points[1:, 0]) - 1
    rest = points[1:] - left[own]
    across = np.abs(step[own, 0] * rest[:, 1] - step[own, 1] * rest[:, 0])
    assert (across <= tolerance * np.hypot(*step[own].T) + 1e-12).all()
    assert len(thinned(points * [1, 0], tolerance)) == 2


@pytest.mark.parametrize(("length", "rho"), [(0.0, 0.0), (5.0, np.exp(-0.4)), (20.0, np.exp(-0.1))])
def test_noise_lasts_for_its_length(length: float, rho: float) -> None:
    """Its variance is that of white noise; four standard errors."""
    n = 100_000
    line = STRAIGHT._replace(end=2.0 * n)
    errors = Row(2.0, 0.1, length).points(line, np.random.default_rng(3)).points[:, 1]
    of_variance = 4 * np.sqrt(2 / n * (1 + rho**2) / (1 - rho**2))
    assert np.var(errors) / 0.01 == pytest.approx(1.0, abs=of_variance)
    assert np.mean(errors[1:] * errors[:-1]) / 0.01 == pytest.approx(rho, abs=of_variance)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_lines_that_are_too_certain_are_found(scale: float) -> None:
    """Lines that are drawn from their Gaussian, and those of half its sigma."""
    rng, errors = np.random.default_rng(4), Errors()
    root = np.diag([0.05, 2e-3, 1e-4, 2e-6])
    for _ in range(2000):
        mean = root @ rng.standard_normal(4)
        cov = scale**2 * root @ root
        line = MapLine(Slot.EGO_LEFT, Gaussian(mean, cov), x_min=-20.0, x_max=80.0)
        errors.evaluate(line, STRAIGHT)
        errors.lines += 1
    found = errors.figures()
    assert found["ratio"] == pytest.approx(1 / scale, rel=4 / np.sqrt(2 * 2000))
    text = "\n".join(
        missed({"all closed forms": {"5 m": found}}, bounds_of("sharpness.lines", quick=True))
    )
    for words in ("beyond 3 sigma", "2nd"):
        assert (words in text) is (scale < 1)


def test_a_sigma_that_falls_is_found() -> None:
    """One of 10 lines falls by 10 % in one of two steps, at one of three places."""
    sigma = np.ones((10, 3, 3)) * [[1.0], [1.0], [2.0]]
    assert falls(sigma)["falls"] == 0
    sigma[3, 1, 2] = 0.9
    sigma[4, 0] = np.nan  # without a line
    found: Any = falls(sigma)
    assert found["falls"] == pytest.approx(1 / 57)
    assert found["largest fall"] == pytest.approx(0.1)


@pytest.mark.parametrize(("radius", "beyond"), [(5.0, False), (4.0, True)])
def test_a_turn_at_the_end_is_three_sigma_if_a_car_can_drive_it(
    radius: float, beyond: bool
) -> None:
    """2 m beyond the end of a line that is known exactly; nothing where the turn leads back."""
    line = MapLine(Slot.EGO_LEFT, Gaussian(np.zeros(4), np.zeros((4, 4))), x_max=12.0)

    def turns(x: np.ndarray) -> np.ndarray:
        with np.errstate(invalid="ignore"):
            return np.where(x <= 12.0, 0.0, radius - np.sqrt(radius**2 - (x - 12.0) ** 2))

    pairs: dict[str, list[np.ndarray]] = {}
    add_beyond(line, TrueLine(-50.0, 17.0, lambda s: s, turns), (-20.0, 80.0), pairs)
    (start, end) = ((z / s)[1] for z, s in pairs["all ends"])
    assert start == 0.0  # it goes on straight
    assert (abs(end) > 3.2) == beyond
    assert [one.shape[1] for one in pairs["cut ends"]] == [6, 2 if beyond else 3]
