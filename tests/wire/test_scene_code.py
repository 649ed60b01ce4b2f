"""Code of scenes through codec and decoder: what is received covers what was sent."""

import math
import re
from contextlib import suppress
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from evidence.exact import covers, is_positive_definite
from evidence.roads import SHAPES, random_scene
from evidence.witness import POSES, Poses
from fuzz_scenes import line_frames, parts_of, pose_frames
from hypothesis import example, given, settings
from hypothesis import strategies as st
from support.scene_streams import COMPLETE, CONDITIONAL, Passed, codec_of, passed
from support.strategies import covariances

from maplines_can import (
    Codec,
    EncodeError,
    Gaussian,
    LeftOut,
    MapError,
    MapLine,
    Polyline,
    PoseError,
    Scene,
    Slot,
    map_scene,
)
from maplines_can.study.scenes.random_scenes import RESOLUTION, noise_floor
from maplines_can.values.line import lateral_jacobian
from maplines_can.wire import Layout, default_dbc_path

#: Covariance of a production pose: 0.1 m, 0.2 m and 0.2 deg.
PRODUCTION = np.diag([0.1, 0.2, np.radians(0.2)]) ** 2
#: Standard deviations of the parameters of a line of a map [m, rad, 1/m, 1/m^2].
SIGMA = np.array([0.05, 2e-3, 1e-4, 3e-6])
WINDOW = (-20.0, 80.0)
SEEDS = st.integers(0, 2**32)
WHOLE = "maplines-scene.dbc"
BOTH = pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])


def scene_of(
    means: Any,
    cov: Any = None,
    pose: Any = PRODUCTION,
    ranges: Any = WINDOW,
    error: MapError | None = None,
    time: float = math.inf,
) -> Scene:
    """A scene of lines of the first slots, which by default have own errors only."""
    n = len(means)
    fit_ranges = np.broadcast_to(np.asarray(ranges, dtype=float), (n, 2))
    cov = np.kron(np.eye(n), np.diag(SIGMA**2)) if cov is None else cov
    lines = [
        MapLine(Slot(i), Gaussian(mean, cov[4 * i : 4 * i + 4, 4 * i : 4 * i + 4]))
        for i, mean in enumerate(means)
    ]
    if np.shape(ranges) != (2,):  # valid in them, too
        pairs = zip(lines, fit_ranges, strict=True)
        lines = [replace(line, x_min=low, x_max=high) for line, (low, high) in pairs]
    return Scene(tuple(lines), cov, PoseError(pose, time), fit_ranges, error)


def empty(pose: Any = PRODUCTION, error: MapError | None = None, time: float = math.inf) -> Scene:
    """A scene without lines."""
    return Scene((), np.zeros((0, 0)), PoseError(pose, time), np.zeros((0, 2)), error)


def straight_lanes(n: int = 3, scale: float = 1.0) -> Scene:
    """Straight lines of a map with an error of their own, seen from a production pose."""
    means = np.array([[1.75 - 3.5 * i, 0.01, 1e-4, 0.0] for i in range(n)])
    J = np.array([[0.0, -1, 0], [0, 0, -1], [0, 0, 0], [0, 0, 0]])
    common = np.kron(np.ones((n, n)), J @ PRODUCTION @ J.T)
    return scene_of(means, common + scale * np.kron(np.eye(n), np.diag(SIGMA**2)))


def road_scene(number: int, lines: int, pose: str, error: MapError | None) -> Scene:
    """A scene of a random road."""
    case = random_scene(list(SHAPES)[number % len(SHAPES)], np.random.default_rng(number), lines)
    poses = Poses.about(case.pose, POSES[pose], 0, np.random.default_rng())
    roads = {slot: Polyline(points) for slot, points in case.lines.items()}
    return map_scene(roads, Gaussian(case.pose, poses.cov), map_error=error)


def check_covered(scene: Scene, found: Passed) -> None:
    """What is received is definite and covers the lines that are sent, in exact arithmetic."""
    received, slots = found.received, [*found.prepared.members]
    if received is None:
        assert not slots
        return
    assert sorted(received.index) == sorted(slots)
    truth = scene.joint([line.slot for line in received.lines])
    assert is_positive_definite(received.cov.tolist())
    assert covers(received.cov, received.means.ravel(), truth.cov, truth.mean)


# ---- what is covered ---------------------------------------------------------------------------


@settings(deadline=None, max_examples=60)
@given(SEEDS, st.integers(1, 4))
def test_any_bits_of_a_scene_are_definite(seed: int, lines: int) -> None:
    """In exact arithmetic, with any pose error and either form of line-specific covariances."""
    rng, parts = np.random.default_rng(seed), parts_of(CONDITIONAL)
    frames = pose_frames(parts, rng.bytes(32), {}, fd=True)
    for slot in list(Slot)[:lines]:
        frames += line_frames(parts, rng.bytes(32), slot, 0, fd=True)
    decoder = parts.codec.decoder()
    for frame in frames:
        decoder.feed(frame.can_id, frame.data, 0)
    found = decoder.scene()
    if found is not None and found.scene.lines:
        assert np.array_equal(found.scene.cov, found.scene.cov.T)
        assert is_positive_definite(found.scene.cov.tolist())


