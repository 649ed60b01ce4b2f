"""Steering by received lines alone, in a closed loop.

A car (kinematic bicycle, steering with 0.1 s delay, 0.1 s lag, and limits of angle and rate)
follows the lane. Twenty times a second, the lines around its stated pose are encoded into frames
and decoded; the lane keeping sees them 40 ms later. The tour has 11.9 km: streets with corners, a
roundabout, a motorway with four lane changes. Shapes: a corner of 8 m and a roundabout of 12 m.

    production   sigma of 0.3 m along, 0.1 m across, 0.2 deg, correlated for 10 s
    precise      0.06 m along, 0.02 m across, 0.05 deg: 95 % of its lateral errors within 5 cm
    rtk          0.01 m along and across, 0.05 deg

The error is the lateral distance of the rear axle from the middle of the lane. The control error is
this, less the lateral error of the stated pose, which no control can know.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from maplines_can.consumers.speed_limit import SteeringReason
from maplines_can.consumers.steering import SteeringState
from maplines_can.maps import Map, Route, load, town_path, town_tour
from maplines_can.simulation import STREETS

from .closed_loop import MARGIN, PERIOD, LoopCycle, ReportedPoses, on_map, on_street, spread
from .harness import bar, evidence, progress

LOCALISATIONS = {
    "production": (0.3, 0.1, math.radians(0.2)),
    "precise": (0.06, 0.02, math.radians(0.05)),
    "rtk": (0.01, 0.01, math.radians(0.05)),
}
#: Where outages begin along the tour [m]: on a street, at a corner, on the motorway.
OUTAGES = {"street": 150.0, "corner": 540.0, "motorway": 4000.0}
#: The car begins so far before an outage [m]; it needs 12 s to get there.
BEFORE = 60.0
DURATION = 20.0
SHAPES = ("corner", "roundabout-12m")


@evidence
def drives(
    seconds: float = math.inf,
    localisations: tuple[str, ...] = tuple(LOCALISATIONS),
    shapes: tuple[str, ...] = SHAPES,
    seed: int = 0,
) -> dict[str, Any]:
    """Drive through the town, and along shapes of street, with each localisation.

    Args:
        seconds: of the tour at most [s].
        localisations: errors of the stated pose.
        shapes: of street.
        seed: of all errors.
    """
    town = load(town_path())
    route = town_tour(town)
    result = {}
    for name in localisations:
        poses = ReportedPoses(LOCALISATIONS[name], seed=seed)
        loops = {"tour": (on_map(town, route, poses.pose), seconds)}
        for shape in shapes:
            own = ReportedPoses(LOCALISATIONS[name], seed=seed)
            loops[shape] = on_street(STREETS[shape].lines, own.pose), math.inf
        for way, (loop, longest) in loops.items():
            with bar(round(min(longest, 1000.0)), f"{way}, {name}", unit=" s") as shown:
                moments = loop.run(longest, tick=shown.update)
            is_at_end = moments[-1].along > loop.way[1] - MARGIN - 3
            ended = is_at_end or moments[-1].t >= longest - 2 * PERIOD
            result[f"{way}, {name}"] = figures(moments) | {"to the end": ended}
    return result


@evidence
def outages(
    n: int = 3,
    places: tuple[str, ...] = tuple(OUTAGES),
    of: tuple[str, ...] = ("localisation", "lines"),
    wait: float = 12.0,
    seed: int = 0,
) -> dict[str, Any]:
    """Let localisation or lines fail for 20 s after a time, n times at each place of the tour.

    Localisation continues by dead reckoning, with a yaw rate bias (0.05 deg/s) and an error of the
    speed (1 %), and states its covariance; or no frames arrive.
    """
    town = load(town_path())
    route = town_tour(town)
    kinds = [(p, what, i) for p in places for what in of for i in range(n)]
    return {
        f"{what}, {place}, {i}": outage(town, route, place, wait, seed + i, lines=what == "lines")
        for place, what, i in progress(kinds, "outages")
    }


def figures(moments: Sequence[LoopCycle]) -> dict[str, Any]:
    """Return the figures of a drive without an outage."""
    driven = [m for m in moments if m.speed > 0]
    error = np.array([m.error for m in driven])
    # The car is on the wrong side of the middle by what it believes to be on the other one.
    control = error + np.array([m.stated_error for m in driven])
    pose = np.array([m.stated_error for m in driven])
    reasons = Counter(m.reason for m in driven if m.reason is not SteeringReason.NONE)
    return {
        "seconds": driven[-1].t,
        "km": (driven[-1].along - driven[0].along) / 1000,
        "error": spread(error),
        "pose error": spread(pose),
        "control error": spread(control),
        "mean speed [m/s]": float(np.mean([m.speed for m in driven])),
        "share of the time, by reason": {
            reason.name: round(n / len(driven), 3) for reason, n in reasons.most_common()
        },
        "handed over": moments[-1].state is SteeringState.HANDOVER,
    }


def outage(
    town: Map, route: Route, place: str, wait: float, seed: int, *, lines: bool
) -> dict[str, Any]:
    """Return what the car does in an outage of the localisation, or of the lines."""
    span, begin = (wait, wait + DURATION), OUTAGES[place]
    sigma = LOCALISATIONS["production"]
    pose = ReportedPoses(sigma, outages=() if lines else (span,), seed=seed).pose
    loop = on_map(town, route, pose)
    loop = replace(loop, way=(begin - BEFORE, loop.way[1]), line_outages=(span,) if lines else ())
    moments = loop.run(seconds=span[1] + 3.0)
    after = [m for m in moments if m.t >= span[0]] or moments[-1:]  # it may stop before
    handover = next((m for m in after if m.state is SteeringState.HANDOVER), None)
    return {
        "largest error [m]": max(abs(m.error) for m in after),
        "hands over after [s]": None if handover is None else handover.t - span[0],
        "because": None if handover is None else handover.reason.name,
        "stops after [s]": after[-1].t - span[0] if after[-1].speed < 0.05 else None,
    }
