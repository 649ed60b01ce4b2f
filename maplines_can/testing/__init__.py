"""Fault injection for tests of a receiver: into a stream of frames, or into a python-can bus."""

from .fault_injector import FaultInjector
from .faults import Faults, Interval
from .faulty_bus import FaultyBus
from .faulty_opener import FaultyOpener
from .scripted_fault import FaultKind, ScriptedFault

__all__ = [
    "FaultInjector",
    "FaultKind",
    "Faults",
    "FaultyBus",
    "FaultyOpener",
    "Interval",
    "ScriptedFault",
]
