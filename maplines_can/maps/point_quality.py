"""What the points of a map tell: how far they stand apart, their noise, and the sigma of a line."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..propagation import map_lines, point_errors
from ..values.gaussian import Gaussian
from ..values.line import LeftOut
from ..values.polyline import Polyline
from .road_map import Lane, Map

Array = NDArray[np.float64]

#: Quantiles that are told.
LOW, MEDIAN, HIGH = 0.05, 0.5, 0.95
#: Places ahead where the sigma of a line is told [m].
AHEAD = (0, 20, 40, 60)
#: Distance between places on lanes [m], and the most of them; a large map is sampled.
EVERY, MAX_PLACES = 10.0, 500
#: Pose without an error to speak of: 0.1 mm and 0.01 mrad.
NO_ERROR = np.diag([1e-8, 1e-8, 1e-10])
#: Points of which the noise is a mean: as many as ``map_lines`` takes.
TOGETHER = 30


class Spread(NamedTuple):
    """Quantiles over the length of the lines [m]."""

    low: float  #: 5 %
    median: float
    high: float  #: 95 %


class Sigmas(NamedTuple):
    """Standard deviations of the lateral positions of lines at a place ahead."""

    x: int  #: place [m]
    lines: int  #: whose range extends so far
    median: float | None  #: [m]; None without lines
    high: float | None  #: 95 % quantile [m]


class PointQuality(NamedTuple):
    """What the points of a map tell."""

    points: int  #: of all lines
    spacing: Spread
    noise: Spread | None  #: None if no line has five points
    places: int  #: on lanes, where lines were computed
    lines: int  #: that were given there
    left_out: dict[LeftOut, int]  #: that were not, by reason
    reach: float | None  #: median of how far ahead the lines extend [m]
    sigmas: tuple[Sigmas, ...]  #: at ``AHEAD``

    def as_dict(self) -> dict[str, Any]:
        """Return all figures, for JSON."""
        return self._asdict() | {
            "spacing": self.spacing._asdict(),
            "noise": self.noise and self.noise._asdict(),
            "left_out": {why.name: n for why, n in self.left_out.items()},
            "sigmas": [one._asdict() for one in self.sigmas],
        }


def point_quality(
    road_map: Map, seed: int = 0, progress: Callable[[float, float], None] = lambda *_: None
) -> PointQuality:
    """Return what the points of a map tell.

    The lines are those around a car on the centre lines of drivable lanes (``Map.lines``), by
    ``map_lines`` with a pose that has no error and without a stated map error: what is left is the
    error that the points show, and what a cubic misses.

    Args:
        road_map: the map.
        seed: of the places on a map of more than 5 km of lanes. A smaller one has one every 10 m.
        progress: is called with the number of places done, and of all.
    """
    lines = [line for lane in road_map.lanes.values() for line in (lane.left, lane.right)]
    lines += road_map.polylines.values()
    own = [*{id(line): line for line in lines}.values()]  # neighbours share theirs
    gaps = np.concatenate([np.diff(line.distance) for line in own])
    squares, lengths = np.concatenate([_noise(line) for line in own]).T
    noise = _spread(np.sqrt(squares), lengths) if len(squares) else None
    poses = [*_poses(road_map, np.random.default_rng(seed))]
    left_out: Counter[LeftOut] = Counter()
    ends, sigmas = [], []
    for i, pose in enumerate(poses):
        progress(i, len(poses))
        found = map_lines(road_map.lines(pose), Gaussian(pose, NO_ERROR), window=(-20.0, 100.0))
        left_out.update(found.left_out.values())
        for line in found:
            ends.append(line.x_max)
            known = [line.x_min <= x <= line.x_max for x in AHEAD]
            sigmas.append(np.where(known, line.y_sigma(np.array(AHEAD, float)), np.nan))
    progress(len(poses), len(poses))
    columns = np.array(sigmas).reshape(-1, len(AHEAD)).T
    return PointQuality(
        sum(len(line.points) for line in own),
        _spread(gaps, gaps),
        noise,
        len(poses),
        len(ends),
        dict(left_out.most_common()),
        float(np.median(ends)) if ends else None,
        tuple(_sigmas(x, column) for x, column in zip(AHEAD, columns, strict=True)),
    )


def _noise(line: Polyline) -> Array:
    """Return the mean square of the errors of about 30 points each, and how long they are: (n, 2).

    The units are m^2 and m.
    """
    squares = point_errors(line)[2:-2] ** 2
    if not len(squares):
        return np.empty((0, 2))
    begin = np.arange(0, len(squares), TOGETHER)
    count = np.diff([*begin, len(squares)])
    lengths = np.gradient(line.distance)[2:-2]
    return np.column_stack(
        [np.add.reduceat(squares, begin) / count, np.add.reduceat(lengths, begin)]
    )


def _spread(values: Array, lengths: Array) -> Spread:
    """Return the quantiles of values that hold over lengths."""
    order = np.argsort(values)
    share = np.cumsum(lengths[order])
    places = share.searchsorted(np.array([LOW, MEDIAN, HIGH]) * share[-1])
    return Spread(*values[order][places.clip(max=len(values) - 1)].tolist())


def _poses(road_map: Map, rng: np.random.Generator) -> Iterator[Array]:
    """Yield poses on the centre lines of drivable lanes, along them."""
    lanes = [lane for lane in road_map.lanes.values() if lane.type.is_drivable]
    ends = np.cumsum([lane.length for lane in lanes])
    if not len(ends):
        return
    count = int(min(max(ends[-1] / EVERY, 1), MAX_PLACES))
    share = rng.random(count) if ends[-1] > EVERY * MAX_PLACES else 0.5
    at = (np.arange(count) + share) * (ends[-1] / count)
    for s, i in zip(at, ends.searchsorted(at).clip(max=len(lanes) - 1), strict=True):
        yield _pose(lanes[i], float(s - ends[i] + lanes[i].length))


def _pose(lane: Lane, s: float) -> Array:
    """Return the pose at an arc length of the centre line [m]."""
    before, after = lane.centre.at(np.array([s - 0.5, s + 0.5]).clip(0.0, lane.length))
    x, y = (before + after) / 2
    return np.array([x, y, np.arctan2(*(after - before)[::-1])])


def _sigmas(x: int, sigmas: Array) -> Sigmas:
    known = sigmas[np.isfinite(sigmas)]
    if not len(known):
        return Sigmas(x, 0, None, None)
    return Sigmas(x, len(known), *np.quantile(known, [MEDIAN, HIGH]).tolist())
