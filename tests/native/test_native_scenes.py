"""Scenes to frames: the C core against Python alone, bit by bit."""

from collections import Counter, UserDict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import fields, replace
from functools import cache, partial
from itertools import chain
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from both_senders import Calls, assert_no_growth, check_same, codecs_of, outcome
from c_layouts import unusual_layouts
from evidence.roads import SHAPES, random_scene
from evidence.witness import POSES, Poses
from maplines_can.native import lib
from random_dbc import random_dbc
from scene_layouts import layout_of
from scene_streams import OFFSETS, road_scene

from maplines_can import (
    Gaussian,
    MapError,
    MapLine,
    Polyline,
    PoseError,
    Scene,
    Slot,
    Status,
    map_scene,
)
from maplines_can.wire import POSE, Codec, Layout, PreparedScene
from maplines_can.wire.c_sender import SceneInC
from maplines_can.wire.records.counters import packed

pytestmark = pytest.mark.skipif(lib is None, reason="there is no C path")

COMPLETE, CONDITIONAL, SECURED = "maplines.dbc", "maplines-pose.dbc", "maplines-secoc.dbc"
ERRORS = (None, MapError(0.05, 0.05), MapError(0.05, 0.05, 0.001), MapError(offset_sigma=0.3))
AGES: tuple[Any, ...] = (
    0.0, 0.0205, 1, np.inf, True, np.float64(0.03), np.float32(0.03), 1e80, 1e120,
    -1.0, np.nan, None, "1", {}, {POSE: 0.1},
    {owner: 0.01 * i for i, owner in enumerate((POSE, *Slot))},
    UserDict(dict.fromkeys((POSE, *Slot), 0.02)),
    {POSE: np.inf} | dict.fromkeys(Slot, -1.0),
)  # fmt: skip


@cache
def roads() -> list[Scene]:
    """Scenes of random roads, seen from production poses and from poor ones."""
    found = []
    for number in range(len(SHAPES), 2 * len(SHAPES)):
        rng = np.random.default_rng(number)
        road = random_scene(list(SHAPES)[number % len(SHAPES)], rng, int(rng.integers(1, 9)))
        poses = Poses.about(road.pose, POSES[list(POSES)[number % 2]], 0, rng)
        lines = {slot: Polyline(points) for slot, points in road.lines.items()}
        ego = Gaussian(road.pose, poses.cov)
        time = float(rng.choice([0.3, 4.0, np.inf]))
        found.append(map_scene(lines, ego, map_error=ERRORS[number % 4], correlation_time=time))
    return found


