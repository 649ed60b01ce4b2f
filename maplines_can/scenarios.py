"""The scenes used everywhere: the paper's scenarios, a production car, and random roads."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .gaussian import Gaussian
from .line import Kind, Slot
from .polyline import Polyline

__all__ = ["SCENARIOS", "Scenario", "SceneLine", "random_scenarios", "scenario"]


@dataclass(frozen=True)
class SceneLine:
    """One line of a scene: where it belongs, what it is, and its map points."""

    slot: Slot
    kind: Kind
    polyline: Polyline


@dataclass(frozen=True, eq=False)
class Scenario:
    """A car that knows its pose as a Gaussian, and the map lines around it.

    Args:
        name: as on the command line.
        about: one sentence for the reader.
        ego: Gaussian over (e_x [m], e_y [m], e_h [rad]) in the map frame.
        lines: the lines of the scene.
        window: (x_min, x_max) of the points that the lines are fitted to [m].
    """

    name: str
    about: str
    ego: Gaussian
    lines: tuple[SceneLine, ...]
    window: tuple[float, float]

    @property
    def polylines(self) -> list[Polyline]:
        """The map points of each line, in the order of ``lines``."""
        return [line.polyline for line in self.lines]


def pose(
    sigma_x: float, sigma_y: float, heading_sigma_deg: float, correlation: float = 0.0
) -> Gaussian:
    """A car at the origin of the map, heading along x; e_x and e_y may correlate."""
    sigma = np.array([sigma_x, sigma_y, np.radians(heading_sigma_deg)])
    R = np.eye(3)
    R[0, 1] = R[1, 0] = correlation
    return Gaussian(np.zeros(3), R * np.outer(sigma, sigma))


def parallel(points: ArrayLike, offset: float) -> NDArray[np.float64]:
    """(n, 2) points ``offset`` [m] to the left of a line."""
    points = np.asarray(points, dtype=float)
    tangent = np.gradient(points, axis=0)
    tangent /= np.hypot(*tangent.T)[:, None]
    return points + offset * tangent[:, ::-1] * [-1.0, 1.0]


def curve(
    y_off: float, heading: float, curvature: NDArray[np.float64], spacing: float, ahead_from: float
) -> NDArray[np.float64]:
    """(n, 2) points of a line whose curvature is given every ``spacing`` [m] along it.

    Args:
        y_off: lateral position of the line at x = 0 [m].
        heading: its direction at s = 0 [rad].
        curvature: (n,) from s = ahead_from on [1/m].
        spacing: way between points [m].
        ahead_from: way of the first point, 0 or less; s = 0 stands at (0, y_off) [m].
    """
    middle = (curvature[1:] + curvature[:-1]) / 2
    turn = np.append(0.0, np.cumsum(middle * spacing))
    chord = turn[:-1] + middle * spacing / 2
    steps = spacing * np.column_stack([np.cos(chord), np.sin(chord)])
    points = np.vstack([[0.0, 0.0], np.cumsum(steps, axis=0)])
    s = ahead_from + spacing * np.arange(len(curvature))
    origin = np.array([np.interp(0, s, points[:, 0]), np.interp(0, s, points[:, 1])])
    back = heading - np.interp(0, s, turn)
    c, d = np.cos(back), np.sin(back)
    return (points - origin) @ np.array([[c, d], [-d, c]]) + [0.0, y_off]


def _lanes(right_boundary: NDArray[np.float64], width: float = 3.5) -> tuple[SceneLine, ...]:
    """All lines of a road of three lanes, the car in the middle one, which the route leaves."""
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
    return tuple(
        SceneLine(slot, kind, Polyline(parallel(right_boundary, offset)))
        for slot, kind, offset in plan
    )


def _highway() -> tuple[SceneLine, ...]:
    x = np.linspace(-20.0, 80.0, 51)
    return _lanes(np.column_stack([x, -1.75 + x**2 / (2 * 2000.0) + 1e-6 * x**3 / 6]))


def _street_turn() -> tuple[SceneLine, ...]:
    s = np.linspace(-10.0, 40.0, 51)
    arc = (s - 5.0).clip(0) / 20.0
    return _lanes(
        np.column_stack([s.clip(max=5.0) + 20 * np.sin(arc), -1.75 + 20 * (1 - np.cos(arc))])
    )


def _scenarios() -> Iterator[Scenario]:
    road, window = _highway(), (-20.0, 80.0)
    turn, turn_window = _street_turn(), (-10.0, 40.0)
    yield Scenario(
        "highway",
        "three lanes, radius 2000 m; position sigma 0.5 m, heading sigma 5 deg (paper, figure 5)",
        pose(0.5, 0.5, 5.0),
        road,
        window,
    )
    yield Scenario(
        "highway-correlated",
        "the same with e_x and e_y correlated by 0.8 (paper, figure 7)",
        pose(0.5, 0.5, 5.0, correlation=0.8),
        road,
        window,
    )
    yield Scenario(
        "highway-10deg",
        "the same as highway with heading sigma 10 deg (paper, figure 8)",
        pose(0.5, 0.5, 10.0),
        road,
        window,
    )
    yield Scenario(
        "street-turn",
        "straight for 5 m, then a left turn of radius 20 m; heading sigma 5 deg (paper, figure 10)",
        pose(0.5, 0.5, 5.0),
        turn,
        turn_window,
    )
    yield Scenario(
        "street-turn-10deg",
        "the same with heading sigma 10 deg (paper, figure 11)",
        pose(0.5, 0.5, 10.0),
        turn,
        turn_window,
    )
    yield Scenario(
        "production",
        "the highway for a production car: 0.3 m along, 0.1 m across, heading sigma 0.5 deg",
        pose(0.3, 0.1, 0.5),
        road,
        window,
    )


#: The fixed scenarios by name. The paper's text gives the heading sigmas; all else is chosen.
SCENARIOS: dict[str, Scenario] = {scenario.name: scenario for scenario in _scenarios()}


def scenario(name: str) -> Scenario:
    """The scenario of a name.

    >>> scenario("production").ego.sigma.round(4)
    array([0.3   , 0.1   , 0.0087])
    >>> scenario("moon")
    Traceback (most recent call last):
    ...
    ValueError: no scenario 'moon'; there are highway, highway-correlated, highway-10deg, \
