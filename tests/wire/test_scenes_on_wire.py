"""Scenes through codec and decoder: what is received is what was sent, within the roundings."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scene_layouts import layout_of
from support.scene_streams import (
    ALL,
    COMPLETE,
    CONDITIONAL,
    MAP_ERROR,
    PERIOD_NS,
    codec_of,
    feed,
    new_codec,
    road_scene,
)

from maplines_can import Codec, EncodeError, MapError, Scene, Slot
from maplines_can.wire import POSE, Owner

SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.NEXT_LEFT)
X = np.array([0.0, 20.0, 40.0])


def received(codec: Codec, scene: Scene, *, fd: bool = False) -> Scene:
    """Return a scene as received."""
    decoder = codec.decoder()
    counters: dict[Owner, int] = {POSE: 7, **{slot: 250 + 3 * slot for slot in Slot}}
    frames = codec.encoder().encode_scene(scene, fd=fd, counters=counters, age=0.02)
    _, t_ns = feed(decoder, frames, 0)
    view = decoder.latest_scene(t_ns)
    assert view.scene is not None
    assert view.age == pytest.approx(0.024 + t_ns / 1e9)
    return view.scene


def assert_covers(decoded: Scene, sent: Scene) -> None:
    """Check that the joint covariance covers that of the same lines as sent, and their errors."""
    slots = [line.slot for line in decoded.lines]
    true, found = sent.joint(slots), decoded.joint()
    d = found.mean - true.mean
    scale = 1 / np.sqrt(found.cov.diagonal())
    margin = (found.cov - true.cov - np.outer(d, d)) * np.outer(scale, scale)
    assert np.linalg.eigvalsh(found.cov * np.outer(scale, scale)).min() > 0
    assert np.linalg.eigvalsh(margin).min() > -1e-9


@pytest.mark.parametrize("fd", [False, True], ids=["classic", "fd"])
@pytest.mark.parametrize("dbc", ALL)
def test_a_scene_is_received_as_it_was_sent(dbc: str, fd: bool) -> None:
    scene = road_scene(SLOTS)
    decoded = received(codec_of(dbc), scene, fd=fd)

    assert [line.slot for line in decoded.lines] == list(SLOTS)
    assert_covers(decoded, scene)
    assert decoded.pose_error.correlation_time == 4.0
    assert decoded.map_error is not None
    assert 1 <= decoded.map_error.offset_sigma / MAP_ERROR.offset_sigma <= 2**0.125
    limit = 1.1 if dbc == CONDITIONAL else 1.3
    for name in ("width", "centre"):
        ours, theirs = getattr(decoded, name)(X), getattr(scene, name)(X)
        assert np.abs(ours.value - theirs.value).max() < 0.01
        ratio = ours.sigma / theirs.sigma
        assert ratio.min() >= 1 - 1e-6
        assert ratio.max() < (limit if name == "width" else 1.1)
    if dbc == CONDITIONAL:
        assert (decoded.fit_ranges == scene.fit_ranges).all()


@pytest.mark.parametrize("dbc", ALL)
def test_an_absent_slot_is_not_in_the_scene(dbc: str) -> None:
    """A sender that alternates scenes of different slots: each scene has the lines of its cycle."""
    codec = new_codec(dbc)
    encoder = codec.encoder()
    plans = [SLOTS, SLOTS[:1], SLOTS[1:], (), SLOTS[:2]]
    empty = Scene((), np.zeros((0, 0)), road_scene().pose_error, np.zeros((0, 2)))
    prepared = [encoder.prepare_scene(road_scene(slots) if slots else empty) for slots in plans]
    decoder, last = codec.decoder(), None
    for cycle in range(40):
        frames = encoder.encode_scene(prepared[cycle % len(plans)])
        _, t_ns = feed(decoder, {POSE: frames.pop(POSE)}, cycle * PERIOD_NS)
        if last is not None:  # the cycle before is over
            decoded = decoder.scene()
            assert decoded is not None
            assert decoded.t_ns == last * PERIOD_NS
            assert tuple(decoded.scene.index) == tuple(plans[last % len(plans)])
        feed(decoder, frames, t_ns)
        last = cycle if plans[cycle % len(plans)] else last
    assert decoder.lost == 0
    assert not decoder.counts


@settings(max_examples=40)
@example(radius=45.0, sigma=(0.03125, 0.5, 0.00390625), noise=(0.0, 0.0625, 0.02))
@given(
    radius=st.floats(25, 2000),
    sigma=st.tuples(st.floats(0.02, 1.0), st.floats(0.02, 0.5), st.floats(0.001, 0.03)),
    noise=st.tuples(st.floats(0, 0.05), st.floats(0, 0.1), st.floats(0, 0.02)),
)
def test_a_decoded_range_is_within_the_one_sent(radius: float, sigma: Any, noise: Any) -> None:
    """The room of 3 sigma at its ends does not get smaller, whatever is rounded."""
    scene = road_scene(SLOTS, radius=radius, sigma=sigma, map_error=MapError(*noise))
    decoder = codec_of(CONDITIONAL).decoder()
    feed(decoder, codec_of(CONDITIONAL).encoder().encode_scene(scene, counters={}), 0)
    decoded = decoder.scene()
    for line in decoded.scene.lines if decoded else ():
        sent = scene.line(line.slot)
        assert sent.x_min <= line.x_min <= line.x_max <= sent.x_max


#: The codec of a DBC without messages of the pose error, as it was before them.
BEFORE = Codec(replace(layout_of(COMPLETE), pose=None))


def test_a_dbc_without_a_pose_error_sends_no_scene() -> None:
    with pytest.raises(EncodeError, match="MapLinePose"):
        BEFORE.encoder().encode_scene(road_scene())
    with pytest.raises(ValueError, match="MapLinePose"):
        BEFORE.decoder().latest_scene(0)
