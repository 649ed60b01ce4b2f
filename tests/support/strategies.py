"""Hypothesis strategies for covariances, Gaussians, lines and motions."""

from typing import Any

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from maplines_can.values.gaussian import Gaussian

#: Numbers with few digits: they shrink well, and their squares do not underflow.
ENTRIES = st.floats(-1, 1, width=16)
JITTERS = (0.0, 1e-15, 1e-12, 1e-9, 1e-6, 1e-3, 1.0)


@st.composite
def scales(draw: Any, n: Any) -> Any:
    """(n,) standard deviations over ten decades, the ratio of those of y_off and c1."""
    return 10.0 ** draw(arrays(int, n, elements=st.integers(-8, 2)))


@st.composite
def covariances(draw: Any, n: int = 4, jitters: Any = JITTERS) -> Any:
    """(n, n) covariances of any rank: zero, singular, nearly singular or well conditioned."""
    A = draw(arrays(float, (n, draw(st.integers(0, n))), elements=ENTRIES))
    S = A @ A.T + draw(st.sampled_from(jitters)) * np.eye(n)
    scale = draw(scales(n))
    return S * scale * scale[:, None]


@st.composite
def symmetric(draw: Any, n: int = 4) -> Any:
    """(n, n) symmetric matrices with variances of 0 or more; most are indefinite."""
    A = draw(arrays(float, (n, n), elements=ENTRIES))
    A = A + A.T
    np.fill_diagonal(A, np.abs(A.diagonal()))
    scale = draw(scales(n))
    return A * np.outer(scale, scale)  # exactly symmetric, whatever the ratio to the variances


@st.composite
def gaussians(draw: Any, n: int = 4, jitters: Any = (1e-6, 1e-3, 1.0)) -> Any:
    """Gaussians with a definite covariance."""
    cov = draw(covariances(n, jitters))
    z = draw(arrays(float, n, elements=st.floats(-3, 3, width=16)))
    return Gaussian(z * np.sqrt(cov.diagonal()), cov)


def mild_lines() -> Any:
    """(4,) lines of motorways and main roads: radius 500 m or more."""
    return st.tuples(
        st.floats(-4, 4), st.floats(-0.1, 0.1), st.floats(-1 / 500, 1 / 500), st.floats(-1e-5, 1e-5)
    ).map(np.array)


def motions(metres: float = 5.0, degrees: float = 10.0) -> Any:
    """(3,) motions of a car: x [m], y [m], heading [rad]."""
    shift, turn = st.floats(-metres, metres), st.floats(-np.radians(degrees), np.radians(degrees))
    return st.tuples(shift, shift, turn).map(np.array)
