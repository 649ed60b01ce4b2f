"""The CAN bus: send lines, receive lines, read logs. The only door to python-can."""

from .fault_plan import Action, Faults, Mishap
from .faulty import FaultyBus
from .keys import key_from_env, key_from_file
from .link import Link, Sent
from .load import bursts_within, bus_load, frame_bits, frame_time
from .logs import LogFrame, read_log
from .mischief import Mischief
from .monitor import Monitor, SlotView
from .receiver import Receiver, ReceiverStats
from .timing import Lateness
from .transmitter import Transmitter, TransmitterStats

__all__ = [
    "Action",
    "Faults",
    "FaultyBus",
    "Lateness",
    "Link",
    "LogFrame",
    "Mischief",
    "Mishap",
    "Monitor",
    "Receiver",
    "ReceiverStats",
    "Sent",
    "SlotView",
    "Transmitter",
    "TransmitterStats",
    "bursts_within",
    "bus_load",
    "frame_bits",
    "frame_time",
    "key_from_env",
    "key_from_file",
    "read_log",
]
