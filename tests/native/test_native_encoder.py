"""Lines to frames: the C core against Python alone, bit by bit."""

import gc
import sys
from collections import Counter, UserDict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache, partial
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from both_senders import Calls, assert_no_growth, check_same, codecs_of, outcome
from c_layouts import unusual_layouts, with_slots
from c_lines import awkward_lines
from hypothesis import given
from hypothesis import strategies as st
from maplines_can.native import lib
from random_dbc import random_dbc
from random_lines import random_lines
from scene_layouts import layout_of
from strategies import covariances, symmetric

from maplines_can import Codec, Gaussian, GaussianMixture, Kind, MapLine, Slot, Status
from maplines_can.wire import POSE, Frame, Layout
from maplines_can.wire.records.counters import packed

pytestmark = pytest.mark.skipif(lib is None, reason="there is no C path")

COMPLETE, CONDITIONAL, SECURED = "maplines.dbc", "maplines-pose.dbc", "maplines-secoc.dbc"
MEAN, COV = np.array([1.75, 0.01, 1e-3, 1e-6]), np.diag([0.1, 0.01, 1e-3, 1e-5]) ** 2


@cache
def layout_of_random(seed: int) -> Layout:
    return Layout.from_text(random_dbc(seed))


def lines_of(codec: Codec, n: int, seed: int) -> Iterator[MapLine]:
    """Lines of any kind; the covariances of some are indefinite, which only `trusted` takes."""
    lines = awkward_lines(codec, n, seed)
    for i in range(n):
        yield MapLine(
            Slot(lines.slot[i]),
            Gaussian.trusted(lines.means[i].copy(), lines.covs[i].copy()),
            Kind(lines.kind[i]),
            x_min=float(lines.x_min[i]),
            x_max=float(lines.x_max[i]),
            age=float(min(lines.age[i], 1e9)),
            status=Status(lines.status[i]),
        )


def ordinary(slot: Slot = Slot.EGO_LEFT, **rest: Any) -> MapLine:
    return MapLine(slot, Gaussian(MEAN, COV), **rest)


def mixture_of(k: int, seed: int = 0) -> GaussianMixture:
    means, covs = random_lines(k, seed)
    weights = np.random.default_rng(seed).dirichlet(np.ones(k)) + 1e-3
    components = [Gaussian(*one) for one in zip(means, covs, strict=True)]
    return GaussianMixture(weights / weights.sum(), components)


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize(
    ("dbc", "is_authenticated"), [(COMPLETE, False), (SECURED, False), (SECURED, True)]
)
def test_lines_of_any_kind(dbc: str, is_authenticated: bool, fd: bool) -> None:
    """Frames, counters and errors are the same."""
    codecs = codecs_of(layout_of(dbc), is_authenticated=is_authenticated)
    encoders = codecs[0].encoder(), codecs[1].encoder()
    calls, statuses = Calls(encoders[0]), Counter[Status]()
    for seed in range(4):
        for line in lines_of(codecs[0], 100, seed):
            sent = check_same(encoders, "encode", line, fd=fd)
            if isinstance(sent, list):
                statuses[line.status] += 1
    if not is_authenticated or fd:
        assert calls.sent >= 350
        assert len(statuses) == len(Status)
    else:
        assert not statuses  # classic CAN is not authenticated


@pytest.mark.parametrize("seed", [*range(12), 1000, 1001])
def test_lines_of_random_dbcs(seed: int) -> None:
    """The same with DBCs of any layout, those at the limits of C included."""
    codecs = codecs_of(layout_of_random(seed))
    encoders = codecs[0].encoder(), codecs[1].encoder()
    lines: list[MapLine] = []
    if codecs[0].layout.is_conditional:
        lines = [ordinary(slot) for slot in codecs[0].layout.messages]
    else:
        calls = Calls(encoders[0])
        lines = list(lines_of(codecs[0], 60, seed))
        check_same(encoders, "encode", lines[0])
        assert calls.sent == 1
    for fd in (False, True):
        for line in lines:
            check_same(encoders, "encode", line, fd=fd)
        check_same(encoders, "encode_lines", lines, fd=fd)


