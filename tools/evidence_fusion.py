#!/usr/bin/env python3
"""Compare ways to fuse received lines with camera lines, and received lines with the truth.

    evidence_fusion.py                          50 cars, correlation times of 1, 5 and 30 s
    evidence_fusion.py --plot docs/fusion.png   draw it, too
    evidence_fusion.py --only received          received lines against the truth only

Run it in the environment of the project: python3 tools/run.py python tools/evidence_fusion.py

fusion: cars drive two stretches of the tour of the shipped town, in the streets and on the
motorway. Each has pose errors, a map error, a camera with a bias, false lines and an outage, and
odometry with a biased yaw rate of its own. The covariance of what a received line has of its own
is that of lines that were encoded and decoded. NEES is the squared error of the lane centre in
units of its variance: the mean over cars and time, where 1 is right. The upper bound is that of the
mean of as many cars at one time (95 %, two-sided chi-square).

received: each car drives another part of the tour. All scenes are encoded with maplines-pose.dbc
and decoded; a fusion runs on them. NEES for each degree of freedom, of single lines, of both
lines together, and of the fused lane centre, at each place. The decoded covariance covers the
true one, so there is an upper bound only.

The exit status is 1 if a right way exceeds a bound, or if a wrong one with independent cycles does
not.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from reporting import parser_of, progress, report

from maplines_can import Codec, MapError, maps
from maplines_can.consumers import LaneFusion
from maplines_can.simulation.along_route import drive_along
from maplines_can.simulation.camera import Errors, Simulation
from maplines_can.simulation.camera_view import LANE, PLACES, drive_view
from maplines_can.simulation.car_stream import CarStream
from maplines_can.study.fusion.picture import draw
from maplines_can.study.fusion.variants import RIGHT, WRONG
from maplines_can.values.line import lateral_jacobian
from maplines_can.wire import default_dbc_path

Array = Any

#: Stretches of the tour by name: start and end [s].
STRETCHES = {"streets": (45.0, 105.0), "motorway": (320.0, 380.0)}
TIMES = (1.0, 5.0, 30.0)
#: Duration of the drive of each car with received lines [s].
DRIVE = 8.0
PARTS = ("fusion", "received")


def upper_bound(runs: int) -> float:
    """Return the upper 95 % bound of the mean NEES of one variable over runs."""
    from scipy.stats import chi2

    return float(chi2.ppf(0.975, runs) / runs)


def fusion(arguments: argparse.Namespace, errors: Errors) -> dict[str, Any]:
    """Return RMS and NEES of all ways, on all stretches, for all correlation times."""
    found = maps.load(maps.town_path())
    route = maps.town_tour(found)
    drive = drive_along(found, route)
    codec = Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))
    stated = MapError(errors.map_local[0], errors.map_offset, errors.map_heading)
    result: dict[str, Any] = {}
    for name, (start, end) in STRETCHES.items():
        times = np.arange(start, min(end, start + arguments.seconds), 1 / arguments.rate)
        cov = np.diag(np.square(errors.pose_sigma))
        view = drive_view(found, route, drive, times, codec, cov, stated)
        ways = [(T, way) for T in TIMES for way in (*RIGHT, *WRONG)]
        for T, way in progress(ways, name):
            simulation = Simulation(view, T, arguments.seeds, arguments.seed, errors)
            track = simulation.run((RIGHT | WRONG)[way](arguments.seeds))
            result.setdefault(name, {}).setdefault(f"{T:g} s", {})[way] = {
                "rms": track.rms.round(3).tolist(),
                "nees": np.nanmean(track.nees, axis=0).round(2).tolist(),
                "false lines used": round(track.false_used, 4),
                "true lines used": round(track.true_used, 4),
            }
    return result


def received(arguments: argparse.Namespace, errors: Errors) -> dict[str, Any]:
    """Return the NEES of received lines, of their joint and of the fused lane over drives."""
    found = maps.load(maps.town_path())
    route = maps.town_tour(found)
    drive = drive_along(found, route)
    codec = Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))
    starts = np.linspace(10.0, drive.duration - DRIVE - 10.0, arguments.seeds)
    single, joint, fused = np.full((3, arguments.seeds, len(PLACES)), np.nan)
    scenes = 0
    for seed in progress(range(arguments.seeds), "received"):
        values: tuple[list[Array], list[Array], list[Array]] = ([], [], [])
        stream = CarStream(found, route, drive, codec, TIMES[seed % 3], seed, errors)
        lane_fusion = None
        for moment in stream(starts[seed], starts[seed] + DRIVE, arguments.rate):
            lane_fusion = lane_fusion or LaneFusion(moment.monitor)
            lane = lane_fusion.step(moment.t_ns, moment.motion, moment.camera)
            if lane.scene is not None:
                values[2].append(centre_nees(lane.scene, moment.true))
            if moment.scene is not None and all(slot in moment.scene.index for slot in LANE):
                own, together = scene_nees(moment.scene, moment.true_then)
                values[0].append(own)
                values[1].append(together)
                scenes += 1
        for kind, of_all in zip(values, (single, joint, fused), strict=True):
            of_all[seed] = mean_of(kind)
    return {
        "scenes": scenes,
        "single lines": mean_of(single).round(2).tolist(),
        "joint": mean_of(joint).round(2).tolist(),
        "fused lane centre": mean_of(fused).round(2).tolist(),
    }


def mean_of(values: Any) -> Array:
    """Return the mean over the first axis without NaN; NaN where there is nothing else."""
    values = np.asarray(values, dtype=float)
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    return total / np.where(known.any(axis=0), known.sum(axis=0), np.nan)


def places_of(scene: Any) -> Array:
    """Return which places are in the valid range of both lines."""
    low, high = scene.x_range(LANE)
    return (np.array(PLACES) >= low) & (np.array(PLACES) <= high)


def centre_nees(scene: Any, true: Array) -> Array:
    """Return the (3,) NEES of the centre at the places, NaN where a line is not valid."""
    centre = scene.centre(np.array(PLACES))
    squares = ((centre.value - true.mean(axis=0)) / centre.sigma) ** 2
    return np.where(places_of(scene), squares, np.nan)


def scene_nees(scene: Any, true: Array) -> tuple[Array, Array]:
    """Return the (3,) mean NEES of single lines, and that of both together, at the places."""
    x, inside = np.array(PLACES), places_of(scene)
    cov = scene.joint(LANE).cov
    J = np.zeros((len(x), 2, 8))
    for i, slot in enumerate(LANE):
        J[:, i, 4 * i : 4 * i + 4] = lateral_jacobian(scene.line(slot).gaussian.mean, x)
    errors = np.array([scene.line(slot).y(x) for slot in LANE]).T - true.T
    both = J @ cov @ J.mT
    single = (errors**2 / np.einsum("xii->xi", both)).mean(axis=1)
    joint = np.einsum("xi,xi->x", errors, np.linalg.solve(both, errors[..., None])[..., 0]) / 2
    return np.where(inside, single, np.nan), np.where(inside, joint, np.nan)


def misses_of(result: dict[str, Any], bound: float) -> list[str]:
    """Return the bounds that are missed."""
    misses = []
    for stretch, times in result.get("fusion", {}).items():
        for T, ways in times.items():
            for way, figures in ways.items():
                worst = max(figures["nees"])
                if way in RIGHT and not worst <= bound:
                    misses.append(f"{stretch}, {T}, {way}: NEES {worst:g}")
                if "joint, cycles independent" in way and not worst > bound:
                    misses.append(f"{stretch}, {T}, {way}: NEES is only {worst:g}")
    figures = result.get("received", {})
    names = ("single lines", "joint", "fused lane centre")
    return misses + [
        f"received, {name}: NEES {figures[name]}"
        for name in names
        if name in figures and not np.nanmax(figures[name]) <= bound
    ]


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("--seeds", type=int, default=50, help="number of cars, 50 by default")
    parser.add_argument("--seed", type=int, default=1, help="of the simulation")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each stretch")
    parser.add_argument("--rate", type=float, default=10.0, help="of the scenes [Hz]")
    parser.add_argument("--only", choices=PARTS, help="one part only")
    parser.add_argument("--plot", type=Path, help="file of the picture of the fusion")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args(argv)
    errors, bound = Errors(), upper_bound(arguments.seeds)
    parts = (arguments.only,) if arguments.only else PARTS
    result: dict[str, Any] = {"x [m]": list(PLACES), "upper bound of NEES": round(bound, 3)}
    for part in parts:
        result[part] = {"fusion": fusion, "received": received}[part](arguments, errors)
    if arguments.plot and "fusion" in result:
        draw(result["fusion"]["motorway"], bound, arguments.plot)
    misses = misses_of(result, bound)
    result |= {"missed": misses, "met": not misses}
    return report(result, arguments.json, 40)


if __name__ == "__main__":
    sys.exit(main())
