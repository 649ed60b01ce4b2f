"""Lane fusion on scenes that were encoded and decoded, in a simulated car."""

from typing import Any

import numpy as np
import pytest

from maplines_can import Codec, Gaussian, MapError, MapLine, Motion, Polyline, Slot, map_scene
from maplines_can.consumers import FusedLane, LaneFusion
from maplines_can.wire import default_dbc_path

LANE = (Slot.EGO_LEFT, Slot.EGO_RIGHT)
P = np.diag([0.3, 0.2, 0.003]) ** 2
CYCLE = 50_000_000
CAMERA_COV = np.diag([0.05, 0.005, 5e-4, 2e-5]) ** 2


class Car:
    """Car that drives straight ahead in the middle of a lane of 3.5 m, and is off its pose."""

    def __init__(self, across: float = 0.0, time: float = 10.0, speed: float = 10.0) -> None:
        self.codec = Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))
        self.encoder, self.decoder = self.codec.encoder(), self.codec.decoder()
        self.across, self.time, self.speed, self.cycle = across, time, speed, 0
        self.slots: tuple[Slot, ...] = LANE

    def send(self) -> int:
        """Send the next scene; return the time after it."""
        x = self.cycle * self.speed * CYCLE / 1e9
        lines = {
            slot: Polyline([[x - 200, y], [x + 300, y]])
            for slot, y in zip(LANE, (1.75, -1.75), strict=True)
            if slot in self.slots
        }
        scene = map_scene(
            lines,
            Gaussian([x, self.across, 0], P),
            map_error=MapError(0.02, 0.05),
            correlation_time=self.time,
        )
        t_ns = self.cycle * CYCLE
        for frames in self.encoder.encode_scene(scene, age=0.0).values():
            for frame in frames:
                self.decoder.feed(frame.can_id, frame.data, t_ns)
                t_ns += 250_000
        self.cycle += 1
        return t_ns

    def step(self, fusion: LaneFusion, t_ns: int, motion: Motion, camera: Any = ()) -> FusedLane:
        """Fuse what has arrived by a time."""
        return fusion.step(t_ns, self.decoder.latest_scene(t_ns), motion, camera)

    def run(self, fusion: LaneFusion, cycles: int, camera: Any = ()) -> FusedLane:
        for _ in range(cycles):
            t_ns, motion = self.send(), Motion.with_sigma(self.speed, 0, (0.1, 0.002))
            lane = self.step(fusion, t_ns, motion, camera)
        return lane


def camera(y: float = 0.0) -> list[MapLine]:
    means = ([side * 1.75 + y, 0, 0, 0] for side in (1, -1))
    pairs = zip(LANE, means, strict=True)
    return [MapLine(slot, Gaussian(mean, CAMERA_COV), x_max=50.0) for slot, mean in pairs]


def test_a_false_camera_line_is_rejected() -> None:
    car = Car()
    fusion = LaneFusion()
    car.run(fusion, 20, camera())
    false = [camera(1.5)[0], camera()[1]]
    lane = car.run(fusion, 1, false)
    assert lane.used == (Slot.EGO_RIGHT,)
    assert lane.rejected == (Slot.EGO_LEFT,)


def test_without_scenes_the_lane_becomes_less_certain_and_ends() -> None:
    car = Car()
    fusion = LaneFusion()
    lane = car.run(fusion, 20)
    assert lane.scene is not None
    sigma, x_max = lane.scene.centre(0.0).sigma, lane.scene.x_range(LANE)[1]
    t_ns, scene = lane.t_ns, lane.scene
    for k in range(1, 60):
        lane = car.step(fusion, t_ns + k * CYCLE, Motion.with_sigma(10.0, 0, (0.1, 0.02)))
        scene = lane.scene or scene
    assert scene.centre(0.0).sigma > sigma
    assert scene.x_range(LANE)[1] == pytest.approx(x_max - 29.5, abs=0.6)
    for k in range(60, 200):
        lane = car.step(fusion, t_ns + k * CYCLE, Motion(10.0, 0))
    assert lane.scene is None


def test_time_does_not_run_backwards_and_slots_are_of_the_lane() -> None:
    fusion = LaneFusion()
    fusion.step(100, None, Motion(0, 0))
    with pytest.raises(ValueError, match="now_ns must be 100 or later, got 99"):
        fusion.step(99, None, Motion(0, 0))
    other = [MapLine(Slot.CENTRE, Gaussian([0, 0, 0, 0], CAMERA_COV))]
    with pytest.raises(ValueError, match="must be of EGO_LEFT or EGO_RIGHT, got CENTRE"):
        fusion.step(100, None, Motion(0, 0), other)
