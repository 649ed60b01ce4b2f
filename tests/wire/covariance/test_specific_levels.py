"""Levels of line-specific covariances: they cover, and they cost what they say."""

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
from maplines_can.values.cubics import line_of_cubic
from maplines_can.values.line import lateral, lateral_jacobian
from maplines_can.values.seen_lines import NODES, SHAPE, bases
from maplines_can.wire.covariance.joint import divergence, largest_ratio
from maplines_can.wire.covariance.specific_levels import (
    GOLDEN_RATIO,
    Arc,
    SpecificLevels,
    point_noise,
)

LINE = layout_of("maplines-pose.dbc")
SIGNALS = tuple(LINE[name] for name in ("OwnLateral", "OwnPoints", "OwnShape"))
LEVELS = SpecificLevels(*SIGNALS)
#: A straight line, and its derivatives with respect to the coefficients of T_0 .. T_3 [m].
STRAIGHT = np.zeros((1, 4)), np.array([[-20.0, 80.0]])
BASIS = bases(*STRAIGHT)
FLOOR = 1e-6
#: Spacings and phases of all raw values.
RAWS = np.arange(SIGNALS[2].raw_max + 1)
SPACINGS, PHASES = 2.0 ** SIGNALS[2].physical(RAWS), RAWS * GOLDEN_RATIO % 1


def straight_noise(spacing: Any, phase: Any = 0.0) -> Any:
    """(4, 4) covariance of the coefficients of T_0 .. T_3 of a straight line."""
    line = Arc.of(np.zeros(4), np.array([-20.0, 80.0]))
    return point_noise(line, np.array([spacing]), np.array([phase]))[0]


def encoded(code: Any, target: Any, rest: Any, floor: float = 0.0) -> Any:
    """Raw values and KL for (L, 4, 4) targets in coefficients of a straight line.

    The KL is infinite if the levels do not cover; it is that from rest + target + floor to rest +
    levels.
    """
    n = len(target)
    lines = [values.repeat(n, 0) for values in STRAIGHT]
    true = rest + target + floor * np.eye(4)
    covers, whole = (BASIS @ X @ BASIS.swapaxes(1, 2) for X in (rest + target, true))
    raw, covered = levels(code, covers, rest, whole, *lines)
    kl = divergence(true, rest + in_metres(code, raw))
    return raw, np.where(covered, kl, np.inf)


def levels(code: Any, target: Any, rest: Any, true: Any, means: Any, fit_ranges: Any) -> Any:
    """Raw values of levels, and whether they cover, of lines each by itself."""
    given = target, rest, true, bases(means, fit_ranges), Arc.of(means, fit_ranges)
    return code.encode(*given, code.spacings(*given))


def in_metres(code: Any, raw: Any) -> Any:
    """Decoded covariances of straight lines in the coefficients of T_0 .. T_3."""
    n = len(raw[SIGNALS[0].name])
    return code.decode(raw, STRAIGHT[0].repeat(n, 0), STRAIGHT[1].repeat(n, 0))


def ranges() -> Any:
    """(2,) ranges of whole metres."""
    return st.tuples(st.integers(-32, 31), st.integers(5, 90)).map(
        lambda ends: np.array([ends[0], ends[0] + ends[1]], dtype=float)
    )


@given(mild_lines(), ranges())
def test_bases_are_the_derivatives_of_a_line(mean: Any, window: Any) -> None:
    """The lateral position at x changes by T_k(w), at w = (x - centre) / half."""
    J = bases(mean[None], window[None])[0]
    x = np.linspace(window[0], window[1], 5)
    w = (x - window.mean()) / (np.ptp(window) / 2)
    got = lateral_jacobian(mean, x) @ J
    assert np.allclose(got, np.polynomial.chebyshev.chebvander(w, 3), atol=1e-9)


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
    step, T = (
        1e-5,
        np.array(
            [
                np.polynomial.Chebyshev.basis(k)
                .convert(kind=np.polynomial.Polynomial)
                .coef.tolist()
                + [0] * (3 - k)
                for k in range(4)
            ]
        ).T,
    )
    ends = [
        line_of_cubic(q[:, None] + sign * step * T, np.full(4, centre), np.full(4, half))
        for sign in (1, -1)
    ]
    expected = (ends[0] - ends[1]).T / (2 * step)
    J = bases(mean[None], window[None])[0]
    assert np.allclose(J, expected, rtol=1e-4, atol=1e-4 * np.abs(J).max(axis=1, keepdims=True))


