"""What an error of an interface means: its queue is full, it is gone, or the frame is wrong.

python-can's drivers agree on ``can.CanError`` and ``OSError`` and on little else,
so the meaning is taken from the operating system's error number wherever one is
in the chain of causes.
"""

from __future__ import annotations

import errno
from enum import Enum

__all__ = ["Fault", "classify_error", "error_text"]


class Fault(Enum):
    """What to do about an error of send or recv."""

    FULL = "the transmit queue is full: try again"
    LOST = "the interface is gone: open it again"
    REFUSED = "the interface can never send this frame"
    UNCLEAR = "the driver gives no error number: try again, and if that does not help it is gone"


_FULL = {errno.ENOBUFS, errno.EAGAIN, errno.EWOULDBLOCK, errno.ETIMEDOUT, errno.EINTR}
# SocketCAN answers EINVAL to a CAN FD frame on an interface or socket without CAN FD.
_REFUSED = {errno.EINVAL, errno.EMSGSIZE, errno.EOPNOTSUPP}


def classify_error(error: BaseException) -> Fault:
    """The meaning of an error that a python-can bus raised.

    An operating system's error that is neither "full" nor "refused" means that
    the interface is gone, known number or not (a serial adapter that is pulled
    out gives none): opening it again is right after all of them.

    >>> classify_error(OSError(errno.ENOBUFS, "No buffer space available")).name
    'FULL'
    >>> classify_error(OSError("device disconnected")).name
    'LOST'
    """
    cause = _system_error(error)
    if isinstance(error, TimeoutError) or isinstance(cause, TimeoutError):
        return Fault.FULL
    number = cause.errno if cause else getattr(error, "error_code", None)
    if number in _FULL:
        return Fault.FULL
    if number in _REFUSED:
        return Fault.REFUSED
    if cause or number in {errno.ENETDOWN, errno.ENODEV, errno.ENXIO}:
        return Fault.LOST
    return Fault.UNCLEAR  # other numbers are a driver's own, not the system's


def error_text(error: BaseException) -> str:
    """The shortest words for an error: the system's, where it has any."""
    cause = _system_error(error)
    text = cause.strerror if cause and cause.strerror else str(error)
    return " ".join(text.split()) or type(error).__name__


def _system_error(error: BaseException | None) -> OSError | None:
    while error is not None and not isinstance(error, OSError):
        error = error.__cause__ or error.__context__
    return error
