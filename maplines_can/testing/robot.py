"""Library of Robot Framework: the bench, its nodes and their assertions as keywords."""

from __future__ import annotations

from ..values.line import MapLine, Slot
from ..wire import Codec
from .bench import Bench
from .nodes import ReceivingNode, SendingNode

#: Ratio of the standard deviations (y_off, beta, c0, c1) to that of y_off.
_RATIOS = (1.0, 0.1, 0.01, 1e-4)


class MaplinesLibrary:
    """A CAN bus for each test, with a node that sends lines and one that receives them.

    In virtual time; or on an interface of python-can, in real time.
    """

    ROBOT_LIBRARY_SCOPE = "TEST"

    def __init__(
        self, interface: str | None = None, channel: str | None = None, dbc: str | None = None
    ) -> None:
        codec = Codec.from_dbc(dbc) if dbc else Codec.from_dbc()
        self._bench = Bench(interface, channel)
        self._sender = SendingNode(self._bench, codec)
        self._receiver = ReceivingNode(self._bench, codec)
        self.ROBOT_LIBRARY_LISTENER = self
        self.ROBOT_LISTENER_API_VERSION = 3

    def publish_line(
        self, slot: str, y_off: float, beta: float, c0: float, c1: float, sigma: float = 0.1
    ) -> None:
        """Send a line now and in each period; sigma is that of y_off [m]."""
        sigmas = [sigma * ratio for ratio in _RATIOS]
        self._sender.publish(MapLine.with_sigma(Slot[slot], [y_off, beta, c0, c1], sigmas))

    def set_faults(self, faults: str) -> None:
        """Inject faults into what is sent from now on, such as loss=0.1."""
        self._sender.faults = faults

    def run_for(self, seconds: float) -> None:
        """Let the time pass [s]."""
        self._bench.run_for(seconds)

    def line_should_be_received(self, slot: str, within: float) -> MapLine:
        """Return the newest line of a slot; fail if none comes within this time [s]."""
        return self._receiver.assert_received(Slot[slot], within)

    def no_line_should_be_stale(self, during: float = 0.0) -> None:
        """Fail if a line becomes stale or too old in this time [s]."""
        self._receiver.assert_no_stale(during=during)

    def _end_test(self, *_: object) -> None:
        self._sender.close()
        self._bench.close()
