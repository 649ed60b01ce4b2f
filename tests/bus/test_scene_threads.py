"""Scenes on a virtual bus, with the threads of a transmitter, a receiver and a consumer."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle
from typing import Any

import pytest
from support.fake_bus import LONG, FakeTime, wait_until
from support.scene_streams import COMPLETE, CONDITIONAL, PERIOD_NS, road_scene

from maplines_can import Codec, Link, Receiver, Scene, Slot, Transmitter
from maplines_can.wire import default_dbc_path

SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.ROUTE)
#: Lateral standard deviation of the pose [m] that is published with a bend of this radius [m].
SIGMA_OF_RADIUS = {200.0: 0.2, 400.0: 0.4, -200.0: 0.3}
#: Cycles of the test, and the first one whose scene is usable: six OKs after the first one.
CYCLES, FIRST_USABLE = 10, 6


def radius_of(scene: Scene) -> float:
    """Return the radius of the bend of a scene; all lines and the pose must be those of one."""
    curvatures = scene.means[:, 2]
    (radius,) = {min(SIGMA_OF_RADIUS, key=lambda r: abs(1 / r - c0)) for c0 in curvatures}
    sigma = scene.pose_error.cov[1, 1] ** 0.5
    assert min(SIGMA_OF_RADIUS, key=lambda r: abs(SIGMA_OF_RADIUS[r] - sigma)) == radius
    return radius


def watch(receiver: Receiver, stop: threading.Event) -> None:
    """Check each view of the newest scene, until the end of the test."""
    newest_ns = 0
    while not stop.wait(0.001):
        view = receiver.latest_scene()
        if view.received is None:
            continue
        scene, _, t_ns, _ = view.received
        assert t_ns >= newest_ns
        newest_ns = t_ns
        assert set(scene.index) <= set(SLOTS)
        radius_of(scene)


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_a_consumer_sees_whole_scenes(monkeypatch: Any, channel: Any, dbc: str) -> None:
    """While one thread publishes scenes, one sends them, one receives and one looks at them.

    The time of all threads is that of the test, which goes on when the frames that are due have
    been received, so that none of them is late on a busy machine.
    """
    monkeypatch.setattr("maplines_can.bus.receiver.time", now := FakeTime())
    codec = Codec.from_dbc(default_dbc_path(dbc))
    scenes = [
        codec.encoder().prepare_scene(road_scene(SLOTS, radius=radius, sigma=(0.3, sigma, 0.005)))
        for radius, sigma in SIGMA_OF_RADIUS.items()
    ]
    others, stop, start_ns = cycle(scenes), threading.Event(), now.ns
    decoder = Codec.from_dbc(default_dbc_path(dbc)).decoder()
    bus = {"interface": "virtual", "channel": channel}
    with (
        Link(**bus, preserve_timestamps=True) as link,
        Link(**bus) as other,
        ThreadPoolExecutor(1) as pool,
        Receiver(other, decoder, on_line=lambda _: None) as receiver,
        Transmitter(link, codec, period=PERIOD_NS / 1e9, clock=now.monotonic) as transmitter,
    ):
        watching = pool.submit(watch, receiver, stop)
        try:
            for k in range(CYCLES):
                pose_ns = start_ns + k * PERIOD_NS + 1_000_000
                now.ns = pose_ns - 1_000_000 * (k == 0)
                transmitter.publish(scenes[k % len(scenes)])
                now.ns = pose_ns
                wait_until(lambda: receiver.stats().pose_errors == k + 1)  # noqa: B023
                for i, slot in enumerate(SLOTS):
                    now.ns = pose_ns + slot * PERIOD_NS // len(Slot)

                    def has_come() -> bool:
                        transmitter.publish(next(others))  # in the midst of the cycle
                        return receiver.stats().lines == len(SLOTS) * k + i + 1  # noqa: B023

                    wait_until(has_come)
                view = receiver.latest_scene()
                assert view.received is not None
                assert view.received.t_ns == pose_ns
                assert set(view.received.scene.index) == set(SLOTS)
                assert radius_of(view.received.scene) == [*SIGMA_OF_RADIUS][k % len(scenes)]
                assert view.usable is (k >= FIRST_USABLE)
        finally:
            stop.set()
        watching.result(LONG)
        stats = receiver.stats()
    assert not stats.counts
    assert stats.lost == 0
