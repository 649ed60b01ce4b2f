"""Map lines and their Gaussians as messages on a CAN bus, as a DBC describes them.

It may import ``core``, ``values`` and ``dbc_files``.
"""

from ..dbc_files.parser import SHIPPED, default_dbc_path
from .batch import Batch, BatchCodec
from .codec import Codec, LineCodec
from .core_tables import CODES
from .encoder import Encoder
from .frames import Frame
from .layout.message_layout import Layout
from .layout.pose_layout import POSE, SCENE, SCENE2, Owner, SceneOwner
from .protection.e2e_state import E2EConfig, E2EState, ProfileStatus
from .protection.key import Key
from .protection.secoc import Authenticator, Verifier
from .reception.check import Check, Reason, SlotStats
from .reception.decoder import Decoder, ReceivedFrame
from .reception.views import ReceivedScene, SceneView, SlotView
from .scene_writer import PreparedScene

__all__ = [
    "CODES",
    "POSE",
    "SCENE",
    "SCENE2",
    "SHIPPED",
    "Authenticator",
    "Batch",
    "BatchCodec",
    "Check",
    "Codec",
    "Decoder",
    "E2EConfig",
    "E2EState",
    "Encoder",
    "Frame",
    "Key",
    "Layout",
    "LineCodec",
    "Owner",
    "PreparedScene",
    "ProfileStatus",
    "Reason",
    "ReceivedFrame",
    "ReceivedScene",
    "SceneOwner",
    "SceneView",
    "SlotStats",
    "SlotView",
    "Verifier",
    "default_dbc_path",
]
