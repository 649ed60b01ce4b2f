"""Raw values of signals of a pose error, for tests."""

from typing import Any

import numpy as np
from scene_layouts import pose_layout_of

POSE = pose_layout_of("maplines-pose.dbc")
POSE_NAMES = [
    *(name for name in POSE.signals if name.startswith(("Pivot", "Ratio", "Inflation"))),
    *("CorrelationTime", "MapOffset", "MapHeading"),
]
#: Covariance of a production pose: 0.1 m, 0.2 m and 0.2 deg.
PRODUCTION = np.diag([0.1, 0.2, np.radians(0.2)]) ** 2


def any_bits(layout: Any, names: Any, rng: Any) -> dict[str, int]:
    """Raw values of signals, whatever they are; half of them are at an end, or 0."""
    return {
        name: int(rng.choice([*layout[name].all_raw, 0]))
        if rng.random() < 0.5
        else int(rng.integers(*layout[name].all_raw, endpoint=True))
        for name in names
    }
