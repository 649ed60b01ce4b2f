"""A localisation on simulated sensors knows its own error; without the GNSS bias it does not."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import chi2
from support.fixtures import Patch
from support.lane_maps import lane, network

from maplines_can import Polyline, Slot, maps
from maplines_can.localisation import GaussMarkov, GnssFix, Localisation, LocalisationLayer
from maplines_can.localisation.scan_matching import ScanReference
from maplines_can.maps import Landmark, LandmarkKind, Map
from maplines_can.maps.line_source import LineSource
from maplines_can.simulation import simulated_localisation
from maplines_can.simulation.sensors import Arrival, SensorSetup, simulated_measurements
from maplines_can.simulation.simulated_localisation import SimulatedLocalisation
from maplines_can.simulation.trajectory import SimulatedDrive, drive_along
from maplines_can.testing.sensor_faults import FAULTS, injected
from maplines_can.values.line import Kind

#: A straight motorway at 30 m/s, with a pole every 200 m.
ROAD = [[0, 0], [1500, 0]]
DRIVE = SimulatedDrive(Polyline(ROAD), 30.0, start_speed=30.0, end_speed=30.0)
POLES = tuple(Landmark(str(x), LandmarkKind.POLE, x, 8.0) for x in range(100, 1500, 200))
MAP = network(
    lane("1", length=1500.0, kinds=(Kind.DASHED, Kind.SOLID)),
    lane("2", length=1500.0, t=3.5, kinds=(Kind.SOLID, Kind.DASHED)),
    rows=["2 1"],
    landmarks=POLES,
)
LAYER = LocalisationLayer(MAP)
SIGMA = np.array([1.0, 1.0, math.radians(1.0)])
CARS = 20


def nees(*, with_bias: bool = True, **settings: Any) -> NDArray[np.float64]:
    """Return the (k, CARS) normalised errors squared in steps of 2 s."""
    setup = SensorSetup(camera_rate=5.0, **settings)
    rng = np.random.default_rng(4)
    arrivals = simulated_measurements(DRIVE, LAYER, setup, rng, CARS, (0.0, 30.0))
    start = DRIVE.at(0.0).pose + SIGMA * rng.standard_normal((CARS, 3))
    errors, extra, gnss = setup.errors, 0.0, setup.errors.gnss
    if not with_bias:
        assert gnss is not None
        errors, extra = replace(errors, gnss=GaussMarkov(0.0)), gnss.sigma**2
    localisation = Localisation(start, 0.0, errors, LAYER, cov=np.diag(SIGMA**2))
    found, due = [], 2.0
    for t, one in arrivals:
        if isinstance(one, GnssFix):
            one = one._replace(cov=one.cov + extra * np.eye(2))
        localisation.add(one)
        if t >= due and localisation.t >= due:
            due += 2.0
            poses = localisation.poses()
            e = poses.mean - DRIVE.at(localisation.t).pose
            found.append((e * np.linalg.solve(poses.cov, e[..., None])[..., 0]).sum(axis=-1))
    return np.array(found)


def test_the_error_is_consistent() -> None:
    """On a motorway, 18 s of it in a tunnel; the mean over cars within bounds of 1e-4 each."""
    found = nees(gnss_outages=((8.0, 26.0),)).mean(axis=1)
    low, high = chi2.ppf([1e-4, 1 - 1e-4], 3 * CARS) / CARS
    assert ((low < found) & (found < high)).all()


def test_without_the_gnss_bias_it_is_not() -> None:
    """As far as the bias does not look like a drift, which would be covered."""
    assert nees(with_bias=False).mean() > 1.4 * 3


def test_the_reported_pose_drives_a_line_source() -> None:
    """Its scenes have the covariance of the filter and its correlation time."""
    source = SimulatedLocalisation(DRIVE, LAYER, seed=2)
    lines = LineSource(
        MAP, source.pose, (Slot.EGO_LEFT,), correlation_time=lambda: source.correlation_time
    )
    for t in np.arange(0.1, 6.0, 0.05):
        cycle = lines.cycle(t, DRIVE.at(t).pose)
    assert cycle.scene is not None
    assert cycle.reported is not None
    error = cycle.scene.pose_error
    assert error.correlation_time == source.correlation_time < 60
    assert np.sqrt(error.cov.diagonal())[1] == pytest.approx(cycle.reported.sigma[1], rel=1e-3)
    assert cycle.reported.sigma[1] < 0.1
    assert source.counts()["line"]["USED"] > 50


@pytest.mark.parametrize("name", ["60 s ahead", "dropped"])
def test_wrong_stamps_give_no_pose(monkeypatch: Patch, name: str) -> None:
    """They never raise out of the source, and the pose is found again."""
    (fault,) = (one for one in FAULTS if (one.sensor, one.name) == ("odometry", name))

    def measurements(*args: Any) -> list[Arrival]:
        return list(injected(simulated_measurements(*args), fault, 5.0, 9.0))

    monkeypatch.setattr(simulated_localisation, "simulated_measurements", measurements)
    source = SimulatedLocalisation(DRIVE, LAYER, SensorSetup(odometry_rate=20.0, camera_rate=2.0))
    poses = {float(t): source.pose(t) for t in np.arange(0.1, 40.0, 0.1)}
    assert all(pose is not None for t, pose in poses.items() if t < 5.0)
    assert [t for t, pose in poses.items() if pose is None and 7.5 < t < 9.0]
    assert list(poses.values())[-1] is not None


def test_the_first_pose_is_off_by_what_is_stated() -> None:
    """In each direction, over many seeds, within four standard errors."""
    way = SimulatedDrive(Polyline([[0, 0], [50, 0]]))
    layer, sigma = LocalisationLayer(Map({}, {})), np.array([0.5, 0.2, 0.02])
    errors = []
    for seed in range(60):
        stated = SimulatedLocalisation(way, layer, seed=seed, start_sigma=sigma).pose(0.0)
        assert stated is not None
        errors.append((stated.mean - way.at(0.0).pose) / sigma)
    assert np.std(errors, axis=0) == pytest.approx(np.ones(3), rel=4 / np.sqrt(120))
    assert np.abs(np.mean(errors, axis=0)).max() < 4 / np.sqrt(60)


def test_scans_that_are_matched_make_the_pose_more_certain() -> None:
    """In the streets of the town, where there are houses; the errors are as stated."""
    town = maps.load(maps.town_path())
    way = drive_along(town, maps.town_tour(town))
    layer, sigmas, errors = LocalisationLayer(town), [], []
    for surfaces in (None, ScanReference(town)):
        source = SimulatedLocalisation(way, layer, seed=1, surfaces=surfaces)
        reported = [(source.pose(t), way.at(t).pose) for t in np.arange(4.0, 8.0)]
        known = [(ego, true) for ego, true in reported if ego is not None]
        assert len(known) == 4
        sigmas.append(np.mean([np.hypot(*ego.sigma[:2]) for ego, _ in known]))
        errors += [(ego.mean - true) / ego.sigma for ego, true in known]
        assert ("pose" in source.counts()) is (surfaces is not None)
    assert sigmas[1] < sigmas[0] / 2
    assert np.abs(errors).max() < 4
