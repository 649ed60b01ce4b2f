"""Fault injection for tests of a receiver: with a python-can bus around any other, or without a bus."""

from .fault_injector import FaultInjector
from .faults import Action, FaultKind, Faults
from .faulty_bus import FaultyBus, FaultyOpener

__all__ = ["Action", "FaultInjector", "FaultKind", "Faults", "FaultyBus", "FaultyOpener"]
