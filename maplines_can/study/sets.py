"""Sets of line Gaussians on which the wire is judged.

``paper``, ``road`` and ``hostile`` make small sets at once. For a study of any size a
``LineSet`` hands out chunks: small values that any process turns into the same Gaussians.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import IllPosedError, StudyError
from ..gaussian import Gaussian
from ..polyline import Polyline
from ..propagation import MapError, Quadrature, Refit, SigmaPoints, Transform
from ..scenarios import SCENARIOS, Scenario, random_scenarios
from .files import GaussianFile, read_map
from .roads import lines_of_roads, random_roads

__all__ = [
    "DRAWN_SETS",
    "Chunk",
    "DrawnChunk",
    "DrawnSet",
    "FileSet",
    "Gaussians",
    "GivenChunk",
    "LineSet",
    "PoseChunk",
    "PoseSet",
    "adversarial",
    "line_set",
    "paper",
    "road",
]


class Gaussians(NamedTuple):
    """Lines as Gaussians."""

    mean: NDArray[np.float64]  #: (N, 4)
    cov: NDArray[np.float64]  #: (N, 4, 4)


#: A seed, or what of it numpy takes.
Seed = int | Sequence[int]


def paper(n: int, seed: int = 0) -> Gaussians:
    """Pose error only: the fixed scenarios and random roads, n in all. Nearly singular."""
    return _gathered(_lines(n, seed, with_map_error=False), n)


def road(n: int, seed: int = 0) -> Gaussians:
    """Pose and map error: point errors and offsets of 2 to 20 cm, a turn of 0.05 deg."""
    return _gathered(_lines(n, seed, with_map_error=True), n)


def adversarial(
    n: int, seed: Seed = 0, singular_share: float = 0.1, at_limit_share: float = 0.1
) -> Gaussians:
    """Random covariances that spare nothing.

    Sigmas log-uniform over 1e-4 to 30 m, 1e-6 to 0.5 rad, 1e-8 to 0.1 1/m, 1e-10
    to 0.05 1/m^2; correlation matrices with condition numbers log-uniform up to 1e10;
    a share of exactly singular ones (ranks 0 to 3), a share of means at the limits.
    """
    rng = np.random.default_rng(seed)
    low, high = np.log([1e-4, 1e-6, 1e-8, 1e-10]), np.log([30.0, 0.5, 0.1, 0.05])
    sigma = np.exp(rng.uniform(low, high, size=(n, 4)))
    rotation, _ = np.linalg.qr(rng.standard_normal((n, 4, 4)))
    log_condition = rng.uniform(0, np.log(1e10), size=(n, 1))
    values = np.exp(-log_condition * np.sort(rng.uniform(0, 1, size=(n, 4)), axis=1))
    values[:, 0], values[:, 3] = 1.0, np.exp(-log_condition[:, 0])
    singular = rng.random(n) < singular_share
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


def _lines(n: int, seed: int, with_map_error: bool) -> Iterator[tuple[NDArray[np.float64], ...]]:
    rng = np.random.default_rng([seed, 1])
    scenes = (*SCENARIOS.values(), *random_scenarios(2 * n, seed))
    return _lines_of_scenes(scenes, rng, with_map_error)


def _lines_of_scenes(
    scenes: Iterable[Scenario], rng: np.random.Generator, with_map_error: bool
) -> Iterator[tuple[NDArray[np.float64], ...]]:
    transform = SigmaPoints()
    # A random road whose sigma points look across the line is no line to send: skipped.
    for scene in scenes:
        error = None
        if with_map_error:
            point_sigma, offset_sigma = 10 ** rng.uniform(np.log10(0.02), np.log10(0.2), size=2)
            error = MapError(point_sigma, offset_sigma, heading_sigma=np.radians(0.05))
        try:
            refit = Refit(scene.polylines, scene.ego.mean, scene.window, error)
            yield from zip(*transform.moments(refit, scene.ego), strict=True)
        except IllPosedError:
            continue


def _gathered(lines: Iterator[tuple[NDArray[np.float64], ...]], n: int) -> Gaussians:
    means, covs = zip(*(line for line, _ in zip(lines, range(n), strict=False)), strict=True)
    return Gaussians(np.array(means), np.array(covs))


# ---- sets of any size, in chunks ------------------------------------------------------

#: Sets that are drawn, by name; the place is part of the seed, so append only.
DRAWN_SETS = ("paper", "road", "adversarial")


class Chunk(ABC):
    """A part of a set, small enough to be sent to another process."""

    @abstractmethod
    def gaussians(self) -> Gaussians:
        """The Gaussians; each time the same ones."""


@dataclass(frozen=True)
class DrawnChunk(Chunk):
    """Chunk ``index`` of a drawn set: a function of what is written here, and of nothing else.

    The first chunk of ``paper`` and ``road`` begins with the fixed scenarios; all else are random
    roads. The laws are those of the functions of the same names, the draws are not.
    """

    name: str
    seed: int
    index: int
    size: int

    def gaussians(self) -> Gaussians:
        """``size`` Gaussians."""
        seed = [self.seed, self.index, 1 + DRAWN_SETS.index(self.name)]
        if self.name == "adversarial":
            return adversarial(self.size, seed)
        rng = np.random.default_rng(seed)
        with_map_error = self.name == "road"
        means, covs = np.empty((0, 4)), np.empty((0, 4, 4))
        if self.index == 0:
            fixed = _lines_of_scenes(SCENARIOS.values(), rng, with_map_error)
            means, covs = _gathered(fixed, self.size)
        while len(means) < self.size:
            missing = self.size - len(means)
            mean, cov = lines_of_roads(random_roads(missing, rng, with_map_error=with_map_error))
            good = np.isfinite(mean).all(axis=1)
            means, covs = np.concatenate([means, mean[good]]), np.concatenate([covs, cov[good]])
        return Gaussians(means, covs)


@dataclass(frozen=True, eq=False)
class GivenChunk(Chunk):
    """Gaussians of a user's own."""

    mean: NDArray[np.float64]  #: (N, 4)
    cov: NDArray[np.float64]  #: (N, 4, 4)

    def gaussians(self) -> Gaussians:
        """Them."""
        return Gaussians(self.mean, self.cov)


