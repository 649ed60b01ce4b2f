from .consistency import CameraNoise as CameraNoise
from .integrity import Tolerance as Tolerance
from .integrity import protection_level as protection_level
from .lane_fusion import FusedLane as FusedLane
from .lane_fusion import LaneFusion as LaneFusion
from .plausibility import CameraBias as CameraBias
from .plausibility import PlausibilityCheck as PlausibilityCheck
from .steering import Command as Command
from .steering import LaneSteering as LaneSteering
from .steering import SteeringLimits as SteeringLimits
from .steering import SteeringReason as SteeringReason
from .steering import SteeringState as SteeringState

__all__: list[str]
