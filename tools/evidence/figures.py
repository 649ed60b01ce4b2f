"""Figures that know how many independent cases they come from."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

#: From this number of independent cases on, a bound has no room for the sampling error.
ENOUGH = 400
#: Room of a bound with fewer cases [standard errors].
ROOM = 4.0


class Statistic(float):
    """Value that is estimated from a number of independent cases."""

    cases: int

    def __new__(cls, value: float, cases: int) -> Statistic:
        """Return the value with its cases."""
        made = super().__new__(cls, value)
        made.cases = cases
        return made

    def room(self, bound: float) -> float:
        """Return by how much the value may be beyond a bound, for its sampling error."""
        return 0.0 if self.cases >= ENOUGH else ROOM * self.error(bound)

    def error(self, bound: float) -> float:
        """Return the standard error of the value if the bound is the true one."""
        raise NotImplementedError


class Share(Statistic):
    """Share of cases; the standard error is that of a binomial distribution."""

    def error(self, bound: float) -> float:
        """Return the standard error at a bound, of a case at least."""
        return max(math.sqrt(bound * (1 - bound) / max(self.cases, 1)), 1 / max(self.cases, 1) / 4)


class Mean(Statistic):
    """Mean of the square of a normal variable, such as NEES for each degree of freedom."""

    def error(self, bound: float) -> float:
        """Return the standard error at a bound."""
        return bound * math.sqrt(2 / max(self.cases, 1))


class Rms(Statistic):
    """Root mean square of a normal variable."""

    def error(self, bound: float) -> float:
        """Return the standard error at a bound."""
        return bound / math.sqrt(2 * max(self.cases, 1))


def quantiles(values: Any, *shares: float) -> dict[str, float]:
    """Return the mean, quantiles and the largest of values, by their names; empty without values.

    >>> quantiles([1.0, 3.0], 0.5)
    {'mean': 2.0, '50 %': 2.0, 'max': 3.0}
    """
    if not len(values):
        return {}
    found = np.quantile(values, shares).tolist()
    named = {f"{100 * share:g} %": value for share, value in zip(shares, found, strict=True)}
    return {"mean": float(np.mean(values)), **named, "max": float(np.max(values))}


def longest(flags: Any) -> Any:
    """Return for how many of k times without a break (k, n) flags are set at most, (n,).

    >>> longest([[True], [True], [False], [True]]).tolist()
    [2.0]
    """
    flags = np.asarray(flags)
    run = best = np.zeros(flags.shape[1])
    for row in flags:
        run = (run + 1) * row
        best = np.maximum(best, run)
    return best


def flat(figures: Mapping[str, Any], head: str = "") -> Iterable[tuple[str, Any]]:
    """Yield the paths and values of nested figures, such as ("paper/KL/mean", 0.002)."""
    for name, value in figures.items():
        if isinstance(value, Mapping):
            yield from flat(value, f"{head}{name}/")
        else:
            yield f"{head}{name}", value
