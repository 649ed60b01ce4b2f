#!/usr/bin/env python3
"""Compare poses of two scan matchings with each other and with the truth, as table 7 of the survey.

    evidence_scan_matching.py              every second through the streets of the town
    evidence_scan_matching.py --step 0.2   more often

Run it in the environment of the project, with the extra scan:

    python3 tools/run.py python tools/evidence_scan_matching.py

The table is that of Liu, Wang and Zhang, High Definition Map for Automated Driving (2019), table
7: the RMS difference of NDT and ICP from each other and from a reference, here the true pose. The
scans are simulated: 720 rays, noise of 3 cm, 5 % of the rays hit something that the map does
not have. With an error of the map, each house and each pole stands up to some centimetres from
where the map has it; the scans are those of the true places, and the matchings know how large the
error is, but not what it is.

Matches that say themselves that they are not valid are counted, and left out: on roads without
houses, a scan has a few poles only. NEES is 3 if the covariance is right. Localisation: GNSS,
odometry and the poses of NDT twice a second, without a camera. The exit status is 1 if an RMS is
more than 0.1 m, or a NEES is more than 3.72.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from reporting import parser_of, progress, report

from maplines_can import Gaussian, Polyline
from maplines_can.ego import (
    GnssFix,
    Localisation,
    LocalisationLayer,
    Odometry,
    SensorSetup,
    SimulatedDrive,
    drive_along,
    simulated_measurements,
)
from maplines_can.ego.scan_matching import (
    ScanMatch,
    ScanReference,
    match_icp,
    match_ndt,
    simulated_scan,
)
from maplines_can.ego.scan_matching.match import MODEL_SIGMA
from maplines_can.maps import Map, load, town_path, town_tour

Array = NDArray[np.float64]
Match = Callable[[ScanReference, Array, Array, tuple[float, float, float]], ScanMatch]

#: Part of the tour of the town [s].
SPAN = (2.0, 240.0)
#: Standard deviations of the pose with which a matching starts: x, y [m], heading [rad].
START = np.array([0.3, 0.3, math.radians(0.5)])
#: Errors of the map that are compared [m], and the largest RMS [m] and NEES.
MAP_ERRORS, MOST_RMS, MOST_NEES = (0.0, 0.05), 0.1, 3.72
METHODS: dict[str, Match] = {"NDT": match_ndt, "ICP": match_icp}
#: Distance of the houses ahead and behind that determine the heading [m].
ARM = 25.0
#: Time between two scans of the localisation [s].
SCAN_STEP = 0.5


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--step", type=float, default=1.0, help="between scans [s] (default: 1)")
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (default: 0)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    town = load(town_path())
    way = drive_along(town, town_tour(town))
    result: dict[str, Any] = {
        f"map error {100 * error:g} cm": compared(town, way, error, arguments)
        for error in MAP_ERRORS
    }
    result["localisation"] = localised(town, way, arguments.seed)
    result["met"] = all(found["met"] for found in result.values())
    return report(result, arguments.json, 30)


def compared(
    town: Map, way: SimulatedDrive, map_error: float, arguments: argparse.Namespace
) -> dict[str, Any]:
    """Return the differences of the methods on a map with an error [m]."""
    rng = np.random.default_rng(arguments.seed)
    reference, real = ScanReference(town), ScanReference(displaced(town, map_error, rng))
    x, y, turn = MODEL_SIGMA
    model_sigma = (x + map_error, y + map_error, turn + map_error / ARM)
    truths: list[Array] = []
    matches: dict[str, list[ScanMatch]] = {name: [] for name in METHODS}
    times = np.arange(*SPAN, arguments.step)
    for t in progress(times, f"map error {map_error:g} m"):
        true = way.at(float(t)).pose
        scan = simulated_scan(real, true, rng)
        start = true + START * rng.standard_normal(3)
        truths.append(true)
        for name, match in METHODS.items():
            matches[name].append(match(reference, scan, start, model_sigma))
    true = np.array(truths)
    valid = {name: np.array([m.is_valid for m in found]) for name, found in matches.items()}
    poses = {name: np.array([m.pose for m in found]) for name, found in matches.items()}
    both = valid["NDT"] & valid["ICP"]
    found: dict[str, Any] = {"scans": len(times)}
    found |= {f"{name} valid": int(some.sum()) for name, some in valid.items()}
    rows = {
        "NDT vs ICP": (poses["NDT"] - poses["ICP"])[both],
        "NDT vs truth": (poses["NDT"] - true)[valid["NDT"]],
        "ICP vs truth": (poses["ICP"] - true)[valid["ICP"]],
    }
    met = both.sum() > len(times) / 4
    for name, difference in rows.items():
        x, y, heading = np.sqrt((difference**2).mean(axis=0))
        found[f"{name}, RMS x, y [m]"] = f"{x:.3f}, {y:.3f}"
        found[f"{name}, RMS heading [deg]"] = float(math.degrees(heading))
        met = met and max(x, y) <= MOST_RMS
    for name, some in matches.items():
        e = (poses[name] - true)[valid[name]]
        P = np.array([m.cov for m in some if m.is_valid])
        nees = float((e * np.linalg.solve(P, e[..., None])[..., 0]).sum(axis=-1).mean())
        found[f"NEES {name}"] = nees
        met = met and nees <= MOST_NEES
    return found | {"met": bool(met)}


def displaced(town: Map, sigma: float, rng: np.random.Generator) -> Map:
    """Return a map whose houses and poles are displaced at random [m]."""

    def moved(outline: Polyline) -> Polyline:
        return Polyline(outline.points + sigma * rng.standard_normal(2))

    poles = [
        replace(
            one, x=one.x + sigma * rng.standard_normal(), y=one.y + sigma * rng.standard_normal()
        )
        for one in town.landmarks
    ]
    return replace(town, buildings=tuple(map(moved, town.buildings)), landmarks=tuple(poles))


def localised(town: Map, way: SimulatedDrive, seed: int) -> dict[str, Any]:
    """Return the errors of a localisation by GNSS, odometry and NDT."""
    rng = np.random.default_rng(seed)
    reference, setup = ScanReference(town), SensorSetup()
    arrivals = simulated_measurements(way, LocalisationLayer(town), setup, rng, span=SPAN)
    sigma = np.array([1.0, 1.0, math.radians(1.0)])
    start = way.at(SPAN[0]).pose + sigma * rng.standard_normal(3)
    localisation = Localisation(Gaussian(start, np.diag(sigma**2)), SPAN[0], setup.errors)
    errors, nees, due = [], [], SPAN[0] + SCAN_STEP
    for _, measurement in progress(arrivals, "localisation"):
        if not isinstance(measurement, Odometry | GnssFix):
            continue
        localisation.add(measurement)
        if isinstance(measurement, Odometry) and measurement.t >= due:
            due += SCAN_STEP
            true = way.at(measurement.t).pose
            scan = simulated_scan(reference, true, rng)
            match = match_ndt(reference, scan, localisation.ego().mean)
            if match.is_valid:
                localisation.add(match.fix(measurement.t))
            ego = localisation.ego()
            errors.append(ego.mean - true)
            nees.append(errors[-1] @ np.linalg.solve(ego.cov, errors[-1]))
    rms = np.sqrt(np.square(errors).mean(axis=0))
    mean = float(np.mean(nees))
    return {
        "RMS x, y [m]": f"{rms[0]:.3f}, {rms[1]:.3f}",
        "RMS heading [deg]": math.degrees(rms[2]),
        "NEES": mean,
        "poses of NDT": dict(localisation.counts().get("pose", {})),
        "met": mean <= MOST_NEES,
    }


if __name__ == "__main__":
    sys.exit(main())
