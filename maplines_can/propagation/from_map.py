"""Lines of a map in the frame of a car whose pose is uncertain: one by one, or as a scene.

The core does it in one call for a transform whose points it knows. For any other one, and for
mixtures, it is asked step by step: for the lines as functions of the pose, whose moments are then
computed here, and for the ranges in which they are valid and certain enough.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from itertools import accumulate
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import ffi, lib
from ..core.memory import new, pointer
from ..values.gaussian import Gaussian
from ..values.linalg import block_diagonal
from ..values.line import PARAMETERS, LeftOut, MapLine, MapLineList, Slot
from ..values.mixture import GaussianMixture
from ..values.polyline import Polyline
from ..values.scene import MapError, PoseError, Scene
from .paths import REASONS, Paths, check_misfit, checked_window, numbers_of, paths_near
from .quadrature import Quadrature
from .refit import MAX_MISFIT, Refit, refits_memory
from .sigma_points import SIGMA_POINTS, SigmaPoints
from .splitting import Mixture
from .transform import Rule, Transform

#: Parameters of a line.
N = len(PARAMETERS)
#: Default of the largest standard deviation of the lateral position of a line [m]. A line that is
#: less certain tells no lane from the next but one, and its band is that of the first order only
#: in name.
MAX_SIGMA = 10.0
#: Rules of transforms that are kept for the next query.
KEPT = 16


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
    covers what the cubic misses there, and the errors that the points of the map show. So, at each
    x from x_min to x_max, the road, as seen from a pose drawn from ``ego``, lies within the band of
    the Gaussian as often as its standard deviation says. The range leaves room for the pose error:
    the line seen from the true pose does not end before it. It ends where the line is less certain
    than ``max_sigma``.

    A line that cannot be given is left out, with a reason, and does not affect the others; one that
    bends, of few points far apart, is such a line. A pose
    from which a line is not a function of x does not lose the line either: the parameters are
    extrapolated from the mean pose.

    Args:
        lines: the line of the map for each slot.
        ego: Gaussian over the pose (e_x [m], e_y [m], e_h [rad]) in the map frame.
        window: (x_min, x_max) ahead of the mean pose that the ranges may extend to [m].
        transform: for the moments of each component; None for ``SigmaPoints()``, and for the
            default of ``Mixture`` if there are several components.
        map_error: error of the map, in addition to the error of the pose. Of independent errors of
            its points, the larger of the stated and of what they show counts.
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
    query = Query(lines, ego, window, map_error, max_misfit, max_sigma)
    if not isinstance(components, Mapping):
        components = dict.fromkeys(query.lines, components)
    if missing := [slot.name for slot in query.lines if slot not in components]:
        raise ValueError(f"components must have a number for each line, but not {missing[0]}")
    counts = {slot: components[slot] for slot in query.lines}
    if set(counts.values()) <= {1}:
        found = query.propagated_lines(transform or SIGMA_POINTS)
        if found is not None:
            return found
    return _lines_by(query, counts, transform)


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
        window: as of ``map_lines``.
        transform: for the moments; None for ``SigmaPoints()``.
        map_error: as of ``map_lines``.
        max_misfit: as of ``map_lines``.
        max_sigma: as of ``map_lines``.

    Returns:
        The lines in the order of ``lines``; ``left_out`` has the reasons of the others by slot.

    Raises:
        TypeError: ``lines`` is not a mapping from slots to polylines.
        ValueError: ``ego`` is not over three variables, or another value is out of range.

    >>> lines = {Slot.EGO_LEFT: Polyline([[-100, 1.75], [200, 1.75]]),
    ...          Slot.EGO_RIGHT: Polyline([[-100, -1.75], [200, -1.75]])}
    >>> scene = map_scene(lines, Gaussian([0, 0, 0], np.diag([0.1, 0.2, 0.01]) ** 2))
    >>> scene.centre(0.0).sigma.round(3), scene.width(0.0).sigma.round(3)
    (np.float64(0.2), np.float64(0.01))
    """
    transform = transform or SIGMA_POINTS
    query = Query(lines, ego, window, map_error, max_misfit, max_sigma)
    pose_error = PoseError(query.pose_cov(), correlation_time)
    found = query.propagated_scene(transform, pose_error)
    return _scene_by(query, transform, pose_error) if found is None else found


