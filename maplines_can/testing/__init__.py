"""For tests, ours and yours: fault injection, and assertions about lines and their uncertainty.

The fixtures of the pytest plugin are in ``plugin.py``; docs/testing.md tells how to use them.

It may import the product and ``model``.
"""

from .. import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__)
