r"""Bus of this package between the nodes: without delay, or with bit rates and arbitration.

    node A  --Transmit-->  queue A  \                        /-->  Transmit to B and C
    node B  --Transmit-->  queue B   >  arbitration, frame time
    node C  --Transmit-->  queue C  /                        \-->  Confirm to the sender

It does what FMI-LS-BUS 1.0.0 asks of a bus simulation; errors of the bus are not simulated.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from ..bus import frame_time
from ..wire import Frame
from .bus_operations import (
    ArbitrationLost,
    ArbitrationLostBehavior,
    Configuration,
    Confirm,
    Corrupt,
    FormatError,
    NodeStatus,
    Operation,
    Parameter,
    Status,
    Transmit,
    Wakeup,
)

#: Data bit rate of CAN FD by the nominal one, if no node gives it: as in the other commands.
FD_FACTOR = 4


class Port(Protocol):
    """Where a node is connected to the bus; a ``Channel`` is one."""

    @property
    def label(self) -> str:
        """Name for messages."""

    @property
    def wants_notifications(self) -> bool:
        """Whether the node awaits confirmations and notifications of the bus."""


@dataclass
class _Connection:
    """Node at the bus."""

    port: Port
    queue: deque[Transmit] = field(default_factory=deque)
    bitrate: int = 0  #: that the node has configured; 0 without one
    data_bitrate: int = 0
    behavior: int = ArbitrationLostBehavior.BUFFER_AND_RETRANSMIT
    status: NodeStatus = NodeStatus.ERROR_ACTIVE


class CanBus:
    """Simulated CAN bus.

    Args:
        ports: of the nodes.
        bitrate: nominal bit rate [bit/s]; 0: as the nodes configure it; None: no frame takes time.

    >>> from types import SimpleNamespace
    >>> a, b = (SimpleNamespace(label=name, wants_notifications=True) for name in "ab")
    >>> bus = CanBus([a, b], 500_000)
    >>> bus.accept(a, Transmit(0x123, b"12345678"))
    >>> bus.arbitrate(0)
    >>> bus.next_ns
    270000
    >>> [(port.label, type(operation).__name__) for port, operation in bus.take(270_000)]
    [('b', 'Transmit'), ('a', 'Confirm')]
    """

    def __init__(self, ports: Sequence[Port], bitrate: int | None = None) -> None:
        self._nodes = {id(port): _Connection(port) for port in ports}
        self._bitrate = bitrate
        self._sending: tuple[_Connection | None, Transmit] | None = None
        self._done_ns: int | None = None  #: end of the frame on the bus
        self._answers: list[tuple[Port, Operation]] = []
        self._foreign: deque[Transmit] = deque()
        self._transmitted: list[Transmit] = []
        self.problems: Counter[str] = Counter()  #: what nodes did wrong, and how often
        self.busy_ns = 0  #: time that frames took

    @property
    def next_ns(self) -> int | None:
        """Time at which `take` returns something; None if nothing is under way."""
        return 0 if self._answers else self._done_ns

    def accept(self, port: Port | None, operation: Operation) -> None:
        """Take an operation of a node; with no port, a frame that is of none of them."""
        node = None if port is None else self._nodes[id(port)]
        match operation:
            case Transmit():
                self._accept_frame(node, operation)
            case Configuration(parameter, value) if node is not None:
                self._configure(node, parameter, value)
            case Status(status) if node is not None:
                node.status = status
            case Wakeup():
                others = [one for one in self._nodes.values() if one is not node]
                self._answers += [(one.port, operation) for one in others]
            case Corrupt(data, reason) if port is not None:
                self.problems[f"{port.label}: {reason}"] += 1
                self._answers.append((port, FormatError(data)))

    def arbitrate(self, now_ns: int) -> None:
        """Let the nodes arbitrate for the bus if it is idle: after `accept` of all at this time."""
        while self._sending is None:
            waiting = [node for node in self._nodes.values() if node.queue]
            heads: list[tuple[_Connection | None, Transmit]] = [(n, n.queue[0]) for n in waiting]
            heads += [(None, frame) for frame in list(self._foreign)[:1]]
            if not heads:
                return
            winner, frame = min(heads, key=_priority)
            duration = self._duration_ns(frame)
            if duration is None:  # a node may still configure the bit rate
                return
            (self._foreign if winner is None else winner.queue).popleft()
            for node in waiting:
                if (
                    node is not winner
                    and node.behavior == ArbitrationLostBehavior.DISCARD_AND_NOTIFY
                ):
                    lost = node.queue.popleft()
                    self._answers.append((node.port, ArbitrationLost(lost.can_id)))
            if self._bitrate is None:
                self._deliver(winner, frame)
            else:
                self._sending, self._done_ns = (winner, frame), now_ns + duration
                self.busy_ns += duration

    def take(self, now_ns: int) -> list[tuple[Port, Operation]]:
        """Return what the nodes receive at this time."""
        if self._sending is not None and self._done_ns is not None and self._done_ns <= now_ns:
            sender, frame = self._sending
            self._sending = self._done_ns = None
            self._deliver(sender, frame)
        out, self._answers = self._answers, []
        return out

    def transmitted(self) -> list[Transmit]:
        """Return the frames whose transmission ended since the last call."""
        out, self._transmitted = self._transmitted, []
        return out

    def _accept_frame(self, node: _Connection | None, frame: Transmit) -> None:
        if node is None:
            self._foreign.append(frame)
        elif node.status is NodeStatus.BUS_OFF:
            self.problems[f"{node.port.label}: sends a frame while it is bus-off"] += 1
        else:
            node.queue.append(frame)

    def _configure(self, node: _Connection, parameter: Parameter, value: int) -> None:
        if parameter is Parameter.CAN_BAUDRATE:
            node.bitrate = value
        elif parameter is Parameter.CAN_FD_BAUDRATE:
            node.data_bitrate = value
        elif parameter is Parameter.ARBITRATION_LOST_BEHAVIOR:
            node.behavior = value
        rates = {one.bitrate for one in self._nodes.values()} - {0}
        if self._bitrate is not None and len(rates | ({self._bitrate} - {0})) > 1:
            listed = ", ".join(map(str, sorted(rates | ({self._bitrate} - {0}))))
            self.problems[f"different bit rates: {listed} bit/s"] += 1

    def _duration_ns(self, frame: Transmit) -> int | None:
        """Return the time of a frame on the bus; None before a bit rate is known."""
        if self._bitrate is None:
            return 0
        nodes = list(self._nodes.values())
        bitrate = self._bitrate or max((node.bitrate for node in nodes), default=0)
        if not bitrate:
            return None
        data_bitrate = max((node.data_bitrate for node in nodes), default=0) or FD_FACTOR * bitrate
        data = b"" if frame.is_remote else frame.data
        sent = Frame(frame.can_id, data, frame.is_fd, frame.is_extended)
        fast = data_bitrate if frame.bit_rate_switch else bitrate
        return round(frame_time(sent, bitrate, fast) * 1e9)

    def _deliver(self, sender: _Connection | None, frame: Transmit) -> None:
        receivers = [
            node
            for node in self._nodes.values()
            if node is not sender and node.status is not NodeStatus.BUS_OFF
        ]
        self._transmitted.append(frame)
        self._answers += [(node.port, frame) for node in receivers]
        if sender is not None and receivers and sender.port.wants_notifications:
            self._answers.append((sender.port, Confirm(frame.can_id)))


def _priority(head: tuple[_Connection | None, Transmit]) -> tuple[bool, int, bool, int, bool]:
    """Return what decides the arbitration; the least wins.

    A standard ID wins over an extended one with the same first 11 bits, and data over a request.
    """
    node, frame = head
    is_passive = node is not None and node.status is NodeStatus.ERROR_PASSIVE
    base, rest = frame.can_id, 0
    if frame.is_extended:
        base, rest = frame.can_id >> 18, frame.can_id & 0x3FFFF
    return is_passive, base, frame.is_extended, rest, frame.is_remote