street-turn, street-turn-10deg, production
    """
    try:
        return SCENARIOS[name]
    except KeyError:
        raise ValueError(f"no scenario {name!r}; there are {', '.join(SCENARIOS)}") from None


def random_scenarios(n: int, seed: int = 0) -> Iterator[Scenario]:
    """Random roads from motorway to street turn, one line each; the same seed, the same roads.

    A road is a clothoid: its sharpest radius from 15 m to straight
    (log-uniform, either side), its curvature growing or falling by up to that
    much along the view; the view is as long as such a road lets a camera see, at
    most 100 m and at most 70 deg of turn. The line lies up to 6 m aside and up to
    6 deg askew; the pose has sigmas of 0.03 to 1 m in each direction, correlated,
    and 0.05 to 10 deg.
    """
    rng = np.random.default_rng(seed)
    for i in range(n):
        radius = 10 ** rng.uniform(np.log10(15.0), 4.5)
        sharpest = rng.choice([-1.0, 1.0]) / radius
        ahead = min(rng.uniform(30.0, 100.0), np.radians(70.0) * radius)
        behind = min(rng.uniform(0.0, 20.0), ahead / 3)
        count = int(rng.integers(12, 61))
        s = np.linspace(-behind, ahead, count)
        growth = rng.uniform(-1.0, 1.0)
        curvature = sharpest * np.interp(s, [0, ahead], [min(1, 1 - growth), min(1, 1 + growth)])
        points = curve(
            rng.uniform(-6.0, 6.0),
            np.radians(rng.uniform(-6.0, 6.0)),
            curvature,
            s[1] - s[0],
            -behind,
        )
        sigma_x, sigma_y = 10 ** rng.uniform(np.log10(0.03), 0.0, size=2)
        heading_sigma_deg = 10 ** rng.uniform(np.log10(0.05), 1.0)
        ego = pose(sigma_x, sigma_y, heading_sigma_deg, correlation=rng.uniform(-0.9, 0.9))
        line = SceneLine(Slot.EGO_LEFT, Kind.SOLID, Polyline(points))
        yield Scenario(
            f"random-{seed}-{i}", "a random road", ego, (line,), (-behind - 1, ahead + 1)
        )
