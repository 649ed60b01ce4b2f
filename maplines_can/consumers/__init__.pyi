from .consumer import Consumer as Consumer
from .consumer import scene_view as scene_view
from .integrity import Level as Level
from .integrity import Tolerance as Tolerance
from .integrity import protection_level as protection_level
from .lane_fusion import FusedLane as FusedLane
from .lane_fusion import LaneFusion as LaneFusion
from .plausibility import CameraBias as CameraBias
from .plausibility import Check as Check
from .plausibility import Outcome as Outcome
from .plausibility import PlausibilityCheck as PlausibilityCheck
from .residual_filter import WHITE_NOISE as WHITE_NOISE
from .residual_filter import CameraNoise as CameraNoise
from .speed_limit import SteeringLimits as SteeringLimits
from .speed_limit import SteeringReason as SteeringReason
from .steering import Command as Command
from .steering import LaneSteering as LaneSteering
from .steering import SteeringState as SteeringState

__all__: list[str]
