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

import csv
import io
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaincinv

from ..gaussian import Gaussian
from ..line import STATES, Slot, Status, lateral, lateral_jacobian
from ..propagation import Linear, MonteCarlo, Quadrature, Refit, SigmaPoints, Transform
from ..propagation.mixture import Mixture
from ..scenarios import SCENARIOS, Scenario
from ..wire import Codec
from .metrics import LATERAL_X

__all__ = [
    "PART_TRANSFORM",
    "Approximation",
    "Row",
    "Truth",
    "as_csv",
    "as_markdown",
    "as_text",
    "judged",
    "representations",
    "through_the_wire",
    "truth_of",
    "truth_table",
]

Array = NDArray[np.float64]

#: The parts of the mixtures go through this, the default of ``Mixture``. In the street turn at
#: 10 deg Quadrature(5) leaves a few false positives less with 5 parts, and a few more with 3.
PART_TRANSFORM: Transform = SigmaPoints()
#: Mass of the regions.
MASS = 0.99
#: Cells of the grid along each parameter.
BINS = 60
#: Batches of the samples, for sampling errors.
BATCHES = 10
#: Draws of each approximation, for its mass outside the true region.
DRAWS = 400_000
#: Draws of the transform MonteCarlo, as the package has it by default.
MONTE_CARLO_DRAWS = 100_000
#: Rows judged at once; numpy works outside of Python's lock.
WORKERS = 2
#: Below this smallest eigenvalue of its correlation matrix a covariance is singular.
SINGULAR = 1e-12
PAIRS = tuple(combinations(range(len(STATES)), 2))


@dataclass(frozen=True)
class Row:
    """One representation of one scene's line; ``_se`` is the standard error of a figure."""

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
    coverage: float  #: in all four parameters
    coverage_se: float


@dataclass(frozen=True, eq=False)
class Approximation:
    """What stands for the line: a point, a Gaussian or a mixture.

    Args:
        weights: (k,) of sum 1.
        means: (k, 4).
        covs: (k, 4, 4), singular ones too; None for a point.
    """

    weights: Array
    means: Array
    covs: Array | None = None

    @classmethod
    def gaussian(cls, mean: ArrayLike, cov: ArrayLike | None) -> Approximation:
        """One Gaussian, or a point where ``cov`` is None."""
        covs = None if cov is None else np.asarray(cov, dtype=float)[None]
        return cls(np.ones(1), np.asarray(mean, dtype=float)[None], covs)


@dataclass(frozen=True, eq=False)
class Truth:
    """The true distribution: samples, their moments and regions, and the same less each batch."""

    samples: Array  #: (n, 4)
    low: Array  #: (4,) where the grid begins
    width: Array  #: (4,) of its cells
    regions: NDArray[np.bool_]  #: (1 + BATCHES, 6, BINS + 2, BINS + 2); the border is outside
    moments: tuple[Gaussian, ...]  #: 1 + BATCHES
    lateral_mean: Array  #: (1 + BATCHES, X) [m]
    lateral_sigma: Array  #: (1 + BATCHES, X) [m]


