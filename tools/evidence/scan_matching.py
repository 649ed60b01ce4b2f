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
houses, a scan has a few poles only. NEES is 3 if the covariance is right.

Localisation: one car for each seed, each with a map error of 5 cm of its own, drives through the
streets for 60 s, with odometry and the poses of a scan matching twice a second; with GNSS and
without, and without a camera. At each time, the mean NEES over the cars is compared with its 95 %
bounds from chi-square. The error of the map is the same from scan to scan, as long as the houses
are. The filter has it as a state; "taken as white", it takes the whole covariance as white noise.

The exit status is 1 if an RMS is more than 0.1 m, if a NEES is above its bound (3.72 for 50 cars),
if less than 90 % of the errors are within their 95 % bound, or if that as white noise is good.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from evidence_localisation import Run, run_of, share_inside
from numpy.typing import NDArray
from reporting import parser_of, progress, report
from scipy.stats import chi2

from maplines_can import Polyline
from maplines_can.localisation import GnssFix, Localisation, LocalisationLayer, Odometry, PoseFix
from maplines_can.localisation.scan_matching import (
    ScanMatch,
    ScanReference,
    match_icp,
    match_ndt,
    simulated_scan,
)
from maplines_can.maps import Map, load, town_path, town_tour
from maplines_can.simulation.along_route import drive_along
from maplines_can.simulation.sensors import SensorSetup, simulated_measurements
from maplines_can.simulation.trajectory import SimulatedDrive

Array = NDArray[np.float64]
Match = Callable[..., ScanMatch]

