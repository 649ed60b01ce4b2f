"""The CAN bus: send lines, receive lines, read logs. The only door to python-can."""

from .link import Link, Sent
from .load import bursts_within, bus_load, frame_bits, frame_time
from .logs import LogFrame, read_log
from .receiver import Receiver, ReceiverStats
from .timing import Lateness
from .transmitter import Transmitter, TransmitterStats

__all__ = [
    "Lateness",
    "Link",
    "LogFrame",
    "Receiver",
    "ReceiverStats",
    "Sent",
    "Transmitter",
    "TransmitterStats",
    "bursts_within",
    "bus_load",
    "frame_bits",
    "frame_time",
    "read_log",
]
