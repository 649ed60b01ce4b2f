"""Lines that exceed a message: the nearest ones within it, alone and in records and scenes."""

from typing import Any

import numpy as np
import pytest
from evidence.exact import covers
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pose_bits import PRODUCTION
from scene_layouts import COMPLETE, CONDITIONAL, layout_of, scene_code, scene_encoder
from scene_streams import codec_of
from scipy.optimize import lsq_linear

from maplines_can import Gaussian, LeftOut, MapError, MapLine, Polyline, PoseError, Scene, Slot
from maplines_can.propagation import map_scene
from maplines_can.values.linalg import block_diagonal
from maplines_can.values.line import lateral
from maplines_can.values.seen_lines import bases
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


def scene_of(means: Any, ranges: Any, sigma: Any = SIGMA) -> Scene:
    """A scene of lines with own errors only, valid in the ranges in which they were fitted."""
    own = np.diag(np.square(sigma))
    lines = tuple(
        MapLine(Slot(i), Gaussian(mean, own), x_min=low, x_max=high)
        for i, (mean, (low, high)) in enumerate(zip(means, np.asarray(ranges), strict=True))
    )
    cov: Any = np.kron(np.eye(len(lines)), own)
    return Scene(lines, cov, PoseError(PRODUCTION), np.asarray(ranges, float))


def is_covered(scene: Scene, sent: Any) -> bool:
    """Whether what is decoded covers the lines that are sent, in exact arithmetic."""
    truth = scene.joint([scene.lines[i].slot for i in sent.lines])
    return covers(sent.decoded.cov, sent.decoded.means.ravel(), truth.cov, truth.mean)


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


def limits(dbc: str) -> Any:
    """Least and greatest parameters of a message."""
    return np.array([signal.physical_range for signal in SIGNALS[dbc]]).T


@settings(max_examples=40)
@given(st.integers(0, 2**32))
@example(0)
def test_a_scene_within_the_limits_of_the_message_loses_no_line(seed: int) -> None:
    """Lines of any parameters and ranges that the message can state, if they are functions of x.

    What is sent is definite and covers; the lines that are sent and those left out add up.
    """
    rng = np.random.default_rng(seed)
    n = rng.integers(2, 9)
    means = rng.uniform(-0.99, 0.99, (n, 4)) * np.abs(limits(CONDITIONAL)).min(axis=0)
    means *= rng.choice([1.0, 0.3, 0.05], (n, 1))
    low = rng.integers(-32, 32, n)
    ranges = np.column_stack([low, (low + rng.integers(1, 60, n)).clip(0)]).astype(float)
    ranges[:, 0] = np.minimum(ranges[:, 0], ranges[:, 1] - 1)
    scene = scene_of(means, ranges)
    sent = scene_encoder(CONDITIONAL).encode(scene)
    assert sent.lines.keys() | sent.left_out.keys() == {*range(n)}
    assert sent.lines.keys().isdisjoint(sent.left_out)
    for i in sent.left_out:
        assert not is_moderate(means[i], ranges[i])
    if sent.decoded is not None:
        truth = scene.joint([scene.lines[i].slot for i in sent.lines])
        K = block_diagonal(
            np.asarray(np.linalg.inv(bases(sent.decoded.means, sent.decoded.fit_ranges)))
        )
        d = truth.mean - sent.decoded.means.ravel()
        L = np.linalg.cholesky(K @ sent.decoded.cov @ K.T)
        error = K @ (truth.cov + np.outer(d, d)) @ K.T
        assert np.linalg.eigvalsh(np.linalg.solve(L, np.linalg.solve(L, error).T))[-1] <= 1


def is_moderate(mean: Any, x_range: Any) -> bool:
    """Whether a line rises by at most 3 for 1 in its range, as lines of a map do."""
    x = np.linspace(x_range[0], x_range[1], 50)
    slope = np.tan(mean[1]) + mean[2] * x + mean[3] * x**2 / 2
    return bool(np.abs(slope).max() < 3)


PARTS = {
    "behind": ([5.0, 0, 0, 0], (-40.0, 80.0), (-32.0, 80.0)),
    "half metres": ([5.0, 0, 0, 0], (-20.5, 79.5), (-20.0, 79.0)),
    "long": ([5.0, 0, 0, 0], (-20.0, 200.0), (-20.0, 127.0)),
    "turned": ([2.0, -0.51, 0.008, 8e-4], (-12.0, 2.0), (-12.0, 2.0)),
    "turned much": ([2.0, -0.55, 0.008, 8e-4], (-12.0, 2.0), (-6.0, 1.0)),
    "short": ([9.8, 0.41, -0.21, 0.041], (-1.0, 0.0), (-1.0, 0.0)),
    "bent": ([4.3, 0, -0.05, -0.066], (-2.0, 4.0), (-2.0, 4.0)),
}


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize(("mean", "x_range", "part"), PARTS.values(), ids=PARTS)
def test_the_part_of_a_line_that_the_message_can_state_is_sent(
    mean: Any, x_range: Any, part: Any, full: bool
) -> None:
    """Near the line, covered, and nothing beyond its range; the other line is there, too."""
    scene = scene_of([mean, [-1.75, 0, 1e-3, 0]], [x_range, (-20.0, 60.0)])
    sent = scene_encoder(CONDITIONAL).encode(scene, full=full)
    assert [*sent.lines] == [0, 1]
    assert sent.left_out == {}
    assert sent.decoded is not None
    assert sent.decoded.fit_ranges[0] == pytest.approx(part)
    x = np.linspace(part[0], part[1], 100)
    apart = lateral(sent.decoded.means[0], x) - lateral(np.array(mean), x)
    assert np.abs(apart).max() <= 1.2 * MAX_DEVIATION
    assert is_covered(scene, sent)


