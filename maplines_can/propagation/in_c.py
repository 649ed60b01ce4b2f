"""The propagation in C, where the extension module is.

The functions return None where there is none, and where the Python functions raise an error or
warn: those then run, and say what is wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..native import core
from ..values.gaussian import Gaussian
from ..values.line import LeftOut, MapLine, MapLineList, Slot
from ..values.map_error import MapError
from ..values.polyline import INDEXED, Polyline
from ..values.scene import PoseError, Scene
from .quadrature import Quadrature
from .sigma_points import SigmaPoints
from .stretches import Stretches
from .transform import Moments, Rule, Transform

#: Sets of lines that are kept for the next query.
KEPT = 16
#: Reasons by their numbers in C, of which 0 is that a line is given.
_REASONS = (None, LeftOut.NOT_IN_WINDOW, LeftOut.ACROSS, LeftOut.TOO_SHORT, LeftOut.UNCERTAIN)
_SLOTS = frozenset(Slot)
#: Errors of arguments that C does not take.
_WRONG = (TypeError, ValueError, OverflowError)


# ---- lines of a map -------------------------------------------------------------------


class CycleInC(NamedTuple):
    """What ``map_lines`` and ``map_scene`` are asked, if C takes it."""

    lines: Mapping[Slot, Polyline]
    ego: Gaussian
    map_error: MapError | None
    settings: tuple[float, ...]  #: as C reads them

    @classmethod
    def of(
        cls,
        lines: Mapping[Slot, Polyline],
        ego: Gaussian,
        window: tuple[float, float],
        map_error: MapError | None,
        max_misfit: float,
        max_sigma: float,
    ) -> CycleInC | None:
        """Return the cycle of the arguments of ``map_lines``."""
        if core is None or not isinstance(lines, dict) or not lines:
            return None
        if not isinstance(ego, Gaussian):
            return None
        if not all(isinstance(line, Polyline) for line in lines.values()):
            return None
        try:
            x_min, x_max = window
            if not max_sigma > 0 or not all(map(_SLOTS.__contains__, lines)):
                return None
        except _WRONG:
            return None
        settings = (x_min, x_max, max_misfit, max_sigma, *_sigmas(map_error))
        return cls(lines, ego, map_error, settings)

    def map_lines(self, transform: Transform) -> MapLineList | None:
        """Return the lines of ``map_lines``, each of one component."""
        found = self._found(core.map_lines, _rule(transform, self.ego))
        if found is None:
            return None
        reasons, means, covs, x_ranges = found
        return MapLineList(self._made(reasons, means, covs, x_ranges), self._left_out(reasons))

    def map_scene(self, transform: Transform, correlation_time: float) -> Scene | None:
        """Return the scene of ``map_scene``."""
        view = core.pose_view(self.ego.mean, self.ego.cov, self.settings)
        if view is None:
            return None
        pose_error = PoseError(view[2], correlation_time)
        rule = _rule(transform, Gaussian.trusted(np.zeros(3), pose_error.cov))
        found = self._found(core.map_scene, rule)
        if found is None:
            return None
        reasons, means, cov, x_ranges, fit_ranges, quartics, specific_covs = found
        left_out = self._left_out(reasons)
        if not len(means):
            return Scene((), cov, pose_error, fit_ranges, self.map_error, left_out)
        covs = [cov[i : i + 4, i : i + 4] for i in range(0, len(cov), 4)]
        made = tuple(self._made(reasons, means, covs, x_ranges))
        return Scene.trusted(
            made, cov, pose_error, fit_ranges, self.map_error, left_out, quartics, specific_covs
        )

    def _found(self, function: Callable[..., Any], rule: Rule | None) -> Any | None:
        """Return what a function of C makes of the parts of the lines around the car."""
        if rule is None:
            return None
        ego, parts = self.ego, tuple(self.lines.values())
        if any(len(line.points) > INDEXED for line in parts):
            start, reach, _ = core.pose_view(ego.mean, ego.cov, self.settings)
            parts = tuple(line.near(start, reach) for line in parts)
        paths = _paths(parts)
        return None if paths is None else function(paths, ego.mean, ego.cov, self.settings, rule)

    def _made(
        self,
        reasons: bytes,
        means: NDArray[np.float64],
        covs: NDArray[np.float64] | Sequence[NDArray[np.float64]],
        x_ranges: NDArray[np.float64],
    ) -> list[MapLine]:
        """Return the lines that are given, which C has checked."""
        given = [
            item for item, reason in zip(self.lines.items(), reasons, strict=True) if not reason
        ]
        rows = zip(given, means, covs, x_ranges.tolist(), strict=True)
        return [
            MapLine(slot, Gaussian.trusted(mean, cov), line.kind, low, high)
            for (slot, line), mean, cov, (low, high) in rows
        ]

    def _left_out(self, reasons: bytes) -> dict[Slot, LeftOut]:
        if not any(reasons):
            return {}
        pairs = zip(self.lines, map(_REASONS.__getitem__, reasons), strict=True)
        return {Slot(slot): reason for slot, reason in pairs if reason is not None}


def _sigmas(map_error: MapError | None) -> tuple[float, ...]:
    if map_error is None:
        return ()
    return (map_error.point_sigma, map_error.offset_sigma, map_error.heading_sigma)


def _rule(transform: Transform, ego: Gaussian) -> Rule | None:
    """Return the points of a transform of a pose, of the transforms that C knows."""
    if type(transform) not in (SigmaPoints, Quadrature):
        return None
    try:
        return transform.rule(ego)  # type: ignore[attr-defined]
    except ValueError:
        return None


@lru_cache(maxsize=KEPT)
def _paths(lines: tuple[Polyline, ...]) -> Any | None:
    """Return lines as C has them. A car asks for the same lines again and again."""
    arrays = tuple((np.ascontiguousarray(line.points), line.distance) for line in lines)
    return core.paths(arrays, sum(len(line.points) for line in lines))


# ---- refits ---------------------------------------------------------------------------


class RefitInC:
    """Lines as functions of the pose, as ``RefitModel``."""

    def __init__(self, refit: Any, count: int, has_noise: bool) -> None:
        self._refit, self.count, self._has_noise = refit, count, has_noise

    @cached_property
    def x_range(self) -> NDArray[np.float64]:
        """(L, 2)."""
        return self._field(0)

    @cached_property
    def misfit(self) -> NDArray[np.float64]:
        """(L,)."""
        return self._field(1)

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """(L, K, 2)."""
        return self._field(2)

    @cached_property
    def is_across(self) -> NDArray[np.bool_]:
        """(L,)."""
        return self._field(3).astype(bool)

    @cached_property
    def noise_cov(self) -> NDArray[np.float64] | None:
        """(L, 4, 4)."""
        return self._field(4) if self._has_noise else None

    @cached_property
    def quartic(self) -> NDArray[np.float64]:
        """(L,)."""
        return self._field(5)

    def _field(self, number: int) -> NDArray[np.float64]:
        found: NDArray[np.float64] = core.refit_field(self._refit, number)
        return found

    def __call__(self, poses: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (N, L, 4) lines for (N, 3) poses."""
        lines = np.empty((len(poses), self.count, 4))
        core.refit_values(self._refit, np.ascontiguousarray(poses), lines)
        return lines

    def weighted_moments(self, gaussian: Gaussian, rule: Rule) -> Moments | None:
        """Return (L, 4) means and (L, 4, 4) covariances, if all lines have values at all points."""
        means, covs = np.empty((self.count, 4)), np.empty((self.count, 4, 4))
        if core.refit_moments(self._refit, gaussian.mean, gaussian.cov, rule, means, covs):
            return Moments(means, covs)
        return None


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
    """Return the refit of lines or stretches, if all of the lines can be given."""
    if core is None:
        return None
    fit = (max_misfit, room, step, *_sigmas(map_error))
    has_noise = map_error is not None or max_misfit < np.inf
    if isinstance(lines, Stretches):
        first = np.append(lines.first, len(lines.x)).astype(float)
        x_range = np.ascontiguousarray(lines.x_range)
        refit = core.refit_of_stretches(lines.x, lines.y, first, x_range, pose, fit)
        return None if refit is None else RefitInC(refit, len(lines.given), has_noise)
    if not all(isinstance(line, Polyline) for line in lines):
        return None
    if any(len(line.points) > INDEXED for line in lines):
        return None
    try:
        look = (*window, max_turn)
    except TypeError:
        return None
    paths = _paths(tuple(lines))
    refit = None if paths is None else core.refit(paths, pose, look, fit)
    return None if refit is None else RefitInC(refit, len(lines), has_noise)
