"""Elementary functions against the mathematical library, whose error is below one unit."""

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.values import elementary

#: Largest error of each function, and of the library, in units in the last place.
MAX_ULPS = {"exp2": 2, "log2": 4, "sin": 3, "cos": 3, "tan": 5, "atan": 5}
OURS = {
    "exp2": elementary.exp2,
    "log2": elementary.log2,
    "sin": lambda x: elementary.sin_cos(x)[0],
    "cos": lambda x: elementary.sin_cos(x)[1],
    "tan": elementary.tan,
    "atan": elementary.atan,
}
LIBRARY = {"exp2": math.exp2, "log2": math.log2} | {
    name: getattr(math, name) for name in ("sin", "cos", "tan", "atan")
}
EXPONENTS = st.floats(-1000, 1000)
NUMBERS = {
    "exp2": EXPONENTS,
    "log2": st.builds(lambda e: 2.0**e, EXPONENTS),
    "atan": st.floats(allow_nan=False, allow_infinity=False),
}


@pytest.mark.parametrize("name", OURS)
@given(data=st.data())
def test_agrees_with_the_library(name: Any, data: Any) -> None:
    x = data.draw(NUMBERS.get(name, st.floats(-1e5, 1e5)))
    library = LIBRARY[name](x)
    # Near a multiple of pi/2, and of log2 near 1, an error of the argument's last bit counts.
    scale = max(abs(library), math.ulp(x) if name in ("sin", "cos", "tan") else 0.0, 2.0**-60)
    assert abs(OURS[name](x) - library) <= MAX_ULPS[name] * np.spacing(scale)


@pytest.mark.parametrize(
    ("name", "x", "value"),
    [
        ("exp2", -math.inf, 0.0),
        ("exp2", math.inf, math.inf),
        ("exp2", -1074.0, 5e-324),
        ("exp2", 10.0, 1024.0),
        ("log2", 0.0, -math.inf),
        ("log2", -1.0, -math.inf),
        ("log2", math.inf, math.inf),
        ("log2", 2.0**-1022, -1022.0),
        ("sin", 0.0, 0.0),
        ("cos", 0.0, 1.0),
        ("atan", math.inf, math.pi / 2),
        ("atan", -math.inf, -math.pi / 2),
    ],
)
def test_edges(name: Any, x: Any, value: Any) -> None:
    assert OURS[name](x) == value


@pytest.mark.parametrize("name", ["sin", "cos", "tan"])
@pytest.mark.parametrize("x", [math.inf, -math.inf, math.nan])
def test_an_angle_that_is_not_finite_has_no_sine(name: Any, x: Any) -> None:
    assert math.isnan(OURS[name](x))


@pytest.mark.parametrize("name", OURS)
def test_a_value_does_not_depend_on_the_others(name: Any) -> None:
    x = np.linspace(0.01, 3.0, 101)
    assert OURS[name](x).tolist() == [float(OURS[name](one)) for one in x]


@given(x=st.floats(-1e300, 1e300))
def test_sine_and_cosine_are_on_the_circle(x: Any) -> None:
    sine, cosine = elementary.sin_cos(x)
    assert abs(sine * sine + cosine * cosine - 1) < 1e-15
