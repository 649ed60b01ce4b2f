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
from dataclasses import dataclass
from itertools import chain, combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..propagation import Linear, MonteCarlo, Quadrature, Refit, SigmaPoints, Transform
from ..propagation.splitting import Mixture
from ..simulation.scenarios import SCENARIOS, Scenario
from ..values.coding_loss import LATERAL_X
from ..values.gaussian import Gaussian
from ..values.line import PARAMETERS, Slot, Status, lateral, lateral_jacobian
from ..values.mixture import GaussianMixture
from ..values.text_table import aligned, csv_text, markdown
from ..wire import Codec
from .roads import paper_refit

Array = NDArray[np.float64]

#: Draws of the transform MonteCarlo, as many as it takes by default.
MONTE_CARLO_DRAWS = 100_000


@dataclass(frozen=True, eq=False)
class Approximation:
    """Approximation of a line's distribution: a point, a Gaussian or a mixture."""

    weights: Array  #: (k,), with the sum 1
    means: Array  #: (k, 4)
    covs: Array | None = None  #: (k, 4, 4), which may be singular; None for a point

    @classmethod
    def gaussian(cls, mean: ArrayLike, cov: ArrayLike | None) -> Approximation:
        """Return one Gaussian, or a point if ``cov`` is None."""
        covs = None if cov is None else np.asarray(cov, dtype=float)[None]
        return cls(np.ones(1), np.asarray(mean, dtype=float)[None], covs)


def representations(
    refit: Refit, ego: Gaussian, *, n: int = MONTE_CARLO_DRAWS, seed: int = 0
) -> dict[str, Approximation]:
    """Return the representations of a line that a sender can choose from, by name.

    Args:
        refit: from pose to line.
        ego: the pose.
        n: upper limit of the Monte Carlo draws.
        seed: Monte Carlo uses seed + 1, so that its draws are not those of the true distribution.
    """
    transforms: dict[str, Transform] = {
        "Linear": Linear(),
        "SigmaPoints": SigmaPoints(),
        "Quadrature": Quadrature(),
        "MonteCarlo": MonteCarlo(min(n, MONTE_CARLO_DRAWS), seed + 1),
    }
    moments = {name: transform.moments(refit, ego) for name, transform in transforms.items()}
    mean, cov = moments["MonteCarlo"]
    found = {
        "mean": Approximation.gaussian(mean, None),
        "mean and sigmas": Approximation.gaussian(mean, np.diag(cov.diagonal())),
    }
    found |= {name: Approximation.gaussian(*both) for name, both in moments.items()}
    for k in (3, 5):
        found[f"mixture of {k}"] = Approximation(*Mixture(k).moments(refit, ego))
    return found


def through_the_wire(
    approximation: Approximation,
    codec: Codec,
    slot: Slot,
    x_range: Array,
    *,
    diagonal: bool = False,
) -> Approximation:
    """Encode and decode an approximation; with ``diagonal``, send only the variances.

    Raises:
        ValueError: it does not fit the messages.
    """
    weights, means, covs = approximation.weights, approximation.means, approximation.covs
    if len(means) > 1 and covs is not None:
        payloads = codec.batch.encode_mixtures(
            weights[None], means[None], covs[None], slot=slot, x_min=x_range[0], x_max=x_range[1]
        )[0]
    else:
        status = None if covs is None else Status.DIAGONAL if diagonal else Status.FULL
        payloads = codec.batch.encode(
            means, covs, slot=slot, x_min=x_range[0], x_max=x_range[1], status=status
        )
    batch = codec.batch.decode(payloads, slot=slot)
    if not batch.accepted.all() or (batch.status == Status.OUT_OF_RANGE).any():
        raise ValueError(
            f"a line of mean {means.tolist()} does not fit the messages of {codec.layout.source}"
        )
    return Approximation(batch.component_weight, batch.mean, None if covs is None else batch.cov)


# ---- evaluation ---------------------------------------------------------------------------------

#: Mass of the regions.
MASS = 0.99
#: Cells of the grid along each parameter.
BINS = 60
#: Batches of the samples, for the jackknife.
BATCHES = 10
#: Draws from each approximation, for its mass outside the true region.
DRAWS = 400_000
#: Smallest eigenvalue of the correlation matrix below which a covariance is singular.
SINGULAR = 1e-12
PAIRS = tuple(combinations(range(len(PARAMETERS)), 2))


