"""The CAN bus: send lines, receive lines, read logs. The only door to python-can."""

from .frame_block import LogFrame
from .keys import key_from_env, key_from_file
from .link import Link, Sent
from .load import bus_load, frame_bits, frame_time, transfers_within
from .log_summary import LogReader, LogSummary, Skipped
from .log_writer import LogWriter
from .logs import read_log
from .receiver import LineListener, Receiver, ReceiverStats
from .schedule import Lateness
from .signals import SignalDecoder, SignalLog, read_signals
from .transmitter import Transmitter, TransmitterStats

__all__ = [
    "Lateness",
    "LineListener",
    "Link",
    "LogFrame",
    "LogReader",
    "LogSummary",
    "LogWriter",
    "Receiver",
    "ReceiverStats",
    "Sent",
    "SignalDecoder",
    "SignalLog",
    "Skipped",
    "Transmitter",
    "TransmitterStats",
    "bus_load",
    "frame_bits",
    "frame_time",
    "key_from_env",
    "key_from_file",
    "read_log",
    "read_signals",
    "transfers_within",
]
