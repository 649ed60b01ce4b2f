"""The default covariance code at the ends of its signals."""

from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray
from scipy.optimize import brentq
from strategies import covariances, symmetric

from maplines_can.values.errors import LayoutError
from maplines_can.wire import Layout
from maplines_can.wire.covariance.cholesky import CholeskyCode
from maplines_can.wire.layout.record_layout import RecordLayout
from maplines_can.wire.layout.signals import Signal

LAYOUT = Layout.from_dbc()
CODE = CholeskyCode(LAYOUT)


def test_a_covariance_that_cannot_be_covered_is_encoded_as_the_widest() -> None:
    """Too large in one state, or in all: the record has no narrower covariance than the DBC can."""
    narrow = np.eye(4) * 1e-6
    huge = narrow.copy()
    huge[0, 0] = 1e12
    coded = CODE.encode(np.array([narrow, huge, 1e12 * np.eye(4)]), LAYOUT.resolution)
    assert coded.covered.tolist() == [True, False, False]
    widest = CODE.widest()
    for name, raw in coded.raw.items():
        assert raw[1:].tolist() == [widest[name]] * 2
    assert (np.diagonal(CODE.decode(coded.raw)[0]) < 1e-2).all()
    widest_cov = CODE.decode(coded.raw)[1]
    sigma = np.sqrt(widest_cov.diagonal())
    correlation = widest_cov / np.outer(sigma, sigma)
    assert np.abs(correlation - np.eye(4)).max() < 0.1
    assert not coded.saturated[0]


def test_a_pivot_is_lifted_by_the_fewest_steps() -> None:
    """Until the ratio to another state rounds to one in range; with a step less, it does not."""
    n = 500
    first, second = CODE.factor.order[:2]
    ratio, pivots = CODE.factor.ratios[1][0], CODE.factor.pivots[:2]
    rng = np.random.default_rng(0)
    error = np.tile(np.diag(LAYOUT.resolution), (n, 1, 1))
    narrow = 1e-5
    slope = narrow * rng.uniform(1.1, 8, n) * ratio.physical_range[1]
    error[:, first, first] = 1e-12
    error[:, first, second] = error[:, second, first] = 1e-6 * slope
    error[:, second, second] = slope**2 + narrow**2

    coded = CODE.encode(error, LAYOUT.resolution)
    assert coded.covered.all()
    assert coded.saturated.all()

    def wanted(lower: int) -> NDArray[np.float64]:
        """The raw ratio that the target needs, with the second pivot lower by some steps."""
        sigma, lifted = (
            np.exp2(pivot.physical(coded.raw[pivot.name] - steps))
            for pivot, steps in zip(pivots, (0, lower), strict=True)
        )
        variance = error[:, first, first] + LAYOUT.resolution[first]
        return ratio.raw(error[:, first, second] / variance * sigma / lifted)

    assert (wanted(0) <= ratio.raw_max).all()
    assert (wanted(1) > ratio.raw_max).all()


def test_the_inflation_is_the_least_that_covers() -> None:
    """To 4e-6: with a step less, the decoded covariance would not cover the target.

    Another algorithm's rounding, of a millionth, does not make it fall short.
    """
    rng = np.random.default_rng(1)
    roots = rng.normal(size=(20_000, 4, 4)) * np.array([0.1, 1e-2, 1e-3, 1e-5])[:, None]
    error = roots @ roots.swapaxes(1, 2)
    coded = CODE.encode(error, LAYOUT.resolution)
    checked = coded.covered & ~coded.saturated & (coded.raw["Inflation"] > 0)
    raw = {name: values[checked] for name, values in coded.raw.items()}

    def largest_ratio(steps: int) -> NDArray[np.float64]:
        """The most variance of the target in any direction, as a multiple of the decoded one."""
        decoded = CODE.decode({**raw, "Inflation": raw["Inflation"] - steps})
        whitening = np.linalg.inv(np.linalg.cholesky(decoded))
        target = whitening @ error[checked] @ whitening.swapaxes(1, 2)
        return np.linalg.eigvalsh(target)[:, -1]

    assert checked.sum() > 10_000
    assert (largest_ratio(0) <= 1 - 1e-6).all()
    assert (largest_ratio(1) > 1 - 4e-6).all()


SPECIAL = st.sampled_from([0.0, 1e-300, 1e-9, 1.0, 1e9, 1e300, np.inf, np.nan])


@given(
    symmetric() | covariances(),
    st.integers(-20, 20),
    st.none() | arrays(float, 4, elements=SPECIAL),
)
def test_one_covariance_is_encoded_as_one_of_many(cov: Any, octaves: int, factors: Any) -> None:
    """Any matrix: also one that is indefinite, that no bits cover, or that is not finite."""
    error = cov * 2.0**octaves
    with np.errstate(all="ignore"):
        if factors is not None:
            error = error * factors * factors[:, None]
        coded = CODE.encode(np.array([error] * 10), LAYOUT.resolution)
    one = CODE.encode_one(error.tolist(), LAYOUT.resolution.tolist())

    assert one == coded.first()