# ---- what is asked --------------------------------------------------------------------


class Query:
    """Checked arguments of ``map_lines`` and ``map_scene``, and as the core reads them."""

    def __init__(
        self,
        lines: Mapping[Slot, Polyline],
        ego: Gaussian,
        window: tuple[float, float],
        map_error: MapError | None,
        max_misfit: float,
        max_sigma: float,
    ) -> None:
        if not isinstance(lines, Mapping):
            raise TypeError(
                "lines must be a mapping from slots to polylines, such as "
                f"{{Slot.EGO_LEFT: Polyline(points)}}, got {type(lines).__name__}"
            )
        self.lines = {  # other threads may change theirs
            slot if type(slot) is Slot else Slot(slot): line for slot, line in dict(lines).items()
        }
        for slot, line in self.lines.items():
            if not isinstance(line, Polyline):
                raise TypeError(
                    f"the line of {slot.name} must be a Polyline, got {type(line).__name__}"
                )
        if ego.mean.size != 3:
            raise ValueError(
                f"ego must be over the pose (e_x [m], e_y [m], e_h [rad]), got {ego.mean.size}-D"
            )
        if not max_sigma > 0:
            raise ValueError(
                f"max_sigma must be more than 0 m, or infinite for no limit, got {max_sigma!r}"
            )
        check_misfit(max_misfit)
        pose = (*ego.mean.tolist(), *ego.cov.ravel().tolist())
        settings = (*checked_window(window), max_misfit, max_sigma, *numbers_of(map_error))
        self.ego, self.map_error, self.max_sigma = ego, map_error, float(max_sigma)
        self.has_noise = map_error is not None or max_misfit < math.inf
        self.values: Any = ffi.new("double[20]", pose + settings)

    def pose_cov(self) -> NDArray[np.float64]:
        """Return the (3, 3) covariance of the pose in the ego frame."""
        view = np.empty(12)
        lib.maplines_query_view(self.values, pointer(view))
        return view[3:].reshape(3, 3)

    def paths(self) -> Paths:
        """Return the lines as the core has them."""
        return paths_near([*self.lines.values()], lib.maplines_query_view, self.values)

    def fitted(self) -> tuple[list[Slot], Refit, NDArray[np.float64], dict[Slot, LeftOut]]:
        """Return the slots of n lines, their refits and (n, 2) ranges, and what is left out."""
        paths = self.paths()
        memory, reasons = refits_memory(paths.lines), ffi.new("uint8_t[]", paths.lines)
        x_ranges = np.empty((paths.lines, 2))
        arrays = reasons, pointer(x_ranges), pointer(memory)
        count = lib.maplines_fit_lines(paths.memory, self.values, paths.work(), *arrays)
        slots = [slot for slot, reason in zip(self.lines, reasons, strict=True) if not reason]
        refit = Refit.of_memory(memory, count, has_noise=self.has_noise)
        return slots, refit, x_ranges, self.left_out(bytes(ffi.buffer(reasons)))

    def propagated_lines(self, transform: Transform) -> MapLineList | None:
        """Return the lines of ``map_lines``, each of one component.

        None for a transform that the core does not know, and if it finds a line that is no
        Gaussian: step by step, the one that is wrong is found and said.
        """
        found = np.empty(22 * len(self.lines))
        reasons = self._reasons(lib.maplines_propagate_lines, transform, self.ego, 1, found)
        if reasons is None:
            return None
        arrays = _rows(found, reasons, ((4,), (4, 4), (2,)))
        return MapLineList(self.made(reasons, *arrays), self.left_out(reasons))

    def propagated_scene(self, transform: Transform, pose_error: PoseError) -> Scene | None:
        """Return the scene of ``map_scene``; None as above."""
        displacement = Gaussian.trusted(np.zeros(3), pose_error.cov)
        count = len(self.lines)
        found = np.empty(25 * count + (4 * count) ** 2)
        function = lib.maplines_propagate_scene
        reasons = self._reasons(function, transform, displacement, count, found)
        if reasons is None:
            return None
        k, left_out = reasons.count(0), self.left_out(reasons)
        found.setflags(write=False)
        means, x_ranges, fit_ranges, quartics, specific_covs = _rows(
            found, reasons, ((4,), (2,), (2,), (), (4, 4))
        )
        cov = found[25 * count :][: (4 * k) ** 2].reshape(4 * k, 4 * k)
        if not k:
            return Scene((), cov, pose_error, fit_ranges, self.map_error, left_out)
        covs = [cov[i : i + 4, i : i + 4] for i in range(0, 4 * k, 4)]
        made = tuple(self.made(reasons, means, covs, x_ranges))
        return Scene.trusted(
            made, cov, pose_error, fit_ranges, self.map_error, left_out, quartics, specific_covs
        )

    def _reasons(
        self,
        function: Callable[..., bool],
        transform: Transform,
        gaussian: Gaussian,
        together: int,
        found: NDArray[np.float64],
    ) -> bytes | None:
        """Return why lines are left out, or 0, and set what else a function of the core finds."""
        if type(transform) not in (SigmaPoints, Quadrature):
            return None
        points = _points_of(transform.rule(gaussian))  # type: ignore[attr-defined]
        paths = self.paths()
        left_out = ffi.new("uint8_t[]", paths.lines)
        work = paths.work(together, points[0])
        if not function(paths.memory, self.values, *points, work, left_out, pointer(found)):
            return None
        return bytes(ffi.buffer(left_out))

    def made(
        self,
        reasons: bytes,
        means: NDArray[np.float64],
        covs: NDArray[np.float64] | Sequence[NDArray[np.float64]],
        x_ranges: NDArray[np.float64],
    ) -> list[MapLine]:
        """Return the lines that are given, which are checked."""
        given = [
            (slot, line.kind)
            for (slot, line), reason in zip(self.lines.items(), reasons, strict=True)
            if not reason
        ]
        rows = zip(given, means, covs, x_ranges.tolist(), strict=True)
        return [
            MapLine.trusted(slot, Gaussian.trusted(mean, cov), kind, low, high)
            for (slot, kind), mean, cov, (low, high) in rows
        ]

    def left_out(self, reasons: bytes) -> dict[Slot, LeftOut]:
        """Return the reasons of the lines that are left out."""
        pairs = zip(self.lines, reasons, strict=True)
        return {slot: REASONS[reason - 1] for slot, reason in pairs if reason}


