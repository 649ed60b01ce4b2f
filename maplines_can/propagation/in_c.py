"""The propagation in the core.

Functions return None without the core, and where the core gives up: the Python functions then run,
which raise an error, warn, or know how to compute with values that are too large for squares.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core import ffi, lib
from ..core.memory import new, pointer, pointers
from ..values.gaussian import Gaussian
from ..values.line import LeftOut, MapLine, MapLineList, Slot
from ..values.map_error import MapError
from ..values.polyline import INDEXED, Polyline
from ..values.scene import PoseError, Scene
from ..values.seen_lines import NODES
from .quadrature import Quadrature
from .sigma_points import SigmaPoints
from .stretches import Stretches, check_given, checked_window
from .transform import Moments, Rule, Transform

#: Sets of lines, and rules of transforms, that are kept for the next query.
KEPT = 16
#: Reasons by their numbers in C, of which 0 is that a line is given.
REASONS = (None, LeftOut.NOT_IN_WINDOW, LeftOut.ACROSS, LeftOut.TOO_SHORT, LeftOut.UNCERTAIN)
_SLOTS = frozenset(Slot)
#: Errors of values that are no numbers in double precision.
_WRONG = (TypeError, OverflowError)


# ---- what all functions take ----------------------------------------------------------


class _Paths(NamedTuple):
    """Lines of a map as the core has them; it only reads them, so threads share them."""

    memory: Any
    lines: int
    points: int  #: of all lines

    def work(self, together: int = 0, poses: int = 0) -> Any:
        """Return memory for a query in which so many lines are propagated together."""
        return new("double[]", lib.maplines_work_size(self.lines, self.points, together, poses))


@lru_cache(maxsize=KEPT)
def _paths(lines: tuple[Polyline, ...]) -> _Paths | None:
    """Return lines as the core has them. A car asks for the same lines again and again."""
    points = [np.ascontiguousarray(line.points, float) for line in lines]
    distances = [np.ascontiguousarray(line.distance, float) for line in lines]
    count = [*map(len, points)]
    memory = new("double[]", lib.maplines_paths_size(len(lines), sum(count)))
    arrays = pointers(points), pointers(distances)
    if not lib.maplines_prepare_paths(len(lines), count, *arrays, memory):
        return None
    return _Paths(memory, len(lines), sum(count))


def _paths_near(
    lines: Sequence[Polyline], start: Callable[..., Any], *of_start: Any
) -> _Paths | None:
    """Return lines, of long ones what is near the car; ``start`` sets where they are followed."""
    if any(len(line.points) > INDEXED for line in lines):
        place = ffi.new("double[12]")
        start(*of_start, place)
        x, y, reach = place[0:3]
        lines = [line.near(np.array([x, y]), reach) for line in lines]
    return _paths(tuple(lines))


@lru_cache(maxsize=KEPT)
def _points_of(rule: Rule) -> tuple[Any, ...]:
    """Return the points of a transform of a pose as arguments of the core."""
    arrays = (rule.z, rule.mean_weights, rule.cov_weights)
    return (len(rule.z), *(pointer(np.ascontiguousarray(array)) for array in arrays))


def _error_of(map_error: MapError | None) -> tuple[float, ...]:
    if map_error is None:
        return (0.0, 0.0, 0.0, 0.0)
    return (1.0, map_error.point_sigma, map_error.offset_sigma, map_error.heading_sigma)


# ---- lines and scenes -----------------------------------------------------------------


class CycleInC(NamedTuple):
    """What ``map_lines`` and ``map_scene`` are asked, if the core takes it."""

    lines: dict[Slot, Polyline]
    ego: Gaussian
    map_error: MapError | None
    query: Any  #: as the core reads it

    @classmethod
    def of(
        cls,
        lines: dict[Slot, Polyline],
        ego: Gaussian,
        window: tuple[float, float],
        map_error: MapError | None,
        max_misfit: float,
        max_sigma: float,
    ) -> CycleInC | None:
        """Return the cycle of the checked arguments of ``map_lines``."""
        if not lines or not _SLOTS.issuperset(lines):
            return None
        pose = (*ego.mean.tolist(), *ego.cov.ravel().tolist())
        try:
            settings = (*window, max_misfit, max_sigma, *_error_of(map_error))
            query = ffi.new("double[20]", pose + settings)
        except _WRONG:
            return None
        return cls(lines, ego, map_error, query)

    def map_lines(self, transform: Transform) -> MapLineList | None:
        """Return the lines of ``map_lines``, each of one component."""
        count = len(self.lines)
        found = np.empty(22 * count)
        reasons = self._reasons(lib.maplines_propagate_lines, transform, self.ego, 1, found)
        if reasons is None:
            return None
        given = reasons.count(0)
        means = found[: 4 * given].reshape(given, 4)
        covs = found[4 * count :][: 16 * given].reshape(given, 4, 4)
        x_ranges = found[20 * count :][: 2 * given].reshape(given, 2)
        return MapLineList(self._made(reasons, means, covs, x_ranges), self._left_out(reasons))

    def map_scene(self, transform: Transform, correlation_time: float) -> Scene | None:
        """Return the scene of ``map_scene``."""
        view = np.empty(12)
        if not lib.maplines_query_view(self.query, pointer(view)):
            return None
        pose_error = PoseError(view[3:].reshape(3, 3), correlation_time)
        displacement = Gaussian.trusted(np.zeros(3), pose_error.cov)
        count = len(self.lines)
        found = np.empty(25 * count + (4 * count) ** 2)
        function = lib.maplines_propagate_scene
        reasons = self._reasons(function, transform, displacement, count, found)
        if reasons is None:
            return None
        k, left_out = reasons.count(0), self._left_out(reasons)
        found.setflags(write=False)
        means, x_ranges, fit_ranges, quartics, specific_covs, cov = (
            found[begin : begin + size].reshape(shape) for begin, size, shape in _parts(count, k)
        )
        if not k:
            return Scene((), cov, pose_error, fit_ranges, self.map_error, left_out)
        covs = [cov[i : i + 4, i : i + 4] for i in range(0, 4 * k, 4)]
        made = tuple(self._made(reasons, means, covs, x_ranges))
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
        try:
            points = _points_of(transform.rule(gaussian))  # type: ignore[attr-defined]
        except ValueError:
            return None
        paths = _paths_near([*self.lines.values()], lib.maplines_query_view, self.query)
        if paths is None:
            return None
        left_out = ffi.new("uint8_t[]", paths.lines)
        work = paths.work(together, points[0])
        if not function(paths.memory, self.query, *points, work, left_out, pointer(found)):
            return None
        return bytes(ffi.buffer(left_out))

    def _made(
        self,
        reasons: bytes,
        means: NDArray[np.float64],
        covs: NDArray[np.float64] | Sequence[NDArray[np.float64]],
        x_ranges: NDArray[np.float64],
    ) -> list[MapLine]:
        """Return the lines that are given, which the core has checked."""
        given = [
            (slot if type(slot) is Slot else Slot(slot), line.kind)
            for (slot, line), reason in zip(self.lines.items(), reasons, strict=True)
            if not reason
        ]
        rows = zip(given, means, covs, x_ranges.tolist(), strict=True)
        return [
            MapLine.trusted(slot, Gaussian.trusted(mean, cov), kind, low, high)
            for (slot, kind), mean, cov, (low, high) in rows
        ]

    def _left_out(self, reasons: bytes) -> dict[Slot, LeftOut]:
        if not any(reasons):
            return {}
        pairs = zip(self.lines, map(REASONS.__getitem__, reasons), strict=True)
        return {Slot(slot): reason for slot, reason in pairs if reason is not None}


@lru_cache(maxsize=128)
def _parts(lines: int, k: int) -> tuple[tuple[int, int, tuple[int, ...]], ...]:
    """Return begin, size and shape of the arrays that the core sets of a scene of k lines."""
    shapes = [(k, 4), (k, 2), (k, 2), (k,), (k, 4, 4), (4 * k, 4 * k)]
    begins = accumulate((4, 2, 2, 1, 16), lambda begin, row: begin + row * lines, initial=0)
    return tuple(
        (begin, int(np.prod(shape)), shape) for begin, shape in zip(begins, shapes, strict=True)
    )


# ---- refits ---------------------------------------------------------------------------


class RefitInC:
    """Lines as functions of the pose, as ``RefitModel``."""

    def __init__(
        self, refits: NDArray[np.float64], fields: NDArray[np.float64], *, has_noise: bool
    ) -> None:
        n = self.count = len(fields) // _FIELDS
        self._refits = refits  # numbers only: it may be copied
        fields.setflags(write=False)
        self.x_range = fields[: 2 * n].reshape(n, 2)  #: (L, 2)
        self.misfit = fields[2 * n : 3 * n]  #: (L,)
        self.is_across = fields[3 * n : 4 * n].astype(bool)  #: (L,)
        self.quartic = fields[4 * n : 5 * n]  #: (L,)
        #: (L, 4, 4)
        self.noise_cov = fields[5 * n : 21 * n].reshape(n, 4, 4) if has_noise else None
        self.points = fields[21 * n :].reshape(n, len(NODES), 2)  #: (L, K, 2)

    def __call__(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (N, L, 4) lines for (N, 3) poses."""
        values = np.empty((len(poses), self.count, 4))
        given = pointer(np.ascontiguousarray(poses))
        lib.maplines_refit_values(pointer(self._refits), len(poses), given, pointer(values))
        return values

    def weighted_moments(self, gaussian: Gaussian, rule: Rule) -> Moments | None:
        """Return (L, 4) means and (L, 4, 4) covariances, if all lines have values at all points."""
        pose = (*gaussian.mean.tolist(), *gaussian.cov.ravel().tolist())
        if len(pose) != 12:
            return None
        means, covs = np.empty((self.count, 4)), np.empty((self.count, 4, 4))
        points = _points_of(rule)
        work, arrays = new("double[]", 7 * points[0]), (pointer(means), pointer(covs))
        if lib.maplines_refit_moments(pointer(self._refits), pose, *points, work, *arrays):
            return Moments(means, covs)
        return None


