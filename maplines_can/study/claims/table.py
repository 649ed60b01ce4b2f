"""Accuracy of each representation of a line against its true distribution.

The true distribution is a Monte Carlo sample, as in the paper (Map Line Interface, IV).
Definitions, for one line of a scenario:

- false negatives: share of the true samples outside the 99 % region of the approximation, in
  all four parameters and in the marginal of each pair of them (mean over the six pairs);
- false positives: mass of the approximation outside the true region of each pair's marginal
  (mean over the six pairs). The true region is the smallest set of cells of a 60 x 60 grid over
  the range of the samples that holds 99 % of them. A perfect representation has 1 %;
- KL: Kullback-Leibler divergence from the Gaussian with the moments of the samples to the one
  with the moments of the representation;
- lateral band at 0, 20, 40 and 80 m: mean of l(x) of the representation minus that of the
  samples, and the ratio of the two standard deviations of l(x). The representation is
  linearized about each mean, as a receiver does it;
- coverage: share of the true samples inside the 99 % region, in all four parameters.

A mean alone is a point. By definition its false negatives are 1, its false positives 0, its KL
is infinite and its band has no width. The region of a singular covariance has no volume: its
false negatives in four parameters are 1 and its KL is infinite.

The standard error of a figure is that of the true samples with the representation held fixed:
binomial for shares, a jackknife over ten batches for the other figures.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from ...propagation import MonteCarlo
from ...simulation.scenarios import SCENARIOS, Scenario
from ...values.line import Slot
from ...wire import Codec
from ..paper_refit import paper_refit
from .approximations import representations, through_the_wire
from .evaluation import ClaimRow, evaluate_approximation, true_distribution

#: Rows computed at once; numpy releases Python's lock.
WORKERS = 2


def accuracy_table(
    scenarios: Sequence[Scenario] | None = None,
    *,
    n: int = 1_000_000,
    seed: int = 0,
    slot: Slot = Slot.EGO_RIGHT,
    codec: Codec | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> list[ClaimRow]:
    """Evaluate all representations of a line, before and after the wire, in each scenario.

    The same arguments give the same rows. Like ``MonteCarlo``, the true distribution leaves out
    draws from which no cubic follows the points.

    Args:
        scenarios: by default all of the package's.
        n: samples of the true distribution.
        seed: of all draws.
        slot: the line of each scenario.
        codec: of the wire; by default the project's own.
        progress: called after each row with the number of rows done and the number of all rows.

    Raises:
        ValueError: a scenario has no such line, n is too small, or a line does not fit the
            messages.
    """
    scenarios = list(SCENARIOS.values() if scenarios is None else scenarios)
    codec = codec or Codec.from_dbc()
    rows: list[ClaimRow] = []
    for scenario in scenarios:
        refit = paper_refit(scenario, slot)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # ill-posed draws, which are left out
            true = true_distribution(MonteCarlo(n, seed).samples(refit, scenario.ego).values)
            kinds = representations(refit, scenario.ego, n=n, seed=seed)
        jobs = []
        for name, before in kinds.items():
            diagonal = name == "mean and sigmas"
            after = through_the_wire(before, codec, slot, refit.x_range, diagonal=diagonal)
            for side, approximation in (("before", before), ("after", after)):
                jobs.append((true, approximation, (scenario.name, name, side), seed))
        # Each row draws from the seed alone, so that threads do not change the result.
        with ThreadPoolExecutor(WORKERS) as pool:
            for row in pool.map(evaluate_approximation, *zip(*jobs, strict=True)):
                rows.append(row)
                if progress is not None:
                    progress(len(rows), len(jobs) * len(scenarios))
    return rows
