"""The filter against closed forms and filterpy, late measurements, and what it refuses."""

import math
import pickle
from typing import Any

import numpy as np
import pytest
from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter
from numpy.typing import NDArray

from maplines_can import Gaussian
from maplines_can.localisation import (
    GaussMarkov,
    GnssFix,
    Localisation,
    Odometry,
    PoseFix,
    SensorErrors,
)
from maplines_can.localisation.motion_model import GNSS, N, initial, predict

DT = 0.02
LINEAR_GNSS = GaussMarkov(1.5, 6.0)
#: With an exact heading, the filter is linear.
LINEAR = SensorErrors(
    speed=GaussMarkov(0.2, 1.0),
    yaw_rate=GaussMarkov(0.0),
    wheel_scale=GaussMarkov(0.02),
    gnss=LINEAR_GNSS,
    camera_offset=GaussMarkov(0.0),
    camera_heading=GaussMarkov(0.0),
    yaw_rate_noise=0.0,
)
EXACT_HEADING = np.diag([2.0, 2.0, 0.0]) ** 2
SIGMA = 0.3


def odometry(t: float, speed: float = 10.0, rate: float = 0.0) -> Odometry:
    return Odometry(t, np.array([speed]), np.array([rate]))


#: With a known error of GNSS.
TOLD = SensorErrors(gnss=GaussMarkov(1.5, 60.0))


def fix(t: float, x: float, y: float, sigma: float = SIGMA) -> GnssFix:
    return GnssFix(t, np.array([[x, y]]), sigma**2 * np.eye(2))


def driven(measurements: list[Any], **settings: Any) -> Localisation:
    settings.setdefault("errors", LINEAR)
    localisation = Localisation(Gaussian(np.zeros(3), EXACT_HEADING), **settings)
    for one in measurements:
        localisation.add(one)
    return localisation


def pose(localisation: Localisation, t: float | None = None) -> Gaussian:
    """Return the pose, which is known."""
    ego = localisation.ego(t)
    assert ego is not None
    return ego


def fixes(rng: np.random.Generator, seconds: int) -> list[GnssFix]:
    """Return positions with errors of 0.5 m at each full second."""
    return [fix(float(t), 10.0 * t + e, n) for t in range(1, seconds + 1)
            for e, n in [0.5 * rng.standard_normal(2)]]  # fmt: skip


class Closed:
    """Joint Gaussian of positions and GNSS errors along x, by the covariances of the processes.

    With an exact heading of 0 and 10 m/s of wheel speed,

        x(t) = x_0 + 10 (1 + k) t - integral of e_v,   z(t) = x(t) + g(t) + noise

    The integral is the sum over the steps of the filter.
    """

    def __init__(self, times: list[float]) -> None:
        self.t = t = np.array(times)
        steps = np.rint(t / DT).astype(int)
        tau, sigma = LINEAR.speed.time, LINEAR.speed.sigma
        lag = np.abs(np.subtract.outer(range(steps.max()), range(steps.max())))
        sums = (sigma * DT) ** 2 * np.exp(-lag * DT / tau)
        sums = np.pad(sums.cumsum(axis=0).cumsum(axis=1), ((1, 0), (1, 0)))
        self.cov = EXACT_HEADING[0, 0] + LINEAR.wheel_scale.sigma**2 * 100 * np.outer(t, t)
        self.cov += sums[np.ix_(steps, steps)]
        bias = LINEAR_GNSS.sigma**2 * np.exp(-np.abs(np.subtract.outer(t, t)) / LINEAR_GNSS.time)
        self.seen = self.cov + bias + SIGMA**2 * np.eye(len(t))

    def gain(self, k: int) -> NDArray[np.float64]:
        """Return the gain of the estimate at the time k from all fixes up to it."""
        past = slice(0, k + 1)
        padded = np.zeros(len(self.t))
        padded[past] = np.linalg.solve(self.seen[past, past], self.cov[past, k])
        return padded

    def error_cov(self, i: int, j: int) -> float:
        """Return the covariance of the errors of the estimates at two times."""
        a, b = self.gain(i), self.gain(j)
        cross = self.cov[i, j] - a @ self.cov[:, j] - b @ self.cov[:, i]
        return float(cross + a @ self.seen @ b)


def test_the_linear_case_is_the_conditional_gaussian() -> None:
    """Mean and variance are those of the joint Gaussian of all positions, without recursion."""
    seen = fixes(np.random.default_rng(1), 12)
    found = driven(sorted([odometry(i * DT) for i in range(1, 601)] + seen, key=lambda one: one.t))
    closed = Closed([one.t for one in seen])
    expected = 120 + closed.gain(11) @ [one.position[0, 0] - 10 * one.t for one in seen]
    assert pose(found).mean[0] == pytest.approx(expected, abs=1e-9)
    assert pose(found).cov[0, 0] == pytest.approx(closed.error_cov(11, 11), rel=1e-9)


