"""Simulation: scenarios, drives and their truth, the pose that a car knows, and its sensors."""

from .. import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__)
