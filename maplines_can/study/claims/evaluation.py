"""The true distribution as a sample, and the figures of an approximation of it.

The module ``table`` defines the figures.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from ...values.gaussian import Gaussian
from ...values.line import PARAMETERS, lateral, lateral_jacobian
from ...values.mixture import GaussianMixture
from ..metrics import LATERAL_X
from .approximations import Approximation

Array = NDArray[np.float64]

#: Mass of the regions.
MASS = 0.99
#: Cells of the grid along each parameter.
BINS = 60
#: Batches of the samples, for the jackknife.
BATCHES = 10
#: Draws from each approximation, for its mass outside the true region.
DRAWS = 400_000
#: Smallest eigenvalue of the correlation matrix below which a covariance is singular.
SINGULAR = 1e-12
PAIRS = tuple(combinations(range(len(PARAMETERS)), 2))


@dataclass(frozen=True)
class ClaimRow:
    """Figures of one representation of a scenario's line; ``_se`` is a figure's standard error."""

    scenario: str
    representation: str
    wire: str  #: "before" or "after"
    false_negatives: float  #: in all four parameters
    false_negatives_se: float
    false_negatives_pairs: float  #: mean over the six pairs
    false_negatives_pairs_se: float
    false_positives: float  #: mean over the six pairs
    false_positives_se: float
    kl: float  #: [nat]
    kl_se: float
    mean_error: tuple[float, ...]  #: of l(x) at each of LATERAL_X [m]
    mean_error_se: tuple[float, ...]
    sigma_ratio: tuple[float, ...]  #: of l(x) at each of LATERAL_X
    sigma_ratio_se: tuple[float, ...]

    @property
    def coverage(self) -> float:
        """Share of the true samples inside the region, in all four parameters."""
        return 1 - self.false_negatives

    @property
    def coverage_se(self) -> float:
        """Standard error of the coverage."""
        return self.false_negatives_se


@dataclass(frozen=True, eq=False)
class TrueDistribution:
    """Samples of the true distribution, with moments and regions for the jackknife.

    Arrays of 1 + BATCHES entries have one for all samples, then one without each batch.
    """

    samples: Array  #: (n, 4)
    low: Array  #: (4,) lower ends of the grid
    width: Array  #: (4,) of its cells
    regions: NDArray[np.bool_]  #: (1 + BATCHES, 6, BINS + 2, BINS + 2); the border is outside
    moments: tuple[Gaussian, ...]  #: 1 + BATCHES
    lateral_mean: Array  #: (1 + BATCHES, X) [m]
    lateral_sigma: Array  #: (1 + BATCHES, X) [m]


def true_distribution(samples: Array) -> TrueDistribution:
    """Return the true distribution of (n, 4) samples.

    Raises:
        ValueError: fewer than 100 samples.
    """
    if not len(samples) >= 10 * BATCHES:
        raise ValueError(f"n must be {10 * BATCHES} or more, got {len(samples)!r}")
    low, high = samples.min(axis=0), samples.max(axis=0)
    width = np.where(high > low, high - low, 1.0) / BINS
    x = np.array(LATERAL_X)
    mean, line_mean = samples.mean(axis=0), lateral(samples.mean(axis=0), x)
    sums = []
    for batch in np.array_split(samples, BATCHES):
        cells = _cells(batch, low, width).clip(1, BINS)  # rounding moves no sample out
        d, e = batch - mean, lateral(batch[:, None, :], x) - line_mean
        moments = (d.sum(axis=0), d.T @ d, e.sum(axis=0), (e**2).sum(axis=0))
        sums.append((len(batch), _counts(cells), *moments))

    def left(values: tuple[Array, ...]) -> Array:
        """Return the sum of all batches, then the sums that leave out one batch."""
        parts = np.array(values, dtype=float)
        whole = parts.sum(axis=0)
        return np.concatenate([whole[None], whole - parts])

    size, counts, *totals = map(left, zip(*sums, strict=True))
    first, second, line, line2 = (
        total / size.reshape(-1, *[1] * (total.ndim - 1)) for total in totals
    )
    return TrueDistribution(
        samples=samples,
        low=low,
        width=width,
        regions=np.array([[densest(pair) for pair in count] for count in counts]),
        moments=tuple(
            Gaussian(mean + a, S - np.outer(a, a)) for a, S in zip(first, second, strict=True)
        ),
        lateral_mean=line_mean + line,
        lateral_sigma=np.sqrt((line2 - line**2).clip(0)),
    )


def evaluate_approximation(
    true: TrueDistribution,
    approximation: Approximation,
    names: tuple[str, str, str],
    seed: int = 0,
) -> ClaimRow:
    """Return all figures of one representation.

    Args:
        true: the true distribution.
        approximation: the representation.
        names: scenario, representation, and "before" or "after".
        seed: of the draws from the approximation, which are the same before and after the wire.
    """
    weights, means, covs = approximation.weights, approximation.means, approximation.covs
    if covs is None:
        negatives, pairs, positives, kl = (1.0, 0.0), (1.0, 0.0), (0.0, 0.0), (np.inf, 0.0)
    else:
        mixture = GaussianMixture(weights, tuple(map(Gaussian, means, covs)))
        draws = _draws(mixture, seed)
        negatives, pairs = _false_negatives(true.samples, mixture, draws)
        positives, kl = _false_positives(true, draws), _kl(true, mixture.overall)
    x = np.array(LATERAL_X)
    lines = lateral(means[:, None, :], x)  # (k, X)
    mean, sigma = weights @ lines, np.zeros(len(x))
    if covs is not None:
        J = lateral_jacobian(means[:, None, :], x)
        within = np.einsum("kxi,kij,kxj->kx", J, covs, J)
        sigma = np.sqrt(weights @ (within + (lines - mean) ** 2))
    ratios = sigma / true.lateral_sigma
    return ClaimRow(
        *names,
        *negatives,
        *pairs,
        *positives,
        *kl,
        mean_error=tuple((mean - true.lateral_mean[0]).tolist()),
        mean_error_se=tuple(_jackknife(true.lateral_mean).tolist()),
        sigma_ratio=tuple(ratios[0].tolist()),
        sigma_ratio_se=tuple(_jackknife(ratios).tolist()),
    )


def _jackknife(values: Array) -> Array:
    """Return the standard error from (1 + BATCHES, ...) values; 0 if one is not finite."""
    if not np.isfinite(values).all():
        return np.zeros(values.shape[1:])
    spread = ((values[1:] - values[1:].mean(axis=0)) ** 2).sum(axis=0)
    return np.asarray(np.sqrt((BATCHES - 1) / BATCHES * spread), dtype=float)


# -- false positives ------------------------------------------------------------


def _cells(samples: Array, low: Array, width: Array) -> NDArray[np.intp]:
    """Return the (n, 4) cells of samples, 1 to BINS; 0 and BINS + 1 are outside the grid."""
    return np.floor((samples - low) / width).clip(-1, BINS).astype(np.intp) + 1


def _counts(cells: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the (6, BINS + 2, BINS + 2) number of samples in each cell of each pair."""
    side = BINS + 2
    return np.array(
        [
            np.bincount(cells[:, i] * side + cells[:, j], minlength=side**2).reshape(side, side)
            for i, j in PAIRS
        ]
    )


