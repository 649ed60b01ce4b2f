"""How many parts each line needs, and how many it gets where all lines share a bus."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .mixture import SPLITS, standard_split

__all__ = ["TOLERANCE", "component_counts", "remaining_nonlinearity"]

#: Least nonlinearity that is worth another part: the second-order part has less than a tenth
#: of a part's variance. In the street turn at 10 deg five parts meet it, and leave some 4 % of
#: their mass to lines that cannot be.
TOLERANCE = 0.3


def remaining_nonlinearity(amount: float, k: int) -> float:
    """What is left of a bend within the k parts of a ``Mixture``.

    Like ``Nonlinearity.amount``, the standard deviation of the second-order part over the
    whole, now of a part: variances are pooled over the parts. Let the output have
    the variance 1 and the function be quadratic, with a second-order part of the
    variance a^2 and a slope of the square 1 - a^2 in the middle. A part of the
    spread s, s^2 = 1 - sum w_i m_i^2, has a second-order part of the variance
    s^4 a^2, and at m_i the square of the slope is larger by 2 a^2 m_i^2 in the mean
    of the two sides:

        a_k^2 = a^2 s^2 / (1 + a^2 (1 - s^2)),

    for a small bend a s. Where the output also varies across the direction of the
    split, or has an error of its own, less is left. Terms above the second order
    are not seen: the outer parts of a tight turn have more than this.

    Args:
        amount: of the whole Gaussian, from ``bend``.
        k: number of parts, 1 to 8.

    >>> [round(remaining_nonlinearity(0.8, k), 2) for k in (1, 2, 5, 8)]
    [0.8, 0.52, 0.24, 0.17]
    """
    weights, means = standard_split(k)
    variance = 1 - weights @ means**2
    return float(amount * np.sqrt(variance / (1 + amount**2 * (1 - variance))))


def component_counts(
    amounts: ArrayLike, *, tolerance: float = TOLERANCE, budget: int | None = None
) -> list[int]:
    """The fewest parts, 1 to 8 for each line, that leave no more than the tolerance.

    Where the budget does not allow it, the largest nonlinearity left is as small as
    the budget allows: each part goes to the line that has most left, and since
    a part more never leaves more, no other division does better. What eight parts
    leave, stays.

    Args:
        amounts: (L,) of ``bend``, from 0 to 1.
        tolerance: of the nonlinearity within the parts, more than 0.
        budget: parts of all lines together, L or more; None: as many as they need.

    Raises:
        ValueError: an amount, the tolerance or the budget is out of its range.

    >>> component_counts([0.87, 0.39, 0.03])
    [5, 2, 1]
    >>> component_counts([0.87, 0.39, 0.03], budget=6)
    [3, 2, 1]
    """
    amounts = np.asarray(amounts, dtype=float)
    if amounts.ndim != 1 or not ((amounts >= 0) & (amounts <= 1)).all():
        raise ValueError(f"amounts must be (L,) from 0 to 1, got {amounts!r}")
    if not tolerance > 0:
        raise ValueError(f"tolerance must be more than 0, got {tolerance!r}")
    if budget is not None and budget < len(amounts):
        raise ValueError(
            f"budget must be {len(amounts)} or more, a part for each line, got {budget!r}"
        )
    left = np.array([[remaining_nonlinearity(a, k) for k in SPLITS] for a in amounts])  # (L, 8)
    counts = [1] * len(amounts)
    while budget is None or sum(counts) < budget:
        open_ = [i for i, k in enumerate(counts) if k < len(SPLITS) and left[i, k - 1] > tolerance]
        if not open_:
            break
        counts[max(open_, key=lambda i: left[i, counts[i] - 1])] += 1
    return counts
