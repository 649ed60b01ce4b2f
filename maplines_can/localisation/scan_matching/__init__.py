"""Scan matching: pose of a car from a lidar scan and the surfaces of its map.

It may import ``values``, ``maps`` and ``localisation``.
"""

from .icp import match_icp
from .match import ScanMatch
from .ndt import match_ndt
from .reference import ScanReference, simulated_scan

__all__ = ["ScanMatch", "ScanReference", "match_icp", "match_ndt", "simulated_scan"]
