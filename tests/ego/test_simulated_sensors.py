"""Simulated sensors have the stated errors, outages and latencies."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from lane_maps import lane, network

from maplines_can import Polyline
from maplines_can.ego import (
    CameraLines,
    GaussMarkov,
    GnssFix,
    LocalisationLayer,
    Odometry,
    SeenLandmarks,
    SensorErrors,
    SensorSetup,
    SimulatedDrive,
    SimulatedSensors,
    simulated_measurements,
)
from maplines_can.ego.simulated_sensors import ErrorProcess
from maplines_can.line import Kind
from maplines_can.maps import Landmark, LandmarkKind

DRIVE = SimulatedDrive(Polyline([[0, 0], [400, 0]]), 20.0, start_speed=20.0, end_speed=20.0)
KINDS = (Kind.DASHED, Kind.SOLID)
POLES = tuple(Landmark(str(x), LandmarkKind.POLE, x, 6.0) for x in range(10, 400, 30))
LAYER = LocalisationLayer(network(lane("1", length=400.0, kinds=KINDS), landmarks=POLES))
SETUP = SensorSetup()
NONE = GaussMarkov(0.0)
EXACT = SensorSetup(
    errors=SensorErrors(NONE, NONE, NONE, NONE, NONE, NONE, yaw_rate_noise=0.0),
    gnss_sigma=0.0, line_sigma=(0.0, 0.0), line_dropout=(1e9, 1.0), false_lines=0.0,
    unknown_kinds=0.0, landmark_sigma=(0.0, 0.0), missed_landmarks=0.0, false_landmarks=0.0,
)  # fmt: skip


def made(setup: SensorSetup, n: int = 1, seed: int = 0, **settings: Any) -> list[Any]:
    return simulated_measurements(DRIVE, LAYER, setup, np.random.default_rng(seed), n, **settings)


def of(arrivals: list[Any], kind: type) -> list[Any]:
    return [one.measurement for one in arrivals if isinstance(one.measurement, kind)]


def test_the_errors_are_gauss_markov() -> None:
    """Their variance is constant, and their correlation over 2 s with 4 s is exp(-1/2)."""
    t = np.arange(0.0, 30.0, 0.5)
    e = ErrorProcess(GaussMarkov(1.5, 4.0), 0.5, (4000,), np.random.default_rng(1)).next(len(t))
    assert e.std(axis=0) == pytest.approx(np.full(len(t), 1.5), rel=0.06)
    assert (e[:, 40] * e[:, 44]).mean() / 1.5**2 == pytest.approx(math.exp(-0.5), abs=0.06)
    constant = ErrorProcess(GaussMarkov(2.0), 0.5, (3,), np.random.default_rng(1)).next(len(t))
    assert (constant == constant[:, :1]).all()


def test_without_errors_the_sensors_tell_the_truth() -> None:
    """Positions, speeds, lines 1.75 m to both sides, and the poles ahead."""
    arrivals = made(EXACT)
    for one in of(arrivals, GnssFix):
        assert one.position[0] == pytest.approx(DRIVE.at(one.t).pose[:2])
    for one in of(arrivals, Odometry):
        assert (one.wheel_speed[0], one.yaw_rate[0]) == pytest.approx((20.0, 0.0), abs=1e-9)
    for one in of(arrivals, CameraLines):
        assert one.offset[0] == pytest.approx([1.75, -1.75])
        assert one.heading[0] == pytest.approx([0.0, 0.0], abs=1e-9)
        assert one.kind[0].tolist() == list(KINDS)
    for one in of(arrivals, SeenLandmarks):
        x = DRIVE.at(one.t).pose[0]
        ahead = [p.x - x for p in POLES if 6 / math.tan(SETUP.landmark_angle) <= p.x - x]
        near = [d for d in ahead if math.hypot(d, 6) <= 40][:4]
        seen = one.position[0][np.isfinite(one.position[0, :, 0])]
        assert seen == pytest.approx(np.array([(d, 6.0) for d in near]).reshape(-1, 2))


def test_the_order_is_that_of_the_arrivals() -> None:
    arrivals = made(SETUP)
    times = [one.t for one in arrivals]
    assert times == sorted(times)
    for one in arrivals:
        late = {GnssFix: 0.1, Odometry: 0.0}.get(type(one.measurement), 0.06)
        assert one.t - one.measurement.t == pytest.approx(late)


def test_the_seed_gives_the_errors() -> None:
    """The same one the same; another one, and another car, others."""
    one, same, other = (of(made(SETUP, 2, seed), GnssFix) for seed in (1, 1, 2))
    assert (one[3].position == same[3].position).all()
    assert (one[3].position != other[3].position).all()
    assert (one[3].position[0] != one[3].position[1]).all()


def test_the_noise_is_as_stated() -> None:
    """Of positions and of lines, over 400 cars, within four standard errors."""
    setup = replace(
        SETUP, false_lines=0.0, line_dropout=(1e9, 1.0), errors=EXACT.errors, camera_rate=2.0
    )
    arrivals = made(setup, 400)
    share = 4 / math.sqrt(2 * 400 * 20)
    gnss = np.array([x.position - DRIVE.at(x.t).pose[:2] for x in of(arrivals, GnssFix)])
    assert gnss.std() == pytest.approx(setup.gnss_sigma, rel=share)
    lines = np.array([(x.offset, x.heading) for x in of(arrivals, CameraLines)])
    assert (lines[:, 0] - [1.75, -1.75]).std() == pytest.approx(0.05, rel=share)
    assert lines[:, 1].std() == pytest.approx(setup.line_sigma[1], rel=share)


def test_outages_are_kept() -> None:
    """No positions and no landmarks; lines are missing."""
    out = ((5.0, 9.0),)
    setup = replace(SETUP, gnss_outages=out, line_outages=out, landmark_outages=out)
    arrivals = made(setup, span=(2.0, 15.0))
    for kind in (GnssFix, SeenLandmarks):
        times = np.array([one.t for one in of(arrivals, kind)])
        assert not ((times >= 5) & (times < 9)).any()
        assert times.min() == 2.0
        assert times.max() > 9
    for one in of(arrivals, CameraLines):
        if 5 <= one.t < 9:
            assert np.isnan(one.offset).all()
    assert any(np.isfinite(one.offset).all() for one in of(arrivals, CameraLines))


def test_the_share_of_false_and_missing_lines() -> None:
    """Over 200 cars; the lines are missing for 5 s in 65 s."""
    lines = np.array([x.offset for x in of(made(SETUP, 200), CameraLines)])
    missing = np.isnan(lines).mean()
    assert 0.02 < missing < 0.12
    off = np.abs(lines[np.isfinite(lines)].reshape(-1, 1) - [1.75, -1.75]).min(axis=1) > 0.4
    assert off.mean() == pytest.approx(SETUP.false_lines * (1 - 0.4 / 3), rel=0.25)


def test_the_errors_continue_from_call_to_call() -> None:
    """In a closed loop the way is known bit by bit: the times are the same, the bias remains."""
    constant = replace(EXACT.errors, gnss=GaussMarkov(2.0), camera_offset=GaussMarkov(0.1))
    setup = replace(EXACT, errors=constant, line_dropout=(3.0, 2.0))
    sensors = SimulatedSensors(LAYER, setup, np.random.default_rng(1))
    parts = [sensors.measure(DRIVE, end) for end in np.arange(0.0, 10.0, 0.05)]
    arrivals = [one for part in parts for one in part]
    whole = made(setup, span=(0.0, 9.95))
    for kind in (GnssFix, Odometry, CameraLines, SeenLandmarks):
        times = [one.t for one in of(arrivals, kind)]
        assert times == pytest.approx([one.t for one in of(whole, kind)])
    bias = [x.position[0] - DRIVE.at(x.t).pose[:2] for x in of(arrivals, GnssFix)]
    assert np.ptp(bias, axis=0) == pytest.approx([0.0, 0.0], abs=1e-9)
    assert abs(np.mean(bias)) > 0.1
    seen = np.array([x.offset[0, 0] for x in of(arrivals, CameraLines)])
    assert np.ptp(seen[np.isfinite(seen)]) == pytest.approx(0.0, abs=1e-9)
    out = np.flatnonzero(np.diff(np.isnan(seen)))
    assert 2 <= len(out) < 20  # some outages, each of many images
