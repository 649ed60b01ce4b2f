"""The propagation: the core against Python alone."""

import copy
import gc
import math
import pickle
import re
import tracemalloc
import warnings
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise, product
from pathlib import Path
from types import MappingProxyType
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from maplines_can.native import lib

from maplines_can import maps
from maplines_can.maps.tracking import LaneTracker
from maplines_can.propagation import (
    Linear,
    MapError,
    Quadrature,
    Refit,
    SigmaPoints,
    from_map,
    in_c,
    map_lines,
    map_scene,
)
from maplines_can.propagation.cubic_fit import _COARSE, _COARSE_FIT, FIT
from maplines_can.propagation.refit_model import _TO_QUARTIC
from maplines_can.propagation.stretches import stretches
from maplines_can.simulation.scenarios import SCENARIOS, STREETS
from maplines_can.values.errors import IllPosedError
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import Kind, LeftOut, MapLine, Slot
from maplines_can.values.polyline import INDEXED, Polyline
from maplines_can.values.scene import Scene

pytestmark = pytest.mark.skipif(lib is None, reason="the core is not there")

ROOT = Path(__file__).resolve().parents[2]
#: Greatest difference, in standard deviations.
LIMIT = 1e-12
#: Greatest difference of ranges [m].
RANGE_LIMIT = 1e-9
MAP_ERRORS = (None, MapError(), MapError(0.05, 0.1, 0.001), MapError(point_sigma=0.2))
TRANSFORMS = (SigmaPoints(), SigmaPoints(0.01, -1.0, 3.0), Quadrature(1), Quadrature(4))


def on_both_paths(call: Callable[[], Any]) -> tuple[Any, Any]:
    """Return what a call returns in C and in Python, with the warnings; or its errors."""

    def outcome() -> Any:
        with warnings.catch_warnings(record=True) as caught, np.errstate(all="ignore"):
            warnings.simplefilter("always")
            try:
                found = call()
            except Exception as error:  # noqa: BLE001 - any error must be the same
                found = type(error), str(error)
            return found, [str(warning.message) for warning in caught]

    (native, in_native) = outcome()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(in_c, "lib", None)
        (python, in_python) = outcome()
    assert in_native == in_python
    return native, python


def assert_covariances(one: Any, other: Any, limit: float = LIMIT) -> None:
    """Covariances (..., n, n) agree in units of their standard deviations."""
    assert np.shape(one) == np.shape(other)
    sigma = np.sqrt(np.diagonal(other, axis1=-2, axis2=-1))
    scale = np.where(sigma > 0, sigma, 1.0)
    difference = np.abs(one - other) / scale[..., None, :] / scale[..., :, None]
    assert (difference <= limit).all()


def assert_line(native: MapLine, python: MapLine) -> None:
    """Two lines agree, and the arrays of the one in C are as those of any Gaussian."""
    for name in ("slot", "kind", "age", "status", "t_ns", "mixture"):
        assert getattr(native, name) == getattr(python, name)
    one, other = native.gaussian, python.gaussian
    assert (np.abs(one.mean - other.mean) <= LIMIT * other.sigma).all()
    assert_covariances(one.cov, other.cov)
    assert (one.cov == one.cov.T).all()
    assert native.x_min == pytest.approx(python.x_min, abs=RANGE_LIMIT)
    assert native.x_max == pytest.approx(python.x_max, abs=RANGE_LIMIT)
    assert not one.mean.flags.writeable
    assert not one.cov.flags.writeable


def assert_lines(lines: Any, ego: Gaussian, **rest: Any) -> int:
    """The lines of both paths agree; return their number, or -1 for an error."""
    native, python = on_both_paths(lambda: map_lines(lines, ego, **rest))
    if isinstance(python, tuple):
        assert native == python
        return -1
    assert list(native.left_out.items()) == list(python.left_out.items())
    assert len(native) == len(python)
    for one, other in zip(native, python, strict=True):
        assert_line(one, other)
    return len(python)


