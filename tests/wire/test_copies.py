"""Codecs, encoders and prepared scenes in other processes: pickled and copied."""

import pickle
from collections.abc import Callable
from copy import copy, deepcopy
from typing import Any

import numpy as np
import pytest
from support.scene_streams import (
    ALL,
    COMPLETE,
    CONDITIONAL,
    authenticated_codec,
    new_codec,
    road_scene,
)

from maplines_can import Codec, MapLine, Slot
from maplines_can.bus import Link, Transmitter
from maplines_can.wire import Encoder

WHOLE = "maplines-scene.dbc"
LINE = MapLine.mean_only(Slot.EGO_LEFT, [1.75, 0.01, 0, 0], x_max=60.0, age=0.02)
MEANS, COVS = [[1.75, 0, 0, 0]], [np.diag([0.01, 1e-4, 1e-8, 1e-12])]


def pickled(value: Any) -> Any:
    return pickle.loads(pickle.dumps(value))  # noqa: S301


COPIES = [
    pytest.param(pickled, id="pickle"),
    pytest.param(copy, id="copy"),
    pytest.param(deepcopy, id="deepcopy"),
]


def frames_of(encoder: Encoder, dbc: str, slots: Any = (Slot.EGO_LEFT, Slot.EGO_RIGHT)) -> Any:
    """Return what an encoder sends next: a scene, and a line if the DBC takes it by itself."""
    sent = encoder.encode_scene(road_scene(slots), age=0.03, fd=dbc == WHOLE)
    return sent, None if dbc in (CONDITIONAL, WHOLE) else encoder.encode(LINE)


@pytest.mark.parametrize("dbc", [*ALL, WHOLE])
@pytest.mark.parametrize("again", COPIES)
def test_a_copy_does_the_same(again: Callable[[Any], Any], dbc: str) -> None:
    """A codec, its batches, an encoder with counters and places of its own, and prepared scenes."""
    codec, fd = new_codec(dbc), dbc == WHOLE
    other: Codec = again(codec)
    assert (repr(other), other.can_ids) == (repr(codec), codec.can_ids)
    encoder = codec.encoder()
    frames_of(encoder, dbc, Slot)  # the counters advance, and whole scenes have two messages
    prepared = again(encoder.prepare_scene(road_scene(), fd=fd))
    copied, found = again(encoder), again(encoder)
    assert frames_of(found, dbc) == frames_of(copied, dbc) == frames_of(encoder, dbc)
    assert found.encode_scene(prepared, fd=fd) == encoder.encode_scene(road_scene(), fd=fd)
    assert other.encoder().encode_scene(road_scene(), fd=fd) == (
        codec.encoder().encode_scene(prepared, fd=fd)
    )
    if dbc not in (CONDITIONAL, WHOLE):
        records = codec.batch.encode(MEANS, COVS)
        assert again(codec.batch).encode(MEANS, COVS).tobytes() == records.tobytes()
        expected, found = (one.batch.decode(records).cov for one in (codec, other))
        assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize("again", [pickled, deepcopy])
def test_a_key_is_never_written(again: Callable[[Any], Any]) -> None:
    """A codec with an authenticator names the cure; so does its encoder."""
    codec = authenticated_codec("maplines-secoc.dbc")
    for value in (codec, codec.encoder()) if again is pickled else (codec,):
        with pytest.raises(TypeError, match=r"Key cannot be pickled or copied.*key_from_file"):
            again(value)


@pytest.mark.parametrize("again", COPIES)
def test_what_has_a_state_cannot_be_copied(again: Callable[[Any], Any]) -> None:
    """A decoder, and threads that send; the message says what to pickle instead."""
    codec = new_codec(COMPLETE)
    with pytest.raises(TypeError, match=r"a Decoder cannot be pickled.*pickle the Codec"):
        again(codec.decoder())
    with (
        Link(interface="virtual", channel="copies") as link,
        pytest.raises(TypeError, match=r"a Transmitter cannot be pickled.*pickle the Codec"),
    ):
        again(Transmitter(link, codec))
