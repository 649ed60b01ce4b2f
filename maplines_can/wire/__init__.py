"""Gaussians of map lines to bytes on a CAN bus, and back, after a DBC."""

from .codec import Codec, Frame
from .decoder import Decoder
from .layout import Layout, default_dbc_path
from .read import Batch
from .reassembly import Reason

__all__ = ["Batch", "Codec", "Decoder", "Frame", "Layout", "Reason", "default_dbc_path"]
