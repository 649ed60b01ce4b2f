"""Drives, simulated and recorded, and the stated poses of the car on them."""

from .drive import SimulatedDrive, State
from .line_source import Cycle, LineSource
from .localisation import (
    CameraLines,
    CarLimits,
    GaussMarkov,
    GnssFix,
    Localisation,
    LocalisationLayer,
    Odometry,
    PoseFix,
    SeenLandmarks,
    SensorErrors,
)
from .map_frame import check_on_map
from .pose_source import PoseSource
from .recorded import RecordedDrive
from .route_drive import drive_along
from .simulated_localisation import SimulatedLocalisation
from .simulated_sensors import SensorSetup, SimulatedSensors, simulated_measurements

__all__ = [
    "CameraLines",
    "CarLimits",
    "Cycle",
    "GaussMarkov",
    "GnssFix",
    "LineSource",
    "Localisation",
    "LocalisationLayer",
    "Odometry",
    "PoseFix",
    "PoseSource",
    "RecordedDrive",
    "SeenLandmarks",
    "SensorErrors",
    "SensorSetup",
    "SimulatedDrive",
    "SimulatedLocalisation",
    "SimulatedSensors",
    "State",
    "check_on_map",
    "drive_along",
    "simulated_measurements",
]
