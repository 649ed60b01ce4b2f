"""Derivatives, innovations and updates of the localisation against differences and textbooks."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import chi2
from support.lane_maps import lane, network

from maplines_can import Gaussian
from maplines_can.localisation import (
    CameraLines,
    GnssFix,
    Localisation,
    LocalisationLayer,
    PoseFix,
    SeenLandmarks,
    Verdict,
)
from maplines_can.localisation.association import GATES, Candidates, associate
from maplines_can.localisation.correlation import ErrorCorrelation
from maplines_can.localisation.motion_model import FIX, HEADING, N, update
from maplines_can.localisation.observation_models import innovation, line_jacobian
from maplines_can.maps import Landmark, LandmarkKind
from maplines_can.maps.lane import LaneType
from maplines_can.values.line import Kind

KINDS = (Kind.DASHED, Kind.SOLID)
SCALES = np.array([1, 1, 0.05, 0.1, 0.01, 0.02, 2, 2, 0.1, 0.01, 1, 1, 1])
LAYER = LocalisationLayer(
    network(lane("1", kinds=KINDS), landmarks=(Landmark("pole", LandmarkKind.POLE, 60.0, 4.0),))
)


def states(n: int, seed: int = 0) -> tuple[Any, Any]:
    """(n, N) means near (50, 0, 0.1) and (n, N, N) covariances with all correlations."""
    rng = np.random.default_rng(seed)
    mean = 0.1 * SCALES * rng.standard_normal((n, N))
    mean[:, :3] += [50.0, 0.0, 0.1]
    A = SCALES[:, None] * rng.standard_normal((n, N, N)) / 4
    return mean, A @ A.mT


def crossing(pose: Any, curvature: float) -> tuple[float, float, float]:
    """y_off, beta and c0 of a circle (or the x axis) through the origin, seen from a pose."""
    x, y, h = pose
    if not curvature:
        return -y / math.cos(h), -math.remainder(h, math.pi), 0.0
    # The centre (0, 1 / curvature) in the frame of the car.
    d = np.array([-x, 1 / curvature - y])
    c, s = math.cos(h), math.sin(h)
    cx, cy = c * d[0] + s * d[1], c * d[1] - s * d[0]
    root = math.sqrt(curvature**-2 - cx**2)
    offset = min(cy + root, cy - root, key=abs)
    slope = cx / (offset - cy)
    return offset, math.atan(slope), (1 + slope**2) / (cy - offset)


@given(
    st.sampled_from([0.0, 0.02, -0.05, 0.1]),
    st.floats(-0.5, 0.5),
    st.floats(-3, 3),
    st.floats(-3, 3),
    st.floats(-4, 4),
)
def test_the_jacobian_of_a_line_in_closed_form(
    curvature: float, turn: float, y: float, x: float, frame: float
) -> None:
    """A circle or a straight line, from a pose beside it, in a map that is turned in any way."""
    pose = np.array([x, y, turn])
    offset, beta, c0 = crossing(pose, curvature)
    c, s = math.cos(frame), math.sin(frame)
    J = line_jacobian(np.array([[offset, beta]]), np.array([c0]), np.array([turn + frame]))[0]
    for k, step in enumerate((1e-4, 1e-4, 1e-5)):
        w = step * np.eye(3)[k]
        w[:2] = c * w[0] + s * w[1], c * w[1] - s * w[0]  # in the frame in which the line is known
        ends = [np.array(crossing(pose + sign * w, curvature)[:2]) for sign in (1, -1)]
        assert J[:, k] == pytest.approx((ends[0] - ends[1]) / (2 * step), abs=1e-5)
    assert J[:, 8:10].tolist() == [[1, 0], [0, 1]]
    assert not J[:, [3, 4, 5, 6, 7, 10, 11, 12]].any()


POSE = np.array([[50.3, -0.2, 0.12], [49.9, 0.1, 0.09]])
A = np.array([[0.3, 0, 0], [0.1, 0.2, 0], [0.01, 0.0, 0.02]])
OBSERVATIONS: dict[str, Any] = {
    "gnss": GnssFix(0.0, POSE[:, :2] + [[0.5, 0.2], [-0.3, 0.1]], np.diag([0.4, 0.5]) ** 2),
    "pose": PoseFix(0.0, POSE, np.diag([0.2, 0.1, 0.01]) ** 2),
    "shared": PoseFix(0.0, POSE, np.diag([0.2, 0.1, 0.01]) ** 2, A @ A.T),
    "lines": CameraLines(
        0.0,
        np.array([[1.8, -1.7], [1.6, -1.9]]),
        np.array([[-0.1, -0.12], [-0.09, -0.1]]),
        np.tile(KINDS, (2, 1)),
        np.diag([0.05, 0.005]) ** 2,
    ),
    "landmark": SeenLandmarks(
        0.0, np.array([[[10.2, 3.1]], [[10.5, 2.9]]]), np.array([[0.04, 0.01], [0.01, 0.09]])
    ),
}


@pytest.mark.parametrize("name", OBSERVATIONS)
def test_residuals_change_by_minus_h(name: str) -> None:
    """By each state, for each car; lines as the layer samples them, the others to rounding."""
    mean, cov = states(2)
    if name == "lines":  # of a pose that is known: one line at one place, without a rest
        cov *= 1e-8
    observation = OBSERVATIONS[name]
    base = innovation(observation, mean, cov, LAYER)
    assert base.source == {"shared": "pose", "lines": "line"}.get(name, name)
    for k in range(N):
        w = 1e-5 * np.eye(N)[k]
        ends = [innovation(observation, mean + sign * w, cov, LAYER) for sign in (1, -1)]
        slope = (ends[1].residual - ends[0].residual) / 2e-5
        assert base.H[..., k] == pytest.approx(slope, abs=2e-4 if name == "lines" else 1e-6)


@pytest.mark.parametrize("name", OBSERVATIONS)
def test_innovations_have_the_covariance_of_a_kalman_filter(name: str) -> None:
    """S = H P H' + R, and its normalised square decides at the 99.9 % quantile."""
    mean, cov = states(2, seed=3)
    if name == "lines":
        cov *= 1e-8
    found = innovation(OBSERVATIONS[name], mean, cov, LAYER)
    m = found.residual.shape[2]
    for car in range(2):
        for block in range(found.residual.shape[1]):
            H, R = found.H[car, block], found.R[car, block]
            stated = OBSERVATIONS[name].cov
            assert pytest.approx(np.broadcast_to(stated, R.shape), rel=1e-6, abs=1e-12) == R
            S = H @ cov[car] @ H.T + R
            assert found.S[car, block] == pytest.approx(S)
            r = found.residual[car, block]
            assert found.squared[car, block] == pytest.approx(r @ np.linalg.inv(S) @ r)
    assert GATES[m] == pytest.approx(chi2.isf(1e-3, m))


