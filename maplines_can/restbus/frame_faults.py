"""Faults of the frames that a restbus sends, on its clock."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..bus.clock import SECOND_NS, Clock, TimerHandle
from ..values.errors import RestbusError
from ..wire import Frame

if TYPE_CHECKING:
    from ..testing import FaultInjector, Faults

#: Other words for faults.
_WORDS = {"drop": "loss"}


def parse_faults(text: str, seed: int) -> Faults:
    """Return the faults of a text, such as ``loss=0.1,dup=0.05`` or ``loss 0.1``, or ``off``.

    Args:
        text: the text.
        seed: of the random faults, if the text names none.

    Raises:
        RestbusError: the text is wrong.
    """
    from ..testing import Faults

    words = text.replace("=", " ").split() if "," not in text else []
    if len(words) == 2:
        text = f"{_WORDS.get(words[0], words[0])}={words[1]}"
    text = "" if text == "off" else text
    if "seed=" not in text:
        text = ",".join(filter(None, [text, f"seed={seed}"]))
    try:
        return Faults.parse(text)
    except ValueError as error:
        raise RestbusError(str(error)) from error


class FaultySending:
    """Function that sends frames with faults, which may be changed at any time.

    Args:
        clock: on which frames are held back, and floods are sent.
        send: takes each frame that is passed on.
        seed: of the random faults, if they name none.
    """

    def __init__(self, clock: Clock, send: Callable[[Frame], object], seed: int) -> None:
        self._clock, self._send, self._seed = clock, send, seed
        self._start_ns = clock.now_ns
        self._injector: FaultInjector[Frame] | None = None
        self._handle: TimerHandle | None = None

    def set(self, text: str) -> None:
        """Set the faults, see ``parse_faults``.

        Raises:
            RestbusError: the text is wrong.
        """
        from ..testing import FaultInjector

        faults = parse_faults(text, self._seed)
        if self._injector is None:
            self._injector = FaultInjector(faults, stream="send")
        else:
            self._injector.faults = faults
        self._injector.start(self._now)
        self._wait()

    def send(self, frame: Frame) -> None:
        """Send a frame, or what becomes of it."""
        if self._injector is None:
            self._send(frame)
            return
        for each in self._injector.apply(frame, self._now):
            self._send(each)
        self._wait()

    def finish(self) -> None:
        """Send the frames that are held back."""
        if self._injector is not None:
            for frame in self._injector.flush():
                self._send(frame)

    def counts(self) -> dict[str, int]:
        """Return the counters of the faults; empty if there never were any."""
        return {} if self._injector is None else self._injector.as_dict()

    @property
    def _now(self) -> float:
        return (self._clock.now_ns - self._start_ns) / SECOND_NS

    def _wait(self) -> None:
        """Wait for the next frame that is held back or of a flood."""
        if self._handle is not None:
            self._handle.cancel()
            self._handle = None
        if self._injector is not None and (due := self._injector.next_due) < math.inf:
            t_ns = self._start_ns + math.ceil(due * SECOND_NS)
            self._handle = self._clock.call_at(t_ns, self._due)

    def _due(self) -> None:
        if self._injector is not None:
            for frame in self._injector.due(max(self._now, self._injector.next_due)):
                self._send(frame)
        self._wait()
