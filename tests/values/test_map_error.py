"""Errors of maps are refused unless they are standard deviations."""

from typing import Any

import numpy as np
import pytest

from maplines_can import MapError


@pytest.mark.parametrize("name", ["point_sigma", "offset_sigma", "heading_sigma"])
@pytest.mark.parametrize("value", [-1e-9, np.nan, np.inf])
def test_invalid_map_error_raises(name: str, value: Any) -> None:
    """Standard deviations are finite and 0 or more."""
    with pytest.raises(ValueError, match=f"{name} must be 0 or more and finite, got"):
        MapError(**{name: value})


def test_a_map_is_exact_unless_its_error_is_stated() -> None:
    assert MapError() == MapError(0.0, 0.0, 0.0)
