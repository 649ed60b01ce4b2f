"""The true distribution as a sample, and how well something stands for it.

Definitions are those of ``study.truth``.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaincinv

from ...gaussian import Gaussian
from ...line import STATES, lateral, lateral_jacobian
from ..metrics import LATERAL_X
from .approximations import Approximation

__all__ = ["Row", "Truth", "judged", "truth_of"]

Array = NDArray[np.float64]

#: Mass of the regions.
MASS = 0.99
#: Cells of the grid along each parameter.
BINS = 60
#: Batches of the samples, for sampling errors.
BATCHES = 10
#: Draws of each approximation, for its mass outside the true region.
DRAWS = 400_000
#: Below this smallest eigenvalue of its correlation matrix a covariance is singular.
SINGULAR = 1e-12
PAIRS = tuple(combinations(range(len(STATES)), 2))


@dataclass(frozen=True)
class Row:
    """One representation of one scene's line; ``_se`` is the standard error of a figure."""

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
    coverage: float  #: in all four parameters
    coverage_se: float


@dataclass(frozen=True, eq=False)
class Truth:
    """The true distribution: samples, their moments and regions, and the same less each batch."""

    samples: Array  #: (n, 4)
    low: Array  #: (4,) where the grid begins
    width: Array  #: (4,) of its cells
    regions: NDArray[np.bool_]  #: (1 + BATCHES, 6, BINS + 2, BINS + 2); the border is outside
    moments: tuple[Gaussian, ...]  #: 1 + BATCHES
    lateral_mean: Array  #: (1 + BATCHES, X) [m]
    lateral_sigma: Array  #: (1 + BATCHES, X) [m]


def truth_of(samples: Array) -> Truth:
    """The true distribution from (n, 4) samples.

    Raises:
        ValueError: fewer than 100 samples.
    """
    if not len(samples) >= 10 * BATCHES:
        raise ValueError(f"n must be {10 * BATCHES} or more, got {len(samples)!r}")
    low, high = samples.min(axis=0), samples.max(axis=0)
    width = np.where(high > low, high - low, 1.0) / BINS
    x = np.array(LATERAL_X)
    mean, line_mean = samples.mean(axis=0), lateral(samples.mean(axis=0), x)
    sizes, counts, sums = [], [], []
    for batch in np.array_split(samples, BATCHES):
        cells = _cells(batch, low, width, inside=True)
        d, e = batch - mean, lateral(batch[:, None, :], x) - line_mean
        sizes.append(len(batch))
        counts.append(_counts(cells))
        sums.append((d.sum(axis=0), d.T @ d, e.sum(axis=0), (e**2).sum(axis=0)))

    def left(values: Array) -> Array:
        """The sum of all batches, and of all but each one."""
        whole = values.sum(axis=0)
        return np.concatenate([whole[None], whole - values])

    size = left(np.array(sizes, dtype=float))
    first, second, line, line2 = (
        left(np.array(part)) / size.reshape(-1, *[1] * np.ndim(part[0]))
        for part in zip(*sums, strict=True)
    )
    return Truth(
        samples=samples,
        low=low,
        width=width,
        regions=np.array(
            [[_densest(pair) for pair in count] for count in left(np.array(counts, dtype=float))]
        ),
        moments=tuple(
            Gaussian(mean + a, S - np.outer(a, a)) for a, S in zip(first, second, strict=True)
        ),
        lateral_mean=line_mean + line,
        lateral_sigma=np.sqrt((line2 - line**2).clip(0)),
    )


