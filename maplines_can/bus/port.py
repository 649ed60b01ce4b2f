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
from .faults import text_of

__all__ = ["Port", "UnfitError"]

_ERRORS = (can.CanError, OSError, ValueError, TypeError, ImportError, AttributeError)


class UnfitError(BusError):
    """The interface is there and up, but not what was asked for: waiting alone does not help."""


class Port:
    """The settings of an interface and what is known of it.

    Args:
        opener: returns a new open bus; None to make one from the settings.
        settings: of ``can.Bus``; None and what is missing comes from
            python-can's environment variables and configuration files, read
            once, so that a later opening is of the same interface.

    Raises:
        BusError: the settings name no interface that python-can knows.
        TypeError: an opener and settings.
    """

    def __init__(self, opener: Callable[[], can.BusABC] | None, settings: dict[str, Any]) -> None:
        if opener and settings:
            raise TypeError(f"give an opener or settings, not both; got {sorted(settings)}")
        self.name = ""  #: interface and channel, for messages
        self.fd = False  #: whether CAN FD frames can be sent
        self._channel = ""  # only of SocketCAN, where the kernel can be asked
        self._index: int | None = None
        self._opener = opener or self._configured(settings)

    def open(self, filters: list[CanFilter] | None = None) -> can.BusABC:
        """A newly opened bus.

        Args:
            filters: what to let through, as in ``can.BusABC.set_filters``.

        Raises:
            BusError: it cannot be opened now; why, and what to do. UnfitError where it is there.
        """
        problem = socketcan.problem(self._channel, self.fd) if self._channel else None
        if problem:
            error = BusError if problem.is_outage else UnfitError
            raise error(f"{self.name} cannot be opened: {problem.text}")
        index = socketcan.index(self._channel)  # before: better found deleted once too often
        try:
            bus = self._opener()
            if filters:
                bus.set_filters(filters)
        except _ERRORS as error:
            name = self.name or "the CAN interface"
            raise BusError(f"{name} cannot be opened: {text_of(error)}") from error
        self.name = self.name or str(bus.channel_info)
        # The virtual bus carries every frame, and calls itself classic all the same.
        self.fd = isinstance(bus, VirtualBus) or bus.protocol is not can.CanProtocol.CAN_20
        if isinstance(bus, SocketcanBus):
            self._index = index if self._channel else socketcan.index(bus.channel)
            self._channel = bus.channel
        return bus

    def deleted(self) -> bool:
        """Whether the open socket belongs to an interface that is no more."""
        return bool(self._channel) and socketcan.index(self._channel) != self._index

    def _configured(self, settings: dict[str, Any]) -> Callable[[], can.BusABC]:
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
            raise BusError(f"the CAN interface cannot be opened: {text_of(error)}") from error
        self.name = " ".join(str(config[k]) for k in ("interface", "channel") if config[k])
        self.fd = bool(config.get("fd"))
        if config["interface"] == "socketcan":
            if not config["channel"]:  # python-can would listen to all, and could send to none
                raise BusError("socketcan needs a channel, such as channel='can0'")
            self._channel = str(config["channel"])
        return lambda: can.Bus(ignore_config=True, **config)
