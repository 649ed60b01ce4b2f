"""Code of scenes: definite for any bits, and never overconfident, in exact arithmetic."""

import math
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from evidence.exact import covers, is_positive_definite
from evidence.roads import SHAPES, random_scene
from evidence.witness import POSES, Poses
from hypothesis import given, settings
from hypothesis import strategies as st
from pose_bits import POSE, POSE_NAMES, PRODUCTION, any_bits
from scene_layouts import COMPLETE, CONDITIONAL, layout_of, scene_code, scene_encoder
from strategies import covariances

from maplines_can import Gaussian, MapError, MapLine, Polyline, PoseError, Scene, Slot
from maplines_can.propagation import map_scene
from maplines_can.study.scenes.source import noise_floor
from maplines_can.values.errors import EncodeError, IllPosedError
from maplines_can.values.line import lateral, lateral_jacobian
from maplines_can.wire.covariance.scene_code import RESOLUTION, SceneCode
from maplines_can.wire.covariance.stated_lines import LARGEST
from maplines_can.wire.layout.signals import FINE_SIGNALS

CODE, LEVELS_CODE = scene_code(CONDITIONAL), scene_code(COMPLETE)
ENCODER, LEVELS_ENCODER = scene_encoder(CONDITIONAL), scene_encoder(COMPLETE)
LINE = layout_of(CONDITIONAL)
MEAN = ("YOff", "Beta", "C0", "C1")
OWN = ("OwnLateral", "OwnPoints", "OwnShape", "Quartic")
COVARIANCE = [
    name
    for name in LINE.signals
    if name.startswith(("Pivot", "Ratio", "Inflation")) or name in FINE_SIGNALS
]
#: Raw values of a Pose record of a production pose.
POSE_RAW = ENCODER.encode(Scene((), np.zeros((0, 0)), PoseError(PRODUCTION), np.zeros((0, 2)))).pose
#: Standard deviations of the parameters of a line of a map [m, rad, 1/m, 1/m^2].
SIGMA = np.array([0.05, 2e-3, 1e-4, 3e-6])
SEEDS = st.integers(0, 2**32)
WINDOW = np.array([-20.0, 80.0])


def function_of_x(rng: Any) -> dict[str, int]:
    """Raw values of mean and range of a line, most of which are functions of x."""
    size = 10 ** rng.uniform(-3, 0) * np.array([1, 0.5, 0.02, 0.003])
    row = {n: int(LINE[n].raw_max * rng.uniform(-s, s)) for n, s in zip(MEAN, size, strict=True)}
    return row | {"XMin": int(rng.integers(0, 33)), "XMax": int(rng.integers(1, 128))}


def scene_of(
    means: Any,
    cov: Any,
    pose: Any = PRODUCTION,
    ranges: Any = WINDOW,
    error: MapError | None = None,
    time: float = math.inf,
) -> Scene:
    """A scene of lines of the first slots."""
    lines = [
        MapLine(Slot(i), Gaussian(mean, cov[4 * i : 4 * i + 4, 4 * i : 4 * i + 4]))
        for i, mean in enumerate(means)
    ]
    fit_ranges = np.broadcast_to(np.asarray(ranges, dtype=float), (len(lines), 2))
    return Scene(tuple(lines), cov, PoseError(pose, time), fit_ranges, error)


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


def sent_rows(scene: Scene) -> list[dict[str, int]]:
    """Raw values of mean and range of complete records, without those of the covariance."""
    layout = layout_of(COMPLETE)
    rows = []
    for mean, (low, high) in zip(scene.means, scene.fit_ranges, strict=True):
        values = dict(zip((*MEAN, "XMin", "XMax"), (*mean, low, high), strict=True))
        rows.append({n: int(layout[n].limited(layout[n].raw(v))) for n, v in values.items()})
    return rows


