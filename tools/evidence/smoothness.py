"""How smooth lines of a map are in the pose: a car moves in steps of 1 cm, and nothing may jump.

A place of the cubic 0, 20 and 40 m ahead of the car is fixed in the frame of the map. After the
next step, the lateral position of the new cubic beside it is compared with it, in the standard
deviation that is stated, and so is this standard deviation with the one before.

jump        of the lateral position: 99.9 % and the largest of all steps [sigma]
sigma       the same of the standard deviation [its own share]
x_max       largest change of x_max over the step [m]
lost        times that a line is not given but was after the last step, of all steps
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from maplines_can import Gaussian, MapError, Polyline, Slot, map_lines
from maplines_can.values.line import lateral, lateral_jacobian

from .harness import bar, evidence
from .sampled_lines import LANE, Case, Row, cases_of
from .sharpness import EGO, sampled, sources
from .witness import Array

#: Step of the car [m], and how far ahead the places are [m].
STEP, PLACES = 0.01, (0.0, 20.0, 40.0)
ROWS = (
    Row(1.0),
    Row(5.0),
    Row(10.0),
    Row(15.0),
    Row(2.0, 0.05),
    Row(2.0, 0.05, stated="points"),
    Row(5.0, 0.05),
    Row(5.0, 0.05, stated="points"),
    Row(10.0, 0.05, stated="points"),
    Row(0.0, tolerance=0.05),
)


@evidence(n=1, length=0.5, roads=("arc of 200 m", "clothoid"))
def smoothness(
    n: int = 5,
    length: float = 5.0,
    maps: tuple[str, ...] = (),
    roads: tuple[str, ...] = ("arc of 200 m", "straight of 40 m, arc of 150 m", "clothoid"),
    seed: int = 2,
) -> dict[str, Any]:
    """Compare lines of map_lines with those after a step of 1 cm.

    Args:
        n: drives on each road and map, with the two lines of a lane each.
        length: of a drive [m].
        maps: folders and files of maps.
        roads: with closed forms; an empty text for none.
        seed: of the cases and of the errors.
    """
    groups = sources(maps, roads)
    result: dict[str, Any] = {}
    with bar(len(groups) * len(ROWS), "smoothness") as shown:
        for place, (name, draw) in enumerate(groups.items()):
            cases = cases_of(draw, n, [seed, place])
            for row in ROWS:
                found = []
                for number, case in enumerate(cases):
                    points = sampled(case, row, np.random.default_rng([seed, number]))
                    found.append(Drive(points, path(case, length), row.error))
                result.setdefault(str(row), {})[name] = figures(found)
                shown.update()
    return result


def path(case: Case, length: float) -> Array:
    """Return (T, 3) poses in steps of ``STEP`` along a smooth curve in the middle of the lane."""
    x = np.arange(-2.0, length + 2.0, 0.25)
    middle = np.polynomial.Polynomial.fit(x, np.mean([case[slot].y(x) for slot in LANE], axis=0), 3)
    at = np.arange(0.0, length, STEP)
    return np.column_stack([at, middle(at), np.arctan(middle.deriv()(at))])


class Drive:
    """Lines from poses along a path, and how they change from pose to pose."""

    def __init__(self, points: dict[Slot, Polyline], poses: Array, error: MapError | None) -> None:
        shape = len(poses), len(LANE)
        self.poses = poses
        self.means, self.covs = np.full((*shape, 4), np.nan), np.full((*shape, 4, 4), np.nan)
        self.ranges = np.full((*shape, 2), np.nan)
        for t, pose in enumerate(poses):
            for line in map_lines(points, Gaussian(pose, EGO.cov), map_error=error):
                i = LANE.index(line.slot)
                self.means[t, i], self.covs[t, i] = line.gaussian.mean, line.gaussian.cov
                self.ranges[t, i] = line.x_min, line.x_max

    @property
    def lost(self) -> Array:
        """Whether lines are not there after a step, but were before."""
        there = np.isfinite(self.means[..., 0])
        return np.asarray(there[:-1] & ~there[1:])

    @property
    def x_max_changes(self) -> Array:
        """Absolute changes of x_max over the steps in the frame of the map [m]."""
        return np.abs(np.diff(self.ranges[..., 1], axis=0))

    def jumps(self, x: float) -> tuple[Array, Array]:
        """Return the changes of y in sigmas, and the relative ones of sigma, x ahead of the car."""
        old = np.stack([np.full(self.means.shape[:2], x), lateral(self.means, x)], axis=-1)[:-1]
        here, there = self.poses[:-1, None], self.poses[1:, None]
        world = turned(old, here[..., 2]) + here[..., :2]
        new = turned(world - there[..., :2], -there[..., 2])
        u, v = np.moveaxis(new, -1, 0)
        change = (lateral(self.means[1:], u) - v) / self.sigma(1, u)
        growth = self.sigma(1, u) / self.sigma(0, np.full_like(u, x)) - 1
        return np.abs(change), np.abs(growth)

    def sigma(self, begin: int, x: Array) -> Array:
        """Return the sigmas of y at (T - 1, L) x from a pose on; NaN beyond the range."""
        own = slice(begin, begin + len(x))
        J = lateral_jacobian(self.means[own], x)
        sigma = np.sqrt(np.einsum("tli,tlij,tlj->tl", J, self.covs[own], J))
        low, high = np.moveaxis(self.ranges[own], -1, 0)
        return np.where((x >= low) & (x <= high), sigma, np.nan)


def turned(points: Array, angle: Array) -> Array:
    """Return (..., 2) points turned by (...) angles [rad]."""
    u, v = np.moveaxis(points, -1, 0)
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([c * u - s * v, s * u + c * v], axis=-1)


def figures(drives: Sequence[Drive]) -> dict[str, Any]:
    """Return the figures of drives by name."""
    found: dict[str, Any] = {}
    for x in PLACES:
        pairs = zip(*(drive.jumps(x) for drive in drives), strict=True)
        for name, many in zip(("jump", "sigma"), pairs, strict=True):
            values = np.concatenate([own[np.isfinite(own)] for own in many])
            if values.size:
                found[f"{name} at {x:g} m, 99.9 %"] = float(np.quantile(values, 0.999))
                found[f"{name} at {x:g} m, max"] = float(values.max())
    found["x_max [m]"] = float(max(np.nanmax(drive.x_max_changes, initial=0.0) for drive in drives))
    found["lost"] = float(np.mean([drive.lost for drive in drives]))
    return found
