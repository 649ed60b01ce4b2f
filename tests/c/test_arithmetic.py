"""Functions of numbers and matrices in C: the bits of Python, for any numbers."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import c_core
import numpy as np
import pytest
from c_lines import exact, is_semidefinite, squared

from maplines_can.model import joint
from maplines_can.values import elementary, fixed_order, linalg
from maplines_can.values.seen_lines import bases

ELEMENTARY, INVERSE, EIGEN, REPAIR, UNCOVERED, COMPARE, GAUSSIAN, LENGTH = range(8)
INF, NAN, HUGE, TINY = math.inf, math.nan, 1e300, 5e-324


def case(command: int, *values: Any) -> bytes:
    """Input of the harness; integers are bytes, everything else is numbers."""
    parts = (
        bytes([value]) if isinstance(value, int) else np.asarray(value, "<f8").tobytes()
        for value in values
    )
    return bytes([command]) + b"".join(parts)


def ran(cases: Sequence[bytes], *flags: str) -> bytes:
    program = c_core.harness("arithmetic", flags=(*c_core.FLAGS, *flags))
    return c_core.run(program, b"".join(cases))


def check(cases: Sequence[bytes], expected: Any, *, has_signs: bool = True) -> None:
    """Compare numbers to the last bit; but one NaN is as good as another.

    Args:
        cases: input of the harness, of which each gives as many numbers.
        expected: (n, k) numbers.
        has_signs: whether zeros must have the same signs.
    """
    got = np.frombuffer(ran(cases), "<f8").reshape(len(cases), -1)
    wanted = np.reshape(expected, got.shape)
    same = (got == wanted) & ((np.signbit(got) == np.signbit(wanted)) | (not has_signs))
    different = np.flatnonzero(~(same | (np.isnan(got) & np.isnan(wanted))).all(axis=1))
    assert not len(different), (different[0], got[different[0]], wanted[different[0]])


@pytest.fixture(autouse=True)
def quiet() -> Iterator[None]:
    """What overflows or is undefined is compared, too."""
    with np.errstate(all="ignore"):
        yield


# ---- numbers -----------------------------------------------------------------------------------


def test_elementary_functions() -> None:
    """Of numbers of any size, around multiples of pi / 4, powers of 2, and at the ends."""
    rng = np.random.default_rng(1)
    exponents = [-2001, -2000, -1999.5, -1074.6, -1074, -1022, 1023, 1024, 1999.5, 2000, 2001]
    quarters = np.pi / 4 * np.concatenate([np.arange(-9, 10), rng.integers(-(10**6), 10**6, 200)])
    powers = 2.0 ** np.arange(-1074, 1024, 7)
    some = [0.0, 1.0, 1e5, TINY, 2.3e-308, 1.7e308, INF, *exponents]
    x = np.concatenate([some, [-value for value in some], [NAN], quarters, powers])
    x = np.concatenate([x, np.nextafter(x, INF), np.nextafter(x, -INF)])
    x = np.concatenate(
        [x, rng.normal(size=500), rng.normal(size=500) * 10 ** rng.uniform(0, 9, 500)]
    )
    sine, cosine = elementary.sin_cos(x)
    functions = (elementary.exp2, elementary.log2, elementary.tan, elementary.atan)
    power, logarithm, tangent, angle = (function(x) for function in functions)
    expected = np.column_stack([power, logarithm, sine, cosine, tangent, angle])
    check([case(ELEMENTARY, value) for value in x], expected)


def test_lengths() -> None:
    """Of vectors whose squares are in the range of numbers, beyond it, or at a bound of it."""
    rng = np.random.default_rng(9)
    some = [0.0, 1.0, TINY, 2.3e-308, 1e-162, 1e-154, 2.0**511.5, 2.0**512, 1.7e308, INF]
    x, y = np.array([(a, b) for a in [*some, NAN] for b in some] * 3).T
    x[len(x) // 3 :] *= -1.0
    x[2 * len(x) // 3 :] = np.nextafter(x[2 * len(x) // 3 :], 0.0)
    near, far = (rng.normal(size=(2, 3000)) * 10.0 ** rng.uniform(*ends, (2, 3000))
                 for ends in ((-3, 8), (-323, 308)))  # fmt: skip
    x, y = np.concatenate([[x, y], near, far], axis=1)
    check([case(LENGTH, *pair) for pair in zip(x, y, strict=True)], elementary.hypot(x, y))


# ---- matrices ----------------------------------------------------------------------------------


def awkward_matrices(rng: Any, n: int, count: int) -> Any:
    """Matrices with zeros, tiny, huge, infinite and undefined entries, some of them singular."""
    A = rng.normal(size=(count, n, n)) * 10.0 ** rng.integers(-4, 5, (count, n, 1))
    kind = rng.integers(0, 8, count)
    A[kind == 1] *= rng.random((count, n, n))[kind == 1] < 0.5
    A[kind == 2, :, 0] = A[kind == 2, :, -1]
    A[kind == 3] *= 10.0 ** rng.integers(-320, 300, (count, n, n))[kind == 3]
    for kind_of, value in ((4, INF), (5, NAN)):
        for place in np.flatnonzero(kind == kind_of):
            A[place, rng.integers(n), rng.integers(n)] = value
    return A


def test_inverses() -> None:
    """Also of singular matrices: the same entries are infinite or undefined."""
    A = awkward_matrices(np.random.default_rng(2), 4, 1000)
    check([case(INVERSE, matrix) for matrix in A], fixed_order.inverse(A))


@pytest.mark.parametrize("n", [1, 2, 3, 4, 8])
def test_eigenvalues(n: int) -> None:
    A = awkward_matrices(np.random.default_rng(n), n, 300)
    S = np.triu(A) + np.triu(A, 1).mT
    expected = []
    for matrix in S:
        values, vectors = fixed_order.eigen(matrix)
        expected.append([*values, *vectors.ravel()])
    check([case(EIGEN, n, matrix) for matrix in S], expected)


def awkward_covariances(rng: Any, count: int) -> Any:
    """Symmetric matrices, many of them indefinite, with variances of 0 or more.

    Some variables have no variance, but covariances: down to those that rounding hides.
    """
    scale = 10.0 ** rng.uniform(-6, 3, (count, 4))
    R = np.tril(rng.uniform(-1.2, 1.2, (count, 4, 4)), -1)
    S = (R + R.mT + np.eye(4)) * (scale[:, :, None] * scale[:, None, :])
    kind = rng.integers(0, 6, count)
    for place in np.flatnonzero(kind >= 2):
        without = rng.permutation(4)[: rng.integers(1, 4)]
        low, high = ((-9, 0), (-170, -150), (-320, -160), (-310, 300))[kind[place] - 2]
        S[place, without] *= 10.0 ** rng.uniform(low, high)
        S[place][:, without] = S[place][without].T
        S[place, without, without] = 0.0
    S[kind == 1] *= 10.0 ** rng.integers(-300, 290, (count, 1, 1))[kind == 1]
    return S.clip(-1e307, 1e307)


def test_repair_of_covariances() -> None:
    """Which are indefinite, and the nearest ones that cover them."""
    S = awkward_covariances(np.random.default_rng(3), 3000)
    S[0] = [  # covariances many times larger than their variances admit
        [2.28529358e-2, 3.36018608e-163, -2.00031097e-3, 3.36018608e-163],
        [3.36018608e-163, 9.88131292e-324, -2.94116132e-164, -2.89114925e-166],
        [-2.00031097e-3, -2.94116132e-164, 1.75086651e-4, -2.97007282e-164],
        [3.36018608e-163, -2.89114925e-166, -2.97007282e-164, 2.22507386e-308],
    ]
    bad = linalg.indefinite(S)
    assert 500 < bad.sum() < 2500
    out = ran([case(REPAIR, matrix) for matrix in S])
    got = np.frombuffer(out, np.dtype([("bad", "?"), ("nearest", "<f8", (4, 4))]))
    assert (got["bad"] == bad).all()
    assert np.array_equal(got["nearest"], linalg.nearest_covariance(S), equal_nan=True)
    assert (got["nearest"][0].diagonal() >= S[0].diagonal()).all()


def random_scene(rng: Any) -> tuple[Any, Any, Any, Any]:
    """Covariances of lines to be covered and due to the pose, their own ones, and bases."""
    lines = int(rng.integers(1, 9))
    n = 4 * lines
    means = rng.normal(size=(lines, 4)) * [3, 0.1, 2e-3, 2e-5]
    low = rng.uniform(-30, 10, lines)
    J = bases(means, np.column_stack([low, low + rng.uniform(1, 100, lines)]))
    roots = J @ (rng.normal(size=(lines, 4, 4)) * 10.0 ** rng.uniform(-4, 0, (lines, 1, 4)))
    own = fixed_order.product(roots, roots.mT)
    sizes = np.linalg.norm(roots, axis=2).reshape(n, 1)
    A = rng.normal(size=(n, 7)) * 10.0 ** rng.uniform(-4, 0) * sizes
    A[:, rng.integers(1, 8) :] = 0.0
    B = A * rng.choice([1.0, 0.9, 1.1, rng.uniform(0, 3)])
    true, spread = fixed_order.product(B, B.T), fixed_order.product(A, A.T)
    for i in range(lines):
        block = slice(4 * i, 4 * i + 4)
        true[block, block] += rng.choice([1.0, 0.5, 1.5]) * own[i]
    own[:, range(4), range(4)] *= rng.choice([1.0, 1.001])
    change = rng.integers(0, 12)
    if change == 0:  # own covariances that are indefinite, or not finite
        own[rng.random(lines) < 0.4] *= rng.choice([-1.0, 0.0, INF])
    elif change == 1:
        roots[0, :, 0] = roots[0, :, 1]
        own[0] = fixed_order.product(roots[0], roots[0].mT)
    elif change == 2:
        M = rng.normal(size=(n, n)) * sizes
        true += 10.0 ** rng.choice([rng.uniform(0, 70), 300.0]) * fixed_order.product(M, M.T)
    elif change == 3:
        factor = 10.0 ** rng.uniform(10, 40)
        spread, true = factor * spread, factor * true
    elif change == 4:
        true[rng.integers(n)] = rng.choice([INF, NAN])
        true = np.triu(true) + np.triu(true, 1).T
    elif change == 5:
        own *= 10.0 ** rng.uniform(-200, 290)
    elif change == 6:  # one that overflows, hardly
        variance = fixed_order.congruence(fixed_order.inverse(J[0]), own[0]).diagonal().max()
        own[0] = own[0] * (1e154 / np.sqrt(variance)) * (1e154 / np.sqrt(variance))
    elif change == 7:  # hardly uncovered
        true = spread + (1 - joint.SLACK + 10.0 ** rng.uniform(-14, -11)) * linalg.block_diagonal(
            own
        )
    return true, spread, own, J


def test_what_own_covariances_lack_to_cover_a_scene() -> None:
    """None, or what each of them lacks; those that cannot be compared are not finite."""
    rng = np.random.default_rng(4)
    scenes = [random_scene(rng) for _ in range(400)]
    out = ran([case(UNCOVERED, len(scene[3]), *scene) for scene in scenes])
    covered, not_comparable = 0, 0
    for scene in scenes:
        with np.errstate(all="ignore"):
            lacking = joint.uncovered(*(one.tolist() for one in scene))
        assert out[0] == (lacking is not None)
        out = out[1:]
        if lacking is None:
            covered += 1
            continue
        expected = np.array(lacking)
        got = np.frombuffer(out, "<f8", expected.size).reshape(expected.shape)
        out = out[8 * expected.size :]
        comparable = np.isfinite(expected).all(axis=(1, 2))
        assert (np.isfinite(got).all(axis=(1, 2)) == comparable).all()
        assert np.array_equal(got[comparable], expected[comparable])
        not_comparable += not comparable.all()
    assert not out
    assert covered > 20
    assert not_comparable > 20


def test_comparisons_of_covariances() -> None:
    """Divergence and ratio: also of singular, indefinite, huge and tiny ones."""
    rng = np.random.default_rng(5)
    roots = rng.normal(size=(2, 1000, 4, 4)) * 10.0 ** rng.uniform(-3, 3, (2, 1000, 4, 1))
    pairs = fixed_order.product(roots, roots.mT)
    kind = rng.integers(0, 10, (2, 1000))
    pairs[kind == 1] -= np.eye(4)
    pairs[kind == 2] *= 0.0
    pairs[kind == 3] *= 10.0 ** rng.uniform(-300, 300, ((kind == 3).sum(), 1, 1))
    pairs[kind == 4, 1, 2] = pairs[kind == 4, 2, 1] = rng.choice(
        [INF, NAN, -INF], (kind == 4).sum()
    )
    true, decoded = pairs
    expected = np.array(
        [
            (
                joint.divergence(one.tolist(), got.tolist()),
                joint.largest_ratio(got.tolist(), one.tolist()),
            )
            for one, got in zip(true, decoded, strict=True)
        ]
    )
    assert 200 < np.isfinite(expected).all(axis=1).sum() < 900
    cases = [case(COMPARE, *pair) for pair in zip(true, decoded, strict=True)]
    check(cases, expected, has_signs=False)  # which is the largest of 0 and -0


# ---- single precision --------------------------------------------------------------------------


def awkward_factors(rng: Any, count: int) -> Iterator[Any]:
    """Lower triangular factors with any correlations, and with sigmas beyond single precision."""
    for i in range(count):
        reach = 10.0 ** rng.uniform(-1, 6)
        T = np.tril(rng.normal(size=(4, 4)) * reach, -1) + np.diag(rng.uniform(0.1, 2, 4))
        sizes = ([1e-3] * 4, [1e-30, 1.0, 1.0, 1e-3], [1e25, 1.0, 1.0, 1.0], [1e-40] * 4)[i % 4]
        yield T / np.linalg.norm(T, axis=1)[:, None] * np.array(sizes)[:, None]


def test_any_factor_is_covered_in_single_precision() -> None:
    """Also by a diagonal one, where floats are too coarse for the correlations, or too short."""
    rng = np.random.default_rng(6)
    cases, given = [], []
    for T in awkward_factors(rng, 200):
        order, factor = rng.permutation(4), np.empty((4, 4))
        mean = rng.integers(2) * rng.normal(size=4) * 10.0 ** rng.uniform(-6, 6, 4)
        factor[order] = T
        cases.append(case(GAUSSIAN, mean, factor, *map(int, order)))
        given.append((mean, factor, order))
    got = np.frombuffer(ran(cases, "-DMAPLINES_FLOAT"), "<f8").reshape(-1, 20)
    diagonal = 0
    for (mean, factor, order), numbers in zip(given, got, strict=True):
        rounded, wide = numbers[:4], numbers[4:].reshape(4, 4)
        assert (rounded == mean.astype(np.float32)).all()
        assert (wide == wide.astype(np.float32)).all()
        assert (np.diagonal(wide[order]) > 0).all()
        assert (np.triu(wide[order], 1) == 0).all()
        e = np.array(exact([rounded])[0]) - np.array(exact([mean])[0])
        assert is_semidefinite(squared(wide) - squared(factor) - np.outer(e, e))
        diagonal += not np.tril(wide[order], -1).any()
    assert 50 < diagonal < 190


@pytest.mark.parametrize("sigma", [1e39, 1e200, INF])
def test_a_sigma_beyond_single_precision_is_the_largest_float(sigma: float) -> None:
    """No float covers it; but the factor stays one of numbers."""
    factor = np.diag([sigma, 1.0, 1.0, 1.0])
    out = ran([case(GAUSSIAN, np.zeros(4), factor, 0, 1, 2, 3)], "-DMAPLINES_FLOAT")
    got = np.frombuffer(out, "<f8")[4:].reshape(4, 4)
    assert got[0, 0] == np.finfo(np.float32).max
    assert np.isfinite(got).all()