def assert_scene(lines: Any, ego: Gaussian, **rest: Any) -> int:
    """The scenes of both paths agree; return the number of lines, or -1 for an error."""
    native, python = on_both_paths(lambda: map_scene(lines, ego, **rest))
    if isinstance(python, tuple):
        assert native == python
        return -1
    assert list(native.left_out.items()) == list(python.left_out.items())
    assert native.map_error == python.map_error
    assert (native.pose_error.cov == python.pose_error.cov).all()
    assert native.pose_error.correlation_time == python.pose_error.correlation_time
    assert (native.fit_ranges == python.fit_ranges).all()
    assert native.quartics == pytest.approx(python.quartics, abs=1e-12)
    assert_covariances(native.cov, python.cov)
    assert (native.specific_covs is None) == (python.specific_covs is None)
    if python.specific_covs is not None:
        assert_covariances(native.specific_covs, python.specific_covs)
    for one, other in zip(native.lines, python.lines, strict=True):
        assert_line(one, other)
    for name in ("cov", "fit_ranges", "quartics"):
        array = getattr(native, name)
        assert not array.flags.writeable
        assert array.dtype == float
    Scene(**{name: getattr(native, name) for name in Scene.__dataclass_fields__})  # is valid
    return len(python.lines)


# ---- tables ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("fit_rows", FIT.T),
        ("quartic_row", _TO_QUARTIC),
        ("coarse_nodes", _COARSE),
        ("coarse_rows", _COARSE_FIT.T),
    ],
)
def test_tables_of_c_are_those_of_python(name: str, values: Any) -> None:
    source = (ROOT / "c" / "propagation" / "nodes.c").read_text()
    (text,) = re.findall(rf"maplines_{name}\[[^]]*\] = {{([^}}]*)}}", source)
    assert [float.fromhex(number) for number in text.split(",") if number.strip()] == (
        values.ravel().tolist()
    )


# ---- scenarios, the town, generated roads ---------------------------------------------


@pytest.mark.parametrize("scenario", [*SCENARIOS.values(), *STREETS.values()], ids=lambda x: x.name)
def test_scenarios(scenario: Any) -> None:
    lines, ego = dict(scenario.lines), scenario.ego
    for error, transform in product(MAP_ERRORS, TRANSFORMS):
        rest: dict[str, Any] = {
            "window": scenario.window,
            "map_error": error,
            "transform": transform,
        }
        assert assert_lines(lines, ego, **rest) >= 0
        assert assert_scene(lines, ego, **rest) >= 0
        for max_sigma in (0.3, 1.0, math.inf):
            assert_lines(lines, ego, max_sigma=max_sigma, **rest)
            assert_scene(lines, ego, max_sigma=max_sigma, **rest)


