"""Poses of two scan matchings against each other and the truth, as table 7 of the survey.

The table is that of Liu, Wang and Zhang, High Definition Map for Automated Driving (2019), table
7: the RMS difference of NDT and ICP from each other and from a reference, here the true pose. The
scans are simulated: 720 rays, noise of 3 cm, 5 % of the rays hit something that the map does
not have. With an error of the map, each house and each pole stands up to some centimetres from
where the map has it; the scans are those of the true places, and the matchings know how large the
error is, but not what it is.

Matches that say themselves that they are not valid are counted, and left out: on roads without
houses, a scan has a few poles only. NEES is 3 if the covariance is right. It needs the extra scan.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
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
from maplines_can.simulation.sensors import SensorSetup, simulated_measurements
from maplines_can.simulation.trajectory import SimulatedDrive, drive_along

from .harness import evidence, progress
from .localisation import Run, run_of, share_inside

Array = NDArray[np.float64]
Match = Callable[..., ScanMatch]

#: Part of the tour of the town [s].
SPAN = (2.0, 240.0)
#: Standard deviations of the pose with which a matching starts: x, y [m], heading [rad].
START = np.array([0.3, 0.3, math.radians(0.5)])
#: Error of the map for the localisation [m].
MAP_ERROR = 0.05
METHODS: dict[str, Match] = {"NDT": match_ndt, "ICP": match_icp}
#: Part of the tour for the localisation [s], with 7 s without houses; time between two scans [s].
FED_SPAN, SCAN_STEP = (40.0, 100.0), 0.5


@evidence(step=60.0, errors=(0.05,))
def poses(
    step: float = 1.0, errors: tuple[float, ...] = (0.0, 0.05), seed: int = 0
) -> dict[str, Any]:
    """Match scans each so many seconds through the streets of the town, for map errors [m]."""
    town = load(town_path())
    way = drive_along(town, town_tour(town))
    result: dict[str, Any] = {}
    for error in errors:
        result |= {
            f"map error {100 * error:g} cm, {name}": found
            for name, found in compared(town, way, error, step, seed).items()
        }
    return result


def compared(
    town: Map, way: SimulatedDrive, map_error: float, step: float, seed: int
) -> dict[str, Any]:
    """Return the differences of the methods on a map with an error [m]."""
    rng = np.random.default_rng(seed)
    reference, real = ScanReference(town), ScanReference(displaced(town, map_error, rng))
    truths: list[Array] = []
    matches: dict[str, list[ScanMatch]] = {name: [] for name in METHODS}
    for t in progress(np.arange(*SPAN, step), f"map error {map_error:g} m"):
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
    rows = {"NDT and ICP": differences(poses["NDT"] - poses["ICP"], both)}
    for name, found in matches.items():
        e = (poses[name] - true)[valid[name]]
        P = np.array([m.cov for m in found if m.is_valid])
        nees = float((e * np.linalg.solve(P, e[..., None])[..., 0]).sum(axis=-1).mean())
        rows[f"{name} and truth"] = differences(poses[name] - true, valid[name]) | {"NEES": nees}
    return rows


def differences(values: Array, valid: NDArray[np.bool_]) -> dict[str, Any]:
    """Return the RMS of valid (n, 3) differences of poses, and the share of valid ones."""
    x, y, heading = np.sqrt((values[valid] ** 2).mean(axis=0))
    return {
        "valid": float(valid.mean()),
        "RMS x [m]": x,
        "RMS y [m]": y,
        "RMS heading [deg]": math.degrees(heading),
    }


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


@evidence(seeds=2, methods=("NDT",), span=3.0)
def localisation(
    seeds: int = 50,
    methods: tuple[str, ...] = tuple(METHODS),
    span: float = FED_SPAN[1] - FED_SPAN[0],
    seed: int = 0,
) -> dict[str, Any]:
    """Localise by odometry and the poses of a scan matching twice a second, with GNSS and without.

    Each car has a map error of 5 cm of its own, and drives through the streets for 60 s without a
    camera. The error of the map is the same from scan to scan, as long as the houses are. The
    filter has it as a state; "taken as white", it takes the whole covariance as white noise, which
    must be found wrong. "NEES over bound" is the mean over its upper 97.5 % bound at one time.

    Args:
        seeds: number of cars.
        methods: of scan matching.
        span: of the drive [s].
        seed: of the random numbers.
    """
    town = load(town_path())
    way = drive_along(town, town_tour(town))
    result: dict[str, Any] = {}
    for name in methods:
        result |= localised(town, way, name, seeds, (FED_SPAN[0], FED_SPAN[0] + span), seed)
    return result


def localised(
    town: Map,
    way: SimulatedDrive,
    method: str,
    n: int,
    span: tuple[float, float],
    seed: int,
) -> dict[str, Any]:
    """Return the figures of localisations by odometry and a scan matching, by their name.

    A match begins at the estimate without GNSS, and goes to all localisations.
    """
    match = METHODS[method]
    rng = np.random.default_rng([seed, 1])
    reference, setup = ScanReference(town), SensorSetup()
    real = [ScanReference(displaced(town, MAP_ERROR, rng)) for _ in range(n)]
    arrivals = simulated_measurements(way, LocalisationLayer(town), setup, rng, n, span)
    start = way.at(span[0]).pose + START * rng.standard_normal((n, 3))
    localisations = {
        name: Localisation(start, span[0], setup.errors, cov=np.diag(START**2))
        for name in (method, f"{method} and GNSS", f"{method} and GNSS, taken as white")
    }
    rows: dict[str, list[Any]] = {name: [] for name in localisations}
    due = span[0] + SCAN_STEP
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
            match(reference, simulated_scan(one, true, rng), start, map_error=MAP_ERROR)
            for one, start in zip(real, guess, strict=True)
        ]
        white = [one._replace(shared=np.zeros((3, 3))) for one in matches]
        for name, localisation in localisations.items():
            fix = pose_fix(measurement.t, white if name.endswith("white") else matches)
            localisation.add(fix)
            poses, times = localisation.poses(), localisation.correlation_times()
            rows[name].append((fix.t, poses.mean - true, poses.cov, true[2], times))
    return {name: fed_figures(run_of(rows[name], [], one)) for name, one in localisations.items()}


def pose_fix(t: float, matches: list[ScanMatch]) -> PoseFix:
    """Return the measurement of n cars; that of a match that is not valid is missing."""
    valid = np.array([one.is_valid for one in matches])[:, None]
    cov, shared = (
        np.where(valid[..., None], np.array(some), np.eye(3))
        for some in ([one.cov - one.shared for one in matches], [one.shared for one in matches])
    )
    return PoseFix(t, np.where(valid, [one.pose for one in matches], np.nan), cov, shared)


def fed_figures(run: Run) -> dict[str, Any]:
    """Return the figures of a localisation."""
    nees, n = run.nees, run.errors.shape[1]
    mean = float(nees.mean())
    rms = np.sqrt(np.square(run.ego_errors).mean(axis=(0, 1)))
    return {
        "NEES": mean,
        "NEES over bound": mean * n / float(chi2.ppf(0.975, 3 * n)),
        "times inside": share_inside(nees, 3),
        "inside": float((nees < chi2.ppf(0.95, 3)).mean()),
        "RMS along [m]": rms[0],
        "RMS across [m]": rms[1],
        "RMS heading [deg]": math.degrees(rms[2]),
        "stated sigma of x, y [m]": float(
            np.sqrt(np.diagonal(run.covs, axis1=-2, axis2=-1)[..., :2].mean())
        ),
    }
