"""The fit of the paper, for the scenarios of the paper."""

from __future__ import annotations

import math
from typing import Any

from ..propagation import MapError, Refit
from ..simulation.scenarios import Scenario
from ..values.line import Slot

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
