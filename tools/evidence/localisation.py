#!/usr/bin/env python3
"""Measure whether the localisation knows its own error.

    evidence_localisation.py                       town, motorway and tunnel, 50 seeds
    evidence_localisation.py --scenario tunnel     one of them
    evidence_localisation.py --recorded FILE.npz   a recorded drive, instead of them
    evidence_localisation.py --maps DIR            drives on maps, 20 each, instead of them
    evidence_localisation.py --roads               drives on random roads, 20 each

Run it in the environment of the project: python3 tools/run.py python tools/evidence_localisation.py

Each scenario is a part of the tour through the map of the package, driven by one car for each seed
with simulated sensors. The filter has the parameters of the simulation. The tunnel is a part of the
motorway without GNSS and without landmarks for 60 s.

NEES: normalised error squared of (x, y, heading), 3 if the covariance is right; NIS: that of the
innovations, 2 for each position, line or landmark. At each time, the mean over the seeds is
compared with its 95 % bounds from chi-square; "inside" is the share of times within them. Errors of
successive times are correlated, so that share scatters around 95 % more than independent times
would. The filter "without bias" takes the GNSS position as white noise of the same total variance.

Autocorrelation: that of the errors over the correlation time that the filter states, 0.37 if that
is right.

A recorded drive is an .npz of a car without a map: gnss_t, gnss_enu, gnss_bearing_deg, speed_t,
speed, imu_t, gyro_frd, and the truth truth_t, truth_enu, truth_vel_enu. The parameters come from
the data sheet of the GNSS receiver (2.5 m CEP) and from the scatter of its first 15 s, not from
the truth. Beside it, the filter finds out the error of GNSS by itself, and GNSS is taken as white
noise of 0.5 m. If the file also has gnss_error (m, 2), the standard deviation [m] and correlation
time [s] of the error of each of the m fixes as the receiver states them, the first one takes these;
NaN where it states none. One drive has one bias, so its NEES is one draw.

Drives on maps are those of maplines drive MAP --localise --seconds 60, with the seeds from --seed
on, which draw the route and the errors of the sensors; those on random roads are in the middle of
three lanes, whose outer lines may have no marking. There, "inside" is the share of poses within
their own 95 % region, "lines used" that of the lines of the camera, and "other lane" that of the
times at which the car is on another lane than it believes, by the ids of the map: also one that
overlaps with it or follows it. Errors of a drive last for a minute, so 20 drives are hardly more
than 20 draws, and the bounds of their mean NEES are those of 99 % of 20 draws.

The exit status is 1 if a bound is missed.
"""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from evidence_maps import files_of
from localised_drives import ROADS, Localised, on_map, on_road
from localised_drives import figures as figures_of_drives
from numpy.typing import NDArray
from reporting import parser_of, progress, report
from scipy.stats import chi2

from maplines_can import Gaussian, MapFileError
from maplines_can.localisation import (
    GaussMarkov,
    GnssFix,
    Localisation,
    LocalisationLayer,
    Odometry,
    Outcome,
    SensorErrors,
    Verdict,
)
from maplines_can.maps import load, town_path, town_tour
from maplines_can.simulation.along_route import drive_along
from maplines_can.simulation.sensors import SensorSetup, simulated_measurements
from maplines_can.simulation.simulated_localisation import START_SIGMA
from maplines_can.simulation.trajectory import SimulatedDrive

Array = NDArray[np.float64]

#: Part of the tour of each scenario, and when it has neither GNSS nor landmarks [s].
SCENARIOS: dict[str, tuple[tuple[float, float], tuple[tuple[float, float], ...]]] = {
    "town": ((0.0, 200.0), ()),
    "motorway": ((265.0, 425.0), ()),
    "tunnel": ((265.0, 425.0), ((310.0, 370.0),)),
}
#: Time between two evaluations [s].
STEP = 0.5
#: Least share of times at which the mean over the seeds must be within its 95 % bounds.
MIN_INSIDE = 0.9
#: Least share of poses on a map within their 95 % region.
MIN_SHARE = 0.9
#: Circular error probable of the receiver of the recorded drive, from its data sheet [m]; that of a
#: Gaussian has 1.177 sigma.
CEP = 2.5
#: Time at the begin of a recorded drive from which the noise of GNSS is read [s].
FIRST = 15.0
#: Standard deviation of GNSS, if it is taken as white [m].
WHITE = 0.5