def pose_signal(name: str, length: int, factor: float, offset: float, unit: str) -> Signal:
    """A signal of a code with three rows."""
    raw_max = 2**length - 1
    return Signal(name, 0, length, False, False, factor, offset, unit, 0, raw_max)


def pose_layout(*ratios: str, step: float = 1 / 32) -> RecordLayout:
    """Signals of the covariance of a pose error, with ratios of these rows and columns."""
    signals = [
        *(pose_signal(f"Pivot{row}", 9, 0.04, -12, "octave") for row in ("Along", "Across")),
        pose_signal("PivotHeading", 9, 0.034, -18, "octave"),
        *(pose_signal(f"Ratio{names}", 8, step, -128 * step, "") for names in ratios),
        pose_signal("Inflation", 4, 0.0062, 0, "octave"),
    ]
    return RecordLayout(signals={signal.name: signal for signal in signals}, source="pose.dbc")


@pytest.mark.parametrize(
    ("ratios", "order"),
    [
        (("AcrossAlong", "HeadingAlong", "HeadingAcross"), [0, 1, 2]),
        (("AcrossHeading", "AlongHeading", "AlongAcross"), [2, 1, 0]),
    ],
)
def test_a_code_of_three_rows_covers(ratios: tuple[str, ...], order: list[int]) -> None:
    """In any order of the rows, and one at a time as many."""
    code = CholeskyCode(pose_layout(*ratios), rows=("Along", "Across", "Heading"))
    assert code.factor.order == order
    rng = np.random.default_rng(2)
    roots = rng.normal(size=(2000, 3, 3)) * np.array([0.3, 0.1, 0.005])[:, None]
    error = roots @ roots.swapaxes(1, 2)
    coded = code.encode(error, np.full(3, 1e-12))
    decoded = code.decode(coded.raw)
    assert coded.covered.all()
    assert decoded.shape == (2000, 3, 3)
    sigma = np.sqrt(np.einsum("nii->ni", decoded))
    excess = (decoded - error) / (sigma[:, :, None] * sigma[:, None, :])
    assert (np.linalg.eigvalsh(excess)[:, 0] > 0).all()
    ratio = np.linalg.eigvals(np.linalg.solve(error, decoded)).real
    assert np.median(ratio.max(axis=1)) < 1.1
    for i in range(20):
        one = code.decode_one({name: int(raw[i]) for name, raw in coded.raw.items()})
        assert np.array_equal(one, decoded[i])


def test_the_rows_that_lack_an_order_are_named() -> None:
    """The rows are those of the code."""
    with pytest.raises(LayoutError, match="RatioAcrossHeading or RatioHeadingAcross"):
        CholeskyCode(
            pose_layout("AcrossAlong", "HeadingAlong"), rows=("Along", "Across", "Heading")
        )


def condition(step: float) -> float:
    """Return the largest trace of an inverse correlation matrix, with ratios of 128 steps."""
    traces = []
    for signs in product([-1, 1], repeat=3):
        factor = np.eye(3)
        factor[np.tril_indices(3, -1)] = 128 * step * np.array(signs)
        cov = factor @ factor.T
        sigma = np.sqrt(cov.diagonal())
        traces.append(np.trace(np.linalg.inv(cov / np.outer(sigma, sigma))))
    return float(max(traces))


def test_ratios_that_are_too_large_are_refused() -> None:
    """Beyond a condition of 1e13, with the worst signs: double precision holds three digits of it.

    The limit is for all ratios together.
    """
    names, rows = ("AcrossAlong", "HeadingAlong", "HeadingAcross"), ("Along", "Across", "Heading")
    limit = brentq(lambda step: np.log10(condition(step)) - 13, 1, 100)
    CholeskyCode(pose_layout(*names, step=limit * (1 - 1e-3)), rows)
    with pytest.raises(LayoutError, match=r"could have the condition number 1e\+13"):
        CholeskyCode(pose_layout(*names, step=limit * (1 + 1e-3)), rows)


def test_the_widest_covariance_is_reached() -> None:
    """One of nearly that size is covered; one that no factor can hold overflows nowhere."""
    widest = CODE.decode_one(CODE.widest())
    huge = np.diag([1e300, 1.0, 1.0, 1.0])
    with np.errstate(all="raise"):
        coded = CODE.encode(np.array([0.99 * widest, huge]), LAYOUT.resolution)
    assert coded.covered.tolist() == [True, False]