@pytest.mark.parametrize("name", ["gnss", "pose", "shared"])
def test_the_gate_of_a_fix(name: str) -> None:
    """Within it a fix is used, beyond it is an outlier; one that is not finite is missing."""
    mean, cov = states(2, seed=5)
    fix: Any = OBSERVATIONS[name]
    field = "position" if name == "gnss" else "pose"
    given_ = getattr(fix, field)
    found = innovation(fix, mean, cov, None)
    exact = given_ - found.residual[:, 0]  # at which the residual is 0
    for factor, verdict in ((0.999, Verdict.USED), (1.001, Verdict.OUTLIER)):
        share = factor * np.sqrt(GATES[given_.shape[1]] / found.squared[:, :1])
        moved = innovation(
            fix._replace(**{field: exact + share * found.residual[:, 0]}), mean, cov, None
        )
        if (np.abs(moved.residual[..., -1]) < 3).all():  # a heading turns round at pi
            assert moved.verdict.tolist() == [[verdict], [verdict]]
    absent = given_.copy()
    absent[1, 0] = np.nan
    missing = innovation(fix._replace(**{field: absent}), mean, cov, None)
    assert missing.verdict[1, 0] == Verdict.MISSING
    assert not missing.residual[1].any()


@given(st.integers(-3, 3), st.floats(-3, 3))
def test_the_heading_of_a_fix_is_compared_as_an_angle(turns: int, error: float) -> None:
    mean, cov = states(1)
    pose = mean[:, :3] + [0, 0, error + 2 * math.pi * turns]
    found = innovation(PoseFix(0.0, pose, np.eye(3)), mean, cov, None)
    assert found.residual[0, 0] == pytest.approx([0, 0, error], abs=1e-9)


