"""Elementary functions against the mathematical library, whose error is below one unit."""

import ast
import math
import re
from decimal import Context, Decimal, localcontext
from fractions import Fraction
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from maplines_can.values import elementary

#: Largest error of each function, and of the library, in units in the last place.
MAX_ULPS = {"exp2": 2, "log2": 4, "sin": 3, "cos": 3, "tan": 5, "atan": 5}
OURS: dict[str, Any] = {
    "exp2": elementary.exp2,
    "log2": elementary.log2,
    "sin": lambda x: elementary.sin_cos(x)[0],
    "cos": lambda x: elementary.sin_cos(x)[1],
    "tan": elementary.tan,
    "atan": lambda x: elementary._values(3, x),
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


# ---- angles of any size ---------------------------------------------------------------


@cache
def pi(digits: int = 700) -> Decimal:
    """Return pi by Machin's formula, 16 atan(1/5) - 4 atan(1/239)."""
    one = 10 ** (digits + 10)

    def inverse_tangent(n: int) -> int:
        total, power, k = 0, one // n, 0
        while power:
            total += (-1) ** k * (power // (2 * k + 1))
            power, k = power // (n * n), k + 1
        return total

    return Decimal(16 * inverse_tangent(5) - 4 * inverse_tangent(239)).scaleb(-digits - 10)


def exact_sine_and_cosine(x: float) -> tuple[Decimal, Decimal]:
    """Return sine and cosine to 60 digits by their series, of the rest of whole turns."""
    with localcontext(Context(prec=700)):
        angle = Decimal(x) % (2 * pi())
    with localcontext(Context(prec=80)):
        term, sums, k = Decimal(1), [Decimal(0)] * 4, 0
        while term.adjusted() > -70 or k < 10:
            sums[k % 4] += term
            k += 1
            term *= angle / k
        return sums[1] - sums[3], sums[0] - sums[2]


@given(x=st.floats(allow_nan=False, allow_infinity=False))
@example(x=1e5)
@example(x=math.nextafter(1e5, math.inf))
@example(x=1e22)
@example(x=-1.7976931348623157e308)
@example(x=6381956970095103 * 2.0**797)  # the double that is nearest to a multiple of pi / 2
@example(x=5e-324)
@example(x=-2.3e-308)
def test_sine_and_cosine_of_any_angle(x: Any) -> None:
    """Far angles are as if they were off by less than half a unit in their last place."""
    off = math.ulp(x) / 2 if abs(x) > 1e5 else 0.0
    for got, exact in zip(elementary.sin_cos(x), exact_sine_and_cosine(x), strict=True):
        error = abs(Fraction(float(got)) - Fraction(exact))
        scale = max(abs(float(exact)), 2.0**-53 * min(abs(x), 1e5))
        assert error <= 3 * Fraction(math.ulp(scale)) + Fraction(off)


# ---- who uses the library --------------------------------------------------------------

PACKAGE = Path(elementary.__file__).parents[1]
#: What has no twin in C: messages, densities, and the positions of arrays of lines.
WITHOUT_TWIN = {"values/arrays.py", "values/coding_loss.py", "values/gaussian.py", "values/line.py",
                "values/mixture.py", "propagation/splitting.py"}  # fmt: skip
INEXACT = re.compile(
    r"a?(sin|cos|tan)h?|arc\w+|atan2|hypot|dist|sinc|exp(2|m1)?|log(2|10|1p)?|pow|\w*power|cbrt"
)


def test_no_module_with_a_twin_in_c_uses_inexact_functions_of_libraries() -> None:
    """Their last bits depend on the machine; docstrings may."""
    found = {
        path.relative_to(PACKAGE).as_posix()
        for folder in ("values", "propagation", "wire")
        for path in (PACKAGE / folder).rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Attribute) and INEXACT.fullmatch(node.attr)
        if isinstance(node.value, ast.Name) and node.value.id in ("np", "math")
    }
    assert found == WITHOUT_TWIN