def judged(
    truth: Truth, approximation: Approximation, names: tuple[str, str, str], seed: int = 0
) -> Row:
    """All figures of one representation.

    Args:
        truth: what it stands for.
        approximation: the representation.
        names: scenario, representation, and "before" or "after".
        seed: of the draws of the approximation: the same before and after the wire.
    """
    if approximation.covs is None:
        outside, outside_se, pairs, pairs_se = 1.0, 0.0, 1.0, 0.0
        positives, positives_se, kl, kl_se = 0.0, 0.0, np.inf, 0.0
    else:
        draws = _draws(approximation, seed)
        outside, outside_se, pairs, pairs_se = _false_negatives(truth, approximation, draws)
        positives, positives_se = _false_positives(truth, draws)
        whole = _whole(approximation)
        values = np.array([_kl(true, whole) for true in truth.moments])
        kl, kl_se = float(values[0]), float(_jackknife(values))
    mean, sigma = _band(approximation)
    ratios = sigma / truth.lateral_sigma
    scenario, representation, wire = names
    return Row(
        scenario=scenario,
        representation=representation,
        wire=wire,
        false_negatives=outside,
        false_negatives_se=outside_se,
        false_negatives_pairs=pairs,
        false_negatives_pairs_se=pairs_se,
        false_positives=positives,
        false_positives_se=positives_se,
        kl=kl,
        kl_se=kl_se,
        mean_error=_floats(mean - truth.lateral_mean[0]),
        mean_error_se=_floats(_jackknife(truth.lateral_mean)),
        sigma_ratio=_floats(ratios[0]),
        sigma_ratio_se=_floats(_jackknife(ratios)),
        coverage=1 - outside,
        coverage_se=outside_se,
    )


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _jackknife(values: Array) -> Array:
    """Standard error from (1 + BATCHES, ...) figures, of all and of all but each batch."""
    if not np.isfinite(values).all():
        return np.zeros(values.shape[1:])
    spread = ((values[1:] - values[1:].mean(axis=0)) ** 2).sum(axis=0)
    return np.asarray(np.sqrt((BATCHES - 1) / BATCHES * spread), dtype=float)


# -- regions of the truth -------------------------------------------------------


def _cells(samples: Array, low: Array, width: Array, *, inside: bool = False) -> NDArray[np.intp]:
    """(n, 4) numbers of cells, 1 to BINS; 0 and BINS + 1 are outside of the grid."""
    place = np.floor((samples - low) / width).clip(-1, BINS)
    if inside:  # the last cell holds its upper edge, and rounding moves no sample out
        place = place.clip(0, BINS - 1)
    return place.astype(np.intp) + 1


def _counts(cells: NDArray[np.intp]) -> NDArray[np.intp]:
    """(6, BINS + 2, BINS + 2) samples in each cell of each pair."""
    side = BINS + 2
    return np.array(
        [
            np.bincount(cells[:, i] * side + cells[:, j], minlength=side**2).reshape(side, side)
            for i, j in PAIRS
        ]
    )


def _densest(count: Array) -> NDArray[np.bool_]:
    """The fewest cells that hold ``MASS`` of the samples."""
    order = np.argsort(-count, axis=None, kind="stable")
    total = np.cumsum(count.ravel()[order])
    chosen = np.zeros(count.size, dtype=bool)
    chosen[order[: int(np.searchsorted(total, MASS * total[-1])) + 1]] = True
    return chosen.reshape(count.shape)


# -- figures --------------------------------------------------------------------


def _draws(approximation: Approximation, seed: int) -> Array:
    """(DRAWS, 4) of the approximation; its parts in turn."""
    assert approximation.covs is not None  # noqa: S101  # a point is not drawn from
    rng = np.random.default_rng([seed, 3])
    normal = rng.standard_normal((DRAWS, len(STATES)))
    # Stratified: each part gets its share to the draw, and the same normals as before the wire.
    edges = np.round(np.cumsum(approximation.weights) * DRAWS).astype(int)
    start = 0
    for end, mean, cov in zip(edges, approximation.means, approximation.covs, strict=True):
        normal[start:end] = mean + normal[start:end] @ Gaussian(mean, cov).root.T
        start = end
    return normal


def _false_positives(truth: Truth, draws: Array) -> tuple[float, float]:
    cells = _cells(draws, truth.low, truth.width)
    counts = _counts(cells)
    inside = np.einsum("bpij,pij->b", truth.regions, counts) / (len(draws) * len(PAIRS))
    out = np.zeros(len(draws))
    for region, (i, j) in zip(truth.regions[0], PAIRS, strict=True):
        out += ~region[cells[:, i], cells[:, j]]
    own = out.std() / len(PAIRS) / np.sqrt(len(draws))
    return float(1 - inside[0]), float(np.hypot(own, _jackknife(inside)))


