"""First-order propagation against the derivative."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.propagation import Linear
from maplines_can.values.gaussian import Gaussian


@pytest.mark.parametrize(
    ("function", "slope"), [(np.square, lambda x: 2 * x), (np.exp, np.exp), (np.sin, np.cos)]
)
@given(m=st.floats(-2, 2), s=st.floats(1e-3, 1))
def test_linear_is_the_first_order_expansion(function: Any, slope: Any, m: float, s: float) -> None:
    """The mean is f(m) and the sigma f'(m) s, for any s.

    The error of the fourth-order difference with steps of 0.01 s is s^5 1e-8 / 30 times the
    fifth derivative.
    """
    result = Linear()(function, Gaussian([m], [[s**2]]))

    assert result.mean[0] == function(m)
    assert np.isclose(result.sigma[0], abs(slope(m)) * s, rtol=0, atol=3e-9 * s**5 + 1e-12)
