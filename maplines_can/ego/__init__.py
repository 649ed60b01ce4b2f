"""Drives, simulated and recorded, and the stated poses of the car on them."""

from .drive import SimulatedDrive, State
from .line_source import Cycle, LineSource
from .map_frame import check_on_map
from .pose_source import PoseSource
from .recorded import RecordedDrive
from .route_drive import drive_along

__all__ = [
    "Cycle",
    "LineSource",
    "PoseSource",
    "RecordedDrive",
    "SimulatedDrive",
    "State",
    "check_on_map",
    "drive_along",
]