@dataclass(frozen=True, eq=False)
class PoseChunk(Chunk):
    """Lines of a map as seen from uncertain poses.

    Of each pose, those lines that pass the car within ``REACH`` and that a cubic follows.
    """

    mean: NDArray[np.float64]  #: (N, 3) e_x, e_y [m], e_h [rad], in the frame of the map
    cov: NDArray[np.float64]  #: (N, 3, 3)
    lines: tuple[Polyline, ...]
    window: tuple[float, float]  #: where points are taken, ahead of the car [m]
    transform: Transform

    def gaussians(self) -> Gaussians:
        """From no line to all lines of the map for each pose."""
        boxes = np.array([[p.points.min(axis=0), p.points.max(axis=0)] for p in self.lines])
        means: list[NDArray[np.float64]] = [np.empty((0, 4))]
        covs: list[NDArray[np.float64]] = [np.empty((0, 4, 4))]
        reach = max(REACH, *map(abs, self.window))
        for mean, cov in zip(self.mean, self.cov, strict=True):
            outside = np.maximum(boxes[:, 0] - mean[:2], mean[:2] - boxes[:, 1]).clip(0)
            for i in np.flatnonzero(np.hypot(*outside.T) <= reach):
                try:
                    refit = Refit(self.lines[i], mean, self.window)
                    line_mean, line_cov = self.transform.moments(refit, Gaussian(mean, cov))
                except IllPosedError:  # not ahead of the car, or across it
                    continue
                if abs(line_mean[0]) <= REACH:
                    means.append(line_mean[None])
                    covs.append(line_cov[None])
        return Gaussians(np.concatenate(means), np.concatenate(covs))


#: Lines of a map farther aside than this at the car are no lines of its road [m].
REACH = 16.0


class LineSet(ABC):
    """A set of any size, in chunks."""

    name: str  #: as in the tables of a study

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """What the set is, so that another one of the same name is known as another."""

    @abstractmethod
    def sizes(self, n: int, size: int) -> list[int]:
        """How much is in each chunk; of poses, how many of them.

        Args:
            n: Gaussians in all, of a drawn set; a file is taken whole.
            size: most in a chunk.
        """

    @abstractmethod
    def chunks(self, n: int, size: int, seed: int) -> Iterator[Chunk]:
        """The chunks, one after the other, none made before it is asked for."""