def check_covered(code: SceneCode, scene: Scene, sent: Any) -> None:
    """What a receiver decodes is definite and covers the lines that are sent, exactly."""
    if not sent.lines:
        assert sent.decoded is None
        return
    decoded = code.decode(code.decode_pose(sent.pose), list(sent.lines.values()))
    for got, expected in zip(decoded, sent.decoded, strict=True):
        assert np.array_equal(got, expected)
    places = list(sent.lines)
    truth = scene.joint([scene.lines[i].slot for i in places])
    assert is_positive_definite(decoded.cov.tolist())
    assert covers(decoded.cov, decoded.means.ravel(), truth.cov, truth.mean)


@settings(deadline=None, max_examples=60)
@given(SEEDS, st.integers(1, 8), st.booleans())
def test_any_bits_of_lines_are_definite_or_ill_posed(seed: int, lines: int, free: bool) -> None:
    """In exact arithmetic, with any pose error and either form of what lines have of their own."""
    rng = np.random.default_rng(seed)
    pose = any_bits(POSE, POSE_NAMES, rng)
    rows = []
    for _ in range(lines):
        row = any_bits(LINE, (*MEAN, "XMin", "XMax"), rng) if free else function_of_x(rng)
        row |= any_bits(LINE, OWN, rng)
        if rng.random() < 0.5:
            row |= any_bits(LINE, COVARIANCE, rng)
        rows.append(row)
    try:
        decoded = CODE.decode(CODE.decode_pose(pose), rows)
    except IllPosedError:
        return
    assert np.array_equal(decoded.cov, decoded.cov.T)
    assert is_positive_definite(decoded.cov.tolist())


def test_most_lines_that_are_functions_of_x_are_decoded() -> None:
    """So that the test before this one checks something."""
    rng, decoded = np.random.default_rng(0), 0
    for _ in range(100):
        row = function_of_x(rng) | any_bits(LINE, OWN, rng)
        try:
            decoded += bool(CODE.decode(CODE.decode_pose(POSE_RAW), [row]).cov.any())
        except IllPosedError:
            continue
    assert decoded > 50


@pytest.mark.parametrize("full", [False, True])
def test_the_least_own_covariances_beside_the_largest_pose_error_are_definite(full: bool) -> None:
    """347 m and 0.65 rad, four times over by the ratios, beside tenths of a millimetre."""
    largest = {name: POSE[name].raw_max for name in POSE_NAMES}
    rng = np.random.default_rng(4)
    for lines in (1, 2, 8):
        rows = []
        for _ in range(lines):
            row = {name: int(rng.normal(0, 100)) for name in ("YOff", "Beta", "C0")}
            row |= {"C1": 0, "XMin": int(rng.integers(0, 32)), "XMax": int(rng.integers(40, 127))}
            row |= dict.fromkeys(OWN, 0)
            if full:
                row |= {n: LINE[n].raw_min if n.startswith("Pivot") else 0 for n in COVARIANCE}
            rows.append(row)
        decoded = CODE.decode(CODE.decode_pose(largest), rows)
        assert is_positive_definite(decoded.cov.tolist())


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
    if np.sqrt(pose.diagonal()).max() > 0.5:
        with suppress(EncodeError):
            ENCODER.encode(scene)
        return
    sent = ENCODER.encode(scene, full=full)
    check_covered(CODE, scene, sent)
    check_covered(LEVELS_CODE, scene, LEVELS_ENCODER.encode_levels(scene, [*sent_rows(scene)]))


@pytest.mark.parametrize("error", [None, MapError(0.05, 0.08, 1e-3)], ids=["exact", "map error"])
@pytest.mark.parametrize("pose", POSES)
@pytest.mark.parametrize("lines", range(1, 9))
def test_scenes_of_roads_are_covered(lines: int, pose: str, error: MapError | None) -> None:
    number = lines + 10 * (error is None) + 3 * (pose == "poor")
    scene = road_scene(number, lines, pose, error)
    assert scene.lines
    sent = ENCODER.encode(scene)
    check_covered(CODE, scene, sent)
    check_covered(CODE, scene, ENCODER.encode(scene, full=True))
    check_covered(LEVELS_CODE, scene, LEVELS_ENCODER.encode_levels(scene, [*sent_rows(scene)]))


