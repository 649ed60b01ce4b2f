"""Roads on which evidence is taken: maps of others, and random roads.

Shapes of random roads are motorway, rural road, city, and others that are hard for a cubic.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from maplines_can import Polyline, Slot, maps
from maplines_can.maps import MapFileError
from maplines_can.simulation.street_shapes import Street, StreetPiece, widening
from maplines_can.study.scenes import map_scenes
from maplines_can.study.scenes.map_scenes import drivable

Array = NDArray[np.float64]
#: Lines around a mean pose, of a number and random numbers.
Draw = Callable[[int, np.random.Generator], tuple[Mapping[Slot, Polyline], Array]]

#: Standard deviations of the car's place across its lane [m], and of its heading from it [rad].
ACROSS_SIGMA, HEADING_SIGMA = 0.3, 0.05
#: Offsets of the lines of a scene [lane widths].
LANES = (0.5, -0.5, 1.5, -1.5, 0.0, 2.5, -2.5, 0.02)


def bend(
    rng: Any, radius: Any, turn: Any, clothoid: float = 0.0, side: int = 0
) -> list[StreetPiece]:
    """Return an arc with random radius [m] and turn [rad], between two clothoids."""
    k = (side or rng.choice([-1, 1])) / rng.uniform(*radius)
    arc = StreetPiece(max(1.0, rng.uniform(*turn) / abs(k) - clothoid), k, k)
    return [StreetPiece(clothoid, 0, k), arc, StreetPiece(clothoid, k, 0)] if clothoid else [arc]


def motorway(rng: Any) -> list[StreetPiece]:
    """Return straight pieces and bends of radius 700 m to 3000 m."""
    pieces = []
    for _ in range(4):
        pieces += [StreetPiece(rng.uniform(20, 300)), *bend(rng, (700, 3000), (0.1, 0.4), 80.0)]
    return pieces


def motorway_exit(rng: Any) -> list[StreetPiece]:
    """Return an exit of radius 40 m to 120 m."""
    ramp = bend(rng, (40, 120), (1.0, 4.0), rng.uniform(30, 80))
    return [StreetPiece(rng.uniform(60, 150)), *ramp, StreetPiece(rng.uniform(60, 150))]


def rural(rng: Any) -> list[StreetPiece]:
    """Return straight pieces and bends of radius 60 m to 400 m."""
    pieces = []
    for _ in range(5):
        pieces += [StreetPiece(rng.uniform(5, 150)), *bend(rng, (60, 400), (0.2, 1.5), 20.0)]
    return pieces


def s_bend(rng: Any) -> list[StreetPiece]:
    """Return two bends of radius 30 m to 80 m to opposite sides."""
    side = rng.choice([-1, 1])
    first, second = (bend(rng, (30, 80), (0.5, 1.2), 10.0, s) for s in (side, -side))
    return [StreetPiece(rng.uniform(20, 60)), *first, *second, StreetPiece(rng.uniform(20, 60))]


def turned_off(rng: Any, radius: tuple[float, float], turn: float) -> list[StreetPiece]:
    """Return a turn between straight pieces, with a random radius [m] and a turn [rad]."""
    begin = StreetPiece(rng.uniform(40, 80))
    return [begin, *bend(rng, radius, (turn, turn)), StreetPiece(rng.uniform(40, 80))]


def roundabout(rng: Any, radius: float) -> list[StreetPiece]:
    """Return most of a circle."""
    return bend(rng, (radius, radius), (1.9 * np.pi, 1.9 * np.pi))


def city(rng: Any) -> list[StreetPiece]:
    """Return corners, bends, S-bends and roundabouts, in random order."""
    pieces = [StreetPiece(rng.uniform(20, 60))]
    for _ in range(5):
        kind = rng.integers(4)
        if kind == 0:
            pieces += bend(rng, (8, 40), (0.3, 1.57))
        elif kind == 1:
            pieces += s_bend(rng)
        elif kind == 2:
            side = rng.choice([-1, 1])
            pieces += bend(rng, (8, 12), (0.6, 0.9), side=-side)
            pieces += bend(rng, (12, 25), (1.6, 4.5), side=side)
            pieces += bend(rng, (8, 12), (0.6, 0.9), side=-side)
        else:
            pieces += bend(rng, (15, 120), (0.3, 1.5), 8.0)
        pieces.append(StreetPiece(rng.uniform(10, 80)))
    return pieces


def boundary(rng: Any) -> Callable[[Array, float], Array]:
    """Return the offset of one of the boundaries of three lanes."""
    lane = rng.choice([-1.5, -0.5, 0.5, 1.5])
    return lambda s, width: np.full(len(s), lane * width)


def widened(rng: Any) -> Callable[[Array, float], Array]:
    """Return the offset of a boundary that moves by 3.5 m along 15 m to 60 m."""
    side, begin, length = rng.choice([-1, 1]), rng.uniform(-15, 60), rng.uniform(15, 60)
    return lambda s, width: side * (width / 2 + 3.5 * widening(s, begin, length))


def ended(rng: Any) -> Callable[[Array, float], Array]:
    """Return the offset of a boundary that ends, or begins, from 5 m behind to 90 m ahead."""
    side, end, sign = rng.choice([-1, 1]), rng.uniform(-5, 90), rng.choice([-1, 1, 1])
    return lambda s, width: np.where(sign * (s - end) <= 0, side * width / 2, np.nan)


def jumped(rng: Any) -> Callable[[Array, float], Array]:
    """Return the offset of a boundary that jumps by up to 3.5 m, from 10 m behind to 80 m ahead."""
    side, place, jump = rng.choice([-1, 1]), rng.uniform(-10, 80), rng.uniform(-3.5, 3.5)
    return lambda s, width: side * width / 2 + np.where(s > place, jump, 0.0)


def imprecise(rng: Any) -> Callable[[Array, float], Array]:
    """Return the offset of a boundary whose points are up to 0.15 m off the road's shape."""
    lane, sigma = rng.choice([-1.5, -0.5, 0.5, 1.5]), rng.uniform(0.02, 0.15)
    return lambda s, width: lane * width + sigma * rng.uniform(-1, 1, len(s))