def test_the_autocorrelation_is_that_of_the_conditional_gaussian() -> None:
    """Between the last and earlier times, of the errors of the estimates of these times."""
    seen = fixes(np.random.default_rng(1), 12)
    found = driven(
        sorted([odometry(i * DT) for i in range(1, 602)] + seen, key=lambda one: one.t), history=0.0
    )
    closed = Closed([one.t for one in seen])
    lags, rho = found.correlation.autocorrelation(np.zeros(1))
    checked = 0
    for lag, both in zip(lags, rho[:, 0, 0], strict=True):
        second = found.correlation.t - lag
        if abs(second - round(second)) < 1e-6 and 1 <= round(second) < 12:
            i, j = 11, round(second) - 1
            variances = closed.error_cov(i, i) * closed.error_cov(j, j)
            assert both == pytest.approx(closed.error_cov(i, j) / math.sqrt(variances), abs=1e-6)
            checked += 1
    assert checked >= 1


@pytest.mark.parametrize("history", [0.5, 1.0])
def test_late_measurements_are_as_in_order(history: float) -> None:
    """Whatever the order in which they arrive within the history."""
    rng = np.random.default_rng(3)
    errors = SensorErrors()
    driving = [odometry(i * DT, 10.0, 0.2) for i in range(251)]
    seen = [
        fix(t, 50 * math.sin(t / 5), 50 - 50 * math.cos(t / 5)) for t in rng.uniform(0.2, 4, 30)
    ]
    both: list[Any] = [*driving, *seen]
    in_order = sorted(both, key=lambda one: one.t)
    arrivals: list[tuple[float, Any]] = [(one.t, one) for one in driving]
    arrivals += [(one.t + rng.uniform(-0.2, 0.9 * history), one) for one in seen]
    late = sorted(arrivals, key=lambda arrival: arrival[0])
    one = pose(driven(in_order, errors=errors, history=history))
    other = pose(driven([m for _, m in late], errors=errors, history=history))
    assert other.mean == pytest.approx(one.mean, abs=1e-9)
    assert other.cov == pytest.approx(one.cov, abs=1e-9)


def test_what_is_not_used_is_counted() -> None:
    """Outliers, what is too late, too early, or not finite; none of it changes the pose."""
    measurements: list[Any] = [odometry(i * DT) for i in range(201)]
    good = pose(driven(measurements))
    wrong: list[Any] = [
        fix(3.8, 500.0, 0.0),  # outlier
        fix(1.0, 10.0, 0.0),  # too late
        fix(9.0, 90.0, 0.0),  # no odometry
        odometry(3.0),  # not later
        odometry(5.0, math.nan),
        odometry(math.nan),
        fix(3.9, math.nan, 0.0),  # missing
    ]
    found = driven([*measurements, *wrong])
    assert pose(found).mean == pytest.approx(good.mean, abs=1e-12)
    for i in range(201, 300):
        found.add(odometry(i * DT))
    counts = found.counts()
    assert counts["odometry"] == {"USED": 300, "TOO_LATE": 1, "INVALID": 2}
    assert counts["gnss"] == {"OUTLIER": 1}
    assert counts["GnssFix"] == {"TOO_LATE": 1, "NO_ODOMETRY": 1}


def test_the_history_is_bounded() -> None:
    """What is older is forgotten."""
    found = driven([odometry(i * DT) for i in range(1000)])
    size = len(pickle.dumps(found))
    for i in range(1000, 2000):
        found.add(odometry(i * DT))
    assert len(pickle.dumps(found)) < 1.2 * size


def test_an_error_that_pose_fixes_share_does_not_average_out() -> None:
    """While the car stands, the covariance is that of one common error and of the mean of n."""
    shared = np.array([[0.04, 0.01, 0], [0.01, 0.09, 0], [0, 0, 0.0004]])
    noise = np.diag([0.01, 0.01, 1e-4])
    none = GaussMarkov(0.0)
    still = SensorErrors(none, none, none, yaw_rate_noise=0.0)
    found = Localisation(Gaussian(np.zeros(3), 100 * np.eye(3)), errors=still)
    n = 20
    for i in range(n):
        found.add(Odometry(0.1 * i, np.zeros(1), np.zeros(1)))
        found.add(PoseFix(0.1 * i, np.zeros((1, 3)), noise, shared))
    assert pose(found).cov == pytest.approx(shared + noise / n, rel=2e-3, abs=1e-6)


