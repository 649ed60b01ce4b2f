"""Simulation: scenarios, drives and their truth, the pose that a car knows, and its sensors.

It may import ``values``, ``propagation``, ``wire``, ``bus``, ``maps``, ``localisation``
and, for faults, ``testing``.
"""

from .. import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__)
