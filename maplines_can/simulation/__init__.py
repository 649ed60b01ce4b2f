"""Simulation: scenarios, drives with their truth and accuracy, the pose and the sensors of a car.

It may import ``values``, ``propagation``, ``wire``, ``bus``, ``maps``, ``localisation``
and, for faults, ``testing``.
"""

from .. import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__)
