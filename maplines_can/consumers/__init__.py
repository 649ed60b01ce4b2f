"""Consumers of received scenes, with one interface: fusion, steering, plausibility; integrity."""

from .. import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__)
