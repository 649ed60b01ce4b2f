"""Nodes on a CAN bus as FMUs: FMI 3.0 co-simulation with FMI-LS-BUS 1.0.

It may import ``values``, ``propagation``, ``wire`` and ``generation``.
"""

from .archive import Fmu, fmu_of, written
from .route import SentRoute

__all__ = ["Fmu", "SentRoute", "fmu_of", "written"]
