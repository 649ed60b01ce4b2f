"""Lines around a car that drives on a map, cycle by cycle."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..propagation import MapError, map_lines, map_scene
from ..propagation.from_map import MAX_SIGMA
from ..propagation.refit import MAX_MISFIT
from ..values.gaussian import Gaussian
from ..values.line import MapLineList, Slot
from ..values.polyline import Polyline
from ..values.scene import Scene
from .road_map import Map
from .routing import Route
from .tracking import LaneTracker, TrackedLines

#: Number of mixture components of each line, from the lines of the map and the reported pose.
ChooseComponents = Callable[[Mapping[Slot, Polyline], Gaussian], Mapping[Slot, int]]

#: Range of the lines around the car [m]. A car drives by what is ahead, and a cubic that must be
#: true for 20 m behind the car is not true for what is ahead in a sharp corner.
WINDOW = (-4.0, 80.0)


class Cycle(NamedTuple):
    """Pose and lines of one cycle."""

    t: float  #: time [s]
    #: over the pose x [m], y [m], heading [rad] in the map frame; None if the car does not know it
    reported: Gaussian | None
    tracked: TrackedLines  #: lines of the map around the reported pose
    lines: MapLineList  #: lines as the car knows them, and those that are left out
    changed: frozenset[Slot]  #: slots of these that have another line than in the cycle before
    #: the lines with their joint covariance, if the source was asked for it and there is a pose
    scene: Scene | None = None


class LineSource:
    """Source of the lines around a car that knows its pose with an error.

    The car finds its lane by the mean of the reported pose, as it knows no other one. Without a
    pose, there are no lines.

    Args:
        road_map: the map.
        reported: function from the time [s] and the true pose (3,) to the reported pose, such as
            ``PoseSource.pose``, or to None if the car does not know it.
        slots: lines to give.
        route: that the car follows.
        window: (x_min, x_max) ahead of the car that the ranges of the lines may extend to [m].
        map_error: error of the map.
        components: number of mixture components of each line, 1 to 8, or a function that chooses
            it in each cycle.
        correlation_time: of the pose error [s], or a function that returns it in each cycle;
            infinite if it is unknown. The cycles then have the joint covariance of their lines,
            which have one component each. None: they do not.
        max_misfit: largest deviation of a cubic from its line [m].
        max_sigma: largest standard deviation of the lateral position of a line [m], see
            ``map_lines``.

    >>> from maplines_can import Polyline
    >>> from maplines_can.simulation import PoseSource
    >>> from maplines_can import maps
    >>> left, right, centre = (Polyline([[0, y], [300, y]]) for y in (3.5, 0, 1.75))
    >>> lane = maps.Lane("1", left, right, centre, road="A")
    >>> road_map = maps.Map({"1": lane}, {"A": maps.Road("A", "", 300.0, ("1",))})
    >>> source = LineSource(road_map, PoseSource((0.3, 0.1, 0.002)).pose)
    >>> cycle = source.cycle(0.0, np.array([100.0, 1.75, 0.0]))
    >>> [line.slot.name for line in cycle.lines], cycle.tracked.lane
    (['EGO_LEFT', 'EGO_RIGHT'], '1')
    """

    # Settings of a constructor: those of ``map_lines`` and ``map_scene`` are among them.
    def __init__(
        self,
        road_map: Map,
        reported: Callable[[float, NDArray[np.float64]], Gaussian | None],
        slots: Collection[Slot] = tuple(Slot)[:4],
        route: Route | None = None,
        window: tuple[float, float] = WINDOW,
        map_error: MapError | None = None,
        components: int | ChooseComponents = 1,
        correlation_time: float | Callable[[], float] | None = None,
        max_misfit: float = MAX_MISFIT,
        max_sigma: float = MAX_SIGMA,
    ) -> None:
        if correlation_time is not None and components != 1:
            raise ValueError(
                "components must be 1 with a correlation_time, since a receiver of the pose error "
                f"splits it itself, got {components!r}"
            )
        self._correlation_time = correlation_time
        self._max_misfit, self._max_sigma = max_misfit, max_sigma
        self._reported, self._slots = reported, frozenset(slots)
        self._window, self._map_error, self._components = window, map_error, components
        self._tracker = LaneTracker(road_map, route)

    def cycle(self, t: float, true_pose: NDArray[np.float64]) -> Cycle:
        """Return the lines at the next time.

        Args:
            t: later than that of the previous call [s].
            true_pose: (3,) x [m], y [m], heading [rad] in the map frame.

        Raises:
            ValueError: a value is not finite, or the time is not later.
        """
        reported = self._reported(t, true_pose)
        if reported is None:
            tracked = self._tracker.lose()
            return Cycle(t, None, tracked, MapLineList([], {}), tracked.changed & self._slots)
        tracked = self._tracker.lines(reported.mean)
        chosen = {slot: line for slot, line in tracked.lines.items() if slot in self._slots}
        own, time, changed = self._components, self._correlation_time, tracked.changed & self._slots
        if time is not None:
            scene = map_scene(
                chosen,
                reported,
                correlation_time=time() if callable(time) else time,
                window=self._window,
                map_error=self._map_error,
                max_misfit=self._max_misfit,
                max_sigma=self._max_sigma,
            )
            lines = MapLineList(scene.lines, scene.left_out)
            return Cycle(t, reported, tracked, lines, changed, scene)
        lines = map_lines(
            chosen,
            reported,
            window=self._window,
            map_error=self._map_error,
            max_misfit=self._max_misfit,
            max_sigma=self._max_sigma,
            components=own(chosen, reported) if callable(own) else own,
        )
        return Cycle(t, reported, tracked, lines, changed)
