"""Lines of a map as Gaussians in the frame of a car whose pose is uncertain."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from ..gaussian import Gaussian
from ..line import Kind, MapLine, Slot
from ..mixture import GaussianMixture
from ..polyline import Polyline
from .refit import MapError, Refit
from .splitting import Mixture
from .transform import Transform


def map_lines(
    lines: Iterable[tuple[Slot, Kind, Polyline]],
    ego: Gaussian,
    window: tuple[float, float],
    *,
    components: int | Sequence[int] = 1,
    transform: Transform | None = None,
    map_error: MapError | None = None,
) -> list[MapLine]:
    """Return lines of the map as seen from an uncertain pose, ready for ``Transmitter``.

    Each line is fitted and transformed in a call of its own. One call for all of
    them is faster, but some results differ in the last bit.

    Args:
        lines: slot, kind and map points of each line, such as the lines of a ``Scenario``.
        ego: Gaussian over the pose (e_x [m], e_y [m], e_h [rad]) in the map frame.
        window: (x_min, x_max) ahead of the mean pose from which the points are taken [m].
        components: components of the Gaussian mixture of each line, 1 to 8, as one number for
            all lines or one for each; 1 gives a single Gaussian.
        transform: for the moments of each component; None for the default of ``Mixture``.
        map_error: error of the map, in addition to the error of the pose.

    Raises:
        IllPosedError: a line has fewer than 4 points in the window, or doubles back.
        ValueError: ``components`` is out of range, or is not one number for each line.

    >>> road = Polyline([[x, 1.75] for x in range(-30, 100, 2)])
    >>> ego = Gaussian([0, 0, 0], [[0.09, 0, 0], [0, 0.01, 0], [0, 0, 1e-4]])
    >>> (line,) = map_lines([(Slot.EGO_LEFT, Kind.SOLID, road)], ego, (-20.0, 80.0))
    >>> line.gaussian.mean.round(2)[0], line.gaussian.sigma.round(2)[0], line.x_max
    (np.float64(1.75), np.float64(0.1), 80.0)
    """
    lines = list(lines)
    counts = [components] * len(lines) if isinstance(components, int) else list(components)
    if len(counts) != len(lines):
        raise ValueError(
            f"components must be one number or one for each of {len(lines)} lines, got {counts}"
        )
    result = []
    for (slot, kind, polyline), k in zip(lines, counts, strict=True):
        refit = Refit(polyline, ego.mean, window, map_error)
        x_min, x_max = refit.x_range.tolist()
        valid_range: dict[str, Any] = {"x_min": x_min, "x_max": x_max, "kind": kind}
        weights, means, covs = Mixture(k, transform).moments(refit, ego)
        gaussians = tuple(Gaussian(mean, cov) for mean, cov in zip(means, covs, strict=True))
        if k == 1:
            result.append(MapLine(slot, gaussians[0], **valid_range))
        else:
            mixture = GaussianMixture(weights, gaussians)
            result.append(MapLine.of_mixture(slot, mixture, **valid_range))
    return result