@pytest.mark.parametrize("phase", [0.0, 0.4])
@pytest.mark.parametrize("spacing", [2**-5, 0.1, 0.5, 0.9, 2**0.5])
def test_point_noise_is_that_of_fits_through_noisy_points(spacing: float, phase: float) -> None:
    """Points of a sloping line with independent unit errors across it, a polyline, and its fit.

    5 standard errors of 20 000 draws.
    """
    n, rng, slope = 20_000, np.random.default_rng(7), 0.5
    line, ends = np.array([1.0, np.arctan(slope), 0.0, 0.0]), np.array([-20.0, 80.0])
    points = np.arange(-1 - phase * spacing, 1 + 2 * spacing, spacing)
    # An error e across a line moves it by e / cos(slope angle) along y.
    noise = rng.standard_normal((n, len(points))) * np.hypot(1, slope)
    at_nodes = np.array([np.interp(NODES, points, row) for row in noise])
    fitted = np.polynomial.chebyshev.chebfit(NODES, at_nodes.T, 3)
    cov = np.cov(fitted)
    scale = np.sqrt(cov.diagonal())
    got = point_noise(Arc.of(line, ends), np.array([spacing]), np.array([phase]))[0]
    assert (np.abs(got - cov) / np.outer(scale, scale)).max() <= 5 * (2 / n) ** 0.5


def test_points_are_at_equal_distances_along_a_bend() -> None:
    """By the arc length of a fine polyline, with the errors across the line at its points."""
    line, ends = np.array([0.0, 0.0, 1 / 60, 0.0]), np.array([0.0, 50.0])
    spacing, phase = 0.3, 0.25
    x = np.linspace(0.0, 50.0, 200_001)
    y, slope = x**2 / 120, x / 60
    along = np.append(0.0, np.hypot(np.diff(x), np.diff(y)).cumsum())
    nodes = np.interp(25 + 25 * NODES, x, 2 * along / along[-1])
    points = np.arange(-phase * spacing, 2 + 2 * spacing, spacing)
    W = np.array([np.interp(nodes, points, row) for row in np.eye(len(points))]).T
    W *= np.hypot(1, np.interp(25 + 25 * NODES, x, slope))[:, None]
    fitted = np.linalg.pinv(np.polynomial.chebyshev.chebvander(NODES, 3)) @ W
    got = point_noise(Arc.of(line, ends), np.array([spacing]), np.array([phase]))[0]
    expected = fitted @ fitted.T
    assert np.allclose(got, expected, atol=1e-3 * expected.max())


@pytest.mark.parametrize("spacing", [0.25, 0.125])
def test_denser_points_average_more_noise(spacing: float) -> None:
    """Half the spacing at most halves the variance: the nodes at the ends use few points."""
    ratio = straight_noise(spacing).diagonal() / straight_noise(spacing / 2).diagonal()
    assert ((ratio > 1.2) & (ratio < 2.1)).all()


def test_there_is_a_level_near_any_spacing_and_phase() -> None:
    """Within 10 % of the spacing and an eighth of it, but at both ends."""
    for spacing in 2.0 ** np.arange(-4.5, 1.0, 0.1):
        for phase in np.arange(0, 1, 0.05):
            near = np.abs(np.log(SPACINGS / spacing)) < 0.1
            turned = np.abs((PHASES - phase + 0.5) % 1 - 0.5)
            assert turned[near].min() <= 0.125


