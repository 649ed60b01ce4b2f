"""Open a CAN interface, and the same one again after it was lost; tell what its errors mean.

Drivers of python-can have little in common but ``can.CanError`` and ``OSError``. An error is
therefore classified by the operating system's error number, if there is one in its chain of causes.

On SocketCAN that does not suffice, and the kernel is asked.  Observed on Linux 6.1:

- ``bind`` succeeds on an interface that is down; the error comes with the first use.
- ``bind`` accepts CAN FD on an interface without it; sending then fails with EINVAL.
- After the interface is deleted, an open socket reports ENODEV *once* and then receives
  nothing and reports nothing, even if an interface of the same name is created: the socket is
  bound to the old index.  `interface_index` distinguishes the two interfaces.
- python-can logs an error for each attempt to open an interface that does not exist.
"""

from __future__ import annotations

import contextlib
import errno
import socket
import struct
import sys
from collections.abc import Callable
from difflib import get_close_matches
from enum import Enum
from typing import TYPE_CHECKING, Any, NamedTuple

from ..values.errors import BusError

if TYPE_CHECKING:
    import can
    from can.typechecking import CanFilter

_ERRORS = (OSError, ValueError, TypeError, ImportError, AttributeError)
_SIOCGIFFLAGS, _SIOCGIFMTU = 0x8913, 0x8921  # linux/sockios.h
_IFF_UP = 1  # linux/if.h
_CANFD_MTU = 72  # linux/can.h: sizeof(struct canfd_frame)


def can_error() -> type[Exception]:
    """Return ``can.CanError``; python-can is loaded where a bus is opened, not before."""
    import can

    return can.CanError


class UnsuitableInterfaceError(BusError):
    """The interface exists and is up, but lacks a feature: waiting alone does not help."""


class BusFactory:
    """Factory of python-can buses on one interface, and the properties of that interface.

    An open bus may be given instead of a function. It belongs to the caller: it is never shut down
    here, and `open` returns the same bus each time.

    Args:
        opener: function that returns a new open bus; called with the settings if there are any.
            None for ``can.Bus``. An open bus is also accepted.
        settings: of ``can.Bus``. Settings that are None or missing are read from
            python-can's environment variables and configuration files. They are read only
            once, so that each bus is of the same interface.

    Raises:
        BusError: the settings name no interface that python-can knows.
        TypeError: ``opener`` is neither a function nor a bus, or an open bus has settings.
    """

    def __init__(
        self, opener: Callable[..., can.BusABC] | can.BusABC | None, settings: dict[str, Any]
    ) -> None:
        import can

        self.name = ""  #: interface and channel, for messages
        self.fd = False  #: whether CAN FD frames can be sent
        self.is_open_for_fd = False  #: whether it was asked for CAN FD, or says that it has it
        self._channel = ""  # of SocketCAN only, whose kernel can be asked for its state
        self._index: int | None = None
        self.is_virtual = False  #: whether it is python-can's in-process interface
        self.is_socketcan = False
        self.is_given = isinstance(opener, can.BusABC)  #: whether the caller opened the bus
        if isinstance(opener, can.BusABC):
            if settings:
                names = ", ".join(settings)
                raise TypeError(f"an open bus takes no settings, got {names}")
            given = opener
            self._opener: Callable[..., can.BusABC] = lambda: given
        elif not (opener is None or callable(opener)):
            raise TypeError(
                "opener must be an open python-can bus (can.BusABC) or a function that returns "
                f"one, got {opener!r}"
            )
        elif opener is None or settings:
            self._opener = self._configured(opener or can.Bus, settings)
        else:
            self._opener = opener

    def open(self, filters: list[CanFilter] | None = None) -> can.BusABC:
        """Return a new open bus.

        Args:
            filters: which frames to receive, as in ``can.BusABC.set_filters``.

        Raises:
            BusError: the interface cannot be opened now; the message has the reason and the cure.
                It is an `UnsuitableInterfaceError` if the interface is up but lacks CAN FD.
        """
        from can import CanProtocol
        from can.interfaces.socketcan import SocketcanBus
        from can.interfaces.virtual import VirtualBus

        if self.is_given and self.is_deleted():
            raise BusError(f"{self.name} was deleted, and a bus of the caller is not reopened")
        problem = interface_problem(self._channel, self.fd) if self._channel else None
        if problem:
            error = BusError if problem.is_outage else UnsuitableInterfaceError
            raise error(f"{self.name} cannot be opened: {problem.text}")
        # Read before opening: a change in between then looks like a deletion, which reopens it.
        index = interface_index(self._channel)
        bus = None
        try:
            bus = self._opener()
            if filters:
                bus.set_filters(filters)
        except (can_error(), *_ERRORS) as error:
            if bus is not None:  # it is useless without its filters
                with contextlib.suppress(can_error(), OSError):
                    self.close(bus)
            name = self.name or "the CAN interface"
            raise BusError(f"{name} cannot be opened: {error_text(error)}") from error
        self.name = self.name or str(bus.channel_info)
        # The virtual bus transports CAN FD frames, too, although it reports classic CAN.
        self.is_virtual = self.is_virtual or isinstance(bus, VirtualBus)
        self.is_open_for_fd |= bus.protocol is not CanProtocol.CAN_20
        self.fd = self.is_virtual or bus.protocol is not CanProtocol.CAN_20
        if isinstance(bus, SocketcanBus) and not self._channel:
            self._channel, self.is_socketcan = bus.channel, True
            index = interface_index(self._channel)
        self._index = index
        return bus

    def close(self, bus: can.BusABC) -> None:
        """Shut a bus down, unless the caller opened it."""
        if not self.is_given:
            bus.shutdown()

    def is_deleted(self) -> bool:
        """Return whether the interface of the open socket was deleted."""
        return bool(self._channel) and interface_index(self._channel) != self._index

    def _configured(
        self, opener: Callable[..., can.BusABC], settings: dict[str, Any]
    ) -> Callable[[], can.BusABC]:
        from can.util import load_config

        given = {key: value for key, value in settings.items() if value is not None}
        context = given.pop("config_context", None)
        try:
            config: dict[str, Any] = dict(load_config(config=given, context=context))
        except (can_error(), *_ERRORS) as error:
            if '"None"' in str(error):  # python-can's name of an interface that is not given
                raise BusError(
                    "no CAN interface is given; pass interface=... and channel=..., set "
                    "CAN_INTERFACE and CAN_CHANNEL, or write them to ~/.canrc"
                ) from error
            text = f"the CAN interface cannot be opened: {error_text(error)}"
            raise BusError(f"{text}{_interface_hint(given.get('interface'))}") from error
        self.name = " ".join(str(config[k]) for k in ("interface", "channel") if config[k])
        self.fd = self.is_open_for_fd = bool(config.get("fd"))
        self.is_virtual = config["interface"] == "virtual"
        self.is_socketcan = config["interface"] == "socketcan"
        if self.is_socketcan:
            if not config["channel"]:  # python-can would receive from all and could send to none
                raise BusError("socketcan needs a channel, such as channel='can0'")
            self._channel = str(config["channel"])
        return lambda: opener(ignore_config=True, **config)