def test_the_shared_error_of_fixes_has_their_covariance() -> None:
    """Its states are in units of the symmetric root, which turns with the covariance."""
    mean, cov = states(2)
    found = innovation(OBSERVATIONS["shared"], mean, cov, None)
    root = found.H[0, 0, :, FIX]
    assert root == pytest.approx(root.T)
    assert root @ root == pytest.approx(A @ A.T)
    assert np.linalg.eigvalsh(root)[0] > 0
    alone = innovation(OBSERVATIONS["pose"], mean, cov, None)
    shift = alone.residual[:, 0] - found.residual[:, 0]
    assert shift == pytest.approx(mean[:, FIX] @ root)


@pytest.mark.parametrize("used", [[True, True], [True, False], [False, False]])
@pytest.mark.parametrize("m", [2, 3])
def test_an_update_is_that_of_a_kalman_filter(used: list[bool], m: int) -> None:
    """One measurement after another, in textbook form; those that are not used say nothing."""
    rng = np.random.default_rng(4)
    mean, cov = states(2)
    H = rng.standard_normal((2, 2, m, N)) / SCALES
    B = rng.standard_normal((2, 2, m, m))
    R = B @ B.mT + 0.1 * np.eye(m)
    residual = rng.standard_normal((2, 2, m))
    flags = np.array([used, used[::-1]])
    got = update(mean, cov, residual, H, R, flags)
    for car in range(2):
        x, P, reduction = mean[car].copy(), cov[car].copy(), np.eye(N)
        for b in np.flatnonzero(flags[car]):
            K = P @ H[car, b].T @ np.linalg.inv(H[car, b] @ P @ H[car, b].T + R[car, b])
            r = residual[car, b] - H[car, b] @ (x - mean[car])
            x = x + K @ r
            M = np.eye(N) - K @ H[car, b]
            P, reduction = M @ P, M @ reduction
        scale = np.outer(SCALES, SCALES)
        assert got[0][car] / SCALES == pytest.approx(x / SCALES, abs=1e-8)
        assert got[1][car] / scale == pytest.approx(P / scale, abs=1e-8)
        assert got[2][car] == pytest.approx(reduction, abs=1e-6)
        assert np.array_equal(got[1][car], got[1][car].T)


def one_by_one(
    count: int, of: Any, squared: Any, cost: Any, place: Any, same: float, gate: float
) -> tuple[list[tuple[int, Verdict]], list[float]]:
    """What ``associate`` returns, a measurement at a time."""
    found, share = [], [0.0] * len(of)
    for i in range(count):
        rows = [k for k in range(len(of)) if of[k] == i]
        if not rows:
            found.append((0, Verdict.UNMATCHED))
            continue
        best = min(rows, key=cost.__getitem__)
        others = [k for k in rows if math.dist(place[k], place[best]) > same]
        likelihood = {k: math.exp(-cost[k] / 2) for k in rows if k not in others}
        for k, value in likelihood.items():
            share[k] = value / sum(likelihood.values())
        verdict = Verdict.USED if squared[best] <= gate else Verdict.OUTLIER
        rival = min((cost[k] for k in others), default=math.inf)
        if verdict == Verdict.USED and rival - cost[best] < 2 * math.log(100):
            verdict = Verdict.AMBIGUOUS
        found.append((best, verdict))
    return found, share


@pytest.mark.parametrize("seed", range(60))
def test_the_association_one_measurement_at_a_time(seed: int) -> None:
    rng = np.random.default_rng(seed)
    count, k = int(rng.integers(1, 6)), int(rng.integers(0, 12))
    of = np.sort(rng.integers(0, count, k))
    squared = rng.uniform(0, 40, k)
    cost = squared + rng.uniform(-8, 2, k)
    place = rng.uniform(0, 2, (k, 1 + seed % 2))
    best, share, verdict = associate(count, Candidates(of, squared, cost, place, 0.5), GATES[2])
    expected, shares = one_by_one(count, of, squared, cost, place, 0.5, GATES[2])
    assert [(int(b), Verdict(v)) for b, v in zip(best, verdict, strict=True)] == expected
    assert share == pytest.approx(shares)


