"""Localisation: pose of a car from GNSS, odometry, and what it sees of its map."""

from .association import Verdict
from .filter import Localisation, Poses
from .localisation_layer import LocalisationLayer
from .measurements import CameraLines, GnssFix, Odometry, PoseFix, SeenLandmarks
from .odometry_stream import CarLimits
from .sensor_errors import GaussMarkov, SensorErrors
from .step import Outcome

__all__ = [
    "CameraLines",
    "CarLimits",
    "GaussMarkov",
    "GnssFix",
    "Localisation",
    "LocalisationLayer",
    "Odometry",
    "Outcome",
    "PoseFix",
    "Poses",
    "SeenLandmarks",
    "SensorErrors",
    "Verdict",
]
