"""Map lines and their Gaussians as messages on a CAN bus, as a DBC describes them."""

from .codec import CODES, Codec
from .message.dbc_reader import default_dbc_path
from .message.frames import Frame
from .message.layout import Layout
from .message.pose_layout import POSE, Owner
from .message.reader import Batch
from .message.scene_writer import PreparedScene
from .protection.e2e_state import E2EConfig, E2EState, ProfileStatus
from .protection.key import Key
from .protection.secoc import Authenticator, Verifier
from .reasons import Reason
from .reception.decoder import Decoder
from .reception.monitor import Monitor, SceneView, SlotView
from .reception.scenes import ReceivedScene
from .reception.sequence import SequenceCheck, SlotStats

__all__ = [
    "CODES",
    "POSE",
    "Authenticator",
    "Batch",
    "Codec",
    "Decoder",
    "E2EConfig",
    "E2EState",
    "Frame",
    "Key",
    "Layout",
    "Monitor",
    "Owner",
    "PreparedScene",
    "ProfileStatus",
    "Reason",
    "ReceivedScene",
    "SceneView",
    "SequenceCheck",
    "SlotStats",
    "SlotView",
    "Verifier",
    "default_dbc_path",
]
