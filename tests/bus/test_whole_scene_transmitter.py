"""Whole scenes from a transmitter to a receiver on simulated time."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from support.fake_bus import FakeOpener
from support.scene_streams import authenticated_codec, codec_of, road_scene
from support.transmitter_bench import PERIOD, Bench

from maplines_can import EncodeError, LeftOut, Link, Slot, Transmitter
from maplines_can.wire import SCENE

DBC = "maplines-scene.dbc"
FIRST, SECOND = 0x379, 0x378
EGO = (Slot.EGO_LEFT, Slot.EGO_RIGHT)

Make = Callable[..., Bench]


def ids(bench: Bench) -> list[int]:
    return [message.arbitration_id for message in bench.messages]


def test_a_scene_is_one_transfer_in_each_period(make_bench: Make) -> None:
    """Scene2 goes before Scene, so that the scene is complete when that comes."""
    bench, scene = make_bench(DBC), road_scene(Slot)
    for cycle in range(12):
        bench.transmitter.publish(scene)
        bench.run((cycle + 0.5) * PERIOD)
        assert {*bench.slots} == {*Slot}
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


def test_lines_without_a_place_are_counted(make_bench: Make) -> None:
    """With a key, two of eight lines at each call."""
    bench = make_bench(DBC, codec=authenticated_codec(DBC))
    for cycle in range(3):
        bench.transmitter.publish(road_scene(Slot))
        bench.run((cycle + 0.5) * PERIOD)
    assert len(bench.slots) == 6
    assert ids(bench) == [SECOND + 2, FIRST + 2] * 3
    stats = bench.transmitter.stats()
    assert (stats.left_out, stats.lines) == ({LeftOut.PLACE: 6}, 18)
    assert not bench.decoder.counts


def test_what_is_no_scene_in_can_fd_is_refused() -> None:
    """When the transmitter is made, or at the call."""
    settings: dict[str, Any] = {"interface": "virtual", "channel": "whole"}
    with Link(FakeOpener(), **settings) as link, pytest.raises(EncodeError, match="fd=True"):
        Transmitter(link, codec_of(DBC))
    for dbc in (DBC, "maplines-pose.dbc"):
        with Link(FakeOpener(), fd=True, **settings) as link:
            transmitter = Transmitter(link, codec_of(dbc), fd=True)
            for lines in (road_scene(EGO).lines, road_scene(EGO).lines[0]):
                with pytest.raises(EncodeError, match=f"{dbc}: .*publish the result of map_scene"):
                    transmitter.publish(lines)
            transmitter.publish([])  # no lines at all are none that do not fit
