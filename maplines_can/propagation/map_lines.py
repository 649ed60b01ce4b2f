"""Lines of a map as Gaussians in the frame of a car whose pose is uncertain."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..arrays import floats
from ..gaussian import Gaussian, indefinite
from ..line import LeftOut, MapLine, MapLineList, Slot
from ..mixture import GaussianMixture
from ..polyline import MAX_TURN, Polyline, stretches, to_ego
from .refit import MAX_MISFIT, MapError, Refit
from .splitting import Mixture
from .transform import Transform

#: Standard deviations of the pose error by which the range of a line is shortened at an end, so
#: that the line seen from the true pose ends beyond it.
MARGIN = 3.0
#: Lines of less range are left out [m].
MIN_RANGE = 1.0
#: Standard deviations of the heading for which the turn of a line leaves room.
TURN_MARGIN = 3.0
#: Least limit of the turn of a line, however uncertain the heading is [rad].
MIN_TURN = np.radians(20.0)
#: Lateral distance for which the window is widened, so that the margins do not shorten it [m].
ASIDE = 10.0


def map_lines(
    lines: Mapping[Slot, Polyline],
    ego: Gaussian,
    *,
    window: tuple[float, float] = (-20.0, 80.0),
    transform: Transform | None = None,
    map_error: MapError | None = None,
    max_misfit: float = MAX_MISFIT,
    components: int | Mapping[Slot, int] = 1,
) -> MapLineList:
    """Return lines of the map as seen from an uncertain pose, ready for ``Transmitter``.

    Each line is given in the range in which a cubic follows it (see ``Refit``), and its covariance
    covers what the cubic misses there. So, at each x from x_min to x_max, the line of the map, as
    seen from a pose drawn from ``ego``, lies within the band of the Gaussian as often as its
    standard deviation says. The range leaves room for the pose error: the line seen from the true
    pose does not end before it.

    A line that cannot be given is left out, with a reason, and does not affect the others. A pose
    from which a line is not a function of x does not lose the line either: the parameters are
    extrapolated from the mean pose.

    Args:
        lines: the line of the map for each slot.
        ego: Gaussian over the pose (e_x [m], e_y [m], e_h [rad]) in the map frame.
        window: (x_min, x_max) ahead of the mean pose that the ranges may extend to [m].
        transform: for the moments of each component; None for ``SigmaPoints()``, and for the
            default of ``Mixture`` if there are several components.
        map_error: error of the map, in addition to the error of the pose.
        max_misfit: largest deviation of a cubic from its line [m].
        components: components of the Gaussian mixture of each line, 1 to 8, as one number for
            all lines or one for each slot; 1 gives a single Gaussian.

    Returns:
        The lines in the order of ``lines``; ``left_out`` has the reasons of the others by slot.

    Raises:
        TypeError: ``lines`` is not a mapping from slots to polylines.
        ValueError: ``ego`` is not over three variables, or another value is out of range.

    >>> road = Polyline([[-100, 1.75], [200, 1.75]])
    >>> ego = Gaussian([0, 0, 0], [[0.09, 0, 0], [0, 0.01, 0], [0, 0, 1e-4]])
    >>> lines = map_lines({Slot.EGO_LEFT: road, Slot.EGO_RIGHT: Polyline([[0, -3], [0, -9]])}, ego)
    >>> [(line.slot.name, line.gaussian.mean.round(2)[0], line.x_max) for line in lines]
    [('EGO_LEFT', np.float64(1.75), 80.0)]
    >>> lines.left_out
    {<Slot.EGO_RIGHT: 1>: <LeftOut.ACROSS: "the line is across the car's x axis">}
    """
    counts = _checked(lines, ego, components)
    x_min, x_max = (floats(end, "window").item() for end in window)
    P = _ego_cov(ego)
    turn = max(MAX_TURN - TURN_MARGIN * float(np.sqrt(P[2, 2])), MIN_TURN)
    if map_error is not None:  # moves the ends of a line as the pose error does
        shift = map_error.offset_sigma**2 + map_error.point_sigma**2
        P = P + np.diag([shift, shift, map_error.heading_sigma**2])
    # A turned car sees the end of a line at x at about x cos(turn), which is nearer.
    shortening = 1 - math.cos(min(MARGIN * math.sqrt(P[2, 2]), math.pi / 2))
    room = MARGIN * float(_along_sigma(P, np.array([-ASIDE, ASIDE])).max())
    room += shortening * max(abs(x_min), abs(x_max))
    # Lines of one component share the calls; each mixture has a direction of its own to cut along.
    singles = [slot for slot, k in counts.items() if k == 1]
    groups = [singles] * bool(singles) + [[slot] for slot, k in counts.items() if k > 1]
    found: dict[Slot, MapLine | LeftOut] = {}
    for slots in groups:
        seen = stretches(
            [lines[slot] for slot in slots], ego.mean, (x_min - room, x_max + room), turn
        )
        found |= {slots[i]: reason for i, reason in seen.left_out.items()}
        if not len(seen.given):
            continue
        refit = Refit(seen, ego.mean, map_error=map_error, max_misfit=max_misfit, room=room)
        margin = MARGIN * _along_sigma(P, refit.points[:, [0, -1], 1])  # (L, 2)
        margin += shortening * np.abs(refit.x_range)
        x_range = (refit.x_range + margin * [1, -1]).clip(x_min, x_max)
        wide = (x_range[:, 1] - x_range[:, 0] >= MIN_RANGE) & ~refit.is_across
        found |= {slots[i]: LeftOut.TOO_SHORT for i in seen.given[~wide]}
        if not wide.any():
            continue
        mixture = Mixture(counts[slots[0]], transform)
        weights, means, covs = mixture.moments(_Extended(refit, wide), ego)
        make = Gaussian.trusted if _is_positive(covs) else Gaussian
        for i, (low, high) in enumerate(x_range[wide].tolist()):
            slot = slots[seen.given[wide][i]]
            gaussians = tuple(map(make, means[:, i], covs[:, i]))
            rest: dict[str, Any] = {"kind": lines[slot].kind, "x_min": low, "x_max": high}
            if len(gaussians) == 1:
                found[slot] = MapLine(slot, gaussians[0], **rest)
            else:
                found[slot] = MapLine.of_mixture(slot, GaussianMixture(weights, gaussians), **rest)
    in_order = [(slot, found[slot]) for slot in counts]
    return MapLineList(
        [line for _, line in in_order if isinstance(line, MapLine)],
        {slot: reason for slot, reason in in_order if isinstance(reason, LeftOut)},
    )


class _Extended:
    """Some lines of a refit, with values also at poses from which they are not functions of x.

    These are extrapolated linearly from the mean pose through the farthest pose with a value that
    halving the distance finds, so that a transform keeps the spread in that direction.
    """

    def __init__(self, refit: Refit, lines: NDArray[np.bool_]) -> None:
        self._refit, self._lines = refit, lines
        self.noise_cov = None if refit.noise_cov is None else refit.noise_cov[lines]

    def _values(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        return self._refit(poses)[:, self._lines]

    def __call__(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        values = self._values(poses)
        missing = np.isnan(values[..., 0])
        if not missing.any():
            return values
        pose = self._refit.pose
        mean = self._values(pose[None])
        share = 1.0
        while missing.any():
            share /= 2
            rows = np.flatnonzero(missing.any(axis=1))
            inner = self._values(pose + share * (poses[rows] - pose))
            filled = mean + (inner - mean) / share
            values[rows] = np.where(missing[rows][..., None], filled, values[rows])
            missing = np.isnan(values[..., 0])
        return values


def _is_positive(covs: NDArray[np.float64]) -> bool:
    """Return whether symmetric (..., n, n) matrices are covariances, checked all at once."""
    variances = np.diagonal(covs, axis1=-2, axis2=-1)
    return bool(np.isfinite(covs).all() and (variances > 0).all() and not indefinite(covs).any())


def _checked(
    lines: Mapping[Slot, Polyline], ego: Gaussian, components: int | Mapping[Slot, int]
) -> dict[Slot, int]:
    """Return the number of components of each line, in order."""
    if not isinstance(lines, Mapping):
        raise TypeError(
            "lines must be a mapping from slots to polylines, such as "
            f"{{Slot.EGO_LEFT: Polyline(points)}}, got {type(lines).__name__}"
        )
    for slot, line in lines.items():
        if not isinstance(line, Polyline):
            raise TypeError(
                f"the line of {Slot(slot).name} must be a Polyline, got {type(line).__name__}"
            )
    if ego.dimension != 3:
        raise ValueError(
            f"ego must be over the pose (e_x [m], e_y [m], e_h [rad]), got {ego.dimension}-D"
        )
    if isinstance(components, Mapping):
        if missing := [Slot(slot).name for slot in lines if slot not in components]:
            raise ValueError(f"components must have a number for each line, but not {missing[0]}")
        return {Slot(slot): components[slot] for slot in lines}
    return dict.fromkeys(map(Slot, lines), components)


def _ego_cov(ego: Gaussian) -> NDArray[np.float64]:
    """Return the (3, 3) covariance of the pose with its position in the ego frame."""
    R = np.eye(3)
    R[:2, :2] = to_ego(np.eye(2), [0.0, 0.0, ego.mean[2]]).T
    return np.asarray(R @ ego.cov @ R.T)


def _along_sigma(P: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (...,) standard deviations of x of points at (...,) lateral positions [m]."""
    return np.sqrt((P[0, 0] - 2 * y * P[0, 2] + y * y * P[2, 2]).clip(0))
