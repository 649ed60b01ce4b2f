"""Facts of a bus, a period apart, from a link whose frames are counted."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from ..bus import Link, Receiver
from ..logs.first_frames import CanId
from ..wire import Decoder, LineCodec
from .facts import Facts, facts_of
from .traffic import Traffic

#: Time between facts [s].
PERIOD = 0.05


class CountedLink(Link):
    """Link that counts the frames it receives; it is of one receiver.

    Args:
        traffic: counter of the frames; it is used by the receiver's thread and by `facts`.
        opener: of the interface, as for ``Link``.
        settings: as for ``Link``.
    """

    def __init__(self, traffic: Traffic, opener: Any = None, **settings: Any) -> None:
        super().__init__(opener, **settings)
        self._traffic, self._counting = traffic, threading.Lock()

    def recv(self, timeout: float) -> Any:
        """Return the next frame, as ``Link.recv``."""
        message = super().recv(timeout)
        if message is None or message.is_remote_frame:
            return message
        with self._counting:
            if message.is_error_frame:
                self._traffic.add_error()
            else:
                can_id = CanId(message.arbitration_id, message.is_extended_id)
                t_ns = round(message.timestamp * 1e9) or time.time_ns()
                self._traffic.add(can_id, len(message.data), t_ns, is_fd=message.is_fd)
        return message

    def traffic(self, t_ns: int) -> Facts:
        """Return the facts of the traffic up to a time [ns], as ``Traffic.facts``."""
        with self._counting:
            return self._traffic.facts(t_ns)


class LiveFacts:
    """Facts of a bus; each has ``traffic``, and ``link``: its name, and whether it is up.

    Args:
        link: what receives.
        receiver: of its lines.
        codec: of the lines.
    """

    def __init__(self, link: CountedLink, receiver: Receiver, codec: LineCodec) -> None:
        self.link, self._receiver, self._layout = link, receiver, codec.layout

    def now(self) -> Facts:
        """Return the facts of this moment."""
        facts = facts_of(self._receiver, self._layout)
        return facts | {
            "traffic": self.link.traffic(round(facts["t"] * 1e9)),
            "link": {"name": self.link.name, "up": self.link.up},
        }

    def each(self, is_over: Callable[[float], bool], period: float = PERIOD) -> Iterator[Facts]:
        """Yield facts a period apart; those that would be late are left out.

        Args:
            is_over: waits for a time [s], and says whether to end, such as ``Event.wait``.
            period: time between facts [s].
        """
        due = time.monotonic()
        while not is_over(max(0.0, due - time.monotonic())):
            yield self.now()
            late = time.monotonic() - due
            due += period * (1 + max(0.0, late // period))


@contextmanager
def live_facts(
    codec: LineCodec,
    decoder: Decoder | None = None,
    traffic: Traffic | None = None,
    opener: Any = None,
    **settings: Any,
) -> Iterator[LiveFacts]:
    """Open a bus, and receive from it.

    Args:
        codec: of the lines.
        decoder: of the lines; one of the codec by default.
        traffic: counter of the frames; one with the usual bit rates by default.
        opener: of the interface, as for ``Link``.
        settings: as for ``Link``.

    Raises:
        BusError: as ``Link``.
    """
    decoder = codec.decoder() if decoder is None else decoder
    traffic = Traffic(codec.layout) if traffic is None else traffic
    with (
        CountedLink(traffic, opener, **settings) as link,
        Receiver(link, decoder, can_ids=None, queue_size=1) as receiver,
    ):
        yield LiveFacts(link, receiver, codec)
