"""Open a CAN interface, and open the same one again after it was lost."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from difflib import get_close_matches
from typing import Any

import can
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.virtual import VirtualBus
from can.typechecking import CanFilter
from can.util import load_config

from ..values.errors import BusError
from . import socketcan
from .driver_errors import error_text

_ERRORS = (can.CanError, OSError, ValueError, TypeError, ImportError, AttributeError)


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
        self.name = ""  #: interface and channel, for messages
        self.fd = False  #: whether CAN FD frames can be sent
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
        if self.is_given and self.is_deleted():
            raise BusError(f"{self.name} was deleted, and a bus of the caller is not reopened")
        problem = socketcan.problem(self._channel, self.fd) if self._channel else None
        if problem:
            error = BusError if problem.is_outage else UnsuitableInterfaceError
            raise error(f"{self.name} cannot be opened: {problem.text}")
        # Read before opening: a change in between then looks like a deletion, which reopens it.
        index = socketcan.index(self._channel)
        bus = None
        try:
            bus = self._opener()
            if filters:
                bus.set_filters(filters)
        except _ERRORS as error:
            if bus is not None:  # it is useless without its filters
                with contextlib.suppress(can.CanError, OSError):
                    self.close(bus)
            name = self.name or "the CAN interface"
            raise BusError(f"{name} cannot be opened: {error_text(error)}") from error
        self.name = self.name or str(bus.channel_info)
        # The virtual bus transports CAN FD frames, too, although it reports classic CAN.
        self.is_virtual = self.is_virtual or isinstance(bus, VirtualBus)
        self.fd = self.is_virtual or bus.protocol is not can.CanProtocol.CAN_20
        if isinstance(bus, SocketcanBus) and not self._channel:
            self._channel, self.is_socketcan = bus.channel, True
            index = socketcan.index(self._channel)
        self._index = index
        return bus

    def close(self, bus: can.BusABC) -> None:
        """Shut a bus down, unless the caller opened it."""
        if not self.is_given:
            bus.shutdown()

    def is_deleted(self) -> bool:
        """Return whether the interface of the open socket was deleted."""
        return bool(self._channel) and socketcan.index(self._channel) != self._index

    def _configured(
        self, opener: Callable[..., can.BusABC], settings: dict[str, Any]
    ) -> Callable[[], can.BusABC]:
        given = {key: value for key, value in settings.items() if value is not None}
        context = given.pop("config_context", None)
        try:
            config: dict[str, Any] = dict(load_config(config=given, context=context))
        except _ERRORS as error:
            if '"None"' in str(error):  # python-can's name of an interface that is not given
                raise BusError(
                    "no CAN interface is given; pass interface=... and channel=..., set "
                    "CAN_INTERFACE and CAN_CHANNEL, or write them to ~/.canrc"
                ) from error
            text = f"the CAN interface cannot be opened: {error_text(error)}"
            raise BusError(f"{text}{_interface_hint(given.get('interface'))}") from error
        self.name = " ".join(str(config[k]) for k in ("interface", "channel") if config[k])
        self.fd = bool(config.get("fd"))
        self.is_virtual = config["interface"] == "virtual"
        self.is_socketcan = config["interface"] == "socketcan"
        if self.is_socketcan:
            if not config["channel"]:  # python-can would receive from all and could send to none
                raise BusError("socketcan needs a channel, such as channel='can0'")
            self._channel = str(config["channel"])
        return lambda: opener(ignore_config=True, **config)


def _interface_hint(name: object) -> str:
    """Return what python-can has instead of an interface that it does not have; else nothing."""
    known = sorted(can.VALID_INTERFACES)
    if name is None or name in known:
        return ""
    like = get_close_matches(str(name), known, 1)
    return f"; did you mean {like[0]}?" if like else f"; python-can has {', '.join(known)}"
