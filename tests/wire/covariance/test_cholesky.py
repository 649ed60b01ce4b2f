"""The default covariance code at the ends of its signals."""

import numpy as np
from numpy.typing import NDArray

from maplines_can.wire import Layout
from maplines_can.wire.covariance.cholesky import CholeskyCode

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
    """To 4e-6: with a step less, the decoded covariance would not cover the target."""
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
    assert (largest_ratio(0) <= 1).all()
    assert (largest_ratio(1) > 1 - 4e-6).all()
