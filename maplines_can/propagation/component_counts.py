"""Number of mixture components for each line, without or within a common budget."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from .splitting import SPLITS, standard_split

#: Largest nonlinearity of a Gaussian that needs no split: the second-order term then has less than
#: a tenth of its variance.
TOLERANCE = 0.3
#: Largest nonlinearity within the components of a mixture, as a share of the tolerance. It is
#: smaller because a component is a part of a Gaussian and so not Gaussian itself, even if the
#: function is linear. In the street turn with 10 deg of heading uncertainty five components are
#: enough; about 4 % of their mass is on impossible lines.
OF_COMPONENTS = 0.75


def remaining_nonlinearity(amount: float, k: int) -> float:
    """Return the nonlinearity within the components of a ``Mixture`` of k components.

    Like ``Nonlinearity.amount``, it is the standard deviation of the second-order term divided by
    the total standard deviation, here within a component, with variances averaged over the
    components. Let the output have the variance 1 and the function be quadratic, with a
    second-order term of variance a^2 and a squared slope of 1 - a^2 at the mean. A component
    N(m_i, v_i) of ``standard_split`` has a second-order term of the variance v_i^2 a^2. At its mean
    the squared slope is larger by 2 a^2 m_i^2, averaged over +m_i and -m_i. The result is

        a_k^2 = a^2 sum w_i v_i^2 / sum w_i (a^2 v_i^2 + (1 - a^2 + 2 a^2 m_i^2) v_i).

    The nonlinearity is smaller if the output also varies with other directions than that of the
    split, or has noise of its own. Terms above the second order are ignored; in a tight turn the
    outer components therefore have more.

    Args:
        amount: ``Nonlinearity.amount`` of the Gaussian before the split.
        k: number of components, 1 to 8.

    >>> [round(remaining_nonlinearity(0.8, k), 2) for k in (1, 2, 5, 8)]
    [0.8, 0.41, 0.18, 0.11]
    """
    weights, means, variances = standard_split(k)
    second = weights @ (amount * variances) ** 2
    first = weights @ ((1 - amount**2 + 2 * amount**2 * means**2) * variances)
    return float(np.sqrt(second / (second + first)))


def component_counts(
    amounts: ArrayLike, *, tolerance: float = TOLERANCE, budget: int | None = None
) -> list[int]:
    """Return the smallest numbers of components, 1 to 8 a line, that meet the tolerance.

    A single Gaussian may have the nonlinearity ``tolerance``; within the components of a mixture,
    three quarters of it are allowed.

    If the budget is too small for that, the largest remaining nonlinearity is as small
    as the budget allows: each component goes to the line with the largest remaining
    nonlinearity. This is optimal, since a further component never increases it. A line
    that does not meet the tolerance with eight components keeps eight.

    Args:
        amounts: (L,) ``Nonlinearity.amount`` of each line, from 0 to 1.
        tolerance: largest nonlinearity of a line that needs no split, more than 0.
        budget: number of components of all lines together, L or more; None for no limit.

    Raises:
        ValueError: an amount, the tolerance or the budget is out of its range.

    >>> component_counts([0.87, 0.39, 0.03])
    [5, 2, 1]
    >>> component_counts([0.87, 0.39, 0.03], budget=6)
    [3, 2, 1]
    """
    amounts = np.asarray(amounts, dtype=float)
    if amounts.ndim != 1 or not ((amounts >= 0) & (amounts <= 1)).all():
        raise ValueError(f"amounts must have shape (L,) with values from 0 to 1, got {amounts!r}")
    if not tolerance > 0:
        raise ValueError(f"tolerance must be more than 0, got {tolerance!r}")
    if budget is not None and budget < len(amounts):
        raise ValueError(
            f"budget must be {len(amounts)} or more, one component for each line, got {budget!r}"
        )
    remaining = np.array([[remaining_nonlinearity(a, k) for k in SPLITS] for a in amounts])
    counts = [1] * len(amounts)
    while budget is None or sum(counts) < budget:
        now = [remaining[i, k - 1] for i, k in enumerate(counts)]
        limits = [tolerance if k == 1 else OF_COMPONENTS * tolerance for k in counts]
        unmet = [i for i, k in enumerate(counts) if k < len(SPLITS) and now[i] > limits[i]]
        if not unmet:
            break
        counts[max(unmet, key=now.__getitem__)] += 1
    return counts
