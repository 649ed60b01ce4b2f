"""Propagation from pose to lines against independent computations, in all scenarios."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform

from maplines_can.propagation import Mixture, MonteCarlo, Quadrature, SigmaPoints
from maplines_can.simulation.scenarios import SCENARIOS
from maplines_can.study.roads import paper_refit

from .harness import evidence, progress

CHUNK, POSES = 50_000, 2000


@evidence(samples=CHUNK)
def propagation(samples: int = 10**6, order: int = 13, seed: int = 1) -> dict[str, Any]:
    """Compare refit, sigma points, quadrature and mixtures with independent computations.

    Differences of the refit from QR and of the sigma points from filterpy are in standard
    deviations, those of the quadrature from Monte Carlo in standard errors. Of mixtures there are
    the factors by which the variance in the worst direction and the worst sigma of a parameter are
    too small. Each figure is the largest of all lines; lists are for y_off, beta, c0 and c1.
    """
    samples = max(1, round(samples / CHUNK)) * CHUNK
    result = {}
    for name, example in progress(SCENARIOS.items(), "scenarios", len(SCENARIOS)):
        refit = paper_refit(example)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # there is the share of ill-posed draws
            mean, sigma, true_cov, excluded = compare_quadrature(
                example, refit, order, samples, seed
            )
        mixtures = np.array([compare_mixture(example, refit, true_cov, k) for k in range(2, 9)])
        result[name] = {
            "lines": len(example.lines),
            "refit": float(
                compare_refit(refit, refit.points, example.ego.sample(POSES, seed)).max()
            ),
            "sigma points": float(compare_sigma_points(example, refit)),
            "mean": float(mean.max()),
            "sigma": float(sigma.max()),
            "mixture variance": float(mixtures[:, 0].max()),
            "mixture sigma": float(mixtures[:, 1].max()),
            "ill-posed draws": excluded / samples,
        }
    return result


def qr_refit(points: Any, poses: Any) -> Any:
    """Return the (N, 4) lines through (n, 2) points seen from (N, 3) poses, by Householder QR."""
    z = (points @ [1, 1j] - (poses[:, :2] @ [1, 1j])[:, None]) * np.exp(-1j * poses[:, 2:])
    u, v = z.real, z.imag
    centre, half = (u.max(axis=1) + u.min(axis=1)) / 2, np.ptp(u, axis=1) / 2
    Q, R = np.linalg.qr(((u - centre[:, None]) / half[:, None])[..., None] ** np.arange(4))
    a, b, c, d = np.linalg.solve(R, Q.swapaxes(1, 2) @ v[..., None])[..., 0].T
    w = -centre / half
    slope = (b + w * (2 * c + w * 3 * d)) / half
    y_off, c0 = a + w * (b + w * (c + w * d)), (2 * c + 6 * d * w) / half**2
    return np.stack([y_off, np.arctan(slope), c0, 6 * d / half**3], axis=-1)


def compare_refit(refit: Any, points: Any, poses: Any) -> Any:
    """Return the (4,) largest differences from QR, in standard deviations of the parameters.

    QR fits the (L, 64, 2) points: those of each line's cubic, and of its T_4, at Chebyshev nodes of
    its range. The frame of the mean pose is that of the map.
    """
    lines = refit(poses)  # (N, L, 4)
    reference = [qr_refit(each, poses) for each in points]
    difference = np.nanmax(np.abs(lines - np.stack(reference, axis=1)), axis=0)
    return (difference / np.nanstd(lines, axis=0)).max(axis=0)


def compare_sigma_points(example: Any, refit: Any) -> Any:
    """Return the largest difference from filterpy of a mean or covariance, in sigmas."""
    largest = 0.0
    for alpha, kappa in ((1.0, 0.0), (0.5, 0.0), (0.5, 1.5)):
        reference = MerweScaledSigmaPoints(3, alpha=alpha, beta=2.0, kappa=kappa)
        values = refit(reference.sigma_points(example.ego.mean, example.ego.cov))
        moments = SigmaPoints(alpha, kappa).moments(refit, example.ego)
        for i, (mean, cov) in enumerate(zip(*moments, strict=True)):
            m, S = unscented_transform(values[:, i], reference.Wm, reference.Wc)
            sigma = np.sqrt(cov.diagonal())
            error = np.vstack([(mean - m)[None] / sigma, (cov - S) / np.outer(sigma, sigma)])
            largest = max(largest, np.abs(error).max())
    return largest


def compare_quadrature(example: Any, refit: Any, order: int, samples: int, seed: int) -> Any:
    """Return the (4,) largest differences of mean and of sigma from Monte Carlo [standard errors].

    The (L, 4, 4) covariances of the draws and the number of excluded draws are returned, too.
    """
    mean, cov = Quadrature(order).moments(refit, example.ego)
    sigma = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    sums, products, excluded = np.zeros((4, *mean.shape)), np.zeros(cov.shape), 0
    for k in range(samples // CHUNK):
        _, values, ill_posed = MonteCarlo(CHUNK, 10_000 * seed + k).samples(refit, example.ego)
        z = (values - mean) / sigma
        sums += [(z**power).sum(axis=0) for power in (1, 2, 3, 4)]
        products += np.einsum("nli,nlj->lij", z, z)
        excluded += ill_posed
    n = samples - excluded
    m1, m2, m3, m4 = sums / n  # about the mean and in the sigmas of the quadrature
    variance = m2 - m1**2
    fourth = m4 - 4 * m1 * m3 + 6 * m1**2 * m2 - 3 * m1**4
    error_of_mean = np.sqrt(variance / n)
    error_of_sigma = np.sqrt((fourth - variance**2) / n) / (2 * np.sqrt(variance))
    mean_off = (np.abs(m1) / error_of_mean).max(axis=0)
    sigma_off = (np.abs(np.sqrt(variance) - 1) / error_of_sigma).max(axis=0)
    scale = sigma[:, :, None] * sigma[:, None, :]
    true_cov = scale * (products / n - m1[:, :, None] * m1[:, None, :])
    return mean_off, sigma_off, true_cov, excluded


def compare_mixture(example: Any, refit: Any, true_cov: Any, k: Any) -> Any:
    """Return the factors by which the mixture's worst variance and worst sigma are too small."""
    weights, means, covs = Mixture(k).moments(refit, example.ego)
    d = means - np.tensordot(weights, means, 1)
    cov = np.tensordot(weights, covs + d[..., :, None] * d[..., None, :], 1)
    sigma = np.sqrt(np.diagonal(true_cov, axis1=-2, axis2=-1))
    scale = sigma[:, :, None] * sigma[:, None, :]
    inverse = np.linalg.inv(np.linalg.cholesky(cov / scale))
    variance = np.linalg.eigvalsh(inverse @ (true_cov / scale) @ inverse.swapaxes(1, 2)).max()
    return variance, (sigma / np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))).max()
