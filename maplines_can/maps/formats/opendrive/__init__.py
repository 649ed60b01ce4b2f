"""ASAM OpenDRIVE: reference lines, lane sections and links, evaluated by this package alone."""

from .reader import read

__all__ = ["read"]
