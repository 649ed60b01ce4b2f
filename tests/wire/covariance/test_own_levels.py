"""Levels of what a line has of its own: they cover, and they cost what they say."""

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scene_layouts import layout_of
from strategies import covariances, mild_lines, symmetric

from maplines_can import Gaussian
from maplines_can.line import lateral, lateral_jacobian, line_of_cubic
from maplines_can.wire.covariance.own_levels import NODES, OwnLevels, bases, point_noise

LINE = layout_of("maplines-pose.dbc")
SIGNALS = tuple(LINE[name] for name in ("OwnLateral", "OwnPoints", "OwnSpacing"))
LEVELS = OwnLevels(*SIGNALS)
#: Derivatives for which the parameters are the coefficients of w^0 .. w^3 [m].
EYE = np.eye(4)[None]
RESOLUTION = np.array([2**-9, 2**-15, 2**-18, 2**-21]) ** 2 / 12


def ranges() -> Any:
    """(2,) ranges of whole metres."""
    return st.tuples(st.integers(-32, 31), st.integers(5, 90)).map(
        lambda ends: np.array([ends[0], ends[0] + ends[1]], dtype=float)
    )


@given(mild_lines(), ranges())
def test_bases_are_the_derivatives_of_a_line(mean: Any, window: Any) -> None:
    """The lateral position at x changes by w^k, for coefficients at w = (x - centre) / half."""
    J = bases(mean[None], window[None])[0]
    x = np.linspace(window[0], window[1], 5)
    w = (x - window.mean()) / (np.ptp(window) / 2)
    got = lateral_jacobian(mean, x) @ J
    assert np.allclose(got, w[:, None] ** np.arange(4), atol=1e-9)


@given(mild_lines(), ranges())
def test_bases_move_the_line_itself(mean: Any, window: Any) -> None:
    """By finite differences of the fitted cubic, through ``line_of_cubic``."""
    half, centre = np.ptp(window) / 2, window.mean()
    slopes = np.tan(mean[1]), mean[2], mean[3]
    x = centre
    q = np.array(
        [
            lateral(mean, x),
            (slopes[0] + slopes[1] * x + slopes[2] * x * x / 2) * half,
            (slopes[1] + slopes[2] * x) * half**2 / 2,
            slopes[2] * half**3 / 6,
        ]
    )
    step = 1e-5
    ends = [
        line_of_cubic(q[:, None] + sign * step * np.eye(4), np.full(4, centre), np.full(4, half))
        for sign in (1, -1)
    ]
    expected = (ends[0] - ends[1]).T / (2 * step)
    J = bases(mean[None], window[None])[0]
    assert np.allclose(J, expected, rtol=1e-4, atol=1e-4 * np.abs(J).max(axis=1, keepdims=True))


@pytest.mark.parametrize("spacing", [2**-6, 0.1, 0.5, 1.0, 2**0.5])
def test_point_noise_is_that_of_fits_through_noisy_points(spacing: float) -> None:
    """Points with independent unit errors, a polyline through them, and a cubic through that.

    The mean of the four positions of the points; 5 standard errors of 20 000 draws each.
    """
    n, rng = 20_000, np.random.default_rng(7)
    cov = np.zeros((4, 4))
    for phase in (0.0, 0.25, 0.5, 0.75):
        points = np.arange(-1 - phase * spacing, 1 + 2 * spacing, spacing)
        noise = rng.standard_normal((n, len(points)))
        at_nodes = np.array([np.interp(NODES, points, row) for row in noise])
        fitted = np.polynomial.polynomial.polyfit(NODES, at_nodes.T, 3)
        cov += np.cov(fitted) / 4
    scale = np.sqrt(cov.diagonal())
    error = np.abs(point_noise(spacing) - cov) / np.outer(scale, scale)
    assert error.max() <= 5 * (2 / (4 * n)) ** 0.5


@pytest.mark.parametrize("spacing", [0.25, 0.125])
def test_denser_points_average_more_noise(spacing: float) -> None:
    """Half the spacing at most halves the variance: the nodes at the ends use few points."""
    ratio = point_noise(spacing).diagonal() / point_noise(spacing / 2).diagonal()
    assert ((ratio > 1.3) & (ratio < 2)).all()


def test_the_raw_value_0_is_no_level() -> None:
    zero = {signal.name: np.array([0]) for signal in SIGNALS}
    assert not LEVELS.decode(zero, EYE).any()
    lateral_only = LEVELS.decode(zero | {"OwnLateral": np.array([50])}, EYE)[0]
    assert lateral_only[0, 0] == pytest.approx(4.0 ** SIGNALS[0].physical_one(50))
    assert np.count_nonzero(lateral_only) == 1
    points = LEVELS.decode(zero | {"OwnPoints": np.array([50]), "OwnSpacing": np.array([4])}, EYE)[
        0
    ]
    level, spacing = SIGNALS[1].physical_one(50), SIGNALS[2].physical_one(4)
    assert np.allclose(points, 4.0**level * point_noise(2.0**spacing), rtol=1e-12)


