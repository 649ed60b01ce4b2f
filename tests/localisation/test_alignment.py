"""The pose from positions along the odometry: exact without errors, consistent with them."""

import math
from typing import Any

import numpy as np
import pytest
from scipy.stats import chi2

from maplines_can.localisation import GaussMarkov, SensorErrors
from maplines_can.localisation.alignment import MIN_WAY, Position, aligned

ERRORS = SensorErrors(gnss=GaussMarkov(1.5, 60.0))
DT = 0.2


def way(n: int, speed: float, rate: float) -> Any:
    """Return (n, 3) poses along an arc."""
    heading = rate * DT * np.arange(n)
    step = speed * DT * np.column_stack([np.cos(heading), np.sin(heading)])
    return np.column_stack([np.cumsum(step, axis=0), heading])


def moved(poses: Any, by: Any) -> Any:
    c, s = math.cos(by[2]), math.sin(by[2])
    xy = poses[:, :2] @ np.array([[c, s], [-s, c]]) + by[:2]
    return np.column_stack([xy, poses[:, 2] + by[2]])


def positions(seen: Any, odometry: Any, sigma: float, *, is_gnss: bool = True) -> list[Position]:
    cov, none = sigma**2 * np.eye(2)[None], np.zeros((1, 2, 2))
    return [
        Position(DT * i, is_gnss, one[None], cov, none, other[None, :2])
        for i, (one, other) in enumerate(zip(seen, odometry, strict=True))
    ]


@pytest.mark.parametrize("turn", [0.0, 1.0, 3.0, -2.0])
@pytest.mark.parametrize("rate", [0.0, 0.2])
def test_without_errors_the_pose_is_exact(turn: float, rate: float) -> None:
    """For any rotation of the frame of the odometry."""
    true = way(40, 10.0, rate)
    odometry = moved(true, [100.0, -50.0, turn])
    found = aligned(positions(true[:, :2], odometry, 0.1), 0, -1.0, odometry[-1], ERRORS)
    assert found is not None
    difference = found.pose - true[-1]
    difference[2] = math.remainder(difference[2], 2 * math.pi)
    assert difference == pytest.approx(np.zeros(3), abs=1e-9)


@pytest.mark.parametrize("rate", [0.0, 0.1])
def test_the_covariance_is_that_of_the_errors(rate: float) -> None:
    """NEES of 300 draws of the errors; so is the joint one with the bias of GNSS."""
    rng, n, sigma = np.random.default_rng(7), 30, 0.4
    true, draws, found = way(n, 10.0, rate), 300, []
    phi = math.exp(-DT / 60)
    for _ in range(draws):
        bias = 1.5 * rng.standard_normal((n, 2))
        for i in range(1, n):
            bias[i] = phi * bias[i - 1] + math.sqrt(1 - phi**2) * bias[i]
        seen = true[:, :2] + bias + sigma * rng.standard_normal((n, 2))
        one = aligned(positions(seen, true, sigma), 0, -1.0, true[-1], ERRORS)
        assert one is not None
        if not one.fits:
            continue
        joint = np.zeros((5, 5))
        joint[:3, :3], joint[3:, 3:] = one.cov, 2.25 * np.eye(2)
        joint[:3, 3:], joint[3:, :3] = one.bias_cov, one.bias_cov.T
        e = np.append(true[-1] - one.pose, bias[-1])
        found.append((e[:3] @ np.linalg.solve(one.cov, e[:3]), e @ np.linalg.solve(joint, e)))
    assert len(found) > 0.98 * draws
    mean = np.mean(found, axis=0)
    # The model also has errors of the odometry, which are not drawn: so it may be cautious.
    for k, values in enumerate((3, 5)):
        high = chi2.ppf(1 - 1e-4, values * len(found)) / len(found)
        assert 0.7 * values < mean[k] < high


@pytest.mark.parametrize(
    "wrong",
    [
        pytest.param(lambda p: np.column_stack([1.5 * p[:, 0], p[:, 1]]), id="scale"),
        pytest.param(lambda p: p + np.repeat([[0, 0], [0, 8]], 20, axis=0), id="jump"),
        pytest.param(lambda p: p * [1, 2] + 0.1 * p[::-1], id="other-curve"),
        pytest.param(lambda p: p * 0, id="frozen"),
    ],
)
def test_positions_that_do_not_fit_give_no_pose(wrong: Any) -> None:
    true = way(40, 10.0, 0.1)
    odometry = moved(true, [30.0, 5.0, 1.0])
    for seen, fits in ((true[:, :2], True), (wrong(true[:, :2]), False)):
        found = aligned(positions(seen, odometry, 0.4), 0, -1.0, odometry[-1], ERRORS)
        assert found is not None
        assert found.fits == fits


def test_a_pose_needs_a_way_and_time() -> None:
    """A car that stands has no heading; and what is before the loss is not used."""
    true = way(40, 10.0, 0.0)
    one = positions(true[:, :2], true, 0.4)
    assert aligned(one, 0, -1.0, true[-1], ERRORS) is not None
    assert aligned(one, 0, 6.0, true[-1], ERRORS) is None
    slow = way(40, 0.9 * MIN_WAY / (39 * DT), 0.0)
    assert aligned(positions(slow[:, :2], slow, 0.4), 0, -1.0, slow[-1], ERRORS) is None
    missing = [p._replace(position=np.full((1, 2), np.nan)) for p in one]
    assert aligned(missing, 0, -1.0, true[-1], ERRORS) is None