def test_the_raw_value_0_is_no_level() -> None:
    zero = {signal.name: np.array([0]) for signal in SIGNALS}
    assert not LEVELS.decode(zero, *STRAIGHT).any()
    lateral_only = LEVELS.decode(zero | {"OwnLateral": np.array([50])}, *STRAIGHT)[0]
    assert lateral_only[0, 0] == pytest.approx(4.0 ** SIGNALS[0].physical_one(50))
    assert np.count_nonzero(lateral_only) == 1
    shape_only = in_metres(LEVELS, zero | {"OwnShape": np.array([100])})[0]
    assert np.allclose(shape_only, 4.0 ** (100 / 25 - 10) * np.diag(SHAPE), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("k", [0, 100, 101, 255])
def test_points_and_the_shape_beside_them_are_as_the_dbc_says(k: int) -> None:
    """Raw values 100 and 101 have the remainders 4 and 5, the others 0 and 3."""
    raw = {"OwnLateral": np.array([0]), "OwnPoints": np.array([20]), "OwnShape": np.array([k])}
    r = {0: 0.0, 4: 0.5 * 1.8**3, 5: 0.5 * 1.8**4, 3: 0.5 * 1.8**2}[k % 6]
    expected = straight_noise(SPACINGS[k], PHASES[k]) + r**2 * SPACINGS[k] * np.diag(SHAPE)
    expected *= 4.0 ** SIGNALS[1].physical_one(20)
    assert np.allclose(in_metres(LEVELS, raw)[0], expected, rtol=1e-9, atol=1e-15)


@given(st.data(), mild_lines(), ranges())
def test_any_bits_are_positive_semidefinite(data: Any, mean: Any, window: Any) -> None:
    raw = {s.name: np.array([data.draw(st.integers(*s.all_raw))]) for s in SIGNALS}
    decoded = LEVELS.decode(raw, mean[None], window[None])[0]
    assert np.array_equal(decoded, decoded.T)
    assert np.linalg.eigvalsh(decoded)[0] >= -1e-13 * decoded.max()


@given(symmetric(), covariances(4, (1e-6, 1e-3, 1.0)), st.floats(-8, 2), mild_lines(), ranges())
def test_decoded_levels_cover_any_symmetric_target(
    target: Any, rest: Any, exponent: float, mean: Any, window: Any
) -> None:
    """Together with what is common to all levels, or the encoder says that they do not."""
    line = mean[None], window[None]
    J = bases(*line)
    target = 10.0**exponent / max(1e-30, np.abs(target).max()) * target
    true = rest + target + FLOOR * np.eye(4)
    covers, whole = (J @ X @ J.swapaxes(1, 2) for X in (rest + target, true))
    raw, covered = levels(LEVELS, covers, rest[None], whole, *line)
    for signal in SIGNALS:
        assert signal.raw_min <= raw[signal.name][0] <= signal.raw_max
    if not covered[0]:
        return
    decoded = LEVELS.decode(raw, *line)[0]
    least = np.linalg.eigvalsh(decoded - target)[0]
    assert least >= -1e-7 * max(np.abs(target).max(), np.abs(decoded).max(), np.abs(rest).max())


@given(covariances(4), covariances(4))
def test_the_divergence_is_that_of_gaussians(true: Any, decoded: Any) -> None:
    """In one array with another pair, against the method of ``Gaussian``."""
    pair = [matrix + 1e-3 * np.abs(matrix).max() * np.eye(4) for matrix in (true, decoded)]
    pair = [matrix + FLOOR * np.eye(4) for matrix in pair]
    expected = Gaussian(np.zeros(4), pair[0]).kl(Gaussian(np.zeros(4), pair[1]))
    both = divergence(*(np.array([matrix, np.eye(4)]) for matrix in pair))
    assert both[0] == pytest.approx(expected, rel=1e-5, abs=1e-7)
    assert both[1] == 0


def test_the_divergence_is_infinite_if_a_determinant_is_not_positive() -> None:
    one, bad = np.eye(4), np.diag([1.0, 1, 1, -1])
    assert divergence(one, bad) == divergence(bad, one) == divergence(one, 0 * one) == np.inf


def test_the_largest_ratio_is_that_of_lateral_position_or_direction() -> None:
    """T_3 has the largest share of the slope at w = 0; T_0 that of the position near 3/4."""
    more = np.diag([1.0, 1, 1, 2])
    assert largest_ratio(more, np.eye(4)) == pytest.approx((1 + 2 * 9) / (1 + 9))
    squares = np.polynomial.chebyshev.chebvander(np.array([0.75]), 3) ** 2
    expected = 1 + 4 / squares.sum()
    assert largest_ratio(np.diag([5.0, 1, 1, 1]), np.eye(4)) == pytest.approx(expected)
    assert largest_ratio(2 * more, more) == pytest.approx(2.0)


@pytest.mark.parametrize("size", [1e2, 1e20, 1e150])
def test_a_target_beyond_the_levels_is_not_covered(size: float) -> None:
    """Whatever is large: a point level, or the lateral one."""
    for i in range(4):
        target = np.zeros((1, 4, 4))
        target[0, i, i] = size
        assert encoded(LEVELS, target, np.eye(4)[None], FLOOR)[1] == np.inf


@pytest.mark.parametrize("with_points", [True, False])
def test_a_target_of_the_family_costs_at_most_a_step(with_points: bool) -> None:
    """Covariances of levels between those of the code, beside no other part."""
    rng, n = np.random.default_rng(3), 50
    a = 2.0 ** rng.uniform(-6, -2.5, n)
    level = 2.0 ** rng.uniform(-7, -4, n)
    chosen = rng.integers(0, 200, n)
    family = LEVELS.noise(Arc.of(*STRAIGHT), chosen[None])[0]
    if not with_points:
        family = np.diag(SHAPE) + np.zeros((n, 1, 1))
    target = level[:, None, None] ** 2 * family
    target[:, 0, 0] += a**2
    raw, kl = encoded(LEVELS, target, np.zeros((n, 4, 4)))
    ratio = largest_ratio(in_metres(LEVELS, raw), target)
    # A level that is too large by d octaves costs (2^-2d - 1) / 2 + d ln 2 in each direction.
    steps = 2 * SIGNALS[1].factor if with_points else 0.04, SIGNALS[0].factor
    step = [(4.0**-d - 1) / 2 + d * np.log(2) for d in steps]
    assert (kl + np.log(ratio)).max() <= 3 * step[0] + step[1] + np.log(4) * max(steps) + 0.02
    assert np.median(kl) <= 0.02


def test_the_levels_are_nearly_the_best_of_all() -> None:
    """Against all combinations of coarse signals that cover the target."""
    coarse = tuple(
        replace(signal, length=4, factor=factor, offset=offset, raw_min=0, raw_max=15)
        for signal, factor, offset in zip(SIGNALS, (0.5, 0.5, 0.4), (-9, -9, -5), strict=True)
    )
    code = SpecificLevels(*coarse)
    raws = np.array([raw for raw in product(range(16), repeat=3) if raw[1]]).T
    a, p = (
        np.where(raw > 0, 2.0 ** s.physical(raw), 0.0)
        for s, raw in zip(coarse, raws[:2], strict=False)
    )
    every = p[:, None, None] ** 2 * code.noise(Arc.of(*STRAIGHT), raws[2][None])[0]
    every[:, 0, 0] += a**2
    rng = np.random.default_rng(5)
    rest = np.diag([1e-2, 1e-3, 1e-4, 1e-4])
    for _ in range(30):
        A = rng.standard_normal((4, 4)) * [[0.05], [0.02], [0.02], [0.01]]
        target = A @ A.T
        raw, kl = encoded(code, target[None], rest[None])
        covering = every[np.linalg.eigvalsh(every - target)[:, 0] >= 0]
        ratio = np.log(largest_ratio(rest + covering, rest + target))
        best = (divergence(rest + target, rest + covering) + ratio).min()
        got = kl[0] + np.log(largest_ratio(rest + in_metres(code, raw)[0], rest + target))
        assert best - 1e-9 <= got <= 1.2 * best + 0.01


def test_the_spacings_of_a_nearly_straight_line_are_as_good_as_any() -> None:
    """Against the cost with all of them, of targets near those of levels."""
    rng, worse = np.random.default_rng(8), []
    for _ in range(40):
        ends = np.array([rng.uniform(-30, 0), rng.uniform(20, 90)])
        bend = rng.normal(0, 0.1 / ends[1])
        line = np.array([[0.0, rng.normal(0, 0.1), bend, 0.0]]), ends[None]
        arc, J = Arc.of(*line), bases(*line)
        assert np.ptp(arc.stretch) < 0.1
        family = LEVELS.noise(arc, rng.integers(0, 256, (1, 1)))[:, 0]
        mixed = np.diag(rng.uniform(0.5, 2, 4))
        target = 4.0 ** rng.uniform(-7, -4) * mixed @ family @ mixed
        true = target + FLOOR * np.eye(4)
        given = J @ target @ J.mT, np.zeros((1, 4, 4)), J @ true @ J.mT, J, arc
        costs = []
        for spacings in (LEVELS.spacings(*given), RAWS[None]):
            raw, covered = LEVELS.encode(*given, spacings)
            decoded = LEVELS.decode(raw, *line)
            cost = divergence(true, decoded) + np.log(largest_ratio(decoded, true))
            costs.append(np.where(covered, cost, np.inf)[0])
        assert costs[1] <= costs[0] < np.inf
        worse.append(costs[0] - costs[1])
    assert np.mean(worse) < 0.01


@pytest.mark.parametrize("bits", [1, 8, 9, 12, 16])
def test_a_long_signal_is_searched_in_steps(bits: int) -> None:
    """In few of them, with all ratios of the shape to the points."""
    raw_max = 2**bits - 1
    shape = replace(SIGNALS[2], length=bits, raw_min=0, raw_max=raw_max, factor=5 / 2**bits)
    searched = SpecificLevels(SIGNALS[0], SIGNALS[1], shape).searched
    assert min(100, 2**bits) <= len(searched) <= 256
    assert set(searched % 6) == set(range(min(6, 2**bits)))
    assert raw_max - searched[-1] < searched[1] - searched[0]
