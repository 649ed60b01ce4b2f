"""Reference line of a road: line, arc, spiral, poly3 and paramPoly3 (ASAM OpenDRIVE, Geometry).

Points of the plane are complex numbers, x + iy. All kinds are one of two curves: a clothoid, whose
curvature is linear in s, or a pair of cubics u(p), v(p).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

#: Most heading change of one geometry [rad]; more is an error of the file.
MAX_TURN = 1000.0
#: Fresnel integrals are exact to 1e-9 m up to these ratios of curvature^2 [1] and of curvature [m]
#: to its change; beyond, their differences cancel.
_FRESNEL_RATIO, _FRESNEL_START = 1e5, 1e6
#: Changes of the curvature below this count as none [1/m^2]: their reciprocals may overflow.
_NO_RATE = 1e-100
#: Heading change [rad] over which the quadrature is exact to 1e-12.
_PANEL = 8.0
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(20)
#: Steps of the inversion of an arc length; each at least halves the bracket.
_STEPS = 60


class Parameter(Enum):
    """Meaning of the parameter p of a pair of cubics."""

    ARC_LENGTH = "p = s"
    NORMALIZED = "p runs from 0 to 1, and s in proportion to the arc length"
    ABSCISSA = "p = u, and s is the arc length (poly3)"


@dataclass(frozen=True)
class Geometry:
    """A piece of a reference line.

    Args:
        s: start [m].
        x, y: position of the start [m].
        heading: direction of the start, or of the u axis of cubics [rad].
        length: [m].
        curvature: at the start [1/m].
        curvature_rate: change of the curvature with s [1/m^2].
        u, v: coefficients of the cubics a + b p + c p^2 + d p^3 [m]; None for a clothoid.
        parameter: meaning of p.
    """

    s: float
    x: float
    y: float
    heading: float
    length: float
    curvature: float = 0.0
    curvature_rate: float = 0.0
    u: tuple[float, float, float, float] | None = None
    v: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    parameter: Parameter = Parameter.ARC_LENGTH

    @property
    def turn(self) -> float:
        """Heading change of a clothoid, at most [rad]."""
        return self.length * (abs(self.curvature) + abs(self.curvature_rate) * self.length)


class ReferenceLine:
    """Reference line of a road.

    Args:
        geometries: at least one, sorted by s.
    """

    def __init__(self, geometries: Sequence[Geometry]) -> None:
        self.starts = [g.s for g in geometries]
        self._start = np.array(self.starts)
        self.end = geometries[-1].s + geometries[-1].length
        self._origin = np.array([complex(g.x, g.y) for g in geometries])
        self._direction = np.exp(1j * np.array([g.heading for g in geometries]))
        self._clothoid = np.array([(g.curvature, g.curvature_rate) for g in geometries])
        self._is_cubic = np.array([g.u is not None for g in geometries])
        self._has_cubics = bool(self._is_cubic.any())
        zero = (0.0, 0.0, 0.0, 0.0)
        u = np.array([g.u or zero for g in geometries])
        self._cubics = u + 1j * np.array([g.v for g in geometries])  # (n, 4)
        self._by_length = np.array([g.parameter is not Parameter.ARC_LENGTH for g in geometries])
        self._scale = np.ones(len(geometries))  # arc length of the cubics for an advance of s
        for row, g in enumerate(geometries):
            if g.parameter is Parameter.NORMALIZED:
                one = np.ones(1)
                self._scale[row] = _arc_length(self._cubics[row, :, None], one)[0] / g.length
        self._highest = np.array(  # p
            [1.0 if g.parameter is Parameter.NORMALIZED else g.length for g in geometries]
        )

    def __call__(self, s: Array, at: Array) -> tuple[Complex, Complex]:
        """Return (n,) positions and (n,) unit tangents at ``s`` of the geometries at ``at``."""
        index = np.maximum(np.searchsorted(self._start, at, side="right") - 1, 0)
        ds = s - self._start[index]
        if not self._has_cubics:
            local, tangent = clothoid(ds, *self._clothoid[index].T)
        else:
            local, tangent = np.empty(len(s), complex), np.empty(len(s), complex)
            is_cubic = self._is_cubic[index]
            for mask, part in ((~is_cubic, self._on_clothoid), (is_cubic, self._on_cubics)):
                if mask.any():
                    local[mask], tangent[mask] = part(ds[mask], index[mask])
        direction = self._direction[index]
        return self._origin[index] + direction * local, direction * tangent

    def _on_clothoid(self, ds: Array, index: NDArray[np.intp]) -> tuple[Complex, Complex]:
        return clothoid(ds, *self._clothoid[index].T)

    def _on_cubics(self, ds: Array, index: NDArray[np.intp]) -> tuple[Complex, Complex]:
        c = self._cubics[index].T
        p = ds.copy()
        if (rows := self._by_length[index]).any():
            length = ds[rows] * self._scale[index[rows]]
            p[rows] = _at_arc_length(c[:, rows], length, self._highest[index[rows]])
        local = c[0] + p * (c[1] + p * (c[2] + p * c[3]))
        return local, _unit(c[1] + p * (2 * c[2] + p * 3 * c[3]), 2 * c[2] + 6 * p * c[3], c[3])


def clothoid(s: Array, curvature: Array, rate: Array) -> tuple[Complex, Complex]:
    """Return (n,) positions and (n,) unit tangents of clothoids from 0 in the direction of x.

    The position is the integral of exp(i (curvature s + rate s^2 / 2)).

    Args:
        s: (n,) arc lengths from the start [m].
        curvature: (n,) at the start [1/m].
        rate: (n,) change of the curvature with s [1/m^2].

    >>> clothoid(np.array([np.pi]), np.array([1.0]), np.array([0.0]))[0].round(12) + 0.0
    array([0.+2.j])
    """
    rate = np.where(np.abs(rate) < _NO_RATE, 0.0, rate)
    turn = s * (curvature + rate * s / 2)
    half = turn / 2
    position = s * np.sinc(half / np.pi) * np.exp(1j * half)  # chord of an arc
    if rate.any():
        by_fresnel = (rate != 0) & (curvature**2 <= _FRESNEL_RATIO * np.abs(rate))
        by_fresnel &= np.abs(curvature) <= _FRESNEL_START * np.abs(rate)
        nearly_arc = (rate != 0) & ~by_fresnel
        for mask, method in ((by_fresnel, _by_fresnel), (nearly_arc, _by_quadrature)):
            if mask.any():
                position[mask] = method(s[mask], curvature[mask], rate[mask])
    return position, np.exp(1j * turn)


def _by_fresnel(s: Array, curvature: Array, rate: Array) -> Complex:
    """Integrate by completing the square.

    curvature s + rate s^2 / 2 = sign(rate) pi/2 t^2 - curvature^2 / (2 rate)
    with t = sqrt(|rate| / pi) (s + curvature / rate).
    """
    from scipy.special import fresnel

    scale, before = np.sqrt(np.abs(rate) / np.pi), curvature / rate
    from_s, from_c = fresnel(scale * before)
    to_s, to_c = fresnel(scale * (s + before))
    integral = (to_c - from_c) + 1j * np.sign(rate) * (to_s - from_s)
    found: Complex = np.exp(-0.5j * (curvature * before)) * integral / scale
    return found


def _by_quadrature(s: Array, curvature: Array, rate: Array) -> Complex:
    """Integrate by Gauss-Legendre quadrature: exact where the Fresnel integrals cancel."""
    turn = np.abs(s) * (np.abs(curvature) + np.abs(rate * s))
    panels = int(turn.max() / _PANEL) + 1
    half = s / (2 * panels)
    position: Complex = np.zeros(len(s), dtype=np.complex128)
    for panel in range(panels):
        node = half * (_NODES[:, np.newaxis] + 2 * panel + 1)
        position += _WEIGHTS @ np.exp(1j * node * (curvature + rate * node / 2))
    return position * half


def _speed(c: Complex, p: Array) -> Array:
    return np.abs(c[1] + p * (2 * c[2] + p * 3 * c[3]))


def _arc_length(c: Complex, p: Array) -> Array:
    """Return (n,) arc lengths of the cubics c, (4, n), from 0 to p."""
    return _WEIGHTS @ _speed(c, (_NODES[:, np.newaxis] + 1) * p / 2) * p / 2


def _at_arc_length(c: Complex, length: Array, highest: Array) -> Array:
    """Return (n,) p from 0 to ``highest`` at arc lengths, by Newton's method in a bracket."""
    low, high = np.zeros_like(length), highest
    tolerance = 1e-9 + 1e-14 * length
    p = np.minimum(length / np.maximum(_speed(c, low), 1e-9), high)
    for _ in range(_STEPS):
        excess = _arc_length(c, p) - length
        if not (np.abs(excess) * (high > low) > tolerance).any():  # neither if it is NaN
            break
        high, low = np.where(excess > 0, p, high), np.where(excess > 0, low, p)
        step = p - excess / np.maximum(_speed(c, p), 1e-12)
        p = np.where((low <= step) & (step <= high), step, (low + high) / 2)
    return p


def _unit(*derivatives: Complex) -> Complex:
    """Return the direction of the first derivative that is not zero, or else that of x."""
    direction = np.ones(len(derivatives[0]), complex)
    for derivative in reversed(derivatives):
        size = np.abs(derivative)
        some = size > 1e-12
        direction[some] = derivative[some] / size[some]
    return direction
