"""Plots of recordings: bands over time, the lane from above, states and rejects."""

from .page import write_page
from .panels import Panel, Recording, panels_of, recorded
from .picture import write_picture

__all__ = ["Panel", "Recording", "panels_of", "recorded", "write_page", "write_picture"]
