"""Lines to frames: what an encoder takes, and what it says of the rest."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from random_dbc import LIMIT_SEED, random_dbc
from scene_layouts import layout_of
from support.lines import random_lines

from maplines_can import Codec, EncodeError, Gaussian, GaussianMixture, Kind, MapLine, Slot, Status
from maplines_can.wire import Layout

MEAN, COV = np.array([1.75, 0.01, 1e-3, 1e-6]), np.diag([0.1, 0.01, 1e-3, 1e-5]) ** 2
DEFAULT = layout_of("maplines.dbc")
CODEC = Codec(DEFAULT)


def ordinary(slot: Slot = Slot.EGO_LEFT, **rest: Any) -> MapLine:
    return MapLine(slot, Gaussian(MEAN, COV), **rest)


def changed(**attributes: Any) -> MapLine:
    """Return a line with attributes that its constructor would refuse."""
    line = ordinary()
    for name, value in attributes.items():
        object.__setattr__(line, name, value)
    return line


def mixture_of(k: int, seed: int = 0) -> GaussianMixture:
    means, covs = random_lines(k, seed)
    weights = np.random.default_rng(seed).dirichlet(np.ones(k)) + 1e-3
    components = [Gaussian(*one) for one in zip(means, covs, strict=True)]
    return GaussianMixture(weights / weights.sum(), components)


def lines_of(layout: Layout, n: int, seed: int) -> Iterator[MapLine]:
    """Yield lines of each slot, kind and status; some are beyond the message."""
    rng = np.random.default_rng(seed)
    means, covs = random_lines(n, seed)
    for i in range(n):
        x_min = rng.uniform(-60, 20)
        yield MapLine(
            Slot(rng.choice([*layout.messages])),
            Gaussian(means[i] * rng.choice([1, 1, 10]), covs[i] * rng.choice([1, 1, 0, 1e9])),
            Kind(int(rng.integers(8))),
            x_min,
            x_min + rng.choice([0, rng.uniform(0, 150)]),
            rng.choice([0.02, np.inf]),
            Status(int(rng.integers(6))),
        )


# ---- what is sent ------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", [None, 0, 2, 5, LIMIT_SEED])
def test_lines_have_the_records_of_a_batch(seed: int | None) -> None:
    """One by one, all together, and as arrays; whatever the DBC."""
    layout = DEFAULT if seed is None else Layout.from_text(random_dbc(seed))
    codec, lines = Codec(layout), list(lines_of(layout, 300, seed=1))
    sent, modulus = Counter[Slot](), 2 ** layout["Counter"].length
    counters = []
    for line in lines:
        counters.append(sent[line.slot] % modulus)
        sent[line.slot] += 1
    names = ("slot", "kind", "x_min", "x_max", "age", "status")
    expected = codec.batch.encode(
        [line.gaussian.mean for line in lines],
        [line.gaussian.cov for line in lines],
        counter=counters,
        **{name: [getattr(line, name) for line in lines] for name in names},
    )
    encoder, fd = codec.encoder(), layout.messages[lines[0].slot].can_id is None
    one_by_one = [encoder.encode(line, fd=fd) for line in lines]
    assert codec.encoder().encode_lines(lines, fd=fd) == one_by_one
    for frames, record in zip(one_by_one, expected, strict=True):
        assert b"".join(frame.data for frame in frames)[: len(record)] == record.tobytes()
    assert {*codec.batch.decode(expected, [line.slot for line in lines]).status} == {*Status}


class Derived(MapLine):
    """A line of a subclass."""


@pytest.mark.parametrize(
    "line",
    [
        pytest.param(Derived(Slot.EGO_LEFT, Gaussian(MEAN, COV), x_max=20), id="subclass"),
        pytest.param(ordinary(x_max=np.float32(20)), id="single-precision"),
        pytest.param(changed(x_max=20), id="integer"),
        pytest.param(changed(x_max=np.array(20.0), kind=0, status=1), id="array-of-one"),
        pytest.param(
            replace(ordinary(x_max=20), gaussian=Gaussian.trusted(MEAN, COV.copy(order="F"))),
            id="by-columns",
        ),
        pytest.param(
            replace(
                ordinary(x_max=20),
                gaussian=Gaussian.trusted(
                    np.repeat(MEAN, 2)[::2], np.kron(COV, np.eye(2))[::2, ::2]
                ),
            ),
            id="strides",
        ),
    ],
)
def test_what_is_unusual_is_converted(line: MapLine) -> None:
    """It is sent as any other."""
    assert CODEC.encoder().encode(line) == CODEC.encoder().encode(ordinary(x_max=20.0))


# ---- what is refused ---------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "error", "message"),
    [
        (changed(slot=9), EncodeError, "slot must be from 0 to 7, got 9|no message for slot 9"),
        (changed(slot=-1), EncodeError, "no message for slot -1"),
        (changed(slot=1.5), EncodeError, "no message for slot 1.5"),
        (changed(kind=8), EncodeError, "signal Kind: .*8.* is not a whole number from 0 to 7"),
        (changed(status=6), EncodeError, "signal Status: .*6.* is not a whole number from 0 to 5"),
        (changed(x_min=np.nan), EncodeError, "x_min must be finite, got nan"),
        (changed(x_min=90.0), EncodeError, "x_min must be x_max or less"),
        (changed(age=-1.0), EncodeError, "age must be 0 s or more, got -1"),
        (changed(age=None), EncodeError, "age must be 0 s or more, got nan"),
        (
            changed(gaussian=Gaussian.trusted(MEAN * np.nan, COV)),
            ValueError,
            "means must be finite",
        ),
        (changed(gaussian=Gaussian.trusted(MEAN, -COV)), ValueError, "variances of 0 or more"),
        (changed(gaussian=Gaussian.trusted(MEAN, COV + np.eye(4, k=1))), ValueError, "symmetric"),
        (changed(gaussian=Gaussian(MEAN[:2], COV[:2, :2])), ValueError, "over four parameters"),
        (
            MapLine.of_mixture(Slot.EGO_LEFT, mixture_of(9)),
            EncodeError,
            "ComponentIndex|ComponentCount: .*9.* is not a whole number from 1 to 8",
        ),
        (None, AttributeError, "'NoneType' object has no attribute 'slot'"),
    ],
)
def test_what_cannot_be_sent_raises(line: Any, error: type[Exception], message: str) -> None:
    """The error names the value; the counters stay."""
    encoder = CODEC.encoder()
    for lines in ([line], [ordinary(), line], [line, ordinary()]):
        with pytest.raises(error, match=message):
            encoder.encode_lines(lines)
    assert encoder.encode(ordinary()) == CODEC.encoder().encode(ordinary())


def test_lines_that_depend_on_the_pose_error_are_sent_as_scenes() -> None:
    """The error says how."""
    encoder = Codec(layout_of("maplines-pose.dbc")).encoder()
    with pytest.raises(EncodeError, match=r"conditional on the pose error.*encode_scene"):
        encoder.encode(ordinary())


# ---- code of others that runs meanwhile --------------------------------------------------------


def test_an_interrupt_is_not_lost() -> None:
    """Ctrl-C while a line is read goes on at once, and no counter advances."""

    class Interrupted(MapLine):
        def __getattribute__(self, name: str) -> Any:
            if name == "mixture":
                raise KeyboardInterrupt
            return super().__getattribute__(name)

    line = object.__new__(Interrupted)
    vars(line).update(vars(ordinary()))
    encoder = CODEC.encoder()
    with pytest.raises(KeyboardInterrupt):
        encoder.encode(line)
    assert encoder.encode(ordinary()) == CODEC.encoder().encode(ordinary())
