from .frame_block import LogFrame as LogFrame
from .keys import key_from_env as key_from_env
from .keys import key_from_file as key_from_file
from .link import Link as Link
from .link import Sent as Sent
from .listener import LineListener as LineListener
from .load import bus_load as bus_load
from .load import frame_bits as frame_bits
from .load import frame_time as frame_time
from .load import transfers_within as transfers_within
from .log_summary import LogReader as LogReader
from .log_summary import LogSummary as LogSummary
from .log_summary import Skipped as Skipped
from .log_writer import LogWriter as LogWriter
from .logs import read_log as read_log
from .receiver import Receiver as Receiver
from .receiver import ReceiverStats as ReceiverStats
from .schedule import Lateness as Lateness
from .signals import SignalDecoder as SignalDecoder
from .signals import SignalLog as SignalLog
from .signals import read_signals as read_signals
from .transmitter import Transmitter as Transmitter
from .transmitter import TransmitterStats as TransmitterStats

__all__: list[str]
