"""Sets of line Gaussians on which the wire is judged."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import IllPosedError
from ..propagation import MapError, Refit, SigmaPoints
from ..scenarios import SCENARIOS, random_scenarios

__all__ = ["Gaussians", "hostile", "paper", "road"]


class Gaussians(NamedTuple):
    """Lines as Gaussians."""

    mean: NDArray[np.float64]  #: (N, 4)
    cov: NDArray[np.float64]  #: (N, 4, 4)


def paper(n: int, seed: int = 0) -> Gaussians:
    """Pose error only: the fixed scenarios and random roads, n in all. Nearly singular."""
    return _gathered(_lines(n, seed, with_map_error=False), n)


def road(n: int, seed: int = 0) -> Gaussians:
    """Pose and map error: point errors and offsets of 2 to 20 cm, a turn of 0.05 deg."""
    return _gathered(_lines(n, seed, with_map_error=True), n)


def hostile(
    n: int, seed: int = 0, singular_share: float = 0.1, at_limit_share: float = 0.1
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
    transform = SigmaPoints()
    # A random road whose sigma points look across the line is no line to send: skipped.
    for scene in (*SCENARIOS.values(), *random_scenarios(2 * n, seed)):
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
