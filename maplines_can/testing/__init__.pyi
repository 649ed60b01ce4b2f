from .bench import Bench as Bench
from .consistency import Consistency as Consistency
from .consistency import assert_consistent as assert_consistent
from .fault_injector import FaultInjector as FaultInjector
from .faults import Faults as Faults
from .faults import Interval as Interval
from .faulty_bus import FaultyBus as FaultyBus
from .faulty_opener import FaultyOpener as FaultyOpener
from .nodes import ReceivingNode as ReceivingNode
from .nodes import SendingNode as SendingNode
from .protection import Protection as Protection
from .protection import assert_protected as assert_protected
from .scripted_fault import FaultKind as FaultKind
from .scripted_fault import ScriptedFault as ScriptedFault

__all__: list[str]
