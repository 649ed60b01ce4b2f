"""What the localisation knows of its own error.

NEES: normalised error squared of (x, y, heading), 3 if the covariance is right; NIS: that of the
innovations, 2 for each position, line or landmark.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from maplines_can import Gaussian
from maplines_can.localisation import (
    BlockOutcome,
    GaussMarkov,
    GnssFix,
    Localisation,
    LocalisationLayer,
    Odometry,
    SensorErrors,
    Verdict,
)
from maplines_can.maps import load, town_path, town_tour
from maplines_can.simulation.sensors import SensorSetup, simulated_measurements
from maplines_can.simulation.simulated_localisation import START_SIGMA
from maplines_can.simulation.trajectory import SimulatedDrive, drive_along

from .harness import evidence, progress
from .localised_drives import ROADS, Localised, figures, on_map, on_road
from .roads import maps_of

Array = NDArray[np.float64]

#: Part of the tour of each scenario, and when it has neither GNSS nor landmarks [s].
SCENARIOS: dict[str, tuple[tuple[float, float], tuple[tuple[float, float], ...]]] = {
    "town": ((0.0, 200.0), ()),
    "motorway": ((265.0, 425.0), ()),
    "tunnel": ((265.0, 425.0), ((310.0, 370.0),)),
}
#: Time between two evaluations [s].
STEP = 0.5
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
    outcomes: list[BlockOutcome]
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


@evidence(seeds=3, scenarios=("tunnel",), span=6.0)
def tour(
    seeds: int = 50,
    scenarios: tuple[str, ...] = tuple(SCENARIOS),
    span: float = math.inf,
    seed: int = 0,
) -> dict[str, Any]:
    """Drive parts of the tour of the town with simulated sensors; the filter knows their errors.

    The tunnel is a part of the motorway without GNSS and without landmarks for 60 s. At each time,
    the mean over the cars is compared with its 95 % bounds from chi-square; "inside" is the share
    of times within them. Errors of successive times are correlated, so that share scatters around
    95 % more than independent times would. The filter without bias takes the GNSS position as white
    noise of the same total variance, which must be found wrong. Autocorrelation: that of the errors
    over the correlation time that the filter states, 0.37 if that is right.

    Args:
        seeds: number of cars.
        scenarios: parts of the tour.
        span: longest time of a part [s].
        seed: of the random numbers.
    """
    town = load(town_path())
    way, layer = drive_along(town, town_tour(town)), LocalisationLayer(town)
    result: dict[str, Any] = {}
    for name in scenarios:
        for kind, with_bias in (("with bias", True), ("without bias", False)):
            run = driven(way, layer, name, seeds, span, seed, with_bias=with_bias)
            result[f"{name}, {kind}"] = of_run(run)
    return result


@evidence(n=2, seconds=3.0, shapes=("rural",))
def drives(
    maps: tuple[str, ...] = (),
    n: int = 20,
    seconds: float = 60.0,
    shapes: tuple[str, ...] = ROADS,
    seed: int = 0,
) -> dict[str, Any]:
    """Drive on maps as maplines drive MAP --localise does, and on random roads.

    Random roads have three lanes, whose outer lines may have no marking; the car is in the middle
    one. "inside" is the share of poses within their own 95 % region, "lines used" that of the lines
    of the camera, and "other lane" that of the times at which the car is on another lane than it
    believes, by the ids of the map: also one that overlaps with it or follows it.

    Args:
        maps: folders and files of maps.
        n: drives on each map and kind of road; their seeds draw routes and errors.
        seconds: of each drive.
        shapes: of random roads.
        seed: of the first drive.
    """
    sources: dict[str, Callable[[int, float], Localised]] = {
        name: partial(on_map, found, LocalisationLayer(found))
        for name, found in maps_of(maps).items()
    }
    sources |= {shape: partial(on_road, shape) for shape in shapes}
    return {
        name: figures([drive(number, seconds) for number in range(seed, seed + n)])
        for name, drive in progress(sources.items(), "drives", len(sources))
    }


def driven(
    way: SimulatedDrive,
    layer: LocalisationLayer,
    name: str,
    n: int,
    longest: float,
    seed: int,
    *,
    with_bias: bool,
) -> Run:
    """Return the run of n cars through a scenario."""
    (begin, end), tunnels = SCENARIOS[name]
    span = begin, min(end, begin + longest)
    setup = SensorSetup(gnss_outages=tunnels, landmark_outages=tunnels)
    rng, sigma = np.random.default_rng([seed, sum(name.encode())]), np.array(START_SIGMA)
    arrivals = simulated_measurements(way, layer, setup, rng, n, span)
    start = way.at(begin).pose + sigma * rng.standard_normal((n, 3))
    errors, extra = setup.errors, np.zeros((2, 2))
    if not with_bias:
        extra = (errors.gnss or SensorErrors.UNKNOWN_GNSS).sigma ** 2 * np.eye(2)
        errors = replace(errors, gnss=GaussMarkov(0.0))
    outcomes: list[BlockOutcome] = []
    localisation = Localisation(
        start, span[0], errors, layer, cov=np.diag(sigma**2), on_outcome=outcomes.append
    )
    rows, due = [], span[0] + STEP
    for _, measurement in progress(arrivals, name):
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


def run_of(rows: list[Any], outcomes: list[BlockOutcome], localisation: Localisation) -> Run:
    """Return the run of rows of time, errors, covariances, heading and correlation times."""
    t, errors, covs, heading, times = (np.array(column) for column in zip(*rows, strict=True))
    return Run(t, errors, covs, heading, times, outcomes, localisation.counts())


def of_run(run: Run) -> dict[str, Any]:
    """Return the figures of a run."""
    n, nees = run.errors.shape[1], run.nees
    mean = float(nees.mean())
    rms = np.sqrt((run.ego_errors**2).mean(axis=(0, 1)))
    innovations = {
        source: nis_figures([one for one in run.outcomes if one.source == source])
        for source in ("gnss", "line", "landmark")
    }
    return {
        "NEES": mean,
        "quantile of NEES": float(chi2.cdf(n * mean, 3 * n)),
        "NEES inside": share_inside(nees, 3),
        "RMS along [m]": rms[0],
        "RMS across [m]": rms[1],
        "RMS heading [deg]": math.degrees(rms[2]),
        **{f"NIS {source}": found for source, found in innovations.items()},
        "autocorrelation": autocorrelations(run),
    }


def share_inside(squared: Array, values: int) -> float:
    """Return the share of (k,) times at which the mean of (k, n) is within its 95 % bounds.

    Values that are NaN do not count.
    """
    count = np.isfinite(squared).sum(axis=1)
    total = np.nansum(squared, axis=1)[count > 0]
    low, high = chi2.ppf([[0.025], [0.975]], values * count[count > 0])
    return float(((low <= total) & (total <= high)).mean())


def nis_figures(outcomes: list[BlockOutcome]) -> dict[str, float]:
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


@evidence()
def recorded(path: Path | None = None) -> dict[str, Any]:
    """Localise a recorded drive: with the bias of GNSS as a state, found out, or as white noise.

    The parameters come from the data sheet of the GNSS receiver (2.5 m CEP) and from the scatter of
    its first 15 s, not from the truth. One drive has one bias, so its NEES is one draw.

    Args:
        path: an .npz of a car without a map: gnss_t, gnss_enu, gnss_bearing_deg, speed_t, speed,
            imu_t, gyro_frd, and the truth truth_t, truth_enu, truth_vel_enu. gnss_error (m, 2) may
            have the standard deviation [m] and correlation time [s] of the error of each fix as
            the receiver states them, which the first filter takes; NaN where it states none.
    """
    if path is None:
        return {}
    data = dict(np.load(path, allow_pickle=False))
    noise = white_noise(data)
    bias = SensorErrors(gnss=GaussMarkov(CEP / math.sqrt(2 * math.log(2)), 60.0))
    white = replace(bias, gnss=GaussMarkov(0.0))
    result: dict[str, Any] = {}
    for name, errors, sigma in (
        ("bias as a state", bias, noise),
        ("not told", SensorErrors(), noise),
        ("white, 0.5 m", white, WHITE),
    ):
        run = replayed(data, errors, sigma)
        rms = np.sqrt((run.ego_errors**2).mean(axis=(0, 1)))
        sigmas = np.sqrt(np.diagonal(run.covs, axis1=-2, axis2=-1).mean(axis=(0, 1)))
        mean = float(run.nees.mean())
        result[name] = {
            "GNSS noise [m]": sigma,
            "NEES": mean,
            "quantile of NEES": float(chi2.cdf(mean, 3)),
            "RMS along [m]": rms[0],
            "RMS across [m]": rms[1],
            "RMS heading [deg]": math.degrees(rms[2]),
            "stated sigma x [m]": sigmas[0],
            "stated sigma y [m]": sigmas[1],
            "stated sigma heading [deg]": math.degrees(sigmas[2]),
            "NIS gnss": nis_figures(run.outcomes)["mean"],
        }
    return result


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
    outcomes: list[BlockOutcome] = []
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
