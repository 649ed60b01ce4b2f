"""Bus factory that injects faults into each bus that it opens."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import can

from .faults import Faults
from .faulty_bus import FaultyBus, parsed


class FaultyOpener:
    """Bus factory for ``Link`` that injects faults.

    Each call opens a bus and wraps it in a ``FaultyBus``. After an outage, the new bus
    continues the random numbers, the intervals and the counters of the previous one. The faults
    may be set at any time, see there.

    Args:
        faults: see ``FaultyBus``.
        opener: factory of the bus to wrap; called with the settings of the link.
        clock: see ``FaultyBus``.
        on_sent: see ``FaultyBus``; may be changed until the first opening.

    Raises:
        ValueError: the text of the faults is wrong.
        TypeError: ``faults`` has a wrong type.

    >>> from maplines_can import Link
    >>> opener = FaultyOpener("loss=1,direction=send")
    >>> with Link(opener, interface="virtual", channel="doc-opener") as link:
    ...     _ = link.send(can.Message(arbitration_id=1))
    >>> opener.as_dict()["lost"]
    1
    """

    def __init__(
        self,
        faults: Faults | str,
        opener: Callable[..., can.BusABC] = can.Bus,
        *,
        clock: Callable[[], float] | None = None,
        on_sent: Callable[[Any], None] | None = None,
    ) -> None:
        self.on_sent = on_sent
        self._faults, self._opener, self._clock = parsed(faults), opener, clock
        self._bus: FaultyBus | None = None

    def __call__(self, **settings: Any) -> FaultyBus:
        """Open a bus with these settings and wrap it."""
        bus = self._opener(**settings)
        self._bus = FaultyBus(
            bus, self._faults, clock=self._clock, previous=self._bus, on_sent=self.on_sent
        )
        return self._bus

    @property
    def faults(self) -> Faults:
        """The faults that are injected; see ``FaultyBus``."""
        return self._faults if self._bus is None else self._bus.faults

    @faults.setter
    def faults(self, faults: Faults | str | None) -> None:
        self._faults = parsed(Faults() if faults is None else faults)
        if self._bus is not None:
            self._bus.faults = self._faults

    def as_dict(self) -> dict[str, int]:
        """Return the counters of ``FaultyBus.as_dict``; none before the first opening."""
        return {} if self._bus is None else self._bus.as_dict()