def _rows(
    found: NDArray[np.float64], reasons: bytes, rows: Sequence[tuple[int, ...]]
) -> list[NDArray[np.float64]]:
    """Return arrays of rows of these shapes, one row for each line, of which the given are set."""
    k, sizes = reasons.count(0), [math.prod(row) for row in rows]
    begins = accumulate((len(reasons) * size for size in sizes), initial=0)
    return [
        found[begin : begin + k * size].reshape(k, *row)
        for begin, size, row in zip(begins, sizes, rows, strict=False)
    ]


@lru_cache(maxsize=KEPT)
def _points_of(rule: Rule) -> tuple[Any, ...]:
    """Return the points of a transform of a pose as arguments of the core."""
    arrays = (rule.z, rule.mean_weights, rule.cov_weights)
    return (len(rule.z), *(pointer(np.ascontiguousarray(array)) for array in arrays))


# ---- step by step ---------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Function:
    """Lines as a function of the pose, with values also where they are no functions of x."""

    values: Callable[[NDArray[np.float64]], NDArray[np.float64]]
    noise_cov: NDArray[np.float64] | None

    def __call__(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        return self.values(poses)


def _values_of(refit: Refit, places: list[int], poses: NDArray[np.float64]) -> NDArray[np.float64]:
    return refit.extended(poses)[:, places]


def _lines_by(query: Query, counts: Mapping[Slot, int], transform: Transform | None) -> MapLineList:
    """Return the lines of ``map_lines`` by any transform, and as mixtures."""
    slots, refit, x_ranges, left_out = query.fitted()
    # Lines of one component share the calls; each mixture has a direction of its own to cut along.
    singles = [i for i, slot in enumerate(slots) if counts[slot] == 1]
    mixtures = [[i] for i, slot in enumerate(slots) if counts[slot] != 1]
    found: dict[Slot, MapLine] = {}
    for places in [singles] * bool(singles) + mixtures:
        function = _Function(
            partial(_values_of, refit, places),
            None if refit.noise_cov is None else refit.noise_cov[places],
        )
        k = counts[slots[places[0]]]
        if k == 1:
            mean, cov = (transform or SIGMA_POINTS).moments(function, query.ego)
            weights, means, covs = np.ones(1), mean[None], cov[None]
        else:
            weights, means, covs = Mixture(k, transform).moments(function, query.ego)
        for i, place in enumerate(places):
            slot, ends = slots[place], x_ranges[place]
            gaussians = tuple(map(Gaussian, means[:, i], covs[:, i]))
            mixture = GaussianMixture(weights, gaussians) if k > 1 else None
            gaussian = gaussians[0] if mixture is None else mixture.overall
            moments = map(pointer, (gaussian.mean, gaussian.cov))
            if not lib.maplines_shorten_line(*moments, query.max_sigma, pointer(ends)):
                left_out[slot] = LeftOut.UNCERTAIN
                continue
            low, high = ends.tolist()
            kind = query.lines[slot].kind
            found[slot] = MapLine(slot, gaussian, kind, low, high, mixture=mixture)
    return MapLineList(
        [found[slot] for slot in query.lines if slot in found],
        {slot: left_out[slot] for slot in query.lines if slot in left_out},
    )


def _scene_by(query: Query, transform: Transform, pose_error: PoseError) -> Scene:
    """Return the scene of ``map_scene`` by any transform."""
    paths = query.paths()
    work, search = paths.work(paths.lines), new("double[]", lib.maplines_search_size())
    memory, left_out = refits_memory(paths.lines), ffi.new("uint8_t[]", paths.lines)
    lib.maplines_search_scene(paths.memory, query.values, work, search)
    displacement = Gaussian.trusted(np.zeros(3), pose_error.cov)
    while k := lib.maplines_search_fit(search, left_out, pointer(memory)):
        refit = Refit.of_memory(memory, k, has_noise=query.has_noise)
        own = refit.noise_cov
        function = _Function(
            partial(_joint_values, refit), None if own is None else block_diagonal(own)
        )
        mean, cov = transform.moments(function, displacement)
        means, x_ranges = np.ascontiguousarray(mean.reshape(k, N)), np.empty((k, 2))
        arrays = (means, np.ascontiguousarray(cov), x_ranges)
        if lib.maplines_search_settle(search, *map(pointer, arrays)):
            break
    reasons = bytes(ffi.buffer(left_out))
    if not k:
        nothing = np.zeros((0, 0)), pose_error, np.zeros((0, 2))
        return Scene((), *nothing, query.map_error, query.left_out(reasons))
    covs = [cov[i : i + N, i : i + N] for i in range(0, N * k, N)]
    return Scene(  # which checks the joint covariance, and so those of its lines
        tuple(query.made(reasons, means, covs, x_ranges)),
        cov,
        pose_error,
        refit.x_range,
        query.map_error,
        query.left_out(reasons),
        refit.quartic,
        np.zeros((k, N, N)) if own is None else own,
    )


def _joint_values(refit: Refit, displacements: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the parameters of all lines as one output, whose moments are the joint ones.

    They are functions of the displacement in the ego frame, as at a receiver: so both take the same
    sigma points.
    """
    return refit.extended(displacements, are_displacements=True).reshape(len(displacements), -1)