def densest(count: Array) -> NDArray[np.bool_]:
    """Return the smallest set of cells that holds ``MASS`` of the samples."""
    order = np.argsort(-count, axis=None, kind="stable")
    total = np.cumsum(count.ravel()[order])
    chosen = np.zeros(count.size, dtype=bool)
    chosen[order[: int(np.searchsorted(total, MASS * total[-1])) + 1]] = True
    return chosen.reshape(count.shape)


def _draws(mixture: GaussianMixture, seed: int) -> Array:
    """Draw (DRAWS, 4) samples, stratified: each component gets exactly its share.

    The normal numbers are the same before and after the wire.
    """
    draws = np.random.default_rng([seed, 3]).standard_normal((DRAWS, len(PARAMETERS)))
    edges = np.round(np.cumsum(mixture.weights) * DRAWS).astype(int)
    for start, end, component in zip((0, *edges), edges, mixture.components, strict=False):
        draws[start:end] = component.mean + draws[start:end] @ component.root.T
    return draws


def _false_positives(true: TrueDistribution, draws: Array) -> tuple[float, float]:
    cells = _cells(draws, true.low, true.width)
    inside = np.einsum("bpij,pij->b", true.regions, _counts(cells)) / (len(draws) * len(PAIRS))
    out = np.zeros(len(draws))
    for region, (i, j) in zip(true.regions[0], PAIRS, strict=True):
        out += ~region[cells[:, i], cells[:, j]]
    own = out.std() / len(PAIRS) / np.sqrt(len(draws))
    return float(1 - inside[0]), float(np.hypot(own, _jackknife(inside)))


