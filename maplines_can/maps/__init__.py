"""Maps: lanes with their boundary lines, from files of several formats."""

from .load import load
from .model import Lane, LaneType, Map, Road, Skipped

__all__ = ["Lane", "LaneType", "Map", "Road", "Skipped", "load"]
