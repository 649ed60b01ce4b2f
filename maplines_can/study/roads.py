"""Random roads from motorway to street turn, their lines, and the fit of the paper."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..propagation import MapError, Refit, SigmaPoints
from ..propagation.paths import MAX_TURN
from ..propagation.refit import MAX_MISFIT
from ..simulation.scenarios import Scenario, pose
from ..values.errors import IllPosedError
from ..values.gaussian import Gaussian
from ..values.line import Kind, Slot
from ..values.polyline import Polyline

Array = NDArray[np.float64]

#: Settings with which ``Refit`` fits all of a window, as the paper does: up to 80 deg from the x
#: axis, and without regard to the deviation of the cubic from the line.
PAPER: dict[str, Any] = {"max_misfit": math.inf, "max_turn": math.radians(80.0)}


def paper_refit(
    scenario: Scenario, slot: Slot | None = None, map_error: MapError | None = None
) -> Refit:
    """Return the function from a pose to the lines of a scenario, as the paper fits them.

    Its covariance has the error of the pose (and of the map), as in the paper's figures, but not
    the deviation of the cubic from the line. Lines that are sent are those of ``map_lines``.

    Args:
        scenario: the scenario.
        slot: the line; None for all lines of the scenario.
        map_error: error of the map.

    Raises:
        ValueError: the scenario has no such line.
        IllPosedError: a line is not in the window, or is nearly perpendicular to the x axis.
    """
    if slot is None:
        return Refit(
            list(scenario.lines.values()), scenario.ego.mean, scenario.window, map_error, **PAPER
        )
    if slot not in scenario.lines:
        raise ValueError(
            f"scenario {scenario.name!r} has no line {slot.name}; "
            f"there are {', '.join(each.name for each in scenario.lines)}"
        )
    return Refit(scenario.lines[slot], scenario.ego.mean, scenario.window, map_error, **PAPER)


def curve(
    y_off: float, heading: float, curvature: NDArray[np.float64], spacing: float, ahead_from: float
) -> NDArray[np.float64]:
    """Return (n, 2) points of a line from its curvature as a function of arc length s.

    Args:
        y_off: lateral position of the line at s = 0 [m].
        heading: direction of the line at s = 0 [rad].
        curvature: (n,) curvature at each point [1/m].
        spacing: arc length between two points [m].
        ahead_from: arc length at the first point, 0 or less; s = 0 lies at (0, y_off) [m].
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


def random_scenarios(n: int, seed: int = 0) -> Iterator[Scenario]:
    """Yield random roads from motorway to street turn, with one line each.

    A road is a clothoid. Its smallest radius is from 15 m to nearly straight,
    log-uniform, to either side; its curvature changes along the road by at most
    its largest value. The road ends after 100 m or a turn of 70 deg at most. The
    line starts up to 6 m beside the car and up to 6 deg off its heading. The pose
    has sigmas of 0.03 to 1 m in each direction, correlated, and of 0.05 to 10 deg.

    Args:
        n: number of roads.
        seed: seed of the random numbers; a seed gives the same roads each time.
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
        lines = {Slot.EGO_LEFT: Polyline(points, Kind.SOLID)}
        yield Scenario(f"random-{seed}-{i}", "a random road", ego, lines, (-behind - 1, ahead + 1))


#: Largest number of points of a road.
POINTS = 60
#: Window that contains each road as a whole [m].
WINDOW = (-1e3, 1e3)


class Roads(NamedTuple):
    """N roads of one line each, and the uncertainty of the car's pose at the origin."""

    points: Array  #: (N, POINTS, 2), in the frame of the mean pose [m]
    number: NDArray[np.int64]  #: (N,) number of valid points of each road
    sigma: Array  #: (N, 3) standard deviations of the pose [m, m, rad]
    correlation: Array  #: (N,) of e_x and e_y
    #: (N, 3) sigmas of the map: of each point [m], of the offset [m], of the heading [rad]; or None
    map_error: Array | None


