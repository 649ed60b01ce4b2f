#!/usr/bin/env python3
"""Count the hours in which an error exceeds protection levels for a range of what is stated.

    evidence_levels.py                2000 h for each row, at a risk of 0.05 in an hour
    evidence_levels.py --hours 300    fewer

Run it in the environment of the project: python3 tools/run.py python tools/evidence_levels.py

Errors are sums of Gauss-Markov processes and white noise, at 20 Hz. Stated is a correlation time of
5 s; the true errors have another time, a share of white noise, or another standard deviation: at
each end of what the level is for, and between. Each row has the share of the hours in which the
error exceeds the level for what is stated (exact) and the level for the range (range), with its
standard error. Where the range covers the error, the share must be at most 0.05, within 3.3
standard errors.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from reporting import parser_of, progress, report
from scipy.signal import lfilter

from maplines_can.consumers.integrity import HOUR, PERIOD, Tolerance, multiplier

Array = NDArray[np.float64]

RISK = 0.05  #: in an hour
STATED = 5.0  #: correlation time [s]
#: Hours that are drawn at once.
CHUNK = 50
#: Allowed deviation in standard errors.
LIMIT = 3.3

#: Return (n,) ratios of true standard deviations to the stated one, each for an hour.
Ratios = Callable[[int, np.random.Generator], Array]


class Row(NamedTuple):
    """A true error, and the range for which the level is."""

    parts: tuple[tuple[float, float], ...]  #: shares of the variance and their times [s]; 0: white
    shortest: float = STATED  #: correlation time [s]
    tolerance: Tolerance = Tolerance()
    ratios: Ratios = lambda n, _: np.ones(n)


WHITE = Tolerance(white_share=0.3)
SIGMA = Tolerance(sigma_ratio=1.3)
SPREAD = Tolerance(sigma_spread=0.3)
ROWS = {
    "as stated": Row(((1.0, 5.0),)),
    "30 % white": Row(((0.7, 5.0), (0.3, 0.0)), 5.0, WHITE),
    "10 % white": Row(((0.9, 5.0), (0.1, 0.0)), 5.0, WHITE),
    "30 % white, any time": Row(((0.7, 5.0), (0.3, 0.0)), 0.0),
    "a tenth of the time": Row(((1.0, 0.5),), 0.5),
    "a third of the time": Row(((1.0, 1.7),), 0.5),
    "a tenth of the time, any time": Row(((1.0, 0.5),), 0.0),
    "half 0.5 s, half 30 s": Row(((0.5, 0.5), (0.5, 30.0)), 0.5),
    "30 s": Row(((1.0, 30.0),), 0.5),
    "sigma 30 % greater": Row(((1.0, 5.0),), 5.0, SIGMA, lambda n, _: np.full(n, 1.3)),
    "sigma within 30 %": Row(((1.0, 5.0),), 5.0, SIGMA, lambda n, rng: rng.uniform(0.7, 1.3, n)),
    "sigma of normal spread 30 %": Row(
        ((1.0, 5.0),), 5.0, SPREAD, lambda n, rng: np.abs(1 + 0.3 * rng.standard_normal(n))
    ),
    "sigma of log-normal spread 30 %": Row(
        ((1.0, 5.0),), 5.0, SPREAD, lambda n, rng: np.exp(0.3 * rng.standard_normal(n))
    ),
    "30 % white, a tenth of the time, sigma 30 % greater": Row(
        ((0.7, 0.5), (0.3, 0.0)), 0.5, Tolerance(0.3, 1.3), lambda n, _: np.full(n, 1.3)
    ),
}


def largest(row: Row, hours: int, rng: np.random.Generator) -> Array:
    """Return the largest absolute error of each hour, in stated standard deviations."""
    samples, found = round(HOUR / PERIOD), []
    for first in range(0, hours, CHUNK):
        count = min(CHUNK, hours - first)
        error = np.zeros((count, samples))
        for share, time in row.parts:
            noise = rng.standard_normal((count, samples))
            if time > 0:
                rho = math.exp(-PERIOD / time)
                noise[:, 1:] *= math.sqrt(1 - rho**2)
                noise = lfilter([1.0], [1.0, -rho], noise, axis=1)
            error += math.sqrt(share) * noise
        found.append(row.ratios(count, rng) * np.abs(error).max(axis=1))
    return np.concatenate(found)


def share_above(errors: Array, K: float) -> dict[str, float]:
    """Return the share of (n,) largest errors above a level, with its standard error."""
    share = float((errors > K).mean())
    deviation = math.sqrt(max(share * (1 - share), 1 / len(errors)) / len(errors))
    return {"K": K, "share of the hours": share, "standard error": deviation}


def main(argv: list[str] | None = None) -> int:
    """Print the figures; return 0 if no level for a range is exceeded too often, else 1."""
    parser = parser_of(__doc__)
    parser.add_argument("--hours", type=int, default=2000, help="for each row (default: 2000)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args(argv)
    return report(run(arguments), arguments.json, 24)


def run(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the figures."""
    result: dict[str, Any] = {}
    met = True
    exact = multiplier(RISK, STATED)
    for i, (name, row) in enumerate(progress(ROWS.items(), "rows", len(ROWS))):
        errors = largest(row, arguments.hours, np.random.default_rng([arguments.seed, i]))
        K = multiplier(RISK, row.shortest, tolerance=row.tolerance)
        ranged = share_above(errors, K)
        ranged["met"] = ranged["share of the hours"] <= RISK + LIMIT * ranged["standard error"]
        met &= bool(ranged["met"])
        result[name] = {"exact": share_above(errors, exact), "range": ranged}
    return result | {"met": met}


if __name__ == "__main__":
    sys.exit(main())