@pytest.mark.parametrize("pose", [0.0, 1e-30, 1e-6, 1.0, 1e2, 1e4])
def test_zero_and_large_pose_errors_are_covered(pose: float) -> None:
    """The pose is not what the lines say: they have all of it of their own, or too little."""
    lanes = straight_lanes()
    scene = scene_of(lanes.means, lanes.cov, pose * PRODUCTION)
    sent = ENCODER.encode(scene)
    assert len(sent.lines) == 3
    check_covered(CODE, scene, sent)


def test_singular_covariances_are_covered() -> None:
    """None at all, only the pose's, and one that is common to all lines but not the pose's."""
    lanes, u = straight_lanes(), np.tile(SIGMA, 3)
    for cov in (np.zeros((12, 12)), lanes.cov - straight_lanes(scale=0.0).cov, np.outer(u, u)):
        scene = scene_of(lanes.means, cov)
        sent = ENCODER.encode(scene)
        assert len(sent.lines) == 3
        check_covered(CODE, scene, sent)


def test_a_pose_error_that_does_not_fit_is_refused() -> None:
    lanes = straight_lanes()
    with pytest.raises(EncodeError, match=r"1000 m along, 0\.2 m across and 0\.00349066 rad"):
        ENCODER.encode(scene_of(lanes.means, lanes.cov, np.diag([1e3, 0.2, np.radians(0.2)]) ** 2))


UNFIT = {
    "beside": ([40.0, 0, 0, 0], WINDOW, SIGMA),
    "across": ([0.0, 1.2, 0, 0], WINDOW, SIGMA),
    "far": ([1e300, 0, 0, 0], WINDOW, SIGMA),
    "bent": ([0, 0, 0, 1.7e308], WINDOW, SIGMA),
    "steep": ([0, 0, 0.12, 0], WINDOW, SIGMA),
    "between metres": ([5.0, 0, 0, 0], [3.2, 3.8], SIGMA),
    "behind": ([5.0, 0, 0, 0], [-40.0, -1.0], SIGMA),
    "ahead": ([5.0, 0, 0, 0], [40.0, 1e200], SIGMA),
    "wide": ([5.0, 0, 0, 0], WINDOW, SIGMA * [1e6, 1, 1, 1]),
    "wider": ([5.0, 0, 0, 0], WINDOW, [0, 0, 0, 1e3 * LARGEST]),
}


@pytest.mark.parametrize("size", [1e20, 1e160, 1e305])
def test_own_covariances_beyond_all_codes_do_not_affect_the_others(size: float) -> None:
    """The line is left out, without a warning, in both kinds of records."""
    lanes = straight_lanes(2)
    own = np.array([size * np.eye(4), np.diag(SIGMA**2)])
    scene = replace(lanes, specific_covs=own)
    assert [*ENCODER.encode(scene).lines] == [1]
    assert 0 not in LEVELS_ENCODER.encode_levels(scene, [*sent_rows(scene)]).lines


@pytest.mark.parametrize("unfit", UNFIT.values(), ids=UNFIT)
@pytest.mark.parametrize("place", [0, 2])
def test_lines_that_do_not_fit_do_not_affect_the_others(unfit: Any, place: int) -> None:
    """They are left out, and the others are sent as without them."""
    lanes = straight_lanes(4)
    mean, window, sigma = unfit
    means, ranges = lanes.means.copy(), lanes.fit_ranges.copy()
    means[place], ranges[place] = mean, window
    cov = lanes.cov.copy()
    own = np.s_[4 * place : 4 * place + 4]
    cov[own], cov[:, own] = 0.0, 0.0
    cov[own, own] = np.diag(np.square(sigma))
    scene = scene_of(means, cov, ranges=ranges)
    others = [i for i in range(4) if i != place]
    keep = (4 * np.array(others)[:, None] + np.arange(4)).ravel()
    alone = scene_of(means[others], cov[np.ix_(keep, keep)], ranges=ranges[others])
    sent, expected = ENCODER.encode(scene), ENCODER.encode(alone)
    assert list(sent.lines) == others
    assert list(sent.lines.values()) == list(expected.lines.values())
    assert sent.pose == expected.pose
    rows: list[Any] = sent_rows(alone)
    rows.insert(place, None)
    by_levels = LEVELS_ENCODER.encode_levels(scene, rows)
    assert place not in by_levels.lines


