"""Totals of figures of merit over any number of chunks, and the divergence by terms.

A study covers more Gaussians than fit into memory, chunk by chunk, and keeps a ``Score`` of each
chunk. Two scores add up exactly to the score of both chunks together, in any order: sums are
rational numbers, and quantiles are read from histograms with fixed bins.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from math import inf, nan, sqrt
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..values.coding_loss import LATERAL_X, Evaluation
from ..values.line import Status

Array = NDArray[np.float64]


def kl_terms(cov: Array, decoded_cov: Array) -> Array:
    """Split KL(N(0, S) || N(0, S')) [nat] into the terms of the entries of the Cholesky factor.

    With ``A = L'^-1 L`` it is the sum of (a_ii^2 - 1) / 2 - ln a_ii and of a_ij^2 / 2, j < i.

    Args:
        cov: (N, 4, 4) positive definite: S = L L^T.
        decoded_cov: (N, 4, 4) positive definite: S' = L' L'^T.

    Returns:
        (N, 4, 4) lower triangles of terms.

    Raises:
        numpy.linalg.LinAlgError: a matrix is not positive definite.
    """
    scale = np.sqrt(np.einsum("nii->ni", cov))
    scale2 = scale[:, :, None] * scale[:, None, :]
    L, L_decoded = (np.linalg.cholesky(S / scale2) for S in (cov, decoded_cov))
    A = np.tril(np.linalg.solve(L_decoded, L))
    terms = A**2 / 2
    terms[:, range(4), range(4)] -= 0.5 + np.log(np.einsum("nii->ni", A))
    return np.asarray(terms)


# ---- totals over chunks ---------------------------------------------------------------


@dataclass(frozen=True)
class Bins:
    """Bins of a histogram of positive numbers: 2^``bits`` of equal width in each octave.

    The bin of a number is read from the bits of its exponent and mantissa, so that it does not
    depend on the rounding of a logarithm. Numbers out of range count in the outermost bins.
    """

    low: int  #: the first bin begins at 2^low
    high: int  #: the last bin ends at 2^high
    bits: int

    @property
    def count(self) -> int:
        """Number of bins."""
        return (self.high - self.low) << self.bits

    def histogram(self, values: Array) -> NDArray[np.int64]:
        """Return (count,) how many values lie in each bin."""
        inside = values.clip(2.0**self.low, np.nextafter(2.0**self.high, 0))
        places = inside.view(np.int64) >> (52 - self.bits)
        return np.bincount(places - ((self.low + 1023) << self.bits), minlength=self.count)

    def edge(self, place: float) -> float:
        """Return the lower edge of a bin; for a fractional index, interpolate within the bin."""
        octave, rest = divmod(place, 1 << self.bits)
        return float(2.0 ** (self.low + octave) * (1 + rest / (1 << self.bits)))


#: For divergences [nat]: quantiles within 1 %.
KL_BINS = Bins(-40, 40, 6)
#: For ratios of standard deviations: quantiles within 0.1 %.
RATIO_BINS = Bins(-8, 24, 9)


@dataclass(frozen=True, eq=False)
class Figure:
    """Mean, spread, extremes and quantiles of a figure of merit over many Gaussians.

    ``a + b`` is the figure of both together, whatever the order of the additions.
    """

    count: int = 0  #: numbers, including infinite ones and NaN
    infinite: int = 0  #: numbers that are infinite or NaN
    total: Fraction = Fraction()  #: sum of the finite numbers
    squares: Fraction = Fraction()  #: sum of their squares
    least: float = inf  #: minimum of all but NaN
    greatest: float = -inf  #: maximum of all but NaN
    bins: Bins | None = None
    histogram: NDArray[np.int64] | None = None  #: of all but NaN, if there are bins

    @classmethod
    def of(cls, values: Array, bins: Bins | None = None) -> Figure:
        """Return the figure of (N,) numbers, with quantiles if ``bins`` are given."""
        finite = values[np.isfinite(values)]
        known = values[~np.isnan(values)]
        return cls(
            count=len(values),
            infinite=len(values) - len(finite),
            total=Fraction(float(finite.sum())),
            squares=Fraction(float((finite**2).sum())),
            least=float(known.min(initial=inf)),
            greatest=float(known.max(initial=-inf)),
            bins=bins,
            histogram=None if bins is None else bins.histogram(known),
        )

    def __add__(self, other: Figure) -> Figure:
        if self.bins != other.bins:
            raise ValueError(f"figures must have the same bins, got {self.bins} and {other.bins}")
        histogram = self.histogram
        if histogram is not None and other.histogram is not None:
            histogram = histogram + other.histogram
        return Figure(
            count=self.count + other.count,
            infinite=self.infinite + other.infinite,
            total=self.total + other.total,
            squares=self.squares + other.squares,
            least=min(self.least, other.least),
            greatest=max(self.greatest, other.greatest),
            bins=self.bins,
            histogram=histogram,
        )

    @property
    def mean(self) -> float:
        """Mean; infinite if a number is not finite, NaN if there are none."""
        if self.infinite or not self.count:
            return inf if self.infinite else nan
        return float(self.total / self.count)

    @property
    def mean_se(self) -> float:
        """Standard error of the mean."""
        n = self.count
        if self.infinite or n < 2:
            return nan
        spread = self.squares - self.total**2 / n  # rounding within a chunk may make it negative
        return sqrt(max(spread, Fraction()) / (n * (n - 1)))

    @property
    def rms(self) -> float:
        """Root mean square; infinite if a number is not finite, NaN if there are none."""
        if self.infinite or not self.count:
            return inf if self.infinite else nan
        return sqrt(self.squares / self.count)

    def quantile(self, share: float) -> float:
        """Return the number below which a share of all numbers lies, read from the bins."""
        if self.bins is None or self.histogram is None:
            raise ValueError("a figure has quantiles only with bins")
        total = int(self.histogram.sum())
        if not total:
            return nan
        sums = self.histogram.cumsum()
        rank = min(max(share, 0.0), 1.0) * total
        place = min(int(np.searchsorted(sums, rank)), len(sums) - 1)
        within = int(self.histogram[place])
        rest = (rank - (int(sums[place]) - within)) / within if within else 0.0
        return min(max(self.bins.edge(place + rest), self.least), self.greatest)

    def quantile_se(self, share: float) -> float:
        """Return the standard error of a quantile, from the quantiles two rank errors away."""
        if self.count < 2:
            return nan
        wide = 2 * sqrt(share * (1 - share) / self.count)
        return (self.quantile(share + wide) - self.quantile(share - wide)) / 4

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON values, without rounding."""
        result: dict[str, Any] = {
            "count": self.count,
            "infinite": self.infinite,
            "sums": [str(self.total), str(self.squares)],
            "extremes": [repr(self.least), repr(self.greatest)],
        }
        if self.bins is not None and self.histogram is not None:
            (places,) = np.nonzero(self.histogram)
            result["bins"] = [self.bins.low, self.bins.high, self.bins.bits]
            result["histogram"] = [places.tolist(), self.histogram[places].tolist()]
        return result

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Figure:
        """Return the figure that ``as_json`` described."""
        bins = histogram = None
        if "bins" in data:
            bins = Bins(*data["bins"])
            histogram = np.zeros(bins.count, dtype=np.int64)
            histogram[data["histogram"][0]] = data["histogram"][1]
        total, squares = map(Fraction, data["sums"])
        least, greatest = map(float, data["extremes"])
        counts = data["count"], data["infinite"]
        return cls(*counts, total, squares, least, greatest, bins, histogram)


@dataclass(frozen=True, eq=False)
class Score:
    """Accumulated counts and error statistics; ``a + b`` is the score of both together."""

    counts: Mapping[str, int]  #: of Gaussians: all of them ("n"), and those with a given outcome
    figures: Mapping[str, Figure]

    @classmethod
    def of(
        cls,
        evaluation: Evaluation,
        status: NDArray[np.int64],
        accepted: NDArray[np.bool_],
        clipped: NDArray[np.bool_],
    ) -> Score:
        """Count outcomes and add up figures.

        Divergences and ratios are over the rows whose decoded covariance is definite and whose
        status is not OUT_OF_RANGE; errors of the mean are over all rows whose status is not. A
        mean that was clipped to its range has an error of another kind, which the covariance
        covers; one such line in a million would hide the rounding of all others, so clipped rows
        have figures of their own.

        Args:
            evaluation: of N decoded Gaussians.
            status: (N,) as received.
            accepted: (N,) rows that the receiver accepted; others count as out of range.
            clipped: (N,) rows whose mean was clipped to its range.
        """
        stated = accepted & (status != Status.OUT_OF_RANGE)
        good = stated & evaluation.positive_definite
        kl = evaluation.kl_covered
        figures = {
            "kl": Figure.of(kl[good], KL_BINS),
            "kl_untouched": Figure.of(kl[good & (status == Status.FULL)]),
        }
        for k, x in enumerate(LATERAL_X):
            error = np.abs(evaluation.lateral_error[:, k])
            figures[f"mean_error_{x:g}"] = Figure.of(error[stated & ~clipped])
            figures[f"clipped_error_{x:g}"] = Figure.of(error[stated & clipped])
            ratio = evaluation.sigma_ratio[good, k]
            figures[f"sigma_ratio_{x:g}"] = Figure.of(ratio, RATIO_BINS)
        outcomes = {
            "not_positive_definite": stated & ~evaluation.positive_definite,
            "overconfident": stated & evaluation.overconfident,
            "saturated": accepted & (status == Status.SATURATED),
            "out_of_range": ~stated,
            "clipped": stated & clipped,
        }
        counts = {name: int(rows.sum()) for name, rows in outcomes.items()}
        return cls({"n": len(status)} | counts, figures)

    def __add__(self, other: Score) -> Score:
        return Score(
            {name: count + other.counts[name] for name, count in self.counts.items()},
            {name: figure + other.figures[name] for name, figure in self.figures.items()},
        )

    def share(self, name: str) -> tuple[float, float]:
        """Return a count as a share of all Gaussians, and its standard error."""
        n, count = self.counts["n"], self.counts[name]
        return (count / n if n else nan), share_se(count, n)

    def as_json(self) -> dict[str, Any]:
        """Return everything as JSON values, without rounding."""
        figures = {name: figure.as_json() for name, figure in self.figures.items()}
        return {"counts": dict(self.counts), "figures": figures}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> Score:
        """Return the score that ``as_json`` described."""
        figures = {name: Figure.from_json(figure) for name, figure in data["figures"].items()}
        return cls(dict(data["counts"]), figures)


def share_se(count: int, n: int) -> float:
    """Return the standard error of a share: the spread of its posterior, given ``count`` of n.

    The prior is uniform (Laplace), so that the error is not zero when count is 0 or n.

    >>> share_se(0, 10**6) < 1.1e-6, round(share_se(500, 1000), 4)
    (True, 0.0158)
    """
    a, b = count + 1, n - count + 1
    return sqrt(a * b / ((a + b) ** 2 * (a + b + 1)))