class Run(NamedTuple):
    """Errors of n cars at k times."""

    t: Array  #: (k,) [s]
    errors: Array  #: (k, n, 3) in the map frame
    covs: Array  #: (k, n, 3, 3)
    heading: Array  #: (k,) true [rad]
    correlation_times: Array  #: (k, n, 3) along, across, heading [s]
    outcomes: list[Outcome]
    counts: dict[str, Any]

    @property
    def nees(self) -> Array:
        """(k, n) normalised errors squared."""
        solved = np.linalg.solve(self.covs, self.errors[..., None])[..., 0]
        return np.asarray((self.errors * solved).sum(axis=-1))

    @property
    def ego_errors(self) -> Array:
        """(k, n, 3) along, across, heading."""
        c, s = np.cos(self.heading)[:, None], np.sin(self.heading)[:, None]
        x, y, h = np.moveaxis(self.errors, -1, 0)
        return np.stack([c * x + s * y, -s * x + c * y, h], axis=-1)


def main() -> int:
    parser = parser_of(__doc__)
    parser.add_argument("--scenario", choices=SCENARIOS, help="only this one")
    parser.add_argument("--recorded", type=Path, help="a recorded drive, .npz")
    parser.add_argument("--maps", nargs="+", metavar="DIR", help="folders or files of maps")
    parser.add_argument("--roads", action="store_true", help="random roads")
    parser.add_argument(
        "-n",
        "--seeds",
        type=int,
        help="cars of each scenario (default: 50), or drives on each map and kind of road (20)",
    )
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="of each drive on a map or road (default: 60)"
    )
    parser.add_argument("--seed", type=int, default=0, help="of the random numbers (default: 0)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    arguments = parser.parse_args()
    on_roads = bool(arguments.maps) or arguments.roads
    arguments.seeds = arguments.seeds or (20 if on_roads else 50)
    if on_roads:
        result = driven_on(arguments)
    else:
        result = recorded(arguments.recorded) if arguments.recorded else simulated(arguments)
    return report(result, arguments.json, 34)


def driven_on(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the figures of the drives on each map and on each kind of random road."""
    drives: dict[str, Callable[[int, float], Localised]] = {}
    not_used: dict[str, str] = {}
    for path in files_of(arguments.maps or []):
        try:
            found = load(path)
        except (MapFileError, ImportError) as error:
            not_used[path.name] = str(error)
        else:
            drives[path.name] = partial(on_map, found, LocalisationLayer(found))
    if arguments.roads:
        drives |= {shape: partial(on_road, shape) for shape in ROADS}
    seeds = range(arguments.seed, arguments.seed + arguments.seeds)
    result: dict[str, Any] = {}
    for name, drive in drives.items():
        found_drives = [drive(seed, arguments.seconds) for seed in progress(seeds, name)]
        row = result[name] = figures_of_drives(found_drives)
        low, high = chi2.ppf([0.005, 0.995], 3 * arguments.seeds) / arguments.seeds
        row["met"] = bool(row["inside"] >= MIN_SHARE and low <= row["NEES"] <= high)
    return result | {
        **({"not used": not_used} if not_used else {}),
        "met": bool(result) and all(row["met"] for row in result.values()),
    }


def simulated(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the figures of the scenarios, with and without the bias of GNSS as a state."""
    town = load(town_path())
    way, layer = drive_along(town, town_tour(town)), LocalisationLayer(town)
    names = [arguments.scenario] if arguments.scenario else [*SCENARIOS]
    result: dict[str, Any] = {}
    for name in names:
        for with_bias in (True, False):
            run = driven(way, layer, name, arguments, with_bias=with_bias)
            found = figures(run)
            fails = found["NEES inside"] < MIN_INSIDE
            found["met"] = found.pop("consistent") if with_bias else fails
            result[name if with_bias else f"{name}, without bias"] = found
    return result | {"met": all(found["met"] for found in result.values())}


def driven(
    way: SimulatedDrive,
    layer: LocalisationLayer,
    name: str,
    arguments: argparse.Namespace,
    *,
    with_bias: bool,
) -> Run:
    """Return the run of a scenario."""
    span, tunnels = SCENARIOS[name]
    setup = SensorSetup(gnss_outages=tunnels, landmark_outages=tunnels)
    rng = np.random.default_rng([arguments.seed, sum(name.encode())])
    n, sigma = arguments.seeds, np.array(START_SIGMA)
    arrivals = simulated_measurements(way, layer, setup, rng, n, span)
    start = way.at(span[0]).pose + sigma * rng.standard_normal((n, 3))
    errors, extra = setup.errors, np.zeros((2, 2))
    if not with_bias:
        extra = (errors.gnss or SensorErrors.UNKNOWN_GNSS).sigma ** 2 * np.eye(2)
        errors = replace(errors, gnss=GaussMarkov(0.0))
    outcomes: list[Outcome] = []
    localisation = Localisation(
        start, span[0], errors, layer, cov=np.diag(sigma**2), on_outcome=outcomes.append
    )
    rows, due = [], span[0] + STEP
    what = f"{name}{'' if with_bias else ', without bias'}"
    for _, measurement in progress(arrivals, what):
        if isinstance(measurement, GnssFix):
            measurement = measurement._replace(cov=measurement.cov + extra)
        localisation.add(measurement)
        if isinstance(measurement, Odometry) and measurement.t >= due:
            due += STEP
            true = way.at(measurement.t).pose
            poses = localisation.poses()
            times = localisation.correlation_times()
            rows.append((measurement.t, poses.mean - true, poses.cov, true[2], times))
    return run_of(rows, outcomes, localisation)


def run_of(rows: list[Any], outcomes: list[Outcome], localisation: Localisation) -> Run:
    """Return the run of rows of time, errors, covariances, heading and correlation times."""
    t, errors, covs, heading, times = (np.array(column) for column in zip(*rows, strict=True))
    return Run(t, errors, covs, heading, times, outcomes, localisation.counts())


def figures(run: Run) -> dict[str, Any]:
    """Return the figures of a run."""
    n = run.errors.shape[1]
    nees = run.nees
    low, high = chi2.ppf([0.025, 0.975], 3 * n) / n
    inside = share_inside(nees, 3)
    by_seed = nees.mean(axis=0)  # independent of each other
    error = 1.96 * by_seed.std(ddof=1) / math.sqrt(n) if n > 1 else math.inf
    rms = np.sqrt((run.ego_errors**2).mean(axis=(0, 1)))
    innovations = {
        source: nis_figures([one for one in run.outcomes if one.source == source])
        for source in ("gnss", "line", "landmark")
    }
    mean = float(nees.mean())
    return {
        "NEES mean": mean,
        "NEES mean inside": bool(low <= mean <= high),
        "NEES 95 % bounds at a time": f"{low:.2f} to {high:.2f}",
        "NEES 95 % of the mean": f"{mean - error:.2f} to {mean + error:.2f}",
        "NEES inside": inside,
        "RMS along, across [m]": f"{rms[0]:.3f}, {rms[1]:.3f}",
        "RMS heading [deg]": math.degrees(rms[2]),
        **{f"NIS {source}": found for source, found in innovations.items()},
        "autocorrelation": autocorrelations(run),
        "measurements": {name: dict(counts) for name, counts in run.counts.items()},
        "consistent": inside >= MIN_INSIDE
        and low <= mean <= high
        and all(found["inside"] >= MIN_INSIDE for found in innovations.values()),
    }


def share_inside(squared: Array, values: int) -> float:
    """Return the share of (k,) times at which the mean of (k, n) is within its 95 % bounds.

    Values that are NaN do not count.
    """
    count = np.isfinite(squared).sum(axis=1)
    total = np.nansum(squared, axis=1)[count > 0]
    low, high = chi2.ppf([[0.025], [0.975]], values * count[count > 0])
    return float(((low <= total) & (total <= high)).mean())


def nis_figures(outcomes: list[Outcome]) -> dict[str, float]:
    """Return mean and share inside of the innovations that were used."""
    if not outcomes:
        return {"mean": math.nan, "inside": math.nan}
    squared = np.array(
        [np.where(one.verdict == Verdict.USED, one.squared, np.nan) for one in outcomes]
    )  # (k, n, B)
    return {
        "mean": float(np.nanmean(squared)),
        "inside": share_inside(squared.reshape(len(squared), -1), 2),
    }


def autocorrelations(run: Run) -> dict[str, Any]:
    """Return the median of the stated correlation times, and the autocorrelation over them."""
    found = {}
    for i, name in enumerate(("along", "across", "heading")):
        stated = run.correlation_times[..., i]
        products, squares = [], []
        for k in range(len(run.t)):
            c, s = math.cos(run.heading[k]), math.sin(run.heading[k])
            axis = [np.array([c, s, 0]), np.array([-s, c, 0]), np.array([0, 0, 1.0])][i]
            lag = np.rint(stated[k].clip(max=1e6) / STEP).astype(int)
            for j in np.flatnonzero((lag > 0) & (lag <= k)):
                here, past = run.errors[k, j] @ axis, run.errors[k - lag[j], j] @ axis
                now, then = (axis @ run.covs[m, j] @ axis for m in (k, k - lag[j]))
                products.append(here * past / math.sqrt(now * then))
                squares.append((here**2 / now + past**2 / then) / 2)
        found[name] = {
            "stated time [s]": float(np.median(stated)),
            "found": float(np.sum(products) / np.sum(squares)) if products else math.nan,
        }
    return found


def recorded(path: Path) -> dict[str, Any]:
    """Return the figures of a recorded drive: bias known, found out, and taken as white noise."""
    data = dict(np.load(path, allow_pickle=False))
    noise = white_noise(data)
    bias = SensorErrors(gnss=GaussMarkov(CEP / math.sqrt(2 * math.log(2)), 60.0))
    white = replace(bias, gnss=GaussMarkov(0.0))
    result: dict[str, Any] = {"GNSS noise from the first 15 s [m]": noise}
    for name, errors, sigma in (
        ("bias as a state", bias, noise),
        ("not told", SensorErrors(), noise),
        ("white, 0.5 m", white, WHITE),
    ):
        run = replayed(data, errors, sigma)
        rms = np.sqrt((run.ego_errors**2).mean(axis=(0, 1)))
        sigmas = np.sqrt(np.diagonal(run.covs, axis1=-2, axis2=-1).mean(axis=(0, 1)))
        result[name] = {
            "NEES mean": float(run.nees.mean()),
            "NEES of the position": float(position_nees(run).mean()),
            "RMS along, across [m]": f"{rms[0]:.2f}, {rms[1]:.2f}",
            "RMS heading [deg]": math.degrees(rms[2]),
            "stated sigma x, y [m]": f"{sigmas[0]:.2f}, {sigmas[1]:.2f}",
            "stated sigma heading [deg]": math.degrees(sigmas[2]),
            "NIS gnss": nis_figures(run.outcomes)["mean"],
        }
    # The bounds of one draw of the bias, heading included.
    low, high = chi2.ppf([0.025, 0.975], 3)
    result["95 % bounds of one draw"] = f"{low:.2f} to {high:.2f}"
    right = ("bias as a state", "not told")
    result["met"] = all(low <= result[name]["NEES mean"] <= high for name in right)
    return result


def position_nees(run: Run) -> Array:
    """Return the normalised errors squared of the position, 2 if the covariance is right."""
    e, P = run.errors[..., :2], run.covs[..., :2, :2]
    return np.asarray((e * np.linalg.solve(P, e[..., None])[..., 0]).sum(axis=-1))


def white_noise(data: dict[str, Array]) -> float:
    """Return the standard deviation of the white noise of GNSS, from third differences [m]."""
    first = data["gnss_t"] < data["gnss_t"][0] + FIRST
    return float(np.diff(data["gnss_enu"][first, :2], 3, axis=0).std() / math.sqrt(20))


def replayed(data: dict[str, Array], errors: SensorErrors, sigma: float) -> Run:
    """Return the run of the filter on a recorded drive, evaluated every ``STEP``."""
    speed = np.interp(data["imu_t"], data["speed_t"], data["speed"])
    rate = -data["gyro_frd"][:, 2].astype(float)
    fixes, cov = data["gnss_enu"][:, :2], sigma**2 * np.eye(2)
    bearing = math.radians(data["gnss_bearing_deg"][0])
    start = np.array([*fixes[0], math.pi / 2 - bearing])
    gnss = errors.gnss or SensorErrors.UNKNOWN_GNSS
    position = (gnss.sigma**2 + sigma**2) * np.ones(2)
    begin = float(data["gnss_t"][0])
    outcomes: list[Outcome] = []
    localisation = Localisation(
        Gaussian(start, np.diag([*position, math.radians(1.0) ** 2])),
        begin,
        errors,
        on_outcome=outcomes.append,
    )
    measurements: list[Odometry | GnssFix] = [
        Odometry(t, np.array([v]), np.array([w]))
        for t, v, w in zip(data["imu_t"], speed, rate, strict=True)
        if t >= begin
    ]
    stated = np.full((len(fixes), 2), np.nan)
    if errors.gnss is not None and errors.gnss.sigma > 0:
        stated = data.get("gnss_error", stated)
    measurements += [
        GnssFix(t, fix[None], cov, error)
        for t, fix, error in zip(data["gnss_t"][1:], fixes[1:], stated[1:], strict=True)
    ]
    velocity = data["truth_vel_enu"][:, :2]
    heading = np.unwrap(np.arctan2(velocity[:, 1], velocity[:, 0]))
    true = np.column_stack([data["truth_enu"][:, :2], heading])
    rows, due = [], begin + STEP
    for measurement in sorted(measurements, key=lambda one: one.t):
        localisation.add(measurement)
        t = measurement.t
        if isinstance(measurement, Odometry) and due <= t <= data["truth_t"][-1]:
            due += STEP
            pose = np.array([np.interp(t, data["truth_t"], column) for column in true.T])
            poses = localisation.poses()
            error = poses.mean - pose
            error[:, 2] = (error[:, 2] + math.pi) % (2 * math.pi) - math.pi
            rows.append((t, error, poses.cov, pose[2], localisation.correlation_times()))
    return run_of(rows, outcomes, localisation)


if __name__ == "__main__":
    sys.exit(main())
