"""Gaussians of map lines to bytes on a CAN bus, and back, after a DBC."""

from .codec import Batch, Codec, Decoder, Frame
from .layout import Layout, default_dbc_path
from .reassembly import Reason

__all__ = ["Batch", "Codec", "Decoder", "Frame", "Layout", "Reason", "default_dbc_path"]