#: Shapes of road by name: pieces, distances of the points [m] and offset of the line. In the
#: lines that end, widen or jump, this is near the car, at s = 0.
SHAPES: dict[str, tuple[Callable[[Any], list[StreetPiece]], tuple[float, float], Any]] = {
    "motorway": (motorway, (0.2, 20), boundary),
    "motorway-coarse": (motorway, (45, 90), boundary),
    "exit": (motorway_exit, (0.2, 5), boundary),
    "rural": (rural, (0.2, 10), boundary),
    "s-bend": (s_bend, (0.2, 2), boundary),
    "city": (city, (0.2, 2), boundary),
    "corner": (lambda rng: turned_off(rng, (8, 8), np.pi / 2), (0.2, 1), boundary),
    "roundabout-12m": (lambda rng: roundabout(rng, 12.0), (0.2, 1), boundary),
    "roundabout-50m": (lambda rng: roundabout(rng, 50.0), (0.2, 2), boundary),
    "lane-ends": (rural, (0.2, 5), ended),
    "lane-widens": (motorway, (0.2, 5), widened),
    "jump": (rural, (0.2, 5), jumped),
    "hairpin": (lambda rng: turned_off(rng, (7, 15), np.pi), (0.2, 1), boundary),
    "imprecise": (city, (1, 10), imprecise),
}


class SceneCase(NamedTuple):
    """Lines of the map and the mean pose of a car in the lane between the first two."""

    lines: dict[Slot, Array]  #: (n, 2) points in the map frame, in the direction of the car
    pose: Array  #: (3,)


def random_scene(shape: str, rng: Any, lines: int) -> SceneCase:
    """Return random lines of a shape of road, 1 to 8, near a car in its middle lane.

    They are the boundaries of the lanes, with a line in the middle and one close to it. A line
    that ends, widens or jumps does so at a place of its own; one that is not there lacks.
    """
    street, points_at = _random_street(shape, rng)
    width = rng.uniform(2.75, 3.75)
    found = {}
    for slot, lane in zip(Slot, LANES[:lines], strict=False):
        s = points_at()
        across = SHAPES[shape][2](rng)(s, width)
        if np.isfinite(across).sum() >= 2:
            across = lane * width + across - np.nanmedian(across)
            there = np.isfinite(across)
            found[slot] = street.line(s[there], across[there])
    turn, place = rng.uniform(-np.pi, np.pi), rng.uniform([3e5, 4e6], [7e5, 7e6])
    c, d = np.cos(turn), np.sin(turn)
    R = np.array([[c, d], [-d, c]])  # from the road to the map
    beside = np.array([0.0, rng.normal(0, ACROSS_SIGMA)])
    pose = np.append(beside @ R + place, turn + rng.normal(0, HEADING_SIGMA))
    return SceneCase({slot: points @ R + place for slot, points in found.items()}, pose)


#: Shapes of road on which the lanes go on.
ROADS = ("motorway", "exit", "rural", "s-bend", "city", "corner", "roundabout-12m", "hairpin")


