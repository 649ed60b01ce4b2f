"""Lines that exceed a message: the nearest ones within it, alone and in records."""

from typing import Any

import numpy as np
import pytest
from evidence.exact import covers
from hypothesis import example, given
from hypothesis import strategies as st
from scene_layouts import COMPLETE, CONDITIONAL, layout_of
from scene_streams import codec_of
from scipy.optimize import lsq_linear

from maplines_can.values.line import lateral
from maplines_can.wire.covariance.nearest_line import (
    MAX_DEVIATION,
    _box_solution,
    _triangular,
    is_within,
    nearest_line,
)
from maplines_can.wire.layout.signals import PARAMETER_SIGNALS

SIGNALS = {
    name: [layout_of(name)[signal] for signal in PARAMETER_SIGNALS]
    for name in (CONDITIONAL, COMPLETE)
}
NO_LIMIT = np.full(4, np.inf)
SIGMA = np.array([0.05, 2e-3, 1e-4, 3e-6])
#: Lines about as large as the ranges of both messages, and up to four times as large.
LINES = st.tuples(
    st.floats(-60, 60), st.floats(-1.2, 1.2), st.floats(-0.6, 0.6), st.floats(-0.1, 0.1)
)
RANGES = st.tuples(st.floats(-20, 30), st.floats(2, 60)).map(
    lambda pair: np.array([pair[0], pair[0] + pair[1]])
)


@given(LINES, RANGES, st.sampled_from([CONDITIONAL, COMPLETE]))
@example((2.0, -0.55, 0.008, 8e-4), np.array([-12.0, 2.0]), CONDITIONAL)
@example((4.3, 0.0, -0.05, -0.066), np.array([-2.0, 4.0]), CONDITIONAL)
def test_the_nearest_line_is_within_the_message_and_near(line: Any, x_range: Any, dbc: str) -> None:
    """In a part of the range about its place nearest to the car, as long as it is asked for."""
    signals = SIGNALS[dbc]
    near = nearest_line(signals, np.array(line), x_range, 1.0, NO_LIMIT)
    if is_within(signals, np.array(line)):
        assert near is not None
        assert near.x_range == pytest.approx(x_range)
    if near is None:
        return
    for signal, value in zip(signals, near.mean, strict=True):
        assert signal.raw_min < signal.raw(value) < signal.raw_max
    low, high = near.x_range
    assert x_range[0] - 1e-9 <= low <= np.clip(0.0, *x_range) + 1e-9
    assert np.clip(0.0, *x_range) - 1e-9 <= high <= x_range[1] + 1e-9
    assert high - low >= 1.0 - 1e-9
    x = np.linspace(low, high, 400)
    assert np.abs(lateral(near.mean, x) - lateral(np.array(line), x)).max() <= 1.1 * MAX_DEVIATION


@pytest.mark.parametrize("seed", range(5))
def test_least_squares_in_a_box_agree_with_scipy(seed: int) -> None:
    """The same parameters, any number of which are at a limit; the optimum may be in the box."""
    rng = np.random.default_rng(seed)
    at_limit = np.zeros(5)
    for _ in range(100):
        A = rng.normal(size=(16, 4)) + rng.choice([0.0, 3.0]) * rng.normal(size=(16, 1))
        low = rng.normal(size=4) - 0.5
        high = low + rng.exponential(size=4) + 1e-3
        u = np.array(_box_solution(_triangular(A.tolist()), low.tolist(), high.tolist()))
        expected = lsq_linear(A, np.zeros(16), (low, high), method="bvls", tol=1e-14).x
        assert u == pytest.approx(expected, abs=1e-9)
        assert ((low <= u) & (u <= high)).all()
        at_limit[((u == low) | (u == high)).sum()] += 1
    assert (at_limit[1:] > 0).all()


def test_a_line_beside_the_message_has_none() -> None:
    """No other parameter makes up for an offset of 60 m."""
    beside = np.array([60.0, 0.0, 0.0, 0.0])
    assert (
        nearest_line(SIGNALS[CONDITIONAL], beside, np.array([-20.0, 80.0]), 1.0, NO_LIMIT) is None
    )


@given(LINES, st.tuples(st.integers(-5, 2), st.integers(1, 6)))
@example((2.0, 0.1, 0.05, -0.05), (0, 5))
@example((2.0, 0.55, 0.0, 0.0), (-1, 3))
def test_a_complete_record_of_a_line_beyond_the_message_is_near_it(line: Any, steps: Any) -> None:
    """Where it is valid, if any other line is near; what is decoded covers it."""
    low, high = 4.0 * steps[0], 4.0 * (steps[0] + steps[1])
    codec = codec_of(COMPLETE)
    near = nearest_line(
        SIGNALS[COMPLETE], np.array(line), np.array([low, high]), 1.0, codec.covariance.reach
    )
    payload = codec.batch.encode([line], [np.diag(SIGMA**2)], x_min=low, x_max=high)
    batch = codec.batch.decode(payload)
    if near is None or batch.status[0] == 5:
        return
    assert low <= batch.x_min[0] <= batch.x_max[0] <= high
    assert batch.x_max[0] - batch.x_min[0] >= 1
    assert covers(batch.cov[0], batch.mean[0], np.diag(SIGMA**2), np.array(line))
    if np.floor(near.x_range[1] / 4) <= np.ceil(near.x_range[0] / 4):
        return  # nothing of the other line's range can be stated
    x = np.linspace(batch.x_min[0], batch.x_max[0], 50)
    apart = np.abs(lateral(batch.mean[0], x) - lateral(np.array(line), x)).max()
    assert apart <= 1.2 * MAX_DEVIATION
