"""Lines of a map in the frame of a car whose pose is uncertain: one by one, or as a scene.

Both go the same way: the stretches of the lines that the car sees (``stretches``), the range in
which a cubic follows each (``Refit``), its moments over the pose (``Transform``), and the range in
which it is valid and certain enough. Lines of a scene are propagated together, so that they have a
joint covariance.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..values.arrays import floats
from ..values.elementary import sin_cos_one
from ..values.fixed_order import congruence, product
from ..values.gaussian import Gaussian
from ..values.linalg import block_diagonal, diagonal_blocks, is_covariance
from ..values.line import MIN_RANGE, PARAMETERS, LeftOut, MapLine, MapLineList, Slot
from ..values.map_error import MapError
from ..values.mixture import GaussianMixture
from ..values.polyline import Polyline
from ..values.scene import PoseError, Scene
from ..values.seen_lines import extended, margins, valid_ranges
from .certain_range import MAX_SIGMA, certain_ranges, check_max_sigma
from .in_c import CycleInC
from .refit import MAX_MISFIT, Refit
from .sigma_points import SigmaPoints
from .splitting import Mixture
from .stretches import MAX_TURN, Stretches, stretches
from .transform import Transform

#: Parameters of a line.
N = len(PARAMETERS)
#: Standard deviations of the heading for which the turn of a line leaves room.
TURN_MARGIN = 3.0
#: Least limit of the turn of a line, however uncertain the heading is [rad].
MIN_TURN = np.radians(20.0)
#: Lateral distance for which the window is widened, so that the margins do not shorten it [m].
ASIDE = 10.0
#: The ends of the ranges in which the cubics of a scene are fitted are multiples of this, so that a
#: message can state them exactly [m].
STEP = 1.0
#: Most times that a line of a scene is fitted again in a shorter range, since it is uncertain at
#: its end.
TRIALS = 8
#: The default transform.
SIGMA_POINTS = SigmaPoints()


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
    lines, window = _checked(lines, ego, window, max_sigma)
    asked = (lines, ego, window, map_error, max_misfit, max_sigma)
    if components == 1 and (cycle := CycleInC.of(*asked)) is not None:
        in_c = cycle.map_lines(transform or SIGMA_POINTS)
        if in_c is not None:
            return in_c
    view = View.of(*asked)
    counts = _counts(lines, components)
    # Lines of one component share the calls; each mixture has a direction of its own to cut along.
    singles = [slot for slot, k in counts.items() if k == 1]
    groups = [singles] * bool(singles) + [[slot] for slot, k in counts.items() if k > 1]
    found: dict[Slot, MapLine | LeftOut] = {}
    for slots in groups:
        found |= _lines(view, slots, counts[slots[0]], transform)
    found |= _as_far_as_certain([x for x in found.values() if isinstance(x, MapLine)], max_sigma)
    in_order = [(slot, found[slot]) for slot in counts]
    return MapLineList(
        [line for _, line in in_order if isinstance(line, MapLine)],
        {slot: reason for slot, reason in in_order if isinstance(reason, LeftOut)},
    )


def map_scene(
    lines: Mapping[Slot, Polyline],
    ego: Gaussian,
    *,
    correlation_time: float = math.inf,
    window: tuple[float, float] = (-20.0, 80.0),
    transform: Transform | None = None,
    map_error: MapError | None = None,
    max_misfit: float = MAX_MISFIT,
    max_sigma: float = MAX_SIGMA,
) -> Scene:
    """Return lines of the map as seen from an uncertain pose, with their joint Gaussian.

    The lines are those of ``map_lines``, but for three details. The ranges in which the cubics are
    fitted end at whole metres. A line that is uncertain far ahead is fitted again in a shorter
    range. The valid ranges leave a little more room at their ends, since they are computed from
    what a receiver knows, too, and may exceed the window by that room. All lines are propagated
    through the same points, so their joint covariance is a covariance.

    The error of the map is independent from line to line.

    Args:
        lines: the line of the map for each slot.
        ego: Gaussian over the pose (e_x [m], e_y [m], e_h [rad]) in the map frame.
        correlation_time: of the pose error [s]; infinite if it is unknown.
        window: (x_min, x_max) ahead of the mean pose that the ranges may extend to [m].
        transform: for the moments; None for ``SigmaPoints()``.
        map_error: error of the map, in addition to the error of the pose.
        max_misfit: largest deviation of a cubic from its line [m].
        max_sigma: largest standard deviation of the lateral position of a line [m]; its range ends
            where it passes this. Infinite for no limit.

    Returns:
        The lines in the order of ``lines``; ``left_out`` has the reasons of the others by slot.

    Raises:
        TypeError: ``lines`` is not a mapping from slots to polylines.
        ValueError: ``ego`` is not over three variables, or another value is out of range.

    >>> lines = {Slot.EGO_LEFT: Polyline([[-100, 1.75], [200, 1.75]]),
    ...          Slot.EGO_RIGHT: Polyline([[-100, -1.75], [200, -1.75]])}
    >>> scene = map_scene(lines, Gaussian([0, 0, 0], np.diag([0.1, 0.2, 0.01]) ** 2))
    >>> scene.centre(0.0).sigma.round(3), scene.width(0.0).sigma.round(3)
    (np.float64(0.2), np.float64(0.024))
    """
    transform = transform or SIGMA_POINTS
    lines, window = _checked(lines, ego, window, max_sigma)
    asked = (lines, ego, window, map_error, max_misfit, max_sigma)
    if (cycle := CycleInC.of(*asked)) is not None:
        in_c = cycle.map_scene(transform, correlation_time)
        if in_c is not None:
            return in_c
    view = View.of(*asked)
    pose_error = PoseError(view.pose_cov, correlation_time)
    slots = [Slot(slot) for slot in lines]
    without = Scene((), np.zeros((0, 0)), pose_error, np.zeros((0, 2)), map_error)
    if not lines:
        return without
    seen = view.stretches(slots)
    left_out = {slots[i]: reason for i, reason in sorted(seen.left_out.items())}
    if not len(seen.given):
        return replace(without, left_out=left_out)
    joint = _joint(view, seen, pose_error.cov, transform)
    kept, refit = joint.kept, joint.refit
    left_out |= {slots[i]: LeftOut.TOO_SHORT for i in seen.given[~kept]}
    left_out |= {slots[i]: LeftOut.UNCERTAIN for i in seen.given[joint.is_shorter & ~kept]}
    left_out = {slot: left_out[slot] for slot in slots if slot in left_out}
    if not kept.any():
        return replace(without, left_out=left_out)
    # The scene checks the joint covariance, and so those of its lines.
    gaussians = map(Gaussian.trusted, joint.means, diagonal_blocks(joint.cov, N))
    given = [slots[i] for i in seen.given[kept]]
    return Scene(
        tuple(
            MapLine(slot, gaussian, kind=lines[slot].kind, x_min=low, x_max=high)
            for slot, gaussian, (low, high) in zip(
                given, gaussians, joint.x_ranges.tolist(), strict=True
            )
        ),
        joint.cov,
        pose_error,
        refit.x_range[kept],
        map_error,
        left_out,
        refit.quartic[kept],
        joint.specific_covs[kept],
    )


# ---- what both share ------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class View:
    """Lines of a map around an uncertain pose, and how far they are used."""

    lines: Mapping[Slot, Polyline]
    ego: Gaussian
    x_range: tuple[float, float]  #: that the ranges may extend to [m]
    map_error: MapError | None
    max_misfit: float  #: of a cubic [m]
    max_sigma: float  #: of the lateral position [m]
    pose_cov: NDArray[np.float64]  #: (3, 3) in the ego frame: along [m], across [m], heading [rad]
    cov: NDArray[np.float64]  #: the same with what of the map error acts as a pose error
    room: float  #: that the ranges leave at their ends, at most [m]
    max_turn: float  #: largest angle between a line and the x axis [rad]

    @classmethod
    def of(
        cls,
        lines: Mapping[Slot, Polyline],
        ego: Gaussian,
        window: tuple[float, float],
        map_error: MapError | None = None,
        max_misfit: float = MAX_MISFIT,
        max_sigma: float = MAX_SIGMA,
    ) -> View:
        """Return the view of the checked arguments of ``map_lines``."""
        x_min, x_max = window
        s, c = sin_cos_one(ego.mean.item(2))
        R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        pose_cov = cov = congruence(R, ego.cov)
        turn = max(MAX_TURN - TURN_MARGIN * float(np.sqrt(cov[2, 2])), MIN_TURN)
        if map_error is not None:  # moves the ends of a line as the pose error does
            shift = map_error.offset_sigma**2 + map_error.point_sigma**2
            cov = cov + np.diag([shift, shift, map_error.heading_sigma**2])
        farthest = max(abs(x_min), abs(x_max))
        corners = np.array([[[farthest, -ASIDE], [farthest, ASIDE]]])
        room = float(margins(cov, corners).max())
        ends = x_min, x_max
        return cls(lines, ego, ends, map_error, max_misfit, max_sigma, pose_cov, cov, room, turn)

    def stretches(self, slots: Sequence[Slot]) -> Stretches:
        """Return what is seen of the lines of some slots, with room at both ends."""
        window = self.x_range[0] - self.room, self.x_range[1] + self.room
        return stretches([self.lines[slot] for slot in slots], self.ego.mean, window, self.max_turn)

    def refit(self, seen: Stretches, step: float = 0.0) -> Refit:
        """Return the cubics of some stretches; their ranges may end at multiples of a step [m]."""
        return Refit(
            seen,
            self.ego.mean,
            map_error=self.map_error,
            max_misfit=self.max_misfit,
            room=self.room,
            step=step,
        )


class ExtendedRefit:
    """Some lines of a refit, with values also at poses from which they are not functions of x."""

    def __init__(self, refit: Refit, lines: NDArray[np.bool_]) -> None:
        self._refit, self._lines = refit, lines
        self.noise_cov = None if refit.noise_cov is None else refit.noise_cov[lines]

    def __call__(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (N, L, 4) lines for (N, 3) poses."""
        found = self._refit(poses)[:, self._lines]
        if not np.isnan(found).any():
            return found
        return extended(lambda at: self._refit(at)[:, self._lines], poses, self._refit.pose)