#: A straight road, and a bend of radius 150 m between two spirals.
SPIRAL = (
    StreetPiece(150),
    StreetPiece(60, 0, 1 / 150),
    StreetPiece(150, 1 / 150, 1 / 150),
    StreetPiece(60, 1 / 150, 0),
)


def spiral_map() -> maps.Map:
    """Return a map with one lane along ``SPIRAL`` and a straight road behind it."""
    street = Street([*SPIRAL, StreetPiece(150)], 0.0)
    return _lane_map(street, np.arange(street.begin, street.end, 2.0))


def straight_map() -> maps.Map:
    """Return a map with one lane along a straight road of 900 m."""
    street = Street([StreetPiece(900)], 0.0)
    return _lane_map(street, np.arange(street.begin, street.end, 5.0))


def random_map(shape: str, seed: int) -> maps.Map:
    """Return a map with one lane along a random road, one of ``ROADS``."""
    street, points_at = _random_street(shape, np.random.default_rng([seed, ROADS.index(shape)]))
    return _lane_map(street, points_at())


def _lane_map(street: Street, s: Array, width: float = 3.5) -> maps.Map:
    """Return a map with one lane along a road, with points at arc lengths s [m]."""
    left, centre, right = (
        Polyline(street.line(s, np.full(len(s), y))) for y in (width / 2, 0.0, -width / 2)
    )
    lane = maps.Lane("1", left, right, centre, road="A")
    return maps.Map({"1": lane}, {"A": maps.Road("A", "", centre.length, ("1",))})


def _random_street(shape: str, rng: Any) -> tuple[Street, Callable[[], Array]]:
    """Return a road, and a function that draws arc lengths of the points of a line along it."""
    pieces_of, spacing, _ = SHAPES[shape]
    pieces = [StreetPiece(*map(float, piece)) for piece in pieces_of(rng)]
    street = Street(pieces, rng.uniform(0.05, 0.9) * sum(piece.length for piece in pieces))
    distance = np.exp(rng.uniform(*np.log(spacing)))
    least, most = max(spacing[0], 0.7 * distance), min(spacing[1], 1.4 * distance)
    count = int((street.end - street.begin) / least) + 1

    def points_at() -> Array:
        s = street.begin + np.append(0.0, rng.uniform(least, most, count).cumsum())
        return np.append(s[s < street.end - least / 2], street.end)

    return street, points_at


# ---- maps of others ----------------------------------------------------------------------------

#: Length of a route [m].
LENGTH = 3000.0


def maps_of(paths: Sequence[str]) -> dict[str, maps.Map]:
    """Return the maps with lanes to drive on below folders, and those of files, by name.

    Raises:
        ValueError: a path does not exist, or is a file that is no such map.
    """
    found = {}
    for path in map(Path, paths):
        if not path.exists():
            raise ValueError(f"there is no file or folder {path}")
        for file in sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]:
            try:
                road_map = maps.load(file)
            except (MapFileError, ImportError, OSError):
                road_map = None
            if road_map is not None and drivable(road_map):
                found[file.name if file.name not in found else str(file)] = road_map
            elif file == path:
                raise ValueError(f"{path} is no map with lanes to drive on")
    return found


def on_map(road_map: maps.Map) -> Draw:
    """Return the drawing of lines around random poses on a map."""
    draw = map_scenes.on_map(road_map)
    return lambda _, rng: draw(rng)


def on_roads(shapes: Sequence[str], lines: int | None = None) -> Draw:
    """Return the drawing of lines of random roads: so many, or 2 to 8 by the number."""

    def draw(number: int, rng: np.random.Generator) -> tuple[Mapping[Slot, Polyline], Array]:
        rest, shape = divmod(number, len(shapes))
        case = random_scene(shapes[shape], rng, lines or 2 + rest % 7)
        return {slot: Polyline(points) for slot, points in case.lines.items()}, case.pose

    return draw


def sources(
    paths: Sequence[str], shapes: Sequence[str], *roads: tuple[str, maps.Map]
) -> dict[str, Callable[[int], maps.Map]]:
    """Return maps for a seed, by name: of folders and files, given ones, and random roads."""

    def always(one: maps.Map, _: int) -> maps.Map:
        return one

    found: dict[str, Callable[[int], maps.Map]] = {
        name: partial(always, one) for name, one in (maps_of(paths) | dict(roads)).items()
    }
    return found | {f"random: {x}": partial(random_map, x) for x in shapes}


def route_of(road_map: maps.Map, seed: int) -> maps.Route:
    """Return the route along the only lane of a map, or a random one."""
    if len(road_map.lanes) == 1:
        return road_map.route("1", "1")
    return maps.random_tour(road_map, LENGTH, seed)