def gaussians(numbers: range) -> Iterator[Scene]:
    """Scenes of random Gaussians: lines across the axis, out of range, or with a wide error."""
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
        low = rng.uniform(-30, 20, n) * rng.choice([1, 1, 1, 6])
        ends = np.column_stack([low, low + 10 ** rng.uniform(rng.choice([0, 1]), 2.1, n)])
        B = (
            np.array([[0.1], [0.2], [0.004]])
            * rng.standard_normal((3, 2))
            * 10 ** rng.uniform(-2, 1)
        )
        specific = np.array([np.diag(own[4 * i : 4 * i + 4]) for i in range(n)]).reshape(-1, 4, 4)
        lines = tuple(
            MapLine(
                slot,
                Gaussian(means[i], cov[4 * i : 4 * i + 4, 4 * i : 4 * i + 4]),
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
            specific_covs=specific if rng.integers(2) else None,
        )


def scenes() -> list[Scene]:
    """Scenes of roads and of Gaussians, and some at the limits."""
    limits = [
        Scene((), np.zeros((0, 0)), PoseError(np.zeros((3, 3))), np.zeros((0, 2))),
        Scene((), np.zeros((0, 0)), PoseError(1e60 * np.eye(3)), np.zeros((0, 2))),
        road_scene(Slot, sigma=(0, 0, 0)),
        road_scene(Slot, sigma=(5, 8, 0.3), radius=60.0),
    ]
    return [*limits, *roads(), *gaussians(range(40))]


def same_fields(one: Any, other: Any) -> bool:
    """Whether two values of the same class have the same fields, to the last bit."""
    if isinstance(one, dict):
        return one == other and [*map(type, one)] == [*map(type, other)]
    if isinstance(one, tuple) and hasattr(one, "_fields"):
        return all(map(same_fields, one, other))
    if isinstance(one, np.ndarray):
        return one.dtype == other.dtype and one.shape == other.shape and np.array_equal(one, other)
    return bool(one == other)


def check_prepared(in_c: PreparedScene, alone: PreparedScene) -> None:
    """Check all attributes of scenes that both have prepared."""
    assert type(in_c.encoded) is SceneInC
    assert [f.name for f in fields(in_c)] == [f.name for f in fields(alone)]
    assert in_c.scene is alone.scene
    for name in ("sent_slots", "unfit", "left_out", "members"):
        assert same_fields(getattr(in_c, name), getattr(alone, name)), name
    for name in ("left_out", "lines", "pose", "decoded"):
        assert same_fields(getattr(in_c.encoded, name), getattr(alone.encoded, name)), name
    assert [*in_c.encoded.lines] == [*alone.encoded.lines]
    for slot in in_c.sent_slots:
        assert in_c.without(slot).sent_slots == alone.without(slot).sent_slots
        assert same_fields(in_c.without(slot).members, alone.without(slot).members)


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize(
    ("dbc", "is_authenticated"),
    [(COMPLETE, False), (CONDITIONAL, False), (SECURED, True)],
)
def test_scenes_of_any_kind(dbc: str, is_authenticated: bool, fd: bool) -> None:
    """Frames, counters, errors, and all that a prepared scene has, are the same."""
    codecs = codecs_of(layout_of(dbc), is_authenticated=is_authenticated)
    encoders = codecs[0].encoder(), codecs[1].encoder()
    calls, reasons = Calls(encoders[0]), Counter[Any]()
    for i, scene in enumerate(scenes()):
        prepared = [outcome(lambda e=e: e.prepare_scene(scene, fd=fd)) for e in encoders]  # type: ignore[misc] # noqa: B023
        if not isinstance(prepared[0], PreparedScene):
            assert prepared[0] == prepared[1]
            reasons["error"] += 1
            continue
        age = AGES[i % 4]
        in_c = outcome(lambda: encoders[0].encode_scene(prepared[0], age=age, fd=fd))  # noqa: B023
        alone = outcome(lambda: encoders[1].encode_scene(prepared[1], age=age, fd=fd))  # noqa: B023
        assert in_c == alone
        check_prepared(*prepared)
        assert encoders[0]._counters == encoders[1]._counters
        reasons.update(prepared[0].unfit.values())
    assert reasons["error"] == 1
    if fd or not is_authenticated:
        assert calls.sent >= 100
        assert calls.left == 1
    if dbc == CONDITIONAL:
        assert len(reasons) >= 4


@pytest.mark.parametrize("seed", [*range(9), 1000, 1001])
def test_scenes_of_random_dbcs(seed: int) -> None:
    """The same with DBCs of any layout."""
    codecs = codecs_of(Layout.from_text(random_dbc(seed)))
    encoders = codecs[0].encoder(), codecs[1].encoder()
    calls = Calls(encoders[0])
    for scene in [*roads()[:3], *gaussians(range(seed, 200, 25))]:
        known = scene.subset([s for s in scene.index if s in codecs[0].layout.messages])
        for fd in (False, True):
            check_same(encoders, "encode_scene", known, fd=fd, age=0.02)
    check_same(encoders, "encode_scene", roads()[0])
    assert calls.sent > 0


@pytest.mark.parametrize("layout", unusual_layouts().values(), ids=unusual_layouts())
def test_layouts_without_some_messages(layout: Layout) -> None:
    """A DBC without a pose error, a slot or a kind of frame: the same errors."""
    for is_authenticated in (False, True):
        codecs = outcome(lambda: codecs_of(layout, is_authenticated=is_authenticated))  # noqa: B023
        if isinstance(codecs[0], type):
            continue  # there is nothing to authenticate
        encoders = codecs[0].encoder(), codecs[1].encoder()
        for slots in (Slot, [Slot.EGO_LEFT], [Slot.EGO_RIGHT, Slot.ROUTE]):
            for fd in (False, True):
                check_same(encoders, "encode_scene", road_scene(slots), fd=fd)


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
@pytest.mark.parametrize("age", AGES, ids=str)
def test_ages(dbc: str, age: Any) -> None:
    """Ages of any class, those of each owner, and those that are wrong."""
    codecs = codecs_of(layout_of(dbc))
    encoders = codecs[0].encoder(), codecs[1].encoder()
    scene = road_scene(OFFSETS)
    prepared = [encoder.prepare_scene(scene) for encoder in encoders]
    for fd in (False, True):
        in_c, alone = (
            outcome(lambda e=e, p=p: e.encode_scene(p, age=age, fd=fd))  # type: ignore[misc] # noqa: B023
            for e, p in zip(encoders, prepared, strict=True)
        )
        assert in_c == alone
    check_same(encoders, "encode_scene", road_scene([Slot.CENTRE]), age=0.0)


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
@pytest.mark.parametrize("start", [0, 7, 15, 255, 256, 2**32 - 1, 2**64 + 15, -1, -(10**30)])
def test_counters(dbc: str, start: int) -> None:
    """Counters wrap alike while lines come and go; those of a caller stay."""
    codecs = codecs_of(layout_of(dbc))
    encoders = codecs[0].encoder(), codecs[1].encoder()
    all_lines, some = road_scene(OFFSETS), road_scene([Slot.ROUTE, Slot.EGO_LEFT])
    prepared = [(e.prepare_scene(all_lines), e.prepare_scene(some)) for e in encoders]
    for encoder in encoders:
        encoder._counters = packed({POSE: start, Slot.EGO_LEFT: start, Slot.CENTRE: start})
    for i in range(40):
        in_c, alone = (
            e.encode_scene(p[i % 3 == 2] if i % 5 else p[0].without(Slot.CENTRE), age=0.02)
            for e, p in zip(encoders, prepared, strict=True)
        )
        assert in_c == alone
        assert [*in_c] == [*alone]
        assert encoders[0]._counters == encoders[1]._counters
    counters: dict[Any, int] = {owner: start + i for i, owner in enumerate((POSE, *Slot))}
    before = dict(counters)
    check_same(encoders, "encode_scene", all_lines, counters=counters)
    check_same(encoders, "encode_scene", all_lines, counters=UserDict(counters))
    check_same(encoders, "encode_scene", all_lines, counters={POSE: 1.5})
    assert counters == before


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_what_a_caller_changes_is_sent(dbc: str) -> None:
    """A scene is sent as its fields are, also if some of them were changed or replaced."""
    codecs = codecs_of(layout_of(dbc))
    scene = road_scene(OFFSETS)

    def changed(encoder: Any, kind: int) -> Any:
        prepared = encoder.prepare_scene(scene)
        encoded = prepared.encoded
        match kind:
            case 0:
                encoded.lines.pop(1)
            case 1:
                encoded.lines[2] |= {"OwnLateral": 1}
            case 2:
                encoded.pose["MapOffset"] = 0
            case 3:
                prepared = replace(
                    prepared, encoded=replace(encoded, pose=encoded.pose | {"MapOffset": 3})
                )
            case 4:
                prepared = replace(prepared, sent_slots=(*prepared.sent_slots[:3],))
            case 5:
                prepared = replace(prepared, sent_slots=prepared.sent_slots[:2]).without(Slot.ROUTE)
            case 6:
                prepared = replace(prepared, sent_slots=[*prepared.sent_slots[::-1]])
            case 7:
                prepared = replace(prepared, encoded=replace(encoded, lines={}))
            case 8:
                prepared = replace(prepared, scene=road_scene([Slot.EGO_LEFT]))
        return encoder.encode_scene(prepared, counters={POSE: 3})

    frames = []
    for kind in range(9):
        in_c, alone = (outcome(lambda c=c: changed(c.encoder(), kind)) for c in codecs)  # type: ignore[misc] # noqa: B023
        assert in_c == alone
        frames.append(in_c)
    unchanged = codecs[0].encoder().encode_scene(scene, counters={POSE: 3})
    assert all(one != unchanged for one in frames[:6])


def test_what_is_only_read_stays_in_c() -> None:
    """A caller that reads the raw values does not lose the speed."""
    encoder = codecs_of(layout_of(CONDITIONAL))[0].encoder()
    calls = Calls(encoder)
    prepared = encoder.prepare_scene(road_scene(OFFSETS))
    first = encoder.encode_scene(prepared, counters={})
    assert prepared.members
    assert prepared.encoded.pose
    assert encoder.encode_scene(prepared, counters={}) == first
    assert (calls.sent, calls.left) == (3, 0)


class NoErrors(Scene):
    """A scene whose pose error is not at hand."""

    @property
    def pose_error(self) -> Any:
        raise LookupError("no pose error")


def strange_scenes() -> Iterator[Any]:
    """Scenes of which something is unusual, or wrong."""
    scene = road_scene([Slot.EGO_LEFT, Slot.CENTRE])
    yield from (None, 3, [], SimpleNamespace(lines=()))
    one = object.__new__(NoErrors)
    vars(one).update(vars(scene))
    yield one
    line, (first, second) = road_scene([Slot.ROUTE]).lines[0], scene.lines
    mixture = SimpleNamespace(weights=np.ones(1), components=(first.gaussian,))
    bad_mean = Gaussian.trusted(np.zeros(3), np.eye(4))
    for name, value in (
        ("lines", [first, second]), ("lines", (first,)), ("lines", (first, first)),
        ("lines", (first, second, line)), ("lines", (first, None)), ("lines", ()),
        ("lines", (first, replace(second, x_min=second.x_max))),
        ("lines", (first, changed(second, "mixture", mixture))),
        ("lines", (first, changed(second, "gaussian", bad_mean))),
        ("lines", (first, changed(second, "x_min", np.float32(-8.0)))),
        ("lines", (first, changed(second, "x_max", np.nan))),
        ("cov", scene.cov.astype(np.float32)), ("cov", scene.cov[:4, :4]), ("cov", None),
        ("cov", scene.cov * np.nan), ("cov", np.asfortranarray(scene.cov)), ("cov", -scene.cov),
        ("cov", scene.cov + 1e-12 * np.eye(8, k=1)),
        ("fit_ranges", scene.fit_ranges[:1]), ("fit_ranges", scene.fit_ranges[:, ::-1]),
        ("fit_ranges", scene.fit_ranges.T), ("fit_ranges", scene.fit_ranges * np.inf),
        ("quartics", np.zeros(3)), ("quartics", np.array([np.nan, 0.0])),
        ("quartics", np.zeros(4)[::2]),
        ("specific_covs", None), ("specific_covs", np.zeros((2, 4, 4))),
        ("specific_covs", np.zeros((2, 4))), ("specific_covs", np.full((2, 4, 4), np.nan)),
        ("pose_error", None), ("pose_error", SimpleNamespace(cov=np.eye(3))),
        ("pose_error", SimpleNamespace(cov=np.eye(3), correlation_time=np.nan)),
        ("pose_error", SimpleNamespace(cov=np.eye(3), correlation_time=-1.0)),
        ("pose_error", SimpleNamespace(cov=np.eye(3) * 1e-4, correlation_time=2)),
        ("pose_error", SimpleNamespace(cov=np.eye(4), correlation_time=2.0)),
        ("pose_error", PoseError(1e60 * np.eye(3))),
        ("map_error", SimpleNamespace(offset_sigma=0.1)),
        ("map_error", SimpleNamespace(offset_sigma=0.1, heading_sigma=-1.0)),
        ("map_error", SimpleNamespace(offset_sigma=np.nan, heading_sigma=0.0)),
        ("map_error", SimpleNamespace(offset_sigma=1, heading_sigma=0)),
    ):  # fmt: skip
        yield changed(scene, name, value)


def changed(given: Any, name: str, value: Any) -> Any:
    """Return a copy with an attribute that no constructor has checked."""
    copy = object.__new__(type(given))
    vars(copy).update(vars(given) | {name: value})
    return copy


@pytest.mark.parametrize("dbc", [COMPLETE, CONDITIONAL])
def test_what_is_unusual_or_wrong(dbc: str) -> None:
    """The same frames or the same error, and the same counters after it."""
    codecs = codecs_of(layout_of(dbc))
    encoders = codecs[0].encoder(), codecs[1].encoder()
    calls, errors = Calls(encoders[0]), Counter[str]()
    for scene in strange_scenes():
        sent = check_same(encoders, "encode_scene", scene)
        errors[sent[0].__name__ if isinstance(sent, tuple) else "sent"] += 1
    assert calls.sent >= 8
    assert errors["sent"] >= 8
    assert errors.total() - errors["sent"] >= 10


def test_threads_prepare_at_the_same_time() -> None:
    """The lock of the interpreter is released while a scene is prepared: nothing is shared."""
    codec = codecs_of(layout_of(CONDITIONAL))[0]
    found = roads()
    one_by_one = [frames_of(codec, scene) for scene in found]
    with ThreadPoolExecutor(4) as pool:
        together = list(pool.map(lambda scene: frames_of(codec, scene), found * 3))
    assert together == one_by_one * 3


def frames_of(codec: Codec, scene: Scene) -> Any:
    return outcome(lambda: list(chain(*codec.encoder().encode_scene(scene).values())))


def test_nothing_leaks() -> None:
    """Scenes that are sent, unusual or wrong leave nothing behind."""
    encoder = codecs_of(layout_of(CONDITIONAL))[0].encoder()
    complete = codecs_of(layout_of(COMPLETE))[0].encoder()
    scene, strange = road_scene([Slot.EGO_LEFT, Slot.ROUTE]), [*strange_scenes()]
    sender: Any = encoder._c
    ages: dict[Any, float] = {POSE: 0.1, Slot.EGO_LEFT: -1.0}

    def cycle() -> None:
        for each in (encoder, complete):
            prepared = each.prepare_scene(scene)
            each.encode_scene(prepared, age=0.02)
            assert each._c is not None
            each._c.write_scene(prepared, packed({}), -1.0)
            each._c.write_scene(prepared, packed({}), ages)
            assert prepared.members
            assert prepared.encoded.pose
            assert prepared.left_out == {}
        for one in strange:
            outcome(partial(sender.prepare, one, full=False))

    assert_no_growth(cycle, 60)
