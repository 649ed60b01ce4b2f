"""Receive lines as a listener of python-can."""

from __future__ import annotations

from collections.abc import Callable

import can

from ..values.line import MapLine
from ..wire import Decoder
from .background import ForkSafeCondition
from .receiver import ReceivedLines


class LineListener(ReceivedLines, can.Listener):
    """Listener of python-can that turns messages into lines.

    It works wherever a ``can.Listener`` does: in a ``can.Notifier``, with or without an asyncio
    event loop, or called directly with the messages of a log. Use one listener for each bus. A
    `Receiver` is a listener with a link and a thread.

    As in python-can, a time stamp of 0 means that there is none; the current time is used instead.
    Read a log that starts at 0 with ``relative_timestamp=False``.

    Lines go to the callback ``on_line`` if there is one. Otherwise they wait for
    `get` or for iteration (``for line in listener``, which ends after `stop`). Lines that wait
    when the listener stops can still be fetched. The newest ``queue_size`` lines wait. Older
    ones are dropped and counted as overflowed, because a stale line is of no use.

    A control loop needs neither callback nor queue: `latest` returns the newest line of a slot at
    any time, with its age, its E2E state, and whether it is stale.

    All methods may be called from any thread. No message causes an exception. An exception raised
    by the callback reaches the caller of the listener: a notifier keeps it as
    ``notifier.exception`` and stops reading, as with any listener. `get` and the iteration raise it
    again.

    Args:
        decoder: turns frames into lines; used by this listener only.
        on_line: a plain function, called with each line by the thread that brings the message.
        queue_size: how many lines may wait.

    Raises:
        ValueError: ``queue_size`` is less than 1.
        TypeError: ``decoder`` is no decoder, or ``on_line`` is no plain function.

    >>> from maplines_can import Codec, MapLine, Slot
    >>> codec = Codec.from_dbc()
    >>> listener = LineListener(codec.decoder())
    >>> for frame in codec.encoder().encode(MapLine.mean_only(Slot.ROUTE, [1.75, 0, 0, 0])):
    ...     listener(
    ...         can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False)
    ...     )
    >>> listener.get().slot.name, listener.stats().frames
    ('ROUTE', 4)
    """

    def __init__(
        self,
        decoder: Decoder,
        *,
        on_line: Callable[[MapLine], object] | None = None,
        queue_size: int = 256,
    ) -> None:
        super().__init__(decoder, on_line, queue_size, ForkSafeCondition())
        self._error: Exception | None = None  # of the notifier; None while messages arrive

    @property
    def _is_over(self) -> bool:
        return self._stopped or self._error is not None

    def _raise_error(self) -> None:
        if self._error is not None:
            raise self._error

    def on_message_received(self, msg: can.Message) -> None:
        """Decode a message; called by python-can. Messages after `stop` are ignored."""
        if not self._stopped:
            self._error = None
        self._take([msg])

    def on_error(self, exc: Exception) -> None:
        """Store the error that ends a notifier's thread, for `get`; called by python-can.

        Raises:
            NotImplementedError: always. This tells the notifier that the error is not handled, so
                it stops unless another listener handles the error.
        """
        with self._changed:
            self._error = exc
            self._changed.notify_all()
        raise NotImplementedError

    def stop(self) -> None:
        """Ignore further messages, and let `get` and the iteration end; called by python-can."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
