"""What a car receives and measures on a simulated drive, moment by moment, and the truth."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..maps import LaneTracker, Map, Route
from ..propagation import MapError, Motion, map_scene
from ..values.line import MapLine
from ..values.polyline import Polyline
from ..values.scene import Scene
from ..wire import Decoder, LineCodec
from .camera import COLUMNS, LANE, Errors, UnitGaussMarkov, camera_view
from .pose_source import PoseSource
from .trajectory import SimulatedDrive
from .truth import true_lines

Array = NDArray[np.float64]

#: Time from the pose to the first frame, and from frame to frame [s].
AGE, FRAME = 0.02, 0.00025


class CarCycle(NamedTuple):
    """One cycle of a drive, after its scene has arrived."""

    t_ns: int  #: now [ns]
    decoder: Decoder  #: of the receiver
    scene: Scene | None  #: that has arrived in this cycle, of a pose ``age`` ago
    true_then: Array  #: (2, 3) as ``true``, from the pose of the scene
    motion: Motion  #: as measured
    camera: list[MapLine]
    true: Array  #: (2, 3) lateral positions of both lines at ``PLACES`` now [m]
    pose_error: Array  #: (3,) true one: along [m], across [m], heading [rad]


class CarStream:
    """Simulated car on a drive: its receiver, its camera and its odometry.

    The scenes are encoded and decoded. The true lines are those of the map with an error of their
    own, each another one.

    Args:
        road_map: the map.
        route: that the car follows.
        drive: the drive.
        codec: of the scenes.
        correlation_time: of the pose error [s].
        seed: of all errors.
        errors: their sizes.
        has_camera: whether the car has one.
    """

    def __init__(
        self,
        road_map: Map,
        route: Route,
        drive: SimulatedDrive,
        codec: LineCodec,
        correlation_time: float,
        seed: int = 0,
        errors: Errors | None = None,
        *,
        has_camera: bool = True,
    ) -> None:
        self._tracker, self._drive, self._codec = LaneTracker(road_map, route), drive, codec
        self._encoder = codec.encoder()
        self._errors, self._time = errors or Errors(), correlation_time
        self._rng = np.random.default_rng([seed, 1])
        self._poses = PoseSource(self._errors.pose_sigma, correlation_time, seed)
        self._offsets: dict[int, Array] = {}  # of each line of the map
        self._has_camera = has_camera

    def __call__(self, start: float, end: float, rate: float = 20.0) -> Iterator[CarCycle]:
        """Yield the moments from start to end of the drive [s], at a rate [1/s]."""
        e, rng, dt = self._errors, self._rng, 1 / rate
        decoder = self._codec.decoder(cycle_ms=1000 * dt)
        bias = UnitGaussMarkov(rng, (3,))
        scale, gyro = (
            1 + e.speed_scale * rng.standard_normal(),
            e.yaw_rate_bias * rng.standard_normal(),
        )
        outage = start + np.array(e.outage) * (end - start)
        error = MapError(e.map_local[0], e.map_offset, e.map_heading)
        for t in np.arange(start, end, dt):
            state = self._drive.at(t)
            stated = self._poses.pose(t, state.pose)
            lines = {
                slot: line
                for slot, line in self._tracker.lines(stated.mean).lines.items()
                if slot in LANE
            }
            true = {slot: self._moved(line) for slot, line in lines.items()}
            sent = map_scene(lines, stated, map_error=error, correlation_time=self._time)
            t_ns = self._transfer(decoder, sent, t)
            speed = float(state.speed) * scale
            noise = e.yaw_rate_noise * rng.standard_normal()
            motion = Motion.with_sigma(
                speed,
                float(state.yaw_rate) + gyro + noise,
                (e.speed_scale * speed + 0.01, e.yaw_rate_noise),
            )
            seen_bias = bias.step(dt / e.bias_time) * e.camera_bias
            camera = []
            if self._has_camera and not outage[0] <= t < outage[1]:
                camera = camera_view(true, state.pose, seen_bias, e, rng)
            view = decoder.latest_scene(t_ns)
            is_new = view.received is not None and view.received.t_ns > round(1e9 * t)
            c, s = math.cos(state.pose[2]), math.sin(state.pose[2])
            R = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
            yield CarCycle(
                t_ns,
                decoder,
                view.scene if is_new else None,
                true_lines(true, LANE, state.pose)[:, COLUMNS],
                motion,
                [replace(line, age=(t_ns - 1e9 * t) / 1e9) for line in camera],
                true_lines(true, LANE, self._drive.at(min(t_ns / 1e9, self._drive.end)).pose)[
                    :, COLUMNS
                ],
                R @ (stated.mean - state.pose),
            )

    def _transfer(self, decoder: Decoder, scene: Scene, t: float) -> int:
        """Send a scene; return the time after its last frame [ns]."""
        t_ns = round(1e9 * (t + AGE))
        fd = not self._codec.layout.has_classic
        for own in self._encoder.encode_scene(scene, age=AGE, fd=fd).values():
            for frame in own:
                decoder.feed(frame.can_id, frame.data, t_ns)
                t_ns += round(1e9 * FRAME)
        return t_ns

    def _moved(self, line: Polyline) -> Polyline:
        """Return the true line, of which that of the map is off by an error of its own."""
        key = id(line)
        if key not in self._offsets:
            own = self._errors.map_offset * self._rng.standard_normal(2)
            local = self._errors.map_local[0] * self._rng.standard_normal(line.points.shape)
            self._offsets[key] = own + local
        return Polyline(line.points + self._offsets[key], line.kind)
