"""Figures of merit of decoded Gaussians, for many at once, and their sums over any number.

A study looks at more Gaussians than fit into memory, in chunks, in any order. ``Figure`` and
``Score`` are what remains of a chunk. Two of them add to what both chunks together would have
given, exactly: sums are whole numbers, and quantiles are read from bins that are always the same.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import nan, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..line import Status, lateral, lateral_jacobian

__all__ = [
    "KL_BINS",
    "LATERAL_X",
    "RATIO_BINS",
    "Bins",
    "Evaluation",
    "Figure",
    "Score",
    "evaluate",
    "kl_terms",
    "share_se",
]

#: Where the lateral band is judged [m].
LATERAL_X = (0.0, 20.0, 40.0, 80.0)

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Each figure for each Gaussian; X places ahead."""

    positive_definite: NDArray[np.bool_]  #: (N,) the decoded covariance has a Cholesky factor
    largest_ratio: Array  #: (N,) largest eigenvalue of S'^-1 (S + d d^T): 1 or less is covered
    kl_covered: Array  #: (N,) KL(N(m', T) || N(m', S')), T = S + d d^T + F [nat]
    kl: Array  #: (N,) KL(N(m, S) || N(m', S')) [nat]; large where S is thinner than the grid
    lateral_error: Array  #: (N, X) decoded less true mean of l(x) [m]
    sigma_ratio: Array  #: (N, X) decoded over true standard deviation of l(x)

    @property
    def overconfident(self) -> NDArray[np.bool_]:
        """(N,) decoded covariances that do not cover what they stand for."""
        return ~(self.largest_ratio <= 1)


def evaluate(
    mean: Array, cov: Array, decoded_mean: Array, decoded_cov: Array, resolution: Array
) -> Evaluation:
    """Compare decoded Gaussians with the true ones.

    Args:
        mean: (N, 4) true.
        cov: (N, 4, 4) true, singular ones too.
        decoded_mean: (N, 4).
        decoded_cov: (N, 4, 4).
        resolution: (4,) variances of the mean's own rounding, factor^2 / 12: F.
    """
    d = mean - decoded_mean
    error = cov + d[:, :, None] * d[:, None, :]
    target = error + np.diag(resolution)
    scale = np.sqrt(np.einsum("nii->ni", decoded_cov))
    scale2 = scale[:, :, None] * scale[:, None, :]
    with np.errstate(divide="ignore", invalid="ignore"):
        L, definite = _cholesky(decoded_cov / scale2)
    # Figures of a matrix that is no covariance are reckoned with 1 and then set: it covers nothing.
    scale2 = np.where(definite[:, None, None], scale2, 1.0)
    scale = np.where(definite[:, None], scale, 1.0)
    none = np.where(definite, 0.0, np.inf)
    log_det_decoded = 2 * np.log(np.einsum("nii->ni", L)).sum(axis=1)

    def whitened(S: Array) -> Array:
        half = np.linalg.solve(L, S / scale2)
        return np.asarray(np.linalg.solve(L, np.swapaxes(half, 1, 2)), dtype=float)

    def divergence(S: Array, z: Array) -> Array:
        with np.errstate(divide="ignore"):
            _, log_det = np.linalg.slogdet(S / scale2)
        trace = np.einsum("nii->n", whitened(S))
        return (trace - 4 + log_det_decoded - log_det + (z**2).sum(axis=1)) / 2

    W = whitened(error)
    z = np.asarray(np.linalg.solve(L, (d / scale)[..., None])[..., 0], dtype=float)
    x = np.array(LATERAL_X)
    J, J_decoded = (lateral_jacobian(m[:, None, :], x) for m in (mean, decoded_mean))
    variance = np.einsum("nxi,nij,nxj->nx", J, cov, J)
    decoded_variance = np.einsum("nxi,nij,nxj->nx", J_decoded, decoded_cov, J_decoded)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        sigma_ratio = np.sqrt(decoded_variance / variance)  # NaN where a variance is negative
    return Evaluation(
        positive_definite=definite,
        largest_ratio=np.asarray(np.linalg.eigvalsh((W + np.swapaxes(W, 1, 2)) / 2)[:, -1]) + none,
        kl_covered=divergence(target, np.zeros_like(z)) + none,
        kl=divergence(cov, z) + none,
        lateral_error=lateral(decoded_mean[:, None, :], x) - lateral(mean[:, None, :], x),
        sigma_ratio=sigma_ratio,
    )


