"""Scenes on a virtual bus, with the threads of a transmitter, a receiver and a consumer."""

from __future__ import annotations

import queue
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from itertools import cycle
from typing import Any

import pytest
from fake_bus import LONG
from scene_streams import COMPLETE, CONDITIONAL, road_scene

from maplines_can import Codec, Receiver, Scene, Slot, Transmitter
from maplines_can.wire import Reason, SceneView, default_dbc_path

SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.ROUTE)
#: Lateral standard deviation of the pose [m] that is published with a bend of this radius [m].
SIGMA_OF_RADIUS = {200.0: 0.2, 400.0: 0.4, -200.0: 0.3}
#: Number of scenes with all lines that the consumer shall see.
SCENES = 8

Views = queue.SimpleQueue[SceneView | None]


def radius_of(scene: Scene) -> float:
    """Return the radius of the bend of a scene; all lines and the pose must be those of one."""
    curvatures = scene.means[:, 2]
    (radius,) = {min(SIGMA_OF_RADIUS, key=lambda r: abs(1 / r - c0)) for c0 in curvatures}
    sigma = scene.pose_error.cov[1, 1] ** 0.5
    assert min(SIGMA_OF_RADIUS, key=lambda r: abs(SIGMA_OF_RADIUS[r] - sigma)) == radius
    return radius


def watch(receiver: Receiver, stop: threading.Event, complete: Views) -> None:
    """Check each view of the newest scene; put those with all lines, once, and None at the end."""
    newest_ns, seen = 0, None
    try:
        while not stop.wait(0.001):
            view = receiver.latest_scene()
            if view.received is None:
                continue
            scene, _, t_ns, _ = view.received
            assert t_ns >= newest_ns
            newest_ns = t_ns
            assert set(scene.index) <= set(SLOTS)
            radius_of(scene)
            if len(scene.index) == len(SLOTS) and seen != (t_ns, view.usable):
                seen = t_ns, view.usable
                complete.put(view)
    finally:
        complete.put(None)


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_a_consumer_sees_whole_scenes(link: Any, other: Any, dbc: str) -> None:
    """While one thread publishes scenes, one sends them, one receives and one looks at them."""
    codec = Codec.from_dbc(default_dbc_path(dbc))
    scenes = [
        codec.prepare_scene(road_scene(SLOTS, radius=radius, sigma=(0.3, sigma, 0.005)))
        for radius, sigma in SIGMA_OF_RADIUS.items()
    ]
    decoder = Codec.from_dbc(default_dbc_path(dbc)).decoder()
    stop, complete = threading.Event(), Views()
    with (
        ThreadPoolExecutor(1) as pool,
        Receiver(other, decoder, on_line=lambda _: None) as receiver,
        Transmitter(link, codec, period=0.05) as transmitter,
    ):
        watching = pool.submit(watch, receiver, stop, complete)
        end, views = time.monotonic() + LONG, list[SceneView]()
        try:
            for scene in cycle(scenes):
                transmitter.publish(scene)
                if (view := complete.get(timeout=LONG)) is None:
                    break  # an assertion failed; it is raised below
                views.append(view)
                radii = {radius_of(one.received.scene) for one in views if one.received}
                is_enough = len(views) >= SCENES and radii == SIGMA_OF_RADIUS.keys()
                if (is_enough and any(one.usable for one in views)) or time.monotonic() > end:
                    break
        finally:
            stop.set()
        watching.result(LONG)
        stats = receiver.stats()
    assert is_enough
    assert any(one.usable for one in views)
    assert not stats.counts.keys() & {Reason.CRC, Reason.MIXED, Reason.CONTENT}
