#!/usr/bin/env python3
"""Compare the propagation from pose to lines with independent computations, in all scenarios.

    refit         against a QR fit of the points, at sampled poses
    sigma points  against filterpy's unscented transform
    quadrature    against Monte Carlo, in standard errors of each mean and sigma
    mixtures      of 2 to 8 components, as a whole, against Monte Carlo: the factors by which the
                  variance in the worst direction and the worst sigma of a parameter are too small

Run it in the project's environment: python3 tools/run.py python tools/evidence_propagation.py
Each figure is the largest of all lines. The exit status is 1 if a figure exceeds its bound.
"""

import json
import sys
import warnings
from typing import Any

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform
from reporting import bar, parser_of

from maplines_can.propagation import Mixture, MonteCarlo, Quadrature, SigmaPoints
from maplines_can.simulation.scenarios import SCENARIOS
from maplines_can.study.paper_refit import paper_refit
from maplines_can.values.line import PARAMETERS

CHUNK, POSES = 50_000, 2000
#: Bounds of the differences: two in standard deviations, then two in standard errors. The others
#: are ratios; in street-turn-10deg the sampling error of a million draws is 0.03.
BOUNDS = {
    "refit": 1e-9,
    "sigma points": 1e-10,
    "mean": 5.0,
    "sigma": 5.0,
    "mixture variance": 1.06,
    "mixture sigma": 1.02,
}


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


def compare_refit(example: Any, refit: Any, poses: Any) -> Any:
    """Return the (4,) largest differences from QR, in standard deviations of the parameters.

    QR fits the points of the lines at 64 Chebyshev nodes of their ranges. The frame of the mean
    pose is that of the map, in which all lines of the scenarios begin in the direction of x. They
    are functions of x until they turn back, as the street turn does beyond 90 deg.
    """
    lines = refit(poses)  # (N, L, 4)
    nodes, reference = np.cos(np.pi * np.arange(64) / 63), []
    for line, (low, high) in zip(example.lines.values(), refit.x_range, strict=True):
        x = (low + high) / 2 + (high - low) / 2 * nodes
        advances = np.append(True, np.diff(line.points[:, 0]) > 0)
        function = line.points[np.logical_and.accumulate(advances)]
        points = np.column_stack([x, np.interp(x, *function.T)])
        reference.append(qr_refit(points, poses))
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


def compare_quadrature(
    example: Any, refit: Any, order: Any, samples: Any, seed: Any, progress: Any
) -> Any:
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
        progress.update(CHUNK)
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


def evidence(order: Any, samples: Any, seed: Any) -> Any:
    """Return the figures of each scenario by name; lists of four are for y_off, beta, c0, c1."""
    result = {}
    with bar(samples * len(SCENARIOS), unit=" draws", leave=False) as progress:
        for name, example in SCENARIOS.items():
            progress.set_description(name)
            refit = paper_refit(example)
            mean, sigma, true_cov, excluded = compare_quadrature(
                example, refit, order, samples, seed, progress
            )
            mixtures = [compare_mixture(example, refit, true_cov, k) for k in range(2, 9)]
            result[name] = {
                "lines": len(example.lines),
                "refit": compare_refit(example, refit, example.ego.sample(POSES, seed)).tolist(),
                "sigma points": compare_sigma_points(example, refit),
                "mean": mean.tolist(),
                "sigma": sigma.tolist(),
                "mixture variance": [variance for variance, _ in mixtures],
                "mixture sigma": [sigma for _, sigma in mixtures],
                "ill-posed draws": excluded / samples,
            }
    return result


def show(result: Any, order: Any, samples: Any) -> None:
    """Print the figures as a table."""
    states = "".join(f"{state:>6}" for state in PARAMETERS)
    print(
        f"refit: difference from QR at {POSES:,} poses [sigma]\n"
        "points: difference of the sigma points from filterpy [sigma]\n"
        f"mean, sigma: difference of the quadrature of order {order} from {samples:,} draws "
        "[standard errors]\n\n"
        f"{'':20}lines   refit  points {'mean':>6}{'':20}{'sigma':>5}{'':16}ill-posed\n"
        f"{'':42}{states} {states}"
    )
    for name, row in result.items():
        errors = " ".join("".join(f"{x:6.1f}" for x in row[w]) for w in ("mean", "sigma"))
        print(
            f"{name:20}{row['lines']:5} {max(row['refit']):7.1e} {row['sigma points']:7.1e}"
            f"{errors} {row['ill-posed draws']:8.1e}"
        )
    print(
        "\nmixtures: factors by which the variance in the worst direction and the worst sigma of a "
        f"parameter are too small\n\n{'':20}" + "".join(f"  {k} components" for k in range(2, 9))
    )
    for name, row in result.items():
        pairs = zip(row["mixture variance"], row["mixture sigma"], strict=True)
        print(f"{name:20}" + "".join(f"{v:8.3f} {s:5.3f}" for v, s in pairs))


def main() -> Any:
    parser = parser_of(__doc__)
    parser.add_argument("--json", action="store_true", help="print the result as JSON")
    parser.add_argument("--seed", type=int, default=1, help="seed of the draws")
    parser.add_argument(
        "--samples", type=int, default=1_000_000, help="number of draws, rounded to 50,000s"
    )
    parser.add_argument(
        "--order", type=int, default=Quadrature().order, help="order of the quadrature"
    )
    arguments = parser.parse_args()
    samples = max(1, round(arguments.samples / CHUNK)) * CHUNK
    warnings.simplefilter("ignore", UserWarning)  # the table has the share of ill-posed draws
    result = evidence(arguments.order, samples, arguments.seed)
    missed = [
        f"MISSED  {name}: the difference of {what} is {np.max(row[what]):.2g}, bound {bound:g}"
        for name, row in result.items()
        for what, bound in BOUNDS.items()
        if not np.max(row[what]) <= bound
    ]
    if arguments.json:
        print(json.dumps(result | {"missed": missed}, indent=2))
    else:
        show(result, arguments.order, samples)
        print("", *(missed or ["All bounds are met."]), sep="\n")
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