@pytest.mark.parametrize("layout", unusual_layouts().values(), ids=unusual_layouts())
def test_layouts_without_some_messages(layout: Layout) -> None:
    """A DBC without a slot or a kind of frame: the same errors, and counters that stay."""
    for is_authenticated in (False, True):
        codecs = outcome(lambda: codecs_of(layout, is_authenticated=is_authenticated))  # noqa: B023
        if isinstance(codecs[0], type):
            continue  # there is nothing to authenticate
        encoders = codecs[0].encoder(), codecs[1].encoder()
        for slot in Slot:
            for fd in (False, True):
                check_same(encoders, "encode", ordinary(slot), fd=fd)
                both = [ordinary(), ordinary(slot)]
                check_same(encoders, "encode_lines", both, fd=fd)


@pytest.mark.parametrize("dbc", [COMPLETE, SECURED])
def test_mixtures(dbc: str) -> None:
    """So are mixtures, alone and among other lines; one of too many components is an error."""
    codecs = codecs_of(layout_of(dbc))
    encoders = codecs[0].encoder(), codecs[1].encoder()
    calls = Calls(encoders[0])
    for k in range(1, 12):
        for status in (Status.FULL, Status.UNKNOWN, Status.DIAGONAL):
            line = MapLine.of_mixture(Slot.NEXT_LEFT, mixture_of(k, k), status=status)
            for fd in (False, True):
                together = [line, ordinary(Slot.NEXT_LEFT), line]
                check_same(encoders, "encode", line, fd=fd)
                check_same(encoders, "encode_lines", together, fd=fd)
    assert calls.sent == 8 * 3 * 2 * 2
    assert calls.left == 3 * 3 * 2 * 2


def test_components_that_are_unusual() -> None:
    """A mixture whose weights or components were changed is written as Python does."""
    codecs = codecs_of(layout_of(COMPLETE))
    for name, value in (
        ("weights", np.array([0.5, 0.6])),
        ("weights", np.array([1.5, -0.5])),
        ("weights", np.array([0.5, 0.25, 0.25])),
        ("components", ()),
        ("components", [Gaussian(MEAN, COV), Gaussian(MEAN, COV)]),
        ("components", (Gaussian(MEAN, COV), Gaussian(MEAN[:2], COV[:2, :2]))),
    ):
        mixture = mixture_of(2)
        line = MapLine.of_mixture(Slot.CENTRE, mixture)
        object.__setattr__(mixture, name, value)
        vars(mixture).pop("means", None)
        vars(mixture).pop("covs", None)
        encoders = codecs[0].encoder(), codecs[1].encoder()
        check_same(encoders, "encode", line)


@pytest.mark.parametrize(
    "start", [0, 1, 14, 15, 16, 255, 256, 2**16 - 1, 2**32 - 1, 2**64 + 15, 10**40, -1, -(2**70)]
)
def test_counters(start: int) -> None:
    """Counters wrap in the same way, from any number on, and those of a caller stay."""
    codecs = codecs_of(layout_of(COMPLETE))
    encoders = codecs[0].encoder(), codecs[1].encoder()
    lines = [ordinary(), MapLine.of_mixture(Slot.EGO_LEFT, mixture_of(3)), ordinary(Slot.ROUTE)]
    for encoder in encoders:
        encoder._counters = packed({Slot.EGO_LEFT: start})
    for _ in range(20):
        check_same(encoders, "encode_lines", lines)
    for kind in (dict, Counter, MappingProxyType, UserDict):
        given: Any = kind({Slot.EGO_LEFT: start, Slot.ROUTE: 3, POSE: 5})
        check_same(encoders, "encode_lines", lines, counters=given)
        assert dict(given) == {Slot.EGO_LEFT: start, Slot.ROUTE: 3, POSE: 5}


@pytest.mark.parametrize("counters", [{Slot.EGO_LEFT: 1.5}, {Slot.EGO_LEFT: "1"}, 5, [0]])
def test_counters_that_are_none(counters: Any) -> None:
    codecs = codecs_of(layout_of(COMPLETE))
    encoders = codecs[0].encoder(), codecs[1].encoder()
    check_same(encoders, "encode_lines", [ordinary()], counters=counters)


class Raising(MapLine):
    """A line that has no age at hand."""

    def __getattribute__(self, name: str) -> Any:
        if name == "age":
            raise LookupError("no age")
        return super().__getattribute__(name)


def made_of(kind: type[MapLine], line: MapLine) -> MapLine:
    """Return a line of a subclass without its constructor."""
    made = object.__new__(kind)
    vars(made).update(vars(line))
    return made


class Renamed(MapLine):
    """A line of a subclass."""


