"""What the Gaussian of a line has beyond a misfit in the variance of y_off alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from maplines_can import Gaussian, MapError, Polyline
from maplines_can.propagation.from_map import MAX_SIGMA, Query
from maplines_can.propagation.refit import MAX_MISFIT, Refit

from .witness import WINDOW, Array


def excess_covs(
    lines: Mapping[Any, Polyline], ego: Gaussian, error: MapError | None
) -> dict[Any, Array]:
    """Return a (4, 4) covariance for each line that ``map_lines`` gives, by slot.

    A refit without a limit of the misfit has the part of the covariance that is due to the map
    alone.
    """
    slots, refit, *_ = Query(lines, ego, WINDOW, error, MAX_MISFIT, MAX_SIGMA).fitted()
    covs = {}
    for i, slot in enumerate(slots):
        window = tuple(refit.x_range[i].tolist())
        of_map = Refit(lines[slot], ego.mean, window, error, max_misfit=np.inf).noise_cov
        cov = np.asarray(refit.noise_cov)[i] - (0.0 if of_map is None else of_map)
        cov[0, 0] -= refit.misfit[i] ** 2
        covs[slot] = cov
    return covs
