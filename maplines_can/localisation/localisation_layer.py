"""Layer of a map for the localisation: markings, kerbs and landmarks, found by position."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..maps import Landmark, Map
from ..values.line import Kind
from ..values.polyline import Polyline

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

Array = NDArray[np.float64]

#: Spacing of the points of the lines [m].
SPACING = 0.5
#: Length over which its curvature is taken [m].
BASE = 2.0
#: Farthest that a line is looked for [m], and largest angle to the car's x axis [rad].
REACH, MAX_ANGLE = 8.0, 0.6
#: A line ends where no point of it is this close to the y axis of the car [m].
MAX_AHEAD = 0.6
#: Kinds of lines that a camera does not see.
_INVISIBLE = frozenset({Kind.UNKNOWN, Kind.VIRTUAL})


class LinesBeside(NamedTuple):
    """Lines of the map that cross the y axes of n cars; k in all."""

    car: NDArray[np.intp]  #: (k,) which car
    offset: Array  #: (k,) y_off [m]
    heading: Array  #: (k,) beta [rad], of the line as an undirected one
    curvature: Array  #: (k,) c0 [1/m]
    kind: NDArray[np.intp]  #: (k,) values of ``Kind``


class LocalisationLayer:
    """Visible lines and landmarks of a map.

    Lines are the boundaries of the drivable lanes that have a marking, a kerb or a barrier.

    Args:
        road_map: the map.
    """

    def __init__(self, road_map: Map) -> None:
        from scipy.spatial import cKDTree

        lines: dict[int, Polyline] = {}
        for lane in road_map.lanes.values():
            if lane.type.is_drivable:
                lines |= {id(line): line for line in (lane.left, lane.right)}
        sampled = [_visible(line) for line in lines.values() if line.length > 0]
        table = np.vstack([*(points for points, _ in sampled), np.empty((0, 4))])
        self._points, self._angle, self._curvature = table[:, :2], table[:, 2], table[:, 3]
        kinds = [kind for _, kind in sampled]
        self._line = np.repeat(np.arange(len(kinds)), [len(kind) for kind in kinds])
        self._kind = np.concatenate([*kinds, np.empty(0, dtype=np.intp)])
        self._tree = cKDTree(self._points)
        self.landmarks: tuple[Landmark, ...] = road_map.landmarks
        #: (m, 2) positions of the landmarks [m].
        self.positions = np.array([(one.x, one.y) for one in road_map.landmarks]).reshape(-1, 2)
        self._landmark_tree = cKDTree(self.positions)

    def lines_beside(self, poses: Array) -> LinesBeside:
        """Return the lines that cross the y axes of cars within 8 m.

        Args:
            poses: (n, 3) x [m], y [m], heading [rad].
        """
        car, row = _pairs(self._tree, poses[:, :2], REACH)
        pose = poses[car]
        d = self._points[row] - pose[:, :2]
        c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        x, y = c * d[:, 0] + s * d[:, 1], -s * d[:, 0] + c * d[:, 1]
        # The line as driven by the car: a line and its reverse are the same one.
        turn = self._angle[row] - pose[:, 2]
        reverse = np.cos(turn) < 0
        angle = np.arctan2(np.sin(turn + np.pi * reverse), np.cos(turn + np.pi * reverse))
        near = (np.abs(x) <= MAX_AHEAD) & (np.abs(angle) <= MAX_ANGLE)
        order = np.flatnonzero(near)
        order = order[np.lexsort((np.abs(x[order]), self._line[row[order]], car[order]))]
        key = car[order] * (self._line.max(initial=0) + 1) + self._line[row[order]]
        first = order[np.append(True, np.diff(key) > 0)[: len(order)]]
        car, x, y, angle = car[first], x[first], y[first], angle[first]
        slope = np.tan(angle)
        bend = np.where(reverse[first], -1, 1) * self._curvature[row[first]]
        bend = bend * (1 + slope**2) ** 1.5  # second derivative of y(x)
        offset = y - slope * x + bend * x**2 / 2
        heading = np.arctan(slope - bend * x)
        return LinesBeside(car, offset, heading, bend, self._kind[row[first]])

    def landmarks_near(self, points: Array, reach: float) -> tuple[NDArray[np.intp], Array]:
        """Return which of (n, 2) points each nearby landmark is near to, and its (k, 2) position.

        Args:
            points: in the map frame [m]; none are near a point that is NaN.
            reach: [m].
        """
        car, row = _pairs(self._landmark_tree, points, reach)
        return car, self.positions[row]


def _pairs(tree: cKDTree, points: Array, reach: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the pairs of (n, 2) points and rows of a tree within a distance [m]."""
    given = np.flatnonzero(np.isfinite(points).all(axis=1))
    if not tree.n or not len(given):
        return np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp)
    found = tree.query_ball_point(points[given], reach)
    counts = [len(rows) for rows in found]
    rows = np.fromiter((row for some in found for row in some), dtype=np.intp, count=sum(counts))
    return np.repeat(given, counts), rows


def _visible(line: Polyline) -> tuple[Array, NDArray[np.intp]]:
    """Return (k, 4) samples of a line where it is visible, and their (k,) kinds."""
    if line.kind in _INVISIBLE and not line.kinds:
        return np.empty((0, 4)), np.empty(0, dtype=np.intp)
    points = _sampled(line)
    s = np.linspace(0.0, line.length, len(points))
    kind = np.array([line.kind_at(at) for at in s.tolist()], dtype=np.intp)
    keep = ~np.isin(kind, [*_INVISIBLE])
    return points[keep], kind[keep]


def _sampled(line: Polyline) -> Array:
    """Return (k, 4) x, y, direction and curvature along a line.

    The direction of a polyline jumps at its points, by up to 1 deg on a motorway. An Akima spline
    through them restores the curve, and remains straight where they are.
    """
    from scipy.interpolate import Akima1DInterpolator

    distance, keep = np.unique(line.distance, return_index=True)
    points = line.points[keep]
    s = np.linspace(0.0, distance[-1], max(1, math.ceil(distance[-1] / SPACING)) + 1)
    if len(points) == 2:
        step = points[1] - points[0]
        angle = math.atan2(step[1], step[0])
        xy = points[0] + np.outer(s / distance[-1], step)
        return np.column_stack([xy, np.full(len(s), angle), np.zeros(len(s))])
    spline = Akima1DInterpolator(distance, points)
    dx, dy = spline(s, 1).T
    angle = np.unwrap(np.arctan2(dy, dx))
    # The second derivative of such a spline jumps from point to point, by 12 % on a circle. A
    # filter would find its place along the circle by it, which nothing shows.
    reach = max(1, round(BASE / 2 / (s[1] - s[0])))
    ahead, behind = (np.clip(np.arange(len(s)) + k, 0, len(s) - 1) for k in (reach, -reach))
    curvature = (angle[ahead] - angle[behind]) / (s[ahead] - s[behind])
    return np.column_stack([spline(s), angle, curvature])
