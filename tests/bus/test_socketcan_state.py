"""The state of a SocketCAN interface, and a deleted one, with the answers of a fake kernel."""

import errno
import struct
import sys
from typing import Any, NamedTuple

import can
import pytest
from support.fake_bus import FRAME, GONE, NO_NUMBER, Clock, FakeBus, FakeOpener

from maplines_can.bus import Link, Sent
from maplines_can.bus.bus_factory import (
    interface_problem,
)
from maplines_can.values.errors import BusError

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="SocketCAN is of Linux")

#: Numbers of linux/sockios.h and linux/if.h.
SIOCGIFFLAGS, SIOCGIFMTU = 0x8913, 0x8921
UP, RUNNING, NOARP = 0x1, 0x40, 0x80
CLASSIC, CAN_FD = 16, 72


class Interface(NamedTuple):
    number: int = 5
    flags: int = UP | RUNNING | NOARP
    mtu: int = CAN_FD


@pytest.fixture
def kernel(monkeypatch: pytest.MonkeyPatch) -> dict[str, Interface]:
    """Interfaces by name; one of number 0 was deleted after it was looked up."""
    interfaces: dict[str, Interface] = {}

    def if_nametoindex(name: str) -> int:
        if name not in interfaces:
            raise OSError(errno.ENODEV, "No such device")
        return interfaces[name].number

    def ioctl(socket: Any, request: int, ifreq: bytes) -> bytes:
        assert len(ifreq) == 40
        found = interfaces[ifreq[:16].rstrip(b"\0").decode()]
        if found.number == 0:
            raise OSError(errno.ENODEV, "No such device")
        answers = {
            SIOCGIFFLAGS: struct.pack("H", found.flags),
            SIOCGIFMTU: struct.pack("i", found.mtu),
        }
        if request not in answers:
            raise OSError(errno.EINVAL, "Invalid argument")
        return ifreq[:16] + answers[request].ljust(24, b"\xaa")

    monkeypatch.setattr("socket.if_nametoindex", if_nametoindex)
    monkeypatch.setattr("fcntl.ioctl", ioctl)
    return interfaces


@pytest.mark.parametrize(
    ("interface", "fd", "words", "is_outage"),
    [
        pytest.param(Interface(), False, None, None, id="up"),
        pytest.param(Interface(), True, None, None, id="up-with-can-fd"),
        pytest.param(Interface(mtu=CLASSIC), False, None, None, id="classic"),
        pytest.param(Interface(mtu=CLASSIC), True, "no CAN FD (its MTU is 16", False, id="no-fd"),
        pytest.param(Interface(mtu=CAN_FD - 1), True, "no CAN FD", False, id="too-short"),
        pytest.param(Interface(flags=NOARP), False, "is down", True, id="down"),
        pytest.param(Interface(flags=NOARP, mtu=CLASSIC), True, "is down", True, id="down-classic"),
        pytest.param(Interface(number=0), False, "read: No such device", True, id="deleted-since"),
        pytest.param(None, False, "no such interface", True, id="missing"),
    ],
)
def test_what_prevents_the_use_of_an_interface(
    kernel: dict[str, Interface],
    interface: Interface | None,
    fd: bool,
    words: str | None,
    is_outage: bool | None,
) -> None:
    """Flags and MTU are read as netdevice(7) describes them."""
    if interface is not None:
        kernel["can0"] = interface
    found = interface_problem("can0", fd)
    if words is None:
        assert found is None
    else:
        assert found is not None
        assert words in found.text
        assert found.is_outage is is_outage


def test_a_deleted_interface_is_noticed_within_a_second(kernel: dict[str, Interface]) -> None:
    """One of the same name was created, so only the index shows it; the link reopens it."""
    kernel["can0"] = Interface()
    clock, opener = Clock(), FakeOpener()
    with Link(opener, interface="socketcan", channel="can0", clock=clock) as link:
        assert link.recv(0.0) is None
        assert (link.up, link.outages) == (True, 0)
        kernel["can0"] = Interface(number=6)
        clock.now += 0.9
        assert link.recv(0.0) is None
        assert link.up
        clock.now += 0.1
        assert link.recv(0.0) is None
        assert (link.up, link.outages) == (False, 1)
        clock.now += 1.0
        assert link.send(FRAME) is Sent.OK
        assert (link.up, link.outages, len(opener.opened)) == (True, 1, 2)
        clock.now += 10.0
        assert link.recv(0.0) is None
        assert link.up


