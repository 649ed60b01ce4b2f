"""Library of Robot Framework: the bench, its nodes and their assertions as keywords."""

from __future__ import annotations

from datetime import timedelta
from functools import cached_property

from ..values.line import MapLine, Slot
from ..wire import Codec
from .bench import Bench
from .nodes import ReceivingNode, SendingNode

#: Ratio of the standard deviations (y_off, beta, c0, c1) to that of y_off.
_RATIOS = (1.0, 0.1, 0.01, 1e-4)


class MaplinesLibrary:
    """A CAN bus for each test, with a node that sends lines and one that receives them.

    In virtual time; or on an interface of python-can, in real time. The first keyword of a test
    opens the bus, and the end of the test closes it: Robot Framework makes libraries of which it
    only reads the keywords, too.
    """

    ROBOT_LIBRARY_SCOPE = "TEST"

    def __init__(
        self, interface: str | None = None, channel: str | None = None, dbc: str | None = None
    ) -> None:
        self._place = interface, channel
        self._codec = Codec.from_dbc(dbc or None)
        self.ROBOT_LIBRARY_LISTENER = self
        self.ROBOT_LISTENER_API_VERSION = 3

    @cached_property
    def _nodes(self) -> tuple[Bench, SendingNode, ReceivingNode]:
        bench = Bench(*self._place)
        return bench, SendingNode(bench, self._codec), ReceivingNode(bench, self._codec)

    def publish_line(
        self, slot: Slot, y_off: float, beta: float, c0: float, c1: float, sigma: float = 0.1
    ) -> None:
        """Send a line now and in each period; sigma is that of y_off [m]."""
        sigmas = [sigma * ratio for ratio in _RATIOS]
        self._nodes[1].publish(MapLine.with_sigma(slot, [y_off, beta, c0, c1], sigmas))

    def set_faults(self, faults: str) -> None:
        """Inject faults into what is sent from now on, such as loss=0.1."""
        self._nodes[1].faults = faults

    def run_for(self, time: timedelta) -> None:
        """Let the time pass, such as 500 ms; a number is in seconds."""
        self._nodes[0].run_for(time.total_seconds())

    def line_should_be_received(self, slot: Slot, within: timedelta) -> MapLine:
        """Return the newest line of a slot; fail if none comes within this time."""
        return self._nodes[2].assert_received(slot, within.total_seconds())

    def no_line_should_be_stale(self, during: timedelta = timedelta()) -> None:
        """Fail if a line becomes stale or too old in this time."""
        self._nodes[2].assert_no_stale(during=during.total_seconds())

    def _end_test(self, *_: object) -> None:
        if "_nodes" in vars(self):
            bench, sender, _receiver = self._nodes
            sender.close()
            bench.close()
            del self._nodes
