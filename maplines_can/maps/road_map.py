"""The map: lanes, roads and landmarks, and what a car asks of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from types import MappingProxyType
from typing import overload

from numpy.typing import ArrayLike

from ..values.arrays import count_text
from ..values.errors import RouteError
from ..values.line import Slot
from ..values.polyline import Polyline
from ..values.route_lines import RouteLines
from .lane import Lane, LaneType, Road, Skipped
from .matching import LaneIndex, LaneMatch
from .routing import Route, shortest_route
from .view import LaneView

__all__ = ["Lane", "LaneType", "Map", "Road", "Skipped"]


@dataclass(frozen=True, eq=False)
class Map:
    """Lanes and roads of a map.

    Args:
        lanes: by their ids.
        roads: by their ids.
        skipped: what in the file is not used, or taken in another way; first what concerns the
            frame.
        projection: PROJ string, WKT or code of the map frame; None if it has none.
        name: name of the file or of the map.
        left_hand_traffic: whether most roads have left-hand traffic.
        polylines: lines of the file that belong to no lane, by their ids.
        landmarks: poles and signs beside the roads, as far as they are read: those of OpenDRIVE.
        buildings: closed outlines of buildings, likewise.

    Raises:
        ValueError: a key differs from the id of its value, or an id leads nowhere.
    """

    lanes: Mapping[str, Lane]
    roads: Mapping[str, Road]
    skipped: tuple[Skipped, ...] = ()
    projection: str | None = None
    name: str = ""
    left_hand_traffic: bool = False
    polylines: Mapping[str, Polyline] = field(default_factory=dict)
    landmarks: tuple[Landmark, ...] = ()
    buildings: tuple[Polyline, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "polylines", MappingProxyType(dict(self.polylines)))
        for name in ("lanes", "roads"):
            object.__setattr__(self, name, MappingProxyType(dict(getattr(self, name))))
            for key, value in getattr(self, name).items():
                if key != value.id:
                    raise ValueError(f"{name}[{key!r}] has the id {value.id!r}; use the same")
        for lane in self.lanes.values():
            if lane.road not in self.roads:
                raise ValueError(f"lane {lane.id!r} is on the road {lane.road!r}, not in roads")
            _require(lane.linked, self.lanes, f"lane {lane.id!r}")
        for road in self.roads.values():
            _require(road.lanes, self.lanes, f"road {road.id!r}")
            _require((*road.successors, *road.predecessors), self.roads, f"road {road.id!r}")

    @cached_property
    def index(self) -> LaneIndex:
        """Search tree over the drivable lanes; built once, when it is used."""
        return LaneIndex(self.lanes)

    @cached_property
    def view(self) -> LaneView:
        """Lines around the lanes; it keeps those of the lanes used last."""
        return LaneView(self.lanes)

    @overload
    def match(self, pose: ArrayLike) -> LaneMatch | None: ...

    @overload
    def match(self, pose: ArrayLike, cov: ArrayLike) -> tuple[LaneMatch, ...]: ...

    def match(
        self, pose: ArrayLike, cov: ArrayLike | None = None
    ) -> LaneMatch | tuple[LaneMatch, ...] | None:
        """Return the lane that a car is on, or with a covariance those that it may be on.

        Without a covariance, it is the drivable lane with the least cost: the distance to the
        lane [m], 2 m per rad of angle between the car and the lane, and 1 m if the car drives
        against its direction. So where lanes overlap, as in a junction, the direction decides.

        With a covariance, the probability of a lane is proportional to that of the pose in it: the
        integral of the Gaussian of the lateral position over the width of the lane, given that
        the heading of the car is that of the lane up to 5 deg (standard deviation), times the
        integral of the longitudinal position over its length, times the likelihood of the heading.
        All positions in a lane are as probable before, so a wide lane has the larger prior. To
        drive against the direction of a lane has the prior probability 0.01.

        Args:
            pose: (3,) e_x [m], e_y [m], e_h [rad] of the car in the map frame.
            cov: (3, 3) covariance of the pose.

        Returns:
            The best match, or None if no drivable lane is within 30 m. With ``cov``, all
            candidates, most probable first; their probabilities sum to 1, or there is none.

        Raises:
            ValueError: ``pose`` or ``cov`` is not finite or has another shape.
        """
        return self.index.match(pose) if cov is None else self.index.candidates(pose, cov)

    def route(
        self,
        start: str | ArrayLike,
        goal: str | ArrayLike,
        via: Sequence[str | ArrayLike] = (),
    ) -> Route:
        """Return the shortest route through successors and lane changes.

        A lane change costs as much as 50 m of driving, and 5 m for each metre by which the lanes
        are shorter than 60 m. To cross a solid line costs as much as 1 km. No route crosses the
        edge of the road, a kerb or a barrier.

        Args:
            start: id of a lane, from whose start, or pose (3,) from which the route starts.
            goal: id of a lane, to whose end, or pose (3,) at which the route ends.
            via: ids of lanes, or poses, that the route passes in this order. From each to the next
                one, it is the shortest.

        Raises:
            RouteError: there is no route, no such lane, or no lane at a pose.
        """
        names = ["start", *("via",) * len(via), "goal"]
        stops = zip(names, (start, *via, goal), strict=True)
        return shortest_route(self.lanes, [self._stop(name, stop) for name, stop in stops])

    def _stop(self, name: str, stop: str | ArrayLike) -> tuple[str, float | None]:
        if isinstance(stop, str):
            return stop, None
        match = self.match(stop)
        if match is None:
            raise RouteError(f"no lane is near the {name} {stop!r}; give a pose in the map frame")
        return match.lane, match.s

    def lines(self, pose: ArrayLike, route: Route | None = None) -> dict[Slot, Polyline]:
        """Return the lines around a car by slot.

        EGO_LEFT and EGO_RIGHT are the boundaries of the lane that the car is on (see ``match``),
        and CENTRE is its centre line. NEXT_LEFT and NEXT_RIGHT are the outer boundaries of the
        drivable lanes beside it, whatever their direction. EDGE_LEFT and EDGE_RIGHT are the
        outermost boundaries of all drivable lanes beside each other. ROUTE is the centre line of
        the route's lanes. So the two slots of a side have the same line where there are no
        further lanes.

        The lines run in the driving direction of the car. Each has one kind: that of the boundary
        beside the car, across the lane. They continue at least 150 m ahead and 60 m behind where
        the map does: along the route, else along the straightest lane. A line ends where a lane
        link has a gap of more than 0.3 m (see ``link_gaps``), and before it returns.
        ``LaneTracker`` keeps slots stable along a drive.

        Args:
            pose: (3,) e_x [m], e_y [m], e_h [rad] of the car in the map frame.
            route: that the car follows. Where lanes overlap, its lanes are preferred.

        Returns:
            The lines that there are; empty if no drivable lane is within 30 m.

        Raises:
            ValueError: ``pose`` is not finite or not of shape (3,).
        """
        preferred = frozenset() if route is None else route.lane_set
        match = self.index.match(pose, preferred)
        return {} if match is None else self.view.lines(match, route)

    def along(self, route: Route) -> RouteLines:
        """Return the lines along a route, for a sender that has no more of the map than these.

        In each lane of the route, they are those of ``lines`` there. In a lane change, they become
        those of the other lane half way.
        """
        return self.view.along(route)

    def __repr__(self) -> str:
        roads, lanes = count_text(len(self.roads), "road"), count_text(len(self.lanes), "lane")
        return f"<Map {self.name!r}: {roads}, {lanes}>"


def _require(ids: Iterable[str], known: Mapping[str, object], where: str) -> None:
    for one in ids:
        if one not in known:
            raise ValueError(f"{where} names {one!r}, which is not in the map")


class LandmarkKind(StrEnum):
    """Kind of a landmark."""

    POLE = "pole"  #: of a street lamp, or a tree trunk
    SIGN = "sign"  #: traffic sign or traffic light


@dataclass(frozen=True)
class Landmark:
    """A thin upright object beside the road.

    Args:
        id: unique in the map.
        kind: of the object.
        x, y: position in the map frame [m].
    """

    id: str
    kind: LandmarkKind
    x: float
    y: float
