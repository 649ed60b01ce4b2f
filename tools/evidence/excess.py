"""What the Gaussian of a line has beyond a misfit in the variance of y_off alone."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from maplines_can import Gaussian, MapError, Polyline
from maplines_can.propagation.cubic_fit import coefficient_variances, longest_ranges
from maplines_can.propagation.from_map import View
from maplines_can.propagation.refit import MAX_MISFIT, Refit
from maplines_can.values.seen_lines import bases

from .witness import WINDOW, Array


def excess_covs(
    lines: Mapping[Any, Polyline], ego: Gaussian, error: MapError | None
) -> dict[Any, Array]:
    """Return a (4, 4) covariance for each line that ``map_lines`` gives, by slot."""
    view, slots = View.of(lines, ego, WINDOW, error), [*lines]
    seen = view.stretches(slots)
    if not len(seen.given):
        return {}
    fitted = longest_ranges(seen, MAX_MISFIT, view.room, 0.0)
    mean = Refit(seen, ego.mean, room=view.room, step=0.0)(ego.mean[None])[0]
    point_sigma = 0.0 if error is None else error.point_sigma
    J, variances = bases(mean, fitted.x_range), coefficient_variances(seen, fitted, point_sigma)
    covs = np.einsum("lik,lk,ljk->lij", J, variances, J)
    covs[:, 0, 0] -= fitted.misfit**2
    return {slots[i]: cov for i, cov in zip(seen.given, covs, strict=True)}