def tour() -> Iterator[tuple[dict[Slot, Polyline], Gaussian]]:
    """Yield the lines around a car on the tour through the town, and its pose."""
    town = maps.load(maps.town_path())
    route = maps.town_tour(town)
    tracker, points = LaneTracker(town, route), route.line.points
    cov = np.diag([0.3, 0.2, math.radians(0.5)]) ** 2
    for a, b in pairwise(points[:: len(points) // 150]):
        pose = np.array([*a, math.atan2(*(b - a)[::-1])])
        yield dict(tracker.lines(pose).lines), Gaussian(pose, cov)


def test_the_tour_through_the_town() -> None:
    given = scenes = 0
    for lines, ego in tour():
        error = MAP_ERRORS[len(lines) % 3]
        for max_sigma in (10.0, 0.5):
            rest: dict[str, Any] = {
                "map_error": error,
                "window": (-4.0, 80.0),
                "max_sigma": max_sigma,
            }
            given += assert_lines(lines, ego, **rest)
            scenes += assert_scene(lines, ego, **rest)
    assert given > 1000
    assert scenes > 1000


def curved(rng: np.random.Generator) -> Any:
    """Points of a road of changing curvature."""
    count, spacing = int(rng.integers(5, 150)), rng.uniform(0.3, 8.0)
    s = spacing * np.arange(count)
    angle = rng.normal(0, 0.3) + np.cumsum(rng.normal(0, 0.02) + rng.normal(0, 5e-4) * s) * spacing
    points = np.cumsum(np.column_stack([np.cos(angle), np.sin(angle)]) * spacing, axis=0)
    return points - points[rng.integers(0, count)] + [0.0, rng.normal(0, 5)]


def zigzag(rng: np.random.Generator) -> Any:
    """Points with kinks, rounded, so that many candidates of the search are alike."""
    steps = rng.normal([4.0, 0.0], [4.0, 2.0], (int(rng.integers(2, 60)), 2))
    points = np.cumsum(steps, axis=0) - [rng.uniform(0, 60), rng.normal(0, 4)]
    return points.round(int(rng.integers(0, 4)))


def hairpin(rng: np.random.Generator) -> Any:
    """Points of a road that turns back."""
    radius, x = rng.uniform(3, 30), np.arange(-60.0, 40.0, 2.0)
    angle = np.linspace(-np.pi / 2, np.pi / 2, 20)
    turn = np.column_stack([40 + radius * np.cos(angle), radius * np.sin(angle)])
    ahead, back = (np.column_stack([x, np.full(len(x), y)]) for y in (-radius, radius))
    points = np.concatenate([ahead, turn, back[::-1]])
    return points + np.array([0.0, rng.normal(0, radius)])


def noisy(rng: np.random.Generator) -> Any:
    """Close points with errors, some of which run back."""
    x = np.linspace(-30.0, 90.0, 400)
    points = np.column_stack([x, np.full(len(x), rng.normal(0, 3))])
    return points + rng.normal(0, rng.choice([0.01, 0.1, 0.3]), points.shape)


def repeated(rng: np.random.Generator) -> Any:
    """Points of which some stand twice or more."""
    points = curved(rng)
    return np.repeat(points, rng.integers(1, 4, len(points)), axis=0)


def segment(rng: np.random.Generator) -> Any:
    """Two points, in any direction: also across the x axis, or within the window."""
    return rng.normal(0, 60, (2, 2))


def circle(rng: np.random.Generator) -> Any:
    """An arc that is symmetric about the car."""
    radius, half = rng.choice([20.0, 50.0, 100.0, 300.0]), rng.uniform(0.1, 1.5)
    angle = np.linspace(-half, half, int(rng.integers(3, 80)))
    return np.column_stack([radius * np.sin(angle), radius - radius * np.cos(angle)])


KINDS = (curved, zigzag, hairpin, noisy, repeated, segment, circle)


def random_pose(rng: np.random.Generator) -> Gaussian:
    """A pose near the origin or far away, with an error that is huge, tiny or singular."""
    sigma = 10 ** rng.uniform(-2.5, 0.3, 3) * [1, 1, 0.1] * rng.choice([1e-4, 1, 1, 1, 1, 10])
    sigma[rng.random(3) < 0.05] = 0.0
    factor = rng.normal(size=(3, 3))
    cov = factor @ factor.T if rng.random() < 0.5 else np.eye(3)
    scale = sigma / np.sqrt(np.diagonal(cov))
    cov = cov * scale * scale[:, None]
    place = rng.choice([0.0, 0.0, 1e3, 1e6]) * rng.normal(size=2)
    return Gaussian([*place, rng.uniform(-4, 4)], (cov + cov.T) / 2)


def random_case(seed: int) -> tuple[dict[Slot, Polyline], Gaussian, dict[str, Any]]:
    """Lines, a pose, and the other arguments of ``map_lines``."""
    rng = np.random.default_rng(seed)
    ego = random_pose(rng)
    heading = ego.mean[2]
    turn = np.array([[np.cos(heading), np.sin(heading)], [-np.sin(heading), np.cos(heading)]])
    lines = {}
    for slot in rng.permutation(8)[: rng.integers(1, 9)].tolist():
        points = KINDS[rng.integers(len(KINDS))](rng) @ turn + ego.mean[:2]
        kind = Kind(int(rng.integers(len(Kind))))
        lines[Slot(slot)] = Polyline(points[:: rng.choice([1, 1, -1])], kind)
    rest: dict[str, Any] = {"map_error": MAP_ERRORS[rng.integers(len(MAP_ERRORS))]}
    if rng.random() < 0.3:  # most of these do not contain the car
        rest["window"] = tuple(np.sort(rng.uniform(-80, 120, 2)).tolist())
    if rng.random() < 0.4:
        rest["max_sigma"] = float(10 ** rng.uniform(-1.5, 0.7))
    if rng.random() < 0.3:
        rest["max_misfit"] = float(rng.choice([1e-4, 0.01, 0.5, np.inf]))
    if rng.random() < 0.3:
        spread = float(10 ** rng.uniform(-3, 0))
        rest["transform"] = SigmaPoints(spread, float(rng.uniform(-2.5, 3)), 1.0)
    elif rng.random() < 0.1:
        rest["transform"] = Quadrature(int(rng.integers(1, 6)))
    return lines, ego, rest


@given(st.integers(0, 2**32))
def test_random_lines(seed: int) -> None:
    lines, ego, rest = random_case(seed)
    assert_lines(lines, ego, **rest)
    assert_scene(lines, ego, **rest)


def test_random_lines_are_computed_in_c() -> None:
    """C gives up for hardly any: else the other tests would compare Python with itself."""
    outcomes = []
    for seed in range(100):
        lines, ego, rest = random_case(seed)
        settings: dict[str, Any] = {"window": (-20.0, 80.0), "max_misfit": 0.1, "max_sigma": 10.0}
        settings |= rest
        transform = settings.pop("transform", SigmaPoints())
        cycle = in_c.CycleInC.of(lines, ego, **settings)
        found = None if cycle is None else cycle.map_lines(transform)
        scene = None if cycle is None else cycle.map_scene(transform, 1.0)
        outcomes.append((found is not None) & (scene is not None))
    assert np.mean(outcomes) > 0.9


@given(st.integers(0, 2**32))
def test_random_refits(seed: int) -> None:
    """All that a refit has, and its lines from any pose, are the same to the last bit."""
    lines, ego, rest = random_case(seed)
    choice = {name: rest[name] for name in ("map_error", "max_misfit", "window") if name in rest}
    native, python = on_both_paths(lambda: Refit([*lines.values()], ego.mean, **choice))
    if isinstance(python, tuple):
        assert native == python
        return
    for name in ("x_range", "misfit", "points", "is_across", "quartic", "pose"):
        one, other = getattr(native, name), getattr(python, name)
        assert one.dtype == other.dtype
        assert one.shape == other.shape
        assert (one == other).all()
    if python.noise_cov is None or np.isnan(python.noise_cov).any():
        assert (native.noise_cov is None) == (python.noise_cov is None)
    else:
        assert_covariances(native.noise_cov, python.noise_cov)
    poses = ego.mean + np.random.default_rng(seed).normal(0, [2.0, 2.0, 0.7], (20, 3))
    with np.errstate(all="ignore"):
        assert np.array_equal(native(poses), python(poses), equal_nan=True)


# ---- long lines, mixtures, other transforms -------------------------------------------


def test_long_lines_are_searched_near_the_car() -> None:
    x = np.linspace(-3000.0, 3000.0, INDEXED + 1000)
    lines = {
        slot: Polyline(np.column_stack([x, y + 20 * np.sin(x / 200)]), Kind.SOLID)
        for slot, y in ((Slot.EGO_LEFT, 1.75), (Slot.EGO_RIGHT, -1.75))
    }
    for place in (-2990.0, 0.0, 400.0, 2999.0, 5000.0):
        ego = Gaussian([place, 20 * math.sin(place / 200), 0.1], np.diag([0.1, 0.2, 0.01]) ** 2)
        assert assert_lines(lines, ego) >= 0
        assert assert_scene(lines, ego) >= 0
        native, python = on_both_paths(lambda: Refit(lines[Slot.EGO_LEFT], ego.mean))  # noqa: B023
        if isinstance(python, tuple):
            assert native == python
        else:
            assert isinstance(native._lines, in_c.RefitInC)
            assert native(ego.mean).tolist() == python(ego.mean).tolist()


@pytest.mark.parametrize("transform", [None, Linear(), Quadrature(3)], ids=repr)
def test_what_c_does_not_do_uses_refits_in_c(transform: Any) -> None:
    scenario = SCENARIOS["highway"]
    lines, ego = dict(scenario.lines), scenario.ego
    counts = {slot: 1 + i % 3 for i, slot in enumerate(lines)}
    native, python = on_both_paths(
        lambda: map_lines(lines, ego, transform=transform, components=counts)
    )
    for one, other in zip(native, python, strict=True):
        assert (one.x_min, one.x_max) == (other.x_min, other.x_max)
        assert np.abs(one.gaussian.mean - other.gaussian.mean).max() <= LIMIT
        assert_covariances(one.gaussian.cov, other.gaussian.cov)
    seen = stretches([*lines.values()], ego.mean, scenario.window)
    native, python = on_both_paths(lambda: Refit(seen, ego.mean))
    assert isinstance(native._lines, in_c.RefitInC)
    assert (native(ego.sample(50)) == python(ego.sample(50))).all()


@pytest.mark.parametrize("transform", TRANSFORMS, ids=repr)
@pytest.mark.parametrize("many", [False, True])
def test_moments_of_a_refit(transform: Any, many: bool) -> None:
    scenario = SCENARIOS["highway"]
    lines = [*scenario.lines.values()]
    native, python = on_both_paths(
        lambda: transform.moments(
            Refit(lines if many else lines[0], scenario.ego.mean, map_error=MapError(0.1, 0.1)),
            scenario.ego,
        )
    )
    assert native.mean.shape == python.mean.shape
    sigma = np.sqrt(np.diagonal(python.cov, axis1=-2, axis2=-1))
    assert (np.abs(native.mean - python.mean) <= LIMIT * sigma).all()
    assert_covariances(native.cov, python.cov)
    assert native.mean.flags.writeable


@pytest.mark.parametrize("sigma", [0.3, 0.55, 2.0])
def test_points_without_a_value_warn_or_raise_on_both_paths(sigma: float) -> None:
    road = Polyline(np.column_stack([np.arange(0.0, 90.0, 2.0), np.full(45, 2.0)]))
    ego = Gaussian(np.zeros(3), np.diag([0.1, 0.1, sigma]) ** 2)
    for transform in (SigmaPoints(), Quadrature(9)):
        native, python = on_both_paths(lambda: transform.moments(Refit(road, ego.mean), ego))  # noqa: B023
        if isinstance(python[0], type):
            assert native == python
            assert python[0] is IllPosedError
        else:
            assert_covariances(native.cov, python.cov)


# ---- errors ---------------------------------------------------------------------------

ROAD = Polyline([[-100, 1.75], [200, 1.75]])
EGO = Gaussian(np.zeros(3), np.diag([0.1, 0.2, 0.01]) ** 2)


@pytest.mark.parametrize(
    "change",
    [
        {"lines": [ROAD]},
        {"lines": {}},
        {"lines": {Slot.EGO_LEFT: [[0, 0], [1, 0]]}},
        {"lines": {9: ROAD}},
        {"lines": {"EGO_LEFT": ROAD}},
        {"ego": Gaussian([0.0], [[1.0]])},
        {"ego": Gaussian(np.zeros(3), np.zeros((3, 3)))},
        {"window": (80.0, -20.0)},
        {"window": (0.0, 0.0)},
        {"window": (0.0, math.inf)},
        {"window": (0.0, math.nan)},
        {"window": (0.0, "80")},
        {"window": (0.0, 1.0, 2.0)},
        {"window": 80.0},
        {"max_misfit": 0.0},
        {"max_misfit": math.nan},
        {"max_misfit": "0.1"},
        {"max_sigma": 0.0},
        {"max_sigma": math.nan},
        {"max_sigma": None},
        {"transform": SigmaPoints(kappa=-3.0)},
        {"components": 0},
        {"components": 9},
        {"lines": {Slot.EGO_LEFT: Polyline(np.array([[0, 0], [1e155, 0], [1e155, 1e155]]))}},
        {"lines": {Slot.EGO_LEFT: Polyline([[0, 0], [0, 0]])}},
        {"lines": {0: ROAD, Slot.EGO_RIGHT: Polyline([[0, -3], [0, -9]])}},
    ],
    ids=repr,
)
def test_wrong_and_extreme_arguments(change: dict[str, Any]) -> None:
    arguments: dict[str, Any] = {"lines": {Slot.EGO_LEFT: ROAD}, "ego": EGO} | change
    assert_lines(**arguments)
    if "components" not in change:
        assert_scene(**arguments)


@pytest.mark.parametrize("time", [0.0, -1.0, math.nan])
def test_a_wrong_correlation_time(time: float) -> None:
    assert assert_scene({Slot.CENTRE: ROAD}, EGO, correlation_time=time) == -1


def test_reasons() -> None:
    lines = {
        Slot.NEXT_LEFT: Polyline([[200, 0], [300, 0]]),
        Slot.EGO_RIGHT: Polyline([[0, -3], [0, -9]]),
        Slot.EGO_LEFT: ROAD,
        Slot.NEXT_RIGHT: Polyline([[10, -3], [11, -3]]),
    }
    found = map_lines(lines, EGO)
    assert found.left_out == map_scene(lines, EGO).left_out
    assert list(found.left_out.values()) == [
        LeftOut.NOT_IN_WINDOW,
        LeftOut.ACROSS,
        LeftOut.TOO_SHORT,
    ]
    assert set(map_lines(lines, EGO, max_sigma=0.1).left_out.values()) >= {LeftOut.UNCERTAIN}
    for max_sigma in (0.1, 0.25, 10.0):
        assert_lines(lines, EGO, max_sigma=max_sigma)
        assert_scene(lines, EGO, max_sigma=max_sigma)


def test_reasons_are_in_the_order_of_the_lines_also_without_a_line() -> None:
    lines = {
        Slot.NEXT_LEFT: Polyline([[200, 0], [300, 0]]),
        Slot.EGO_RIGHT: Polyline([[0, -3], [0, -9]]),
        Slot.EGO_LEFT: Polyline([[-300, 0], [-200, 0]]),
    }
    assert assert_scene(lines, EGO) == assert_lines(lines, EGO) == 0
    assert list(map_scene(lines, EGO).left_out) == [*lines]


@pytest.mark.parametrize("end", [1e-9, 1.2e-16, 1e-18, 1e-60])
def test_a_range_of_less_than_a_nanometre(end: float) -> None:
    """Its second differences would be those over more steps than an integer has."""
    seen = replace(stretches([ROAD], np.zeros(3), (-20.0, 80.0)), x_range=np.array([[0.0, end]]))
    native, python = on_both_paths(lambda: Refit(seen, np.zeros(3)))
    assert isinstance(python, Refit)
    assert python.noise_cov is not None
    assert np.array_equal(native.noise_cov, python.noise_cov, equal_nan=True)


@pytest.mark.parametrize("poses", [np.zeros(2), np.zeros((4, 2)), np.zeros((2, 2, 3))], ids=repr)
def test_poses_of_a_wrong_shape(poses: Any) -> None:
    native, python = on_both_paths(lambda: Refit(ROAD, np.zeros(3))(poses))
    assert native == python
    assert isinstance(native, tuple)


# ---- memory and threads ---------------------------------------------------------------


def test_calls_keep_no_memory() -> None:
    """Neither good calls nor those that the core gives up keep a block of memory."""
    lines, points = {Slot.EGO_LEFT: ROAD}, np.zeros((5, 3))
    far = {Slot.EGO_LEFT: Polyline(np.array([[0, 0], [1e155, 0]]))}

    def calls() -> None:
        map_lines(lines, EGO)
        map_scene(lines, EGO)
        refit = Refit(ROAD, np.zeros(3))
        refit(points)
        SigmaPoints().moments(refit, EGO)
        with np.errstate(all="ignore"):
            map_lines(far, EGO)

    calls()
    tracemalloc.start()
    try:
        growth = []
        for _ in range(4):  # the interpreter fills caches of its own meanwhile
            gc.collect()
            before, _ = tracemalloc.get_traced_memory()
            for _ in range(200):
                calls()
            gc.collect()
            growth.append(tracemalloc.get_traced_memory()[0] - before)
    finally:
        tracemalloc.stop()
    assert min(growth) < 8000, growth


def test_a_refit_outlives_its_lines_and_may_be_copied() -> None:
    """It has no pointers to what it was made of."""
    poses = EGO.sample(20)
    refit = Refit([Polyline(ROAD.points), Polyline(ROAD.points + np.array([0, 3]))], EGO.mean)
    values = refit(poses)
    again = pickle.loads(pickle.dumps(refit))  # noqa: S301 - of this test
    in_c._paths.cache_clear()
    del refit
    gc.collect()
    assert isinstance(again._lines, in_c.RefitInC)
    assert (again(poses) == values).all()
    assert (copy.deepcopy(again)(poses) == values).all()


class Lines(Mapping[Slot, Polyline]):
    """A mapping that is no dictionary."""

    def __init__(self, lines: dict[Slot, Polyline]) -> None:
        self._lines = lines

    def __getitem__(self, slot: Slot) -> Polyline:
        return self._lines[slot]

    def __iter__(self) -> Iterator[Slot]:
        return iter(self._lines)

    def __len__(self) -> int:
        return len(self._lines)


@pytest.mark.parametrize("function", [map_lines, map_scene])
@pytest.mark.parametrize("of", [Lines, MappingProxyType, OrderedDict])
def test_lines_of_any_mapping(function: Any, of: Any) -> None:
    lines = dict(SCENARIOS["highway"].lines)
    ego = SCENARIOS["highway"].ego
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(from_map, "View", None)  # of the Python functions
        found, expected = function(of(lines), ego), function(lines, ego)
    for one, other in zip(
        getattr(found, "lines", found), getattr(expected, "lines", expected), strict=True
    ):
        assert one.slot is other.slot
        assert (one.gaussian.cov == other.gaussian.cov).all()


def test_threads_share_lines() -> None:
    """The interpreter runs other threads meanwhile; what they share is not written."""
    lines, ego, rest = random_case(3)
    refit = Refit([ROAD], EGO.mean)
    poses = EGO.sample(2000)
    expected = [line.gaussian.cov.tolist() for line in map_lines(lines, ego, **rest)]

    def work(i: int) -> bool:
        if i % 10 == 0:
            in_c._paths.cache_clear()
        own = [line.gaussian.cov.tolist() for line in map_lines(lines, ego, **rest)]
        return own == expected and bool((refit(poses) == values).all())

    values = refit(poses)
    with ThreadPoolExecutor(4) as pool:
        assert all(pool.map(work, range(100)))
