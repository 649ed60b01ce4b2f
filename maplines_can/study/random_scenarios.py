"""Random scenarios, from motorway to street turn."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..simulation.scenarios import Scenario, pose
from ..values.line import Kind, Slot
from ..values.polyline import Polyline


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
