"""How to open a CAN interface, the same one each time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import can
from can.interfaces.socketcan import SocketcanBus
from can.interfaces.virtual import VirtualBus
from can.typechecking import CanFilter
from can.util import load_config

from ..errors import BusError
from . import socketcan
from .driver_errors import error_text

__all__ = ["BusFactory", "UnsuitableInterfaceError"]

_ERRORS = (can.CanError, OSError, ValueError, TypeError, ImportError, AttributeError)


class UnsuitableInterfaceError(BusError):
    """The interface is there and up, but not what was asked for: waiting alone does not help."""


class BusFactory:
    """The settings of an interface and what is known of it.

    Args:
        opener: returns a new open bus; called with the settings, unless it is given alone.
            None for ``can.Bus``.
        settings: of ``can.Bus``; None and what is missing comes from
            python-can's environment variables and configuration files, read
            once, so that a later opening is of the same interface.

    Raises:
        BusError: the settings name no interface that python-can knows.
    """

    def __init__(self, opener: Callable[..., can.BusABC] | None, settings: dict[str, Any]) -> None:
        self.name = ""  #: interface and channel, for messages
        self.fd = False  #: whether CAN FD frames can be sent
        self._channel = ""  # only of SocketCAN, where the kernel can be asked
        self._index: int | None = None
        self.is_virtual = False  #: of python-can's in-process interface
        self.is_socketcan = False
        if opener is None or settings:
            self._opener = self._configured(opener or can.Bus, settings)
        else:
            self._opener = opener

    def open(self, filters: list[CanFilter] | None = None) -> can.BusABC:
        """A newly opened bus.

        Args:
            filters: what to let through, as in ``can.BusABC.set_filters``.

        Raises:
            BusError: it cannot be opened now; why, and what to do. UnsuitableInterfaceError where it is there.
        """
        problem = socketcan.problem(self._channel, self.fd) if self._channel else None
        if problem:
            error = BusError if problem.is_outage else UnsuitableInterfaceError
            raise error(f"{self.name} cannot be opened: {problem.text}")
        index = socketcan.index(self._channel)  # before: better found deleted once too often
        try:
            bus = self._opener()
            if filters:
                bus.set_filters(filters)
        except _ERRORS as error:
            name = self.name or "the CAN interface"
            raise BusError(f"{name} cannot be opened: {error_text(error)}") from error
        self.name = self.name or str(bus.channel_info)
        # The virtual bus carries every frame, and calls itself classic all the same.
        self.is_virtual = self.is_virtual or isinstance(bus, VirtualBus)
        self.fd = self.is_virtual or bus.protocol is not can.CanProtocol.CAN_20
        if isinstance(bus, SocketcanBus) and not self._channel:
            self._channel, self.is_socketcan = bus.channel, True
            index = socketcan.index(self._channel)
        self._index = index
        return bus

    def deleted(self) -> bool:
        """Whether the open socket belongs to an interface that is no more."""
        return bool(self._channel) and socketcan.index(self._channel) != self._index

    def _configured(
        self, opener: Callable[..., can.BusABC], settings: dict[str, Any]
    ) -> Callable[[], can.BusABC]:
        given = {key: value for key, value in settings.items() if value is not None}
        context = given.pop("config_context", None)
        try:
            config: dict[str, Any] = dict(load_config(config=given, context=context))
        except _ERRORS as error:
            if '"None"' in str(error):  # the unknown interface is called so
                raise BusError(
                    "no CAN interface is given; pass interface=... and channel=..., set "
                    "CAN_INTERFACE and CAN_CHANNEL, or write them to ~/.canrc"
                ) from error
            raise BusError(f"the CAN interface cannot be opened: {error_text(error)}") from error
        self.name = " ".join(str(config[k]) for k in ("interface", "channel") if config[k])
        self.fd = bool(config.get("fd"))
        self.is_virtual = config["interface"] == "virtual"
        self.is_socketcan = config["interface"] == "socketcan"
        if self.is_socketcan:
            if not config["channel"]:  # python-can would listen to all, and could send to none
                raise BusError("socketcan needs a channel, such as channel='can0'")
            self._channel = str(config["channel"])
        return lambda: opener(ignore_config=True, **config)
