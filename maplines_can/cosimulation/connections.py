"""How nodes are connected: by the bus of this package, or by an FMU that simulates the bus.

Faults are injected into the frames that the nodes send, before the bus; the frames that the bus
delivers are recorded. Operations that are no frames have no faults.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from ..values.errors import FmuError
from .bus import CanBus
from .bus_operations import Confirm, Corrupt, Operation, Transmit
from .node import Channel, Node

if TYPE_CHECKING:
    from ..testing import FaultInjector

#: What a channel receives.
Delivery = tuple[Channel, list[Operation]]
#: Records a frame at a time [s].
Record = Callable[[Transmit, float], None]


class SentFrame(NamedTuple):
    """Frame on its way from a node to the bus, in the form that the fault injector takes."""

    can_id: int
    data: bytes
    is_fd: bool = False
    is_extended: bool = False
    frame: Transmit | None = None  #: the original; None if it is of a flood
    sender: Channel | None = None

    def transmitted(self) -> Transmit:
        """Return the frame with the faults that it got."""
        original = self.frame or Transmit(0, b"")
        return original._replace(
            can_id=self.can_id, data=self.data, is_fd=self.is_fd, is_extended=self.is_extended
        )


class Link(ABC):
    """Connection of channels.

    Args:
        channels: of the nodes.
        injector: injects faults into sent frames; None for none.
        record: called with each frame that the bus delivers.
    """

    def __init__(
        self,
        channels: Sequence[Channel],
        injector: FaultInjector[SentFrame] | None,
        record: Record,
    ) -> None:
        self.channels = channels
        self._injector, self._record = injector, record
        self.sent: Counter[str] = Counter()  #: frames by the channel that sent them
        self.received: Counter[str] = Counter()  #: frames by the channel that received them
        self.confirmed: Counter[str] = Counter()  #: confirmations by the channel that received them
        self.problems: Counter[str] = Counter()  #: what nodes did wrong, and how often
        self.frames = 0  #: delivered by the bus
        if injector is not None:
            injector.start(0.0)

    @property
    def next_ns(self) -> int | None:
        """Earliest time at which `take` has something to return; None if nothing is under way."""
        due = math.inf if self._injector is None else self._injector.next_due
        times = [] if due == math.inf else [_ns_of(due)]
        return min([*times, *self._own_times()], default=None)

    def accept(self, channel: Channel, operations: Sequence[Operation], now_ns: int) -> None:
        """Take what a channel sends at a time."""
        for operation in operations:
            if not isinstance(operation, Transmit):
                self._forward(channel, operation)
                continue
            self.sent[channel.label] += 1
            if self._injector is None:
                self._forward(channel, operation)
                continue
            frame = SentFrame(*operation[:4], operation, channel)
            for passed in self._injector.apply(frame, now_ns / 1e9):
                self._forward(passed.sender, passed.transmitted())

    def take(self, now_ns: int) -> list[Delivery]:
        """Return what the channels receive at a time."""
        if self._injector is not None:
            while self._injector.next_due <= now_ns / 1e9:
                for passed in self._injector.due(now_ns / 1e9):
                    self._forward(passed.sender, passed.transmitted())
        deliveries = self._deliveries(now_ns)
        for channel, operations in deliveries:
            for operation in operations:
                self.received[channel.label] += isinstance(operation, Transmit)
                self.confirmed[channel.label] += isinstance(operation, Confirm)
        return deliveries

    def rest(self, now_ns: int) -> None:  # noqa: B027 - most links have nothing to do
        """Go on when all nodes have sent what they send at this time."""

    @abstractmethod
    def _forward(self, sender: Channel | None, operation: Operation) -> None:
        """Pass an operation on; the sender is None for a frame of a flood."""

    @abstractmethod
    def _deliveries(self, now_ns: int) -> list[Delivery]:
        """Return what the channels receive at a time."""

    @abstractmethod
    def _own_times(self) -> list[int]:
        """Return the times at which the link has something to deliver."""

    def _record_frame(self, frame: Transmit, now_ns: int) -> None:
        self.frames += 1
        self._record(frame, now_ns / 1e9)


class BusLink(Link):
    """Nodes at a bus of this package; see ``CanBus`` for the bit rate."""

    def __init__(
        self,
        nodes: Sequence[Node],
        bitrate: int | None,
        injector: FaultInjector[SentFrame] | None,
        record: Record,
    ) -> None:
        channels = [channel for node in nodes for channel in node.channels]
        super().__init__(channels, injector, record)
        self.bus = CanBus(channels, bitrate)
        self.problems = self.bus.problems
        self._by_id = {id(channel): channel for channel in channels}

    def rest(self, now_ns: int) -> None:
        """Let the nodes arbitrate."""
        self.bus.arbitrate(now_ns)

    def _forward(self, sender: Channel | None, operation: Operation) -> None:
        self.bus.accept(sender, operation)

    def _own_times(self) -> list[int]:
        return [] if self.bus.next_ns is None else [self.bus.next_ns]

    def _deliveries(self, now_ns: int) -> list[Delivery]:
        by_channel: dict[int, list[Operation]] = {}
        for port, operation in self.bus.take(now_ns):
            by_channel.setdefault(id(port), []).append(operation)
        for frame in self.bus.transmitted():
            self._record_frame(frame, now_ns)
        return [(self._by_id[key], operations) for key, operations in by_channel.items()]


class SimulatedBusLink(Link):
    """Nodes at an FMU that simulates the bus: the first node at its first terminal, and so on.

    A frame of a flood comes from the first node, as if that sent too much.

    Raises:
        FmuError: the FMU has not enough terminals.
    """

    def __init__(
        self,
        nodes: Sequence[Node],
        simulation: Node,
        injector: FaultInjector[SentFrame] | None,
        record: Record,
    ) -> None:
        channels = [channel for node in nodes for channel in node.channels]
        super().__init__(channels, injector, record)
        if len(self.channels) > len(simulation.channels):
            raise FmuError(
                f"{simulation.name} has {len(simulation.channels)} terminals for nodes, and "
                f"{len(self.channels)} are to be connected; use fewer FMUs, or leave out "
                f"{simulation.name}: the bus of this package takes any number"
            )
        pairs = list(zip(self.channels, simulation.channels, strict=False))
        self._peers = {id(channel): there for channel, there in pairs}
        self._peers |= {id(there): channel for channel, there in pairs}
        self._of_bus = {id(there) for _, there in pairs}
        self._mail: list[tuple[Channel, Operation]] = []

    def accept(self, channel: Channel, operations: Sequence[Operation], now_ns: int) -> None:
        """Take what a channel of a node or of the bus simulation sends at a time."""
        if id(channel) not in self._of_bus:
            super().accept(channel, operations, now_ns)
            return
        peer = self._peers[id(channel)]
        self._mail += [(peer, operation) for operation in operations]

    def _forward(self, sender: Channel | None, operation: Operation) -> None:
        source = self.channels[0] if sender is None else sender
        if isinstance(operation, Corrupt):
            self.problems[f"{source.label}: {operation.reason}"] += 1
        self._mail.append((self._peers[id(source)], operation))

    def _own_times(self) -> list[int]:
        return [0] if self._mail else []

    def _deliveries(self, now_ns: int) -> list[Delivery]:
        by_channel: dict[int, Delivery] = {}
        for channel, operation in self._mail:
            by_channel.setdefault(id(channel), (channel, []))[1].append(operation)
        self._mail.clear()
        on_bus: Counter[Transmit] = Counter()  # all nodes but the sender receive a frame
        for channel, operations in by_channel.values():
            if id(channel) not in self._of_bus:
                on_bus |= Counter(one for one in operations if isinstance(one, Transmit))
        for frame in on_bus.elements():
            self._record_frame(frame, now_ns)
        return list(by_channel.values())


def _ns_of(time: float) -> int:
    """Return the first nanosecond that is not before a time [s]."""
    ns = math.ceil(time * 1e9)
    return ns if ns / 1e9 >= time else ns + 1
