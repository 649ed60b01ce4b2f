"""Weighted sums of lateral positions: what a consumer may compute from the Gaussian over a cubic.

z is such a sum of the true line, less that of the mean, in units of the standard deviation that the
Gaussian gives the sum.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from .figures import Rms, Share, quantiles
from .witness import Array

#: Distances of slopes and of second differences, and where they begin [m].
SLOPES, SECONDS = (10.0, 20.0), (5.0, 10.0, 20.0)
SLOPES_AT, SECONDS_AT = (0.0, 20.0, 40.0), (-5.0, 0.0, 5.0, 10.0, 20.0, 30.0, 40.0)
#: Where the lateral position is evaluated, and where its standard deviation is compared [m].
Y_AT, SIGMA_AT = (0.0, 20.0, 40.0), (0.0, 40.0, 80.0)


class Sums(NamedTuple):
    """F weighted sums of lateral positions at three places each; unused ones have no weight."""

    names: tuple[str, ...]  #: of the figures to which they belong
    x: Array  #: (F, 3) [m]
    weights: Array  #: (F, 3)

    @classmethod
    def of(cls, rows: Sequence[tuple[str, Sequence[float], Sequence[float]]]) -> Sums:
        """Return the sums of names, places [m] and weights."""
        filled = [
            (n, [*x, *[x[0]] * (3 - len(x))], [*w, *[0.0] * (3 - len(w))]) for n, x, w in rows
        ]
        names, x, weights = zip(*filled, strict=True)
        return cls(names, np.array(x), np.array(weights))

    def within(self, x_min: float, x_max: float) -> Sums:
        """Return those of which all places are in a range [m]."""
        kept = np.flatnonzero(((self.x >= x_min) & (self.x <= x_max)).all(axis=1))
        return Sums(tuple(self.names[i] for i in kept), self.x[kept], self.weights[kept])


def _sums() -> Iterator[tuple[str, Sequence[float], Sequence[float]]]:
    yield from (("y", (x,), (1.0,)) for x in Y_AT)
    for d in SLOPES:
        yield from ((f"slope {d:g} m", (x, x + d), (-1 / d, 1 / d)) for x in SLOPES_AT)
    for d in SECONDS:
        for x in SECONDS_AT:
            yield f"2nd {d:g} m", (x, x + d, x + 2 * d), (1.0, -2.0, 1.0)
    # The mean of the curvature over 10 m about the car, and ahead of it, with triangular weights.
    for x in (-5.0, 0.0):
        yield "curvature", (x, x + 5.0, x + 10.0), (0.04, -0.08, 0.04)


#: Those of one line, and those of the difference of two.
OF_LINE = Sums.of([*_sums()])
OF_WIDTH = Sums.of([(f"width, {name}", x, w) for name, x, w in _sums() if name != "curvature"])


class Given(NamedTuple):
    """Joint distribution of L lines that a consumer has."""

    means: Array  #: (L, 4)
    cov: Array  #: (4 L, 4 L)
    ranges: Array  #: (L, 2) in which the lines are valid [m]

    def z(self, sums: Sums, lines: Sequence[int], true: Callable[[int, float], Array]) -> Array:
        """Return (F, D) z of sums of a line, or of the first line less the second.

        ``true`` gives the (D,) true lateral positions of a line at x [m].
        """
        means, variances = self.moments(sums, lines)
        at = [{x: true(i, x) for x in np.unique(sums.x)} for i in lines]
        values = 0.0
        for sign, y in zip((1, -1), at, strict=False):
            places = np.array([[y[x] for x in row] for row in sums.x])  # (F, 3, D)
            weights = np.broadcast_to(sign * sums.weights[:, :, None], places.shape)
            # A place without weight may be one that the line does not cross.
            values = values + np.where(weights == 0, 0.0, weights * places).sum(axis=1)
        return np.asarray((values - means[:, None]) / np.sqrt(variances)[:, None])

    def moments(self, sums: Sums, lines: Sequence[int]) -> tuple[Array, Array]:
        """Return the (F,) means and variances of sums of a line or of a difference of two."""
        mean = np.zeros(len(sums.names))
        J = np.zeros((len(mean), len(self.cov)))
        for sign, i in zip((1, -1), lines, strict=False):
            y_off, beta, c0, c1 = self.means[i]
            x, w = sums.x, sign * sums.weights
            y = y_off + np.tan(beta) * x + c0 / 2 * x**2 + c1 / 6 * x**3  # (F, 3)
            mean += (w * y).sum(axis=-1)
            slope = (1 + np.tan(beta) ** 2) * x
            rows = np.array([np.ones_like(slope), slope, x**2 / 2, x**3 / 6])
            J[:, 4 * i : 4 * i + 4] += np.einsum("ft,pft->fp", w, rows)
        return mean, np.einsum("fi,ij,fj->f", J, self.cov, J)


class Tally:
    """z of sums, ranges, and counts of the lines of a shape of road, or of a map."""

    def __init__(self) -> None:
        self.z: dict[str, list[Array]] = {}
        self.values: dict[str, list[float]] = {}
        self.counts: dict[str, int] = dict.fromkeys(("lines", "ahead", "refused"), 0)

    def add(self, other: Tally) -> None:
        """Add what another one has."""
        for name, z in other.z.items():
            self.z.setdefault(name, []).extend(z)
        for name, values in other.values.items():
            self.values.setdefault(name, []).extend(values)
        for name, count in other.counts.items():
            self.counts[name] += count

    def put(self, name: str, value: float) -> None:
        """Add a value of a quantity."""
        self.values.setdefault(name, []).append(value)

    def evaluate(self, given: Given, true: Callable[[int, float], Array]) -> None:
        """Evaluate the lines, and the difference of the first two of a scene."""
        for i, (low, high) in enumerate(given.ranges):
            ends = Sums.of([("y at x_min", (low,), (1.0,)), ("y at x_max", (high,), (1.0,))])
            self._add(given, OF_LINE.within(low, high), [i], true)
            self._add(given, ends, [i], true)
            self.put("range [m]", high - low)
        if len(given.ranges) > 1:
            low, high = given.ranges[:2, 0].max(), given.ranges[:2, 1].min()
            self._add(given, OF_WIDTH.within(low, high), [0, 1], true)

    def _add(self, given: Given, sums: Sums, lines: list[int], true: Any) -> None:
        if sums.names:
            for name, values in zip(sums.names, given.z(sums, lines, true), strict=True):
                self.z.setdefault(name, []).append(values)

    def figures(self) -> dict[str, Any]:
        """Return all figures by name; a line that does not cross x counts as beyond 3 sigma."""
        z = {name: (np.concatenate(many), len(many)) for name, many in sorted(self.z.items())}
        counts = self.counts
        return {
            **counts,
            "refused with 15 m ahead": Share(
                counts["refused"] / max(counts["ahead"], 1), counts["ahead"]
            ),
            "beyond 3 sigma": {
                name: Share(float((~(np.abs(v) <= 3)).mean()), n) for name, (v, n) in z.items()
            },
            "rms": {name: Rms(float(np.sqrt(np.nanmean(v**2))), n) for name, (v, n) in z.items()},
            **{name: quantiles(values, 0.05, 0.5) for name, values in self.values.items()},
        }