def test_only_an_error_without_a_number_means_that_no_node_acknowledges(
    kernel: dict[str, Interface],
) -> None:
    """However long it lasts, it is no outage; the error of an interface that is gone is one."""
    kernel["can0"] = Interface()
    opener, clock = FakeOpener(*[NO_NUMBER] * 5, GONE), Clock()
    with Link(opener, clock=clock, interface="socketcan", channel="can0") as link:
        for _ in range(5):
            assert link.send(FRAME) is Sent.FULL
            clock.now += Link.UNCLEAR_TIMEOUT
        assert (link.up, link.outages) == (True, 0)
        assert link.send(FRAME) is Sent.DOWN
        assert (link.up, link.outages) == (False, 1)


def test_receiving_fails_for_a_second_before_an_interface_is_lost(
    kernel: dict[str, Interface],
) -> None:
    """No error of `recv` means that no node acknowledges, not even one without a number."""
    kernel["can0"] = Interface()
    opener, clock = FakeOpener(*[NO_NUMBER] * 3), Clock()
    with Link(opener, clock=clock, interface="socketcan", channel="can0") as link:
        for outages in (0, 0, 1):
            link.recv(0.0)
            assert link.outages == outages
            clock.now += 0.5


def test_frames_that_were_received_before_a_deletion_are_returned(
    kernel: dict[str, Interface],
) -> None:
    """The kernel is asked when there are none."""
    kernel["can0"] = Interface()
    with Link(FakeOpener(), interface="socketcan", channel="can0") as link:
        del kernel["can0"]
        bus: Any = link._bus
        bus._recv_internal = lambda timeout: (FRAME, True)  # noqa: ARG005
        assert link.recv(0.0) is FRAME
        assert link.up
        bus._recv_internal = lambda timeout: (None, True)  # noqa: ARG005
        assert link.recv(0.0) is None
        assert not link.up


class FdOpener(FakeOpener):
    """Factory of fake buses with CAN FD."""

    def __call__(self, **settings: Any) -> Any:
        bus = super().__call__(**settings)
        bus._can_protocol = can.CanProtocol.CAN_FD
        return bus


def test_an_interface_that_comes_back_without_can_fd_is_reported_once_an_outage(
    kernel: dict[str, Interface],
) -> None:
    """It is up, so the user has to know why nothing is received; it is tried again and again."""
    kernel["can0"] = Interface()
    events: list[tuple[bool, str]] = []
    opener, clock = FdOpener(), Clock()
    settings: dict[str, Any] = {"interface": "socketcan", "channel": "can0", "fd": True}
    with Link(opener, clock=clock, on_event=lambda *e: events.append(e), **settings) as link:
        for outage in (1, 2):
            opener.script[:] = [GONE]
            kernel["can0"] = Interface(mtu=CLASSIC)
            for _ in range(20):
                assert link.send(FRAME) is Sent.DOWN
                clock.now += 0.5
            kernel["can0"] = Interface()
            clock.now += 1.0
            assert link.send(FRAME) is Sent.OK
            assert link.outages == outage
        assert [up for up, _ in events] == [False, False, True] * 2
        assert ["has no CAN FD" in text for _, text in events] == [False, True, False] * 2


class GivenSocket(FakeBus):
    """A SocketCAN bus of the caller, without a socket."""

    channel = "can0"


@pytest.fixture
def given_socket(
    kernel: dict[str, Interface], monkeypatch: pytest.MonkeyPatch
) -> type[GivenSocket]:
    """The class of a bus that is taken for one of SocketCAN."""
    kernel["can0"] = Interface()
    monkeypatch.setattr("can.interfaces.socketcan.SocketcanBus", GivenSocket)
    return GivenSocket


def test_a_given_socket_is_not_used_again_after_its_interface_was_deleted(
    kernel: dict[str, Interface], given_socket: type[GivenSocket]
) -> None:
    """It is bound to the old one, even if there is a new one of that name; down is no deletion."""
    clock, bus = Clock(), given_socket([GONE, None, GONE])
    with Link(bus, clock=clock) as link:
        for outages in (1, 1, 2):
            kernel["can0"] = Interface(number=5 if outages == 1 else 6)
            link.send(FRAME)
            assert link.outages == outages
            clock.now += 2.0
        assert bus.sent.qsize() == 1
        for _ in range(3):
            assert link.send(FRAME) is Sent.DOWN
            clock.now += 2.0
        assert bus.sent.qsize() == 1
        with pytest.raises(BusError, match="fake was deleted, and a bus of the caller is not"):
            link._factory.open()


def test_other_systems_have_no_socketcan(
    kernel: dict[str, Interface], monkeypatch: pytest.MonkeyPatch
) -> None:
    """They have interfaces of that name, perhaps."""
    kernel["can0"] = Interface()
    monkeypatch.setattr("sys.platform", "win32")
    found = interface_problem("can0", fd=False)
    assert found is not None
    assert found.text == "its state cannot be read: SocketCAN exists on Linux only"