def _checked(
    lines: Mapping[Slot, Polyline], ego: Gaussian, window: tuple[float, float], max_sigma: float
) -> tuple[dict[Slot, Polyline], tuple[float, float]]:
    """Return the lines, of any mapping, and the window as floats; the others are checked."""
    if not isinstance(lines, Mapping):
        raise TypeError(
            "lines must be a mapping from slots to polylines, such as "
            f"{{Slot.EGO_LEFT: Polyline(points)}}, got {type(lines).__name__}"
        )
    lines = dict(lines)  # other threads may change theirs
    for slot, line in lines.items():
        if not isinstance(line, Polyline):
            raise TypeError(
                f"the line of {Slot(slot).name} must be a Polyline, got {type(line).__name__}"
            )
    if ego.mean.size != 3:
        raise ValueError(
            f"ego must be over the pose (e_x [m], e_y [m], e_h [rad]), got {ego.mean.size}-D"
        )
    check_max_sigma(max_sigma)
    x_min, x_max = floats(window, "window").tolist()
    return lines, (x_min, x_max)


def _counts(
    lines: Mapping[Slot, Polyline], components: int | Mapping[Slot, int]
) -> dict[Slot, int]:
    """Return the number of components of each line, in order."""
    if isinstance(components, Mapping):
        if missing := [Slot(slot).name for slot in lines if slot not in components]:
            raise ValueError(f"components must have a number for each line, but not {missing[0]}")
        return {Slot(slot): components[slot] for slot in lines}
    return dict.fromkeys(map(Slot, lines), components)


