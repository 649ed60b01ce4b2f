"""Lines of the ego lane along a drive, as they are and as a receiver knows them."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from maplines_can.maps import LaneTracker, Map, Route
from maplines_can.propagation import MapError, map_scene
from maplines_can.simulation.camera import COLUMNS, LANE, PLACES, camera_lines
from maplines_can.simulation.car_stream import AGE, FRAME
from maplines_can.simulation.trajectory import CarState, SimulatedDrive
from maplines_can.simulation.truth import true_lines
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.scene import Scene
from maplines_can.wire import Codec, Decoder, Encoder

Array = NDArray[np.float64]


class DriveView(NamedTuple):
    """Ego lane at (n,) times of a drive; NaN where a line is not given."""

    state: CarState
    lines: Array  #: (n, 2, 4) cubics of both lines from the true pose
    fit_ranges: Array  #: (n, 2, 2) in which they were fitted [m]
    true: Array  #: (n, 2, 3) lateral positions of the lines at ``PLACES`` [m]
    valid: NDArray[np.bool_]  #: (n, 3) which places are in the valid range of both lines
    own: Array  #: (n, 8, 8) covariance of what received lines have of their own
    seen: Array  #: (n, 2, 4) cubics that a camera fits; NaN where it does not see enough


def drive_view(
    road_map: Map,
    route: Route,
    drive: SimulatedDrive,
    times: Iterable[float],
    codec: Codec,
    pose_cov: Array,
    map_error: MapError,
) -> DriveView:
    """Return the view of a drive, with lines that were encoded and decoded.

    Args:
        road_map: the map.
        route: that the car follows.
        drive: the drive.
        times: [s].
        codec: that encodes and decodes the lines, with a Pose message.
        pose_cov: (3, 3) of the pose error that the sender states, in the ego frame.
        map_error: that the sender states.
    """
    state = drive.at(np.array([*times]))
    tracker, n = LaneTracker(road_map, route), len(state.t)
    view = DriveView(
        state,
        np.full((n, 2, 4), np.nan),
        np.full((n, 2, 2), np.nan),
        np.full((n, 2, len(PLACES)), np.nan),
        np.zeros((n, len(PLACES)), dtype=bool),
        np.full((n, 8, 8), np.nan),
        np.full((n, 2, 4), np.nan),
    )
    encoder, decoder = codec.encoder(), codec.decoder()
    for k, pose in enumerate(state.pose):
        seen = tracker.lines(pose)
        lines = {slot: seen.lines[slot] for slot in LANE if slot in seen.lines}
        view.true[k] = true_lines(lines, LANE, pose)[:, COLUMNS]
        view.seen[k] = camera_lines(lines, pose)
        ego = Gaussian(pose, turned(pose_cov, pose[2]))
        scene = map_scene(lines, ego, map_error=map_error, correlation_time=1.0)
        received = transferred(encoder, decoder, scene, float(state.t[k]))
        if received is not None and all(slot in received.index for slot in LANE):
            view.lines[k] = [received.line(slot).gaussian.mean for slot in LANE]
            view.fit_ranges[k] = received.fit_ranges
            low, high = received.x_range(LANE)
            view.valid[k] = (np.array(PLACES) >= low) & (np.array(PLACES) <= high)
            view.own[k] = received.conditional().cov
    return view


def turned(cov: Array, heading: float) -> Array:
    """Return a (3, 3) covariance in the ego frame, in the frame of the map."""
    c, s = np.cos(heading), np.sin(heading)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(R @ cov @ R.T)


def transferred(encoder: Encoder, decoder: Decoder, scene: Scene, t: float) -> Scene | None:
    """Return a scene as received; None if it was not.

    Args:
        encoder: encodes the scene.
        decoder: of the receiver.
        scene: as sent.
        t: time of its pose [s], later than that of the scene before.
    """
    for own in encoder.encode_scene(scene, age=AGE).values():
        for i, frame in enumerate(own):
            decoder.feed(frame.can_id, frame.data, round(1e9 * (t + AGE + i * FRAME)))
    received = decoder.scene()
    is_new = received is not None and abs(received.t_ns / 1e9 - AGE - t) < FRAME
    return received.scene if received is not None and is_new else None
