"""Example scenarios: those of the paper, a production car, and streets of typical shapes."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..values.gaussian import Gaussian
from ..values.line import Kind, Slot
from ..values.polyline import Polyline
from .street_shapes import streets


@dataclass(frozen=True, eq=False)
class Scenario:
    """Car (ego) whose pose is a Gaussian, and the map lines around it.

    Args:
        name: name of the scenario, as on the command line.
        about: description in one sentence.
        ego: Gaussian over (e_x [m], e_y [m], e_h [rad]) in the map frame.
        lines: the line of the map for each slot.
        window: (x_min, x_max) ahead of the car in which the lines are seen [m].

    >>> from maplines_can import map_lines
    >>> production = scenario("production")
    >>> lines = map_lines(production.lines, production.ego, window=production.window)
    >>> [line.slot.name for line in lines[:2]]
    ['EGO_LEFT', 'EGO_RIGHT']
    """

    name: str
    about: str
    ego: Gaussian
    lines: Mapping[Slot, Polyline]
    window: tuple[float, float]

    def first_lines(self, number: int) -> dict[Slot, Polyline]:
        """Return the first lines."""
        return dict(islice(self.lines.items(), number))


def pose(
    sigma_x: float, sigma_y: float, heading_sigma_deg: float, correlation: float = 0.0
) -> Gaussian:
    """Return the pose of a car at the origin of the map that heads along x.

    The standard deviations are of e_x [m], e_y [m] and e_h [deg], the correlation of e_x and e_y.
    """
    sigma = np.array([sigma_x, sigma_y, np.radians(heading_sigma_deg)])
    R = np.eye(3)
    R[0, 1] = R[1, 0] = correlation
    return Gaussian(np.zeros(3), R * np.outer(sigma, sigma))


def parallel(points: ArrayLike, offset: float) -> NDArray[np.float64]:
    """Return (n, 2) points that lie ``offset`` [m] to the left of a line's (n, 2) points."""
    points = np.asarray(points, dtype=float)
    tangent = np.gradient(points, axis=0)
    tangent /= np.hypot(*tangent.T)[:, None]
    return points + offset * tangent[:, ::-1] * [-1.0, 1.0]


def _lanes(right_boundary: NDArray[np.float64], width: float = 3.5) -> dict[Slot, Polyline]:
    """Return all lines of a road with three lanes: the car in the middle, the route on the left."""
    plan = (
        (Slot.EGO_LEFT, Kind.DASHED, width),
        (Slot.EGO_RIGHT, Kind.DASHED, 0.0),
        (Slot.NEXT_LEFT, Kind.SOLID, 2 * width),
        (Slot.NEXT_RIGHT, Kind.SOLID, -width),
        (Slot.CENTRE, Kind.VIRTUAL, width / 2),
        (Slot.EDGE_LEFT, Kind.ROAD_EDGE, 2 * width + 0.5),
        (Slot.EDGE_RIGHT, Kind.KERB, -width - 0.5),
        (Slot.ROUTE, Kind.VIRTUAL, width * 3 / 2),
    )
    return {slot: Polyline(parallel(right_boundary, offset), kind) for slot, kind, offset in plan}


def _highway() -> dict[Slot, Polyline]:
    x = np.linspace(-20.0, 80.0, 51)
    return _lanes(np.column_stack([x, -1.75 + x**2 / (2 * 2000.0) + 1e-6 * x**3 / 6]))


def _street_turn() -> dict[Slot, Polyline]:
    s = np.linspace(-10.0, 40.0, 51)
    arc = (s - 5.0).clip(0) / 20.0
    return _lanes(
        np.column_stack([s.clip(max=5.0) + 20 * np.sin(arc), -1.75 + 20 * (1 - np.cos(arc))])
    )


def _scenarios() -> Iterator[Scenario]:
    highway, turn = (_highway(), (-20.0, 80.0)), (_street_turn(), (-10.0, 40.0))
    yield Scenario(
        "highway",
        "three lanes, radius 2000 m; position sigma 0.5 m, heading sigma 5 deg (paper, figure 5)",
        pose(0.5, 0.5, 5.0),
        *highway,
    )
    yield Scenario(
        "highway-correlated",
        "highway with the errors along and across the road correlated by 0.8 (paper, figure 7)",
        pose(0.5, 0.5, 5.0, correlation=0.8),
        *highway,
    )
    yield Scenario(
        "highway-10deg",
        "highway with heading sigma 10 deg (paper, figure 8)",
        pose(0.5, 0.5, 10.0),
        *highway,
    )
    yield Scenario(
        "street-turn",
        "straight for 5 m, then a left turn of radius 20 m; heading sigma 5 deg (paper, figure 10)",
        pose(0.5, 0.5, 5.0),
        *turn,
    )
    yield Scenario(
        "street-turn-10deg",
        "street-turn with heading sigma 10 deg (paper, figure 11)",
        pose(0.5, 0.5, 10.0),
        *turn,
    )
    yield Scenario(
        "production",
        "highway seen by a production car: sigma 0.3 m along, 0.1 m across, heading sigma 0.5 deg",
        pose(0.3, 0.1, 0.5),
        *highway,
    )


#: The scenarios by name. The paper states the heading sigmas; the other values are our choice.
SCENARIOS: dict[str, Scenario] = {scenario.name: scenario for scenario in _scenarios()}
#: Streets of typical shapes, seen by a car with sigmas of 0.1 m along, 0.2 m across and 0.2 deg.
STREETS: dict[str, Scenario] = {
    name: Scenario(name, about, pose(0.1, 0.2, 0.2), lines, (-20.0, 80.0))
    for name, about, lines in streets()
}


def scenario(name: str) -> Scenario:
    """Return the scenario with this name.

    Raises:
        ValueError: there is no such scenario.

    >>> scenario("production").ego.sigma.round(4)
    array([0.3   , 0.1   , 0.0087])
    >>> scenario("moon")
    Traceback (most recent call last):
    ...
    ValueError: no scenario 'moon'; there are highway, highway-correlated, highway-10deg, \
street-turn, street-turn-10deg, production, corner, roundabout-12m, roundabout-50m, exit, s-bend, \
lane-ends, lane-widens, motorway-coarse
    """
    scenarios = SCENARIOS | STREETS
    try:
        return scenarios[name]
    except KeyError:
        raise ValueError(f"no scenario {name!r}; there are {', '.join(scenarios)}") from None