# ---- lines one by one -----------------------------------------------------------------


def _lines(
    view: View, slots: Sequence[Slot], k: int, transform: Transform | None
) -> dict[Slot, MapLine | LeftOut]:
    """Return by slot some lines as k components each, or why they are left out."""
    seen = view.stretches(slots)
    found: dict[Slot, MapLine | LeftOut] = {slots[i]: why for i, why in seen.left_out.items()}
    if not len(seen.given):
        return found
    refit = view.refit(seen)
    margin = margins(view.cov, refit.points[:, [0, -1]])
    x_range = (refit.x_range + margin * [1, -1]).clip(*view.x_range)
    wide = (x_range[:, 1] - x_range[:, 0] >= MIN_RANGE) & ~refit.is_across
    found |= {slots[i]: LeftOut.TOO_SHORT for i in seen.given[~wide]}
    if not wide.any():
        return found
    function = ExtendedRefit(refit, wide)
    weights = None
    if k == 1:
        mean, cov = (transform or SIGMA_POINTS).moments(function, view.ego)
        means, covs = mean[None], cov[None]
    else:
        weights, means, covs = Mixture(k, transform).moments(function, view.ego)
    variances = np.diagonal(covs, axis1=-2, axis2=-1)
    # Checked all at once; else the constructor says what is wrong.
    make = Gaussian.trusted if (variances > 0).all() and is_covariance(covs) else Gaussian
    for i, (low, high) in enumerate(x_range[wide].tolist()):
        slot = slots[seen.given[wide][i]]
        gaussians = tuple(map(make, means[:, i], covs[:, i]))
        rest: dict[str, Any] = {"kind": view.lines[slot].kind, "x_min": low, "x_max": high}
        if weights is None:
            found[slot] = MapLine(slot, gaussians[0], **rest)
        else:
            found[slot] = MapLine.of_mixture(slot, GaussianMixture(weights, gaussians), **rest)
    return found


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


