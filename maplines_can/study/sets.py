"""Sets of line Gaussians on which the wire is evaluated.

``paper``, ``road`` and ``adversarial`` draw small sets at once. For a study of any size, a
``LineSet`` yields chunks: small picklable functions that return the same Gaussians in any process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..propagation import MapError, Quadrature, Refit, SigmaPoints, Transform
from ..simulation.scenarios import SCENARIOS, Scenario
from ..values.errors import IllPosedError, StudyError
from ..values.gaussian import Gaussian
from ..values.polyline import Polyline
from .files import GaussianFile, read_map
from .roads import PAPER, lines_of_roads, paper_refit, random_roads, random_scenarios

Array = NDArray[np.float64]


class Gaussians(NamedTuple):
    """Gaussians of N lines."""

    mean: Array  #: (N, 4)
    cov: Array  #: (N, 4, 4)


#: A chunk of a set: returns its Gaussians, the same at each call.
Chunk = Callable[[], Gaussians]


def paper(n: int, seed: int = 0) -> Gaussians:
    """Return n lines of the fixed scenarios and random roads, with pose error only.

    They are fitted as in the paper (see ``paper_refit``). Their covariances are nearly singular.
    """
    return _small_set(n, seed, None)


def road(n: int, seed: int = 0) -> Gaussians:
    """Return n lines of the same roads with pose and map error, as far as a cubic follows them.

    Their covariances cover what the cubic misses (see ``Refit``). Point errors and offsets of the
    map are 2 to 20 cm, its heading error is 0.05 deg.
    """
    return _small_set(n, seed, _stated)


def survey(n: int, seed: int = 0) -> Gaussians:
    """Return n lines of the same roads as a map has them that was thinned, and has errors.

    It has a point each 1 to 15 m, with an independent error of 1 to 20 cm; half of these maps state
    it, and offset and heading as those of ``road``. Lines that cannot be given are not of the set.
    """
    return _small_set(n, seed, _surveyed)


def adversarial(n: int, seed: int | Sequence[int] = 0, at_limit_share: float = 0.1) -> Gaussians:
    """Return n random Gaussians that cover all that the wire may meet.

    Sigmas are log-uniform over 1e-4 to 30 m, 1e-6 to 0.5 rad, 1e-8 to 0.1 1/m and 1e-10 to
    0.05 1/m^2; condition numbers of the correlation matrices are log-uniform up to 1e10. A tenth
    of the covariances is exactly singular (ranks 0 to 3); a share of the means is at a limit.
    """
    rng = np.random.default_rng(seed)
    low, high = np.log([1e-4, 1e-6, 1e-8, 1e-10]), np.log([30.0, 0.5, 0.1, 0.05])
    sigma = np.exp(rng.uniform(low, high, size=(n, 4)))
    rotation, _ = np.linalg.qr(rng.standard_normal((n, 4, 4)))
    log_condition = rng.uniform(0, np.log(1e10), size=(n, 1))
    values = np.exp(-log_condition * np.sort(rng.uniform(0, 1, size=(n, 4)), axis=1))
    values[:, 0], values[:, 3] = 1.0, np.exp(-log_condition[:, 0])
    singular = rng.random(n) < 0.1
    rank = rng.integers(0, 4, size=n)
    values[singular] *= np.arange(4) < rank[singular, None]
    root = rotation * np.sqrt(values)[:, None, :]
    norm = np.sqrt((root**2).sum(axis=2, keepdims=True))
    root = sigma[:, :, None] * root / np.where(norm > 0, norm, 1)
    limit = np.array([32.0, 0.5, 0.125, 0.03125])
    mean = rng.uniform(-limit, limit, size=(n, 4))
    at_limit = rng.random((n, 4)) < at_limit_share
    mean = np.where(at_limit, np.sign(mean) * limit, mean)
    cov = root @ np.swapaxes(root, 1, 2)
    return Gaussians(mean, (cov + np.swapaxes(cov, 1, 2)) / 2)


Lines = Sequence[Polyline]
#: Lines of a road as a map has them, and the error of the map.
_Mapped = Callable[[Lines, np.random.Generator], tuple[Lines, MapError]]


def _stated(lines: Lines, rng: np.random.Generator) -> tuple[Lines, MapError]:
    point_sigma, offset_sigma = 10 ** rng.uniform(np.log10(0.02), np.log10(0.2), size=2)
    return lines, MapError(point_sigma, offset_sigma, heading_sigma=np.radians(0.05))


def _surveyed(lines: Lines, rng: np.random.Generator) -> tuple[Lines, MapError]:
    spacing, sigma = 10 ** rng.uniform([0.0, -2.0], np.log10([15.0, 0.2]))
    thinned = [line.resampled(spacing) for line in lines]
    noisy = [
        Polyline(line.points + rng.normal(0.0, sigma, line.points.shape), line.kind)
        for line in thinned
    ]
    stated = sigma if rng.random() < 0.5 else 0.0
    return noisy, replace(_stated(lines, rng)[1], point_sigma=stated)


def _small_set(n: int, seed: int, mapped: _Mapped | None) -> Gaussians:
    scenarios = chain(SCENARIOS.values(), random_scenarios(2 * n, seed))
    return _lines_of_scenarios(scenarios, n, np.random.default_rng([seed, 1]), mapped)


def _lines_of_scenarios(
    scenarios: Iterable[Scenario], n: int, rng: np.random.Generator, mapped: _Mapped | None
) -> Gaussians:
    """Return the first n lines of scenarios; a scenario with a line across the car is skipped.

    They are fitted as in the paper, without a map error, if nothing says how a map has them.
    """
    means: list[Array] = []
    covs: list[Array] = []
    for scenario in scenarios:
        if len(means) >= n:
            break
        try:
            if mapped is None:
                refit = paper_refit(scenario)
            else:
                lines, error = mapped(list(scenario.lines.values()), rng)
                refit = Refit(lines, scenario.ego.mean, scenario.window, error)
            mean, cov = SigmaPoints().moments(refit, scenario.ego)
        except IllPosedError:
            continue
        means += list(mean)
        covs += list(cov)
    return Gaussians(np.reshape(means[:n], (-1, 4)), np.reshape(covs[:n], (-1, 4, 4)))


# ---- sets of any size, in chunks ------------------------------------------------------

#: Sets that are drawn, by name; the position is part of the seed, so only append.
DRAWN_SETS = ("paper", "road", "adversarial")
#: Lines of a map that pass the car farther aside than this do not belong to its road [m].
REACH = 16.0
#: Most poses in a chunk: propagating a pose takes far longer than reading a Gaussian.
POSES_IN_A_CHUNK = 1000


def drawn_chunk(name: str, seed: int, index: int, size: int) -> Gaussians:
    """Draw chunk ``index`` of a drawn set, ``size`` Gaussians.

    The first chunk of ``paper`` and ``road`` begins with the fixed scenarios; the rest are random
    roads. They have the distributions of the functions of the same names, but other draws.
    """
    rng_seed = [seed, index, 1 + DRAWN_SETS.index(name)]
    if name == "adversarial":
        return adversarial(size, rng_seed)
    rng = np.random.default_rng(rng_seed)
    with_map_error = name == "road"
    fixed = SCENARIOS.values() if index == 0 else ()
    means, covs = _lines_of_scenarios(fixed, size, rng, _stated if with_map_error else None)
    while len(means) < size:
        missing = size - len(means)
        roads = random_roads(missing, rng, with_map_error=with_map_error)
        mean, cov = lines_of_roads(roads, **({} if with_map_error else PAPER))
        good = np.isfinite(mean).all(axis=1)
        means, covs = np.concatenate([means, mean[good]]), np.concatenate([covs, cov[good]])
    return Gaussians(means, covs)


def _seen_lines(
    means: Array,
    covs: Array,
    lines: Sequence[Polyline],
    window: tuple[float, float],
    transform: Transform,
) -> Gaussians:
    """Return the lines of a map as seen from uncertain poses.

    Of each pose, these are the lines that pass the car within ``REACH`` and that a cubic follows.
    ``means`` are (N, 3) e_x, e_y [m], e_h [rad], in the frame of the map; ``covs`` (N, 3, 3).
    """
    boxes = np.array([[line.points.min(axis=0), line.points.max(axis=0)] for line in lines])
    line_means, line_covs = [np.empty((0, 4))], [np.empty((0, 4, 4))]
    reach = max(REACH, *map(abs, window))
    for mean, cov in zip(means, covs, strict=True):
        outside = np.maximum(boxes[:, 0] - mean[:2], mean[:2] - boxes[:, 1]).clip(0)
        for i in np.flatnonzero(np.hypot(*outside.T) <= reach):
            try:
                refit = Refit(lines[int(i)], mean, window)
                line_mean, line_cov = transform.moments(refit, Gaussian(mean, cov))
            except IllPosedError:  # not ahead of the car, or across it
                continue
            if abs(line_mean[0]) <= REACH:
                line_means.append(line_mean[None])
                line_covs.append(line_cov[None])
    return Gaussians(np.concatenate(line_means), np.concatenate(line_covs))


def _sizes(n: int, size: int) -> list[int]:
    return [min(size, n - start) for start in range(0, n, size)]


@dataclass(frozen=True)
class DrawnSet:
    """One of ``DRAWN_SETS``."""

    name: str

    def describe(self) -> dict[str, Any]:
        """Return JSON values that identify the Gaussians."""
        return {"name": self.name}

    def sizes(self, n: int, size: int) -> list[int]:
        """Return the number of Gaussians in each chunk: n in all, at most ``size`` in one."""
        return _sizes(n, size)

    def chunks(self, n: int, size: int, seed: int) -> Iterator[Chunk]:
        """Yield the chunks in order."""
        for index, count in enumerate(self.sizes(n, size)):
            yield partial(drawn_chunk, self.name, seed, index, count)


@dataclass(frozen=True)
class MapView:
    """How poses see the lines of a map."""

    path: Path  #: of the map
    window: tuple[float, float] = (-20.0, 80.0)  #: where points are taken, ahead of the car [m]
    transform: Literal["sigma-points", "quadrature"] = "sigma-points"  #: from a pose to a line

    def __post_init__(self) -> None:
        if not self.window[0] < self.window[1]:
            raise StudyError(f"the window must have x_min < x_max [m], got {self.window}")


@dataclass(frozen=True)
class FileSet:
    """All Gaussians of a file, or the lines that its poses see; ``n`` and ``seed`` are ignored."""

    file: GaussianFile
    view: MapView | None = None  #: for poses

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.file.path.name

    def describe(self) -> dict[str, Any]:
        """Return JSON values that identify the Gaussians, by the content of the files."""
        description: dict[str, Any] = {"name": self.name, "sha256": self.file.sha256}
        if self.view is not None:
            _, description["map_sha256"] = read_map(self.view.path)
            description |= {"window": list(self.view.window), "transform": self.view.transform}
        return description

    def sizes(self, n: int, size: int) -> list[int]:  # noqa: ARG002
        """Return the number of rows in each chunk."""
        return _sizes(self.file.rows, self._rows(size))

    def chunks(self, n: int, size: int, seed: int) -> Iterator[Chunk]:  # noqa: ARG002
        """Yield the chunks in order, each read only when it is asked for."""
        blocks = self.file.blocks(self._rows(size))
        if self.view is None:
            yield from (partial(Gaussians, mean, cov) for mean, cov in blocks)
            return
        lines, _ = read_map(self.view.path)
        transform = SigmaPoints() if self.view.transform == "sigma-points" else Quadrature()
        for mean, cov in blocks:
            yield partial(_seen_lines, mean, cov, lines, self.view.window, transform)

    def _rows(self, size: int) -> int:
        return size if self.view is None else min(size, POSES_IN_A_CHUNK)


#: A set of any size, in chunks.
LineSet = DrawnSet | FileSet


def line_set(what: str, view: MapView | None = None) -> LineSet:
    """Return the set of a name, or of a file.

    Args:
        what: one of ``DRAWN_SETS``, or the path of a file of Gaussians or of poses.
        view: of the map, for poses.

    Raises:
        StudyError: there is no such set or file, or its content is not valid.
    """
    if what in DRAWN_SETS:
        return DrawnSet(what)
    path = Path(what)
    if not path.is_file():
        raise StudyError(
            f"there is no set or file {what!r}; sets are {', '.join(DRAWN_SETS)}, and a file of "
            "your own is .npz, .csv or .parquet"
        )
    file = GaussianFile.opened(path)
    if file.dimension == 4:
        return FileSet(file)
    if view is None:
        raise StudyError(f"{path}: holds poses; give the lines of their map with --map FILE")
    return FileSet(file, view)