def _interface_hint(name: object) -> str:
    """Return what python-can has instead of an interface that it does not have; else nothing."""
    from can import VALID_INTERFACES

    known = sorted(VALID_INTERFACES)
    if name is None or name in known:
        return ""
    like = get_close_matches(str(name), known, 1)
    return f"; did you mean {like[0]}?" if like else f"; python-can has {', '.join(known)}"


def interface_index(channel: str) -> int | None:
    """Return the kernel's index of the interface, which is new each time it is created."""
    with contextlib.suppress(OSError):
        return socket.if_nametoindex(channel)
    return None


class Problem(NamedTuple):
    """Reason why an interface cannot be used, with the cure."""

    text: str
    is_outage: bool = True  #: gone or down; False: it is up, but lacks CAN FD


def interface_problem(channel: str, fd: bool) -> Problem | None:
    """Return why the interface cannot be used now (if ``fd``, for CAN FD); None if it can."""
    if interface_index(channel) is None:
        return Problem("there is no such interface; 'ip -br link' lists those that are")
    try:
        up = _query(channel, _SIOCGIFFLAGS, "H") & _IFF_UP
        mtu = _query(channel, _SIOCGIFMTU, "i")
    except OSError as error:  # deleted since the call before
        return Problem(f"its state cannot be read: {error.strerror}")
    if not up:
        return Problem(f"the interface is down; 'ip link set {channel} up'")
    if fd and mtu < _CANFD_MTU:
        return Problem(
            f"the interface has no CAN FD (its MTU is {mtu}, CAN FD has {_CANFD_MTU}); enable it, "
            "or open the interface with fd=False and send classic frames",
            is_outage=False,
        )
    return None


def _query(channel: str, request: int, kind: str) -> int:
    """Return one number of ``struct ifreq`` (netdevice(7)): the name, then the reply."""
    if sys.platform != "linux":  # Windows has no fcntl
        raise OSError(0, "SocketCAN exists on Linux only")
    import fcntl

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        reply = fcntl.ioctl(any_socket, request, struct.pack("16s24x", channel.encode()))
    return int(struct.unpack_from(kind, reply, 16)[0])


class DriverError(Enum):
    """Classes of errors of send and recv, by what to do about them."""

    FULL = "the transmit queue is full: try again"
    LOST = "the interface is gone: open it again"
    REFUSED = "the interface can never send this frame"
    UNCLEAR = "there is no error number: try again, and if the error persists, open it again"


_FULL = {errno.ENOBUFS, errno.EAGAIN, errno.EWOULDBLOCK, errno.ETIMEDOUT, errno.EINTR}
# SocketCAN returns EINVAL for a CAN FD frame on an interface or socket without CAN FD.
_REFUSED = {errno.EINVAL, errno.EMSGSIZE, errno.EOPNOTSUPP}


def classify_error(error: BaseException) -> DriverError:
    """Return the class of an error that a python-can bus raised.

    An error of the operating system that is neither FULL nor REFUSED is LOST, even if it has
    no number: a serial adapter that is unplugged raises an ``OSError`` without one.

    >>> classify_error(OSError(errno.ENOBUFS, "No buffer space available")).name
    'FULL'
    >>> classify_error(OSError("device disconnected")).name
    'LOST'
    """
    cause = _system_error(error)
    if isinstance(cause, TimeoutError):
        return DriverError.FULL
    number = cause.errno if cause else getattr(error, "error_code", None)
    if number in _FULL:
        return DriverError.FULL
    if number in _REFUSED:
        return DriverError.REFUSED
    if cause or number in {errno.ENETDOWN, errno.ENODEV, errno.ENXIO}:
        return DriverError.LOST
    return DriverError.UNCLEAR  # other numbers are the driver's own


def error_text(error: BaseException) -> str:
    """Return a short text for an error: that of the operating system, if there is one."""
    cause = _system_error(error)
    text = cause.strerror if cause and cause.strerror else str(error)
    return " ".join(text.split()) or type(error).__name__


def _system_error(error: BaseException | None) -> OSError | None:
    while error is not None and not isinstance(error, OSError):
        error = error.__cause__ or error.__context__
    return error
