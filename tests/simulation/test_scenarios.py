"""The scenarios match their descriptions."""

from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.simulation.scenarios import parallel
from maplines_can.study.roads import curve, paper_refit, random_scenarios
from maplines_can.values.line import Slot

ROADS = list(random_scenarios(300, seed=1))


def test_random_roads_repeat() -> None:
    """A seed gives the same roads, whatever their number; another seed gives other roads."""
    again, other = list(random_scenarios(2, seed=1)), next(random_scenarios(1, seed=2))

    for a, b in zip(ROADS, again, strict=False):
        assert np.array_equal(a.lines[Slot.EGO_LEFT].points, b.lines[Slot.EGO_LEFT].points)
        assert np.array_equal(a.ego.cov, b.ego.cov)
    assert not np.array_equal(other.ego.cov, ROADS[0].ego.cov)
    assert len({road.name for road in ROADS}) == len(ROADS)


def test_random_roads_stay_within_their_ranges() -> None:
    """Curvature within 1/15, turn within 70 deg, offset, heading and sigmas as documented."""
    for road in ROADS:
        points = road.lines[Slot.EGO_LEFT].points
        step = np.diff(points, axis=0) @ [1, 1j]
        turn, spacing = np.angle(step[1:] / step[:-1]), np.abs(step).mean()
        at_car = np.searchsorted(points[:, 0], 0) - 1  # the step in which the car stands

        assert np.abs(turn).max() <= spacing / 15 * (1 + 1e-6)
        assert np.abs(turn[at_car + 1 :].sum()) <= np.radians(70)
        assert 12 <= len(points) <= 60
        assert np.abs(np.interp(0, *points.T)) <= 6 + 1e-9
        assert np.abs(np.angle(step[at_car])) <= np.radians(6) + np.abs(turn).max()
        assert 0.03 <= road.ego.sigma[:2].min() <= road.ego.sigma[:2].max() <= 1
        assert 0.05 <= np.degrees(road.ego.sigma[2]) <= 10
        assert np.abs(road.ego.correlation[0, 1]) <= 0.9
        assert np.isfinite(paper_refit(road)(road.ego.mean)).all()


def circle_centre(points: Any) -> Any:
    """Return the centre of the circle through the first, the middle and the last point."""
    a, b, c = points[[0, len(points) // 2, -1]]
    return np.linalg.solve(2 * np.array([b - a, c - a]), [b @ b - a @ a, c @ c - a @ a])


@given(st.floats(-6, 6), st.floats(-0.1, 0.1), st.floats(1 / 500, 1 / 15), st.sampled_from([-1, 1]))
def test_constant_curvature_is_a_circle(
    y_off: float, heading: float, curvature: float, side: Any
) -> None:
    """Points half a metre apart lie on the circle that touches the heading at (0, y_off)."""
    points = curve(y_off, heading, np.full(31, side * curvature), 0.5, -5.0) @ [1, 1j]
    radius = 0.25 / np.sin(0.25 * curvature)  # of the circle with chords of half a metre
    centre = 1j * y_off + 1j * side * radius * np.exp(1j * heading)

    assert np.allclose(np.abs(np.diff(points)), 0.5, rtol=1e-12)
    assert np.allclose(points[10], 1j * y_off, atol=1e-9)
    assert np.allclose(np.abs(points - centre), radius, rtol=1e-10)


@given(st.floats(-7, 7), st.floats(1 / 500, 1 / 15))
def test_a_parallel_keeps_the_distance(offset: float, curvature: float) -> None:
    """The parallel of a left turn is a left turn, nearer to its centre if it lies to the left."""
    points = curve(0.0, 0.0, np.full(41, curvature), 1.0, 0.0)
    beside, centre = parallel(points, offset), circle_centre(points)
    radius, beside_radius = (np.hypot(*(p - centre).T)[1:-1] for p in (points, beside))

    assert np.allclose(np.hypot(*(beside - points).T), abs(offset), rtol=1e-12)
    assert np.allclose(beside_radius, radius - offset)
