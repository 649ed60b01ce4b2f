"""Longest range in which a cubic can follow a line, by Chebyshev fits (linear programming)."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linprog

from .witness import WINDOW, Array

#: Largest deviation of the cubic [m].
MAX_MISFIT = 0.1
#: A line is a function y(x) while it deviates by less from the car's x axis [rad].
TURN = np.radians(65.0)


def chebyshev_misfit(x: Array, y: Array) -> float:
    """Return the least possible largest deviation of a cubic from (n,) points [m]."""
    w = (x - x.mean()) / max(np.ptp(x) / 2, 1e-9)
    A, one = np.vander(w, 4), np.ones((len(x), 1))
    solution = linprog(
        [0, 0, 0, 0, 1],
        A_ub=np.block([[A, -one], [-A, -one]]),
        b_ub=np.append(y, -y),
        bounds=[(None, None)] * 4 + [(0, None)],
        method="highs",
    )
    return float(solution.x[4])


class View:
    """Line as a function y(x), as a car sees it from its mean pose."""

    def __init__(self, local: Array, nearest: int) -> None:
        steps = np.diff(local, axis=0)
        along = steps[:, 0] >= np.cos(TURN) * np.hypot(*steps.T)
        self.is_seen = bool(along[nearest])
        across = np.flatnonzero(~along)
        first = across[across < nearest].max(initial=-1) + 1
        last = across[across > nearest].min(initial=len(steps))
        self.x, self.y = local[first : last + 1].T
        self.low, self.high = max(WINDOW[0], self.x[0]), min(WINDOW[1], self.x[-1])

    def holds(self, low: float, high: float) -> bool:
        """Return whether a cubic follows the line from low to high within ``MAX_MISFIT``."""
        inside = self.x[(self.x > low) & (self.x < high)]
        if len(inside) > 60:
            inside = inside[np.linspace(0, len(inside) - 1, 60).astype(int)]
        x = np.union1d(np.linspace(low, high, 61), inside)
        y = np.interp(x, self.x, self.y)
        squares = np.polynomial.Polynomial.fit(x, y, 3)
        return np.abs(squares(x) - y).max() <= MAX_MISFIT or chebyshev_misfit(x, y) <= MAX_MISFIT

    def farthest(self, low: float, least: float) -> float:
        """Return how far a cubic follows the line from low, at least to ``least`` [m]."""
        if self.holds(low, self.high):
            return self.high
        inner, outer = least, self.high
        while outer - inner > 0.1:
            middle = (inner + outer) / 2
            inner, outer = (middle, outer) if self.holds(low, middle) else (inner, middle)
        return inner

    def longest(self, known: float) -> float:
        """Return the longest range about the car that a cubic follows, at least ``known`` [m]."""
        car, best = min(max(0.0, self.low), self.high), known
        for begin in np.linspace(car, self.low, 11 if self.low < car else 1):
            end = max(begin + best + 0.1, car)
            if end < self.high and self.holds(begin, end):
                best = self.farthest(begin, end) - begin
            elif end >= self.high > begin + best and self.holds(begin, self.high):
                best = self.high - begin
        return float(best)
