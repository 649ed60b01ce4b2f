"""Settings name the interface; errors of opening are one clear line, and all have a class."""

import errno
from pathlib import Path
from typing import Any

import can
import pytest
from support.fake_bus import (
    FRAME,
    FULL,
    GONE,
    NO_NUMBER,
    Clock,
    FakeOpener,
)
from support.kernel_can import ip

from maplines_can.bus import (
    Link,
    Sent,
)
from maplines_can.bus.bus_factory import DriverError, classify_error, error_text
from maplines_can.values.errors import BusError


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        pytest.param({}, "no CAN interface is given; pass interface=", id="nothing"),
        pytest.param({"interface": "canny"}, 'Unknown interface type "canny"', id="unknown"),
        pytest.param({"interface": "socketcan"}, "socketcan needs a channel", id="no-channel"),
        pytest.param(
            {"interface": "socketcan", "channel": "nocan7"},
            "socketcan nocan7 cannot be opened: there is no such interface",
            id="no-such-interface",
        ),
        pytest.param({"interface": "slcan", "channel": "x"}, "slcan x cannot be", id="no-driver"),
        pytest.param(
            {"interface": "udp_multicast", "channel": "nowhere"},
            "udp_multicast nowhere cannot be opened",
            id="no-address",
        ),
    ],
)
def test_an_interface_that_cannot_be_opened_raises_one_clear_line(
    settings: Any, words: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """The first opening is not retried."""
    for name in ("CAN_INTERFACE", "CAN_CHANNEL", "CAN_CONFIG"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    with pytest.raises(BusError) as caught:
        Link(**settings)

    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_opener_gets_the_settings_each_time() -> None:
    """Settings that are None are left out; the bus after an outage has the same ones."""
    opener, clock = FakeOpener(GONE), Clock()
    with Link(
        opener, interface="virtual", channel="can0", fd=True, bitrate=None, clock=clock
    ) as link:
        first = opener.settings
        assert (link.name, first["fd"], "bitrate" in first) == ("virtual can0", True, False)  # type: ignore[index, operator]
        assert (first["interface"], first["channel"]) == ("virtual", "can0")  # type: ignore[index]
        assert first["ignore_config"]  # type: ignore[index]  # it is not read again
        link.send(FRAME)
        clock.now += 1.0
        assert link.send(FRAME) is Sent.OK
    assert len(opener.opened) == 2
    assert opener.settings == first


def test_an_interface_without_a_name_that_cannot_be_opened() -> None:
    """An opener without settings has none before it has opened a bus."""
    opener = FakeOpener()
    opener.cannot_open = True
    with pytest.raises(BusError, match=r"^the CAN interface cannot be opened: No such device$"):
        Link(opener)


@pytest.mark.parametrize(("interface", "fd"), [("virtual", True), ("pcan", False)])
def test_the_virtual_interface_has_can_fd_whatever_the_opener_makes_of_it(
    interface: str, fd: bool
) -> None:
    """Such as a bus that injects faults, which is no ``VirtualBus``."""
    with Link(FakeOpener(), interface=interface, channel="x") as link:
        assert link.fd is fd


@pytest.mark.parametrize("source", ["environment", "file", "context"])
def test_settings_are_read_from_the_configuration_of_python_can(
    source: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, channel: str
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    if source == "environment":
        monkeypatch.setenv("CAN_INTERFACE", "virtual")
        monkeypatch.setenv("CAN_CHANNEL", channel)
    else:
        section = {"file": "default", "context": "car"}[source]
        text = f"[{section}]\ninterface = virtual\nchannel = {channel}\n"
        (tmp_path / ".canrc").write_text(text)
    context = "car" if source == "context" else None
    with Link(interface=None, config_context=context) as link:
        assert link.name == f"virtual {channel}"


@pytest.mark.socketcan
@pytest.mark.parametrize(
    ("before", "settings", "words"),
    [
        ("link set vcan0 down", {}, "the interface is down; 'ip link set vcan0 up'"),
        ("link del vcan0", {}, "there is no such interface"),
        ("link show vcan2", {"channel": "vcan2", "fd": True}, "the interface has no CAN FD"),
    ],
)
def test_a_socketcan_interface_that_cannot_be_opened_raises(
    vcan: str, before: str, settings: Any, words: str
) -> None:
    ip(before)
    with pytest.raises(BusError) as caught:
        Link(**{"interface": "socketcan", "channel": vcan, **settings})
    assert words in str(caught.value)


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
