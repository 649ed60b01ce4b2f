"""Classify the errors of python-can's drivers: queue full, interface lost, or frame refused.

The drivers have little in common but ``can.CanError`` and ``OSError``. An error is therefore
classified by the operating system's error number, if there is one in its chain of causes.
"""

from __future__ import annotations

import errno
from enum import Enum


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
