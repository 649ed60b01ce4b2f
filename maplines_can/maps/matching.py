"""Matching of a pose to the lanes near it."""

from __future__ import annotations

import math
from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.arrays import floats
from ..values.polyline import Pieces, Polyline, merged
from .lane import Lane

T = TypeVar("T")

#: Lanes farther from the pose are no match [m].
MAX_DISTANCE = 30.0
#: Distance to the lane that counts as much as a heading difference of 1 rad [m].
HEADING_COST = 2.0
#: Distance to the lane that counts as much as driving against its direction [m].
AGAINST_COST = 1.0
#: Distance to the lane that counts as much as a turn of the lane by 1 rad [m]: where lanes of a
#: junction overlap, the straight one is preferred.
TURN_COST = 0.02
#: Distance to a lane that counts as much as that the car follows it no longer [m]. It keeps the car
#: on its route where lanes overlap.
PREFERENCE = 1.0
#: Standard deviation of the heading of cars relative to their lane [rad].
HEADING_SIGMA = math.radians(5.0)
#: Prior probability that a car drives against the direction of its lane.
AGAINST_PRIOR = 0.01
#: Candidates of less probability are left out.
MIN_PROBABILITY = 1e-6
#: Least standard deviation of a position [m], so that a covariance may be 0.
MIN_SIGMA = 1e-3

#: Lines of more points are searched by boxes around so many steps.
_LARGE = 512
_BLOCK = 64
#: Large lines whose boxes are kept.
_LINES_KEPT = 256
#: Positions farther away are as far as this [m], so that their squares do not overflow.
_FAR = 1e100
#: Distance of the samples of centre lines in the search tree [m].
_SPACING = 2.0
#: Distance beyond the widest lane at which lanes are candidates [m].
_MARGIN = 0.5
#: Half the width of a lane is taken as at most this [m]; a wider one is found near its centre line.
_WIDEST = 30.0


@dataclass(frozen=True, slots=True)
class LaneMatch:
    """A pose in the coordinates of a lane.

    Args:
        lane: id.
        s: arc length along the centre line [m].
        t: lateral offset from the centre line, positive on the left [m].
        heading: of the car relative to the centre line, in (-pi, pi] [rad].
        margins: distances inside the left and the right boundary, the start and the end of the
            lane [m]; negative beyond one.
        probability: that the car is in the lane.
    """

    lane: str
    s: float
    t: float
    heading: float
    margins: tuple[float, float, float, float]
    probability: float = 1.0

    @property
    def outside(self) -> float:
        """Distance from the area of the lane [m]; 0 in the lane."""
        left, right, start, end = self.margins
        return math.hypot(max(0.0, -left, -right), max(0.0, -start, -end))

    @property
    def is_against(self) -> bool:
        """Whether the car drives against the direction of the lane."""
        return abs(self.heading) > math.pi / 2

    @property
    def skew(self) -> float:
        """Angle between the car and the line of the lane, whatever its direction [rad]."""
        return min(abs(self.heading), math.pi - abs(self.heading))


def wrapped(angle: float) -> float:
    """Return an angle in (-pi, pi] [rad].

    >>> wrapped(3 * math.pi / 2) == -math.pi / 2
    True
    """
    return math.pi - (math.pi - angle) % math.tau


