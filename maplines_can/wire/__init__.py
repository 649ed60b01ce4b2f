"""Gaussians of map lines to bytes on a CAN bus, and back, after a DBC."""

from .codec import Codec, Frame
from .decoder import Decoder
from .e2e_state import E2EConfig, E2EState, ProfileStatus
from .layout import Layout, default_dbc_path
from .read import Batch
from .reassembly import Reason
from .secoc import Authenticator, Key, Verifier
from .slot_check import SlotCheck, SlotStats

__all__ = [
    "Authenticator",
    "Batch",
    "Codec",
    "Decoder",
    "E2EConfig",
    "E2EState",
    "Frame",
    "Key",
    "Layout",
    "ProfileStatus",
    "Reason",
    "SlotCheck",
    "SlotStats",
    "Verifier",
    "default_dbc_path",
]
