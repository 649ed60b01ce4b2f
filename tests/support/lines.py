"""Lines for tests: random Gaussians of a motorway, and lines of scenarios."""

from collections.abc import Mapping
from itertools import islice
from typing import Any

import numpy as np

from maplines_can import map_lines


def random_lines(n: Any, seed: Any) -> Any:
    """Return (n, 4) means and (n, 4, 4) covariances, as on a motorway."""
    rng = np.random.default_rng(seed)
    means = rng.uniform(-1, 1, (n, 4)) * [4.0, 0.1, 2e-3, 1e-5]
    root = rng.standard_normal((n, 4, 4)) * np.array([[0.1], [0.01], [3e-4], [1e-5]])
    return means, root @ root.transpose(0, 2, 1)


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
