"""Whole scenes from a transmitter to a receiver on simulated time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from support.fake_bus import FULL, FakeOpener
from support.scene_streams import authenticated_codec, codec_of, road_scene
from support.transmitter_bench import PERIOD, Bench

from maplines_can import EncodeError, LeftOut, Link, Slot, Transmitter
from maplines_can.bus.tx_queue import ALLOWANCE
from maplines_can.wire import SCENE, SCENE2

DBC = "maplines-scene.dbc"
FIRST, SECOND = 0x379, 0x378
EGO = (Slot.EGO_LEFT, Slot.EGO_RIGHT)

Make = Callable[..., Bench]


def ids(bench: Bench) -> list[int]:
    return [message.arbitration_id for message in bench.messages]


def slots_of(bench: Bench) -> set[Slot]:
    scene = bench.view().scene
    assert scene is not None
    return {*scene.index}


def test_a_scene_is_one_transfer_in_each_period(make_bench: Make) -> None:
    """Scene2 goes before Scene, so that the scene is complete when that comes."""
    bench, scene = make_bench(DBC), road_scene(Slot)
    for cycle in range(12):
        bench.transmitter.publish(scene)
        bench.run((cycle + 0.5) * PERIOD)
        assert slots_of(bench) == {*Slot}
    assert ids(bench) == [SECOND, FIRST] * 12
    assert all(message.is_fd for message in bench.messages)
    assert [owner for _, owner in bench.owners] == [SCENE] * 12
    times = [time for time, _ in bench.owners]
    assert times == pytest.approx([cycle * PERIOD for cycle in range(12)], abs=1e-6)
    assert bench.decoder.lost == 0
    assert not bench.decoder.counts
    assert bench.view().usable
    stats = bench.transmitter.stats()
    assert (stats.pose_errors, stats.lines, stats.frames, stats.left_out) == (24, 96, 24, {})


def test_few_lines_take_one_frame_until_there_are_more(make_bench: Make) -> None:
    bench = make_bench(DBC)
    for cycle, slots in enumerate((EGO, (*EGO, Slot.ROUTE), [*Slot][:5], EGO)):
        bench.transmitter.publish(road_scene(slots))
        bench.run((cycle + 0.5) * PERIOD)
        assert slots_of(bench) == {*slots}
    assert ids(bench) == [FIRST, FIRST, SECOND, FIRST, SECOND, FIRST]


def test_a_late_scene_has_its_counters_and_places_and_a_greater_age(make_bench: Make) -> None:
    """Whatever the number of attempts, and if deadlines are skipped."""
    bench, rng = make_bench(DBC), np.random.default_rng(3)
    scenes = [road_scene(Slot), road_scene((*EGO, Slot.ROUTE, Slot.CENTRE))]
    bench.transmitter.publish(scenes[0])
    queue = bench.transmitter._tx_queue
    for cycle in range(30):
        bench.transmitter.publish(scenes[cycle % 2])
        bench.clock.now += (queue.wait(bench.clock.now) or 0.0) + rng.uniform(0, 2.5) * PERIOD
        transfer = queue.take(bench.clock.now)
        assert transfer is not None
        again = transfer
        for _ in range(int(rng.integers(3))):
            again = queue.renew(again, again.latest + 0.002)
        assert [frame.can_id for frame in again.frames] == [SECOND, FIRST]
        for frame, other in zip(transfer.frames, again.frames, strict=True):
            assert (frame.data[2], other.data[2]) == (cycle, cycle)
            assert frame.data[12:] == other.data[12:]  # all lines
        assert again.latest >= transfer.latest >= transfer.deadline + ALLOWANCE
        bench.transmitter._send(again)
        bench.receive()
    assert bench.decoder.lost == 0
    assert not bench.decoder.counts


def test_a_full_queue_delays_a_scene(make_bench: Make) -> None:
    """Of which one frame was sent already."""
    bench = make_bench(DBC, script=[None, FULL, FULL, None, FULL])
    bench.transmitter.publish(road_scene(Slot))
    bench.run(3.95 * PERIOD)
    assert slots_of(bench) == {*Slot}
    assert bench.transmitter.stats().retries == 3
    assert bench.decoder.lost == 0


def test_a_retracted_line_is_in_no_scene(make_bench: Make) -> None:
    """Its place is empty, until it is published again."""
    bench = make_bench(DBC)
    bench.transmitter.publish(road_scene(Slot))
    bench.run(PERIOD)
    bench.transmitter.retract(Slot.EGO_LEFT)
    bench.run(2 * PERIOD)
    assert slots_of(bench) == {*Slot} - {Slot.EGO_LEFT}
    bench.transmitter.publish(road_scene(Slot))
    bench.run(3 * PERIOD)
    assert slots_of(bench) == {*Slot}


def test_lines_without_a_place_are_counted(make_bench: Make) -> None:
    """With a key, two of eight lines at each call."""
    bench = make_bench(DBC, codec=authenticated_codec(DBC))
    for cycle in range(3):
        bench.transmitter.publish(road_scene(Slot))
        bench.run((cycle + 0.5) * PERIOD)
    assert len(slots_of(bench)) == 6
    assert ids(bench) == [SECOND + 2, FIRST + 2] * 3
    stats = bench.transmitter.stats()
    assert (stats.left_out, stats.lines) == ({LeftOut.PLACE: 6}, 18)
    assert not bench.decoder.counts


def test_what_is_no_scene_in_can_fd_is_refused() -> None:
    """When the transmitter is made, or at the call."""
    settings: dict[str, Any] = {"interface": "virtual", "channel": "whole"}
    with Link(FakeOpener(), **settings) as link, pytest.raises(EncodeError, match="fd=True"):
        Transmitter(link, codec_of(DBC))
    with Link(FakeOpener(), fd=True, **settings) as link:
        transmitter = Transmitter(link, codec_of(DBC), fd=True)
        with pytest.raises(EncodeError, match="publish the result of map_scene"):
            transmitter.publish(road_scene(EGO).lines)


def test_after_scenes_of_another_number_of_messages_the_join_holds(make_bench: Make) -> None:
    """Whichever frames are lost, a scene is of one cycle."""
    bench, rng = make_bench(DBC), np.random.default_rng(5)
    bench.receive = lambda: None  # type: ignore[method-assign]
    for cycle in range(40):
        bench.transmitter.publish(road_scene(Slot, radius=200.0 + 10 * cycle))
        bench.run((cycle + 0.5) * PERIOD)
        for i in range(bench.opener.sent.qsize()):
            message = bench.opener.sent.get(timeout=0)
            if rng.random() > 0.2:
                bench.decoder.feed(message.arbitration_id, message.data, bench.now_ns + i)
        scene = bench.view().scene
        if scene is not None:
            curvatures = {round(1 / line.gaussian.mean[2], -1) for line in scene.lines}
            assert max(curvatures) - min(curvatures) < 30
    assert {SCENE, SCENE2} <= bench.decoder.checks.keys()
