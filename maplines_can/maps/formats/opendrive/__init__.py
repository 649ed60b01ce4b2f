"""ASAM OpenDRIVE: reference lines, lane sections and links, evaluated by this package alone.

It may import ``values`` and ``maps``.
"""

from .reader import read

__all__ = ["read"]