def _false_negatives(
    truth: Truth, approximation: Approximation, draws: Array
) -> tuple[float, float, float, float]:
    """In four parameters and over the pairs, each with its error."""
    regions = [
        _Region(approximation, list(columns), draws) for columns in (range(len(STATES)), *PAIRS)
    ]
    n, four, pairs, pairs2 = len(truth.samples), 0, 0.0, 0.0
    for part in np.array_split(truth.samples, BATCHES):
        batch = np.ascontiguousarray(part.T)
        four += int(regions[0].outside(batch).sum())
        out = np.zeros(len(part))
        for region in regions[1:]:
            out += region.outside(batch)
        out /= len(PAIRS)
        pairs, pairs2 = pairs + float(out.sum()), pairs2 + float((out**2).sum())
    share, pair_share = four / n, pairs / n
    edge = max(region.edge_error for region in regions)
    return (
        share,
        float(np.hypot(np.sqrt(share * (1 - share) / n), edge)),
        pair_share,
        float(np.hypot(np.sqrt(max(pairs2 / n - pair_share**2, 0) / n), edge)),
    )


class _Region:
    """The region of highest density of some parameters of an approximation."""

    def __init__(self, approximation: Approximation, columns: list[int], draws: Array) -> None:
        assert approximation.covs is not None  # noqa: S101  # a point has no region
        self._columns = columns
        self._means = approximation.means[:, columns]
        covs = approximation.covs[:, columns][:, :, columns]
        whiteners = [_whitener(cov) for cov in covs]
        self._whiteners = [W for W in whiteners if W is not None]
        self._flat = len(self._whiteners) < len(whiteners)
        self.edge_error = 0.0
        self._edge, self._log_weights = 2 * gammaincinv(len(columns) / 2, MASS), np.zeros(1)
        if len(whiteners) > 1 and not self._flat:
            log_dets = np.array([np.log(np.abs(W.diagonal())).sum() for W in self._whiteners])
            self._log_weights = np.log(approximation.weights) + log_dets
            self._log_weights -= self._log_weights.max()
            self._edge = float(np.quantile(self._depth(draws.T[columns]), MASS))
            self.edge_error = float(np.sqrt(MASS * (1 - MASS) / len(draws)))

    def _depth(self, x: Array) -> Array:
        """(n,) minus twice the log density at (parameters, n) points, up to a constant.

        For one Gaussian it is the squared distance.
        """
        depths = [
            ((W @ (x - mean[:, None])) ** 2).sum(axis=0) - 2 * log_weight
            for mean, W, log_weight in zip(
                self._means, self._whiteners, self._log_weights, strict=True
            )
        ]
        least = np.min(depths, axis=0)
        if len(depths) == 1:
            return np.asarray(least, dtype=float)
        total = sum(np.exp((least - depth) / 2) for depth in depths)
        return np.asarray(least - 2 * np.log(total), dtype=float)

    def outside(self, samples: Array) -> NDArray[np.bool_]:
        """(n,) which of (4, n) samples lie outside."""
        if self._flat:
            return np.ones(samples.shape[1], dtype=bool)
        return np.asarray(self._depth(samples[self._columns]) > self._edge)


def _whitener(cov: Array) -> Array | None:
    """Lower-triangular W with ``W cov W^T`` the identity; None where cov is singular."""
    variance = cov.diagonal()
    if not (variance > 0).all():
        return None
    scale = np.sqrt(variance)
    R = cov / scale / scale[:, None]
    if np.linalg.eigvalsh(R)[0] < SINGULAR:
        return None
    return np.asarray(np.linalg.inv(np.linalg.cholesky(R)) / scale, dtype=float)


def _whole(approximation: Approximation) -> Gaussian:
    """The one Gaussian with its mean and covariance."""
    assert approximation.covs is not None  # noqa: S101  # a point has no moments to compare
    w, means, covs = approximation.weights, approximation.means, approximation.covs
    mean = w @ means
    d = means - mean
    return Gaussian(mean, np.einsum("k,kij->ij", w, covs + d[:, :, None] * d[:, None, :]))


def _kl(true: Gaussian, other: Gaussian) -> float:
    return np.inf if _whitener(other.cov) is None else true.kl(other)


def _band(approximation: Approximation) -> tuple[Array, Array]:
    """Mean and standard deviation of l(x) at LATERAL_X."""
    x = np.array(LATERAL_X)
    w, means = approximation.weights, approximation.means
    lines = lateral(means[:, None, :], x)  # (k, X)
    mean = w @ lines
    if approximation.covs is None:
        return mean, np.zeros(len(x))
    J = lateral_jacobian(means[:, None, :], x)
    within = np.einsum("kxi,kij,kxj->kx", J, approximation.covs, J)
    return mean, np.sqrt(w @ (within + (lines - mean) ** 2))
