"""Representations of a line: a point, a Gaussian or a mixture, before and after the wire."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...propagation import Linear, MonteCarlo, Quadrature, Refit, SigmaPoints, Transform
from ...propagation.splitting import Mixture
from ...values.gaussian import Gaussian
from ...values.line import Slot, Status
from ...wire import Codec

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