class Clock:
    """A number that knows how to be a float."""

    def __float__(self) -> float:
        return 0.02


def unusual_lines() -> Iterator[Any]:
    """Lines and other things of which something is unusual, or wrong."""
    yield from (None, 1, "line", [], SimpleNamespace(slot=0), ordinary)
    yield made_of(Raising, ordinary())
    yield Renamed(Slot.EGO_LEFT, Gaussian(MEAN, COV))
    for values in (
        {"x_min": 0, "x_max": 80},
        {"x_min": np.float32(0.1), "x_max": np.float64(80.04)},
        {"x_min": np.array(2.0), "x_max": 20},
        {"age": 1},
        {"age": True},
        {"age": np.float64(0.02)},
        {"age": np.float32(0.02)},
        {"age": np.inf},
        {"kind": 3, "status": 2},
    ):
        yield ordinary(**values)
    for name, value in (
        ("slot", 9), ("slot", -1), ("slot", 2), ("slot", 1.0), ("slot", "EGO_LEFT"), ("slot", None),
        ("kind", 8), ("kind", 2), ("kind", -1), ("status", 6), ("status", 1.0), ("status", -1),
        ("x_min", np.nan), ("x_min", 90.0), ("x_max", np.inf), ("x_min", "0"), ("x_max", 10**400),
        ("age", -1.0), ("age", np.nan), ("age", None), ("age", Clock()), ("age", 1j),
        ("gaussian", None), ("mixture", 1), ("mixture", mixture_of(2)),
    ):  # fmt: skip
        line = ordinary()
        object.__setattr__(line, name, value)
        yield line
    for mean, cov in (
        (MEAN.astype(np.float32), COV),
        (MEAN, COV.astype(np.float32)),
        (MEAN[:3].copy(), COV),
        (MEAN, COV[:3, :3].copy()),
        (MEAN, COV.copy(order="F")),
        (np.repeat(MEAN, 2)[::2], np.kron(COV, np.ones((2, 3)))[::2, ::3]),
        (MEAN[::-1], COV[::-1, ::-1]),
        (MEAN * [np.nan, 1, 1, 1], COV),
        (MEAN * [1, 1, np.inf, 1], COV),
        (MEAN, COV * np.nan),
        (MEAN, -COV),
        (MEAN, COV + 1e-9 * np.eye(4, k=1)),
        (MEAN, COV + 1e-9 * np.eye(4, k=1) + 2e-9 * np.eye(4, k=-1)),
        (MEAN, 0 * COV),
        (MEAN, COV * 1e307 * 1e3),
    ):
        with np.errstate(all="ignore"):
            line = ordinary()
            arrays: Any = mean[...], cov[...]
            object.__setattr__(line, "gaussian", Gaussian.trusted(*arrays))
            yield line
    for attributes in ({}, {"mean": MEAN}, {"mean": MEAN, "cov": None}, {"mean": 3, "cov": 3}):
        line = ordinary()
        object.__setattr__(line, "gaussian", SimpleNamespace(**attributes))
        yield line


@pytest.mark.parametrize("line", [*unusual_lines()])
def test_what_is_unusual_or_wrong(line: Any) -> None:
    """The same frames, or the same error; and after an error the same counters as before."""
    codecs = codecs_of(layout_of(COMPLETE))
    encoders = codecs[0].encoder(), codecs[1].encoder()
    check_same(encoders, "encode", line)
    check_same(encoders, "encode", line, fd=True)
    check_same(encoders, "encode_lines", [ordinary(), line])
    check_same(encoders, "encode_lines", (line, ordinary()))
    check_same(encoders, "encode", ordinary())


@pytest.mark.parametrize("lines", [[], (), None, 3, {}, "ab", range(2), np.zeros(2)], ids=str)
def test_lines_that_are_no_sequence_of_lines(lines: Any) -> None:
    codecs = codecs_of(layout_of(COMPLETE))
    encoders = codecs[0].encoder(), codecs[1].encoder()
    check_same(encoders, "encode_lines", lines)


def test_an_interrupt_is_not_lost() -> None:
    """What is no error of a program, such as Ctrl-C while a line is read, goes on at once."""

    class Interrupted(MapLine):
        def __getattribute__(self, name: str) -> Any:
            if name == "mixture" and "mixture" in vars(self):
                raise KeyboardInterrupt
            return super().__getattribute__(name)

    line = made_of(Interrupted, ordinary())
    encoder = codecs_of(layout_of(COMPLETE))[0].encoder()
    with pytest.raises(KeyboardInterrupt):
        encoder.encode(line)
    assert encoder._counters == packed({})