@pytest.mark.parametrize("seed", range(3))
def test_the_autocorrelation_is_that_of_all_transitions(seed: int) -> None:
    """Psi P_j from the beginning of every kept span, in the axes of the car."""
    rng = np.random.default_rng(seed)
    n, dt = 2, 0.05
    P = states(n, seed)[1]
    correlation, covs, transitions = ErrorCorrelation(0.0, P), [P], []
    for k in range(1, 60):
        M = np.eye(N) + 0.1 * rng.standard_normal((n, N, N)) * SCALES[:, None] / SCALES
        B = 0.3 * SCALES[:, None] * rng.standard_normal((n, N, N))
        P = M @ P @ M.mT + B @ B.mT
        correlation.advance(k * dt, P, M)
        covs.append(P)
        transitions.append(M)
    heading = np.array([0.3, -2.0])
    lags, rho = correlation.autocorrelation(heading)
    assert len(lags) > 5
    assert (np.diff(lags) > 0).all()
    c, s = np.cos(heading), np.sin(heading)
    T = np.zeros((n, 3, N))
    T[:, 0, 0], T[:, 0, 1], T[:, 1, 0], T[:, 1, 1], T[:, 2, HEADING] = c, s, -s, c, 1
    for lag, values in zip(lags, rho, strict=True):
        j = round((59 * dt - lag) / dt)
        Psi = np.eye(N)
        for M in transitions[j:]:
            Psi = M @ Psi
        joint = T @ Psi @ covs[j] @ T.mT
        now, then = (np.einsum("nij->nij", T @ X @ T.mT) for X in (P, covs[j]))
        for i in range(3):
            expected = joint[:, i, i] / np.sqrt(now[:, i, i] * then[:, i, i])
            assert values[:, i] == pytest.approx(expected, rel=1e-9, abs=1e-12)


@pytest.mark.parametrize("time", [0.7, 3.0, 40.0])
@pytest.mark.parametrize("seconds", [0.5, 12.0, 90.0])
def test_the_correlation_time_of_gauss_markov_errors(time: float, seconds: float) -> None:
    """That of the process, also while the past is shorter than that; unknown without any loss."""
    dt, P = 0.1, np.tile(np.diag(SCALES**2), (1, 1, 1))
    correlation = ErrorCorrelation(0.0, P)
    heading = np.zeros(1)
    assert np.isinf(correlation.times(heading)).all()
    phi = np.ones(N)
    phi[:3] = math.exp(-dt / time), math.exp(-2 * dt / time), 1.0
    for k in range(1, round(seconds / dt) + 1):
        correlation.advance(k * dt, P, np.diag(phi)[None])
    along, across, turn = correlation.times(heading)[0]
    assert along == pytest.approx(time, rel=1e-6)
    assert across == pytest.approx(time / 2, rel=1e-6)
    assert turn == math.inf
    assert correlation.times(np.array([math.pi / 2]))[0, :2] == pytest.approx([time / 2, time])


def test_the_past_is_kept_in_few_spans_and_for_ten_minutes() -> None:
    """Their number grows with the logarithm of the time: none is longer than 15 % of its age."""
    P = np.eye(N)[None]
    correlation, counts = ErrorCorrelation(0.0, P), []
    for k in range(1, 6401):
        correlation.advance(0.125 * k, P, 0.999 * np.eye(N)[None])
        if k in (1600, 3200, 6400):
            lags, rho = correlation.autocorrelation(np.zeros(1))
            counts.append(len(lags))
            expected = 0.999 ** (lags / 0.125)
            assert rho[:, 0, 0] == pytest.approx(expected, rel=1e-6)
            end = np.append(0.0, lags[:-1])
            assert (lags - end <= np.maximum(0.125, 0.15 * end)).all()
            longer = lags[1:] - end[:-1] > 0.15 * end[:-1]  # two of them
            assert longer[2:].mean() > 0.9
    assert lags[-1] <= 600.0
    assert lags[-1] > 600 / 1.3
    assert counts[1] - counts[0] < 12


@pytest.mark.parametrize("t", [-0.1, math.nan, math.inf, -math.inf])
def test_there_are_no_poses_of_the_past_and_of_no_time(t: float) -> None:
    localisation = Localisation(Gaussian(np.zeros(3), np.eye(3)))
    assert localisation.poses(0.1).mean.shape == (1, 3)
    with pytest.raises(ValueError, match="t must be"):
        localisation.poses(t)


def test_only_lines_of_drivable_lanes_are_in_the_layer() -> None:
    """Not those of a sidewalk, whatever their kinds."""
    for kind, lines in ((LaneType.DRIVING, 2), (LaneType.SIDEWALK, 0)):
        layer = LocalisationLayer(network(lane("1", kinds=KINDS, type=kind)))
        assert len(layer.lines_beside(np.array([[50.0, 0.0, 0.0]])).car) == lines
