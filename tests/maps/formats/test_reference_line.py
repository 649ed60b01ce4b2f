"""The reference line agrees with closed forms and with quadrature, each kind alone and chained."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad
from support.xodr_files import geometry, record, road

from maplines_can.maps.formats.opendrive.reference_line import (
    MAX_TURN,
    Array,
    Complex,
    Geometry,
    ReferenceLine,
    clothoid,
)

S = np.linspace(0.0, 100.0, 41)


def line_of(*geometries: str, length: float = 100.0) -> ReferenceLine:
    return record(road(plan="".join(geometries), length=length)).reference


def at(line: ReferenceLine, s: Array) -> tuple[Complex, Complex]:
    return line(s, s)


def by_quadrature(s: float, curvature: float, rate: float) -> complex:
    """Integrate cos and sin of the heading."""

    def heading(x: float) -> float:
        return x * (curvature + rate * x / 2)

    x = quad(lambda x: math.cos(heading(x)), 0, s, limit=500, epsabs=1e-11)[0]
    y = quad(lambda x: math.sin(heading(x)), 0, s, limit=500, epsabs=1e-11)[0]
    return complex(x, y)


@pytest.mark.parametrize("curvature", [0.01, -0.2, 1e-9, 0.0, 1.0])
def test_arc(curvature: float) -> None:
    """Points of a circle; the centre is at distance 1 / curvature on the left."""
    shape = f'<arc curvature="{curvature!r}"/>'
    position, tangent = at(line_of(geometry(shape, x=3.0, heading=1.0)), S)
    if curvature > 1e-6 or curvature < 0:
        centre = 3 + np.exp(1j) * 1j / curvature
        expected = centre - np.exp(1j * (1 + curvature * S)) * 1j / curvature
    else:
        expected = 3 + np.exp(1j) * (S + 0.5j * curvature * S**2)
    assert np.abs(position - expected).max() < 1e-9
    assert np.abs(tangent - np.exp(1j * (1 + curvature * S))).max() < 1e-12


@pytest.mark.parametrize(
    ("start", "end"),
    [
        pytest.param(0.0, 0.02, id="entering"),
        pytest.param(0.02, 0.0, id="leaving"),
        pytest.param(-0.03, 0.03, id="S-bend"),
        pytest.param(0.02, -0.01, id="unequal-S-bend"),
        pytest.param(0.02, 0.02, id="same-curvature"),
        pytest.param(0.0, 0.0, id="straight"),
        pytest.param(0.02, 0.02 + 1e-9, id="tiny-change"),
        pytest.param(0.02, math.nextafter(0.02, 1), id="least-change"),
        pytest.param(0.0, 1e-300, id="nearly-straight"),
        pytest.param(1e-160, 1e-158, id="nothing-but-rounding"),
        pytest.param(0.5, 0.5001, id="many-turns-nearly-arc"),
        pytest.param(0.0, 1.5, id="many-turns"),
    ],
)
def test_spiral(start: float, end: float) -> None:
    shape = f'<spiral curvStart="{start!r}" curvEnd="{end!r}"/>'
    position, tangent = at(line_of(geometry(shape)), S)
    rate = (end - start) / 100.0
    assert np.abs(position - [by_quadrature(s, start, rate) for s in S]).max() < 1e-8
    assert np.abs(tangent - np.exp(1j * S * (start + rate * S / 2))).max() < 1e-9


@given(
    st.floats(0.01, 500),
    st.floats(-0.5, 0.5),
    st.one_of(st.just(0.0), st.floats(-12, -1).map(lambda e: 10.0**e)),
    st.booleans(),
)
def test_clothoids_agree_with_quadrature(
    s: float, curvature: float, rate: float, sign: bool
) -> None:
    rate = rate / s * (1 if sign else -1)
    (position,), _ = clothoid(np.array([s]), np.array([curvature]), np.array([rate]))
    steps = 64 + int(s * (abs(curvature) + abs(rate) * s))
    node, weight = np.polynomial.legendre.leggauss(10)
    edge = np.linspace(0, s, steps + 1)
    x = (edge[:-1, None] + edge[1:, None]) / 2 + node * s / steps / 2
    expected = (weight * np.exp(1j * x * (curvature + rate * x / 2))).sum() * s / steps / 2
    assert abs(position - expected) < 1e-6


def test_poly3_advances_by_arc_length() -> None:
    """v(u) is as stated, and the curve up to u is as long as s."""
    b, c, d = 0.3, -0.01, 1e-4
    position, tangent = at(
        line_of(geometry(f'<poly3 a="2.0" b="{b}" c="{c}" d="{d}"/>', length=80.0), length=80.0),
        np.linspace(0, 80, 17),
    )
    u = position.real
    assert position.imag == pytest.approx(2 + b * u + c * u**2 + d * u**3, abs=1e-9)
    slope = b + 2 * c * u + 3 * d * u**2
    assert tangent == pytest.approx((1 + 1j * slope) / np.hypot(1, slope))
    for s, end in zip(np.linspace(0, 80, 17), u, strict=True):
        length = quad(lambda p: math.hypot(1, b + 2 * c * p + 3 * d * p**2), 0, end)[0]
        assert length == pytest.approx(s, abs=1e-7)


def param_poly3(u: tuple[float, ...], v: tuple[float, ...], p_range: str) -> str:
    names = [
        f'{name}{axis}="{value!r}"'
        for axis, k in (("U", u), ("V", v))
        for name, value in zip("abcd", k, strict=True)
    ]
    return f"<paramPoly3 {p_range} {' '.join(names)}/>"


def test_param_poly3_with_arc_length_range() -> None:
    """p is s; the tangent follows from the derivatives."""
    u, v = (0.0, 1.0, 1e-4, -2e-6), (0.0, 0.0, 4e-3, -1e-5)
    shape = param_poly3(u, v, 'pRange="arcLength"')
    position, tangent = at(line_of(geometry(shape, x=5.0, heading=0.7)), S)
    local = sum((u[k] + 1j * v[k]) * S**k for k in range(4))
    slope = sum(k * (u[k] + 1j * v[k]) * S ** (k - 1) for k in range(1, 4))
    assert np.abs(position - (5 + np.exp(0.7j) * local)).max() < 1e-9
    assert np.abs(tangent - np.exp(0.7j) * slope / np.abs(slope)).max() < 1e-12


def test_param_poly3_whose_start_tangent_is_not_the_heading() -> None:
    """The cross-section is normal to the curve, not to hdg."""
    shape = param_poly3((0, 0.8, 0, 0), (0, 0.6, 0, 0), 'pRange="arcLength"')
    _, tangent = at(line_of(geometry(shape, heading=0.5)), S[:1])
    assert tangent[0] == pytest.approx(np.exp(0.5j) * (0.8 + 0.6j))


def test_param_poly3_that_starts_at_rest() -> None:
    """Where the first derivative is 0, the direction is that of the second."""
    shape = param_poly3((0, 0, 30, 0), (0, 0, 40, 0), 'pRange="normalized"')
    position, tangent = at(
        line_of(geometry(shape, length=50.0), length=50.0), np.array([0.0, 25.0])
    )
    assert tangent == pytest.approx([0.6 + 0.8j] * 2)
    assert position == pytest.approx([0, 15 + 20j], abs=1e-6)


def test_a_jump_between_geometries_has_two_sides() -> None:
    """At its end, a geometry has its own value."""
    line = ReferenceLine([Geometry(0, 0, 0, 0, length=50), Geometry(50, 50, 2, 0, length=50)])
    stop = np.array([50.0])
    assert line(stop, stop - 1)[0] == pytest.approx([50])
    assert line(stop, stop)[0] == pytest.approx([50 + 2j])


def test_many_turns_are_an_error_of_the_file() -> None:
    with pytest.raises(ValueError, match=r"it turns by .* rad, more than"):
        line_of(geometry(f'<arc curvature="{MAX_TURN}"/>'))


@given(st.tuples(*[st.floats(-1, 1)] * 4), st.tuples(*[st.floats(-1, 1)] * 4), st.floats(5, 80))
def test_normalized_cubics_are_traversed_evenly(u: Any, v: Any, length: float) -> None:
    """At any share of s, the same share of the arc length, by dense points."""
    cu = (u[0], 30 + 10 * u[1], 8 * u[2], 5 * u[3])
    cv = (v[0], 10 * v[1], 8 * v[2], 5 * v[3])
    shape = param_poly3(cu, cv, 'pRange="normalized"')
    line = line_of(geometry(shape, length=length), length=length)
    p = np.linspace(0, 1, 20_001)
    dense = sum((cu[k] + 1j * cv[k]) * p**k for k in range(4))
    way = np.append(0.0, np.abs(np.diff(dense)).cumsum())
    s = np.linspace(0, length, 17)
    position, tangent = at(line, s)
    expected = np.interp(s / length * way[-1], way, p)
    assert np.abs(position - sum((cu[k] + 1j * cv[k]) * expected**k for k in range(4))).max() < 1e-5
    slope = sum(k * (cu[k] + 1j * cv[k]) * expected ** (k - 1) for k in range(1, 4))
    assert np.abs(tangent - slope / np.abs(slope)).max() < 1e-5