def random_roads(n: int, rng: np.random.Generator, *, with_map_error: bool) -> Roads:
    """Draw n roads from motorway to street turn, as described at ``random_scenarios``.

    With map error, its sigmas are 2 to 20 cm for each point and for the common offset, and
    0.05 deg for the heading.
    """
    radius = 10 ** rng.uniform(np.log10(15.0), 4.5, n)
    sharpest = rng.choice([-1.0, 1.0], n) / radius
    ahead = np.minimum(rng.uniform(30.0, 100.0, n), np.radians(70.0) * radius)
    behind = np.minimum(rng.uniform(0.0, 20.0, n), ahead / 3)
    count = rng.integers(12, POINTS + 1, n)
    growth = rng.uniform(-1.0, 1.0, n)
    y_off, heading = rng.uniform(-6.0, 6.0, n), np.radians(rng.uniform(-6.0, 6.0, n))
    sigma = np.column_stack(
        [
            10 ** rng.uniform(np.log10(0.03), 0.0, (n, 2)),
            np.radians(10 ** rng.uniform(np.log10(0.05), 1.0, n)),
        ]
    )
    correlation = rng.uniform(-0.9, 0.9, n)
    map_error = None
    if with_map_error:
        both = 10 ** rng.uniform(np.log10(0.02), np.log10(0.2), (n, 2))
        map_error = np.column_stack([both, np.full(n, np.radians(0.05))])

    spacing = (ahead + behind) / (count - 1)
    s = spacing[:, None] * np.arange(POINTS) - behind[:, None]
    here, there = np.minimum(1, 1 - growth), np.minimum(1, 1 + growth)
    share = (s / ahead[:, None]).clip(0, 1)
    curvature = sharpest[:, None] * (here[:, None] + (there - here)[:, None] * share)
    points = _curves(y_off, heading, curvature, spacing, behind / spacing)
    return Roads(points, count, sigma, correlation, map_error)


def _curves(y_off: Array, heading: Array, curvature: Array, spacing: Array, place: Array) -> Array:
    """Return (N, P, 2) points as ``scenarios.curve`` does; ``place`` is the index of s = 0."""
    rows = np.arange(len(place))
    middle = (curvature[:, 1:] + curvature[:, :-1]) / 2 * spacing[:, None]  # turn of each step
    turn = np.zeros_like(curvature)
    middle.cumsum(axis=1, out=turn[:, 1:])
    chord = turn[:, :-1] + middle / 2
    points = np.zeros((*curvature.shape, 2))
    steps = spacing[:, None, None] * np.stack([np.cos(chord), np.sin(chord)], axis=-1)
    steps.cumsum(axis=1, out=points[:, 1:])
    first = place.astype(int)
    rest = place - first

    def at_zero(values: Array) -> Array:
        weight = rest.reshape(-1, *[1] * (values.ndim - 2))
        return values[rows, first] * (1 - weight) + values[rows, first + 1] * weight

    points -= at_zero(points)[:, None]
    back = heading - at_zero(turn)
    c, d = np.cos(back)[:, None], np.sin(back)[:, None]
    x, y = points[..., 0], points[..., 1]
    return np.stack([c * x - d * y, d * x + c * y + y_off[:, None]], axis=-1)


def lines_of_roads(
    roads: Roads, *, max_misfit: float = MAX_MISFIT, max_turn: float = MAX_TURN
) -> tuple[Array, Array]:
    """Propagate the pose through the refit of each road, with sigma points.

    Args:
        roads: the roads.
        max_misfit: see ``Refit``.
        max_turn: see ``Refit``.

    Returns:
        (N, 4) means and (N, 4, 4) covariances; NaN where a road is across the car at the mean pose
        or at a sigma point.
    """
    n = len(roads.number)
    mean, cov = np.full((n, 4), np.nan), np.full((n, 4, 4), np.nan)
    transform, at_origin = SigmaPoints(), np.zeros(3)
    poses = np.einsum("ni,nj->nij", roads.sigma, roads.sigma) * np.eye(3)
    poses[:, 0, 1] = poses[:, 1, 0] = roads.correlation * roads.sigma[:, 0] * roads.sigma[:, 1]
    for i in range(n):
        error = None if roads.map_error is None else MapError(*roads.map_error[i])
        line = Polyline(roads.points[i, : roads.number[i]])
        try:
            refit = Refit(line, at_origin, WINDOW, error, max_misfit=max_misfit, max_turn=max_turn)
            mean[i], cov[i] = transform.moments(refit, Gaussian.trusted(at_origin, poses[i]))
        except IllPosedError:
            continue
    return mean, cov
