"""What only the kernel knows of a SocketCAN interface: is it there, up, and able to do CAN FD.

Why ask at all, when a socket reports errors?  Seen on Linux 6.1:

- ``bind`` succeeds on an interface that is down; the error comes with the first use.
- ``bind`` accepts CAN FD on an interface that has none; sending then gives EINVAL.
- After the interface is deleted, an old socket reports ENODEV *once* and then stays
  silent for ever, also when an interface of the same name appears again: it is
  bound to the old index.  `index` tells the two apart.
- python-can logs an error for each attempt to open an interface that is not there.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
from typing import NamedTuple

__all__ = ["Problem", "index", "problem"]

_SIOCGIFFLAGS, _SIOCGIFMTU = 0x8913, 0x8921  # linux/sockios.h
_IFF_UP = 1  # linux/if.h
_CANFD_MTU = 72  # linux/can.h: sizeof(struct canfd_frame)


def index(channel: str) -> int | None:
    """The kernel's number of the interface; a new one each time it is created."""
    with contextlib.suppress(OSError):
        return socket.if_nametoindex(channel)
    return None


class Problem(NamedTuple):
    """Why an interface cannot be used, with the cure."""

    text: str
    is_outage: bool = True  #: it is gone or down; otherwise it is there, and not what is asked for


def problem(channel: str, fd: bool) -> Problem | None:
    """Why the interface cannot be used now, with the cure; None if it can.

    Args:
        channel: name of the interface, such as ``can0``.
        fd: whether it must be able to carry CAN FD frames.
    """
    if index(channel) is None:
        return Problem("there is no such interface; 'ip -br link' lists those that are")
    try:
        up = _ask(channel, _SIOCGIFFLAGS, "H") & _IFF_UP
        mtu = _ask(channel, _SIOCGIFMTU, "i")
    except OSError as error:  # deleted since the line above
        return Problem(f"it cannot be asked: {error.strerror}")
    if not up:
        return Problem(f"the interface is down; 'ip link set {channel} up'")
    if fd and mtu < _CANFD_MTU:
        return Problem(
            f"the interface has no CAN FD (its MTU is {mtu}, CAN FD has {_CANFD_MTU}); enable it, "
            "or open the interface with fd=False and send classic frames",
            is_outage=False,
        )
    return None


def _ask(channel: str, request: int, kind: str) -> int:
    """One number of ``struct ifreq`` (netdevice(7)): the name, then the answer."""
    if sys.platform != "linux":  # no SocketCAN there, and no fcntl
        raise OSError(0, "SocketCAN is a part of Linux")
    import fcntl

    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as any_socket:
        reply = fcntl.ioctl(any_socket, request, struct.pack("16s24x", channel.encode()))
    return int(struct.unpack_from(kind, reply, 16)[0])
