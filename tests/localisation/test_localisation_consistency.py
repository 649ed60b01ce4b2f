"""The monitor of the innovations: false alarms as designed, contradictions, and what vouches."""

from typing import Any

import numpy as np
import pytest

from maplines_can.localisation.association import GATES, Verdict
from maplines_can.localisation.divergence import (
    AGREED,
    FALSE_ALARM,
    GNSS_FALSE_ALARM,
    MAX_MEAN,
    MAX_NIS,
    REJECTED,
    SINGLE_SOURCE,
    SOURCES,
    VOUCHES,
    WINDOW,
    Consistency,
    agreeing,
    compared,
    found_again,
    lost,
    may_align,
    unsuspicious,
    vouched,
    widening,
)
from maplines_can.localisation.motion_model import N
from maplines_can.localisation.observation_models import Innovation


def innovation(residual: Any, source: str = "gnss", scale: float = 1.0) -> Innovation:
    """Return the innovations of n cars, (n, B, m), whose covariance is ``scale`` squared."""
    residual = np.asarray(residual, dtype=float)
    n, B, m = residual.shape
    S = scale**2 * np.eye(m) + np.zeros((n, B, m, m))
    squared = (residual**2).sum(axis=-1) / scale**2
    verdict = np.where(squared <= GATES[m], Verdict.USED, Verdict.OUTLIER)
    return Innovation(source, residual, np.zeros((n, B, m, N)), S, S, verdict)


def after(count: int, residual: Any, source: str = "gnss", n: int = 1) -> Any:
    """Return the consistency after as many equal measurements, and whether any contradicted."""
    trust, contradicted = unsuspicious(n), np.full(n, False)
    for i in range(count):
        one = np.broadcast_to(residual, (n, 1, len(residual)))
        trust, some, _ = compared(trust, innovation(one, source), 0.2 * i)
        contradicted |= some
    return trust, contradicted


@pytest.mark.parametrize(("source", "m"), [("gnss", 2), ("line", 2), ("landmark", 2), ("pose", 3)])
def test_a_right_filter_is_not_suspected(source: str, m: int) -> None:
    """4e5 white innovations of unit covariance: at most one is widened, and one a contradiction.

    But for GNSS: these are 16 000 windows, of which each is looked at 25 times.
    """
    rng, n = np.random.default_rng(11), 2000
    trust, contradictions, widened, mean = unsuspicious(n), 0, 0, np.zeros(0)
    probability = GNSS_FALSE_ALARM if source == "gnss" else FALSE_ALARM
    for i in range(200):
        one = rng.standard_normal((n, 1, m))
        trust, contradicted, _ = compared(trust, innovation(one, source), float(i))
        contradictions += int(contradicted.sum())
        widened += int((widening(trust)[0] > 1).sum())
        if i % (2 * WINDOW) == 0 and i:
            s = SOURCES.index(source)
            mean = np.append(mean, (trust.mean[:, s] ** 2).sum(axis=1))
    assert widened <= 1
    assert contradictions <= 1 + 25 * 16_000 * probability
    # The squared mean is chi-square by design: its quantiles are those of the limit, scaled.
    from scipy.stats import chi2

    scale = MAX_MEAN[source] / chi2.isf(probability, m)
    beyond = (mean > scale * chi2.isf(1e-2, m)).mean()
    assert beyond == pytest.approx(1e-2, abs=4 * np.sqrt(1e-2 / len(mean)))


@pytest.mark.parametrize("source", SOURCES)
def test_some_rejected_in_a_row_contradict(source: str) -> None:
    """As many as ``REJECTED``, even in alternating directions; one that is used starts again."""
    s = SOURCES.index(source)
    m = 3 if source == "pose" else 2
    trust = unsuspicious(1)
    used, far = np.zeros((1, 1, m)), np.full((1, 1, m), 9.0)
    for i in range(2 * REJECTED[s] - 1):
        one = used if i == REJECTED[s] - 1 else far * (-1) ** i
        trust, contradicted, drifts = compared(trust, innovation(one, source), float(i))
        assert not contradicted.any()
    trust, contradicted, drifts = compared(trust, innovation(far, source), 99.0)
    assert contradicted.all()
    assert not drifts.any()


