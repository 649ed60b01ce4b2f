"""Restbus simulation: the positioning ECU and its neighbours in the test of another device."""

from .config import EXAMPLE, Config, Event
from .simulator import Restbus

__all__ = ["EXAMPLE", "Config", "Event", "Restbus"]
