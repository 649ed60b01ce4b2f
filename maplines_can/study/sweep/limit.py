"""The rate-distortion limit: the fewest bits that could send a source of Gaussians.

Gaussians of p components are sent with a mean KL divergence from the true to the decoded one. If
it is small, it is a quadratic form, 2 KL = d^T F d, with F the Fisher information of the n
parameters; then (Linder and Zamir, IEEE Trans. Inf. Theory 45(2), 1999, 533)

    R(KL) = h_F - n/2 log2(2 pi e 2 KL / n)  bit,    h_F = h(theta) + E log2 sqrt(det F(theta))

bounds the mean length of every code as KL goes to 0, and codes of long blocks attain it. Scalar
quantizers lose at least 1/2 log2(2 pi e / 12) = 0.2546 bit per parameter against it. h_F, the
entropy with respect to the Fisher volume, is the same in all coordinates. The coordinates here,
with S = L L^T, are the mean m, ln L_ii, and t_ij = L_ij / L_ii for j < i. With L'^-1 L = 1 + A and
z = L'^-1 (m - m'), 2 KL = |z|^2 + 2 sum A_ii^2 + sum A_ij^2, where A_ii = d ln L_ii and
A_ij = d t_ij up to terms of the other parameters whose Jacobian is 1. Therefore

    h_F = h(m, ln L_ii, t_ij) + p/2 bit - E log2 sqrt(det S)    n = p + p (p + 1) / 2: all
    h_F = h(ln L_ii, t_ij)    + p/2 bit                         n = p (p + 1) / 2: covariance

The second is for the covariances alone, KL(N(m, S) || N(m, S')), without using what the mean says
about them. The difference of the two is the entropy of the mean, given the covariance.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from math import nan
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Disjoint batches of samples. Their scatter gives the standard error, and their excess over the
#: estimate from all samples gives the bias.
BATCHES = 8
#: Neighbours for each dimension that estimate the shape of a neighbourhood. Fewer follow a curved
#: source more closely but estimate its shape less well: 4 to 30 differ by half a bit there.
NEIGHBOURS = 10
#: Rows computed at a time; 14 dimensions take 60 MB.
BLOCK = 1024
#: Least eigenvalue of a correlation matrix whose coordinates are independent.
COLLINEAR = 1e-9
#: Sources that fill their n dimensions are estimated at 0.9 n and more, surfaces at 0.8 n.
MIN_DIMENSION = 0.85


@dataclass(frozen=True)
class Limit:
    """The bound R(KL) of a source, with estimates of its errors.

    It may also come from a closed form, or from a source on a surface of ``dimension``.

    >>> limit = Limit(entropy_bits=10.0, dimension=14)
    >>> limit.bits([1e-3, 1e-4]).round(2)
    array([70.75, 94.01])
    """

    entropy_bits: float  #: h_F [bit]; NaN if the source is singular
    dimension: int  #: n, parameters of a Gaussian
    entropy_se_bits: float = 0.0  #: standard error of h_F [bit]
    bias_bits: float = 0.0  #: probable excess of h_F, and of R [bit]
    samples: int = 0  #: distinct samples used
    local_dimension: float = nan  #: estimated dimension that the samples fill
    caveat: str = ""  #: why h_F is not reliable; empty if it is

    def bits(self, kl: ArrayLike) -> Array:
        """Return the (...,) smallest mean length of a message [bit] for mean divergences ``kl``.

        Valid at high rates: well above ``dimension`` bits.

        Args:
            kl: (...,) positive, KL(true || decoded) [nat].

        Raises:
            ValueError: a divergence is not positive.
        """
        kl = np.asarray(kl, dtype=float)
        if not (kl > 0).all():
            raise ValueError(f"kl must be positive [nat], got {kl!r}")
        n = self.dimension
        return np.asarray(self.entropy_bits - n / 2 * np.log2(2 * np.pi * math.e * 2 * kl / n))


def limit_of(
    means: ArrayLike,
    covs: ArrayLike,
    *,
    part: Literal["all", "covariance"] = "all",
    resolution: ArrayLike | None = None,
    seed: int = 0,
) -> Limit:
    """Estimate the bound of the source of a sample of Gaussians, by nearest neighbours.

    The joint entropy is the sum of the marginal entropies minus the total correlation. The latter
    is the entropy of independent standard normal variables minus the joint entropy of the normal
    scores. This is exact and removes heavy tails. Each entropy is estimated from the distances to
    the next neighbours (Kozachenko and Leonenko 1987; Kraskov, Stoegbauer and Grassberger, Phys.
    Rev. E 69, 066138, 2004); that of the scores with Mahalanobis distances of the local covariance
    of the neighbours, which adapts to a curved source (after Lord, Sun and Bollt, Chaos 28, 033114,
    2018). The error of the same procedure on a standard normal sample of the same size is
    subtracted.

    The result is still too high if the source is finer than the distance of neighbours; for smooth
    sources the excess goes with N^(-2/n) (Berrett, Samworth and Yuan, Ann. Statist. 47, 288,
    2019). ``bias_bits`` extrapolates this law from N/8 and N samples. It is not subtracted:
    ``entropy_bits`` is the high end and ``entropy_bits - bias_bits`` the probable low end. On
    sources with closed forms the true value lay between them, up to the standard errors (that of
    the bias is about three times that of the entropy), except for sources at least ten times wider
    in one direction than in another, where it was lower.

    A source on a surface of fewer than n dimensions has no h_F (it is minus infinity), and its
    bound rises by less than n/2 log2 10 bit per decade. Exact ties give NaN. If the samples only
    look like a surface, by ``local_dimension``, ``caveat`` says so; a code then looks better
    against the high end than it is.

    h_F depends neither on the order of the components nor on their units, but its bias depends on
    the order: choose one with small ratios.

    20 000 samples of 14 dimensions take 15 s, 100 000 take 4 min, half of it for the normal sample,
    which is cached for the next set of this size; 200 and 300 MB.

    Args:
        means: (N, p); unused for the part "covariance".
        covs: (N, p, p) positive definite; N is at least 160 n.
        part: "all", n = p + p (p + 1) / 2 parameters, or "covariance", n = p (p + 1) / 2.
        resolution: (p,) variances added to each covariance, as by ``evaluate``; none by default.
        seed: of the split into batches and of the normal samples.

    Raises:
        ValueError: a shape or value is wrong, a covariance is singular, or there are too few
            distinct samples.

    >>> rng = np.random.default_rng(1)
    >>> sigma = 2 ** rng.uniform(0, 10, size=2000)  # 10 octaves, and KL = (ln sigma'/sigma)^2
    >>> limit = limit_of(np.zeros((2000, 1)), sigma[:, None, None] ** 2, part="covariance")
    >>> print(f"{limit.entropy_bits:.1f}; exactly {0.5 + np.log2(10 * np.log(2)):.1f}")
    3.3; exactly 3.3
    """
    theta, log_volume, names = coordinates(means, covs, part, resolution)
    given, n = theta.shape
    _, first = np.unique(theta, axis=0, return_index=True)
    first = np.random.default_rng(seed).permutation(np.sort(first))
    if len(first) < 2 * BATCHES * NEIGHBOURS * n:
        raise ValueError(
            f"{n} parameters take at least {2 * BATCHES * NEIGHBOURS * n} distinct samples, "
            f"got {len(first)} distinct ones of {given}; draw more"
        )
    theta, log_volume = theta[first], log_volume[first]
    samples = len(theta)
    sizes = {"dimension": n, "samples": samples}
    if reason := _singular(theta, names):
        return Limit(nan, **sizes, entropy_se_bits=nan, bias_bits=nan, caveat=reason)

    h, batches, filled = _estimates(theta, log_volume)
    error, error_batches, normal_filled = _of_normal(samples, n, seed)
    shrinkage = BATCHES ** (-2 / n)
    step = batches.mean() - h - (np.mean(error_batches) - error)
    se = np.sqrt((batches.var(ddof=1) + np.var(error_batches, ddof=1)) / BATCHES)
    local_dimension = n * filled / normal_filled
    caveat = ""
    if local_dimension < MIN_DIMENSION * n:
        caveat = (
            f"the samples fill about {local_dimension:.1f} of {n} dimensions: the true bound is "
            "lower, and rises more slowly as KL falls"
        )
    return Limit(
        entropy_bits=float((h - error) / np.log(2)),
        entropy_se_bits=float(se / np.log(2)),
        bias_bits=float(step * shrinkage / (1 - shrinkage) / np.log(2)),
        local_dimension=float(local_dimension),
        caveat=caveat,
        **sizes,
    )


def coordinates(
    means: ArrayLike, covs: ArrayLike, part: str, resolution: ArrayLike | None
) -> tuple[Array, Array, list[str]]:
    """Return coordinates (N, n), the logarithm of their Fisher volume (N,), and their names."""
    if part not in ("all", "covariance"):
        raise ValueError(f"part must be 'all' or 'covariance', got {part!r}")
    m, S = np.asarray(means, dtype=float), np.asarray(covs, dtype=float)
    if m.ndim != 2 or m.size == 0 or S.shape != (*m.shape, m.shape[1]):
        raise ValueError(
            f"means and covs must have shapes (N, p) and (N, p, p), got {m.shape} and {S.shape}"
        )
    if not np.isfinite(m).all() or not np.isfinite(S).all():
        raise ValueError("means and covs must be finite")
    p = m.shape[1]
    if resolution is not None:
        F = np.asarray(resolution, dtype=float)
        if F.shape != (p,) or not (F >= 0).all():
            raise ValueError(
                f"resolution must have shape ({p},) and values of 0 or more, got {resolution!r}"
            )
        S = S + np.diag(F)
    try:
        L = np.asarray(np.linalg.cholesky(S), dtype=float)
    except np.linalg.LinAlgError:
        raise ValueError(
            "covs must be positive definite: a singular one has no finite rate; "
            "add the resolution of the means, Codec.resolution"
        ) from None
    log_pivots = np.log(np.einsum("nii->ni", L))
    i, j = np.tril_indices(p, -1)
    theta = np.column_stack([log_pivots, L[:, i, j] / L[:, i, i]])
    names = [f"ln L_{a}{a}" for a in range(p)]
    names += [f"t_{a}{b}" for a, b in zip(i, j, strict=True)]
    log_volume = np.full(len(m), p / 2 * np.log(2))
    if part == "all":
        theta = np.column_stack([m, theta])
        names = [f"m_{a}" for a in range(p)] + names
        log_volume -= log_pivots.sum(axis=1)
    return theta, log_volume, names


def _singular(theta: Array, names: Sequence[str]) -> str:
    """Return why the entropy of (N, n) coordinates is minus infinity, or an empty text."""
    for x, name in zip(theta.T, names, strict=True):
        _, count = np.unique(x, return_counts=True)
        if count.max() > NEIGHBOURS // 2:
            share = count.max() / len(x)
            return f"singular: {name} has the same value in {share:.1%} of the samples"
    values, vectors = np.linalg.eigh(np.atleast_2d(np.corrcoef(_normal_scores(theta).T)))
    if values[0] < COLLINEAR:
        dependent = [name for name, v in zip(names, vectors[:, 0], strict=True) if abs(v) > 0.1]
        return f"singular: {', '.join(dependent)} determine each other"
    return ""


def _estimates(theta: Array, log_volume: Array) -> tuple[float, Array, float]:
    """Return the entropy [nat] of all samples, of each batch, and the dimension they fill.

    ``theta`` has (N, n) coordinates in random order, ``log_volume`` the (N,) logarithms of the
    weight of a unit of volume.
    """
    h, local_dimension = _entropy(theta)
    size = len(theta) // BATCHES
    rows = [slice(i * size, (i + 1) * size) for i in range(BATCHES)]
    h_batches = np.array([_entropy(theta[r])[0] + log_volume[r].mean() for r in rows])
    return h + float(log_volume.mean()), h_batches, local_dimension


@lru_cache
def _of_normal(samples: int, n: int, seed: int) -> tuple[float, tuple[float, ...], float]:
    """Return the errors of ``_estimates`` for a standard normal sample."""
    x = np.random.default_rng([seed, samples, n]).standard_normal((samples, n))
    # Relative to the density at the points, so that their scatter does not count as an error.
    log_density = -((x**2).sum(axis=1) + n * np.log(2 * np.pi)) / 2
    error, error_batches, local_dimension = _estimates(x, log_density)
    return error, tuple(error_batches.tolist()), local_dimension


def _entropy(theta: Array) -> tuple[float, float]:
    """Return the uncorrected entropy [nat] of (N, n) coordinates, and the dimension they fill."""
    # In one dimension a few neighbours are close enough, and near ties do not matter.
    single = sum(_neighbours(x[:, None], NEIGHBOURS // 2, shaped=False)[0] for x in theta.T)
    scores = _normal_scores(theta)
    root = np.asarray(np.linalg.cholesky(np.atleast_2d(np.cov(scores.T))), dtype=float)
    white = np.asarray(np.linalg.solve(root, scores.T).T, dtype=float)
    joint, local_dimension = _neighbours(white, 1, shaped=True)
    joint += np.log(root.diagonal()).sum()
    return single + joint - theta.shape[1] / 2 * np.log(2 * np.pi * math.e), local_dimension


def _neighbours(x: Array, k: int, shaped: bool) -> tuple[float, float]:
    """Return the entropy [nat] of (N, n) points by their k-th neighbours, and their dimension.

    The dimension is that of Levina and Bickel (2004), averaged as by MacKay and Ghahramani.
    ``shaped`` distances are in the metric of the covariance of the neighbours.
    """
    from scipy.spatial import cKDTree
    from scipy.special import digamma, gammaln

    samples, n = x.shape
    near = NEIGHBOURS * n if shaped else k
    tree = cKDTree(x)
    log_radius = log_ratio = 0.0
    for start in range(0, samples, BLOCK):
        centre = x[start : start + BLOCK]
        distance, index = tree.query(centre, k=near + 1)
        distance = distance[:, 1:]  # the nearest is the point itself
        if not shaped:
            log_radius += n * np.log(distance[:, k - 1]).sum()
            continue
        ratio = distance[:, NEIGHBOURS - 1, None] / distance[:, : NEIGHBOURS - 1]
        log_ratio += np.log(ratio).mean(axis=1).sum()
        d = np.swapaxes(x[index[:, 1:]] - centre[:, None], 1, 2)  # (B, n, near)
        spread = d - d.mean(axis=2, keepdims=True)
        L = np.linalg.cholesky(spread @ np.swapaxes(spread, 1, 2) / near)
        squared = (np.linalg.solve(L, d) ** 2).sum(axis=1)
        log_radius += n / 2 * np.log(np.partition(squared, k - 1, axis=1)[:, k - 1]).sum()
        log_radius += np.log(np.einsum("bii->bi", L)).sum()
    log_ball = n / 2 * np.log(np.pi) - gammaln(n / 2 + 1)
    entropy = digamma(samples) - digamma(k) + log_ball + log_radius / samples
    return float(entropy), samples / log_ratio if shaped else nan


def _normal_scores(theta: Array) -> Array:
    """Map each of (N, n) coordinates to a standard normal distribution, by ranks."""
    from scipy.special import ndtri

    rank = np.argsort(np.argsort(theta, axis=0), axis=0)
    return np.asarray(ndtri((rank + 0.5) / len(theta)), dtype=float)