@pytest.mark.parametrize("shift", [0.0, 1.5, 2.0, 3.0])
def test_a_drift_contradicts_though_each_measurement_is_used(shift: float) -> None:
    """A mean of the normalised innovations of 1.5 sigma, within two windows."""
    trust, contradicted = after(2 * WINDOW, [shift, 0.0])
    assert (trust.rejected == 0).all()
    assert contradicted.all() == (shift > 0)


def test_noise_that_is_larger_than_stated_widens() -> None:
    """By about the ratio of the variances."""
    rng, n, ratio = np.random.default_rng(2), 200, 4.0
    trust = unsuspicious(n)
    for i in range(3 * WINDOW):
        one = np.sqrt(ratio) * rng.standard_normal((n, 1, 2))
        trust, *_ = compared(trust, innovation(one), float(i))
    factor = widening(trust)[0]
    assert (factor > MAX_NIS).mean() > 0.5
    assert np.median(factor) == pytest.approx(3.0, abs=0.7)  # the gate takes the largest ones


@pytest.mark.parametrize(
    ("source", "residual", "position", "turn"),
    [
        ("gnss", [30.0, 40.0], 50.0, 5.0),
        ("landmark", [6.0, 8.0], 10.0, 1.0),
        ("line", [20.0, 5.0], 20.0, 5.0),
        ("pose", [3.0, 4.0, 7.0], 5.0, 7.0),
    ],
)
def test_two_rejected_in_a_row_widen_by_the_residual(
    source: str, residual: list[float], position: float, turn: float
) -> None:
    for count in (1, 2):
        nis, xy, heading = widening(after(count, residual, source)[0])
        assert xy == pytest.approx(position**2 if count == 2 else 0)
        assert heading == pytest.approx(turn**2 if count == 2 else 0)
        assert nis == 1


def test_landmarks_and_poses_vouch_for_a_pose() -> None:
    """If they agreed twice, lately; neither GNSS nor lines do, and none for itself."""
    for source in SOURCES:
        m = 3 if source == "pose" else 2
        trust, _ = after(2, np.zeros(m), source)
        for other in (*SOURCES, None):
            expected = source in {"landmark", "pose"} and other != source
            assert vouched(trust, other, 0.2 + VOUCHES).all() == expected
            assert not vouched(trust, other, 0.3 + VOUCHES).any()
        assert not vouched(after(1, np.zeros(m), source)[0], "gnss", 0.0).any()


def once_lost(**settings: Any) -> Consistency:
    return lost(unsuspicious(1), np.array([True]), 5.0, "gnss", **settings)


def agreed(trust: Consistency, count: int, source: str = "gnss", value: float = 0.0) -> Any:
    for i in range(count):
        trust, *_ = compared(trust, innovation([[[value, 0.0]]], source), 6.0 + i)
    return trust


def test_a_lost_pose_is_known_again_when_what_contradicted_it_agrees() -> None:
    """As often in a row, clearly, and all of it; but not if it has followed the fault."""
    trust = once_lost()
    assert not trust.known.any()
    assert not agreeing(agreed(trust, AGREED - 1)).any()
    assert agreeing(agreed(trust, AGREED)).all()
    assert not agreeing(agreed(trust, AGREED, "line")).any()
    assert not agreeing(agreed(trust, AGREED, value=3.0)).any()  # within the gate, but far
    both = lost(trust, np.array([True]), 5.5, "line")
    assert not agreeing(agreed(both, AGREED)).any()
    assert agreeing(agreed(agreed(both, AGREED), AGREED, "line")).all()
    for settings in ({"misled": np.array([True])}, {"missed": True}):
        assert not agreeing(agreed(once_lost(**settings), AGREED)).any()
    clean = found_again(agreed(trust, AGREED), np.array([True]))
    for one, other in zip(clean, unsuspicious(1), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    ("settings", "also", "wait"),
    [
        ({}, None, SINGLE_SOURCE),
        ({"misled": np.array([True])}, None, SINGLE_SOURCE),
        ({}, "line", 0.0),
        ({"missed": True}, None, 0.0),
    ],
)
def test_a_single_source_must_fit_the_odometry_for_longer(
    settings: dict[str, Any], also: str | None, wait: float
) -> None:
    trust = once_lost(**settings)
    if also is not None:
        trust = lost(trust, np.array([True]), 5.1, also)
    assert not may_align(trust, 99.0).any()
    trust = trust._replace(fits=np.array([10.0]))
    assert may_align(trust, 10.0 + wait).all()
    if wait:
        assert not may_align(trust, 10.0 + wait - 0.1).any()
