from ..logs.frame_block import LogFrame as LogFrame
from ..logs.log_reader import read_log as read_log
from ..logs.log_summary import LogReader as LogReader
from ..logs.log_summary import LogSummary as LogSummary
from ..logs.log_summary import Skipped as Skipped
from ..logs.log_writer import LogWriter as LogWriter
from ..logs.signal_log import SignalDecoder as SignalDecoder
from ..logs.signal_log import SignalLog as SignalLog
from ..logs.signal_log import read_signals as read_signals
from .frame_timing import bus_load as bus_load
from .frame_timing import frame_bits as frame_bits
from .frame_timing import frame_time as frame_time
from .frame_timing import transfers_within as transfers_within
from .keys import key_from_env as key_from_env
from .keys import key_from_file as key_from_file
from .link import Link as Link
from .link import Sent as Sent
from .listener import LineListener as LineListener
from .receiver import Receiver as Receiver
from .receiver import ReceiverStats as ReceiverStats
from .schedule import Lateness as Lateness
from .transmitter import Transmitter as Transmitter
from .transmitter import TransmitterStats as TransmitterStats

__all__: list[str]
