"""The simulation of lane fusion on a straight road, and the ways to fuse."""

from typing import Any

import numpy as np
import pytest
from evidence.drive_view import DriveView
from evidence.fusion import RIGHT, WRONG, Fused, Simulation

from maplines_can.simulation.camera import Errors
from maplines_can.simulation.trajectory import CarState

CARS = 40


def straight(n: int = 100, dt: float = 0.2, speed: float = 15.0) -> DriveView:
    """A straight road whose lines the receiver knows exactly but for the stated errors."""
    t = np.asarray(dt * np.arange(n), dtype=float)
    pose = np.column_stack([speed * t, np.zeros(n), np.zeros(n)])
    lines = np.tile([[1.75, 0, 0, 0], [-1.75, 0, 0, 0]], (n, 1, 1))
    e = Errors()
    own = np.square([e.map_offset, e.map_heading, 0, 0]) + np.square(e.map_local)
    return DriveView(
        CarState(t, pose, np.full(n, speed), np.zeros(n)),
        lines,
        np.tile([-20.0, 80.0], (n, 2, 1)),
        np.tile([[1.75] * 3, [-1.75] * 3], (n, 1, 1)),
        np.ones((n, 3), dtype=bool),
        np.tile(np.diag(np.tile(own, 2)), (n, 1, 1)),
        lines,
    )


def nees(way: str, time: float) -> Any:
    error, sigma = Simulation(straight(), time, CARS, seed=2).run(Fused(CARS, way))
    assert np.sqrt(np.nanmean(error[..., 0] ** 2)) < 0.15
    return np.nanmean((error / sigma) ** 2, axis=(0, 1))


@pytest.mark.parametrize("time", [1.0, 30.0])
@pytest.mark.parametrize("way", RIGHT)
def test_the_right_ways_are_not_overconfident(way: str, time: float) -> None:
    """Up to the upper bound for 40 cars."""
    found = nees(way, time)
    assert (found < 1.5).all()
    assert (found > 0.55).all()


def test_independent_cycles_are_overconfident() -> None:
    assert nees(*WRONG, 30.0).max() > 3
