"""Lines of a scenario as a sender sends them, and the pose of a car that weaves in its lane."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..propagation import MapError, map_lines, map_scene
from ..propagation.from_map import MAX_SIGMA
from ..values.gaussian import Gaussian
from ..values.line import MapLineList, Slot
from ..values.scene import Scene
from .scenarios import Scenario

#: Speed of the car of a scenario along its road [m/s], and the lateral sine by which it weaves
#: within its lane: amplitude [m] and period [s].
SPEED, AMPLITUDE, SINE_PERIOD = 10.0, 0.3, 10.0


@dataclass(frozen=True)
class ScenarioLines:
    """Source of the lines of a scenario.

    Args:
        scenario: the scenario.
        lines: number of lines, the first of the scenario.
        components: of each line; those of a scene have one.
        correlation_time: of the pose error [s], for a ``Scene`` with the joint covariance of its
            lines; None for lines alone.
        map_error: of the map; None if it is exact.
        max_sigma: largest standard deviation of the lateral position of a line [m].
    """

    scenario: Scenario
    lines: int = 4
    components: int | Mapping[Slot, int] = 1
    correlation_time: float | None = None
    map_error: MapError | None = None
    max_sigma: float = MAX_SIGMA

    def seen_from(self, ego: Gaussian | None = None) -> MapLineList | Scene:
        """Return the lines as seen from a pose; by default, that of the scenario."""
        lines = self.scenario.first_lines(self.lines)
        pose = self.scenario.ego if ego is None else ego
        options: dict[str, Any] = {
            "window": self.scenario.window,
            "map_error": self.map_error,
            "max_sigma": self.max_sigma,
        }
        if self.correlation_time is not None:
            return map_scene(lines, pose, correlation_time=self.correlation_time, **options)
        return map_lines(lines, pose, components=self.components, **options)


def weaving_ego(scenario: Scenario, t: float) -> Gaussian:
    """Return the pose at time t [s] of a car that weaves within its lane at ``SPEED``.

    Its offset to the left is a sine, and its heading relative to the road is the slope of its path.
    The road ahead stays that of the scenario, as it does on a straight or circular road.

    >>> from maplines_can.simulation import scenario
    >>> weaving_ego(scenario("production"), 2.5).mean.round(9)  # at the end to the left
    array([0. , 0.3, 0. ])
    """
    phase = 2 * np.pi * t / SINE_PERIOD
    slope = 2 * np.pi / SINE_PERIOD * AMPLITUDE * np.cos(phase) / SPEED
    offset = [0.0, AMPLITUDE * np.sin(phase), np.arctan(slope)]
    return Gaussian(scenario.ego.mean + offset, scenario.ego.cov)
