"""Batches of lines: the kernel of the core against NumPy, to the last bit."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import fields
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from c_lines import Lines, awkward_lines, random_records
from hypothesis import given
from hypothesis.extra.numpy import arrays
from maplines_can.native import lib
from random_dbc import LIMIT_SEED, random_dbc
from random_lines import random_lines
from scene_layouts import layout_of

from maplines_can import Slot, Status
from maplines_can.values.errors import EncodeError
from maplines_can.wire import Codec
from maplines_can.wire.layout import validation
from maplines_can.wire.layout.message_layout import Layout
from maplines_can.wire.records.batch_kernel import BatchKernel

pytestmark = pytest.mark.skipif(lib is None, reason="there is no C path")

COMPLETE = ("maplines.dbc", "maplines-secoc.dbc")
#: Random DBCs with complete records, one of which is at the limits of the core.
SEEDS = (0, 2, 3, 5, LIMIT_SEED)
NUMBERS = st.floats(-1e3, 1e3) | st.sampled_from(
    [0.0, -0.0, 1e-300, 5e-324, 1e9, -1e9, 1e155, 1e307, 1.1e307, np.inf, np.nan]
)


def codec_of(name: str) -> Codec:
    codec = Codec(layout_of(name))
    assert kernel_of(codec) is not None
    return codec


def kernel_of(codec: Codec) -> BatchKernel | None:
    assert codec._complete is not None
    return codec._complete.format.kernel


@contextmanager
def numpy_alone(codec: Codec) -> Iterator[None]:
    """Run a codec without the C core."""
    assert codec._complete is not None
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(codec._complete.format, "kernel", None)
        patch.setattr(validation, "lib", None)
        yield


def outcome(work: Any) -> Any:
    """Return the bytes of the result of some work, with types and shapes, or its error."""
    try:
        result = work()
    except (ValueError, TypeError, EncodeError) as error:
        return type(error), str(error)
    if isinstance(result, np.ndarray):
        return result.dtype, result.shape, result.tobytes(), result.flags.writeable
    values = {field.name: getattr(result, field.name) for field in fields(result)}
    return {name: (a.dtype, a.shape, a.tobytes(), a.flags.writeable) for name, a in values.items()}


def compare(codec: Codec, work: Any) -> Any:
    """Compare the outcomes on both paths, which is returned."""
    native = outcome(work)
    with numpy_alone(codec):
        expected = outcome(work)
    if isinstance(native, dict) and isinstance(expected, dict):
        different = [name for name in native if native[name] != expected[name]]
        assert not different
    assert native == expected
    return native


@pytest.fixture(scope="module", params=[*COMPLETE, *SEEDS])
def codec(request: pytest.FixtureRequest) -> Codec:
    if isinstance(request.param, str):
        return codec_of(request.param)
    codec = Codec(Layout.from_text(random_dbc(request.param), "random.dbc"))
    if codec.layout.is_conditional:
        pytest.skip("its records are conditional on the pose error")
    assert kernel_of(codec) is not None
    return codec


def test_enough_random_dbcs_have_complete_records() -> None:
    layouts = [Layout.from_text(random_dbc(seed), "random.dbc") for seed in SEEDS]
    assert sum(not layout.is_conditional for layout in layouts) >= 3


# ---- decode ------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [0, 1, 127, 128, 129, 3000])
def test_records_are_decoded_the_same(codec: Codec, n: int) -> None:
    """Random bits at the ends of the signals too, and damaged records: all rows are the same."""
    records, slots = random_records(codec, n, np.random.default_rng(n)) if n else (
        np.empty((0, codec.layout.record_bytes), np.uint8),
        np.empty(0, int),
    )  # fmt: skip
    decoded = compare(codec, lambda: codec.batch.decode(records, slots))
    if n == 3000:
        verdicts = np.frombuffer(decoded["verdict"][2], np.int8)
        assert set(verdicts) == {0, 1, 2, 3}
        assert (verdicts == 0).sum() > 500


def test_bits_without_any_order_are_decoded_the_same(codec: Codec) -> None:
    bits = np.random.default_rng(1).integers(0, 256, (2000, codec.layout.record_bytes))
    records = bits.astype(np.uint8)
    records[0], records[1] = 0, 255
    compare(codec, lambda: codec.batch.decode(records, next(iter(codec.layout.messages))))


def test_arrays_in_any_order_are_decoded() -> None:
    codec = codec_of("maplines.dbc")
    payloads = codec.batch.encode(*random_lines(40, 3))
    for records in (payloads[::-1], np.asfortranarray(payloads), payloads[::3]):
        records.flags.writeable = False
        assert not isinstance(compare(codec, lambda r=records: codec.batch.decode(r)), tuple)


@given(bits=arrays(np.uint8, (3, 32)), slot=st.sampled_from(sorted(Slot)))
def test_any_bits_are_decoded_the_same(bits: Any, slot: Slot) -> None:
    codec = codec_of("maplines.dbc")
    compare(codec, lambda: codec.batch.decode(bits, slot))


def test_wrong_payloads_have_the_same_errors() -> None:
    codec = codec_of("maplines.dbc")
    for payloads in (np.zeros((2, 31), np.uint8), np.zeros((2, 32)), np.zeros(32, np.uint8)):
        native = compare(codec, lambda p=payloads: codec.batch.decode(p))
        assert native[0] is ValueError
    native = compare(codec, lambda: codec.batch.decode(np.zeros((2, 32), np.uint8), [0, 9]))
    assert native[0] is EncodeError


# ---- encode ------------------------------------------------------------------------------------


@pytest.mark.parametrize("k", [0, 2, 3])
def test_awkward_lines_are_encoded_the_same(codec: Codec, k: int) -> None:
    """Indefinite, singular, tiny and huge covariances, and means and ranges beyond the message."""
    n, seed = 400, 10 + k
    rng = np.random.default_rng(seed)
    if k >= 2 ** codec.layout["ComponentCount"].length:
        pytest.skip("the DBC has no such mixtures")
    if not k:
        lines = awkward_lines(codec, n, seed)
    else:
        of = awkward_lines(codec, n * k, seed)
        lines = Lines(of.means.reshape(n, k, 4), of.covs.reshape(n, k, 4, 4), rng, codec, k=k)
    native = compare(codec, lambda: lines.payloads(codec))
    assert not isinstance(native[0], type)
    payloads = np.frombuffer(native[2], np.uint8).reshape(-1, codec.layout.record_bytes)
    status = codec.batch.decode(payloads, np.repeat(lines.slot, max(k, 1))).status
    assert set(Status) - {Status.REPAIRED, Status.SATURATED} <= set(status)


def test_statuses_of_awkward_lines_are_all_there() -> None:
    codec = codec_of("maplines.dbc")
    lines = awkward_lines(codec, 2000, 4)
    payloads = lines.payloads(codec)[:, 0]
    assert set(codec.batch.decode(payloads, lines.slot).status) == set(Status)


def test_lines_without_covariance_are_encoded_the_same(codec: Codec) -> None:
    means, _ = random_lines(100, 2)
    means[::7] *= 1e5
    slot = next(iter(codec.layout.messages))
    for status in (None, Status.UNKNOWN, Status.OUT_OF_RANGE):
        compare(codec, lambda s=status: codec.batch.encode(means, slot=slot, status=s))


@given(
    mean=arrays(float, (2, 4), elements=st.floats(-1e4, 1e4) | NUMBERS),
    root=arrays(float, (2, 4, 4), elements=st.floats(-3, 3)),
    entry=st.none() | st.tuples(st.integers(0, 3), st.integers(0, 3), NUMBERS),
    status=st.sampled_from(Status),
    form=st.sampled_from([np.float64, np.float32]),
)
def test_any_gaussians_are_encoded_the_same_or_have_the_same_error(
    mean: Any, root: Any, entry: Any, status: Status, form: Any
) -> None:
    codec = codec_of("maplines.dbc")
    covs = (root @ root.mT).astype(form)
    if entry is not None:
        with np.errstate(over="ignore"):
            covs[1, entry[0], entry[1]] = entry[2]
    compare(codec, lambda: codec.batch.encode(mean, covs, status=status, x_max=50.0))


@pytest.mark.parametrize(
    "attributes",
    [
        {"x_min": 1.0},
        {"x_min": np.nan},
        {"x_max": [0.0, np.inf]},
        {"age": -1.0},
        {"age": np.nan},
        {"x_min": 2.0, "age": -1.0},
        {"age": -1.0, "component_weight": 0.0},
        {"component_weight": [1.0, 2.0]},
        {"component_index": 1},
        {"component_index": 1, "component_count": 2.0},
        {"component_index": [0, 1], "component_count": 1},
        {"slot": [1], "kind": [2], "status": [1], "counter": [7], "x_max": [9.0], "age": [0.5]},
        {"component_count": 100},
        {"kind": 8},
        {"kind": 1.5},
        {"status": 6},
        {"slot": 9},
        {"slot": [0, 1, 2]},
        {"counter": 2**40 + 3},
        {"counter": -1},
        {"counter": 0.5},
        {"age": True, "kind": True},
        {"colour": 1},
    ],
)
def test_attributes_are_checked_the_same(attributes: dict[str, Any]) -> None:
    codec = codec_of("maplines.dbc")
    means, covs = random_lines(2, 5)
    compare(codec, lambda: codec.batch.encode(means, covs, **attributes))


def test_without_lines_no_attribute_is_wrong() -> None:
    codec, none = codec_of("maplines.dbc"), np.empty((0, 4))
    for wrong in ({}, {"kind": 8}, {"slot": 9}, {"age": [-1.0]}, {"x_min": np.nan}):
        native = compare(codec, lambda w=wrong: codec.batch.encode(none, **w))
        assert native[1] == (0, 32)


def test_wrong_mixtures_have_the_same_errors() -> None:
    codec = codec_of("maplines.dbc")
    means, covs = random_lines(100, 5)
    for k in (1, 2, 50, 100):  # the DBC has fewer components than 50
        given = np.full((1, k), 1 / k), means[None, :k], covs[None, :k]
        compare(codec, lambda g=given: codec.batch.encode_mixtures(*g))
    uneven = np.array([[0.5, 0.4]]), means[None, :2], covs[None, :2]
    assert compare(codec, lambda: codec.batch.encode_mixtures(*uneven))[0] is ValueError


# ---- the seam ----------------------------------------------------------------------------------


def test_arrays_of_other_sizes_are_refused() -> None:
    """C would read beyond them."""
    kernel = kernel_of(codec_of("maplines.dbc"))
    assert kernel is not None
    gaussians = validation.checked_gaussians(*random_lines(3, 1))
    numbers = [0] * 5, [0.0] * 4
    for wrong in (
        lambda: kernel.read(np.zeros((3, 32), np.uint8), np.zeros(2, np.uint16)),
        lambda: kernel.read(np.zeros((3, 31), np.uint8), np.zeros(3, np.uint16)),
        lambda: kernel.encode(gaussians, np.zeros((2, 4, 4)), 0, *numbers),
        lambda: kernel.encode(gaussians._replace(cov=np.zeros((2, 4, 4))), None, 0, *numbers),
        lambda: kernel.cover(np.ones((1, 2)), np.zeros((1, 2, 4)), np.zeros((1, 1, 4, 4)), 128),
    ):
        with pytest.raises(ValueError, match="shape"):
            wrong()
    many = np.full((1, 65), 1 / 65), np.zeros((1, 65, 4)), np.zeros((1, 65, 4, 4))
    with pytest.raises(ValueError, match="components"):
        kernel.cover(*many, 128)


def test_threads_have_results_of_their_own() -> None:
    """The loops run without the GIL."""
    codec = codec_of("maplines.dbc")
    lines = [random_lines(3000, seed) for seed in range(4)]
    expected = [codec.batch.encode(*line).tobytes() for line in lines]
    got: dict[int, bytes] = {}

    def work(i: int) -> None:
        payloads = codec.batch.encode(*lines[i])
        codec.batch.decode(payloads)
        got[i] = payloads.tobytes()

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [got[i] for i in range(4)] == expected
