"""The bus of this package: arbitration, frame times, confirmations, and what nodes do wrong."""

from dataclasses import dataclass

import pytest

from maplines_can.cosimulation.bus import CanBus
from maplines_can.cosimulation.bus_operations import (
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
    decode,
    encode,
)

DISCARD = Configuration(
    Parameter.ARBITRATION_LOST_BEHAVIOR, ArbitrationLostBehavior.DISCARD_AND_NOTIFY
)
#: Longest time of a frame of 8 bytes at 500 kbit/s: 135 bits [ns].
FRAME_NS = 270_000


@dataclass(eq=False)
class Port:
    label: str
    wants_notifications: bool = False


class Nodes:
    """Three nodes at a bus, and what they receive."""

    def __init__(self, bitrate: int | None = 500_000, notified: str = "") -> None:
        self.ports = {name: Port(name, name in notified) for name in "abc"}
        self.bus = CanBus(list(self.ports.values()), bitrate)

    def send(self, name: str, *operations: Operation) -> None:
        for operation in operations:
            self.bus.accept(self.ports[name], operation)

    def take(self, now_ns: int) -> list[tuple[str, Operation]]:
        self.bus.arbitrate(now_ns)
        out = [(port.label, operation) for port, operation in self.bus.take(now_ns)]
        self.bus.arbitrate(now_ns)
        return out

    def frames(self, count: int) -> list[tuple[int, int]]:
        """Return times and IDs of the next frames."""
        found: list[tuple[int, int]] = []
        self.bus.arbitrate(0)
        while len(found) < count:
            assert self.bus.next_ns is not None
            now = self.bus.next_ns
            self.take(now)
            found += [(now, frame.can_id) for frame in self.bus.transmitted()]
        return found


def frame(can_id: int, *, is_extended: bool = False, is_remote: bool = False) -> Transmit:
    return Transmit(can_id, b"" if is_remote else bytes(8), False, is_extended, is_remote)


def test_without_a_bit_rate_frames_arrive_at_once() -> None:
    nodes = Nodes(None, notified="a")
    nodes.send("a", frame(2))
    assert nodes.take(5) == [("b", frame(2)), ("c", frame(2)), ("a", Confirm(2))]
    assert nodes.bus.next_ns is None


def test_a_remote_frame_with_a_length_and_no_data_is_confirmed() -> None:
    """As in FMI-LS-BUS since its pull request 393; it is on the bus as long as one without data."""
    (remote,) = decode(bytes.fromhex("10000000 10000000 02000000 00 01 0800"))
    assert isinstance(remote, Transmit)
    nodes = Nodes(None, notified="a")
    nodes.send("a", remote)
    assert nodes.take(5) == [("b", remote), ("c", remote), ("a", Confirm(2))]
    assert encode([remote]).hex() == "10000000100000000200000000010800"


def test_the_lowest_id_wins_whoever_comes_first() -> None:
    nodes = Nodes()
    nodes.send("a", frame(3), frame(1))  # a node sends its frames in order
    nodes.send("b", frame(2))
    assert nodes.frames(3) == [(FRAME_NS, 2), (2 * FRAME_NS, 3), (3 * FRAME_NS, 1)]
    assert nodes.bus.busy_ns == 3 * FRAME_NS


@pytest.mark.parametrize(
    ("winner", "loser"),
    [
        (frame(0x100), frame(0x100, is_remote=True)),
        (frame(0x100), frame(0x100 << 18, is_extended=True)),
        (frame(0x0FF << 18 | 0x3FFFF, is_extended=True), frame(0x100)),
        (frame(0x100 << 18, is_extended=True), frame(0x100 << 18 | 1, is_extended=True)),
    ],
)
def test_arbitration_compares_bit_by_bit(winner: Transmit, loser: Transmit) -> None:
    for names in ("ab", "ba"):
        nodes = Nodes()
        nodes.send(names[0], winner)
        nodes.send(names[1], loser)
        nodes.bus.arbitrate(0)
        assert nodes.bus.next_ns is not None
        nodes.take(nodes.bus.next_ns)
        assert nodes.bus.transmitted() == [winner]


