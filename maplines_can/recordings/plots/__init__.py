"""Plots of recordings: bands over time, the lane from above, states and rejects.

It may import ``values``, ``wire``, ``logs`` and ``recordings``.
"""

from .bokeh_page import write_page
from .log_panels import Panel, Recording, panels_of, recorded
from .matplotlib_picture import write_picture

__all__ = ["Panel", "Recording", "panels_of", "recorded", "write_page", "write_picture"]