def test_the_pose_between_odometries_is_predicted() -> None:
    found = driven([odometry(i * DT) for i in range(11)])
    assert pose(found, 0.25).mean == pytest.approx([2.5, 0, 0])
    with pytest.raises(ValueError, match=r"t must be finite and 0\.2 s or later"):
        found.ego(0.1)


def test_a_curve_is_as_by_an_unscented_filter() -> None:
    """Of filterpy, on a circle: the linearisation is harmless, and so is the code."""
    errors = TOLD
    mean, cov = initial(np.zeros((1, 3)), np.diag([0.5, 0.5, 0.02]) ** 2, errors)
    points = MerweScaledSigmaPoints(N, alpha=0.5, beta=2.0, kappa=0.0)
    H = np.zeros((2, N))
    H[:, :2] = H[:, GNSS] = np.eye(2)

    def moved(x: NDArray[np.float64], dt: float) -> NDArray[np.float64]:
        after, _, _ = predict(x[None], np.zeros((1, N, N)), 10 * ONE, 0.3 * ONE, dt, errors)
        return after[0]

    ukf = UnscentedKalmanFilter(N, 2, DT, lambda x: H @ x, moved, points)
    ukf.x, ukf.P, ukf.R = mean[0], cov[0], SIGMA**2 * np.eye(2)
    ukf.Q = predict(mean, np.zeros((1, N, N)), 10 * ONE, 0.3 * ONE, DT, errors)[1][0]
    found = Localisation(Gaussian(np.zeros(3), cov[0][:3, :3]), errors=errors)
    found.add(odometry(0.0, 10.0, 0.3))
    rng = np.random.default_rng(2)
    for i in range(1, 251):
        t = i * DT
        ukf.predict()
        if i % 10 == 0:
            x, y = np.array([math.sin(0.3 * t), 1 - math.cos(0.3 * t)]) * 10 / 0.3
            z = np.array([x, y]) + 0.3 * rng.standard_normal(2)
            found.add(fix(t, *z))
            ukf.update(z)
        found.add(odometry(t, 10.0, 0.3))
    ego = pose(found)
    assert ego.mean == pytest.approx(ukf.x[:3], abs=0.02 * ego.sigma.max())
    assert ego.sigma == pytest.approx(np.sqrt(ukf.P.diagonal()[:3]), rel=0.01)


ONE = np.ones(1)


def test_without_observations_the_error_remains() -> None:
    """Its correlation time is unknown."""
    found = driven([odometry(i * DT) for i in range(1, 100)], errors=SensorErrors())
    assert found.correlation_times()[0, 1] == math.inf


def test_the_pose_error_is_the_covariance_in_the_axes_of_the_car() -> None:
    """Along, across, and of the heading, with all that they have in common."""
    errors, turn = SensorErrors(), 0.7
    c, s = math.cos(turn), math.sin(turn)
    P = np.array([[0.5, 0.1, 0.02], [0.1, 0.3, -0.01], [0.02, -0.01, 0.04]])
    found = Localisation(Gaussian([5.0, -3.0, turn], P), errors=errors).pose_error()
    assert found is not None
    rotation = np.zeros((3, 3))
    rotation[:2, :2], rotation[2, 2] = np.array([[c, -s], [s, c]]).T, 1.0
    assert found.cov == pytest.approx(rotation @ P @ rotation.T, abs=1e-12)
    assert found.cov[2, 2] == pytest.approx(0.04)


def test_the_correlation_time_is_where_the_autocorrelation_falls_to_1_over_e() -> None:
    """The pose is known by GNSS alone, since the wheel speed says nothing; so its error is that."""
    errors = SensorErrors(
        speed=GaussMarkov(3000.0, 0.01), yaw_rate=GaussMarkov(0.0), wheel_scale=GaussMarkov(0.0),
        gnss=GaussMarkov(1.5, 4.0), camera_offset=GaussMarkov(0.0),
        camera_heading=GaussMarkov(0.0), yaw_rate_noise=0.0,
    )  # fmt: skip
    found = driven(
        sorted(
            [odometry(i * DT) for i in range(1, 1001)]
            + [fix(i * DT, 10 * i * DT, 0.0, 0.01) for i in range(1, 1001)],
            key=lambda one: one.t,
        ),
        errors=errors,
    )
    along, across, heading = found.correlation_times()[0]
    assert along == pytest.approx(4.0, rel=0.1)
    error = found.pose_error()
    assert error is not None
    assert error.correlation_time == across
    assert heading == math.inf  # it has no error
