"""Handovers of the lane keeping where a driver has no trouble.

A simulated driver follows random routes, within the lane and with at most 2 m/s^2 across; ten times
a second, the lane keeping sees the lines around a stated pose (0.3 m along, 0.1 m across, 0.2 deg,
correlated for 10 s). In lane changes it follows the line of the route. After a handover it begins
again at once. Cycles in which it hands over count by reason, apart from those where a driver would
have trouble, too: the middle of the lane bends by more than the car can steer within 10 m, or the
map has no lane of 2 m to 8 m there, or it ends.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np

from maplines_can import Slot
from maplines_can import maps as map_model
from maplines_can.consumers import scene_view
from maplines_can.consumers.path import WIDTHS
from maplines_can.consumers.speed_limit import SteeringLimits, SteeringReason
from maplines_can.consumers.steering import LaneSteering, SteeringState
from maplines_can.maps.line_source import WINDOW, LineSource
from maplines_can.propagation.motion import Motion
from maplines_can.simulation import PoseSource
from maplines_can.simulation.trajectory import drive_along

from .closed_loop import BESIDE_CHANGE, ODOMETRY
from .figures import Share
from .harness import evidence, progress
from .roads import ROADS, route_of, sources
from .witness import Array, beside

#: Standard deviations of the pose, and their correlation time [s].
SIGMA, CORRELATION = (0.3, 0.1, np.radians(0.2)), 10.0
#: Period of the cycles [s].
PERIOD = 0.1
#: Distance ahead in which a bend, or the end of the route, is trouble for a driver [m].
NEAR, END = 10.0, 60.0


@evidence
def handover(
    maps: tuple[str, ...] = (),
    n: int = 3,
    seconds: float = 120.0,
    shapes: tuple[str, ...] = ROADS,
    window: tuple[float, ...] = WINDOW,
    seed: int = 0,
) -> dict[str, Any]:
    """Watch the lane keeping beside drives of a driver, and count where it hands over.

    Args:
        maps: folders and files of maps.
        n: routes on each map and random road.
        seconds: of each route.
        shapes: of random roads.
        window: in which lines are seen [m].
        seed: of the first route.
    """
    result = {}
    found = sources(maps, shapes)
    for name, map_of in progress(found.items(), "roads", len(found)):
        rows: list[tuple[SteeringReason | None, float, float]] = []
        for number in range(seed, seed + n):
            road_map = map_of(number)
            route = route_of(road_map, number)
            rows += watched(road_map, route, number, seconds, (window[0], window[1]))
        reasons = Counter(reason.name for reason, _, _ in rows if reason is not None)
        reach, sigma = np.array([row[1:] for row in rows]).reshape(-1, 2).T
        result[name] = {
            "minutes": len(rows) * PERIOD / 60,
            "RANGE": reasons["RANGE"],
            "TIGHT": Share(reasons["TIGHT"] / max(len(rows), 1), len(rows)),
            "others": reasons.total() - reasons["RANGE"] - reasons["TIGHT"],
            "range ahead, 5 % [m]": float(np.nanquantile(reach, 0.05)),
            "range ahead, median [m]": float(np.nanmedian(reach)),
            "sigma at the car, median [m]": float(np.nanmedian(sigma)),
        }
    return result


def watched(
    road_map: map_model.Map,
    route: map_model.Route,
    seed: int,
    seconds: float,
    window: tuple[float, float],
) -> Iterator[tuple[SteeringReason | None, float, float]]:
    """Yield the reason of a handover or None, the reach of the path and its sigma, each cycle."""
    drive = drive_along(road_map, route)
    source = LineSource(
        road_map,
        PoseSource(SIGMA, CORRELATION, seed).pose,
        (Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.ROUTE),
        route,
        window,
        correlation_time=CORRELATION,
    )
    t = np.arange(0.5, min(drive.end - 0.1, seconds), PERIOD)
    state = drive.at(t)
    along = route.start + np.append(0.0, np.hypot(*np.diff(state.pose[:, :2], axis=0).T).cumsum())
    bend = np.abs(state.yaw_rate) / np.maximum(state.speed, 0.5)
    changes = [(c.start - BESIDE_CHANGE, c.end + BESIDE_CHANGE) for c in route.changes]
    steering = LaneSteering(period=PERIOD)
    for i, now in enumerate(t.tolist()):
        cycle = source.cycle(now, state.pose[i])
        scene = cycle.scene
        slot = Slot.ROUTE if any(a <= along[i] <= b for a, b in changes) else None
        if scene is not None and slot is None:
            scene = scene.subset(x.slot for x in scene.lines if x.slot is not Slot.ROUTE)
        speed = float(state.speed[i])
        motion = Motion.with_sigma(speed, float(state.yaw_rate[i]), ODOMETRY)
        steering.set_speed, steering.route = max(speed, 2.0), slot
        view = scene_view(scene if scene and scene.lines else None)
        command = steering.step(round(1e9 * now), view, motion)
        near = (along >= along[i]) & (along <= along[i] + NEAR)
        has_trouble = (
            bend[near].max() > SteeringLimits().curvature
            or along[i] > min(route.goal, route.line.length) - END
            or not has_lane(cycle.tracked.lines, state.pose[i])
        )
        path = command.path
        reason = None
        if command.state is SteeringState.HANDOVER:
            steering = LaneSteering(period=PERIOD)
            reason = None if has_trouble else command.reason
        yield (
            reason,
            np.nan if path is None else path.reach,
            np.nan if path is None else path.sigma[0],
        )


def has_lane(lines: Any, pose: Array) -> bool:
    """Return whether there is a lane of a possible width around the car."""
    if not {Slot.EGO_LEFT, Slot.EGO_RIGHT} <= lines.keys():
        return False
    left, right = (beside(lines[slot].points, pose) for slot in (Slot.EGO_LEFT, Slot.EGO_RIGHT))
    return bool(WIDTHS[0] <= left - right <= WIDTHS[1] and left > 0 > right)