#: Part of the tour of the town [s].
SPAN = (2.0, 240.0)
#: Standard deviations of the pose with which a matching starts: x, y [m], heading [rad].
START = np.array([0.3, 0.3, math.radians(0.5)])
#: Errors of the map that are compared [m], and the largest RMS [m] and NEES.
MAP_ERRORS, MAX_RMS, MAX_NEES = (0.0, 0.05), 0.1, 3.72
METHODS: dict[str, Match] = {"NDT": match_ndt, "ICP": match_icp}
#: Part of the tour for the localisation [s], with 7 s without houses; time between two scans [s].
FED_SPAN, SCAN_STEP = (40.0, 100.0), 0.5
#: Least share of errors of the localisation within their 95 % bound.
MIN_WITHIN = 0.9


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--step", type=float, default=1.0, help="between scans [s] (default: 1)")
    parser.add_argument(
        "--seeds", type=int, default=50, help="cars, for localisation (default: 50)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (default: 0)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    town = load(town_path())
    way = drive_along(town, town_tour(town))
    result: dict[str, Any] = {
        f"map error {100 * error:g} cm": compared(town, way, error, arguments)
        for error in MAP_ERRORS
    }
    for name in METHODS:
        result |= localised(town, way, name, arguments)
    result["met"] = all(found["met"] for found in result.values())
    return report(result, arguments.json, 30)


def compared(
    town: Map, way: SimulatedDrive, map_error: float, arguments: argparse.Namespace
) -> dict[str, Any]:
    """Return the differences of the methods on a map with an error [m]."""
    rng = np.random.default_rng(arguments.seed)
    reference, real = ScanReference(town), ScanReference(displaced(town, map_error, rng))
    truths: list[Array] = []
    matches: dict[str, list[ScanMatch]] = {name: [] for name in METHODS}
    times = np.arange(*SPAN, arguments.step)
    for t in progress(times, f"map error {map_error:g} m"):
        true = way.at(float(t)).pose
        scan = simulated_scan(real, true, rng)
        start = true + START * rng.standard_normal(3)
        truths.append(true)
        for name, match in METHODS.items():
            matches[name].append(match(reference, scan, start, map_error=map_error))
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
        met = met and max(x, y) <= MAX_RMS
    for name, some in matches.items():
        e = (poses[name] - true)[valid[name]]
        P = np.array([m.cov for m in some if m.is_valid])
        nees = float((e * np.linalg.solve(P, e[..., None])[..., 0]).sum(axis=-1).mean())
        found[f"NEES {name}"] = nees
        met = met and nees <= MAX_NEES
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


def localised(
    town: Map, way: SimulatedDrive, method: str, arguments: argparse.Namespace
) -> dict[str, Any]:
    """Return the figures of localisations by odometry and a scan matching, by their name.

    Each car has a map error of its own. A match begins at the estimate without GNSS, and goes to
    all localisations.
    """
    n, seed, match = arguments.seeds, arguments.seed, METHODS[method]
    rng = np.random.default_rng([seed, 1])
    reference, setup = ScanReference(town), SensorSetup()
    real = [ScanReference(displaced(town, MAP_ERRORS[-1], rng)) for _ in range(n)]
    arrivals = simulated_measurements(way, LocalisationLayer(town), setup, rng, n, FED_SPAN)
    start = way.at(FED_SPAN[0]).pose + START * rng.standard_normal((n, 3))
    localisations = {
        name: Localisation(start, FED_SPAN[0], setup.errors, cov=np.diag(START**2))
        for name in (method, f"{method} and GNSS", f"{method} and GNSS, taken as white")
    }
    rows: dict[str, list[Any]] = {name: [] for name in localisations}
    due = FED_SPAN[0] + SCAN_STEP
    for _, measurement in progress(arrivals, f"localisation by {method}"):
        for name, localisation in localisations.items():
            if isinstance(measurement, Odometry) or (
                isinstance(measurement, GnssFix) and name != method
            ):
                localisation.add(measurement)
        if not isinstance(measurement, Odometry) or measurement.t < due:
            continue
        due += SCAN_STEP
        true, guess = way.at(measurement.t).pose, localisations[method].poses().mean
        matches = [
            match(reference, simulated_scan(one, true, rng), start, map_error=MAP_ERRORS[-1])
            for one, start in zip(real, guess, strict=True)
        ]
        white = [one._replace(shared=np.zeros((3, 3))) for one in matches]
        for name, localisation in localisations.items():
            fix = pose_fix(measurement.t, white if name.endswith("white") else matches)
            localisation.add(fix)
            poses, times = localisation.poses(), localisation.correlation_times()
            rows[name].append((fix.t, poses.mean - true, poses.cov, true[2], times))
    return {
        f"localisation, {name}": fed_figures(run_of(rows[name], [], one), "white" in name)
        for name, one in localisations.items()
    }


def pose_fix(t: float, matches: list[ScanMatch]) -> PoseFix:
    """Return the measurement of n cars; that of a match that is not valid is missing."""
    valid = np.array([one.is_valid for one in matches])[:, None]
    cov, shared = (
        np.where(valid[..., None], np.array(some), np.eye(3))
        for some in ([one.cov - one.shared for one in matches], [one.shared for one in matches])
    )
    return PoseFix(t, np.where(valid, [one.pose for one in matches], np.nan), cov, shared)


def fed_figures(run: Run, is_white: bool) -> dict[str, Any]:
    """Return the figures of a localisation; that which is taken as white must be overconfident."""
    nees, n = run.nees, run.errors.shape[1]
    by_seed, mean = nees.mean(axis=0), float(nees.mean())
    error = 1.96 * by_seed.std(ddof=1) / math.sqrt(n) if n > 1 else math.inf
    low, high = chi2.ppf([0.025, 0.975], 3 * n) / n
    rms = np.sqrt(np.square(run.ego_errors).mean(axis=(0, 1)))
    sigma = np.sqrt(np.diagonal(run.covs, axis1=-2, axis2=-1)[..., :2].mean())
    inside = float((nees < chi2.ppf(0.95, 3)).mean())
    return {
        "NEES": mean,
        "NEES 95 % of the mean": f"{mean - error:.2f} to {mean + error:.2f}",
        "NEES 95 % bounds at a time": f"{low:.2f} to {high:.2f}",
        "times inside": share_inside(nees, 3),
        "errors within their 95 % bound": inside,
        "RMS along, across [m]": f"{rms[0]:.3f}, {rms[1]:.3f}",
        "RMS heading [deg]": math.degrees(rms[2]),
        "stated sigma of x, y [m]": float(sigma),
        "poses": dict(run.counts.get("pose", {})),
        "met": bool(mean > high if is_white else mean <= high and inside >= MIN_WITHIN),
    }


if __name__ == "__main__":
    sys.exit(main())