def test_a_line_that_changes_the_list_of_lines() -> None:
    """Reading a line may run any code: the lines that are sent are those that were given."""

    class Sly(MapLine):
        def __getattribute__(self, name: str) -> Any:
            if name == "mixture":
                lines.clear()
                gc.collect()
            return super().__getattribute__(name)

    line = made_of(Sly, ordinary())
    lines: list[MapLine] = [line, ordinary(Slot.ROUTE, x_max=50.0), ordinary(Slot.CENTRE)]
    encoder = codecs_of(layout_of(COMPLETE))[0].encoder()
    sent = encoder.encode_lines(lines)
    assert lines == []
    assert len(sent) == 3


@given(
    mean=st.tuples(*[st.floats(-2, 2)] * 4),
    cov=covariances() | symmetric(),
    line=st.fixed_dictionaries(
        {
            "slot": st.sampled_from(Slot),
            "kind": st.sampled_from(Kind),
            "status": st.sampled_from(Status),
            "x_min": st.floats(-200, 0),
            "x_max": st.floats(0, 600),
            "age": st.floats(0, 1) | st.just(np.inf),
        }
    ),
    fd=st.booleans(),
)
def test_any_line(mean: Any, cov: Any, line: dict[str, Any], fd: bool) -> None:
    """Any line gives the same frames, whatever its covariance."""
    scaled = np.array(mean) * [10, 0.5, 0.02, 1e-4]
    given = MapLine(gaussian=Gaussian.trusted(scaled, np.array(cov)), **line)
    codecs = codecs_of_maplines()
    check_same((codecs[0].encoder(), codecs[1].encoder()), "encode", given, fd=fd)


@cache
def codecs_of_maplines() -> tuple[Codec, Codec]:
    return codecs_of(layout_of(COMPLETE))


def test_frames_are_ordinary() -> None:
    """A Frame of C is one like any other: it can be compared, hashed, replaced and collected."""
    (line,) = codecs_of_maplines()[0].encoder().encode_lines([ordinary()])
    for frame in line:
        assert type(frame) is Frame
        assert frame == Frame(frame.can_id, frame.data, frame.is_fd, frame.is_extended)
        assert hash(frame) == hash(tuple(frame))
        assert frame._replace(is_fd=True).is_fd
        assert gc.is_tracked(frame)
        assert sys.getrefcount(frame.data) <= 3


def test_an_encoder_in_several_threads() -> None:
    """Each record has another counter, as if one thread had sent all."""
    codec = codecs_of_maplines()[0]
    encoder, alone = codec.encoder(), codec.encoder()
    repetitions, threads = 300, 3

    def send(_: int) -> list[Frame]:
        return [frame for _ in range(repetitions) for frame in encoder.encode(ordinary())]

    with ThreadPoolExecutor(threads) as pool:
        sent = [frame for frames in pool.map(send, range(threads)) for frame in frames]

    expected = [frame for _ in range(repetitions * threads) for frame in alone.encode(ordinary())]
    assert Counter(sent) == Counter(expected)
    assert encoder._counters == alone._counters


def test_nothing_leaks() -> None:
    """Sending for long takes no more memory, whether lines are usual, unusual or wrong."""
    encoder = codecs_of(layout_of(COMPLETE))[0].encoder()
    slots = with_slots(layout_of(COMPLETE), Slot.EGO_LEFT)
    lacking = codecs_of(slots)[0].encoder()
    mixture = MapLine.of_mixture(Slot.CENTRE, mixture_of(8))
    raising = made_of(Raising, ordinary())
    reversed_cov = replace(ordinary(), gaussian=Gaussian.trusted(MEAN, COV[::-1, ::-1]))

    def cycle() -> None:
        encoder.encode(ordinary())
        encoder.encode_lines([ordinary(Slot.ROUTE), mixture], fd=True)
        other: Any
        for other in (reversed_cov, None, raising, mixture.gaussian):
            outcome(partial(encoder.encode_lines, [ordinary(), other]))
        outcome(partial(lacking.encode_lines, [ordinary(), ordinary(Slot.ROUTE)]))

    assert_no_growth(cycle, 300)
