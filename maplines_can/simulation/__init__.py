"""Simulation: scenarios, drives of a car on a map, its sensors, and its errors."""

from .. import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__)