def test_a_complete_record_without_a_range_is_not_in_the_scene() -> None:
    """Its valid range was too short for the steps of 4 m, and was rounded inwards to none."""
    lanes = road_scene(0, 2, "production", MapError(0.05, 0.05))
    rows = sent_rows(lanes)
    rows[0] |= {"XMin": 5, "XMax": 0}
    assert [*LEVELS_ENCODER.encode_levels(lanes, [*rows]).lines] == [1]


def test_a_scene_without_lines_is_a_pose() -> None:
    empty = Scene((), np.zeros((0, 0)), PoseError(PRODUCTION), np.zeros((0, 2)))
    assert ENCODER.encode(empty).lines == LEVELS_ENCODER.encode_levels(empty, []).lines == {}
    assert ENCODER.encode(empty).pose.keys() == set(POSE_NAMES)


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("number", range(6))
def test_a_decoded_scene_is_encoded_as_itself_and_covered(number: int, full: bool) -> None:
    """Ranges and times are kept; a decoded covariance is covered again.

    Means are kept in the form of the finer steps; in the other one, a mean of those has to be
    rounded.
    """
    scene = road_scene(number, 3, "production", MapError(0.05, 0.08))
    first = ENCODER.encode(scene, full=full)
    pose = CODE.decode_pose(first.pose)
    decoded = first.decoded
    assert decoded is not None
    error = MapError(0.0, pose.offset_sigma, pose.heading_sigma)
    again = scene_of(decoded.means, decoded.cov, pose.cov, decoded.fit_ranges, error)
    second = ENCODER.encode(again, full=full)
    check_covered(CODE, again, second)
    assert list(second.lines) == list(range(len(first.lines)))
    for row, kept in zip(second.lines.values(), first.lines.values(), strict=True):
        names = ["XMin", "XMax"]
        if full or "Inflation" not in kept:
            names += [name for name in (*MEAN, *FINE_SIGNALS) if name in kept]
        for name in names:
            assert row[name] == kept[name]
    for name in ("MapOffset", "MapHeading"):
        assert second.pose[name] == first.pose[name]
    repeated = ENCODER.encode(scene, full=full)
    assert (repeated.pose, repeated.lines) == (first.pose, first.lines)


def test_means_are_within_a_centimetre_all_over_the_range() -> None:
    """Though half a step of C1 alone is 2 cm at 80 m: each rounding allows for those before it."""
    rng = np.random.default_rng(2)
    for _ in range(100):
        mean = rng.uniform(-1, 1, 4) * [5, 0.2, 2e-3, 1e-5]
        scene = scene_of(mean[None], np.diag(SIGMA**2))
        decoded = ENCODER.encode(scene).decoded
        assert decoded is not None
        x = np.linspace(-20, 80, 101)
        assert np.abs(lateral(decoded.means[0], x) - lateral(mean, x)).max() <= 0.01


