from ..values.errors import DriveFileError as DriveFileError
from .along_route import drive_along as drive_along
from .pose_source import PoseSource as PoseSource
from .recorded import RecordedDrive as RecordedDrive
from .scenarios import SCENARIOS as SCENARIOS
from .scenarios import STREETS as STREETS
from .scenarios import Scenario as Scenario
from .scenarios import scenario as scenario
from .sensors import SensorSetup as SensorSetup
from .sensors import SimulatedSensors as SimulatedSensors
from .simulated_localisation import SimulatedLocalisation as SimulatedLocalisation
from .street_shapes import Street as Street
from .street_shapes import StreetPiece as StreetPiece
from .trajectory import CarState as CarState
from .trajectory import SimulatedDrive as SimulatedDrive

__all__: list[str]