@settings(deadline=None, max_examples=40)
@given(SEEDS, st.sampled_from([1, 2, 3, 5]), st.floats(-4, 1), covariances(3), st.booleans())
def test_any_scene_is_covered(
    seed: int, lines: int, exponent: float, pose: Any, full: bool
) -> None:
    """Covariances as a caller may give them, singular ones too, with any pose error."""
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((4 * lines, rng.choice([0, 1, 3, 8])))
    A *= 10.0**exponent * np.tile(SIGMA, lines)[:, None]
    own = rng.choice([0.0, 1e-12, 1.0]) * np.kron(np.eye(lines), np.diag(SIGMA**2))
    means = rng.uniform(-1, 1, (lines, 4)) * [5, 0.2, 2e-3, 1e-5]
    pose = pose * 10.0 ** -rng.integers(0, 6)
    error = [None, MapError(), MapError(0.05, 0.1, 1e-3)][rng.integers(3)]
    low = rng.integers(-30, 20, lines)
    ranges = np.column_stack([low, low + rng.integers(1, 90, lines)])
    scene = scene_of(means, A @ A.T + own, pose, ranges, error)
    if rng.random() < 0.5:  # of another scene
        B = rng.standard_normal((lines, 4, 4)) * 10.0 ** rng.integers(-3, 2) * SIGMA[:, None]
        scene = replace(scene, specific_covs=B @ B.swapaxes(1, 2))
    for dbc in (CONDITIONAL, COMPLETE, WHOLE):
        with suppress(*(() if np.sqrt(pose.diagonal()).max() <= 0.5 else (EncodeError,))):
            check_covered(scene, passed(dbc, scene, fd=full or dbc == WHOLE))


# ---- what does not fit -------------------------------------------------------------------------

UNFIT = {
    "beside": ([60.0, 0, 0, 0], WINDOW, SIGMA, LeftOut.MEAN),
    "across": ([0.0, 1.3, 0, 0], WINDOW, SIGMA, LeftOut.MEAN),
    "far": ([1e300, 0, 0, 0], WINDOW, SIGMA, LeftOut.ACROSS),
    "bent": ([0, 0, 0, 1.7e308], WINDOW, SIGMA, LeftOut.ACROSS),
    "no function of x": ([0.0, 0, 0.3, 0], WINDOW, SIGMA, LeftOut.ACROSS),
    "behind": ([5.0, 0, 0, 0], (-40.0, -1.0), SIGMA, LeftOut.RANGE),
    "ahead": ([5.0, 0, 0, 0], (40.0, 1e200), SIGMA, LeftOut.RANGE),
    "between metres": ([2.0, 0, 0, 0], (3.2, 3.8), SIGMA, LeftOut.RANGE),
    "wide": ([2.0, 0, 0, 0], WINDOW, 1e6 * SIGMA, LeftOut.COVARIANCE),
    "wider": ([2.0, 0, 0, 0], WINDOW, [0, 0, 0, 1e53], LeftOut.ACROSS),
    "widest": ([2.0, 0, 0, 0], WINDOW, [0, 0, 0, 1e153], LeftOut.ACROSS),
}


@pytest.mark.parametrize(("mean", "window", "sigma", "reason"), UNFIT.values(), ids=UNFIT)
@pytest.mark.parametrize("place", [0, 2])
def test_lines_that_do_not_fit_do_not_affect_the_others(
    mean: Any, window: Any, sigma: Any, reason: LeftOut, place: int
) -> None:
    """They are left out with a reason, and the others are sent as without them."""
    lanes = straight_lanes(4)
    means, ranges, cov = lanes.means.copy(), lanes.fit_ranges.copy(), lanes.cov.copy()
    means[place], ranges[place] = mean, window
    own = np.s_[4 * place : 4 * place + 4]
    cov[own], cov[:, own] = 0.0, 0.0
    cov[own, own] = np.diag(np.square(sigma))
    scene = scene_of(means, cov, ranges=ranges)
    others = [Slot(i) for i in range(4) if i != place]
    found, alone = passed(CONDITIONAL, scene), passed(CONDITIONAL, scene.subset(others))
    assert found.prepared.left_out == found.prepared.unfit == {Slot(place): reason}
    assert [*found.prepared.members] == others
    assert found.frames == alone.frames
    assert Slot(place) not in codec_of(COMPLETE).encoder().prepare_scene(scene).members


MEAN = [codec_of(CONDITIONAL).layout[name] for name in ("YOff", "Beta", "C0", "C1")]


