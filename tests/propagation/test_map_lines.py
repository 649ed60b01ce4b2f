"""Lines of a map, seen from an uncertain pose: they hold where they are given."""

from typing import Any

import numpy as np
import pytest

from maplines_can import LeftOut, Polyline, Quadrature, Refit, SigmaPoints, Slot, map_lines
from maplines_can.simulation.scenarios import SCENARIOS, pose
from maplines_can.values.polyline import to_ego

SCENE = SCENARIOS["street-turn"]
LEFT, RIGHT = Slot.EGO_LEFT, Slot.EGO_RIGHT
#: Pose of a production car, as in the issue: 0.1 m, 0.2 m and 0.2 deg.
EGO = pose(0.1, 0.2, 0.2)
STRAIGHT = Polyline([[-100, 1.75], [200, 1.75]])


def straight_then_arc(start: float, radius: float, degrees: float, spacing: float = 1.0) -> Any:
    """Line at y = 1.75 from x = -40 to ``start``, an arc to the left, and 60 m straight on."""
    turn = np.radians(degrees)
    angle = np.linspace(0, turn, max(3, round(radius * turn / spacing) + 1))
    arc = np.array([start, 1.75]) + radius * np.column_stack([np.sin(angle), 1 - np.cos(angle)])
    ahead = np.arange(spacing, 60 + spacing / 2, spacing)[:, None]
    after = arc[-1] + ahead * [np.cos(turn), np.sin(turn)]
    x = np.arange(-40.0, start, spacing)
    return Polyline(np.vstack([np.column_stack([x, 0 * x + 1.75]), arc, after]))


def share_outside(polyline: Any, line: Any, ego: Any, n: int = 1500) -> float:
    """Largest share over x of poses from which the line of the map is beyond three sigmas.

    x are five positions from x_min to x_max.
    """
    x = np.linspace(line.x_min, line.x_max, 5)
    outside = np.zeros(5)
    for drawn in ego.sample(n, seed=5):
        u, v = to_ego(polyline.points, drawn).T
        ahead = u[: u.argmax() + 1], v[: u.argmax() + 1]
        assert ahead[0][0] <= line.x_min + 1e-9
        assert ahead[0][-1] >= line.x_max - 1e-9
        y = np.interp(x, *ahead)
        outside += np.abs(y - line.y(x)) > 3 * line.y_sigma(x)
    return float((outside / n).max())


#: Share of a Gaussian beyond three sigmas, 0.27 %, and 4 standard errors of 1500 draws.
MAX_OUTSIDE = 0.0027 + 4 * np.sqrt(0.0027 / 1500)


def given(polyline: Any, ego: Any = EGO, **settings: Any) -> Any:
    """The only line, which must be given."""
    lines = map_lines({LEFT: polyline}, ego, **settings)
    assert lines.left_out == {}
    (line,) = lines
    return line


@pytest.mark.parametrize(
    ("polyline", "least"),
    [
        pytest.param(straight_then_arc(40.0, 8.0, 90.0), 40.0, id="corner"),
        pytest.param(straight_then_arc(-20.0, 100.0, 60.0), 30.0, id="arc-of-100-m"),
        pytest.param(straight_then_arc(40.0, 60.0, 90.0), 40.0, id="bend-from-40-m"),
    ],
)
def test_item_3_a_tight_bend_does_not_pull_the_line_from_the_road(
    polyline: Any, least: float
) -> None:
    """The old fits had y_off 5.26, 1.95 and 2.21 m; the line holds as far as it is given."""
    line = given(polyline)
    x, y = polyline.points[polyline.points[:, 0].argsort()].T
    at_car = np.interp(0.0, x[x < 30], y[x < 30])

    assert abs(line.y(0.0) - at_car) <= 0.11
    assert line.x_max >= least
    assert share_outside(polyline, line, EGO) <= MAX_OUTSIDE


def test_item_3_two_points_300_m_apart_are_a_line() -> None:
    """It was refused. It is given in all of the window, with the pose error alone."""
    line = given(STRAIGHT)

    assert (line.x_min, line.x_max) == (-20.0, 80.0)
    assert line.y([-20.0, 0.0, 80.0]) == pytest.approx([1.75] * 3, abs=1e-4)
    assert line.y_sigma(0.0) == pytest.approx(0.2, rel=5e-3)
    assert share_outside(STRAIGHT, line, EGO) <= MAX_OUTSIDE


def test_item_3_a_line_that_cannot_be_given_costs_the_others_nothing() -> None:
    """Of a good line and one of two points both are given; one across has a reason."""
    refit = Refit([STRAIGHT, Polyline([[0, -1.75], [50, -1.75]])], np.zeros(3), (-20.0, 80.0))
    assert refit(np.zeros(3))[:, 0] == pytest.approx([1.75, -1.75])
    across, far = Polyline([[20, -9], [20, 9]]), Polyline([[500, 0], [600, 0]])
    alone = given(STRAIGHT)
    lines = map_lines({RIGHT: across, LEFT: STRAIGHT, Slot.CENTRE: far}, EGO)

    assert [line.slot for line in lines] == [LEFT]
    assert np.allclose(lines[0].gaussian.cov, alone.gaussian.cov, rtol=1e-9, atol=1e-18)
    assert lines.left_out == {RIGHT: LeftOut.ACROSS, Slot.CENTRE: LeftOut.NOT_IN_WINDOW}
    assert list(lines.left_out.values()) == [LeftOut.ACROSS, LeftOut.NOT_IN_WINDOW]


def test_a_transform_that_fails_at_some_poses_does_not_lose_the_line() -> None:
    """From sigma points 45 deg to the side, a line that turns by 60 deg is across the car."""
    line = straight_then_arc(10.0, 40.0, 80.0)
    wide = pose(0.1, 0.2, 12.0)
    for transform in (SigmaPoints(), Quadrature(13), None):
        lines = map_lines({LEFT: line}, wide, transform=transform)
        assert [each.slot for each in lines] == [LEFT]
        assert np.isfinite(lines[0].gaussian.cov).all()
    (several,) = map_lines({LEFT: line}, wide, components=3)
    assert len(several.mixture.weights) == 3  # type: ignore[union-attr]


def test_components_for_each_line() -> None:
    """One component is a single Gaussian, more are a mixture, with the same mean and spread."""
    lines = {slot: SCENE.lines[slot] for slot in (LEFT, RIGHT)}
    one, three = map_lines(lines, SCENE.ego, window=SCENE.window, components={LEFT: 1, RIGHT: 3})
    (single,) = map_lines({RIGHT: lines[RIGHT]}, SCENE.ego, window=SCENE.window)

    assert one.mixture is None
    assert len(three.mixture.weights) == 3  # type: ignore[union-attr]
    assert (three.x_min, three.x_max) == pytest.approx((single.x_min, single.x_max))
    assert three.gaussian.sigma[0] == pytest.approx(single.gaussian.sigma[0], rel=0.05)