# ---- lines of a scene -----------------------------------------------------------------


class _Joint(NamedTuple):
    """Lines of a scene as fitted, and the moments of those that are kept."""

    refit: Refit
    specific_covs: NDArray[np.float64]  #: (L, 4, 4)
    kept: NDArray[np.bool_]  #: (L,) whether a line is in the scene
    is_shorter: NDArray[np.bool_]  #: (L,) whether it was fitted again, since it was uncertain
    means: NDArray[np.float64] = np.zeros((0, N))  #: (K, 4) of the lines that are kept
    cov: NDArray[np.float64] = np.zeros((0, 0))  #: (4 K, 4 K)
    x_ranges: NDArray[np.float64] = np.zeros((0, 2))  #: (K, 2) in which they are valid [m]


def _joint(view: View, seen: Stretches, P: NDArray[np.float64], transform: Transform) -> _Joint:
    """Return the lines of a scene in the ranges in which they are valid and certain enough.

    Where a line is uncertain at an end, it is fitted again in a shorter range, at most ``TRIALS``
    times. A line whose range turns out too short is dropped, and the others are propagated again.
    """
    heading_sigma = 0.0 if view.map_error is None else view.map_error.heading_sigma
    is_shorter, dropped = np.zeros((2, len(seen.given)), dtype=bool)
    trials = np.zeros(len(seen.given), dtype=int)
    while True:
        refit = view.refit(seen, STEP)
        specific = refit.noise_cov
        if specific is None:
            specific = np.zeros((len(seen.given), N, N))
        x_ranges = valid_ranges(
            refit(view.ego.mean[None])[0], refit.x_range, P, specific, heading_sigma
        )
        kept = (_length(x_ranges) >= MIN_RANGE) & ~refit.is_across & ~dropped
        kept &= (refit.x_range % STEP == 0).all(axis=1)
        if not kept.any():
            return _Joint(refit, specific, kept, is_shorter)
        mean, cov = transform.moments(
            _Flat(ExtendedRefit(refit, kept), view.ego.mean), Gaussian.trusted(np.zeros(3), P)
        )
        means, places = mean.reshape(-1, N), np.flatnonzero(kept)
        # From the means that are sent, as a receiver does.
        x_ranges = valid_ranges(means, refit.x_range[kept], P, specific[kept], heading_sigma)
        ended = _length(x_ranges) < MIN_RANGE
        if ended.any():
            dropped[places[ended]] = True
            continue
        certain = certain_ranges(means, diagonal_blocks(cov, N), x_ranges, view.max_sigma)
        long = (certain != x_ranges).any(axis=1)
        if not long.any():
            return _Joint(refit, specific, kept, is_shorter, means, cov, x_ranges)
        places = places[long]
        shorter = _shorter(refit.x_range[places], x_ranges[long], certain[long])
        is_shorter[places] = True
        dropped[places] = (trials[places] >= TRIALS) | (_length(shorter) < MIN_RANGE)
        trials[places] += 1
        ends = refit.x_range.copy()
        ends[places] = np.where(dropped[places, None], ends[places], shorter)
        seen = replace(seen, x_range=ends)


def _length(x_ranges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (L,) lengths of (L, 2) ranges [m]."""
    return np.asarray(x_ranges[:, 1] - x_ranges[:, 0])


def _shorter(
    fit_ranges: NDArray[np.float64], x_ranges: NDArray[np.float64], certain: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the (L, 2) ranges to be fitted for lines to be valid where they are certain.

    A line that is certain nowhere may be so if less of it is fitted: half of what is ahead.
    """
    car = np.clip(0.0, fit_ranges[:, 0], fit_ranges[:, 1])[:, None]
    half = car + (fit_ranges - car) / 2
    return np.where(np.isnan(certain), half, certain + (fit_ranges - x_ranges))


class _Flat:
    """The parameters of all lines as one output, so that a transform gives their joint moments.

    They are functions of the displacement in the ego frame, as at a receiver: so both take the same
    sigma points.
    """

    def __init__(self, function: ExtendedRefit, pose: NDArray[np.float64]) -> None:
        self._function, self._pose = function, pose
        s, c = sin_cos_one(pose.item(2))
        self._to_map = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        own = function.noise_cov
        self.noise_cov = None if own is None else block_diagonal(own)

    def __call__(self, displacements: NDArray[np.float64]) -> NDArray[np.float64]:
        poses = self._pose + product(displacements, self._to_map)
        return self._function(poses).reshape(len(poses), -1)
