"""Scenes to frames in C: the same bytes, reasons and counters as in Python."""

import struct
from collections.abc import Iterable, Iterator
from copy import copy
from dataclasses import replace
from typing import Any, NamedTuple

import c_core
import numpy as np
import pytest
from c_layouts import with_messages, with_slots
from evidence.roads import SHAPES, random_scene
from evidence.witness import POSES, Poses
from scene_layouts import layout_of
from scene_streams import road_scene

from maplines_can import (
    Codec,
    Gaussian,
    Kind,
    MapError,
    MapLine,
    Polyline,
    PoseError,
    Scene,
    Slot,
    Status,
    map_scene,
)
from maplines_can.model.records import intact
from maplines_can.values.errors import EncodeError, IllPosedError
from maplines_can.values.line import LeftOut
from maplines_can.values.seen_lines import SeenLines
from maplines_can.wire import POSE, Layout
from maplines_can.wire.layout.signals import PARAMETER_SIGNALS
from maplines_can.wire.records.frames import Frame

CONDITIONAL, COMPLETE = "maplines-pose.dbc", "maplines.dbc"
OWNERS = (*Slot, POSE)
#: Numbers of maplines_left_out_t and of maplines_refusal_t.
LEFT_OUT = {LeftOut.ACROSS: 1, LeftOut.RANGE: 2, LeftOut.MEAN: 3, LeftOut.COVARIANCE: 4}
NO_MESSAGE, BAD_POSE, UNSEEN = 1, 16, 17
ERRORS = (None, MapError(0.05, 0.05), MapError(0.05, 0.05, 0.001), MapError(offset_sigma=0.3))
AGES = (0.0, 0.004, 0.0205, np.inf)


class Case(NamedTuple):
    """A scene that a sender with these counters sends."""

    scene: Scene
    counters: dict[Any, int]
    age: float
    is_fd: bool


class Sent(NamedTuple):
    """What is sent of a scene."""

    refusal: int
    left_out: list[int]  #: by line; 0 if it is in the scene
    is_sent: list[bool]  #: by line
    statuses: list[int]  #: of the lines that are sent
    counters: list[int]  #: by owner
    frames: list[tuple[int, bool, bool, bytes]]  #: CAN ID, extended, CAN FD, data


def input_of(case: Case) -> bytes:
    """A case as c/tests/scene_encode_harness.c reads it."""
    scene, error = case.scene, case.scene.map_error
    n, specific = len(scene.lines), scene.specific_covs
    parts = [struct.pack("<B9I", case.is_fd, *(case.counters[owner] for owner in OWNERS))]
    parts.append(struct.pack("<B", n))
    for line, fit_range, quartic in zip(scene.lines, scene.fit_ranges, scene.quartics, strict=True):
        values = (line.x_min, line.x_max, case.age, *line.gaussian.mean, *fit_range, quartic)
        parts.append(struct.pack("<3B10d", line.slot, line.kind, line.status, *values))
    parts.append(struct.pack("<B", specific is not None))
    arrays = (() if specific is None else specific, scene.cov, scene.pose_error.cov)
    parts += [np.asarray(array, dtype="<f8").tobytes() for array in arrays]
    of_map = (error.offset_sigma, error.heading_sigma) if error else (0.0, 0.0)
    parts.append(struct.pack("<4d", case.age, scene.pose_error.correlation_time, *of_map))
    return b"".join(parts)


def in_c(layout: Layout, cases: list[Case], *prefix: str, **compiler: Any) -> list[Sent]:
    """What the C core sends; see ``c_core.harness`` and ``c_core.run``."""
    program = c_core.harness("scene_encode", layout, **compiler)
    output = c_core.run(program, b"".join(map(input_of, cases)), *prefix)
    view, at = memoryview(output), 0

    def read(form: str) -> tuple[Any, ...]:
        nonlocal at
        values = struct.unpack_from(form, view, at)
        at += struct.calcsize(form)
        return values

    sent = []
    for case in cases:
        (refusal,) = read("<B")
        lines = [read("<3B") for _ in case.scene.lines]
        counters = list(read("<9I"))
        frames = []
        for _ in range(read("<H")[0]):
            can_id, is_extended, is_fd, length = read("<I3B")
            frames.append((can_id, bool(is_extended), bool(is_fd), bytes(view[at : at + length])))
            at += length
        left_out, is_sent = [line[0] for line in lines], [bool(line[1]) for line in lines]
        statuses = [line[2] for line in lines if line[1]]
        sent.append(Sent(refusal, left_out, is_sent, statuses, counters, frames))
    assert at == len(output)
    return sent


