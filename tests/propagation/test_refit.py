"""Refit against QR fits of the resampled line at each pose, and its range against the limit."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.strategies import mild_lines, motions

from maplines_can.propagation import MapError, MonteCarlo, Refit
from maplines_can.simulation.scenarios import SCENARIOS, scenario
from maplines_can.study.roads import PAPER
from maplines_can.values.errors import IllPosedError
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import Slot, lateral, lateral_jacobian
from maplines_can.values.polyline import Polyline, to_map


def qr_lines(u: Any, v: Any) -> Any:
    """(N, 4) lines through (N, n) points: Householder QR on Chebyshev polynomials.

    An independent method: the refit uses normal equations and monomials.
    """
    centre = (u.max(axis=1) + u.min(axis=1))[:, None] / 2
    half = np.ptp(u, axis=1)[:, None] / 2
    Q, R = np.linalg.qr(np.polynomial.chebyshev.chebvander((u - centre) / half, 3))
    q = np.linalg.solve(R, np.swapaxes(Q, -1, -2) @ v[..., None])[..., 0]
    slope, *curvatures = (
        np.polynomial.chebyshev.chebval(
            (-centre / half)[:, 0], np.polynomial.chebyshev.chebder(q.T, k), tensor=False
        )
        / half[:, 0] ** k
        for k in (1, 2, 3)
    )
    y_off = np.polynomial.chebyshev.chebval((-centre / half)[:, 0], q.T, tensor=False)
    return np.stack([y_off, np.arctan(slope), *curvatures], axis=-1)


def qr_refit(points: Any, poses: Any) -> Any:
    """(N, 4) lines of (n, 2) map points as seen from (N, 3) poses."""
    e_x, e_y, e_h = poses.T[..., None]
    z = (points @ [1, 1j] - (e_x + 1j * e_y)) * np.exp(-1j * e_h)
    return qr_lines(z.real, z.imag)


def refit_of(scene: Any, **rest: Any) -> Any:
    return Refit(list(scene.lines.values()), scene.ego.mean, scene.window, **rest)


@pytest.mark.parametrize("settings", [{}, PAPER], ids=["honest", "paper"])
@pytest.mark.parametrize("scene", SCENARIOS.values(), ids=SCENARIOS)
def test_all_lines_of_all_scenarios_agree_with_qr(scene: Any, settings: Any) -> None:
    """At 2000 sampled poses, within 1e-9 of each parameter's standard deviation.

    The points are those of a cubic, and of a T_4 in addition.
    """
    poses = scene.ego.sample(2000, seed=1)
    refit = refit_of(scene, **settings)
    lines = refit(poses)
    good = ~np.isnan(lines).any(axis=(1, 2))
    assert good.mean() > 0.99

    for i, (points, (low, high)) in enumerate(zip(refit.points, refit.x_range, strict=True)):
        w = np.cos(np.pi * np.arange(len(points)) / (len(points) - 1))
        assert np.allclose(np.sort(points[:, 0]), np.sort((low + high + (high - low) * w) / 2))
        of_chebyshev = np.polynomial.Chebyshev.fit(points[:, 0], points[:, 1], 5).coef
        assert of_chebyshev[4:] == pytest.approx([refit.quartic[i], 0.0], abs=1e-9)
        reference = qr_refit(to_map(points, scene.ego.mean), poses[good])
        difference = np.abs(lines[good, i] - reference).max(axis=0)
        assert (difference <= 1e-9 * reference.std(axis=0)).all()


def chords_of(line: Any, x: Any) -> float:
    """Largest distance of a cubic from its chords between points at x: step^2 / 8 times |l''|."""
    return float(np.diff(x).max() ** 2 / 8 * np.abs(line[2] + line[3] * x).max())


@given(mild_lines(), motions(degrees=180), st.integers(300, 600))
def test_a_cubic_is_recovered(line: Any, pose: Any, count: int) -> None:
    """Points on a cubic, seen from the mean pose anywhere in the map, give the cubic.

    The line between the points is as far from the cubic as its chords. The fit enlarges that by
    less than 3, the norm of a least-squares cubic at Chebyshev nodes.
    """
    x = np.linspace(-20, 80, count)
    z = (x + 1j * lateral(line, x)) * np.exp(1j * pose[2]) + pose[0] + 1j * pose[1]
    refit = Refit(Polyline(np.column_stack([z.real, z.imag])), pose, (-20.1, 80.1))

    within = 3 * chords_of(line, x) + 1e-9
    assert np.allclose(lateral(refit(pose), x), lateral(line, x), rtol=0, atol=within)
    assert np.allclose(refit.x_range, [-20, 80])
    assert refit.misfit <= within


@pytest.mark.parametrize(
    ("points", "pose", "words"),
    [
        pytest.param(
            [[500 + x, 0] for x in range(9)],
            [0, 0, 0],
            r"cannot be given: the line is not in the window; .* \(-10, 40\) m",
            id="beyond-the-window",
        ),
        pytest.param(
            [[x, 2.0] for x in range(-5, 6)],
            [0, 0, np.radians(85)],
            "the line is across the car's x axis",
            id="nearly-perpendicular",
        ),
        pytest.param([[5, 1]] * 9, [0, 0, 0], "across the car's x axis", id="one-place"),
    ],
)
def test_an_ill_posed_line_raises(points: Any, pose: Any, words: str) -> None:
    """The message has the reason and the window."""
    with pytest.raises(IllPosedError, match=words):
        Refit(Polyline(points), pose, (-10, 40))
    with pytest.raises(IllPosedError, match=words):
        Refit(
            [Polyline([[x, 0.0] for x in range(-9, 40)]).resampled(1), Polyline(points)][::-1],
            pose,
            (-10, 40),
        )


def test_ill_posed_poses_give_nan() -> None:
    """Their rows are NaN; MonteCarlo counts them and warns."""
    road = Polyline([[x, 2.0] for x in range(-20, 81, 2)])
    refit = Refit(road, np.zeros(3), (-20, 80), max_misfit=np.inf)  # without noise
    wide = Gaussian(np.zeros(3), np.diag([0.25, 0.25, np.radians(40) ** 2]))
    n = 20_000
    ill_posed = np.abs(np.cos(wide.sample(n, seed=3)[:, 2])) < 0.17  # a straight line: 80.2 deg
    lines = refit(wide.sample(n, seed=3))

    assert np.array_equal(np.isnan(lines).all(axis=1), ill_posed)
    assert np.array_equal(np.isnan(lines).any(axis=1), ill_posed)
    with pytest.warns(
        UserWarning, match=f"{ill_posed.sum()} of {n} draws are ill-posed and excluded"
    ):
        samples = MonteCarlo(n, seed=3).samples(refit, wide)
    assert samples.ill_posed == ill_posed.sum() > 0
    assert np.allclose(samples.values, lines[~ill_posed], rtol=0, atol=1e-12)
    assert np.array_equal(samples.inputs, wide.sample(n, seed=3)[~ill_posed])
    with pytest.raises(IllPosedError, match="90 deg"):
        refit([0.0, 0.0, np.pi / 2])
    assert np.isfinite(refit([0.0, 0.0, np.radians(80.1)])).all()


def errors_of_points(error: Any, points: Any, rng: Any) -> Any:
    """(k, 2) points with errors, drawn as MapError defines them, about the origin."""
    turned = np.exp(1j * error.heading_sigma * rng.standard_normal()) * (points @ [1, 1j])
    common = error.offset_sigma * rng.standard_normal(2)
    local = error.point_sigma * rng.standard_normal(points.shape)
    return np.column_stack([turned.real, turned.imag]) + common + local


@pytest.mark.parametrize(
    "error",
    [
        pytest.param(MapError(point_sigma=0.02), id="points"),
        pytest.param(MapError(offset_sigma=0.02), id="offset"),
        pytest.param(MapError(heading_sigma=1e-3), id="heading"),
        pytest.param(MapError(0.02, 0.01, 5e-4), id="all"),
    ],
)
@pytest.mark.parametrize(
    ("name", "window"),
    [("highway", (-15.0, 60.0)), ("street-turn", (-8.0, 14.0))],
    ids=["highway", "street-turn"],
)
def test_noise_cov_is_the_covariance_of_fits_to_erroneous_maps(
    name: str, window: Any, error: Any
) -> None:
    """Lateral positions in 1000 erroneous maps have it, within 5 standard errors and 3 %.

    The latter is what the linearization leaves out.
    """
    lines, pose = (
        [scenario(name).lines[slot] for slot in (Slot.EGO_LEFT, Slot.EGO_RIGHT)],
        [0.0] * 3,
    )
    refit, rng, n = Refit(lines, pose, window, error, **PAPER), np.random.default_rng(4), 1000

    def drawn() -> Any:
        wrong = [Polyline(errors_of_points(error, line.points, rng)) for line in lines]
        return Refit(wrong, pose, window, **PAPER)(pose)

    fits, x = np.array([drawn() for _ in range(n)]), np.linspace(window[0], window[1], 4)
    for i, cov in enumerate(refit.noise_cov):  # type: ignore[arg-type]
        J = lateral_jacobian(refit(pose)[i], x)
        cov = J @ cov @ J.T
        sigma = np.sqrt(cov.diagonal())
        correlation = cov / np.outer(sigma, sigma)
        difference = np.abs(np.cov((lateral(fits[:, None, i], x) / sigma).T) - correlation)
        assert (difference <= 5 * np.sqrt((1 + correlation**2) / n) + 0.03).all()
