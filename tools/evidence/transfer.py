"""Scenes over a bus without faults, to what a receiver has of them."""

from __future__ import annotations

from functools import cache

from maplines_can import Codec, Scene
from maplines_can.wire import Decoder, Encoder, PreparedScene, default_dbc_path


@cache
def codec_of(dbc: str = "maplines.dbc") -> Codec:
    """Return the codec of a DBC of the package."""
    return Codec.from_dbc(default_dbc_path(dbc))


def transferred(codec: Codec, scene: Scene | PreparedScene, *, fd: bool = False) -> Scene | None:
    """Return a scene as a new receiver has it from a new sender; None if it has none."""
    decoder = codec.decoder()
    for frames in codec.encoder().encode_scene(scene, fd=fd).values():
        for frame in frames:
            decoder.feed(frame.can_id, frame.data, 0)
    received = decoder.scene()
    return None if received is None else received.scene


def feed(
    encoder: Encoder, decoder: Decoder, scene: Scene, t: float, age: float, step: float
) -> int:
    """Feed the frames of a scene that is sent at a time to its receiver, so far apart [s].

    Returns:
        the time after the last one [ns].
    """
    ns = round(1e9 * t)
    for frames in encoder.encode_scene(scene, age=age).values():
        for frame in frames:
            decoder.feed(frame.can_id, frame.data, ns)
            ns += round(1e9 * step)
    return ns
