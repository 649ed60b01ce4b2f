"""Error of a map: the line-specific part of it, whatever the pose is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, slots=True)
class MapError:
    """Standard deviations of the errors of the map points.

    Published errors of the lane geometry of HD maps are 5 to 20 cm (Liu, Wang, Zhang
    2020, tables 3, 5 and 6). Some are common to a section of a road, some are local.

    Args:
        point_sigma: independent error of each map point, in any direction [m]. What the points
            show of it counts, if that is more.
        offset_sigma: common offset of all points of a line, in any direction [m].
        heading_sigma: common rotation of all points of a line about the car [rad].

    Raises:
        ValueError: a value is negative or not finite.
    """

    point_sigma: float = 0.0
    offset_sigma: float = 0.0
    heading_sigma: float = 0.0

    def __post_init__(self) -> None:
        for name in ("point_sigma", "offset_sigma", "heading_sigma"):
            if not 0 <= getattr(self, name) < np.inf:
                raise ValueError(
                    f"{name} must be 0 or more and finite, got {getattr(self, name)!r}"
                )
