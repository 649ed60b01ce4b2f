#!/usr/bin/env python3
"""Watch the lane keeping beside drives of a driver, and count where it hands over.

    evidence_handover.py DIR              every map in a folder, and random roads
    evidence_handover.py --seconds 60     random roads only, one minute of each

Run it in the environment of the project: python3 tools/run.py python tools/evidence_handover.py DIR

A simulated driver follows random routes, within the lane and with at most 2 m/s^2 across; ten times
a second, the lane keeping sees the lines around a stated pose (0.3 m along, 0.1 m across, 0.2 deg,
correlated for 10 s). In lane changes it follows the line of the route. After a handover it begins
again at once. Cycles in which it hands over count by reason, apart from those where a driver would
have trouble, too: the middle of the lane bends by more than the car can steer within 10 m, or the
map has no lane of 2 m to 8 m there, or it ends. The exit status is 1 if there is one for RANGE, or
if those for TIGHT are more than 1 % of the cycles.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from evidence_maps import beside
from line_witness import Array
from reporting import bar, parser_of, report
from road_sources import route_of, sources_of

from maplines_can import PoseSource, Slot, maps
from maplines_can.consumers.path import WIDTHS
from maplines_can.consumers.steering import (
    LaneSteering,
    SteeringLimits,
    SteeringReason,
    SteeringState,
)
from maplines_can.maps.line_source import WINDOW, LineSource
from maplines_can.propagation.motion import Motion
from maplines_can.propagation.refit import MAX_MISFIT
from maplines_can.simulation.along_route import drive_along
from maplines_can.study.closed_loop import BESIDE_CHANGE, ODOMETRY

#: Standard deviations of the pose, and their correlation time [s].
SIGMA, CORRELATION = (0.3, 0.1, np.radians(0.2)), 10.0
#: Period of the cycles [s], and length of the routes [m].
PERIOD, LENGTH = 0.1, 3000.0
#: Largest share of cycles that hand over for TIGHT.
MAX_TIGHT = 0.01
#: Distance ahead in which a bend, or the end of the route, is trouble for a driver [m].
NEAR, END = 10.0, 60.0


def watched(
    road_map: maps.Map,
    route: maps.Route,
    seed: int,
    options: argparse.Namespace,
    tick: Callable[[float], object],
) -> Iterator[tuple[SteeringReason | None, float, float]]:
    """Yield the reason of a handover or None, the reach of the path and its sigma, each cycle."""
    drive = drive_along(road_map, route)
    source = LineSource(
        road_map,
        PoseSource(SIGMA, CORRELATION, seed).pose,
        (Slot.EGO_LEFT, Slot.EGO_RIGHT, Slot.ROUTE),
        route,
        tuple(options.window),
        correlation_time=CORRELATION,
        max_misfit=options.max_misfit,
    )
    t = np.arange(0.5, min(drive.end - 0.1, options.seconds), PERIOD)
    state = drive.at(t)
    along = route.start + np.append(0.0, np.hypot(*np.diff(state.pose[:, :2], axis=0).T).cumsum())
    bend = np.abs(state.yaw_rate) / np.maximum(state.speed, 0.5)
    changes = [(c.start - BESIDE_CHANGE, c.end + BESIDE_CHANGE) for c in route.changes]
    steering = LaneSteering(period=PERIOD)
    for i, now in enumerate(t.tolist()):
        tick(PERIOD)
        cycle = source.cycle(now, state.pose[i])
        scene = cycle.scene
        slot = Slot.ROUTE if any(a <= along[i] <= b for a, b in changes) else None
        if scene is not None and slot is None:
            scene = scene.subset(x.slot for x in scene.lines if x.slot is not Slot.ROUTE)
        speed = float(state.speed[i])
        motion = Motion.with_sigma(speed, float(state.yaw_rate[i]), ODOMETRY)
        command = steering.update(
            now, scene if scene and scene.lines else None, 0.0, motion, max(speed, 2.0), slot
        )
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


def figures(rows: list[tuple[SteeringReason | None, float, float]]) -> dict[str, Any]:
    """Return the figures of the cycles of a map."""
    reasons = Counter(reason.name for reason, _, _ in rows if reason is not None)
    reach, sigma = np.array([row[1:] for row in rows]).reshape(-1, 2).T
    return {
        "minutes": round(len(rows) * PERIOD / 60, 1),
        "handovers, by reason": dict(reasons),
        "range ahead, 5 % and median [m]": np.nanquantile(reach, [0.05, 0.5]).round(1).tolist(),
        "sigma at the car, median [m]": round(float(np.nanmedian(sigma)), 3),
        "met": not reasons["RANGE"] and reasons["TIGHT"] <= MAX_TIGHT * len(rows),
    }


def main(argv: list[str] | None = None) -> int:
    """Print the figures; return 0 if the bounds are met, else 1."""
    parser = parser_of(__doc__)
    parser.add_argument("paths", nargs="*", metavar="DIR", help="folders or files of maps")
    parser.add_argument("-n", "--routes", type=int, default=3, help="routes on each map and road")
    parser.add_argument("--seconds", type=float, default=120.0, help="of each route")
    parser.add_argument("--window", nargs=2, type=float, default=WINDOW, metavar=("MIN", "MAX"))
    parser.add_argument("--max-misfit", type=float, default=MAX_MISFIT, help="of the cubics [m]")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args(argv)
    found = sources_of(options.paths)
    result: dict[str, Any] = {}
    with bar(round(options.seconds) * options.routes * len(found), unit=" s") as shown:
        for name, map_of in found:
            rows: list[tuple[SteeringReason | None, float, float]] = []
            for seed in range(options.seed, options.seed + options.routes):
                road_map = map_of(seed)
                route = route_of(road_map, LENGTH, seed)
                rows += watched(road_map, route, seed, options, shown.update)
            result[name] = figures(rows)
    result["met"] = all(row["met"] for row in result.values())
    return report(result, options.json, 36)


if __name__ == "__main__":
    sys.exit(main())