@dataclass(frozen=True)
class ClaimRow:
    """Figures of one representation of a scenario's line; ``_se`` is a figure's standard error."""

    scenario: str
    representation: str
    wire: str  #: "before" or "after"
    false_negatives: float  #: in all four parameters
    false_negatives_se: float
    false_negatives_pairs: float  #: mean over the six pairs
    false_negatives_pairs_se: float
    false_positives: float  #: mean over the six pairs
    false_positives_se: float
    kl: float  #: [nat]
    kl_se: float
    mean_error: tuple[float, ...]  #: of l(x) at each of LATERAL_X [m]
    mean_error_se: tuple[float, ...]
    sigma_ratio: tuple[float, ...]  #: of l(x) at each of LATERAL_X
    sigma_ratio_se: tuple[float, ...]

    @property
    def coverage(self) -> float:
        """Share of the true samples inside the region, in all four parameters."""
        return 1 - self.false_negatives

    @property
    def coverage_se(self) -> float:
        """Standard error of the coverage."""
        return self.false_negatives_se


@dataclass(frozen=True, eq=False)
class TrueDistribution:
    """Samples of the true distribution, with moments and regions for the jackknife.

    Arrays of 1 + BATCHES entries have one for all samples, then one without each batch.
    """

    samples: Array  #: (n, 4)
    low: Array  #: (4,) lower ends of the grid
    width: Array  #: (4,) of its cells
    regions: NDArray[np.bool_]  #: (1 + BATCHES, 6, BINS + 2, BINS + 2); the border is outside
    moments: tuple[Gaussian, ...]  #: 1 + BATCHES
    lateral_mean: Array  #: (1 + BATCHES, X) [m]
    lateral_sigma: Array  #: (1 + BATCHES, X) [m]


def true_distribution(samples: Array) -> TrueDistribution:
    """Return the true distribution of (n, 4) samples.

    Raises:
        ValueError: fewer than 100 samples.
    """
    if not len(samples) >= 10 * BATCHES:
        raise ValueError(f"n must be {10 * BATCHES} or more, got {len(samples)!r}")
    low, high = samples.min(axis=0), samples.max(axis=0)
    width = np.where(high > low, high - low, 1.0) / BINS
    x = np.array(LATERAL_X)
    mean, line_mean = samples.mean(axis=0), lateral(samples.mean(axis=0), x)
    sums = []
    for batch in np.array_split(samples, BATCHES):
        cells = _cells(batch, low, width).clip(1, BINS)  # rounding moves no sample out
        d, e = batch - mean, lateral(batch[:, None, :], x) - line_mean
        moments = (d.sum(axis=0), d.T @ d, e.sum(axis=0), (e**2).sum(axis=0))
        sums.append((len(batch), _counts(cells), *moments))

    def left(values: tuple[Array, ...]) -> Array:
        """Return the sum of all batches, then the sums that leave out one batch."""
        parts = np.array(values, dtype=float)
        whole = parts.sum(axis=0)
        return np.concatenate([whole[None], whole - parts])

    size, counts, *totals = map(left, zip(*sums, strict=True))
    first, second, line, line2 = (
        total / size.reshape(-1, *[1] * (total.ndim - 1)) for total in totals
    )
    return TrueDistribution(
        samples=samples,
        low=low,
        width=width,
        regions=np.array([[densest(pair) for pair in count] for count in counts]),
        moments=tuple(
            Gaussian(mean + a, S - np.outer(a, a)) for a, S in zip(first, second, strict=True)
        ),
        lateral_mean=line_mean + line,
        lateral_sigma=np.sqrt((line2 - line**2).clip(0)),
    )


def evaluate_approximation(
    true: TrueDistribution,
    approximation: Approximation,
    names: tuple[str, str, str],
    seed: int = 0,
) -> ClaimRow:
    """Return all figures of one representation.

    Args:
        true: the true distribution.
        approximation: the representation.
        names: scenario, representation, and "before" or "after".
        seed: of the draws from the approximation, which are the same before and after the wire.
    """
    weights, means, covs = approximation.weights, approximation.means, approximation.covs
    if covs is None:
        negatives, pairs, positives, kl = (1.0, 0.0), (1.0, 0.0), (0.0, 0.0), (np.inf, 0.0)
    else:
        mixture = GaussianMixture(weights, tuple(map(Gaussian, means, covs)))
        draws = _draws(mixture, seed)
        negatives, pairs = _false_negatives(true.samples, mixture, draws)
        positives, kl = _false_positives(true, draws), _kl(true, mixture.overall)
    x = np.array(LATERAL_X)
    lines = lateral(means[:, None, :], x)  # (k, X)
    mean, sigma = weights @ lines, np.zeros(len(x))
    if covs is not None:
        J = lateral_jacobian(means[:, None, :], x)
        within = np.einsum("kxi,kij,kxj->kx", J, covs, J)
        sigma = np.sqrt(weights @ (within + (lines - mean) ** 2))
    ratios = sigma / true.lateral_sigma
    return ClaimRow(
        *names,
        *negatives,
        *pairs,
        *positives,
        *kl,
        mean_error=tuple((mean - true.lateral_mean[0]).tolist()),
        mean_error_se=tuple(_jackknife(true.lateral_mean).tolist()),
        sigma_ratio=tuple(ratios[0].tolist()),
        sigma_ratio_se=tuple(_jackknife(ratios).tolist()),
    )


