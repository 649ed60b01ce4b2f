"""Fault injection for tests of a receiver: into a stream of frames, or into a python-can bus."""

from .fault_injector import FaultInjector
from .faults import FaultKind, Faults, Interval, ScriptedFault
from .faulty_bus import FaultyBus, FaultyOpener

__all__ = [
    "FaultInjector",
    "FaultKind",
    "Faults",
    "FaultyBus",
    "FaultyOpener",
    "Interval",
    "ScriptedFault",
]