# -- false negatives and KL -----------------------------------------------------


def _false_negatives(
    samples: Array, mixture: GaussianMixture, draws: Array
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return share and standard error in four parameters, and as the mean over the pairs."""
    (four, edge_error), *pairs = (
        _outside(mixture, list(columns), samples, draws) for columns in (range(4), *PAIRS)
    )
    edge = max(edge_error, *(error for _, error in pairs))
    of_pairs = np.mean([out for out, _ in pairs], axis=0)
    return tuple(  # type: ignore[return-value]  # two of them
        (float(out.mean()), float(np.hypot(out.std() / np.sqrt(len(samples)), edge)))
        for out in (four, of_pairs)
    )


def _outside(
    mixture: GaussianMixture, columns: list[int], samples: Array, draws: Array
) -> tuple[NDArray[np.bool_], float]:
    """Return which (n, 4) samples lie outside a marginal's region, and the error of its mass.

    The edge of the region is found from the draws of the mixture, unless that is one Gaussian. If
    a component is singular, all samples are outside.
    """
    from scipy.special import gammaincinv

    marginal = mixture.marginal(columns)
    whiteners = [W for cov in marginal.covs if (W := _whitener(cov)) is not None]
    k = len(marginal.weights)
    if len(whiteners) < k:
        return np.ones(len(samples), dtype=bool), 0.0
    log_weights = np.log(marginal.weights)
    log_weights += [np.log(np.abs(W.diagonal())).sum() for W in whiteners]
    log_weights -= log_weights.max()

    def depth(points: Array) -> Array:
        """Return -2 log density of (n, 4) points, up to a constant."""
        x = np.ascontiguousarray(points.T)[columns]
        depths = [
            ((W @ (x - mean[:, None])) ** 2).sum(axis=0) - 2 * log_weight
            for mean, W, log_weight in zip(marginal.means, whiteners, log_weights, strict=True)
        ]
        least = np.min(depths, axis=0)
        total = sum(np.exp((least - each) / 2) for each in depths)
        return np.asarray(least - 2 * np.log(total), dtype=float)

    edge, edge_error = 2 * gammaincinv(len(columns) / 2, MASS), 0.0
    if k > 1:
        edge = float(np.quantile(depth(draws), MASS))
        edge_error = float(np.sqrt(MASS * (1 - MASS) / len(draws)))
    out = [depth(part) > edge for part in np.array_split(samples, BATCHES)]
    return np.concatenate(out), edge_error


def _whitener(cov: Array) -> Array | None:
    """Return the lower-triangular W with ``W cov W^T = I``, or None if cov is singular."""
    variance = cov.diagonal()
    if not (variance > 0).all():
        return None
    scale = np.sqrt(variance)
    R = cov / scale / scale[:, None]
    if np.linalg.eigvalsh(R)[0] < SINGULAR:
        return None
    return np.asarray(np.linalg.inv(np.linalg.cholesky(R)) / scale, dtype=float)


def _kl(true: TrueDistribution, other: Gaussian) -> tuple[float, float]:
    if _whitener(other.cov) is None:
        return np.inf, 0.0
    values = np.array([each.kl(other) for each in true.moments])
    return float(values[0]), float(_jackknife(values))
