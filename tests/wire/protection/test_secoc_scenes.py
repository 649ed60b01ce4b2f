"""Authenticated whole scenes: freshness values of 4 bytes over restarts, losses and silences.

The receiver has a clock, or takes the times of the frames, as of a log.
"""

from typing import Any

import numpy as np
import pytest
from support.scene_streams import road_scene
from support.secoc_streams import MS, SECRET, US, Clock, S

from maplines_can import Codec, Scene
from maplines_can.values.errors import EncodeError, LayoutError
from maplines_can.wire import Authenticator, Key, Reason, default_dbc_path

#: What 4 bytes of microseconds can count [ns]: 71.6 minutes.
SPAN = 2**32 * US
CYCLE = 50 * MS


@pytest.fixture(scope="module")
def scene() -> Scene:
    return road_scene()


def codec_of(clock: Any, **rest: Any) -> Codec:
    keys = Authenticator(Key(SECRET), clock=clock, **rest)
    return Codec.from_dbc(default_dbc_path("maplines-scene.dbc"), authenticator=keys)


def sent(encoder: Any, scene: Scene) -> Any:
    """The frame of the message Scene."""
    (frame,) = encoder.encode_scene(scene, fd=True)["scene"]
    return frame


def answer(decoder: Any, frame: Any, clock: Clock) -> str:
    """The reason why a frame that is received now is dropped, or that its lines come."""
    found = decoder.feed(frame.can_id, frame.data, clock.now)
    return found.name if isinstance(found, Reason) else "lines"


def test_a_receiver_needs_a_clock() -> None:
    """Four bytes of a freshness value cannot be completed without one."""
    with pytest.raises(LayoutError, match=r"4 bytes, but without a clock 7 are needed"):
        codec_of(None)


@pytest.mark.parametrize(
    "silence", [CYCLE, 17 * CYCLE, SPAN - US, SPAN, SPAN + CYCLE, 3 * SPAN, 86_400 * S]
)
@pytest.mark.parametrize("of_log", [False, True])
def test_any_number_of_frames_may_be_lost(scene: Scene, silence: int, of_log: bool) -> None:
    """Also more than the truncated value counts; and what was recorded before is not accepted.

    A receiver that has just started has no last value: its clock alone completes one.
    """
    clock = Clock()
    encoder, codec = codec_of(clock).encoder(), codec_of("frames" if of_log else clock)
    decoder, before = codec.decoder(), sent(encoder, scene)
    assert answer(decoder, before, clock) == "lines"
    clock.now += silence
    now = sent(encoder, scene)
    assert answer(decoder, now, clock) == answer(codec.decoder(), now, clock) == "lines"
    assert answer(decoder, before, clock) in ("REPLAY", "MAC")


@pytest.mark.parametrize(
    ("late", "expected"),
    [
        pytest.param(CYCLE, "lines", id="within-the-window"),
        pytest.param(S, "lines", id="the-window"),
        pytest.param(S + US, "AGE", id="older"),
        pytest.param(SPAN, "AGE", id="same-low-bytes"),
        pytest.param(2 * SPAN, "MAC", id="twice"),
    ],
)
@pytest.mark.parametrize("of_log", [False, True])
def test_a_recording_to_a_receiver_that_restarts(
    scene: Scene, late: int, expected: str, of_log: bool
) -> None:
    """Its full freshness value comes from the clock: only a recording within the window passes."""
    clock = Clock()
    recorded = sent(codec_of(clock).encoder(), scene)
    clock.now += late
    decoder = codec_of("frames" if of_log else clock).decoder()
    assert answer(decoder, recorded, clock) == expected
    clock.now += US
    assert answer(decoder, sent(codec_of(clock).encoder(), scene), clock) in ("lines", "DUPLICATE")
    assert answer(decoder, recorded, clock) != "lines"


@pytest.mark.parametrize("t_ns", [0, -1, -(10**18), 2**62])
def test_a_log_without_absolute_times_has_no_lines(scene: Scene, t_ns: int) -> None:
    """Its times do not complete the freshness values."""
    clock = Clock()
    frame, decoder = sent(codec_of(clock).encoder(), scene), codec_of("frames").decoder()
    assert decoder.feed(frame.can_id, frame.data, t_ns) is Reason.MAC


def test_a_sender_needs_a_clock_of_its_own(scene: Scene) -> None:
    with pytest.raises(EncodeError, match="an authenticator that sends needs a clock"):
        sent(codec_of("frames").encoder(), scene)


@pytest.mark.parametrize("clock", ["frame", np.array([1, 2])])
def test_what_is_no_clock_is_refused(clock: Any) -> None:
    with pytest.raises(ValueError, match=r'"frames", got an? (str|ndarray)'):
        codec_of(clock)
