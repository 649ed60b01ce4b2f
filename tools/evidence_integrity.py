#!/usr/bin/env python3
"""Verify the protection levels of the lateral position, and draw the Stanford diagram.

    evidence_integrity.py                              risks of 1e-5 and 1e-7 in an hour
    evidence_integrity.py --plot docs/stanford.png     draw the diagram, too

Run it in the environment of the project: python3 tools/run.py python tools/evidence_integrity.py

in time: probability that a Gauss-Markov error exceeds the level at any of the 72 000 samples of an
hour, by importance sampling, for each correlation time. The upper end of its 95 % confidence
interval must be at most the stated risk.

in a scene: probability that the error of the lane centre of a received scene exceeds the level at
one time, by importance sampling of pose errors (mean shift), against that of a normal variable with
the decoded variance. The decoded covariance covers the true one, so the ratio is at most 1; scenes
in which the misfit of the cubic is most of the error may exceed it, so the mean over scenes counts.

diagram: protection levels (1e-5) of fused lanes over the errors.
"""

from __future__ import annotations

import argparse
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from evidence_fusion import STRETCHES
from reporting import parser_of, progress, report

from maplines_can import Codec, MapError, maps
from maplines_can.consumers.integrity import (
    ALERT_LIMITS,
    PERIOD,
    RISKS,
    multiplier,
    risk_bound,
    samples_of,
)
from maplines_can.simulation.along_route import drive_along
from maplines_can.simulation.camera import Errors, Simulation
from maplines_can.simulation.camera_view import PLACES, drive_view
from maplines_can.study.fusion.variants import RIGHT
from maplines_can.study.integrity.sampling import (
    excursion_probability,
    nominal,
    tail_probability,
)
from maplines_can.study.integrity.stanford import Shares, draw
from maplines_can.wire import default_dbc_path

TIMES = (1.0, 5.0, 30.0)
#: Correlation time of the errors in the diagram [s], and its risk.
DIAGRAM = 5.0, 1e-5


def in_time(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the risks of an hour, stated and sampled."""
    rng = np.random.default_rng(arguments.seed)
    result: dict[str, Any] = {}
    for T in progress(TIMES, "in time"):
        for risk in RISKS:
            K = multiplier(risk, T)
            rho, n = math.exp(-PERIOD / T), samples_of(PERIOD)
            sampled = excursion_probability(K, rho, n, arguments.draws, rng)
            result[f"{risk:g} an hour, {T:g} s"] = {
                "K": round(K, 3),
                "bound": risk_bound(K, T),
                "sampled": sampled.value,
                "interval": [sampled.low, sampled.high],
                "met": sampled.high <= risk,
            }
    return result


def views(arguments: argparse.Namespace, errors: Errors) -> dict[str, Any]:
    """Return the views of both stretches."""
    found = maps.load(maps.town_path())
    route = maps.town_tour(found)
    drive = drive_along(found, route)
    codec = Codec.from_dbc(default_dbc_path("maplines-pose.dbc"))
    stated = MapError(errors.map_local[0], errors.map_offset, errors.map_heading)
    cov = np.diag(np.square(errors.pose_sigma))
    return {
        name: drive_view(
            found,
            route,
            drive,
            np.arange(start, start + arguments.seconds, 0.1),
            codec,
            cov,
            stated,
        )
        for name, (start, _) in progress(STRETCHES.items(), "views")
    }


def in_scenes(arguments: argparse.Namespace, errors: Errors, view: Any) -> dict[str, Any]:
    """Return the tails of received scenes, relative to those of a normal variable."""
    result: dict[str, Any] = {}
    for place, x in enumerate(PLACES):
        known = np.flatnonzero(
            view.valid[:, place] & np.isfinite(view.true[:, :, place]).all(axis=1)
        )
        for risk in RISKS:
            K = multiplier(risk, DIAGRAM[0])
            tails = [
                tail_probability(
                    view, k, place, K, errors, arguments.draws, arguments.seed + int(k)
                ).value
                for k in known[:: max(1, len(known) // arguments.scenes)]
            ]
            ratio = np.array(tails) / nominal(K)
            result[f"{risk:g} at {x:g} m"] = {
                "scenes": len(ratio),
                "mean ratio": float(ratio.mean()),
                "largest ratio": float(ratio.max()),
                "met": bool(ratio.mean() <= 1),
            }
    return result


def diagram(arguments: argparse.Namespace, errors: Errors, seen: dict[str, Any]) -> dict[str, Any]:
    """Return the shares of the Stanford diagram, and draw it."""
    T, risk = DIAGRAM
    result: dict[str, Any] = {}
    for name, view in seen.items():
        way = RIGHT["pose error as state"](arguments.seeds)
        track = Simulation(view, T, arguments.seeds, arguments.seed, errors).run(way)
        limit = ALERT_LIMITS["street" if name == "streets" else name]
        errors_, levels = [], []
        for place, x in enumerate(PLACES):
            known = np.isfinite(track.error[..., place])
            errors_.append(np.abs(track.error[..., place][known]))
            levels.append(multiplier(risk, T) * track.sigma[..., place][known])
            shares = Shares.of(errors_[-1], levels[-1], limit)
            result[f"{name}, {x:g} m"] = {"alert limit": limit, **shares._asdict()}
        if arguments.plot and name == "motorway":
            draw(errors_, levels, limit, arguments.plot)
    return result


def main(argv: list[str] | None = None) -> int:
    """Run the command and return its exit status."""
    parser = parser_of(__doc__)
    parser.add_argument("--draws", type=int, default=4000, help="paths, and samples of a scene")
    parser.add_argument("--scenes", type=int, default=60, help="scenes of the motorway")
    parser.add_argument("--seeds", type=int, default=50, help="cars of the diagram")
    parser.add_argument("--seconds", type=float, default=60.0, help="of each stretch")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--plot", type=Path, help="file of the Stanford diagram")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args(argv)
    errors = Errors()
    risks, seen = in_time(arguments), views(arguments, errors)
    scenes = in_scenes(arguments, errors, seen["motorway"])
    shares = diagram(arguments, errors, seen)
    met = all(figures["met"] for part in (risks, scenes) for figures in part.values())
    met &= all(figures["misleading"] == 0 for figures in shares.values())
    result = {"in time": risks, "in a scene": scenes, "diagram": shares, "met": met}
    return report(result, arguments.json, 16)


if __name__ == "__main__":
    sys.exit(main())