def in_python(codec: Codec, case: Case) -> Sent:
    """What the Python package sends."""
    encoder, lines = codec.encoder(), case.scene.lines
    try:
        prepared = encoder.prepare_scene(case.scene, fd=case.is_fd)
        frames = encoder.encode_scene(prepared, age=case.age, fd=case.is_fd, counters=case.counters)
    except (EncodeError, IllPosedError) as error:
        refusal = UNSEEN
        if isinstance(error, EncodeError):
            refusal = BAD_POSE if "pose error does not fit" in str(error) else NO_MESSAGE
        nothing = [0] * len(lines)
        return Sent(refusal, nothing, [False] * len(lines), [], [*case.counters.values()], [])
    left_out = [0] * len(lines)
    for place, member in zip(range(len(lines)), prepared.core.space.members, strict=False):
        left_out[place] = member.left_out
    modulus = 2 ** codec.layout["Counter"].length
    pose_modulus = 2 ** codec.layout.pose["Counter"].length if codec.layout.pose else 1
    counters = [
        (n + (owner in frames)) % (pose_modulus if owner == POSE else modulus)
        if owner in frames
        else n
        for owner, n in case.counters.items()
    ]
    of_lines = [line.slot in prepared.sent_slots for line in lines]
    statuses = [status_of(codec, slot, frames[slot]) for slot in prepared.sent_slots]
    flat = [(f.can_id, f.is_extended, f.is_fd, f.data) for own in frames.values() for f in own]
    return Sent(0, left_out, of_lines, statuses, counters, flat)


def status_of(codec: Codec, slot: Slot, frames: Iterable[Frame]) -> int:
    """The status in the frames of a line; FULL of a record that is conditional and has none."""
    layout = codec.layout
    if layout.is_conditional:
        return Status.FULL
    payload = b"".join(frame.data for frame in frames)[: layout.record_bytes]
    raw = intact(layout, payload, layout.messages[slot].data_id)
    assert not isinstance(raw, str)
    return raw["Status"]


def case_of(scene: Scene, rng: Any, layout: Layout) -> Case:
    """A case with random counters and ages."""
    bits = dict.fromkeys(OWNERS, layout["Counter"].length)
    bits[POSE] = layout.pose["Counter"].length if layout.pose else 0
    counters = {owner: int(rng.integers(2 ** min(bits[owner], 32))) for owner in OWNERS}
    return Case(scene, counters, float(rng.choice(AGES)), bool(rng.integers(2)))