def _sizes(n: int, size: int) -> list[int]:
    return [min(size, n - start) for start in range(0, n, size)]


@dataclass(frozen=True)
class DrawnSet(LineSet):
    """One of ``DRAWN_SETS``."""

    name: str

    def describe(self) -> dict[str, Any]:
        """Its name says it all."""
        return {"name": self.name}

    def sizes(self, n: int, size: int) -> list[int]:
        """As many as are wanted."""
        return _sizes(n, size)

    def chunks(self, n: int, size: int, seed: int) -> Iterator[Chunk]:
        """Each drawn by itself."""
        for index, count in enumerate(self.sizes(n, size)):
            yield DrawnChunk(self.name, seed, index, count)


@dataclass(frozen=True)
class FileSet(LineSet):
    """The Gaussians of a file, all of them."""

    file: GaussianFile
    name: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.file.path.name)

    def describe(self) -> dict[str, Any]:
        """By what is in the file, not by its place."""
        return {"name": self.name, "sha256": self.file.sha256}

    def sizes(self, n: int, size: int) -> list[int]:  # noqa: ARG002
        """All rows of the file."""
        return _sizes(self.file.rows, size)

    def chunks(self, n: int, size: int, seed: int) -> Iterator[Chunk]:  # noqa: ARG002
        """The rows in their order; ``n`` and ``seed`` do not matter."""
        for mean, cov in self.file.blocks(size):
            yield GivenChunk(mean, cov)


#: Poses take so much longer than Gaussians, which are there already.
POSES_IN_A_CHUNK = 1000


@dataclass(frozen=True)
class PoseSet(LineSet):
    """The lines of a map, as seen from the poses of a file.

    Args:
        file: of the poses.
        map_path: of the map's lines.
        window: where points are taken, ahead of the car [m].
        transform: from the pose to the line.
    """

    file: GaussianFile
    map_path: Path
    window: tuple[float, float] = (-20.0, 80.0)
    transform: Literal["sigma-points", "quadrature"] = "sigma-points"
    name: str = field(init=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "name", self.file.path.name)
        if not self.window[0] < self.window[1]:
            raise StudyError(f"the window must have x_min < x_max [m], got {self.window}")

    def describe(self) -> dict[str, Any]:
        """By what is in the files."""
        _, sha256 = read_map(self.map_path)
        return {
            "name": self.name,
            "sha256": self.file.sha256,
            "map_sha256": sha256,
            "window": list(self.window),
            "transform": self.transform,
        }

    def sizes(self, n: int, size: int) -> list[int]:  # noqa: ARG002
        """All poses of the file."""
        return _sizes(self.file.rows, min(size, POSES_IN_A_CHUNK))

    def chunks(self, n: int, size: int, seed: int) -> Iterator[Chunk]:  # noqa: ARG002
        """The poses in their order; ``n`` and ``seed`` do not matter."""
        lines, _ = read_map(self.map_path)
        transform = SigmaPoints() if self.transform == "sigma-points" else Quadrature()
        for mean, cov in self.file.blocks(min(size, POSES_IN_A_CHUNK)):
            yield PoseChunk(mean, cov, lines, self.window, transform)


def line_set(
    what: str,
    *,
    map_path: Path | None = None,
    window: tuple[float, float] = (-20.0, 80.0),
    transform: Literal["sigma-points", "quadrature"] = "sigma-points",
) -> LineSet:
    """The set of a name, or of a file.

    Args:
        what: one of ``DRAWN_SETS``, or the path of a file of Gaussians or of poses.
        map_path: a file with the lines of the map, for poses.
        window: for poses, where points are taken [m].
        transform: for poses.

    Raises:
        StudyError: there is no such set or file, or what is in it does not serve.
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
    if map_path is None:
        raise StudyError(f"{path}: holds poses; give the lines of their map with --map FILE")
    return PoseSet(file, map_path, window, transform)
