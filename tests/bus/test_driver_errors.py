"""Errors of drivers are classified by the number of the operating system."""

import errno
from typing import Any

import can
import pytest
from support.fake_bus import (
    FULL,
    GONE,
    NO_NUMBER,
)

from maplines_can.bus.bus_factory import DriverError, classify_error, error_text


def caused_by(error: Any, cause: Any) -> Any:
    error.__cause__ = cause
    return error


def raised_during(error: Any, context: Any) -> Any:
    error.__context__ = context
    return error


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        pytest.param(FULL, DriverError.FULL, id="queue-full"),
        pytest.param(can.CanTimeoutError("late"), DriverError.FULL, id="timeout"),
        pytest.param(
            caused_by(can.CanOperationError("x"), TimeoutError()), DriverError.FULL, id="usb"
        ),
        pytest.param(BlockingIOError(errno.EAGAIN, ""), DriverError.FULL, id="would-block"),
        pytest.param(GONE, DriverError.LOST, id="no-device"),
        pytest.param(can.CanOperationError("x", errno.ENETDOWN), DriverError.LOST, id="down"),
        pytest.param(can.CanOperationError("x", errno.ENXIO), DriverError.LOST, id="deleted"),
        pytest.param(
            caused_by(can.CanOperationError("x"), GONE), DriverError.LOST, id="caused-by-gone"
        ),
        pytest.param(
            raised_during(can.CanOperationError("x"), raised_during(KeyError(), GONE)),
            DriverError.LOST,
            id="raised-while-gone-is-handled",
        ),
        pytest.param(OSError("device disconnected"), DriverError.LOST, id="serial-pulled-out"),
        pytest.param(can.CanOperationError("x", errno.EINVAL), DriverError.REFUSED, id="fd-frame"),
        pytest.param(NO_NUMBER, DriverError.UNCLEAR, id="no-number"),
        pytest.param(can.CanOperationError("x", -13), DriverError.UNCLEAR, id="number-of-a-driver"),
    ],
)
def test_class_of_an_error(error: Any, expected: Any) -> None:
    """The number of the operating system decides, wherever in the chain of causes it is."""
    assert classify_error(error) is expected


def test_text_of_an_error_is_that_of_the_operating_system() -> None:
    assert error_text(caused_by(can.CanOperationError("Failed [19]"), GONE)) == "No such device"
    assert error_text(can.CanOperationError("two\nlines")) == "two lines"
    assert error_text(can.CanTimeoutError()) == "CanTimeoutError"
    assert error_text(OSError("device disconnected")) == "device disconnected"
    assert error_text(raised_during(KeyError("x"), GONE)) == "No such device"
