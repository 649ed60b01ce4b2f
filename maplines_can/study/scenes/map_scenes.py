"""Scenes as a car would send them: of places on maps, and of random roads.

Each is seen from a pose with a random error, of a kind of ``POSES``. The map is exact, or has an
error of a kind of ``MAPS``. Sizes are drawn within a factor of 2, since a field that is rounded is
not to be judged at one value alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...maps import Lane, Map, load
from ...propagation import MapError, map_scene
from ...values.errors import StudyError
from ...values.gaussian import Gaussian
from ...values.line import Slot
from ...values.polyline import Polyline
from ...values.scene import Scene
from .random_scenes import POSE_FACTOR, PRODUCTION, RATIO, SPACING, random_road

Array = NDArray[np.float64]

#: Standard deviations of the pose: along [m], across [m], heading [deg].
POSES = {"production": PRODUCTION, "poor": (0.5, 1.0, 2.0)}
#: Standard deviations of the map: of the points [m], of their offset [m] and heading [deg].
MAPS = {"exact": (0.0, 0.0, 0.0), "points": (0.05, 0.0, 0.0), "drift": (0.05, 0.05, 0.05)}
#: Name of the random roads.
ROADS = "random roads"
#: Slots of the lines around a pose on a map.
SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.NEXT_LEFT, Slot.NEXT_RIGHT)
#: Of a random pose: largest offset from the centre line [m], standard deviation of the direction.
OFFSET, TURN = 0.5, math.radians(3.0)

#: Lines around a random pose, and the pose.
Draw = Callable[[np.random.Generator], tuple[Mapping[Slot, Polyline], Array]]


class DrawnScene(NamedTuple):
    """Scene, and where it is from."""

    source: str  #: name of the map, or ``ROADS``
    pose: str  #: of ``POSES``
    error: str  #: of ``MAPS``
    scene: Scene


def drawn_scenes(
    maps: Mapping[str, Map], n: int, seed: int, *, roads: bool = True
) -> Iterator[DrawnScene]:
    """Yield n scenes of each map, and of random roads, in turn with each error of pose and map.

    Args:
        maps: with lanes to drive on, by name.
        n: number of scenes of each.
        seed: of the places and the errors.
        roads: whether random roads are among them.
    """
    sources: dict[str, Draw] = {name: on_map(road_map) for name, road_map in maps.items()}
    if roads:
        sources[ROADS] = on_road
    kinds = list(product(POSES, MAPS))
    for place, (source, draw) in enumerate(sources.items()):
        rng = np.random.default_rng([seed, place])
        for number in range(n):
            pose, error = kinds[number % len(kinds)]
            scene = None
            while scene is None or not scene.lines:  # where no line can be given, there is none
                scene = seen(*draw(rng), pose, error, rng)
            yield DrawnScene(source, pose, error, scene)


def maps_of(paths: Sequence[str | Path]) -> dict[str, Map]:
    """Return the maps of files by the names of these.

    Raises:
        MapFileError: a file is no map.
        StudyError: a map has no lanes to drive on.
    """
    found = {}
    for path in paths:
        road_map = load(path)
        if not drivable(road_map):
            raise StudyError(f"{path}: the map has no lanes to drive on, so no car sees its lines")
        name = Path(path).name
        found[name if name not in found else str(path)] = road_map
    return found


def drivable(road_map: Map) -> list[Lane]:
    """Return the lanes to drive on."""
    return [lane for lane in road_map.lanes.values() if lane.type.is_drivable and lane.length > 0]


def on_map(road_map: Map) -> Draw:
    """Return the drawing of lines around random poses on a map."""
    lanes = drivable(road_map)

    def draw(rng: np.random.Generator) -> tuple[Mapping[Slot, Polyline], Array]:
        pose = random_pose(lanes, rng)
        return {slot: x for slot, x in road_map.lines(pose).items() if slot in SLOTS}, pose

    return draw


def on_road(rng: np.random.Generator) -> tuple[Mapping[Slot, Polyline], Array]:
    """Return the lines of a random road, seen from a pose on it."""
    closest, farthest = map(math.log, SPACING)
    spacings = np.exp(rng.uniform(closest, farthest, len(SLOTS)))
    return random_road(spacings, rng)


def random_pose(lanes: Sequence[Lane], rng: np.random.Generator) -> Array:
    """Return a pose on one of the lanes, drawn by their lengths, about in its direction."""
    lengths = np.array([lane.length for lane in lanes])
    lane = lanes[rng.choice(len(lanes), p=lengths / lengths.sum())]
    points = lane.centre.points
    s = rng.uniform(0, lane.length)
    k = min(int(lane.centre.distance.searchsorted(s, side="right")), len(points) - 1)
    step = points[k] - points[k - 1]
    heading = np.arctan2(step[1], step[0])
    x, y = (np.interp(s, lane.centre.distance, values) for values in points.T)
    side = np.clip(rng.normal(0, OFFSET / 2), -OFFSET, OFFSET)
    side = np.clip(side, -lane.width / 4, lane.width / 4)
    return np.array(
        [x - side * np.sin(heading), y + side * np.cos(heading), heading + rng.normal(0, TURN)]
    )


def seen(
    lines: Mapping[Slot, Polyline], mean: Array, pose: str, error: str, rng: np.random.Generator
) -> Scene:
    """Return lines of a map as seen from a pose, with errors of about the sizes of their kinds.

    Args:
        lines: by slot.
        mean: (3,) pose x [m], y [m], heading [rad].
        pose: error of the pose, of ``POSES``.
        error: error of the map, of ``MAPS``.
        rng: of the sizes.
    """
    *place, turn = POSES[pose]
    root = np.eye(3)
    root[np.tril_indices(3, -1)] = rng.uniform(-RATIO, RATIO, 3)
    root *= _about([*place, math.radians(turn)], rng)[:, None]
    c, d = np.cos(mean[2]), np.sin(mean[2])
    root = np.array([[c, -d, 0], [d, c, 0], [0, 0, 1]]) @ root
    *sigmas, turn = MAPS[error]
    map_error = MapError(*_about([*sigmas, math.radians(turn)], rng))
    return map_scene(lines, Gaussian(mean, root @ root.T), map_error=map_error)


def _about(sizes: Sequence[float], rng: np.random.Generator) -> Array:
    """Return sizes within a factor of ``POSE_FACTOR`` of these."""
    reach = math.log(POSE_FACTOR)
    return np.asarray(np.array(sizes) * np.exp(rng.uniform(-reach, reach, len(sizes))))
