from .checks import Finding as Finding
from .checks import check as check
from .fmu_description import Description as Description
from .fmu_description import read_description as read_description
from .runner import CoSimulation as CoSimulation

__all__: list[str]
