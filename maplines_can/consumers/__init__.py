"""Consumers of received lines: what a car does with them."""

from .. import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__)
