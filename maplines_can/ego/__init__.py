"""Drives, simulated and recorded, and the stated poses of the car on them."""

from .drive import SimulatedDrive, State
from .map_frame import check_on_map
from .pose_source import PoseSource
from .recorded import RecordedDrive

__all__ = ["PoseSource", "RecordedDrive", "SimulatedDrive", "State", "check_on_map"]