class LaneIndex:
    """Search tree over the drivable lanes of a map.

    Args:
        lanes: by their ids.
    """

    def __init__(self, lanes: Mapping[str, Lane]) -> None:
        from scipy.spatial import KDTree  # loads scipy, which the values do not need

        self._lanes = {key: lane for key, lane in lanes.items() if lane.type.is_drivable}
        self._ids = list(self._lanes)
        samples, counts, reaches = [], [], []
        for lane in self._lanes.values():
            count = math.ceil(lane.length / _SPACING) + 1
            centre, left = (_at_fractions(line, count) for line in (lane.centre, lane.left))
            widest = float(np.hypot(*(left - centre)).max())
            reaches.append(min(widest, _WIDEST) + _MARGIN + _SPACING / 2)
            samples.append(centre)
            counts.append(count)
        self._owner = np.arange(len(counts)).repeat(counts)
        self._reach = np.array(reaches).repeat(counts)
        self._farthest = max(reaches, default=0.0)
        points = np.concatenate(samples, axis=1).T if samples else np.empty((0, 2))
        self._tree = KDTree(points)
        self._turn = {
            key: abs(_turn(lane)) if lane.junction is not None else 0.0
            for key, lane in self._lanes.items()
        }

    def near(self, pose: ArrayLike, margin: float = 0.0) -> list[LaneMatch]:
        """Return the lanes near a pose, in no order.

        These are all lanes that the pose is in, and those about ``_MARGIN`` + ``margin`` [m] from
        it; if there is none, the nearest one up to ``MAX_DISTANCE``.

        Args:
            pose: (3,) e_x [m], e_y [m], e_h [rad] of the car in the map frame.
            margin: additional distance [m].

        Raises:
            ValueError: ``pose`` is not finite or not of shape (3,).
        """
        pose = floats(pose, "pose")
        if pose.shape != (3,) or not np.isfinite(pose).all():
            raise ValueError(f"pose must be finite with shape (3,), got {pose!r}")
        point, heading = pose[:2].clip(-_FAR, _FAR), float(pose[2])
        rows = np.array(self._tree.query_ball_point(point, self._farthest + margin), dtype=int)
        away = np.hypot(*(self._tree.data[rows] - point).T)
        rows = rows[away <= self._reach[rows] + margin]
        if not len(rows):
            distance, row = self._tree.query(point, distance_upper_bound=MAX_DISTANCE)
            if not math.isfinite(distance):
                return []
            rows = np.array([row])
        found = sorted({*self._owner[rows].tolist()})
        return list(_located([self._lanes[self._ids[i]] for i in found], point, heading))

    def cost(self, match: LaneMatch) -> float:
        """Return the distance to the lane, plus what the direction of the car counts [m]."""
        against = AGAINST_COST if match.is_against else 0.0
        turn = TURN_COST * self._turn[match.lane]
        return match.outside + HEADING_COST * match.skew + against + turn

    def match(self, pose: ArrayLike, preferred: Container[str] = ()) -> LaneMatch | None:
        """Return the best match: see ``Map.match``.

        Args:
            pose: (3,) e_x [m], e_y [m], e_h [rad] of the car in the map frame.
            preferred: ids of lanes that have an advantage if the car is in them.
        """

        def cost(match: LaneMatch) -> float:
            is_preferred = match.lane in preferred and not match.is_against and not match.outside
            return self.cost(match) - (PREFERENCE if is_preferred else 0.0)

        return min(self.near(pose), key=cost, default=None)

    def candidates(self, pose: ArrayLike, cov: ArrayLike) -> tuple[LaneMatch, ...]:
        """Return the lanes that an uncertain pose may be in: see ``Map.match``."""
        P = floats(cov, "cov")
        if P.shape != (3, 3) or not np.isfinite(P).all() or (np.diag(P) < 0).any():
            raise ValueError(f"cov must be a covariance of shape (3, 3), got {P!r}")
        pose = floats(pose, "pose")
        sigma = math.sqrt(P[0, 0] + P[1, 1])
        near = self.near(pose, min(3 * sigma, MAX_DISTANCE))
        weights = [_weight(match, pose, P) for match in near]
        total = sum(weights)
        if total <= 0:  # far from all lanes
            best = min(near, key=self.cost, default=None)
            return (best,) if best else ()
        found = (
            replace(match, probability=weight / total)
            for match, weight in zip(near, weights, strict=True)
            if weight >= MIN_PROBABILITY * total
        )
        return tuple(sorted(found, key=lambda match: -match.probability))


def _weight(match: LaneMatch, pose: NDArray[np.float64], P: NDArray[np.float64]) -> float:
    """Return the probability of the lane but for a factor common to all."""
    direction = float(pose[2]) - match.heading
    c, s = math.cos(direction), math.sin(direction)
    to_lane = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    (ss, _, _), (_, tt, tp), (_, _, pp) = (to_lane @ P @ to_lane.T).tolist()
    pp += HEADING_SIGMA**2
    difference = match.heading
    if match.is_against:
        difference -= math.copysign(math.pi, difference)
    # The lateral position given that the car drives along the lane, by the Kalman gain tp / pp.
    shift = -tp / pp * difference
    sigma_t = math.sqrt(max(tt - tp * tp / pp, MIN_SIGMA**2))
    sigma_s = math.sqrt(max(ss, MIN_SIGMA**2))
    left, right, start, end = match.margins
    lateral = _mass(-right - shift, left - shift, sigma_t)
    along = _mass(-start, end, sigma_s)
    prior = AGAINST_PRIOR if match.is_against else 1.0
    return prior * lateral * along * math.exp(-0.5 * difference**2 / pp)


def _mass(low: float, high: float, sigma: float) -> float:
    """Return the probability of a centred normal variable to be between two values."""
    if low >= high:
        return 0.0
    if low > 0:  # the lower tail is more accurate
        low, high = -high, -low
    scale = 1 / (sigma * math.sqrt(2))
    return 0.5 * (math.erfc(-high * scale) - math.erfc(-low * scale))


