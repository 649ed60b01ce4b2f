"""Localisation: pose of a car from GNSS, odometry, and what it sees of its map.

It may import ``values`` and ``maps``.
"""

from .association import Verdict
from .filter import Localisation, Poses
from .localisation_layer import LocalisationLayer
from .measurements import CameraLines, GnssFix, Odometry, PoseFix, SeenLandmarks
from .odometry_stream import CarLimits
from .sensor_errors import GaussMarkov, SensorErrors
from .step import BlockOutcome

__all__ = [
    "BlockOutcome",
    "CameraLines",
    "CarLimits",
    "GaussMarkov",
    "GnssFix",
    "Localisation",
    "LocalisationLayer",
    "Odometry",
    "PoseFix",
    "Poses",
    "SeenLandmarks",
    "SensorErrors",
    "Verdict",
]
