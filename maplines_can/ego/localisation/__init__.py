"""Localisation: pose of a car from GNSS, odometry, and what it sees of its map."""

from .association import Verdict
from .filter import Localisation, Outcome, Poses
from .localisation_layer import LocalisationLayer
from .measurements import CameraLines, GnssFix, Odometry, PoseFix, SeenLandmarks
from .sensor_errors import GaussMarkov, SensorErrors

__all__ = [
    "CameraLines",
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
