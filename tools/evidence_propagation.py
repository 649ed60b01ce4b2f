#!/usr/bin/env python3
"""Show that the way from the pose to the lines is right, with figures, for all scenarios.

    refit         against a QR fit of the points, at sampled poses
    sigma points  against filterpy's unscented transform
    quadrature    against Monte Carlo draws, in sampling errors of each mean and sigma

Run it in the project's environment: python3 tools/run.py python tools/evidence_propagation.py
Each figure is the largest of all lines. Ends with a nonzero status where a bound is missed.
"""

import json
import sys
import warnings

import numpy as np
from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform
from reporting import bar, parser_of

from maplines_can.line import STATES
from maplines_can.propagation import MonteCarlo, Quadrature, Refit, SigmaPoints
from maplines_can.scenarios import SCENARIOS

CHUNK, POSES = 50_000, 2000
#: Largest differences: in standard deviations, the same, and in sampling errors.
BOUNDS = {"refit": 1e-9, "sigma points": 1e-10, "mean": 5.0, "sigma": 5.0}


def qr_refit(points, poses):
    """(N, 4) lines through (n, 2) points as seen from (N, 3) poses, by Householder QR."""
    z = (points @ [1, 1j] - (poses[:, :2] @ [1, 1j])[:, None]) * np.exp(-1j * poses[:, 2:])
    u, v = z.real, z.imag
    centre, half = (u.max(axis=1) + u.min(axis=1)) / 2, np.ptp(u, axis=1) / 2
    Q, R = np.linalg.qr(((u - centre[:, None]) / half[:, None])[..., None] ** np.arange(4))
    a, b, c, d = np.linalg.solve(R, Q.swapaxes(1, 2) @ v[..., None])[..., 0].T
    w = -centre / half
    slope = (b + w * (2 * c + w * 3 * d)) / half
    y_off, c0 = a + w * (b + w * (c + w * d)), (2 * c + 6 * d * w) / half**2
    return np.stack([y_off, np.arctan(slope), c0, 6 * d / half**3], axis=-1)


def refit_and_qr(scene, refit, poses):
    """(4,) largest differences of the parameters, in their own standard deviations."""
    lines = refit(poses)  # (N, L, 4)
    windows = [line.window(scene.ego.mean, *scene.window) for line in scene.polylines]
    witness = np.stack([qr_refit(points, poses) for points in windows], axis=1)
    difference = np.nanmax(np.abs(lines - witness), axis=0)
    return (difference / np.nanstd(lines, axis=0)).max(axis=0)


def sigma_points_and_filterpy(scene, refit):
    """Largest difference of a mean or a covariance, in standard deviations."""
    worst = 0.0
    for alpha, kappa in ((1.0, 0.0), (0.5, 0.0), (0.5, 1.5)):
        witness = MerweScaledSigmaPoints(3, alpha=alpha, beta=2.0, kappa=kappa)
        values = refit(witness.sigma_points(scene.ego.mean, scene.ego.cov))
        moments = SigmaPoints(alpha, kappa).moments(refit, scene.ego)
        for i, (mean, cov) in enumerate(zip(*moments, strict=True)):
            m, S = unscented_transform(values[:, i], witness.Wm, witness.Wc)
            sigma = np.sqrt(cov.diagonal())
            off = np.vstack([(mean - m)[None] / sigma, (cov - S) / np.outer(sigma, sigma)])
            worst = max(worst, np.abs(off).max())
    return worst


def quadrature_and_draws(scene, refit, order, samples, seed, draws):
    """(4,) and (4,) largest differences of mean and sigma in sampling errors; draws lost."""
    mean, cov = Quadrature(order).moments(refit, scene.ego)
    sigma = np.sqrt(np.diagonal(cov, axis1=-2, axis2=-1))
    sums, lost = np.zeros((4, *mean.shape)), 0
    for k in range(samples // CHUNK):
        _, values, ill_posed = MonteCarlo(CHUNK, 10_000 * seed + k).samples(refit, scene.ego)
        z = (values - mean) / sigma
        sums += [(z**power).sum(axis=0) for power in (1, 2, 3, 4)]
        lost += ill_posed
        draws.update(CHUNK)
    n = samples - lost
    m1, m2, m3, m4 = sums / n  # about the mean and in the sigmas of the quadrature
    variance = m2 - m1**2
    fourth = m4 - 4 * m1 * m3 + 6 * m1**2 * m2 - 3 * m1**4
    of_mean = np.sqrt(variance / n)
    of_sigma = np.sqrt((fourth - variance**2) / n) / (2 * np.sqrt(variance))
    off = np.abs(m1) / of_mean, np.abs(np.sqrt(variance) - 1) / of_sigma
    return off[0].max(axis=0), off[1].max(axis=0), lost


def evidence(order, samples, seed):
    """The figures of each scenario, by name; four figures are those of y_off, beta, c0, c1."""
    result = {}
    with bar(samples * len(SCENARIOS), unit=" draws", leave=False) as draws:
        for name, scene in SCENARIOS.items():
            draws.set_description(name)
            refit = Refit(scene.polylines, scene.ego.mean, scene.window)
            mean, sigma, lost = quadrature_and_draws(scene, refit, order, samples, seed, draws)
            result[name] = {
                "lines": len(scene.lines),
                "refit": refit_and_qr(scene, refit, scene.ego.sample(POSES, seed)).tolist(),
                "sigma points": sigma_points_and_filterpy(scene, refit),
                "mean": mean.tolist(),
                "sigma": sigma.tolist(),
                "ill-posed draws": lost / samples,
            }
    return result


def show(result, order, samples):
    states = "".join(f"{state:>6}" for state in STATES)
    print(
        f"refit: off QR, at {POSES:,} poses; points: sigma points off filterpy [both in sigmas]\n"
        f"mean, sigma: quadrature of order {order} off {samples:,} draws [sampling errors]\n\n"
        f"{'':20}lines   refit  points {'mean':>6}{'':20}{'sigma':>5}{'':16}ill-posed\n"
        f"{'':42}{states} {states}"
    )
    for name, row in result.items():
        off = " ".join("".join(f"{x:6.1f}" for x in row[w]) for w in ("mean", "sigma"))
        print(
            f"{name:20}{row['lines']:5} {max(row['refit']):7.1e} {row['sigma points']:7.1e}"
            f"{off} {row['ill-posed draws']:8.1e}"
        )


def main():
    parser = parser_of(__doc__)
    parser.add_argument("--json", action="store_true", help="for machines")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--samples", type=int, default=1_000_000, help="steps of 50,000")
    parser.add_argument("--order", type=int, default=Quadrature().order)
    arguments = parser.parse_args()
    samples = max(1, round(arguments.samples / CHUNK)) * CHUNK
    warnings.simplefilter("ignore", UserWarning)  # draws without a line are in the table
    result = evidence(arguments.order, samples, arguments.seed)
    missed = [
        f"MISSED  {name}: {what} is off by {np.max(row[what]):.2g}, the bound is {bound:g}"
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