@settings(max_examples=40)
@given(SEEDS)
@example(0)
def test_a_scene_within_the_limits_of_the_message_loses_no_line(seed: int) -> None:
    """Lines of any parameters and ranges that the message can state, unless they are steep."""
    rng = np.random.default_rng(seed)
    n = rng.integers(2, 9)
    means = rng.uniform(-0.99, 0.99, (n, 4)) * [s.physical_range[1] for s in MEAN]
    means *= rng.choice([1.0, 0.3, 0.05], (n, 1))
    low = rng.integers(-32, 32, n)
    ranges = np.column_stack([low, (low + rng.integers(1, 60, n)).clip(0)]).astype(float)
    ranges[:, 0] = np.minimum(ranges[:, 0], ranges[:, 1] - 1)
    scene = scene_of(means, ranges=ranges)
    found = passed(CONDITIONAL, scene)
    assert {*found.prepared.members} | found.prepared.unfit.keys() == {*scene.index}
    for slot in found.prepared.unfit:
        x = np.linspace(ranges[slot, 0], ranges[slot, 1], 50)
        slope = np.tan(means[slot, 1]) + means[slot, 2] * x + means[slot, 3] * x**2 / 2
        assert np.abs(slope).max() >= 3  # lines of a map rise by less
    check_covered(scene, found)


# ---- what it costs -----------------------------------------------------------------------------


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("error", [None, MapError(0.05, 0.08)], ids=["exact", "map error"])
@pytest.mark.parametrize("pose", POSES)
def test_joint_quantities_are_as_uncertain_as_at_the_sender(
    shape: str, error: MapError | None, pose: str
) -> None:
    """Width and difference of directions of conditional records, within 12 %.

    In a hairpin with a poor pose within 100 %. Beyond the resolution of the means, at the ends of
    the common range and between them. Nothing is common to a lane's boundaries but the pose error,
    which these quantities do not see: they show what the lines have of their own.
    """
    scene = road_scene([*SHAPES].index(shape) + 14, 4, pose, error)
    received = passed(CONDITIONAL, scene).scene
    most = 2.0 if (shape, pose) == ("hairpin", "poor") else 1.12
    assert [*received.index][:2] == [Slot(0), Slot(1)]
    floor = noise_floor(received.means, received.fit_ranges, RESOLUTION)[:8, :8]
    true, ranges = scene.cov[:8, :8] + floor, received.fit_ranges[:2]
    for x in np.linspace(ranges[:, 0].max(), ranges[:, 1].min(), 5):
        position = lateral_jacobian(received.means[:2], x)
        turned = 1 + np.tan(received.means[:2, 1]) ** 2
        slope = np.array([[0.0, t, x, x * x / 2] for t in turned])
        for one, other in (position, slope):
            g = np.append(one, -other)
            assert g @ received.cov[:8, :8] @ g <= most**2 * (g @ true @ g)


# ---- the pose error ----------------------------------------------------------------------------


TIME = re.compile(r'(CorrelationTime (?:m1 )?: \d+\|4@1\+) \(0.5,-2\) \[-2\|5.5\] "octave"')


@cache
def altered(law: str) -> Codec:
    """The codec of a DBC whose correlation time has another factor, offset and range."""
    text, n = TIME.subn(rf"\1 {law}", default_dbc_path(CONDITIONAL).read_text())
    assert n == 3
    return Codec(Layout.from_text(text))


@pytest.mark.parametrize(
    ("law", "greatest"),
    [
        ('(0.5,-2) [-2|5.5] ""', 2**5.5),
        ('(0.1,1.03) [1.03|2.53] "octave"', 2**2.53),
        ('(3,-20) [-20|25] "octave"', 2.0**25),
        ('(12,20) [20|200] "octave"', 2.0**200),
    ],
)
@settings(max_examples=10)
@given(octaves=st.floats(-40, 210))
def test_no_decoded_correlation_time_is_too_short(
    law: str, greatest: float, octaves: float
) -> None:
    """Whatever the signal of the DBC: less than a step longer, or unknown; sent again, the same."""
    codec, time = altered(law), 2.0**octaves
    assert codec.layout.pose is not None
    signal = codec.layout.pose["CorrelationTime"]

    def decoded(time: float) -> float:
        scene = replace(straight_lanes(1), pose_error=PoseError(PRODUCTION, time))
        return passed(codec, scene).scene.pose_error.correlation_time

    received = decoded(time)
    assert received >= time
    assert decoded(received) == received
    if time > greatest * (1 + 1e-12):
        assert received == math.inf
    elif time <= greatest * (1 - 1e-12):
        least = 2.0 ** signal.physical_one(1)
        assert received <= max(least, time * 2**signal.factor * (1 + 1e-12))


@BOTH
def test_the_largest_pose_error_that_fits(dbc: str) -> None:
    """The encoder refuses larger ones in each of its directions, up to the largest numbers."""
    rng, encoder = np.random.default_rng(1), codec_of(dbc).encoder()
    for _ in range(5):
        A = rng.standard_normal((3, 3)) * np.array([[0.1], [0.2], [0.004]])
        fits, refused = 0.0, 40.0
        for _ in range(12):
            scale = (fits + refused) / 2
            try:
                encoder.prepare_scene(empty(4.0**scale * A @ A.T))
            except EncodeError:
                refused = scale
            else:
                fits = scale
        assert 1.0 < fits < 20.0
    for size in (1e60, 1e300, 1e307):
        with pytest.raises(EncodeError, match=r"the pose error does not fit.*m along"):
            encoder.prepare_scene(empty(size * np.eye(3)))
