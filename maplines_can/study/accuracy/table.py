"""The table of truth: how well each representation of a line stands for its true distribution.

The true distribution is a Monte Carlo sample, as in the paper (Map Line Interface, IV).
Definitions, for one line of a scene:

- false negatives: share of the true samples outside the 99 % region of the approximation, in
  all four parameters and in the marginal of each pair of them (mean over the six pairs);
- false positives: mass of the approximation outside the true region of each pair's marginal
  (mean over the six). That region is the fewest cells of a 60 x 60 grid over the range of the
  samples that hold 99 % of them: a perfect representation has 1 % as well;
- KL: from the Gaussian with the moments of the samples to that with the representation's;
- lateral band at 0, 20, 40 and 80 m: the representation's mean of l(x) less that of the samples,
  and its standard deviation of l(x) over theirs; to first order about each mean, as a
  receiver reckons it;
- coverage: share of the true samples inside the 99 % region, in all four parameters.

A mean alone is a point: by definition its false negatives are 1, its false positives 0, its KL
infinite and its band has no width. A singular covariance has a region without
volume: its false negatives in four parameters are 1 and its KL is infinite.

The sampling error beside a figure is that of the samples which judge it, with the
representation as it is: binomial for shares, a jackknife over ten batches for the others.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

from ...line import Slot
from ...propagation import MonteCarlo, Refit
from ...scenarios import SCENARIOS, Scenario
from ...wire import Codec
from .approximations import representations, through_the_wire
from .evaluation import Row, judged, truth_of

__all__ = ["accuracy_table", "refit_of"]

#: Rows judged at once; numpy works outside of Python's lock.
WORKERS = 2


def accuracy_table(
    scenarios: Sequence[Scenario] | None = None,
    *,
    n: int = 1_000_000,
    seed: int = 0,
    slot: Slot = Slot.EGO_RIGHT,
    codec: Codec | None = None,
    progress: Callable[[int, int], object] | None = None,
) -> list[Row]:
    """Judge all representations of a line, before and after the wire, in each scene.

    The same arguments give the same rows. Draws from which no cubic follows the
    points are left out of the truth, as ``MonteCarlo`` leaves them out.

    Args:
        scenarios: by default all of the package's.
        n: samples of the truth.
        seed: of all draws.
        slot: the line of each scene.
        codec: of the wire; by default the project's own.
        progress: called after each row with the number done and the number of all.

    Raises:
        ValueError: a scene has no such line, n is too small, or a line does not fit the wire.
    """
    scenes = list(SCENARIOS.values()) if scenarios is None else list(scenarios)
    codec = codec or Codec.from_dbc()
    rows: list[Row] = []
    for scene in scenes:
        refit = refit_of(scene, slot)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # ill-posed draws, which are left out
            truth = truth_of(MonteCarlo(n, seed).samples(refit, scene.ego).values)
            kinds = representations(refit, scene.ego, n=n, seed=seed)
        jobs = []
        for name, before in kinds.items():
            diagonal = name == "mean and sigmas"
            after = through_the_wire(before, codec, slot, refit.x_range, diagonal=diagonal)
            for where, approximation in (("before", before), ("after", after)):
                jobs.append((truth, approximation, (scene.name, name, where), seed))
        # Each row draws from the seed alone: threads change the time and nothing else.
        with ThreadPoolExecutor(WORKERS) as pool:
            for row in pool.map(judged, *zip(*jobs, strict=True)):
                rows.append(row)
                if progress is not None:
                    progress(len(rows), len(jobs) * len(scenes))
    return rows


def refit_of(scene: Scenario, slot: Slot) -> Refit:
    """From pose to line, for one line of a scene.

    Raises:
        ValueError: the scene has no such line.
    """
    for line in scene.lines:
        if line.slot == slot:
            return Refit(line.polyline, scene.ego.mean, scene.window)
    raise ValueError(
        f"scenario {scene.name!r} has no line {slot.name}; "
        f"there are {', '.join(line.slot.name for line in scene.lines)}"
    )