def truth_table(
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
        refit = _refit(scene, slot)
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


def _refit(scene: Scenario, slot: Slot) -> Refit:
    for line in scene.lines:
        if line.slot == slot:
            return Refit(line.polyline, scene.ego.mean, scene.window)
    raise ValueError(
        f"scenario {scene.name!r} has no line {slot.name}; "
        f"there are {', '.join(line.slot.name for line in scene.lines)}"
    )


def representations(
    refit: Refit, ego: Gaussian, *, n: int = MONTE_CARLO_DRAWS, seed: int = 0
) -> dict[str, Approximation]:
    """What a sender could send of a line, by name.

    Args:
        refit: from pose to line.
        ego: the pose.
        n: upper limit of the draws of Monte Carlo.
        seed: Monte Carlo draws from the seed after it: other draws than the truth's.
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
        found[f"mixture of {k}"] = Approximation(*Mixture(k, PART_TRANSFORM).moments(refit, ego))
    return found


def through_the_wire(
    approximation: Approximation,
    codec: Codec,
    slot: Slot,
    x_range: Array,
    *,
    diagonal: bool = False,
) -> Approximation:
    """What a receiver gets of it; ``diagonal`` sends the variances only.

    Raises:
        ValueError: it does not fit the messages.
    """
    means, covs = approximation.means, approximation.covs
    if len(means) > 1 and covs is not None:
        payloads = codec.encode_mixtures(
            approximation.weights[None],
            means[None],
            covs[None],
            slot=slot,
            x_min=x_range[0],
            x_max=x_range[1],
        )[0]
    else:
        status = None if covs is None else Status.DIAGONAL if diagonal else Status.FULL
        payloads = codec.encode_batch(
            means, covs, slot=slot, x_min=x_range[0], x_max=x_range[1], status=status
        )
    batch = codec.decode_batch(payloads, slot=slot)
    if not batch.accepted.all() or (batch.status == Status.OUT_OF_RANGE).any():
        raise ValueError(
            f"a line of mean {means.tolist()} does not fit the messages of {codec.layout.source}"
        )
    return Approximation(batch.component_weight, batch.mean, None if covs is None else batch.cov)


def truth_of(samples: Array) -> Truth:
    """The true distribution from (n, 4) samples.

    Raises:
        ValueError: fewer than 100 samples.
    """
    if not len(samples) >= 10 * BATCHES:
        raise ValueError(f"n must be {10 * BATCHES} or more, got {len(samples)!r}")
    low, high = samples.min(axis=0), samples.max(axis=0)
    width = np.where(high > low, high - low, 1.0) / BINS
    x = np.array(LATERAL_X)
    mean, line_mean = samples.mean(axis=0), lateral(samples.mean(axis=0), x)
    sizes, counts, sums = [], [], []
    for batch in np.array_split(samples, BATCHES):
        cells = _cells(batch, low, width, inside=True)
        d, e = batch - mean, lateral(batch[:, None, :], x) - line_mean
        sizes.append(len(batch))
        counts.append(_counts(cells))
        sums.append((d.sum(axis=0), d.T @ d, e.sum(axis=0), (e**2).sum(axis=0)))

    def left(values: Array) -> Array:
        """The sum of all batches, and of all but each one."""
        whole = values.sum(axis=0)
        return np.concatenate([whole[None], whole - values])

    size = left(np.array(sizes, dtype=float))
    first, second, line, line2 = (
        left(np.array(part)) / size.reshape(-1, *[1] * np.ndim(part[0]))
        for part in zip(*sums, strict=True)
    )
    return Truth(
        samples=samples,
        low=low,
        width=width,
        regions=np.array(
            [[_densest(pair) for pair in count] for count in left(np.array(counts, dtype=float))]
        ),
        moments=tuple(
            Gaussian(mean + a, S - np.outer(a, a)) for a, S in zip(first, second, strict=True)
        ),
        lateral_mean=line_mean + line,
        lateral_sigma=np.sqrt((line2 - line**2).clip(0)),
    )


def judged(
    truth: Truth, approximation: Approximation, names: tuple[str, str, str], seed: int = 0
) -> Row:
    """All figures of one representation.

    Args:
        truth: what it stands for.
        approximation: the representation.
        names: scenario, representation, and "before" or "after".
        seed: of the draws of the approximation: the same before and after the wire.
    """
    if approximation.covs is None:
        outside, outside_se, pairs, pairs_se = 1.0, 0.0, 1.0, 0.0
        positives, positives_se, kl, kl_se = 0.0, 0.0, np.inf, 0.0
    else:
        draws = _draws(approximation, seed)
        outside, outside_se, pairs, pairs_se = _false_negatives(truth, approximation, draws)
        positives, positives_se = _false_positives(truth, draws)
        whole = _whole(approximation)
        values = np.array([_kl(true, whole) for true in truth.moments])
        kl, kl_se = float(values[0]), float(_jackknife(values))
    mean, sigma = _band(approximation)
    ratios = sigma / truth.lateral_sigma
    scenario, representation, wire = names
    return Row(
        scenario=scenario,
        representation=representation,
        wire=wire,
        false_negatives=outside,
        false_negatives_se=outside_se,
        false_negatives_pairs=pairs,
        false_negatives_pairs_se=pairs_se,
        false_positives=positives,
        false_positives_se=positives_se,
        kl=kl,
        kl_se=kl_se,
        mean_error=_floats(mean - truth.lateral_mean[0]),
        mean_error_se=_floats(_jackknife(truth.lateral_mean)),
        sigma_ratio=_floats(ratios[0]),
        sigma_ratio_se=_floats(_jackknife(ratios)),
        coverage=1 - outside,
        coverage_se=outside_se,
    )


def _floats(values: Array) -> tuple[float, ...]:
    return tuple(float(value) for value in values)


def _jackknife(values: Array) -> Array:
    """Standard error from (1 + BATCHES, ...) figures, of all and of all but each batch."""
    if not np.isfinite(values).all():
        return np.zeros(values.shape[1:])
    spread = ((values[1:] - values[1:].mean(axis=0)) ** 2).sum(axis=0)
    return np.asarray(np.sqrt((BATCHES - 1) / BATCHES * spread), dtype=float)


# -- regions of the truth -------------------------------------------------------


def _cells(samples: Array, low: Array, width: Array, *, inside: bool = False) -> NDArray[np.intp]:
    """(n, 4) numbers of cells, 1 to BINS; 0 and BINS + 1 are outside of the grid."""
    place = np.floor((samples - low) / width).clip(-1, BINS)
    if inside:  # the last cell holds its upper edge, and rounding moves no sample out
        place = place.clip(0, BINS - 1)
    return place.astype(np.intp) + 1


def _counts(cells: NDArray[np.intp]) -> NDArray[np.intp]:
    """(6, BINS + 2, BINS + 2) samples in each cell of each pair."""
    side = BINS + 2
    return np.array(
        [
            np.bincount(cells[:, i] * side + cells[:, j], minlength=side**2).reshape(side, side)
            for i, j in PAIRS
        ]
    )


def _densest(count: Array) -> NDArray[np.bool_]:
    """The fewest cells that hold ``MASS`` of the samples."""
    order = np.argsort(-count, axis=None, kind="stable")
    total = np.cumsum(count.ravel()[order])
    chosen = np.zeros(count.size, dtype=bool)
    chosen[order[: int(np.searchsorted(total, MASS * total[-1])) + 1]] = True
    return chosen.reshape(count.shape)


# -- figures --------------------------------------------------------------------


def _draws(approximation: Approximation, seed: int) -> Array:
    """(DRAWS, 4) of the approximation; its parts in turn."""
    assert approximation.covs is not None  # noqa: S101  # a point is not drawn from
    rng = np.random.default_rng([seed, 3])
    normal = rng.standard_normal((DRAWS, len(STATES)))
    # Stratified: each part gets its share to the draw, and the same normals as before the wire.
    edges = np.round(np.cumsum(approximation.weights) * DRAWS).astype(int)
    start = 0
    for end, mean, cov in zip(edges, approximation.means, approximation.covs, strict=True):
        normal[start:end] = mean + normal[start:end] @ Gaussian(mean, cov).root.T
        start = end
    return normal


def _false_positives(truth: Truth, draws: Array) -> tuple[float, float]:
    cells = _cells(draws, truth.low, truth.width)
    counts = _counts(cells)
    inside = np.einsum("bpij,pij->b", truth.regions, counts) / (len(draws) * len(PAIRS))
    out = np.zeros(len(draws))
    for region, (i, j) in zip(truth.regions[0], PAIRS, strict=True):
        out += ~region[cells[:, i], cells[:, j]]
    own = out.std() / len(PAIRS) / np.sqrt(len(draws))
    return float(1 - inside[0]), float(np.hypot(own, _jackknife(inside)))


def _false_negatives(
    truth: Truth, approximation: Approximation, draws: Array
) -> tuple[float, float, float, float]:
    """In four parameters and over the pairs, each with its error."""
    regions = [
        _Region(approximation, list(columns), draws) for columns in (range(len(STATES)), *PAIRS)
    ]
    n, four, pairs, pairs2 = len(truth.samples), 0, 0.0, 0.0
    for part in np.array_split(truth.samples, BATCHES):
        batch = np.ascontiguousarray(part.T)
        four += int(regions[0].outside(batch).sum())
        out = np.zeros(len(part))
        for region in regions[1:]:
            out += region.outside(batch)
        out /= len(PAIRS)
        pairs, pairs2 = pairs + float(out.sum()), pairs2 + float((out**2).sum())
    share, pair_share = four / n, pairs / n
    edge = max(region.edge_error for region in regions)
    return (
        share,
        float(np.hypot(np.sqrt(share * (1 - share) / n), edge)),
        pair_share,
        float(np.hypot(np.sqrt(max(pairs2 / n - pair_share**2, 0) / n), edge)),
    )


class _Region:
    """The region of highest density of some parameters of an approximation."""

    def __init__(self, approximation: Approximation, columns: list[int], draws: Array) -> None:
        assert approximation.covs is not None  # noqa: S101  # a point has no region
        self._columns = columns
        self._means = approximation.means[:, columns]
        covs = approximation.covs[:, columns][:, :, columns]
        whiteners = [_whitener(cov) for cov in covs]
        self._whiteners = [W for W in whiteners if W is not None]
        self._flat = len(self._whiteners) < len(whiteners)
        self.edge_error = 0.0
        self._edge, self._log_weights = 2 * gammaincinv(len(columns) / 2, MASS), np.zeros(1)
        if len(whiteners) > 1 and not self._flat:
            log_dets = np.array([np.log(np.abs(W.diagonal())).sum() for W in self._whiteners])
            self._log_weights = np.log(approximation.weights) + log_dets
            self._log_weights -= self._log_weights.max()
            self._edge = float(np.quantile(self._depth(draws.T[columns]), MASS))
            self.edge_error = float(np.sqrt(MASS * (1 - MASS) / len(draws)))

    def _depth(self, x: Array) -> Array:
        """(n,) minus twice the log density at (parameters, n) points, up to a constant.

        For one Gaussian it is the squared distance.
        """
        depths = [
            ((W @ (x - mean[:, None])) ** 2).sum(axis=0) - 2 * log_weight
            for mean, W, log_weight in zip(
                self._means, self._whiteners, self._log_weights, strict=True
            )
        ]
        least = np.min(depths, axis=0)
        if len(depths) == 1:
            return np.asarray(least, dtype=float)
        total = sum(np.exp((least - depth) / 2) for depth in depths)
        return np.asarray(least - 2 * np.log(total), dtype=float)

    def outside(self, samples: Array) -> NDArray[np.bool_]:
        """(n,) which of (4, n) samples lie outside."""
        if self._flat:
            return np.ones(samples.shape[1], dtype=bool)
        return np.asarray(self._depth(samples[self._columns]) > self._edge)


def _whitener(cov: Array) -> Array | None:
    """Lower-triangular W with ``W cov W^T`` the identity; None where cov is singular."""
    variance = cov.diagonal()
    if not (variance > 0).all():
        return None
    scale = np.sqrt(variance)
    R = cov / scale / scale[:, None]
    if np.linalg.eigvalsh(R)[0] < SINGULAR:
        return None
    return np.asarray(np.linalg.inv(np.linalg.cholesky(R)) / scale, dtype=float)


def _whole(approximation: Approximation) -> Gaussian:
    """The one Gaussian with its mean and covariance."""
    assert approximation.covs is not None  # noqa: S101  # a point has no moments to compare
    w, means, covs = approximation.weights, approximation.means, approximation.covs
    mean = w @ means
    d = means - mean
    return Gaussian(mean, np.einsum("k,kij->ij", w, covs + d[:, :, None] * d[:, None, :]))


def _kl(true: Gaussian, other: Gaussian) -> float:
    return np.inf if _whitener(other.cov) is None else true.kl(other)


def _band(approximation: Approximation) -> tuple[Array, Array]:
    """Mean and standard deviation of l(x) at LATERAL_X."""
    x = np.array(LATERAL_X)
    w, means = approximation.weights, approximation.means
    lines = lateral(means[:, None, :], x)  # (k, X)
    mean = w @ lines
    if approximation.covs is None:
        return mean, np.zeros(len(x))
    J = lateral_jacobian(means[:, None, :], x)
    within = np.einsum("kxi,kij,kxj->kx", J, approximation.covs, J)
    return mean, np.sqrt(w @ (within + (lines - mean) ** 2))


# -- writers --------------------------------------------------------------------


def _columns() -> Iterator[tuple[str, str, Callable[[Row], float], Callable[[Row], float]]]:
    """Name in CSV, heading, figure and error, in the order of the row."""
    for name, heading in (
        ("false_negatives", "FN 4-D"),
        ("false_negatives_pairs", "FN pairs"),
        ("false_positives", "FP pairs"),
        ("kl", "KL [nat]"),
        ("coverage", "coverage"),
    ):
        yield name, heading, _getter(name), _getter(f"{name}_se")
    for name, heading, unit, suffix in (
        ("mean_error", "error", " [m]", "_m"),
        ("sigma_ratio", "sigma ratio", "", ""),
    ):
        for i, x in enumerate(LATERAL_X):
            yield (
                f"{name}_at_{x:g}m{suffix}",
                f"{heading} {x:g} m{unit}",
                _getter(name, i),
                _getter(f"{name}_se", i),
            )


def _getter(name: str, index: int | None = None) -> Callable[[Row], float]:
    def get(row: Row) -> float:
        value = getattr(row, name)
        return float(value if index is None else value[index])

    return get


_NAMES = ("scenario", "representation", "wire")


def as_csv(rows: Sequence[Row]) -> str:
    """One line a row, each figure to six digits and followed by its standard error."""
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    columns = list(_columns())
    writer.writerow([*_NAMES, *(f"{name}{end}" for name, *_ in columns for end in ("", "_se"))])
    for row in rows:
        figures = (f"{get(row):.6g}" for _, _, *pair in columns for get in pair)
        writer.writerow([*(getattr(row, name) for name in _NAMES), *figures])
    return out.getvalue()


def as_markdown(rows: Sequence[Row]) -> str:
    """A table for a page, figures with their standard errors."""
    header, *body = _cells_of(rows, list(_columns()), _NAMES)
    lines = [header, ["---"] * len(_NAMES) + ["---:"] * (len(header) - len(_NAMES)), *body]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def as_text(rows: Sequence[Row]) -> str:
    """Two tables a scene for a terminal: the shares and KL, and the lateral band."""
    columns, blocks = list(_columns()), []
    for scene in dict.fromkeys(row.scenario for row in rows):
        of_scene = [row for row in rows if row.scenario == scene]
        blocks.append(scene)
        for part in (columns[:5], columns[5:9], columns[9:]):
            table = _cells_of(of_scene, part, _NAMES[1:])
            widths = [max(map(len, column)) for column in zip(*table, strict=True)]
            blocks.append(
                "\n".join(
                    "  ".join(
                        cell.ljust(width) if i < 2 else cell.rjust(width)
                        for i, (cell, width) in enumerate(zip(line, widths, strict=True))
                    )
                    for line in table
                )
            )
    return "\n\n".join(blocks) + "\n"


def _cells_of(
    rows: Sequence[Row],
    columns: Sequence[tuple[str, str, Callable[[Row], float], Callable[[Row], float]]],
    names: Sequence[str],
) -> list[list[str]]:
    header = [*names, *(heading for _, heading, *_ in columns)]
    body = [
        [
            *(str(getattr(row, name)) for name in names),
            *(_with_error(get(row), error(row)) for _, _, get, error in columns),
        ]
        for row in rows
    ]
    return [header, *body]


def _with_error(value: float, error: float) -> str:
    """A figure and its error, to the error's second digit.

    >>> _with_error(0.0123456, 0.00012), _with_error(1.0, 0.0), _with_error(12345.6, 210)
    ('0.01235 ± 0.00012', '1', '12350 ± 210')
    """
    if not error:
        return f"{value:g}"
    digits = 1 - int(np.floor(np.log10(error)))
    places = max(digits, 0)
    return f"{round(value, digits):.{places}f} ± {round(error, digits):.{places}f}"