#: Numbers of a line in the fields of refits.
_FIELDS = 21 + 2 * len(NODES)


def refit_in_c(
    lines: Sequence[Polyline] | Stretches,
    pose: NDArray[np.float64],
    window: tuple[float, float],
    max_turn: float,
    map_error: MapError | None,
    max_misfit: float,
    room: float,
    step: float,
) -> RefitInC | None:
    """Return the refit of lines or stretches.

    Raises:
        ValueError: the window is empty.
        IllPosedError: a line has no stretch.
    """
    settings = (max_misfit, room, step, *_error_of(map_error))
    has_noise = map_error is not None or max_misfit < np.inf
    count = len(lines.given) if isinstance(lines, Stretches) else len(lines)
    fields = np.empty(_FIELDS * count)
    refits = np.empty(lib.maplines_refits_size(count))
    made = pointer(refits), pointer(fields)
    if isinstance(lines, Stretches):
        points = len(lines.x)
        given = (lines.x, lines.y, lines.first.astype(np.int64), lines.x_range)
        if [array.shape for array in given] != [(points,), (points,), (count,), (count, 2)]:
            return None
        arrays = [pointer(np.ascontiguousarray(array)) for array in given]
        work = _Paths(None, count, points).work()
        is_done = lib.maplines_refit_stretches(
            count, points, *arrays, pose.tolist(), settings, work, *made
        )
    else:
        look = (*pose.tolist(), *checked_window(window), max_turn)
        paths = _paths_near(lines, lib.maplines_refit_start, look)
        if paths is None:
            return None
        left_out = ffi.new("uint8_t[]", count)
        is_done = lib.maplines_refit_lines(
            paths.memory, look, settings, paths.work(), left_out, *made
        )
        check_given([REASONS[reason] for reason in left_out], window)
    return RefitInC(refits, fields, has_noise=has_noise) if is_done else None