def _jackknife(values: Array) -> Array:
    """Return the standard error from (1 + BATCHES, ...) values; 0 if one is not finite."""
    if not np.isfinite(values).all():
        return np.zeros(values.shape[1:])
    spread = ((values[1:] - values[1:].mean(axis=0)) ** 2).sum(axis=0)
    return np.asarray(np.sqrt((BATCHES - 1) / BATCHES * spread), dtype=float)


# -- false positives ------------------------------------------------------------


def _cells(samples: Array, low: Array, width: Array) -> NDArray[np.intp]:
    """Return the (n, 4) cells of samples, 1 to BINS; 0 and BINS + 1 are outside the grid."""
    return np.floor((samples - low) / width).clip(-1, BINS).astype(np.intp) + 1


def _counts(cells: NDArray[np.intp]) -> NDArray[np.intp]:
    """Return the (6, BINS + 2, BINS + 2) number of samples in each cell of each pair."""
    side = BINS + 2
    return np.array(
        [
            np.bincount(cells[:, i] * side + cells[:, j], minlength=side**2).reshape(side, side)
            for i, j in PAIRS
        ]
    )


def densest(count: Array) -> NDArray[np.bool_]:
    """Return the smallest set of cells that holds ``MASS`` of the samples."""
    order = np.argsort(-count, axis=None, kind="stable")
    total = np.cumsum(count.ravel()[order])
    chosen = np.zeros(count.size, dtype=bool)
    chosen[order[: int(np.searchsorted(total, MASS * total[-1])) + 1]] = True
    return chosen.reshape(count.shape)


def _draws(mixture: GaussianMixture, seed: int) -> Array:
    """Draw (DRAWS, 4) samples, stratified: each component gets exactly its share.

    The normal numbers are the same before and after the wire.
    """
    draws = np.random.default_rng([seed, 3]).standard_normal((DRAWS, len(PARAMETERS)))
    edges = np.round(np.cumsum(mixture.weights) * DRAWS).astype(int)
    for start, end, component in zip((0, *edges), edges, mixture.components, strict=False):
        draws[start:end] = component.mean + draws[start:end] @ component.root.T
    return draws


def _false_positives(true: TrueDistribution, draws: Array) -> tuple[float, float]:
    cells = _cells(draws, true.low, true.width)
    inside = np.einsum("bpij,pij->b", true.regions, _counts(cells)) / (len(draws) * len(PAIRS))
    out = np.zeros(len(draws))
    for region, (i, j) in zip(true.regions[0], PAIRS, strict=True):
        out += ~region[cells[:, i], cells[:, j]]
    own = out.std() / len(PAIRS) / np.sqrt(len(draws))
    return float(1 - inside[0]), float(np.hypot(own, _jackknife(inside)))


# -- false negatives and KL -----------------------------------------------------


