"""Scenes on a road, and their frames through a receiver."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import cache
from itertools import chain
from typing import Any, NamedTuple

import numpy as np
from scene_layouts import layout_of

from maplines_can import Codec, Gaussian, MapError, Polyline, Scene, Slot, map_scene
from maplines_can.wire import Authenticator, Decoder, Frame, Key, PreparedScene, Reason

#: Offsets of the lines from the car [m].
OFFSETS = {
    Slot.EGO_LEFT: 1.75,
    Slot.EGO_RIGHT: -1.75,
    Slot.NEXT_LEFT: 5.25,
    Slot.NEXT_RIGHT: -5.25,
    Slot.CENTRE: 0.0,
    Slot.EDGE_LEFT: 7.0,
    Slot.EDGE_RIGHT: -7.0,
    Slot.ROUTE: 0.4,
}
CONDITIONAL, COMPLETE, SECURED = "maplines-pose.dbc", "maplines.dbc", "maplines-secoc.dbc"
ALL = (CONDITIONAL, COMPLETE, SECURED)
MAP_ERROR = MapError(point_sigma=0.05, offset_sigma=0.05, heading_sigma=0.001)
PERIOD_NS, FRAME_NS = 50_000_000, 250_000


@cache
def codec_of(dbc: str) -> Codec:
    """Return the codec of one of the project's DBCs, for tests that leave its counters alone."""
    return new_codec(dbc)


def new_codec(dbc: str) -> Codec:
    """Return a codec of one of the project's DBCs with counters of its own."""
    return Codec(layout_of(dbc))


def authenticated_codec(dbc: str) -> Codec:
    """Return a codec with a key."""
    key = Key(bytes(range(16)), key_id=1)
    return Codec(layout_of(dbc), Authenticator(key, clock=lambda: 10**18))


def road_scene(
    slots: Iterable[Slot] = (Slot.EGO_LEFT, Slot.EGO_RIGHT),
    *,
    radius: float = 400.0,
    sigma: Any = (0.3, 0.2, 0.005),
    map_error: MapError | None = MAP_ERROR,
    **settings: Any,
) -> Scene:
    """Return lines of a bend with this radius, seen from an uncertain pose."""
    s = np.arange(-100.0, 200.0, 2.0)[:, None] / radius
    lines = {
        slot: Polyline(
            np.hstack(
                [
                    (radius - OFFSETS[slot]) * np.sin(s),
                    radius - (radius - OFFSETS[slot]) * np.cos(s),
                ]
            )
        )
        for slot in slots
    }
    ego = Gaussian([0, 0, 0], np.diag(sigma) ** 2)
    return map_scene(lines, ego, map_error=map_error, **{"correlation_time": 4.0} | settings)


def beyond(scene: Scene, slot: Slot) -> Scene:
    """The same scene with a line that no message can state."""
    place, lines = scene.index[slot], [*scene.lines]
    line = lines[place]
    mean = [1e3, *line.gaussian.mean[1:]]
    lines[place] = replace(line, gaussian=Gaussian(mean, line.gaussian.cov))
    return replace(scene, lines=tuple(lines))


def random_scenes(n: int, seed: int) -> Iterator[Scene]:
    """Yield bends with lines of any slots, seen from poses that are known well or poorly."""
    rng = np.random.default_rng(seed)
    for _ in range(n):
        slots = rng.permutation([*Slot])[: rng.integers(1, 9)]
        yield road_scene(
            [Slot(int(slot)) for slot in slots],
            radius=float(rng.choice([60.0, 200.0, 2000.0])),
            sigma=np.array([0.3, 0.2, 0.005]) * 10.0 ** rng.uniform(-1.5, 1, 3),
            map_error=[None, MAP_ERROR, MapError(0.05, 0.05), MapError(offset_sigma=0.3)][
                rng.integers(4)
            ],
            correlation_time=float(rng.choice([0.3, 4.0, np.inf])),
        )


def feed(
    receiver: Decoder, frames: Mapping[Any, list[Frame]], t_ns: int, apart_ns: int = FRAME_NS
) -> tuple[list[Any], int]:
    """Feed the frames of a cycle; return the lines and reasons, and the time after them."""
    answers: list[Any] = []
    for own in frames.values():
        for frame in own:
            answer = receiver.feed(frame.can_id, frame.data, t_ns)
            answers += [answer] if isinstance(answer, Reason) else answer
            t_ns += apart_ns
    return answers, t_ns


class Passed(NamedTuple):
    """A scene that was sent, and what is received of it."""

    prepared: PreparedScene
    frames: dict[Any, list[Frame]]
    received: Scene | None  #: None if it is a pose error without lines

    @property
    def full(self) -> list[Slot]:
        """Lines of which all entries of the line-specific covariance are sent."""
        pages = self.prepared.layout.pages
        return [s for s in self.prepared.sent_slots if len(self.frames[s]) == pages]

    @property
    def scene(self) -> Scene:
        """The scene as received; there must be one."""
        assert self.received is not None
        return self.received


def passed(dbc: str | Codec, scene: Scene, *, fd: bool = False, age: float = 0.0) -> Passed:
    """Send a scene, and receive it."""
    codec = codec_of(dbc) if isinstance(dbc, str) else dbc
    encoder, decoder = codec.encoder(), codec.decoder()
    prepared = encoder.prepare_scene(scene, fd=fd)
    frames = encoder.encode_scene(prepared, fd=fd, age=age)
    for frame in chain.from_iterable(frames.values()):
        decoder.feed(frame.can_id, frame.data, 0)
    found = decoder.scene()
    received = None if found is None or not found.scene.lines else found.scene
    return Passed(prepared, frames, received)
