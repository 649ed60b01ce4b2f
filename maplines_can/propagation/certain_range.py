"""Certain range: how far the lateral position of a line is known."""

from __future__ import annotations

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from ..values.elementary import tan
from ..values.fixed_order import product

#: Default of the largest standard deviation of the lateral position of a line [m]. A line that is
#: less certain tells no lane from the next but one, and its band is that of the first order only
#: in name.
MAX_SIGMA = 10.0
#: The variance of the lateral position is a polynomial of this degree in x.
DEGREE = 6
_NODES = chebyshev.chebpts1(DEGREE + 1)
_TO_COEFFICIENTS = np.linalg.inv(chebyshev.chebvander(_NODES, DEGREE))
#: Largest imaginary part of a root that is real but for rounding.
_REAL = 1e-7


def check_max_sigma(max_sigma: float) -> None:
    """Check the largest standard deviation of the lateral position of a line [m].

    Raises:
        ValueError: it is 0 or less, or no number.
    """
    if not max_sigma > 0:
        raise ValueError(
            f"max_sigma must be more than 0 m, or infinite for no limit, got {max_sigma!r}"
        )


def certain_ranges(
    means: NDArray[np.float64],
    covs: NDArray[np.float64],
    x_ranges: NDArray[np.float64],
    max_sigma: float,
) -> NDArray[np.float64]:
    """Return the (L, 2) parts of ranges in which the lateral positions of lines are certain enough.

    They contain the place nearest to the car. They end where the standard deviation passes the
    limit: the variance is a polynomial in x, whose roots are exact.

    Args:
        means: (L, 4) lines.
        covs: (L, 4, 4) their covariances.
        x_ranges: (L, 2) ranges [m].
        max_sigma: largest standard deviation of the lateral position [m].

    Returns:
        NaN for a line that is less certain even at the place nearest to the car.

    >>> cov = np.diag([0.1, 0.01, 0, 0]) ** 2
    >>> certain_ranges(np.zeros((1, 4)), cov[None], np.array([[-20.0, 80.0]]), 0.5).round(2)
    array([[-20.  ,  48.99]])
    """
    if not np.isfinite(max_sigma):
        return x_ranges
    centre, half = x_ranges.mean(axis=1), np.diff(x_ranges)[:, 0] / 2
    x, slope = centre[:, None] + half[:, None] * _NODES, tan(means[:, 1:2])
    square = x * x
    J = np.stack([np.ones_like(x), (1 + slope * slope) * x, square / 2, square * x / 6], axis=-1)
    variance = np.add.reduce((product(J, covs) * J).transpose(2, 0, 1), axis=0)
    excess = variance @ _TO_COEFFICIENTS.T  # (L, DEGREE + 1)
    excess[:, 0] -= max_sigma**2
    found = x_ranges.copy()
    # No Chebyshev polynomial exceeds 1.
    for i in np.flatnonzero(excess[:, 0] + np.abs(excess[:, 1:]).sum(axis=1) > 0):
        car = (np.clip(0.0, *x_ranges[i]) - centre[i]) / half[i]
        if chebyshev.chebval(car, excess[i]) > 0:
            found[i] = np.nan
            continue
        roots = chebyshev.chebroots(chebyshev.chebtrim(excess[i]))
        ends = roots[np.abs(roots.imag) < _REAL].real
        low = centre[i] + half[i] * ends[ends <= car].max(initial=-np.inf)
        high = centre[i] + half[i] * ends[ends >= car].min(initial=np.inf)
        found[i] = max(x_ranges[i, 0], low), min(x_ranges[i, 1], high)
    return found
