"""A transmitter and a receiver on one simulated clock, without threads."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import can
import numpy as np
from support.fake_bus import Clock, FakeOpener

from maplines_can import Codec, Link, Transmitter
from maplines_can.wire import POSE, SceneView

PERIOD = 0.05


@dataclass
class Bench:
    """A transmitter and a monitor on one clock, without threads."""

    codec: Codec
    period: float = PERIOD
    script: list[Any] = field(default_factory=list)
    lateness: float = 0.0
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.clock, self.opener = Clock(), FakeOpener(*self.script)
        self.start = self.clock.now
        fd: dict[str, Any] = {"interface": "virtual", "channel": "scenes", "fd": True}
        self.link = Link(self.opener, clock=self.clock, **(fd if self.settings.get("fd") else {}))
        self.transmitter = Transmitter(
            self.link, self.codec, period=self.period, clock=self.clock, **self.settings
        )
        self.decoder = self.codec.decoder(cycle_ms=1e3 * self.period)
        self.rng = np.random.default_rng(1)
        self.owners: list[tuple[float, Any]] = []
        self.messages: list[can.Message] = []

    @property
    def time(self) -> float:
        return self.clock.now - self.start

    @property
    def now_ns(self) -> int:
        return round(self.time * 1e9)

    def run(self, end: float) -> None:
        """Send and receive until ``end`` [s], each transfer a little late."""
        queue = self.transmitter._tx_queue
        while (step := queue.wait(self.clock.now)) is not None and self.time + step <= end + 1e-9:
            self.clock.now += step + 1e-9 + self.rng.uniform(0, self.lateness)
            transfer = queue.take(self.clock.now)
            if transfer is not None:
                self.owners.append((self.time, transfer.owner))
                self.transmitter._send(transfer)
            self.receive()
        self.clock.now = max(self.clock.now, self.start + end)

    def receive(self) -> None:
        for i in range(self.opener.sent.qsize()):
            message = self.opener.sent.get(timeout=0)
            self.messages.append(message)
            self.decoder.feed(message.arbitration_id, message.data, self.now_ns + 250_000 * i)

    def view(self) -> SceneView:
        return self.decoder.latest_scene(self.now_ns)

    @property
    def lost(self) -> int:
        """Records missing by their counters, of lines and of the pose error."""
        return self.decoder.lost + self.decoder.checks[POSE].lost
