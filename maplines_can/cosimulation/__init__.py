"""Co-simulation of FMUs that are nodes of a CAN bus: FMI 3.0 with FMI-LS-BUS 1.0.0, low cut."""

from .checks import Finding, check
from .description import Description, read_description
from .runner import CoSimulation

__all__ = ["CoSimulation", "Description", "Finding", "check", "read_description"]
