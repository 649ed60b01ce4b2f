"""Landmarks of a map: the localisation layer, in which a car finds its pose."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum


class LandmarkKind(StrEnum):
    """Kind of a landmark."""

    POLE = "pole"  #: of a street lamp, or a tree trunk
    SIGN = "sign"  #: traffic sign or traffic light


@dataclass(frozen=True)
class Landmark:
    """A thin upright object beside the road.

    Args:
        id: unique in the map.
        kind: of the object.
        x, y: position in the map frame [m].
    """

    id: str
    kind: LandmarkKind
    x: float
    y: float
