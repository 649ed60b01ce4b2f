"""Monte Carlo sampling, the reference for the other transforms."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.errors import IllPosedError
from ..values.gaussian import Gaussian
from ..values.linalg import square_root
from .transform import Moments, Transform, weighted_moments, without_value


class Samples(NamedTuple):
    """Draws of a Gaussian and the values of a function at them."""

    inputs: NDArray[np.float64]  #: (k, n) draws of the Gaussian
    values: NDArray[np.float64]  #: (k, m) or (k, L, m) values of the function
    ill_posed: int  #: number of excluded draws, at which the function has no value


@dataclass(frozen=True)
class MonteCarlo(Transform):
    """n random draws (Map Line Interface, eq. 2 and 3).

    The standard error of a mean is sigma / sqrt(n), and that of a standard deviation
    sigma / sqrt(2 n). Draws at which the function has no value are excluded and
    counted, with a warning.

    Args:
        n: number of draws, 2 or more.
        seed: the same seed gives the same draws.

    >>> result = MonteCarlo(100_000, seed=1)(np.sin, Gaussian([0.0], [[1.0]]))
    >>> bool(abs(result.cov[0, 0] - (1 - np.exp(-2)) / 2) < 0.01)
    True
    """

    n: int = 100_000
    seed: int = 0

    def __post_init__(self) -> None:
        if not self.n >= 2:
            raise ValueError(f"n must be 2 or more, got {self.n!r}")

    def samples(self, function: Callable[..., Any], gaussian: Gaussian) -> Samples:
        """Return draws and values; the values include random errors of ``noise_cov``, if any.

        Raises:
            IllPosedError: the function has a value at fewer than 2 draws.
        """
        samples = self._exact_samples(function, gaussian)
        noise_cov = getattr(function, "noise_cov", None)
        if noise_cov is None:
            return samples
        values = samples.values.copy()
        rng = np.random.default_rng([self.seed, 1])
        for index in np.ndindex(noise_cov.shape[:-2]):
            normal = rng.standard_normal((len(values), values.shape[-1]))
            values[(slice(None), *index)] += normal @ square_root(noise_cov[index]).T
        return samples._replace(values=values)

    def _exact_samples(self, function: Callable[..., Any], gaussian: Gaussian) -> Samples:
        """Return draws and values without errors of ``noise_cov``."""
        inputs = gaussian.sample(self.n, self.seed)
        values = np.asarray(function(inputs), dtype=float)
        excluded = without_value(values)
        ill_posed = int(excluded.sum())
        if ill_posed > self.n - 2:
            raise IllPosedError(
                f"the function has no value at {ill_posed} of {self.n} draws; narrow the Gaussian"
            )
        if ill_posed:
            warnings.warn(f"{ill_posed} of {self.n} draws are ill-posed and excluded", stacklevel=4)
            inputs, values = inputs[~excluded], values[~excluded]
        return Samples(inputs, values, ill_posed)

    def _moments(self, function: Callable[..., Any], gaussian: Gaussian) -> Moments:
        values = self._exact_samples(function, gaussian).values
        weights = np.full(len(values), 1 / len(values))
        return weighted_moments(values, weights, weights)