def test_means_with_all_entries_are_within_two_millimetres() -> None:
    """Half of a fine step of each parameter; those are 1/8 or 1/16 of a step."""
    rng = np.random.default_rng(2)
    for _ in range(100):
        mean = rng.uniform(-1, 1, 4) * [5, 0.2, 2e-3, 1e-5]
        scene = scene_of(mean[None], np.diag(SIGMA**2))
        decoded = ENCODER.encode(scene, full=True).decoded
        assert decoded is not None
        x = np.linspace(-20, 80, 101)
        assert np.abs(lateral(decoded.means[0], x) - lateral(mean, x)).max() <= 0.002


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("error", [None, MapError(0.05, 0.08)], ids=["exact", "map error"])
@pytest.mark.parametrize("pose", POSES)
def test_joint_quantities_are_as_uncertain_as_at_the_sender(
    shape: str, error: MapError | None, pose: str
) -> None:
    """Width and difference of directions of conditional records, within 12 %.

    Beyond the resolution of the means, at the ends of the common range and between them. Nothing is
    common to a lane's boundaries but the pose error, which these quantities do not see: they show
    what the lines have of their own.
    """
    scene = road_scene([*SHAPES].index(shape) + 14, 4, pose, error)
    sent = ENCODER.encode(scene)
    assert [*sent.lines][:2] == [0, 1]
    decoded = sent.decoded
    assert decoded is not None
    true = scene.cov[:8, :8] + noise_floor(decoded.means, decoded.fit_ranges, RESOLUTION)[:8, :8]
    ranges = decoded.fit_ranges[:2]
    for x in np.linspace(ranges[:, 0].max(), ranges[:, 1].min(), 5):
        position = lateral_jacobian(decoded.means[:2], x)
        turned = 1 + np.tan(decoded.means[:2, 1]) ** 2
        slope = np.array([[0.0, t, x, x * x / 2] for t in turned])
        for one, other in (position, slope):
            g = np.append(one, -other)
            assert g @ decoded.cov[:8, :8] @ g <= 1.12**2 * (g @ true @ g)


def test_a_scene_that_states_its_own_covariances_is_covered() -> None:
    """Even if they are wrong, and with less for a poor pose: they are not to be inferred."""
    known = road_scene(5, 4, "poor", None)
    assert known.specific_covs is not None
    unknown = replace(known, specific_covs=None)
    sizes = []
    for scene in (known, unknown, replace(known, specific_covs=0 * known.specific_covs)):
        sent = ENCODER.encode(scene)
        check_covered(CODE, scene, sent)
        assert sent.decoded is not None
        sizes.append(np.linalg.slogdet(sent.decoded.cov)[1])
    assert sizes[0] <= sizes[1]
    check_covered(LEVELS_CODE, known, LEVELS_ENCODER.encode_levels(known, [*sent_rows(known)]))


def test_lines_of_a_map_error_take_two_frames_and_others_four() -> None:
    """Levels hold what a map error is; nothing they have suits a line without any error."""
    scene = road_scene(0, 4, "production", MapError(0.05, 0.05))
    rows = ENCODER.encode(scene).lines.values()
    assert sum("Inflation" in row for row in rows) <= 1
    for row in ENCODER.encode(scene, full=True).lines.values():
        assert "Inflation" in row
        assert [row[name] for name in OWN[:3]] == [0, 0, 0]


@pytest.mark.parametrize("x", [0.0, 20.0, 40.0])
def test_width_and_centre_are_as_uncertain_as_at_the_sender(x: float) -> None:
    """A straight lane with a map error: within 5 % of the sender's and the resolution."""
    roads = {
        Slot(i): Polyline([[-100.0, y], *[[s, y] for s in range(-90, 200, 5)]])
        for i, y in enumerate((1.75, -1.75))
    }
    ego = Gaussian([0, 0, 0], PRODUCTION)
    scene = map_scene(roads, ego, map_error=MapError(0.05, 0.05))
    sent = ENCODER.encode(scene)
    assert sent.decoded is not None
    received = Scene(
        scene.lines, sent.decoded.cov, scene.pose_error, sent.decoded.fit_ranges, scene.map_error
    )
    floor = 2 * 2**-9 / 12**0.5
    for true, got in (
        (scene.width(x), received.width(x)),
        (scene.centre(x), received.centre(x)),
    ):
        assert true.sigma < got.sigma <= 1.05 * np.hypot(true.sigma, floor)
    assert received.width(x).sigma < received.centre(x).sigma / 2


@pytest.mark.parametrize("x_min", [32, 33, 63])
def test_the_receivers_ranges_must_not_be_empty(x_min: int) -> None:
    row = dict.fromkeys((*MEAN, *OWN), 0) | {"XMin": x_min, "XMax": 0}
    with pytest.raises(IllPosedError, match="the range of a line is empty"):
        CODE.decode(CODE.decode_pose(POSE_RAW), [row])