def _located(
    lanes: Sequence[Lane], point: NDArray[np.float64], heading: float
) -> Iterator[LaneMatch]:
    """Yield a pose in the coordinates of lanes."""
    lines = [line for lane in lanes for line in (lane.left, lane.right, lane.centre)]
    places = iter(locate(lines, point))
    for lane in lanes:
        left, right, centre = next(places), next(places), next(places)
        start = centre.s + centre.overshoot
        margins = (-left.t, right.t, start, lane.length - start)
        yield LaneMatch(lane.id, centre.s, centre.t, wrapped(heading - centre.direction), margins)


@dataclass(frozen=True, slots=True)
class Place:
    """The place of a line that is nearest to a point.

    Args:
        s: arc length [m].
        t: distance of the point, positive on the left [m].
        direction: of the line [rad].
        overshoot: distance along the line beyond its end, or negative before its start [m].
    """

    s: float
    t: float
    direction: float
    overshoot: float


def locate(lines: Iterable[Polyline], point: NDArray[np.float64]) -> Iterator[Place]:
    """Yield the place of each line that is nearest to a point."""
    parts = [_near(line, point) for line in lines]
    x, y = (np.concatenate([part for part, _, _ in parts]) - point).T
    dx, dy = x[1:] - x[:-1], y[1:] - y[:-1]
    x, y = x[:-1], y[:-1]
    squared_length = dx * dx + dy * dy
    share = -(x * dx + y * dy) / np.where(squared_length > 0, squared_length, 1.0)
    clipped = share.clip(0.0, 1.0)
    squared = (x + clipped * dx) ** 2 + (y + clipped * dy) ** 2
    first = 0
    for part, distance, length in parts:
        last = first + len(part) - 1
        k = first + int(squared[first:last].argmin())
        s0, s1 = distance[k - first : k - first + 2].tolist()
        step, along = s1 - s0, float(share[k]) * (s1 - s0)
        overshoot = 0.0
        if s0 == 0 and along < 0:
            overshoot = along
        elif s1 == length and along > step:
            overshoot = along - step
        cross = float(dy[k] * x[k] - dx[k] * y[k])
        # Beyond an end, the distance from the line extended, else from the line itself.
        t = cross / (step or 1.0) if overshoot else math.copysign(math.sqrt(squared[k]), cross)
        s = s0 + min(max(along, 0.0), step)
        yield Place(s, t, math.atan2(dy[k], dx[k]), overshoot)
        first = last + 1


def pieces_beside(
    line: Polyline, points: Iterable[NDArray[np.float64]], values: Sequence[T], is_along: bool
) -> Pieces[T]:
    """Return values that change at points beside a line, by the arc length of the line [m].

    The points, at which all values but the first one begin, run along the line or against it.
    """
    order = slice(None, None, 1 if is_along else -1)
    places = [place.s for point in points for place in locate([line], point)][order]
    starts = np.maximum.accumulate([0.0, *places]).tolist()
    return merged(list(dict(zip(starts, values[order], strict=True)).items()))


def _near(
    line: Polyline, point: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Return points of a line around that nearest to a point, arc lengths, and its length."""
    points, distance = line.points, line.distance
    if len(points) > _LARGE:
        low, high = _boxes(line)
        outside = np.maximum(low - point, point - high).clip(min=0.0)
        farthest = np.hypot(*(points[:-1:_BLOCK] - point).T).min()
        blocks = np.flatnonzero(np.hypot(*outside.T) <= farthest)
        part = slice(int(blocks[0]) * _BLOCK, (int(blocks[-1]) + 1) * _BLOCK + 1)
        points, distance = points[part], distance[part]
    return points, distance, line.length


@lru_cache(_LINES_KEPT)
def _boxes(line: Polyline) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the lower and the upper corners of boxes around each ``_BLOCK`` steps of a line."""
    starts = np.arange(0, len(line.points) - 1, _BLOCK)
    ends = line.points[np.minimum(starts + _BLOCK, len(line.points) - 1)]
    low, high = (f.reduceat(line.points, starts) for f in (np.minimum, np.maximum))
    return np.minimum(low, ends), np.maximum(high, ends)


def _at_fractions(line: Polyline, count: int) -> NDArray[np.float64]:
    """Return (2, count) points at even fractions of the length."""
    at = np.linspace(0.0, line.length, count)
    return np.array([np.interp(at, line.distance, values) for values in line.points.T])


def _turn(lane: Lane) -> float:
    """Return the angle by which the centre line turns from start to end [rad]."""
    (x0, y0), (x1, y1) = np.diff(lane.centre.points, axis=0)[[0, -1]].tolist()
    return wrapped(math.atan2(y1, x1) - math.atan2(y0, x0))
