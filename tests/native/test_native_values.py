"""Gaussians and bands of lines: the core against Python alone."""

import sys
from typing import Any

import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from hypothesis.extra.numpy import arrays
from maplines_can.native import lib

from maplines_can.core.memory import pointer
from maplines_can.values import gaussian as module
from maplines_can.values import line as line_module
from maplines_can.values.gaussian import Gaussian
from maplines_can.values.line import MapLine, Slot

pytestmark = pytest.mark.skipif(lib is None, reason="there is no core")

NUMBERS = st.floats(allow_nan=False, allow_infinity=False) | st.sampled_from(
    [0.0, -0.0, 1.0, -1.0, 1e-9, 1e-5, 1e154, 1e307, 1.1e307, 5e-324, float("inf"), float("nan")]
)


def outcome(mean: Any, cov: Any) -> tuple[Any, ...]:
    """Return the bytes of a Gaussian with what its arrays are, or the error."""
    try:
        made = Gaussian(mean, cov)
    except (ValueError, TypeError) as error:
        return type(error), str(error)
    arrays_of = made.mean, made.cov
    return tuple(
        (a.tobytes(), a.shape, a.dtype, a.flags.writeable, a.flags.c_contiguous, type(a))
        for a in arrays_of
    )


def same_on_both_paths(mean: Any, cov: Any) -> bool:
    """Compare the outcomes on both paths; return whether there is a Gaussian."""
    native = outcome(mean, cov)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "lib", None)
        assert outcome(mean, cov) == native
    return not isinstance(native[0], type)


@st.composite
def covariances(draw: st.DrawFn, n: int) -> np.ndarray[Any, Any]:
    """Return matrices of few variables that are covariances, nearly so, or not at all."""
    A = draw(arrays(float, (n, n), elements=st.floats(-3, 3) | NUMBERS))
    kind = draw(st.sampled_from(["any", "product", "nearly", "correlation"]))
    if kind == "any":
        return A
    with np.errstate(all="ignore"):
        scale = draw(arrays(float, n, elements=st.floats(0, 1e3)))
        S = A @ A.T if kind != "correlation" else np.ones((n, n))
        S = S * scale * scale[:, None]
        if kind == "nearly":
            S = S * (1 + draw(st.sampled_from([0, 1e-10, 9e-10, 1.1e-9, 1e-6])) * A)
    return np.asarray(S)


@given(st.data(), st.integers(1, 5))
def test_the_same_gaussians_and_errors(data: st.DataObject, n: int) -> None:
    mean = data.draw(arrays(float, n, elements=NUMBERS))
    cov = data.draw(covariances(n))
    same_on_both_paths(mean, cov)
    same_on_both_paths(mean.tolist(), cov.tolist())
    same_on_both_paths(tuple(mean), list(cov))


@pytest.mark.parametrize("n", [1, 2, 4, 7, 32, 33, 40])
def test_sizes(n: int) -> None:
    """Singular, regular and indefinite matrices."""
    A = np.random.default_rng(n).standard_normal((n, n))
    for k in (1, (n + 1) // 2, n):
        S = A[:, :k] @ A[:, :k].T
        assert same_on_both_paths(np.zeros(n), S)
        assert same_on_both_paths(np.zeros(n), np.asfortranarray(S))
        below = S - 1.1 * np.linalg.eigvalsh(S)[-1] * np.eye(n)
        assert not same_on_both_paths(np.zeros(n), below)


@pytest.mark.parametrize(
    ("mean", "cov"),
    [
        ([0, 0], [[1, 2], [2, 1]]),
        ([0, 0], [[1, 0.5], [0.4, 1]]),
        ([True, 0], np.eye(2)),
        ([10**400, 0], np.eye(2)),
        ([2**60 + 1, 0], np.eye(2)),
        ([0j, 0], np.eye(2)),
        (["0", 0], np.eye(2)),
        ([], np.zeros((0, 0))),
        ([0, 0], np.eye(3)),
        ([[0, 0]], np.eye(2)),
        ([0, 0], [[1, 0], [0]]),
        (0.0, 1.0),
        (None, None),
        (np.zeros(2, np.float32), np.eye(2, dtype=np.float32)),
        (np.zeros(2, ">f8"), np.eye(2, dtype=">f8")),
        (np.zeros(2, int), np.eye(2, dtype=int)),
        (np.zeros(4)[::2], np.eye(4)[::2, ::2]),
        (np.zeros(2), np.array([[1.0, 0.0, 0.0, 1.0]])),
        (np.ma.masked_array([0.0, 1.0], [True, False]), np.eye(2)),
        (np.float64(0), np.float64(1)),
        ([np.float64(1), np.float32(2)], np.eye(2)),
        ("ab", np.eye(2)),
        (b"12345678", np.eye(1)),
    ],
)
def test_edges(mean: Any, cov: Any) -> None:
    same_on_both_paths(mean, cov)


def test_a_gaussian_copies_what_it_is_given() -> None:
    mean, cov = np.zeros(2), np.eye(2)
    made = Gaussian(mean, cov)
    mean[:], cov[:] = 7, 7
    assert made.mean.tolist() == [0, 0]
    assert made.cov.tolist() == [[1, 0], [0, 1]]


def test_rounding_errors_of_single_precision() -> None:
    """The bound is that of what is given, also where both paths compute in double precision."""
    S = np.array([[1.0, 0.5], [0.5 + 5e-6, 1.0]])
    assert same_on_both_paths([0, 0], S.astype(np.float32))
    assert not same_on_both_paths([0, 0], S.astype(np.float32).astype(float))


def test_zeros_keep_their_signs() -> None:
    """A covariance is averaged with its transpose only where they differ."""
    assert same_on_both_paths([0, -0.0], [[1.0, -0.0], [0.0, 1.0]])
    assert same_on_both_paths([0, 0], [[1.0, 0.5], [0.5 + 1e-12, 1.0]])


@given(
    arrays(float, 4, elements=st.floats(-1.5, 1.5)),
    arrays(float, (4, 4), elements=st.floats(-3, 3)),
    st.floats(allow_nan=True) | st.integers(-(10**6), 10**6),
)
def test_the_same_band_of_a_line(mean: Any, A: Any, x: float) -> None:
    line = MapLine(Slot.EGO_LEFT, Gaussian.trusted(mean, A @ A.T))
    native = line.y(x), line.y_sigma(x)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(line_module, "lib", None)
        alone = line.y(x), line.y_sigma(x)
    assert [*map(type, native)] == [*map(type, alone)]
    np.testing.assert_array_equal(native, alone)


def test_a_gaussian_that_was_not_checked_may_hold_any_arrays() -> None:
    odd = Gaussian.trusted(np.array([1.0, 9, 0, 9, 0, 9, 0, 9])[::2], np.diag([4.0] * 8)[::2, ::2])
    line = MapLine(Slot.EGO_LEFT, odd)
    assert [line.y(2.0), line.y_sigma(0.0)] == [1.0, 2.0]


@pytest.mark.parametrize("kind", [">f8" if sys.byteorder == "little" else "<f8", "f2", "O"])
def test_pointers_of_arrays_that_the_core_would_misread(kind: str) -> None:
    with pytest.raises(KeyError):
        pointer(np.zeros(2, kind))