def kl_terms(cov: Array, decoded_cov: Array) -> Array:
    """KL(N(0, S) || N(0, S')) [nat], and what each entry of the Cholesky factor has in it.

    With ``A = L'^-1 L`` it is the sum of (a_ii^2 - 1) / 2 - ln a_ii and of a_ij^2 / 2, j < i.

    Args:
        cov: (N, 4, 4) positive definite: S = L L^T.
        decoded_cov: (N, 4, 4) positive definite: S' = L' L'^T.

    Returns:
        (N, 4, 4) lower triangles.

    Raises:
        numpy.linalg.LinAlgError: a matrix is not positive definite.
    """
    scale = np.sqrt(np.einsum("nii->ni", cov))
    scale2 = scale[:, :, None] * scale[:, None, :]
    L, L_decoded = (np.linalg.cholesky(S / scale2) for S in (cov, decoded_cov))
    A = np.tril(np.linalg.solve(L_decoded, L))
    pivots = np.einsum("nii->ni", A)
    terms = A**2 / 2
    terms[:, range(4), range(4)] -= 0.5 + np.log(pivots)
    return np.asarray(terms)


# ---- sums of figures over chunks ------------------------------------------------------


@dataclass(frozen=True)
class Bins:
    """Bins of a histogram of positive numbers: so many to each octave, of equal widths in it.

    Where a number belongs is read from the bits of its exponent and mantissa, so that no
    rounding of a logarithm decides. Smaller and greater numbers count in the outermost bins.

    Args:
        low: the first bin begins at 2^low.
        high: the last one ends at 2^high.
        bits: 2^bits bins in each octave.
    """

    low: int
    high: int
    bits: int

    @property
    def count(self) -> int:
        """How many bins there are."""
        return (self.high - self.low) << self.bits

    def histogram(self, values: Array) -> NDArray[np.int64]:
        """(count,) how many values lie in each bin."""
        inside = values.clip(2.0**self.low, np.nextafter(2.0**self.high, 0))
        places = inside.view(np.int64) >> (52 - self.bits)
        first = (self.low + 1023) << self.bits
        return np.bincount(places - first, minlength=self.count)

    def edge(self, place: float) -> float:
        """Where a bin begins; between two bins, what divides them in that ratio."""
        octave, part = divmod(place, 1 << self.bits)
        return float(2.0 ** (self.low + octave) * (1 + part / (1 << self.bits)))


#: Of divergences [nat]: quantiles are good to less than 1 %.
KL_BINS = Bins(-40, 40, 6)
#: Of ratios of standard deviations: to less than 0.1 %.
RATIO_BINS = Bins(-8, 24, 9)

#: Exact sums are counted in units of 2^-1074, of which each double is a whole number.
UNIT_BITS = 1074


def _exact(value: float) -> int:
    numerator, denominator = value.as_integer_ratio()
    return numerator << (UNIT_BITS - denominator.bit_length() + 1)


