"""A transmitter and a receiver on one simulated clock, without threads."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import can
import numpy as np
from support.fake_bus import Clock, FakeOpener

from maplines_can import Codec, Link, MapLine, Slot, Transmitter
from maplines_can.wire import POSE, Reason, SceneView

PERIOD = 0.05


@dataclass
class Bench:
    """A transmitter and a monitor on one clock, without threads."""

    codec: Codec
    period: float = PERIOD
    script: list[Any] = field(default_factory=list)
    lateness: float = 0.0
    loss: float = 0.0  #: share of transfers whose first frame is lost
    transit: float = 0.0  #: longest time of a frame on the bus [s]
    seed: int = 1
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
        self.rng = np.random.default_rng(self.seed)
        self.owners: list[tuple[float, Any]] = []
        self.messages: list[can.Message] = []
        self.lines: list[MapLine] = []

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
        is_lost = self.loss > 0 and self.rng.random() < self.loss
        for i in range(self.opener.sent.qsize()):
            message = self.opener.sent.get(timeout=0)
            self.messages.append(message)
            transit = self.rng.uniform(0, self.transit) if self.transit else 0.0
            t_ns = self.now_ns + round(1e9 * transit) + 250_000 * i
            if not (is_lost and i == 0):
                found = self.decoder.feed(message.arbitration_id, message.data, t_ns)
                self.lines += [] if isinstance(found, Reason) else found

    def view(self) -> SceneView:
        return self.decoder.latest_scene(self.now_ns)

    @property
    def slots(self) -> tuple[Slot, ...]:
        """The slots of the newest scene."""
        scene = self.view().scene
        return () if scene is None else tuple(scene.index)

    @property
    def lost(self) -> int:
        """Records missing by their counters, of lines and of the pose error."""
        return self.decoder.lost + sum(
            check.lost for owner, check in self.decoder.checks.items() if owner == POSE
        )
