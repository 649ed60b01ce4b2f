"""Consumers of received lines: what a car does with them."""

from .lane_fusion import FusedLane, LaneFusion

__all__ = ["FusedLane", "LaneFusion"]
