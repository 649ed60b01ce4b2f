"""Lines of scenarios, for tests."""

from collections.abc import Mapping
from itertools import islice
from typing import Any

from maplines_can import map_lines


def scenario_lines(scenario: Any, lines: int = 4, **settings: Any) -> Any:
    """Return the first lines of a scenario as ``map_lines`` does, with its settings."""
    first = dict(islice(scenario.lines.items(), lines))
    return map_lines(first, scenario.ego, window=scenario.window, **settings)


def lines_timed_out(counts: Mapping[str, int], pending: int, frames: int) -> int:
    """Return how many lines a receiver dropped by the time-out of their transfers.

    A machine that does not run the sender for half a cycle between the frames of a line causes
    that. Tests allow it, and nothing else, so that they do not depend on the load.

    Args:
        counts: dropped frames by the name of the reason.
        pending: frames of incomplete transfers.
        frames: frames of a line.
    """
    return (counts.get("TIMEOUT", 0) + pending) // frames
