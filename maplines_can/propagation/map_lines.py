"""Lines of a map as Gaussians in the frame of a car whose pose is uncertain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.arrays import floats
from ..values.gaussian import Gaussian
from ..values.linalg import indefinite
from ..values.line import LeftOut, MapLine, MapLineList, Slot
from ..values.map_error import MapError
from ..values.mixture import GaussianMixture
from ..values.polyline import Polyline, to_ego
from ..values.seen_lines import extended, margins
from .certain_range import MAX_SIGMA, certain_ranges, check_max_sigma
from .refit import MAX_MISFIT, Refit
from .splitting import Mixture
from .stretches import MAX_TURN, stretches
from .transform import Transform

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
    max_sigma: float = MAX_SIGMA,
    components: int | Mapping[Slot, int] = 1,
) -> MapLineList:
    """Return lines of the map as seen from an uncertain pose, ready for ``Transmitter``.

    Each line is given in the range in which a cubic follows it (see ``Refit``), and its covariance
    covers what the cubic misses there. So, at each x from x_min to x_max, the line of the map, as
    seen from a pose drawn from ``ego``, lies within the band of the Gaussian as often as its
    standard deviation says. The range leaves room for the pose error: the line seen from the true
    pose does not end before it. It ends where the line is less certain than ``max_sigma``.

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
        max_sigma: largest standard deviation of the lateral position of a line [m]; its range ends
            where it passes this. Infinite for no limit.
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
    check_lines(lines, ego)
    check_max_sigma(max_sigma)
    counts = _counts(lines, components)
    x_min, x_max = (floats(end, "window").item() for end in window)
    view = view_of(ego, (x_min, x_max), map_error)
    # Lines of one component share the calls; each mixture has a direction of its own to cut along.
    singles = [slot for slot, k in counts.items() if k == 1]
    groups = [singles] * bool(singles) + [[slot] for slot, k in counts.items() if k > 1]
    found: dict[Slot, MapLine | LeftOut] = {}
    for slots in groups:
        seen = stretches([lines[slot] for slot in slots], ego.mean, view.window, view.max_turn)
        found |= {slots[i]: reason for i, reason in seen.left_out.items()}
        if not len(seen.given):
            continue
        refit = Refit(seen, ego.mean, map_error=map_error, max_misfit=max_misfit, room=view.room)
        margin = margins(view.cov, refit.points[:, [0, -1]])
        x_range = (refit.x_range + margin * [1, -1]).clip(x_min, x_max)
        wide = (x_range[:, 1] - x_range[:, 0] >= MIN_RANGE) & ~refit.is_across
        found |= {slots[i]: LeftOut.TOO_SHORT for i in seen.given[~wide]}
        if not wide.any():
            continue
        mixture = Mixture(counts[slots[0]], transform)
        weights, means, covs = mixture.moments(ExtendedRefit(refit, wide), ego)
        make = Gaussian.trusted if _is_positive(covs) else Gaussian
        for i, (low, high) in enumerate(x_range[wide].tolist()):
            slot = slots[seen.given[wide][i]]
            gaussians = tuple(map(make, means[:, i], covs[:, i]))
            rest: dict[str, Any] = {"kind": lines[slot].kind, "x_min": low, "x_max": high}
            if len(gaussians) == 1:
                found[slot] = MapLine(slot, gaussians[0], **rest)
            else:
                found[slot] = MapLine.of_mixture(slot, GaussianMixture(weights, gaussians), **rest)
    found |= _as_far_as_certain([x for x in found.values() if isinstance(x, MapLine)], max_sigma)
    in_order = [(slot, found[slot]) for slot in counts]
    return MapLineList(
        [line for _, line in in_order if isinstance(line, MapLine)],
        {slot: reason for slot, reason in in_order if isinstance(reason, LeftOut)},
    )


def _as_far_as_certain(lines: Sequence[MapLine], max_sigma: float) -> dict[Slot, MapLine | LeftOut]:
    """Return by slot the lines whose ranges are to be shortened, or why they are left out."""
    if not lines:
        return {}
    means = np.array([line.gaussian.mean for line in lines])
    covs = np.array([line.gaussian.cov for line in lines])
    x_ranges = np.array([[line.x_min, line.x_max] for line in lines])
    certain = certain_ranges(means, covs, x_ranges, max_sigma)
    found: dict[Slot, MapLine | LeftOut] = {}
    for i in np.flatnonzero((certain != x_ranges).any(axis=1)).tolist():
        low, high = certain[i].tolist()
        is_long = high - low >= MIN_RANGE  # not if it is NaN
        shorter = replace(lines[i], x_min=low, x_max=high) if is_long else LeftOut.UNCERTAIN
        found[lines[i].slot] = shorter
    return found


class View(NamedTuple):
    """How far lines are used around an uncertain pose."""

    cov: NDArray[np.float64]  #: (3, 3) of the pose and of the map, in the ego frame
    room: float  #: that the ranges leave at their ends, at most [m]
    window: tuple[float, float]  #: with that room [m]
    max_turn: float  #: largest angle between a line and the x axis [rad]


def view_of(ego: Gaussian, window: tuple[float, float], map_error: MapError | None) -> View:
    """Return the view for a Gaussian over the pose, a window [m] and the error of the map."""
    P = ego_cov(ego)
    turn = max(MAX_TURN - TURN_MARGIN * float(np.sqrt(P[2, 2])), MIN_TURN)
    if map_error is not None:  # moves the ends of a line as the pose error does
        shift = map_error.offset_sigma**2 + map_error.point_sigma**2
        P = P + np.diag([shift, shift, map_error.heading_sigma**2])
    farthest = max(map(abs, window))
    corners = np.array([[[farthest, -ASIDE], [farthest, ASIDE]]])
    room = float(margins(P, corners).max())
    return View(P, room, (window[0] - room, window[1] + room), turn)


class ExtendedRefit:
    """Some lines of a refit, with values also at poses from which they are not functions of x."""

    def __init__(self, refit: Refit, lines: NDArray[np.bool_]) -> None:
        self._refit, self._lines = refit, lines
        self.noise_cov = None if refit.noise_cov is None else refit.noise_cov[lines]

    def __call__(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (N, L, 4) lines for (N, 3) poses."""
        return extended(lambda at: self._refit(at)[:, self._lines], poses, self._refit.pose)


def _is_positive(covs: NDArray[np.float64]) -> bool:
    """Return whether symmetric (..., n, n) matrices are covariances, checked all at once."""
    variances = np.diagonal(covs, axis1=-2, axis2=-1)
    return bool(np.isfinite(covs).all() and (variances > 0).all() and not indefinite(covs).any())


def check_lines(lines: Mapping[Slot, Polyline], ego: Gaussian) -> None:
    """Check the arguments that ``map_lines`` and ``map_scene`` share."""
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


def _counts(
    lines: Mapping[Slot, Polyline], components: int | Mapping[Slot, int]
) -> dict[Slot, int]:
    """Return the number of components of each line, in order."""
    if isinstance(components, Mapping):
        if missing := [Slot(slot).name for slot in lines if slot not in components]:
            raise ValueError(f"components must have a number for each line, but not {missing[0]}")
        return {Slot(slot): components[slot] for slot in lines}
    return dict.fromkeys(map(Slot, lines), components)


def ego_cov(ego: Gaussian) -> NDArray[np.float64]:
    """Return the (3, 3) covariance of the pose with its position in the ego frame."""
    R = np.eye(3)
    R[:2, :2] = to_ego(np.eye(2), [0.0, 0.0, ego.mean[2]]).T
    return np.asarray(R @ ego.cov @ R.T)
