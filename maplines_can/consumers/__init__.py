"""Consumers of received scenes, with one interface: fusion, steering, plausibility; integrity.

It may import ``values``, ``propagation`` and ``wire``.
"""

from .. import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__)
