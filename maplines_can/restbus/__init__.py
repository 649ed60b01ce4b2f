"""Restbus simulation: the positioning ECU and its neighbours in the test of another device.

It may import the product, and ``testing`` for faults.
"""

from .config import EXAMPLE, Config, Event
from .simulator import Restbus

__all__ = ["EXAMPLE", "Config", "Event", "Restbus"]
