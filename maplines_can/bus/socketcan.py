"""Query the kernel for the state of a SocketCAN interface: does it exist, is it up, has it CAN FD.

The errors of a socket do not suffice.  Observed on Linux 6.1:

- ``bind`` succeeds on an interface that is down; the error comes with the first use.
- ``bind`` accepts CAN FD on an interface without it; sending then fails with EINVAL.
- After the interface is deleted, an open socket reports ENODEV *once* and then receives
  nothing and reports nothing, even if an interface of the same name is created: the socket is
  bound to the old index.  `index` distinguishes the two interfaces.
- python-can logs an error for each attempt to open an interface that does not exist.
"""

from __future__ import annotations

import contextlib
import socket
import struct
import sys
from typing import NamedTuple

_SIOCGIFFLAGS, _SIOCGIFMTU = 0x8913, 0x8921  # linux/sockios.h
_IFF_UP = 1  # linux/if.h
_CANFD_MTU = 72  # linux/can.h: sizeof(struct canfd_frame)


def index(channel: str) -> int | None:
    """Return the kernel's index of the interface, which is new each time it is created."""
    with contextlib.suppress(OSError):
        return socket.if_nametoindex(channel)
    return None


class Problem(NamedTuple):
    """Reason why an interface cannot be used, with the cure."""

    text: str
    is_outage: bool = True  #: gone or down; False: it is up, but lacks CAN FD


def problem(channel: str, fd: bool) -> Problem | None:
    """Return why the interface cannot be used now (if ``fd``, for CAN FD); None if it can."""
    if index(channel) is None:
        return Problem("there is no such interface; 'ip -br link' lists those that are")
    try:
        up = _query(channel, _SIOCGIFFLAGS, "H") & _IFF_UP
        mtu = _query(channel, _SIOCGIFMTU, "i")
    except OSError as error:  # deleted since the call of index
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
