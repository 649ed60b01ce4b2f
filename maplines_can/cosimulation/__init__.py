"""Co-simulation of FMUs that are nodes of a CAN bus: FMI 3.0 with FMI-LS-BUS 1.0.0, low cut.

It may import ``values``, ``wire``, ``bus`` and, for faults, ``testing``.
"""

from .. import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__)
