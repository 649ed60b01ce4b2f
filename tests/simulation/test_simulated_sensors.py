"""Simulated sensors have the stated errors, outages and latencies."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from support.lane_maps import lane, network

from maplines_can import Polyline
from maplines_can.localisation import (
    CameraLines,
    GaussMarkov,
    GnssFix,
    LocalisationLayer,
    Odometry,
    SeenLandmarks,
    SensorErrors,
)
from maplines_can.maps import Landmark, LandmarkKind
from maplines_can.simulation.sensors import (
    ErrorProcess,
    SensorSetup,
    SimulatedSensors,
    seen_landmarks,
    simulated_measurements,
)
from maplines_can.simulation.trajectory import SimulatedDrive
from maplines_can.values.line import Kind

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


def test_error_processes_are_the_same_in_any_portions() -> None:
    """Of the same random numbers: e' = phi e + sqrt(1 - phi^2) w, from the first one on."""
    process, dt = GaussMarkov(0.7, 3.0), 0.2
    white = np.random.default_rng(4).standard_normal((12, 2, 3))
    phi = math.exp(-dt / 3.0)
    expected = [white[0]]
    for w in white[1:]:
        expected.append(phi * expected[-1] + math.sqrt(1 - phi**2) * w)
    for portions in ((12,), (1,) * 12, (5, 1, 6)):
        errors = ErrorProcess(process, dt, (2, 3), np.random.default_rng(4))
        got = np.concatenate([errors.next(k) for k in portions], axis=-1)
        assert got == pytest.approx(0.7 * np.moveaxis(np.array(expected), 0, -1))


@pytest.mark.parametrize("sigma", [(0.3, 0.0), (0.0, 0.02), (0.3, 0.02)])
def test_the_covariance_of_a_landmark_is_that_of_range_and_bearing(sigma: Any) -> None:
    """J diag J', with J by differences of the position."""
    distance, bearing = np.array([[5.0, 30.0, np.nan]]), np.array([[0.4, -1.0, 0.0]])
    seen = seen_landmarks(2.5, distance, bearing, sigma)
    assert seen.t == 2.5
    step = 1e-6
    for k in range(2):
        r, a = distance[0, k], bearing[0, k]
        assert seen.position[0, k] == pytest.approx([r * math.cos(a), r * math.sin(a)])
        ends = [
            seen_landmarks(0.0, np.array([[r + dr]]), np.array([[a + da]]), sigma).position[0, 0]
            for dr, da in ((step, 0), (-step, 0), (0, step), (0, -step))
        ]
        J = np.column_stack([ends[0] - ends[1], ends[2] - ends[3]]) / (2 * step)
        assert seen.cov[0, k] == pytest.approx(J @ np.diag(sigma) ** 2 @ J.T, abs=1e-8)
    assert np.isnan(seen.position[0, 2]).all()


def with_error(**errors: Any) -> SensorSetup:
    return replace(EXACT, errors=replace(EXACT.errors, **errors))


def test_the_wheel_speed_has_a_scale_and_a_slip() -> None:
    """True speed = (1 + scale) wheel speed - slip, as the filter of the localisation models it."""
    for name in ("wheel_scale", "speed"):
        errors = {name: GaussMarkov(0.1)}
        speeds = np.array([x.wheel_speed for x in of(made(with_error(**errors), 500), Odometry)])
        assert np.ptp(speeds, axis=0) == pytest.approx(np.zeros(500), abs=1e-9)
        error = 20.0 / speeds[0] - 1 if name == "wheel_scale" else speeds[0] - 20.0
        assert error.std() == pytest.approx(0.1, rel=4 / math.sqrt(1000))


@pytest.mark.parametrize("rate", [10.0, 50.0])
def test_the_white_noise_of_the_yaw_rate_is_a_density(rate: float) -> None:
    """Its integral over a time has the same variance at any rate."""
    setup = replace(with_error(yaw_rate_noise=0.01), odometry_rate=rate)
    arrivals = made(setup, 300, span=(0.0, 4.0))
    rates = np.array([one.yaw_rate for one in of(arrivals, Odometry)])
    assert len(rates) == 4 * rate + 1
    integral = rates[:-1].sum(axis=0) / rate
    assert integral.std() == pytest.approx(0.01 * math.sqrt(4.0), rel=4 / math.sqrt(600))
    biased = made(with_error(yaw_rate=GaussMarkov(0.02)), 300, span=(0.0, 0.1))
    bias = np.array([one.yaw_rate for one in of(biased, Odometry)])
    assert bias[0].std() == pytest.approx(0.02, rel=4 / math.sqrt(600))
    assert np.ptp(bias, axis=0) == pytest.approx(np.zeros(300), abs=1e-12)


def test_camera_errors_are_common_to_the_lines() -> None:
    """Both lines of an image have them in full; they stay for their times."""
    setup = with_error(camera_offset=GaussMarkov(0.1), camera_heading=GaussMarkov(0.01))
    images = of(made(setup, 300), CameraLines)
    offset = np.array([one.offset for one in images]) - [1.75, -1.75]
    heading = np.array([one.heading for one in images])
    for values, sigma in ((offset, 0.1), (heading, 0.01)):
        assert values[..., 0] == pytest.approx(values[..., 1])
        assert np.ptp(values, axis=0) == pytest.approx(np.zeros((300, 2)), abs=1e-9)
        assert values[0, :, 0].std() == pytest.approx(sigma, rel=4 / math.sqrt(600))
    assert abs(np.corrcoef(offset[0, :, 0], heading[0, :, 0])[0, 1]) < 4 / math.sqrt(300)