@dataclass(frozen=True, eq=False)
class Figure:
    """One figure of many Gaussians: mean, spread, extremes and quantiles.

    ``a + b`` is the figure of both together. It does not depend on the order in which many are
    added.
    """

    count: int = 0  #: how many numbers, the infinite ones too
    infinite: int = 0  #: how many are infinite or NaN
    total: int = 0  #: sum of the finite ones [2^-1074]
    squares: int = 0  #: sum of their squares [2^-1074]
    least: float = np.inf  #: of all but NaN
    greatest: float = -np.inf
    bins: Bins | None = None  #: of the histogram, if there is one
    histogram: NDArray[np.int64] | None = None

    @classmethod
    def of(cls, values: Array, bins: Bins | None = None) -> Figure:
        """The figure of some numbers.

        Args:
            values: (N,).
            bins: to be had for quantiles.
        """
        finite = np.isfinite(values)
        good = values if finite.all() else values[finite]
        known = values if len(good) == len(values) else values[~np.isnan(values)]
        return cls(
            count=len(values),
            infinite=len(values) - len(good),
            total=_exact(float(good.sum())),
            squares=_exact(float((good**2).sum())),
            least=float(known.min(initial=np.inf)),
            greatest=float(known.max(initial=-np.inf)),
            bins=bins,
            histogram=None if bins is None else bins.histogram(known),
        )

    def __add__(self, other: Figure) -> Figure:
        if self.bins != other.bins:
            raise ValueError(f"figures must have the same bins, got {self.bins} and {other.bins}")
        both = self.histogram is not None and other.histogram is not None
        return Figure(
            count=self.count + other.count,
            infinite=self.infinite + other.infinite,
            total=self.total + other.total,
            squares=self.squares + other.squares,
            least=min(self.least, other.least),
            greatest=max(self.greatest, other.greatest),
            bins=self.bins,
            histogram=self.histogram + other.histogram if both else None,  # type: ignore[operator]
        )

    @property
    def mean(self) -> float:
        """Mean; infinite where one number is, NaN of none."""
        if self.infinite or not self.count:
            return np.inf if self.infinite else nan
        return self.total / (self.count << UNIT_BITS)

    @property
    def mean_se(self) -> float:
        """Standard error of the mean."""
        if self.infinite or self.count < 2:
            return nan
        n = self.count
        spread = (self.squares * n << UNIT_BITS) - self.total**2  # n^2 times the variance
        return sqrt(max(spread, 0) / (n * n * (n - 1) << 2 * UNIT_BITS))

    @property
    def rms(self) -> float:
        """Root mean square."""
        if self.infinite or not self.count:
            return np.inf if self.infinite else nan
        return sqrt(self.squares / (self.count << UNIT_BITS))

    def quantile(self, share: float) -> float:
        """The number below which a share of all lies, read from the bins."""
        if self.bins is None or self.histogram is None:
            raise ValueError("a figure has quantiles only with bins")
        total = int(self.histogram.sum())
        if not total:
            return nan
        sums = self.histogram.cumsum()
        rank = min(max(share, 0.0), 1.0) * total
        place = min(int(np.searchsorted(sums, rank)), len(sums) - 1)
        within = int(self.histogram[place])
        part = (rank - (int(sums[place]) - within)) / within if within else 0.0
        return min(max(self.bins.edge(place + part), self.least), self.greatest)

    def quantile_se(self, share: float) -> float:
        """Standard error of a quantile, from those that lie two errors of its rank aside."""
        if self.count < 2:
            return nan
        wide = 2 * sqrt(share * (1 - share) / self.count)
        return (self.quantile(share + wide) - self.quantile(share - wide)) / 4

    def as_json(self) -> dict[str, Any]:
        """Everything, in what JSON has; sums without rounding."""
        result: dict[str, Any] = {
            "count": self.count,
            "infinite": self.infinite,
            "total": _shortened(self.total),
            "squares": _shortened(self.squares),
            "extremes": [repr(self.least), repr(self.greatest)],
        }
        if self.bins is not None and self.histogram is not None:
            (places,) = np.nonzero(self.histogram)
            result["bins"] = [self.bins.low, self.bins.high, self.bins.bits]
            result["histogram"] = [places.tolist(), self.histogram[places].tolist()]
        return result

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Figure:
        """What ``as_json`` gave."""
        bins = histogram = None
        if "bins" in data:
            bins = Bins(*data["bins"])
            histogram = np.zeros(bins.count, dtype=np.int64)
            places, counts = data["histogram"]
            histogram[places] = counts
        least, greatest = map(float, data["extremes"])
        (total, total_zeros), (squares, squares_zeros) = data["total"], data["squares"]
        return cls(
            count=data["count"],
            infinite=data["infinite"],
            total=total << total_zeros,
            squares=squares << squares_zeros,
            least=least,
            greatest=greatest,
            bins=bins,
            histogram=histogram,
        )


def _shortened(whole: int) -> tuple[int, int]:
    """A whole number without the zeros that its bits end in, and how many these are."""
    zeros = max((whole & -whole).bit_length() - 1, 0)
    return whole >> zeros, zeros