def on_roads(numbers: range) -> Iterator[Scene]:
    """Scenes of random roads, seen from production poses and from poor ones."""
    for number in numbers:
        rng = np.random.default_rng(number)
        road = random_scene(list(SHAPES)[number % len(SHAPES)], rng, int(rng.integers(1, 9)))
        sigma = POSES[list(POSES)[number // len(SHAPES) % 2]]
        poses = Poses.about(road.pose, sigma, 0, rng)
        yield map_scene(
            {slot: Polyline(points) for slot, points in road.lines.items()},
            Gaussian(road.pose, poses.cov),
            map_error=ERRORS[rng.integers(len(ERRORS))],
            correlation_time=float(rng.choice([0.3, 4.0, np.inf])),
        )


def gaussians(numbers: range) -> Iterator[Scene]:
    """Scenes of random Gaussians, from tiny to huge; lines across the axis or out of range."""
    for number in numbers:
        rng = np.random.default_rng(number)
        n = int(rng.integers(0, 9))
        size, wide = 10 ** rng.uniform(-2, 1.2), 10 ** rng.uniform(-3, 1.5)
        means = size * rng.standard_normal((n, 4)) * [5, 0.2, 5e-3, 2e-5]
        sigma = np.tile([0.3, 5e-3, 2e-4, 5e-6], n)
        A = wide * sigma[:, None] * rng.standard_normal((4 * n, int(rng.integers(1, 8))))
        own = (0.3 * wide * sigma * 10 ** rng.uniform(-3, 1, 4 * n)) ** 2
        cov = A @ A.T + np.diag(own)
        cov = (cov + cov.T) / 2
        rank = int(rng.integers(1, 4))
        B = 10 ** rng.uniform(-2, 1) * np.array([[0.1], [0.2], [0.004]])
        B = B * rng.standard_normal((3, rank))
        low = rng.uniform(-30, 20, n) * rng.choice([1, 1, 1, 6])
        ends = np.column_stack([low, low + 10 ** rng.uniform(rng.choice([0, 1]), 2.1, n)])
        specific = None
        if rng.integers(2):
            specific = np.array([np.diag(own[4 * i : 4 * i + 4]) for i in range(n)]).reshape(
                -1, 4, 4
            )
        lines = tuple(
            MapLine(
                slot,
                Gaussian(means[i], cov[4 * i : 4 * i + 4, 4 * i : 4 * i + 4]),
                Kind(int(rng.integers(8))),
                x_min=float(ends[i, 0]),
                x_max=float(ends[i].mean() if rng.integers(2) else ends[i, 1]),
                status=Status(int(rng.choice([0, 1, 1, 1, 2, 3, 4]))),
            )
            for i, slot in enumerate(rng.permutation(list(Slot))[:n])
        )
        yield Scene(
            lines,
            cov,
            PoseError(B @ B.T, float(rng.choice([0.01, 1.0, 1e9, np.inf]))),
            ends,
            ERRORS[rng.integers(len(ERRORS))],
            quartics=np.where(rng.integers(0, 2, n), rng.uniform(-0.5, 0.5, n), 0.0),
            specific_covs=specific,
        )


def at_ends(means: Any, layout: Layout, states: list[int], steps: float, rng: Any) -> None:
    """Move some parameters to the ends of their ranges, 8 steps from those of the signals."""
    for j in states:
        signal = layout[PARAMETER_SIGNALS[j]]
        ends = np.array(signal.physical_range) + np.array([8, -8]) * signal.factor
        moved = (
            rng.choice(ends, len(means)) + rng.uniform(-steps, steps, len(means)) * signal.factor
        )
        means[:, j] = np.where(rng.random(len(means)) < 0.6, moved, means[:, j])


def steepest(mean: Any, fit_range: Any, quartic: Any) -> Any:
    """Return the multiple of a mean that is hardly a function of x."""
    good, bad = 0.0, 1e6
    for _ in range(60):
        share = (good + bad) / 2
        try:
            SeenLines(share * mean[None], fit_range, quartic)
            good = share
        except IllPosedError:
            bad = share
    return good * mean


def extreme(numbers: Iterable[int], layout: Layout) -> Iterator[Scene]:
    """Scenes of Gaussians of which one thing is at an end of what there is, or far beyond it."""
    for number in numbers:
        rng = np.random.default_rng(number)
        scene = next(s for s in gaussians(range(10 * number, 10**9)) if len(s.lines))
        means, cov, ranges = scene.means.copy(), scene.cov, scene.fit_ranges
        specific, error, pose = scene.specific_covs, scene.map_error, scene.pose_error
        x_ranges = [(line.x_min, line.x_max) for line in scene.lines]
        match number % 11:
            case 0:
                error = MapError(offset_sigma=10 ** rng.uniform(-12, 8))
            case 1:
                error = MapError(heading_sigma=10 ** rng.uniform(-12, 8))
            case 2:
                scale = 10 ** rng.uniform(60, 130)
                cov = cov * scale
                specific = None if specific is None else specific * scale
            case 3 if specific is not None:
                specific = specific * 10 ** rng.uniform(60, 130)
            case 4:
                means[0] *= 10 ** rng.uniform(20, 70, 4)
            case 5:
                pose = PoseError(pose.cov * 10 ** rng.uniform(20, 150), pose.correlation_time)
            case 6:  # ranges of a few metres, some steps from the ends of the signals
                ranges = rng.uniform([-5, 1], [0, 4], ranges.shape)
                x_ranges = [(low + rng.uniform(0, 1), high) for low, high in ranges]
                at_ends(means, layout, [0, 1, 2, 3], 30.0, rng)
            case 7 | 8:  # as far as a message can state
                at_ends(means, layout, [0, 1], 0.02, rng)
            case _:  # hardly a function of x
                ranges = rng.uniform([-2, 30], [0, 60], ranges.shape)
                x_ranges = ranges.tolist()
                for i in range(len(means)):
                    means[i] = rng.uniform(0.5, 1.0, 4) * [1, 0.3, 0.1, 1e-4]
                    curve = ranges[i : i + 1], scene.quartics[i : i + 1]
                    means[i] = steepest(means[i], *curve) * (1 - 10 ** rng.uniform(-9, -4))
        lines = tuple(
            replace(
                line,
                gaussian=Gaussian(means[i], cov[4 * i : 4 * i + 4, 4 * i : 4 * i + 4]),
                x_min=float(x_ranges[i][0]),
                x_max=float(x_ranges[i][1]),
            )
            for i, line in enumerate(scene.lines)
        )
        yield Scene(
            lines, cov, pose, ranges, error, quartics=scene.quartics, specific_covs=specific
        )


def awkward() -> Iterator[Scene]:
    """Scenes at the limits: no lines, no pose error, bends, pose errors without limit."""
    yield Scene((), np.zeros((0, 0)), PoseError(np.zeros((3, 3))), np.zeros((0, 2)))
    for sigma in ((0.3, 0.2, 0.005), (0, 0, 0), (0, 0.2, 0), (5, 8, 0.3), (1e-6, 1e-6, 1e-9)):
        for radius in (60.0, 1e5):
            yield road_scene(Slot, sigma=np.array(sigma), radius=radius)
            yield road_scene([Slot.ROUTE], sigma=np.array(sigma), radius=radius, map_error=None)
    for size in (1e3, 1e9, 1e60):
        P = size * np.eye(3)
        yield Scene((), np.zeros((0, 0)), PoseError(P), np.zeros((0, 2)))


def check(
    layout: Layout,
    scenes: Iterable[Scene],
    seed: int = 0,
    *prefix: str,
    **compiler: Any,
) -> list[Sent]:
    """Compare what both send of scenes in either kind of frame, and return it.

    Lines for which the DBC has no such message are left out before.
    """
    rng, codec = np.random.default_rng(seed), Codec(layout)
    cases = [sendable(case_of(scene, rng, layout), layout) for scene in scenes]
    expected = [in_python(codec, case) for case in cases]
    for got, wanted in zip(in_c(layout, cases, *prefix, **compiler), expected, strict=True):
        assert got == wanted
    return expected


def sendable(case: Case, layout: Layout) -> Case:
    """A case with the lines for which there are messages, in frames that the pose error has."""
    pose = layout.messages_of[POSE]
    is_fd = pose.can_id is None or (case.is_fd and pose.fd_can_id is not None)
    slots = [
        slot
        for slot in case.scene.index
        if (own := layout.messages_of.get(slot)) is not None
        and (own.fd_can_id if is_fd else own.can_id) is not None
    ]
    return case._replace(scene=case.scene.subset(slots), is_fd=is_fd)


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_scenes_of_roads(dbc: str) -> None:
    """Frames, reasons and counters of scenes of all shapes of roads."""
    sent = check(layout_of(dbc), on_roads(range(len(SHAPES), 2 * len(SHAPES) + 4)))
    assert sum(len(one.frames) for one in sent) > 100


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_scenes_of_random_gaussians(dbc: str) -> None:
    """Whatever a caller may give, with lines left out for every reason."""
    sent = check(layout_of(dbc), gaussians(range(150)))
    reasons = {reason for one in sent for reason in one.left_out}
    assert reasons >= ({0, 1, 2, 3, 4} if dbc == CONDITIONAL else {0, 1, 2, 4})


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_extreme_scenes(dbc: str) -> None:
    """Also those whose lines cannot be seen from other poses."""
    numbers = [*range(88), 193]  # of the last, a rounded mean exceeds its signal
    sent = check(layout_of(dbc), extreme(numbers, layout_of(dbc)))
    assert {one.refusal for one in sent} == {0, BAD_POSE, UNSEEN}


@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_awkward_scenes(dbc: str) -> None:
    """Also those whose pose error does not fit."""
    sent = check(layout_of(dbc), awkward())
    assert {one.refusal for one in sent} == {0, BAD_POSE}


def changed(field: str, place: Any, value: Any) -> Scene:
    """A good scene with one value that no ``Scene`` has."""
    scene = road_scene()
    object.__setattr__(scene, "map_error", copy(scene.map_error))  # which all scenes share
    for holder, name in (
        (scene, field),
        (scene.pose_error, field.removeprefix("pose_")),
        (scene.map_error, field.removeprefix("map_")),
        (scene.lines[0], field),
        (scene.lines[0].gaussian, field),
    ):
        if hasattr(holder, name):
            old = getattr(holder, name)
            if isinstance(old, np.ndarray):
                new = old.copy()
                new[place] = value
            else:
                new = value
            object.__setattr__(holder, name, new)
            return scene
    raise AttributeError(field)


@pytest.mark.parametrize(
    ("field", "place", "value", "refusal"),
    [
        pytest.param("mean", 1, np.inf, 3, id="mean"),
        pytest.param("cov", (5, 5), np.nan, 4, id="cov not finite"),
        pytest.param("cov", (5, 5), -1e-9, 5, id="variance"),
        pytest.param("cov", (0, 5), 1.0, 6, id="asymmetric"),
        pytest.param("cov", (np.arange(8), np.arange(8)), 1e-12, 14, id="indefinite"),
        pytest.param("specific_covs", (0, 2, 2), -1.0, 5, id="specific variance"),
        pytest.param("pose_cov", (1, 1), -1.0, 5, id="pose variance"),
        pytest.param("fit_ranges", (0, 1), -99.0, 7, id="fit range"),
        pytest.param("fit_ranges", (0, 0), -np.inf, 7, id="begin of fit range"),
        pytest.param("fit_ranges", (0, 1), np.inf, 7, id="end of fit range"),
        pytest.param("quartics", 0, np.nan, 7, id="quartic"),
        pytest.param("map_offset_sigma", None, -1e-9, 16, id="map offset"),
        pytest.param("map_offset_sigma", None, np.inf, 16, id="infinite map offset"),
        pytest.param("map_heading_sigma", None, np.nan, 16, id="map heading"),
        pytest.param("map_heading_sigma", None, np.inf, 16, id="infinite map heading"),
        pytest.param("x_min", None, 99.0, 7, id="range"),
        pytest.param("correlation_time", None, 0.0, 16, id="correlation time"),
        pytest.param("slot", None, Slot.EGO_RIGHT, 15, id="same slot"),
        pytest.param("slot", None, 8, 1, id="no slot"),
        pytest.param("kind", None, 8, 9, id="kind"),
        pytest.param("status", None, 6, 10, id="status"),
    ],
)
@pytest.mark.parametrize("dbc", [CONDITIONAL, COMPLETE])
def test_mistakes_of_a_caller_are_named(
    dbc: str, field: str, place: Any, value: Any, refusal: int
) -> None:
    """Nothing is sent then, and no counter advances."""
    layout = layout_of(dbc)
    case = case_of(changed(field, place, value), np.random.default_rng(0), layout)
    (sent,) = in_c(layout, [case])
    assert sent.refusal == refusal
    assert not sent.frames
    assert sent.counters == [*case.counters.values()]


@pytest.mark.parametrize("age", [-1e-9, np.nan])
def test_an_age_of_a_pose_error_that_is_none(age: float) -> None:
    case = case_of(road_scene(()), np.random.default_rng(0), layout_of(COMPLETE))
    (sent,) = in_c(layout_of(COMPLETE), [case._replace(age=age)])
    assert (sent.refusal, sent.frames) == (8, [])


def test_more_lines_than_slots() -> None:
    """As if there were a ninth line."""
    case = case_of(road_scene(Slot), np.random.default_rng(0), layout_of(COMPLETE))
    data = bytearray(input_of(case))
    data[struct.calcsize("<B9I")] += 1
    assert c_core.run(c_core.harness("scene_encode", layout_of(COMPLETE)), bytes(data))[0] == 12


@pytest.mark.parametrize(
    ("layout", "is_fd", "refusal"),
    [
        pytest.param(layout_of(COMPLETE), True, 0, id="sent"),
        pytest.param(replace(layout_of(COMPLETE), pose=None), True, NO_MESSAGE, id="no-pose"),
        pytest.param(with_slots(layout_of(COMPLETE), Slot.ROUTE), True, NO_MESSAGE, id="slot"),
        pytest.param(with_messages(layout_of(CONDITIONAL), fd_can_id=None), False, 0, id="classic"),
        pytest.param(
            with_messages(layout_of(CONDITIONAL), fd_can_id=None), True, NO_MESSAGE, id="no-FD"
        ),
    ],
)
def test_a_scene_without_messages(layout: Layout, is_fd: bool, refusal: int) -> None:
    """Of the pose error or of a line, in the frame format that is wanted."""
    case = case_of(road_scene([Slot.EGO_LEFT]), np.random.default_rng(0), layout)
    (sent,) = in_c(layout, [case._replace(is_fd=is_fd)])
    assert (sent.refusal, bool(sent.frames)) == (refusal, refusal == 0)