def test_the_shares_of_what_is_not_as_it_should_be() -> None:
    """Unknown kinds, missed and false landmarks, false lines: within four standard errors."""
    setup = replace(
        EXACT, unknown_kinds=0.3, missed_landmarks=0.25, false_landmarks=0.1, false_lines=0.2
    )
    arrivals = made(setup, 200, span=(0.0, 10.0))
    images, n = of(arrivals, CameraLines), 200
    kinds = np.array([one.kind for one in images])
    share = (kinds == Kind.UNKNOWN).mean()
    assert share == pytest.approx(0.3, abs=4 * math.sqrt(0.21 / kinds.size))
    known = kinds != Kind.UNKNOWN
    assert (kinds == list(KINDS))[known].all()
    off = np.array([one.offset for one in images]) - [1.75, -1.75]
    false = np.abs(off) > 1e-9
    assert false.mean() == pytest.approx(0.2, abs=4 * math.sqrt(0.16 / off.size))
    assert np.abs(off).max() <= 3.0
    spread = np.array([off[false].mean(), off[false].std()])
    assert spread == pytest.approx([0.0, 3 / math.sqrt(3)], abs=4 * 3 / math.sqrt(false.sum()))

    exact = of(made(EXACT, 1, span=(0.0, 10.0)), SeenLandmarks)
    total = missing = wrong = invented = empty = 0
    for true, one in zip(exact, of(arrivals, SeenLandmarks), strict=True):
        assert one.t == pytest.approx(true.t)
        place = np.broadcast_to(true.position, one.position.shape)
        there, seen = np.isfinite(place[..., 0]), np.isfinite(one.position[..., 0])
        same = np.hypot(*np.moveaxis(one.position - place, -1, 0)) < 1e-6
        total += there.sum()
        missing += (there & ~seen).sum()
        wrong += (there & seen & ~same).sum()
        empty += (~there).sum()
        invented += (~there & seen).sum()
        r = np.hypot(*np.moveaxis(one.position, -1, 0))[seen]
        angle = np.arctan2(one.position[..., 1], one.position[..., 0])[seen]
        assert (r <= 40.0 + 1e-9).all()
        assert (np.abs(angle) <= setup.landmark_angle + 1e-9).all()
    for found, of_all, expected in (
        (wrong, total, 0.1),
        (invented, empty, 0.1),
        (missing, total, 0.25 * 0.9),
    ):
        sigma = math.sqrt(expected * (1 - expected) / of_all)
        assert found / of_all == pytest.approx(expected, abs=4 * sigma)
    assert n == len(images[0].offset)


@pytest.mark.parametrize("seed", [1, 2])
def test_random_outages_of_the_lines_last_as_stated(seed: int) -> None:
    """Times between them and their durations are exponential: their means, over many cars."""
    setup = replace(EXACT, line_dropout=(4.0, 2.0), camera_rate=20.0)
    images = of(made(setup, 300, seed), CameraLines)
    out = np.isnan(np.array([one.offset[:, 0] for one in images]))
    assert (out == np.isnan(np.array([one.offset[:, 1] for one in images]))).all()
    t = np.array([one.t for one in images])
    # The share of time of a process that begins without an outage: 1/3 (1 - exp(-t (1/4 + 1/2))).
    expected = (1 - np.exp(-0.75 * t)) / 3
    assert out.mean(axis=1) == pytest.approx(expected, abs=4.5 * math.sqrt(0.22 / 300))
    begins = (np.diff(out.astype(int), axis=0) > 0).sum()
    assert out.sum() / 20.0 / begins == pytest.approx(2.0, rel=0.15)


def test_landmarks_come_at_a_fifth_of_the_rate_of_images() -> None:
    """In any portions of the drive, and nearest first, four at most."""
    sensors = SimulatedSensors(LAYER, EXACT, np.random.default_rng(0))
    ends = [0.0, 0.3, 0.35, 1.0, 2.2, 2.25, 6.0]
    arrivals = [one for end in ends for one in sensors.measure(DRIVE, end)]
    times = [one.t for one in of(arrivals, SeenLandmarks)]
    assert times == pytest.approx(np.arange(0.0, 6.01, 0.5).tolist())
    for one in of(arrivals, SeenLandmarks):
        r = np.hypot(*one.position[0].T)
        seen = r[np.isfinite(r)]
        assert (np.diff(seen) > 0).all()
        assert one.position.shape == (1, 4, 2)


def test_the_nearest_line_on_each_side_is_seen() -> None:
    """Of a road with two lanes, from three places across it."""
    two = network(
        lane("l", length=400.0, t=1.75, kinds=(Kind.SOLID, Kind.DASHED)),
        lane("r", length=400.0, t=-1.75, kinds=(Kind.DASHED, Kind.KERB)),
        rows=["l r"],
    )
    for y, offsets, kinds in (
        (1.0, [2.5, -1.0], [Kind.SOLID, Kind.DASHED]),
        (-0.5, [0.5, -3.0], [Kind.DASHED, Kind.KERB]),
        (-4.0, [0.5, math.nan], [Kind.KERB, Kind.UNKNOWN]),
        (5.0, [math.nan, -1.5], [Kind.UNKNOWN, Kind.SOLID]),
    ):
        way = SimulatedDrive(
            Polyline([[10.0, y], [300.0, y]]), 20.0, start_speed=20.0, end_speed=20.0
        )
        (first, *_) = of(
            simulated_measurements(
                way, LocalisationLayer(two), EXACT, np.random.default_rng(0), span=(5.0, 5.2)
            ),
            CameraLines,
        )
        assert first.offset[0] == pytest.approx(offsets, nan_ok=True)
        assert first.kind[0].tolist() == kinds
        assert np.isnan(first.heading[0]).tolist() == np.isnan(offsets).tolist()