@dataclass(frozen=True, eq=False)
class Score:
    """What a code made of many Gaussians. ``a + b`` is that of both together.

    Args:
        counts: of Gaussians: all of them ("n"), and those that came out in some way.
        figures: by name.
    """

    counts: Mapping[str, int]
    figures: Mapping[str, Figure]

    @classmethod
    def of(
        cls,
        verdict: Evaluation,
        status: NDArray[np.int64],
        accepted: NDArray[np.bool_],
        clipped: NDArray[np.bool_],
    ) -> Score:
        """Count and add up.

        Divergences and ratios are over the rows whose decoded covariance is definite and that do
        not say OUT_OF_RANGE; errors of the mean over all that do not. Means that met the end of
        their range have errors of another kind, which the covariance covers: one such line
        in a million would hide the rounding of all others, so they are apart.

        Args:
            verdict: of N decoded Gaussians.
            status: (N,) as they were received.
            accepted: (N,) as they were received; a row that was not counts as out of range.
            clipped: (N,) means that met the end of their range.
        """
        stated = accepted & (status != Status.OUT_OF_RANGE)
        good = stated & verdict.positive_definite
        kl = verdict.kl_covered
        figures = {
            "kl": Figure.of(kl[good], KL_BINS),
            "kl_untouched": Figure.of(kl[good & (status == Status.FULL)]),
        }
        for k, x in enumerate(LATERAL_X):
            error = np.abs(verdict.lateral_error[:, k])
            figures[f"mean_error_{x:g}"] = Figure.of(error[stated & ~clipped])
            figures[f"clipped_error_{x:g}"] = Figure.of(error[stated & clipped])
            ratio = verdict.sigma_ratio[good, k]
            figures[f"sigma_ratio_{x:g}"] = Figure.of(ratio, RATIO_BINS)
        counts = {
            "n": len(status),
            "not_positive_definite": int((stated & ~verdict.positive_definite).sum()),
            "overconfident": int((stated & verdict.overconfident).sum()),
            "saturated": int((accepted & (status == Status.SATURATED)).sum()),
            "out_of_range": int((~stated).sum()),
            "clipped": int((stated & clipped).sum()),
        }
        return cls(counts, figures)

    def __add__(self, other: Score) -> Score:
        return Score(
            {name: count + other.counts[name] for name, count in self.counts.items()},
            {name: figure + other.figures[name] for name, figure in self.figures.items()},
        )

    def share(self, name: str) -> tuple[float, float]:
        """A count as a share of all, and its sampling error."""
        n, count = self.counts["n"], self.counts[name]
        return (count / n if n else nan), share_se(count, n)

    def as_json(self) -> dict[str, Any]:
        """Everything, in what JSON has."""
        figures = {name: figure.as_json() for name, figure in self.figures.items()}
        return {"counts": dict(self.counts), "figures": figures}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Score:
        """What ``as_json`` gave."""
        figures = {name: Figure.from_json(figure) for name, figure in data["figures"].items()}
        return cls(dict(data["counts"]), figures)


def share_se(count: int, n: int) -> float:
    """Sampling error of a share: the spread of what it may be, given so many of n.

    Of a uniform prior (Laplace), so that none of n, or all, is no certainty.

    >>> share_se(0, 10**6) < 1.1e-6, round(share_se(500, 1000), 4)
    (True, 0.0158)
    """
    a, b = count + 1, n - count + 1
    return sqrt(a * b / ((a + b) ** 2 * (a + b + 1)))


def _cholesky(S: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Factors, and which matrices have one; the identity where there is none."""
    L = np.zeros_like(S)
    definite = np.ones(len(S), dtype=bool)
    for i in range(S.shape[-1]):
        for j in range(i):
            rest = S[:, i, j] - np.einsum("nk,nk->n", L[:, i, :j], L[:, j, :j])
            L[:, i, j] = rest / L[:, j, j]
        pivot = S[:, i, i] - np.einsum("nk,nk->n", L[:, i, :i], L[:, i, :i])
        definite &= pivot > 0
        L[:, i, i] = np.sqrt(np.where(definite, pivot, 1.0))
    L[~definite] = np.eye(S.shape[-1])
    return L, definite