@given(st.data(), mild_lines(), ranges())
def test_any_bits_are_positive_semidefinite(data: Any, mean: Any, window: Any) -> None:
    raw = {s.name: np.array([data.draw(st.integers(*s.all_raw))]) for s in SIGNALS}
    J = bases(mean[None], window[None])
    decoded = LEVELS.decode(raw, J)[0]
    assert np.array_equal(decoded, decoded.T)
    inverse = np.linalg.inv(J[0])
    in_metres = inverse @ decoded @ inverse.T
    assert np.linalg.eigvalsh(in_metres)[0] >= -1e-9 * np.abs(in_metres).max()


@given(symmetric(), covariances(4, (1e-6, 1e-3, 1.0)), st.floats(-8, 2), mild_lines(), ranges())
def test_decoded_levels_cover_any_symmetric_target(
    target: Any, rest: Any, exponent: float, mean: Any, window: Any
) -> None:
    """Or the divergence is infinite; it is that from target + resolution, beside the rest."""
    J = bases(mean[None], window[None])
    scale = 10.0**exponent / max(1e-30, np.abs(target).max())
    target, rest = J @ (scale * target) @ J.swapaxes(1, 2), J @ rest @ J.swapaxes(1, 2)
    raw, kl = LEVELS.encode(target, rest, J, RESOLUTION)
    for signal in SIGNALS:
        assert signal.raw_min <= raw[signal.name][0] <= signal.raw_max
    if np.isinf(kl[0]):
        return
    inverse = np.linalg.inv(J[0])
    decoded, target, rest = (
        inverse @ matrix[0] @ inverse.T for matrix in (LEVELS.decode(raw, J), target, rest)
    )
    least = np.linalg.eigvalsh(decoded - target)[0]
    assert least >= -1e-7 * max(np.abs(target).max(), np.abs(decoded).max())
    true = rest + target + inverse @ np.diag(RESOLUTION) @ inverse.T
    true, decoded, rest = ((matrix + matrix.T) / 2 for matrix in (true, decoded, rest))
    eigenvalues = np.linalg.eigvalsh(true)
    if eigenvalues[0] > 1e-6 * eigenvalues[-1]:
        expected = Gaussian(np.zeros(4), true).kl(Gaussian(np.zeros(4), rest + decoded))
        assert kl[0] == pytest.approx(expected, rel=1e-5, abs=1e-7)


@pytest.mark.parametrize("size", [1e2, 1e20, 1e150])
def test_a_target_beyond_the_levels_is_not_covered(size: float) -> None:
    """Whatever is large: a point level, or the lateral one."""
    for i in range(4):
        target = np.zeros((1, 4, 4))
        target[0, i, i] = size
        assert LEVELS.encode(target, EYE, EYE, RESOLUTION)[1] == np.inf


def test_a_target_of_the_family_costs_at_most_a_step() -> None:
    """Covariances of levels between those of the code, beside no other part."""
    rng, n = np.random.default_rng(3), 200
    a = 2.0 ** rng.uniform(-8, -2, n)
    p = 2.0 ** rng.uniform(-8, -4.5, n)
    spacing = 2.0 ** SIGNALS[2].physical(rng.integers(0, 16, n))
    target = p[:, None, None] ** 2 * np.array([point_noise(s) for s in spacing])
    target[:, 0, 0] += a**2
    _, kl = LEVELS.encode(target, np.zeros((n, 4, 4)), np.tile(EYE, (n, 1, 1)), np.zeros(4))
    # A level that is too large by d octaves costs (2^-2d - 1) / 2 + d ln 2 in each direction.
    steps = 2 * SIGNALS[1].factor, SIGNALS[0].factor
    step = [(4.0**-d - 1) / 2 + d * np.log(2) for d in steps]
    assert kl.max() <= 3 * step[0] + step[1] + 0.02
    assert np.median(kl) <= 0.02


def test_the_levels_are_nearly_the_best_of_all() -> None:
    """Against all combinations of coarse signals that cover the target."""
    coarse = tuple(
        replace(signal, length=4, factor=factor, offset=offset, raw_min=0, raw_max=15)
        for signal, factor, offset in zip(SIGNALS, (0.5, 0.5, 0.5), (-9, -9, -7), strict=True)
    )
    code = OwnLevels(*coarse)
    raws = np.array([raw for raw in product(range(16), repeat=3) if raw[1]]).T
    every = code.decode(dict(zip((s.name for s in coarse), raws, strict=True)), EYE.repeat(3840, 0))
    rng = np.random.default_rng(5)
    rest = np.diag([1e-2, 1e-3, 1e-4, 1e-4])
    for _ in range(30):
        A = rng.standard_normal((4, 4)) * [[0.05], [0.02], [0.02], [0.01]]
        target = A @ A.T
        _, kl = code.encode(target[None], rest[None], EYE, np.zeros(4))
        covering = every[np.linalg.eigvalsh(every - target)[:, 0] >= 0]
        true = Gaussian(np.zeros(4), rest + target)
        best = min(true.kl(Gaussian(np.zeros(4), rest + cov)) for cov in covering)
        assert best - 1e-9 <= kl[0] <= 1.2 * best + 0.01