UNFIT = {
    "beside": ([60.0, 0, 0, 0], (-20.0, 80.0), 1.0, LeftOut.MEAN),
    "across": ([0.0, 1.3, 0, 0], (-20.0, 80.0), 1.0, LeftOut.MEAN),
    "behind the car": ([2.0, 0, 0, 0], (-20.0, -1.0), 1.0, LeftOut.RANGE),
    "far ahead": ([2.0, 0, 0, 0], (40.0, 80.0), 1.0, LeftOut.RANGE),
    "between metres": ([2.0, 0, 0, 0], (3.2, 3.8), 1.0, LeftOut.RANGE),
    "wide": ([2.0, 0, 0, 0], (-20.0, 80.0), 1e5, LeftOut.COVARIANCE),
    "no function of x": ([0.0, 0, 0.3, 0], (-20.0, 80.0), 1.0, LeftOut.ACROSS),
}


@pytest.mark.parametrize(("mean", "x_range", "size", "reason"), UNFIT.values(), ids=UNFIT)
def test_a_line_that_is_left_out_has_its_reason(
    mean: Any, x_range: Any, size: float, reason: LeftOut
) -> None:
    scene = scene_of([mean], [x_range], size * SIGMA)
    sent = scene_encoder(CONDITIONAL).encode(scene)
    assert (sent.lines, sent.left_out) == ({}, {0: reason})
    prepared = codec_of(CONDITIONAL).encoder().prepare_scene(scene)
    assert prepared.left_out == prepared.unfit == {Slot(0): reason}


@given(LINES, RANGES, st.floats(0.0, 2.0))
@example((2.0, 0.62, 0.0, 0.0), np.array([-6.0, 1.0]), 0.9)
@example((2.0, 0.56, 0.0, 0.0), np.array([-1.5, 1.5]), 0.69)
def test_a_near_line_in_a_scene_is_valid_for_a_metre(line: Any, x_range: Any, room: float) -> None:
    """After the rounding to whole metres, and without the room at the ends; or it is left out."""
    low, high = x_range
    room = min(room, (high - low) / 4)
    own = np.diag(SIGMA**2)
    given = MapLine(Slot(0), Gaussian(line, own), x_min=low + room, x_max=high - room)
    scene = Scene((given,), own, PoseError(PRODUCTION), x_range[None])
    sent = scene_encoder(CONDITIONAL).encode(scene)
    assert len(sent.lines) + len(sent.left_out) == 1
    if sent.decoded is not None and not is_within(SIGNALS[CONDITIONAL], np.array(line)):
        assert np.diff(sent.decoded.fit_ranges[0])[0] >= 1.0 + 2 * room - 1e-9


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


@pytest.mark.parametrize("error", [None, MapError(0.05, 0.05, 0.001)])
@pytest.mark.parametrize("radius", [30.0, 150.0, 1e6])
@pytest.mark.parametrize("count", [1, 2, 4])
def test_a_scene_takes_no_more_frames_than_complete_records(
    count: int, radius: float, error: MapError | None
) -> None:
    """Four classic frames a line, with its pose error, also if levels cost all lines much."""
    s = np.arange(-60.0, 100.0, 7.0) / radius
    lines = {
        Slot(i): Polyline(
            np.column_stack([(radius - y) * np.sin(s), radius - (radius - y) * np.cos(s)])
        )
        for i, y in enumerate([1.75, -1.75, 5.25, -5.25][:count])
    }
    for seed in range(3):
        sigma = np.diag([0.3, 0.2, 0.01 * 4.0**-seed]) ** 2
        scene = map_scene(lines, Gaussian([0.0, 0.1 * seed, 0.0], sigma), map_error=error)
        frames = codec_of(CONDITIONAL).encoder().encode_scene(scene, counters={})
        assert len(frames) == 1 + count
        assert sum(map(len, frames.values())) <= 4 * count
        sent = scene_encoder(CONDITIONAL).encode(scene)
        assert is_covered(scene, sent)
        assert scene_code(CONDITIONAL).is_conditional
