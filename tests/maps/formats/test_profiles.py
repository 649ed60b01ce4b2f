"""Piecewise cubics."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from maplines_can.maps.formats.opendrive.profiles import CubicPiece, Profiles

S = np.array([-5.0, 0.0, 4.0, 10.0, 15.0, 20.0, 99.0])


def test_functions_may_have_different_numbers_of_pieces() -> None:
    found = Profiles([[], [CubicPiece(0.0, 5.0)], [CubicPiece(0.0, 1.0), CubicPiece(10.0, 2.0)]])(
        S, S
    )
    assert found == pytest.approx(np.array([[0] * 7, [5] * 7, [1, 1, 1, 2, 2, 2, 2]], dtype=float))


@given(
    st.lists(st.tuples(*[st.floats(-10, 10)] * 5), min_size=1, max_size=5, unique_by=lambda p: p[0])
)
def test_values_agree_with_polynomials(pieces: list[tuple[float, ...]]) -> None:
    """Of NumPy, at one position at a time."""
    (found,) = Profiles([[CubicPiece(*piece) for piece in pieces]])(S, S)
    for s, value in zip(S, found, strict=True):
        begun = [piece for piece in pieces if piece[0] <= s]
        start, *coefficients = max(begun) if begun else min(pieces)
        expected = np.polynomial.Polynomial(coefficients)(max(0.0, s - start))
        assert value == pytest.approx(expected, abs=1e-9)