def _false_negatives(
    samples: Array, mixture: GaussianMixture, draws: Array
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return share and standard error in four parameters, and as the mean over the pairs."""
    (four, edge_error), *pairs = (
        _outside(mixture, list(columns), samples, draws) for columns in (range(4), *PAIRS)
    )
    edge = max(edge_error, *(error for _, error in pairs))
    of_pairs = np.mean([out for out, _ in pairs], axis=0)
    return tuple(  # type: ignore[return-value]  # two of them
        (float(out.mean()), float(np.hypot(out.std() / np.sqrt(len(samples)), edge)))
        for out in (four, of_pairs)
    )


def _outside(
    mixture: GaussianMixture, columns: list[int], samples: Array, draws: Array
) -> tuple[NDArray[np.bool_], float]:
    """Return which (n, 4) samples lie outside a marginal's region, and the error of its mass.

    The edge of the region is found from the draws of the mixture, unless that is one Gaussian. If
    a component is singular, all samples are outside.
    """
    from scipy.special import gammaincinv

    marginal = mixture.marginal(columns)
    whiteners = [W for cov in marginal.covs if (W := _whitener(cov)) is not None]
    k = len(marginal.weights)
    if len(whiteners) < k:
        return np.ones(len(samples), dtype=bool), 0.0
    log_weights = np.log(marginal.weights)
    log_weights += [np.log(np.abs(W.diagonal())).sum() for W in whiteners]
    log_weights -= log_weights.max()

    def depth(points: Array) -> Array:
        """Return -2 log density of (n, 4) points, up to a constant."""
        x = np.ascontiguousarray(points.T)[columns]
        depths = [
            ((W @ (x - mean[:, None])) ** 2).sum(axis=0) - 2 * log_weight
            for mean, W, log_weight in zip(marginal.means, whiteners, log_weights, strict=True)
        ]
        least = np.min(depths, axis=0)
        total = sum(np.exp((least - each) / 2) for each in depths)
        return np.asarray(least - 2 * np.log(total), dtype=float)

    edge, edge_error = 2 * gammaincinv(len(columns) / 2, MASS), 0.0
    if k > 1:
        edge = float(np.quantile(depth(draws), MASS))
        edge_error = float(np.sqrt(MASS * (1 - MASS) / len(draws)))
    out = [depth(part) > edge for part in np.array_split(samples, BATCHES)]
    return np.concatenate(out), edge_error


def _whitener(cov: Array) -> Array | None:
    """Return the lower-triangular W with ``W cov W^T = I``, or None if cov is singular."""
    variance = cov.diagonal()
    if not (variance > 0).all():
        return None
    scale = np.sqrt(variance)
    R = cov / scale / scale[:, None]
    if np.linalg.eigvalsh(R)[0] < SINGULAR:
        return None
    return np.asarray(np.linalg.inv(np.linalg.cholesky(R)) / scale, dtype=float)


def _kl(true: TrueDistribution, other: Gaussian) -> tuple[float, float]:
    if _whitener(other.cov) is None:
        return np.inf, 0.0
    values = np.array([each.kl(other) for each in true.moments])
    return float(values[0]), float(_jackknife(values))


# ---- the table ----------------------------------------------------------------------------------

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


_NAMES = ("scenario", "representation", "wire")
#: Headings of the figures by their names in CSV.
_HEADINGS = {
    "false_negatives": "FN 4-D",
    "false_negatives_pairs": "FN pairs",
    "false_positives": "FP pairs",
    "kl": "KL [nat]",
    "coverage": "coverage",
    **{f"mean_error_at_{x:g}m_m": f"error {x:g} m [m]" for x in LATERAL_X},
    **{f"sigma_ratio_at_{x:g}m": f"sigma ratio {x:g} m" for x in LATERAL_X},
}


def as_csv(rows: Sequence[ClaimRow]) -> str:
    """Return one line per row: each figure to six digits, followed by its standard error."""
    heading = [*_NAMES, *(f"{name}{end}" for name in _HEADINGS for end in ("", "_se"))]
    body = ([*_names(row), *chain.from_iterable(_figures(row))] for row in rows)
    return csv_text([heading, *body])


def as_markdown(rows: Sequence[ClaimRow]) -> str:
    """Return one Markdown table of figures with their standard errors."""
    body = [[*_names(row), *(_with_error(*pair) for pair in _figures(row))] for row in rows]
    return markdown([[*_NAMES, *_HEADINGS.values()], *body], left=len(_NAMES))


def as_text(rows: Sequence[ClaimRow]) -> str:
    """Return three tables per scenario for a terminal: shares and KL, mean error, sigma ratio."""
    blocks, headings = [], list(_HEADINGS.values())
    for scenario in dict.fromkeys(row.scenario for row in rows):
        of_scenario = [row for row in rows if row.scenario == scenario]
        blocks.append(scenario)
        for part in (slice(5), slice(5, 9), slice(9, None)):
            body = [
                [*_names(row)[1:], *(_with_error(*pair) for pair in _figures(row)[part])]
                for row in of_scenario
            ]
            blocks.append(aligned([[*_NAMES[1:], *headings[part]], *body], left=2))
    return "\n\n".join(blocks) + "\n"


def _names(row: ClaimRow) -> list[str]:
    return [str(getattr(row, name)) for name in _NAMES]


def _figures(row: ClaimRow) -> list[tuple[float, float]]:
    """Return each figure and its standard error, in the order of the headings."""
    pairs = [
        (np.atleast_1d(getattr(row, name)), np.atleast_1d(getattr(row, f"{name}_se")))
        for name in (*list(_HEADINGS)[:5], "mean_error", "sigma_ratio")
    ]
    values, errors = (np.concatenate(part).tolist() for part in zip(*pairs, strict=True))
    return list(zip(values, errors, strict=True))


def _with_error(value: float, error: float) -> str:
    """Return a figure and its error, rounded to the second digit of the error.

    >>> _with_error(0.0123456, 0.00012), _with_error(1.0, 0.0), _with_error(12345.6, 210)
    ('0.01235 ± 0.00012', '1', '12350 ± 210')
    """
    if not error:
        return f"{value:g}"
    digits = 1 - int(np.floor(np.log10(error)))
    places = max(digits, 0)
    return f"{round(value, digits):.{places}f} ± {round(error, digits):.{places}f}"