def test_a_frame_that_comes_later_waits_for_the_bus() -> None:
    nodes = Nodes()
    nodes.send("a", frame(5))
    nodes.bus.arbitrate(0)
    nodes.send("b", frame(1))
    assert nodes.take(FRAME_NS - 1) == []
    assert [name for name, _ in nodes.take(FRAME_NS)] == ["b", "c"]
    assert nodes.bus.next_ns == 2 * FRAME_NS


def test_a_loser_that_discards_is_notified() -> None:
    nodes = Nodes()
    nodes.send("a", DISCARD, frame(2))
    nodes.send("b", frame(1))
    assert nodes.take(0) == [("a", ArbitrationLost(2))]
    assert nodes.frames(1) == [(FRAME_NS, 1)]
    assert nodes.bus.next_ns is None


def test_an_error_passive_node_comes_last() -> None:
    nodes = Nodes()
    nodes.send("a", Status(NodeStatus.ERROR_PASSIVE), frame(1))
    nodes.send("b", frame(2))
    assert [can_id for _, can_id in nodes.frames(2)] == [2, 1]


def test_a_node_that_is_bus_off_neither_sends_nor_receives_nor_confirms() -> None:
    nodes = Nodes(None, notified="a")
    for name in "bc":
        nodes.send(name, Status(NodeStatus.BUS_OFF))
    nodes.send("a", frame(1))
    nodes.send("b", frame(2))
    assert nodes.take(0) == []
    assert nodes.bus.problems == {"b: sends a frame while it is bus-off": 1}


def test_the_nodes_give_the_bit_rate() -> None:
    nodes = Nodes(0)
    nodes.send("a", frame(1))
    assert nodes.take(0) == []
    assert nodes.bus.next_ns is None
    nodes.send("b", Configuration(Parameter.CAN_BAUDRATE, 250_000))
    assert nodes.frames(1) == [(2 * FRAME_NS, 1)]
    nodes.send("c", Configuration(Parameter.CAN_BAUDRATE, 500_000))
    assert nodes.bus.problems == {"different bit rates: 250000, 500000 bit/s": 1}


@pytest.mark.parametrize(
    ("switch", "data_bitrate", "duration"),
    # 34 nominal and 358 data bits, see `frame_bits`
    [(True, None, 247_000), (True, 1_000_000, 426_000), (False, None, 784_000)],
)
def test_a_can_fd_frame_has_two_bit_rates(
    switch: bool, data_bitrate: int | None, duration: int
) -> None:
    nodes = Nodes()
    if data_bitrate is not None:
        nodes.send("b", Configuration(Parameter.CAN_FD_BAUDRATE, data_bitrate))
    nodes.send("a", Transmit(1, bytes(32), is_fd=True, bit_rate_switch=switch))
    assert nodes.frames(1) == [(duration, 1)]


def test_a_wakeup_goes_to_the_others_and_a_configuration_to_none() -> None:
    nodes = Nodes()
    nodes.send("a", Wakeup(), DISCARD, Status(NodeStatus.ERROR_ACTIVE))
    assert nodes.take(0) == [("b", Wakeup()), ("c", Wakeup())]


def test_a_corrupt_operation_is_answered() -> None:
    nodes = Nodes()
    nodes.send("a", Corrupt(b"xyz", "3 bytes"))
    assert nodes.take(0) == [("a", FormatError(b"xyz"))]
    assert nodes.bus.problems == {"a: 3 bytes": 1}


def test_a_foreign_frame_goes_to_all() -> None:
    nodes = Nodes(None, notified="abc")
    nodes.bus.accept(None, frame(0))
    assert nodes.take(0) == [(name, frame(0)) for name in "abc"]
