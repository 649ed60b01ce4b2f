"""Scenes of two senders on one bus, through a monitor that tells them apart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple

from support.scene_streams import FRAME_NS, PERIOD_NS, codec_of, road_scene

from maplines_can import MapLine, Scene, Slot
from maplines_can.wire import POSE, Frame, PreparedScene
from maplines_can.wire.layout.pose_layout import Owner

SLOTS = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
#: Radius of the bend [m] and standard deviation of the pose error across [m] of each sender.
RADIUS, SIGMA = (400.0, -200.0), (0.2, 0.4)


class Event(NamedTuple):
    """A frame of a sender."""

    t_ns: int
    sender: int
    frame: Frame


@dataclass(frozen=True)
class Sender:
    """One of two senders; times are in cycles of the DBC."""

    number: int
    every: int = 1  #: cycles between its scenes
    start: float = 0.0
    stop: float = float("inf")
    counters: Mapping[Any, int] = field(default_factory=dict)  #: first ones; 0 if there is none
    slots: Sequence[Slot] = SLOTS
    sends_pose: bool = True

    def events(self, dbc: str, cycles: float) -> Iterator[Event]:
        """Yield its frames, a scene every ``every`` cycles."""
        owners: list[Owner] = [POSE, *self.slots]
        scene, codec, k = prepared(dbc, self.number, tuple(self.slots)), codec_of(dbc), 0
        while (t := self.start + k * self.every) < min(self.stop, cycles):
            counters = {owner: (self.counters.get(owner, 0) + k) % 256 for owner in owners}
            owned = codec.encoder().encode_scene(scene, counters=counters)
            frames = [f for o, of in owned.items() if o != POSE or self.sends_pose for f in of]
            for i, frame in enumerate(frames):
                yield Event(round(t * PERIOD_NS) + i * FRAME_NS, self.number, frame)
            k += 1


@cache
def prepared(dbc: str, sender: int, slots: tuple[Slot, ...]) -> PreparedScene:
    """Return the scene of a sender."""
    sigma = (0.3, SIGMA[sender], 0.005)
    return (
        codec_of(dbc).encoder().prepare_scene(road_scene(slots, radius=RADIUS[sender], sigma=sigma))
    )


def senders_of_line(line: MapLine) -> set[int]:
    """Return the sender of the mean of a line."""
    return {int(line.gaussian.mean[2] < 0)}


def senders_of(scene: Scene) -> set[int]:
    """Return the senders of a scene: of its pose error and of its lines."""
    across = scene.pose_error.cov[1, 1] ** 0.5
    return set[int]({int(across > sum(SIGMA) / 2)}).union(*map(senders_of_line, scene.lines))


def merged(dbc: str, senders: Sequence[Sender], cycles: float) -> list[Event]:
    """Return the frames of all senders in the order of time."""
    events = [event for sender in senders for event in sender.events(dbc, cycles)]
    return sorted(events, key=lambda event: event[:2])
