"""Streets agree with closed forms and with numerical integration; scenarios match their names."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from maplines_can.simulation.scenarios import STREETS, scenario
from maplines_can.simulation.street_shapes import LANES, Street, StreetPiece, lanes
from maplines_can.values.line import Slot

PIECES = st.lists(
    st.builds(StreetPiece, st.floats(1, 80), st.floats(-0.07, 0.07), st.floats(-0.07, 0.07)),
    min_size=1,
    max_size=4,
)


@given(st.floats(5, 2000), st.sampled_from([-1, 1]), st.floats(-4, 4))
def test_constant_curvature_is_a_circle(radius: float, side: int, offset: float) -> None:
    """Nearly all of it, whatever the distance of the points; a parallel has the same centre."""
    street = Street([StreetPiece(1.9 * np.pi * radius, side / radius, side / radius)])
    s = np.array([0.0, 0.3, 1.0, 1.8, 1.9]) * np.pi * radius
    angle = s / radius
    beside = radius - side * offset

    points = street.line(s, offset)

    expected = [beside * np.sin(angle), side * (radius - beside * np.cos(angle))]
    assert np.allclose(points, np.column_stack(expected), atol=1e-9 * radius)
    assert np.allclose(street.heading(s), side * angle)


@given(PIECES, st.floats(0, 1))
def test_any_street_agrees_with_numerical_integration(
    pieces: list[StreetPiece], share: float
) -> None:
    """Kinks of the curvature included; at s = 0 it goes through the origin along x."""
    behind = share * sum(piece.length for piece in pieces)
    street = Street(pieces, behind)
    z, heading, expected = 0j, 0.0, [0j]
    for length, begin, end in pieces:

        def rates(s: float, state: Any, k: Any = (begin, (end - begin) / length)) -> Any:
            return [np.cos(state[2]), np.sin(state[2]), k[0] + k[1] * s]

        solved = solve_ivp(rates, (0, length), [z.real, z.imag, heading], rtol=1e-10, atol=1e-10)
        x, y, heading = solved.y[:, -1]
        z = x + 1j * y
        expected.append(z)
    joints = np.cumsum([0.0, *(piece.length for piece in pieces)]) - behind

    points = street.line(np.append(joints, 0.0)) @ [1, 1j]

    steps = np.diff(points[:-1]) * np.exp(1j * (-street.heading(joints[:1])))
    assert np.allclose(steps, np.diff(expected), atol=1e-6)
    assert abs(points[-1]) < 1e-9
    assert street.heading(0.0) == 0
    assert (street.begin, street.end) == pytest.approx((joints[0], joints[-1]))


def test_a_shifted_line_moves_and_ends() -> None:
    """The other lines stay as they are in ``LANES``."""
    s = np.arange(0.0, 50.0)
    shift = {Slot.EGO_LEFT: 0 * s + 0.5, Slot.EGO_RIGHT: np.where(s > 20, np.nan, 0.0)}

    lines = lanes(Street([StreetPiece(50)]), s, shift)

    assert list(lines) == list(LANES)
    assert (lines[Slot.EGO_LEFT].points[:, 1] == 2.25).all()
    assert lines[Slot.EGO_RIGHT].points[-1].tolist() == [20.0, -1.75]
    for slot in LANES.keys() - shift.keys():
        assert np.allclose(lines[slot].points[:, 1], LANES[slot][1])
        assert lines[slot].kind == LANES[slot][0]


@pytest.mark.parametrize("name", STREETS)
def test_the_car_is_in_its_lane(name: str) -> None:
    """All lines are there, at their distances from the car, and the pose is as documented."""
    example = scenario(name)
    sigma = [0.1, 0.2, np.radians(0.2)]

    assert example is STREETS[name]
    assert np.allclose(example.ego.sigma, sigma)
    assert list(example.lines) == list(LANES)
    for slot, line in example.lines.items():
        near = np.hypot(*line.resampled(0.1).points.T).min()
        if not (name == "lane-ends" and slot in (Slot.NEXT_RIGHT, Slot.EDGE_RIGHT)):
            assert near == pytest.approx(abs(LANES[slot][1]), abs=0.6 if "coarse" in name else 0.1)


def centre(name: str) -> Any:
    """Return the points of the centre of the car's lane as complex numbers."""
    return STREETS[name].lines[Slot.CENTRE].points @ [1, 1j]
