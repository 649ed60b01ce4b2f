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

from .transfer import codec_of, feed

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
    pose_cov: Array,
    map_error: MapError,
) -> DriveView:
    """Return the view of a drive, with lines that were encoded and decoded.

    Args:
        road_map: the map.
        route: that the car follows.
        drive: the drive.
        times: [s].
        pose_cov: (3, 3) of the pose error that the sender states, in the ego frame.
        map_error: that the sender states.
    """
    state = drive.at(np.array([*times]))
    tracker, n = LaneTracker(road_map, route), len(state.t)
    lines, seen, true = (np.full((n, 2, width), np.nan) for width in (4, 4, len(PLACES)))
    ranges, own = np.full((n, 2, 2), np.nan), np.full((n, 8, 8), np.nan)
    valid = np.zeros((n, len(PLACES)), dtype=bool)
    codec = codec_of("maplines-pose.dbc")
    encoder, decoder = codec.encoder(), codec.decoder()
    for k, pose in enumerate(state.pose):
        tracked = tracker.lines(pose).lines
        lane = {slot: tracked[slot] for slot in LANE if slot in tracked}
        true[k], seen[k] = true_lines(lane, LANE, pose)[:, COLUMNS], camera_lines(lane, pose)
        ego = Gaussian(pose, turned(pose_cov, pose[2]))
        t, sent = float(state.t[k]), map_scene(lane, ego, map_error=map_error, correlation_time=1.0)
        feed(encoder, decoder, sent, t + AGE, AGE, FRAME)
        found = decoder.scene()
        is_new = found is not None and abs(found.t_ns / 1e9 - AGE - t) < FRAME
        if found is not None and is_new and all(slot in found.scene.index for slot in LANE):
            scene = found.scene
            lines[k] = [scene.line(slot).gaussian.mean for slot in LANE]
            ranges[k], own[k] = scene.fit_ranges, scene.conditional().cov
            low, high = scene.x_range(LANE)
            valid[k] = (np.array(PLACES) >= low) & (np.array(PLACES) <= high)
    return DriveView(state, lines, ranges, true, valid, own, seen)


def turned(cov: Array, heading: float) -> Array:
    """Return a (3, 3) covariance in the ego frame, in the frame of the map."""
    c, s = np.cos(heading), np.sin(heading)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(R @ cov @ R.T)
